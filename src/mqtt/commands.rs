//! Messages of command topics, handed to the gateway. \[IO\]

use std::collections::BTreeMap;
use std::sync::Arc;

use tokio::task::JoinSet;

use super::requests::{Requests, Response, VerbTopics};
use super::serial_command::{Refused, SerialAnswer, SerialCommand, result};
use super::uplink::Incoming;
use crate::gateway::command::{Action, Authority, CommandSource, Desk, Outcome};
use crate::mapping::TagTable;
use crate::process_image::LineIndex;

/// Requests of one line that are handed in and not answered. One more is refused as `busy`; other lines do not wait for it.
const UNDER_WAY: usize = 8;

/// What is to be published.
#[derive(Debug, PartialEq, Eq)]
pub(super) enum Answer {
    /// What became of bytes for a serial line.
    Serial(SerialAnswer),
    /// What became of a request.
    Response(Response),
}

/// The command topics and what is under way of them.
#[derive(Debug)]
pub(super) struct Commands {
    topics: Vec<(Arc<str>, LineIndex)>,
    requests: Requests,
    desk: Desk,
    under_way: JoinSet<(Line, Option<String>, Outcome)>,
    /// How many of them are of a line, by its topic; none of a line that is not here.
    of_line: BTreeMap<Arc<str>, usize>,
}

/// A line by its names, which stay what they are when another table comes.
#[derive(Clone, Debug)]
struct Line {
    topic: Arc<str>,
    node: Arc<str>,
    number: u8,
}

impl Commands {
    /// Commands of these topics and requests, for the gateway behind a desk.
    pub(super) fn new(topics: Vec<(Arc<str>, LineIndex)>, requests: Requests, desk: Desk) -> Self {
        Self { topics, requests, desk, under_way: JoinSet::new(), of_line: BTreeMap::new() }
    }

    /// Goes on with other topics, and another table, at another desk. What is under way is answered as ever.
    pub(super) fn exchange(
        &mut self,
        topics: Vec<(Arc<str>, LineIndex)>,
        requests: Vec<VerbTopics>,
        table: Arc<TagTable>,
        desk: Desk,
    ) {
        self.topics = topics;
        self.requests.exchange(requests, table, desk.clone());
        self.desk = desk;
    }

    /// Takes a message; gives the answer where there is one already. Bytes for a line are handed in in the order in which
    /// the messages came.
    pub(super) fn handle(&mut self, message: &Incoming) -> Option<Answer> {
        let response = self.requests.handle(message).map(Answer::Response);
        response.or_else(|| self.handle_bytes(message).map(Answer::Serial))
    }

    fn handle_bytes(&mut self, message: &Incoming) -> Option<SerialAnswer> {
        let topic = message.topic.as_str();
        let (known, place) = self.topics.iter().find(|(known, _)| **known == *topic)?;
        let (known, place) = (Arc::clone(known), *place);
        if message.retain {
            // What was kept by the broker was meant for another time.
            tracing::warn!(
                topic,
                "a retained message on a command topic is ignored; publish without retain, and clear it"
            );
            return None;
        }
        if message.payload.is_empty() {
            // How a retained message is cleared.
            return None;
        }
        let line = self.line(known, place);
        let command = match SerialCommand::read(&message.payload) {
            Ok(command) => command,
            Err(Refused { transaction, answer, why }) => {
                tracing::warn!(topic, "not sent: {why}");
                return answer.then(|| line.answer(transaction, "rejected", why));
            }
        };
        let action = Action::SerialSend { line: place, bytes: command.bytes };
        let under_way = self.of_line.get(&line.topic).copied().unwrap_or_default();
        let handed_in = if under_way < UNDER_WAY {
            self.desk.hand_in(CommandSource::mqtt(topic.to_owned()), &Authority::SerialLine, action)
        } else {
            Err(Outcome::Busy)
        };
        match handed_in {
            Ok(mut answer) => {
                self.of_line.insert(Arc::clone(&line.topic), under_way + 1);
                self.under_way.spawn(async move { (line, command.transaction, answer.wait().await) });
                None
            }
            Err(outcome) => answer(&line, command.transaction, outcome),
        }
    }

    /// Waits for the next answer to a request; for ever where nothing is under way. Cancel-safe.
    pub(super) async fn next(&mut self) -> Answer {
        loop {
            let ended = tokio::select! {
                response = self.requests.next() => return Answer::Response(response),
                ended = self.under_way.join_next(), if !self.under_way.is_empty() => ended,
            };
            match ended {
                Some(Ok((line, transaction, outcome))) => {
                    if let Some(under_way) = self.of_line.get_mut(&line.topic) {
                        *under_way = under_way.saturating_sub(1);
                    }
                    if let Some(answer) = answer(&line, transaction, outcome) {
                        return Answer::Serial(answer);
                    }
                }
                // A panic is our bug; it ends this task, and the supervisor tells.
                Some(Err(error)) => {
                    if let Ok(panic) = error.try_into_panic() {
                        std::panic::resume_unwind(panic);
                    }
                }
                None => {}
            }
        }
    }

    fn line(&self, topic: Arc<str>, place: LineIndex) -> Line {
        let table = self.requests.table();
        let def = table.line(place);
        let node = def.and_then(|def| table.node(def.node)).map_or("", |node| node.name.as_str());
        Line { topic, node: node.into(), number: def.map_or(0, |def| def.number) }
    }
}

impl Line {
    fn answer(&self, transaction: Option<String>, result: &'static str, message: String) -> SerialAnswer {
        SerialAnswer { node: Arc::clone(&self.node), number: self.number, transaction, result, message }
    }
}

fn answer(line: &Line, transaction: Option<String>, outcome: Outcome) -> Option<SerialAnswer> {
    let (result, message) = result(outcome);
    if result != "ok" {
        tracing::warn!(topic = &*line.topic, result, "not or not wholly sent: {message}");
    }
    transaction.map(|transaction| line.answer(Some(transaction), result, message))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::mqtt::uplink::ReplyTo;

    fn commands(topics: Vec<(Arc<str>, LineIndex)>, desk: Desk) -> Commands {
        let clock = crate::time::Clock::start();
        Commands::new(topics, Requests::new(Vec::new(), Arc::default(), desk.clone(), clock), desk)
    }

    fn message(answer: Option<Answer>) -> (&'static str, String) {
        match answer {
            Some(Answer::Serial(answer)) => (answer.result, answer.message),
            other => panic!("{other:?}"),
        }
    }

    fn request(topic: &str) -> Incoming {
        let payload = br#"{"transaction":"a","data":"x"}"#.to_vec();
        Incoming { topic: topic.to_owned(), payload, retain: false, reply_to: ReplyTo::default() }
    }

    #[tokio::test]
    async fn a_line_that_is_held_does_not_make_another_one_busy() {
        let (desk, _gateway) = Desk::new(64);
        let topics = vec![(Arc::from("one"), LineIndex(0)), (Arc::from("two"), LineIndex(1))];
        let mut commands = commands(topics, desk);
        for _ in 0..UNDER_WAY {
            assert_eq!(commands.handle(&request("one")), None);
        }
        assert_eq!(message(commands.handle(&request("one"))).0, "busy");
        assert_eq!(commands.handle(&request("two")), None);
    }

    #[tokio::test]
    async fn an_answer_makes_room_for_the_next_request_of_its_line() {
        let (desk, gateway) = Desk::new(64);
        let mut commands = commands(vec![(Arc::from("one"), LineIndex(0))], desk);
        for _ in 0..UNDER_WAY {
            commands.handle(&request("one"));
        }
        // The gateway is gone: whatever waits is answered.
        drop(gateway);
        commands.next().await;
        assert_ne!(message(commands.handle(&request("one"))).1, "too much waits for this line; try again");
    }
}
