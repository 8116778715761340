//! Requests that come through the broker, `bridge/request/<verb>`, handed to the gateway. \[IO\]

use std::sync::Arc;

use serde_json::{Map, Value as Json};
use tokio::task::JoinSet;

use super::transactions::{Seen, Transactions};
use super::uplink::{Incoming, ReplyTo};
use crate::gateway::command::request::{self, Reply};
use crate::gateway::command::{Authority, CommandSource, Desk, Outcome};
use crate::mapping::TagTable;
use crate::time::Clock;

/// The longest payload in bytes.
pub const LONGEST: usize = 4_096;

/// Bytes of a topic at which an answer is asked for.
const LONGEST_RESPONSE_TOPIC: usize = 512;

/// Letters of a transaction.
const LONGEST_TRANSACTION: usize = 64;

/// Requests under way. One more is answered `busy`.
const UNDER_WAY: usize = 16;

/// A request topic, and that of its answers.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct VerbTopics {
    /// What can be asked for there.
    pub verb: &'static str,
    /// `bridge/request/<verb>`.
    pub request: Arc<str>,
    /// `bridge/response/<verb>`.
    pub response: Arc<str>,
}

/// An answer that is to be published.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Response {
    /// Where.
    pub topic: Arc<str>,
    /// JSON.
    pub payload: String,
    /// What the request wants to find in it, with MQTT 5.
    pub correlation: Option<Arc<[u8]>>,
}

/// Where an answer goes.
#[derive(Clone, Debug)]
struct Target {
    topic: Arc<str>,
    correlation: Option<Arc<[u8]>>,
}

/// The request topics, and what is under way of them.
#[derive(Debug)]
pub(super) struct Requests {
    topics: Vec<VerbTopics>,
    table: Arc<TagTable>,
    desk: Desk,
    clock: Clock,
    transactions: Transactions,
    under_way: JoinSet<(&'static str, Target, String, Outcome)>,
}

impl Requests {
    pub(super) fn new(topics: Vec<VerbTopics>, table: Arc<TagTable>, desk: Desk, clock: Clock) -> Self {
        let (transactions, under_way) = (Transactions::default(), JoinSet::new());
        Self { topics, table, desk, clock, transactions, under_way }
    }

    /// What there is.
    pub(super) fn table(&self) -> &TagTable {
        &self.table
    }

    /// Goes on with other topics, and another table, at another desk. What is under way is answered as ever, and no transaction is
    /// forgotten.
    pub(super) fn exchange(&mut self, topics: Vec<VerbTopics>, table: Arc<TagTable>, desk: Desk) {
        (self.topics, self.table, self.desk) = (topics, table, desk);
    }

    /// Takes a message; gives the answer where there is one already.
    pub(super) fn handle(&mut self, message: &Incoming) -> Option<Response> {
        let topics = self.topics.iter().find(|topics| *topics.request == *message.topic)?.clone();
        let source = CommandSource::mqtt(message.topic.clone());
        if message.payload.is_empty() {
            // How a retained message is cleared.
            return None;
        }
        if message.retain {
            // What was kept by the broker was meant for another time.
            self.desk.refuse(source, topics.verb, "a retained request is ignored".to_owned());
            return None;
        }
        let (target, may_answer) = target(&topics, &message.reply_to);
        let members = match members(&message.payload) {
            Ok(members) => members,
            Err(why) => {
                self.desk.refuse(source, topics.verb, why.clone());
                return Some(answer(&target, None, &Reply::rejected(why)));
            }
        };
        let transaction = match transaction(&members) {
            Ok(transaction) => transaction,
            Err(why) => {
                self.desk.refuse(source, topics.verb, why.to_owned());
                return Some(answer(&target, None, &Reply::rejected(why)));
            }
        };
        if !may_answer {
            let why = format!("the response topic must begin with `{}`", response_prefix(&topics));
            self.desk.refuse(source, topics.verb, why.clone());
            return Some(answer(&target, Some(&transaction), &Reply::rejected(why)));
        }
        let reply = self.carry_out(&topics, &target, &transaction, &members, message)?;
        Some(answer(&target, Some(&transaction), &reply))
    }

    /// `None`: the answer comes later.
    fn carry_out(
        &mut self,
        topics: &VerbTopics,
        target: &Target,
        transaction: &str,
        members: &Map<String, Json>,
        message: &Incoming,
    ) -> Option<Reply> {
        let source = CommandSource::mqtt(message.topic.clone());
        let refuse = |why: &str| {
            self.desk.refuse(source.clone(), topics.verb, why.to_owned());
            Some(Reply::rejected(why))
        };
        let now = self.clock.now();
        let id = (topics.verb, transaction.to_owned());
        match self.transactions.look(now.instant, &id, &message.payload) {
            Seen::New => {}
            Seen::Answered(reply) => return Some(reply),
            Seen::UnderWay => return None,
            Seen::Other => {
                return refuse("another request had this `transaction` within the last ten minutes");
            }
            Seen::Full => return Some(Reply::new(topics.verb, Outcome::Busy)),
        }
        match expired(members, now.utc.as_millis()) {
            Ok(false) => {}
            Ok(true) => return refuse("it has expired"),
            Err(why) => return refuse(why),
        }
        let Some(grant) = self.desk.access().of_broker().cloned() else {
            return refuse("nobody may ask through the broker");
        };
        let action = match request::read(topics.verb, members, &self.table) {
            Ok(action) => action,
            Err(reply) => {
                let mut source = source;
                source.access = Some(Arc::clone(grant.name()));
                self.desk.refuse(source, topics.verb, reply.message.clone());
                return Some(reply);
            }
        };
        if self.under_way.len() >= UNDER_WAY {
            return Some(Reply::new(topics.verb, Outcome::Busy));
        }
        match self.desk.hand_in(source, &Authority::Grant(grant), action) {
            Ok(mut waiting) => {
                self.transactions.begin(now.instant, id, &message.payload);
                let (verb, target, transaction) = (topics.verb, target.clone(), transaction.to_owned());
                self.under_way.spawn(async move { (verb, target, transaction, waiting.wait().await) });
                None
            }
            Err(outcome) => Some(Reply::new(topics.verb, outcome)),
        }
    }

    /// Waits for the next answer; for ever where nothing is under way. Cancel-safe.
    pub(super) async fn next(&mut self) -> Response {
        loop {
            match self.under_way.join_next().await {
                Some(Ok((verb, target, transaction, outcome))) => {
                    let reply = Reply::new(verb, outcome);
                    self.transactions.end(&(verb, transaction.clone()), &reply);
                    return answer(&target, Some(&transaction), &reply);
                }
                // A panic is our bug; it ends this task, and the supervisor tells.
                Some(Err(error)) => {
                    if let Ok(panic) = error.try_into_panic() {
                        std::panic::resume_unwind(panic);
                    }
                }
                None => return std::future::pending().await,
            }
        }
    }
}

fn members(payload: &[u8]) -> Result<Map<String, Json>, String> {
    if payload.len() > LONGEST {
        return Err(format!("a request has at most {LONGEST} bytes"));
    }
    match serde_json::from_slice(payload) {
        Ok(Json::Object(members)) => Ok(members),
        Ok(_) => Err("a request is a JSON object".to_owned()),
        Err(error) => Err(format!("a request is a JSON object: {error}")),
    }
}

fn transaction(members: &Map<String, Json>) -> Result<String, &'static str> {
    let text = members.get("transaction").and_then(Json::as_str);
    let good = |text: &&str| (1..=LONGEST_TRANSACTION).contains(&text.chars().count());
    text.filter(good)
        .map(str::to_owned)
        .ok_or("`transaction` must be text of 1 to 64 letters, another one for each request")
}

/// Whether the time in `expires` has come.
fn expired(members: &Map<String, Json>, now_millis: i64) -> Result<bool, &'static str> {
    match members.get("expires") {
        None => Ok(false),
        Some(expires) => {
            let expires = expires.as_i64().ok_or("`expires` must be a time in ms since 1970")?;
            Ok(expires <= now_millis)
        }
    }
}

/// The topics at which answers may be asked for, so that nobody makes the gateway write where he may not write himself.
fn response_prefix(topics: &VerbTopics) -> &str {
    topics.response.strip_suffix(topics.verb).unwrap_or(&topics.response)
}

/// Where the answer goes, and whether that is where it is wanted.
fn target(topics: &VerbTopics, wanted: &ReplyTo) -> (Target, bool) {
    let correlation = wanted.correlation.clone();
    let here = |topic| Target { topic, correlation: correlation.clone() };
    let Some(topic) = wanted.topic.as_deref() else { return (here(Arc::clone(&topics.response)), true) };
    let is_good = topic.len() <= LONGEST_RESPONSE_TOPIC
        && topic.strip_prefix(response_prefix(topics)).is_some_and(|rest| !rest.is_empty())
        && !topic.chars().any(|c| matches!(c, '+' | '#') || c.is_control());
    (here(if is_good { topic.into() } else { Arc::clone(&topics.response) }), is_good)
}

fn answer(target: &Target, transaction: Option<&str>, reply: &Reply) -> Response {
    #[derive(serde::Serialize)]
    struct Answer<'a> {
        transaction: Option<&'a str>,
        #[serde(flatten)]
        reply: &'a Reply,
    }
    // Texts and numbers are always JSON.
    let payload = serde_json::to_string(&Answer { transaction, reply }).unwrap_or_default();
    let Target { topic, correlation } = target.clone();
    Response { topic, payload, correlation }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::access::{Access, AccessEntry, Role};
    use crate::gateway::Command;
    use crate::gateway::command::Action;
    use crate::mapping::{At, Sketch, SourceText};
    use tokio::sync::{mpsc, oneshot};

    type Queue = mpsc::Receiver<(Command, oneshot::Sender<Outcome>)>;

    fn requests(role: Role) -> (Requests, Desk, Queue) {
        let table = Sketch::new().node("engine1", 1, "motortech-detcon", |_| ()).build().unwrap().0;
        let entry = AccessEntry { role, mqtt: Some(At::nowhere(true)), ..AccessEntry::default() };
        let entries = [(At::nowhere("scada".to_owned()), entry)].into();
        let (access, _) = Access::build(&SourceText::new("", ""), &entries, &table);
        let (desk, queue) = Desk::new(32);
        desk.set_access(Arc::new(access));
        let topics = request::VERBS.map(|verb| VerbTopics {
            verb,
            request: format!("c/g/bridge/request/{verb}").into(),
            response: format!("c/g/bridge/response/{verb}").into(),
        });
        let requests = Requests::new(topics.to_vec(), Arc::new(table), desk.clone(), Clock::start());
        (requests, desk, queue)
    }

    fn message(verb: &str, payload: &str) -> Incoming {
        Incoming {
            topic: format!("c/g/bridge/request/{verb}"),
            payload: payload.into(),
            retain: false,
            reply_to: ReplyTo::default(),
        }
    }

    fn refused(desk: &Desk) -> u64 {
        desk.refused().into_iter().map(|(_, count)| count).sum()
    }

    const ACKNOWLEDGE: &str = r#"{"transaction":"a1","node":"engine1","alarm":"trip"}"#;

    #[tokio::test]
    async fn a_request_is_answered_once_it_was_carried_out_and_not_carried_out_twice() {
        let (mut requests, _, mut queue) = requests(Role::Operator);
        let acknowledge = message("acknowledge", ACKNOWLEDGE);
        assert_eq!(requests.handle(&acknowledge), None);
        assert_eq!(requests.handle(&acknowledge), None, "under way");
        let (command, reply) = queue.recv().await.unwrap();
        assert_eq!(command.source.to_string(), "mqtt c/g/bridge/request/acknowledge as scada");
        assert!(matches!(command.action, Action::Acknowledge { raise: None, .. }));
        reply.send(Outcome::Done).unwrap();
        let response = requests.next().await;
        assert_eq!(&*response.topic, "c/g/bridge/response/acknowledge");
        assert_eq!(response.payload, r#"{"transaction":"a1","result":"ok","message":""}"#);
        assert_eq!(requests.handle(&acknowledge), Some(response));
        assert!(queue.try_recv().is_err(), "it was done once");
        let other = message("acknowledge", &ACKNOWLEDGE.replace("trip", "low_rpm"));
        assert!(requests.handle(&other).unwrap().payload.contains("another request had this"));
    }

    #[tokio::test]
    async fn c_5_what_is_retained_late_too_long_or_no_request_is_refused_and_counted() {
        let (mut requests, desk, mut queue) = requests(Role::Engineer);
        let retained = Incoming { retain: true, ..message("acknowledge", ACKNOWLEDGE) };
        assert_eq!(requests.handle(&retained), None);
        let long = format!("{{\"transaction\":\"a\",\"x\":\"{}\"}}", "x".repeat(LONGEST));
        for (payload, why) in [
            (long.as_str(), "at most 4096 bytes"),
            ("17", "JSON object"),
            ("{", "JSON object"),
            ("{}", "`transaction`"),
            (r#"{"transaction":""}"#, "`transaction`"),
            (r#"{"transaction":"a","expires":1}"#, "expired"),
            (r#"{"transaction":"a","expires":"soon"}"#, "`expires`"),
            (r#"{"transaction":"a","node":"engine1"}"#, "`alarm`"),
        ] {
            let response = requests.handle(&message("acknowledge", payload)).unwrap();
            assert!(
                response.payload.contains("\"rejected\"") && response.payload.contains(why),
                "{response:?}"
            );
        }
        assert_eq!(refused(&desk), 9);
        assert_eq!(requests.handle(&message("acknowledge", "")), None, "a cleared topic is no request");
        assert_eq!(requests.handle(&message("fly", ACKNOWLEDGE)), None, "another topic");
        assert_eq!(refused(&desk), 9);
        assert!(queue.try_recv().is_err());
    }

    #[tokio::test]
    async fn an_answer_goes_where_it_is_wanted_with_what_is_to_be_found_in_it() {
        let (mut requests, _, mut queue) = requests(Role::Operator);
        let reply_to = ReplyTo {
            topic: Some("c/g/bridge/response/scada/7".to_owned()),
            correlation: Some(Arc::from(*b"\0\x01")),
        };
        let acknowledge = Incoming { reply_to: reply_to.clone(), ..message("acknowledge", ACKNOWLEDGE) };
        assert_eq!(requests.handle(&acknowledge), None);
        queue.recv().await.unwrap().1.send(Outcome::Done).unwrap();
        let response = requests.next().await;
        assert_eq!(Some(&*response.topic), reply_to.topic.as_deref());
        assert_eq!(response.correlation, reply_to.correlation);
        let again = requests.handle(&message("acknowledge", ACKNOWLEDGE)).unwrap();
        assert_eq!((&*again.topic, again.correlation), ("c/g/bridge/response/acknowledge", None));
    }

    #[tokio::test]
    async fn nobody_makes_the_gateway_write_where_answers_do_not_belong() {
        let (mut requests, desk, mut queue) = requests(Role::Engineer);
        let foreign = [
            "c/g/engine1/state",
            "c/g/bridge/request/nmt",
            "c/g/bridge/response/",
            "c/g/bridge/response/#",
            "c/g/bridge/response/a/+",
            "c/g/bridge/response/a\0",
            "other/c/g/bridge/response/a",
            "",
        ];
        for topic in
            foreign.map(str::to_owned).into_iter().chain([format!("c/g/bridge/response/{}", "x".repeat(512))])
        {
            let reply_to = ReplyTo { topic: Some(topic.clone()), correlation: None };
            let request = Incoming { reply_to, ..message("acknowledge", ACKNOWLEDGE) };
            let response = requests.handle(&request).unwrap();
            assert_eq!(&*response.topic, "c/g/bridge/response/acknowledge", "{topic}");
            assert!(
                response.payload.contains("must begin with `c/g/bridge/response/`"),
                "{}",
                response.payload
            );
            assert!(response.payload.contains(r#""transaction":"a1""#));
        }
        assert_eq!(refused(&desk), 9);
        assert!(queue.try_recv().is_err(), "and nothing is done");
    }

    #[tokio::test]
    async fn s11_who_may_ask_is_looked_up_for_each_request() {
        let (mut requests, desk, mut queue) = requests(Role::Viewer);
        let nmt = message("nmt", r#"{"transaction":"n","node":"engine1","request":"stop"}"#);
        assert!(requests.handle(&nmt).unwrap().payload.contains("`scada` is viewer"));
        desk.set_access(Arc::default());
        assert!(requests.handle(&nmt).unwrap().payload.contains("nobody may ask"));
        assert_eq!(refused(&desk), 2);
        assert!(queue.try_recv().is_err());
    }
}
