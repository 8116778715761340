//! Where northbounds hand in their requests to the gateway, and wait for the answers. \[IO\]

use tokio::sync::{mpsc, oneshot};

use super::{Action, Command, CommandSource, Outcome};

/// The asker's end of the queue of requests. Clones share the queue.
#[derive(Clone, Debug)]
pub struct Desk {
    commands: mpsc::Sender<(Command, oneshot::Sender<Outcome>)>,
}

impl Desk {
    /// A desk at which so many requests can wait, and the end that the gateway's task takes them from.
    #[must_use]
    pub fn new(bound: usize) -> (Self, mpsc::Receiver<(Command, oneshot::Sender<Outcome>)>) {
        let (commands, taken) = mpsc::channel(bound.max(1));
        (Self { commands }, taken)
    }

    /// Asks for something and waits until the gateway has answered, in bounded time. Who stops waiting does not take the
    /// request back.
    ///
    /// [`Outcome::Busy`] where the queue is full; nothing was done then. [`Outcome::Failed`] where the gateway ends.
    pub async fn ask(&self, source: CommandSource, action: Action) -> Outcome {
        let (reply, answer) = oneshot::channel();
        // The task of the gateway gives the request its number.
        let command = Command { id: 0, source, action };
        match self.commands.try_send((command, reply)) {
            Ok(()) => answer.await.unwrap_or_else(|_| ends()),
            Err(mpsc::error::TrySendError::Full(_)) => Outcome::Busy,
            Err(mpsc::error::TrySendError::Closed(_)) => ends(),
        }
    }
}

fn ends() -> Outcome {
    Outcome::Failed("the gateway is stopping".into())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn action() -> Action {
        Action::AcknowledgeAll { node: None }
    }

    fn source() -> CommandSource {
        CommandSource::Web("test".into())
    }

    #[tokio::test]
    async fn a_full_desk_is_busy_and_one_without_a_gateway_says_so() {
        let (desk, mut taken) = Desk::new(1);
        let waiting = tokio::spawn({
            let desk = desk.clone();
            async move { desk.ask(source(), action()).await }
        });
        tokio::task::yield_now().await;
        assert_eq!(desk.ask(source(), action()).await, Outcome::Busy);
        let (_, reply) = taken.recv().await.unwrap();
        reply.send(Outcome::Done).unwrap();
        assert_eq!(waiting.await.unwrap(), Outcome::Done);
        drop(taken);
        assert!(matches!(desk.ask(source(), action()).await, Outcome::Failed(_)));
    }
}
