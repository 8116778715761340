//! Where northbounds hand in their requests to the gateway, and wait for the answers. \[IO\]
//!
//! Nothing passes without a right to it: a request that its [`Authority`] does not allow goes no further, and is told of.

use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use tokio::sync::{Notify, mpsc, oneshot};
use tokio::time::{Interval, MissedTickBehavior, interval};

use super::refused::Ledger;
use super::{Access, Action, Authority, Command, CommandSource, Door, Outcome, Refused};

/// The gateway is told of refused requests at most this often.
const REFUSALS_PAUSE: Duration = Duration::from_millis(100);

/// What is told of a request that a reload overtook.
const CHANGED: &str = "the configuration was changed meanwhile; nothing of this was done";

/// The asker's end of the queue of requests. Clones share the queue.
#[derive(Clone, Debug)]
pub struct Desk {
    commands: mpsc::Sender<(Command, oneshot::Sender<Outcome>)>,
    /// Of this desk alone: tags are named by their places in the table that goes with it.
    access: Arc<Mutex<Arc<Access>>>,
    /// Desks that were [renewed](Self::renewed) before it.
    generation: u64,
    shared: Arc<Shared>,
}

/// What all ends have in common, those of a renewed desk too.
#[derive(Debug, Default)]
struct Shared {
    refused: Mutex<Refusals>,
    news: Notify,
}

#[derive(Debug, Default)]
struct Refusals {
    ledger: Ledger,
    /// Of the desk that the gateway serves.
    generation: u64,
}

impl Desk {
    /// A desk at which so many requests can wait, and the end that the gateway's task takes them from. Nobody is known at it.
    #[must_use]
    pub fn new(bound: usize) -> (Self, mpsc::Receiver<(Command, oneshot::Sender<Outcome>)>) {
        let (commands, taken) = mpsc::channel(bound.max(1));
        (Self { commands, access: Arc::default(), generation: 0, shared: Arc::default() }, taken)
    }

    /// Who may ask for what, from now on.
    pub fn set_access(&self, access: Arc<Access>) {
        *self.access.lock().unwrap_or_else(PoisonError::into_inner) = access;
    }

    /// Who may ask for what. To be asked for each request: it changes with the configuration.
    #[must_use]
    pub fn access(&self) -> Arc<Access> {
        Arc::clone(&self.access.lock().unwrap_or_else(PoisonError::into_inner))
    }

    /// A desk for those who ask by the places of another table, with what may be asked for there, and the end that the gateway's
    /// task takes its requests from. At this one nobody is served once the gateway has that.
    #[must_use]
    pub fn renewed(&self, bound: usize, access: Arc<Access>) -> (Self, Requests) {
        let (commands, taken) = mpsc::channel(bound.max(1));
        let (access, shared) = (Arc::new(Mutex::new(access)), Arc::clone(&self.shared));
        let desk = Self { commands, access, generation: self.generation.saturating_add(1), shared };
        let requests = Requests::new(&desk, taken);
        (desk, requests)
    }

    /// Asks for something and waits until the gateway has answered, in bounded time. Who stops waiting does not take the
    /// request back.
    ///
    /// [`Outcome::Forbidden`] where the authority does not allow it; [`Outcome::Busy`] where the queue is full; nothing was
    /// done then. [`Outcome::Failed`] where the gateway ends, or serves another desk by now.
    pub async fn ask(&self, source: CommandSource, authority: &Authority, action: Action) -> Outcome {
        match self.hand_in(source, authority, action) {
            Ok(mut answer) => answer.wait().await,
            Err(outcome) => outcome,
        }
    }

    /// Asks for something without waiting for the answer. Requests of one asker are dealt with in the order in which they
    /// were handed in.
    ///
    /// # Errors
    /// What [`ask`](Self::ask) answers where the request was not taken.
    pub fn hand_in(
        &self,
        mut source: CommandSource,
        authority: &Authority,
        action: Action,
    ) -> Result<Answer, Outcome> {
        if let Authority::Grant(grant) = authority {
            source.access = Some(Arc::clone(grant.name()));
        }
        if let Err(why) = authority.permits(&action) {
            let (verb, text) = (action.word(), why.clone());
            self.note(Refused { source, verb, action: Some(action), text, count: 1 });
            return Err(Outcome::Forbidden(why));
        }
        let (reply, answer) = oneshot::channel();
        // The task of the gateway gives the request its number.
        let command = Command { id: 0, source, action };
        match self.commands.try_send((command, reply)) {
            Ok(()) => Ok(Answer(answer)),
            Err(mpsc::error::TrySendError::Full(_)) => Err(Outcome::Busy),
            // Another desk is served by now, or none ever again.
            Err(mpsc::error::TrySendError::Closed(_))
                if self.shared.refused().generation == self.generation =>
            {
                Err(ends())
            }
            Err(mpsc::error::TrySendError::Closed(_)) => Err(Outcome::Failed(CHANGED.to_owned())),
        }
    }

    /// A door refused a request by itself: nobody who may ask at all, or one that it could not even read. `verb` is the word of what was asked for.
    pub fn refuse(&self, source: CommandSource, verb: &'static str, text: String) {
        self.note(Refused { source, verb, action: None, text, count: 1 });
    }

    fn note(&self, refused: Refused) {
        self.shared.note(self.generation, refused);
    }

    /// How many requests were refused at each door since the start.
    #[must_use]
    pub fn refused(&self) -> Vec<(Door, u64)> {
        let totals = self.shared.refused().ledger.totals();
        Door::ALL.into_iter().zip(totals).collect()
    }
}

/// The answer to a request that was handed in.
#[derive(Debug)]
pub struct Answer(oneshot::Receiver<Outcome>);

impl Answer {
    /// Waits for it, in bounded time. It is given once. Cancel-safe.
    pub async fn wait(&mut self) -> Outcome {
        (&mut self.0).await.unwrap_or_else(|_| ends())
    }
}

fn ends() -> Outcome {
    Outcome::Failed("the gateway is stopping, or has just taken in another configuration".into())
}

/// The gateway's end: requests, and what was refused before it became one.
#[derive(Debug)]
pub struct Requests {
    commands: mpsc::Receiver<(Command, oneshot::Sender<Outcome>)>,
    generation: u64,
    shared: Arc<Shared>,
    /// When refusals are told.
    pace: Interval,
}

/// One of what [`Requests`] brings.
#[derive(Debug)]
pub enum Request {
    /// A request, and where its answer goes.
    Command(Command, oneshot::Sender<Outcome>),
    /// Requests that were refused.
    Refused(Vec<Refused>),
}

impl Requests {
    /// The end of a desk: what [`Desk::new`] gave beside it.
    #[must_use]
    pub fn new(desk: &Desk, commands: mpsc::Receiver<(Command, oneshot::Sender<Outcome>)>) -> Self {
        Self { commands, generation: desk.generation, shared: Arc::clone(&desk.shared), pace: pace() }
    }

    /// The next one; `None` when nobody can ask any more. Cancel-safe.
    pub async fn next(&mut self) -> Option<Request> {
        let Self { commands, shared, pace, .. } = self;
        tokio::select! {
            command = commands.recv() => match command {
                Some((command, reply)) => Some(Request::Command(command, reply)),
                None => Some(shared.take()).filter(|refused| !refused.is_empty()).map(Request::Refused),
            },
            refused = shared.next_refused(pace) => Some(Request::Refused(refused)),
        }
    }

    /// Nobody is served here any more, because requests come from `next` from now on. Who waits is told so; gives what was
    /// refused, which is to be told by the table that it was asked by.
    pub fn give_way_to(&mut self, next: &Self) -> Vec<Refused> {
        let mut refused = self.shared.refused();
        // Before the end is closed: whoever finds it so knows why.
        refused.generation = next.generation;
        self.commands.close();
        while let Ok((Command { source, action, .. }, reply)) = self.commands.try_recv() {
            let (verb, text) = (action.word(), CHANGED.to_owned());
            refused.ledger.note(Refused { source, verb, action: Some(action), text, count: 1 });
            // An asker who has gone does not want to know.
            let _ = reply.send(Outcome::Failed(CHANGED.to_owned()));
        }
        refused.ledger.take()
    }
}

/// Without a desk: requests alone.
impl From<mpsc::Receiver<(Command, oneshot::Sender<Outcome>)>> for Requests {
    fn from(commands: mpsc::Receiver<(Command, oneshot::Sender<Outcome>)>) -> Self {
        Self { commands, generation: 0, shared: Arc::default(), pace: pace() }
    }
}

fn pace() -> Interval {
    let mut pace = interval(REFUSALS_PAUSE);
    pace.set_missed_tick_behavior(MissedTickBehavior::Delay);
    pace
}

impl Shared {
    fn refused(&self) -> MutexGuard<'_, Refusals> {
        self.refused.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// What was asked for by the places of a table that is no more cannot be told in detail.
    fn note(&self, generation: u64, refused: Refused) {
        let mut refusals = self.refused();
        let is_current = refusals.generation == generation;
        let action = refused.action.filter(|_| is_current);
        refusals.ledger.note(Refused { action, ..refused });
        drop(refusals);
        self.news.notify_one();
    }

    fn take(&self) -> Vec<Refused> {
        self.refused().ledger.take()
    }

    /// Waits for refusals, at the pace. Cancel-safe: they are taken last.
    async fn next_refused(&self, pace: &mut Interval) -> Vec<Refused> {
        loop {
            let waits = !self.refused().ledger.is_empty();
            if waits {
                pace.tick().await;
                return self.take();
            }
            self.news.notified().await;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::access::{Grant, Role};

    fn action() -> Action {
        Action::AcknowledgeAll { node: None }
    }

    fn source() -> CommandSource {
        CommandSource::web("test".into())
    }

    fn authority(role: Role) -> Authority {
        Authority::Grant(Arc::new(Grant::new("hmi", role, [])))
    }

    #[tokio::test]
    async fn a_full_desk_is_busy_and_one_without_a_gateway_says_so() {
        let (desk, mut taken) = Desk::new(1);
        let operator = authority(Role::Operator);
        let waiting = tokio::spawn({
            let (desk, operator) = (desk.clone(), operator.clone());
            async move { desk.ask(source(), &operator, action()).await }
        });
        tokio::task::yield_now().await;
        assert_eq!(desk.ask(source(), &operator, action()).await, Outcome::Busy);
        let (command, reply) = taken.recv().await.unwrap();
        assert_eq!(command.source.to_string(), "web test as hmi");
        reply.send(Outcome::Done).unwrap();
        assert_eq!(waiting.await.unwrap(), Outcome::Done);
        drop(taken);
        assert!(matches!(desk.ask(source(), &operator, action()).await, Outcome::Failed(_)));
    }

    #[tokio::test(start_paused = true)]
    async fn cr_2_1_what_is_forbidden_never_reaches_the_queue_and_each_of_it_is_counted() {
        let (desk, taken) = Desk::new(1);
        let mut requests = Requests::new(&desk, taken);
        let viewer = authority(Role::Viewer);
        for _ in 0..1000 {
            assert!(matches!(desk.ask(source(), &viewer, action()).await, Outcome::Forbidden(_)));
        }
        desk.refuse(CommandSource::modbus("10.0.0.7:1".into()), "write", "nobody".into());
        let Some(Request::Refused(refused)) = requests.next().await else { panic!("no refusals") };
        let told: Vec<(&str, u64)> = refused.iter().map(|each| (each.verb, each.count)).collect();
        assert_eq!(told, [("write", 1), ("acknowledge_all", 1000)]);
        assert_eq!(refused[1].source.to_string(), "web test as hmi");
        assert_eq!(desk.refused()[0], (Door::Modbus, 1));
        assert_eq!(desk.refused()[2], (Door::Web, 1000));
        drop(desk);
        assert!(requests.next().await.is_none());
    }

    #[tokio::test(start_paused = true)]
    async fn refusals_are_told_ten_times_a_second_at_most_and_hold_no_request_up() {
        let (desk, taken) = Desk::new(8);
        let mut requests = Requests::new(&desk, taken);
        let clock = crate::time::Clock::start();
        let elapsed = || Duration::from_millis(clock.now().instant.as_millis());
        for _ in 0..3 {
            desk.refuse(source(), "write", String::new());
            assert!(matches!(requests.next().await, Some(Request::Refused(_))));
        }
        assert_eq!(elapsed(), REFUSALS_PAUSE * 2);
        desk.refuse(source(), "write", String::new());
        let _answer = desk.hand_in(source(), &authority(Role::Operator), action()).unwrap();
        assert!(matches!(requests.next().await, Some(Request::Command(..))));
        assert_eq!(elapsed(), REFUSALS_PAUSE * 2);
        drop(desk);
        assert!(matches!(requests.next().await, Some(Request::Refused(_))), "the last are not lost");
    }

    #[tokio::test(start_paused = true)]
    async fn p29_what_waited_when_another_table_came_is_told_so_and_never_done_by_its_places() {
        let (desk, taken) = Desk::new(4);
        let mut requests = Requests::new(&desk, taken);
        let operator = authority(Role::Operator);
        let mut waiting = desk.hand_in(source(), &operator, action()).unwrap();
        let grant = Grant::new("new", Role::Operator, []);
        let (renewed, mut next) = desk.renewed(4, Arc::default());
        let refused = requests.give_way_to(&next);
        assert_eq!((refused.len(), refused[0].verb), (1, "acknowledge_all"));
        assert!(refused[0].action.is_some(), "it is told by the table that it was asked by");
        assert!(matches!(waiting.wait().await, Outcome::Failed(why) if why.contains("changed meanwhile")));
        // Who has not noticed yet is not served, and what it is refused is told without places.
        let late = desk.ask(source(), &operator, action()).await;
        assert!(matches!(&late, Outcome::Failed(why) if why.contains("changed meanwhile")), "{late:?}");
        let viewer = authority(Role::Viewer);
        assert!(matches!(desk.ask(source(), &viewer, action()).await, Outcome::Forbidden(_)));
        let Some(Request::Refused(late)) = next.next().await else { panic!("no refusals") };
        assert_eq!((late.len(), &late[0].action), (1, &None));
        let _answer = renewed.hand_in(source(), &Authority::Grant(Arc::new(grant)), action()).unwrap();
        assert!(matches!(next.next().await, Some(Request::Command(..))));
        assert_eq!(renewed.refused()[2], (Door::Web, 2), "counters go on");
    }

    #[tokio::test]
    async fn cr_2_1_who_asks_by_the_table_before_keeps_the_rights_of_it_until_there_is_another_one() {
        let (desk, _) = Desk::new(1);
        let before = Arc::new(Access::default());
        desk.set_access(Arc::clone(&before));
        let (renewed, _) = desk.renewed(1, Arc::new(Access::default()));
        assert!(Arc::ptr_eq(&desk.access(), &before));
        assert!(!Arc::ptr_eq(&renewed.access(), &before));
    }
}
