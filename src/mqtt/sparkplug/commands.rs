//! What hosts ask for by Sparkplug, handed to the gateway. \[IO\]
//!
//! Sparkplug has no answer to a command: what became of it stands in the log and in the journal, and a host sees the value change.

use std::sync::Arc;

use tokio::task::JoinSet;

use super::command::Asked;
use crate::gateway::command::request::Reply;
use crate::gateway::command::{Action, Authority, CommandSource, Desk, Outcome};

/// Commands under way. One more is not carried out.
const UNDER_WAY: usize = 16;

/// The commands of one session's task.
#[derive(Debug)]
pub(super) struct Commands {
    desk: Desk,
    under_way: JoinSet<()>,
}

impl Commands {
    pub(super) fn new(desk: Desk) -> Self {
        Self { desk, under_way: JoinSet::new() }
    }

    /// Goes on at another desk. What is under way is ended as ever.
    pub(super) fn set_desk(&mut self, desk: Desk) {
        self.desk = desk;
    }

    /// Has the gateway do what the message of a topic asks for.
    pub(super) fn handle(&mut self, topic: &str, asked: Asked) {
        while self.under_way.try_join_next().is_some() {}
        let source = CommandSource::mqtt(topic.to_owned());
        match asked {
            Asked::Nothing => {}
            Asked::Refused(why) => self.refuse(source, topic, why),
            Asked::Write(writes) => {
                let Some(grant) = self.desk.access().of_broker().map(Arc::clone) else {
                    return self.refuse(source, topic, "nobody may ask through the broker".to_owned());
                };
                if self.under_way.len() >= UNDER_WAY {
                    return tell(topic, Outcome::Busy);
                }
                let action = Action::WriteTags { writes };
                match self.desk.hand_in(source, &Authority::Grant(grant), action) {
                    Ok(mut answer) => {
                        let topic = topic.to_owned();
                        self.under_way.spawn(async move { tell(&topic, answer.wait().await) });
                    }
                    Err(outcome) => tell(topic, outcome),
                }
            }
        }
    }

    fn refuse(&self, source: CommandSource, topic: &str, why: String) {
        tracing::warn!(topic, "a command by Sparkplug is not carried out: {why}");
        self.desk.refuse(source, "write", why);
    }
}

fn tell(topic: &str, outcome: Outcome) {
    let Reply { result, message, .. } = Reply::new("write", outcome);
    if result == "ok" {
        tracing::info!(topic, "a command by Sparkplug is carried out");
    } else {
        tracing::warn!(topic, result, "a command by Sparkplug is not carried out: {message}");
    }
}
