//! Names of topics: everything stands under `<base>/<gateway>/`.

use std::fmt::Write as _;
use std::sync::Arc;

use super::requests::VerbTopics;
use crate::gateway::command::request::VERBS;
use crate::mapping::{AlarmDef, AlarmOwner, LineDef, TagTable};

/// Every topic of one gateway, made once.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Topics {
    /// `bridge/state`: online or offline, retained, last will.
    pub bridge_state: Arc<str>,
    /// `bridge/info`: what this gateway is, retained.
    pub bridge_info: Arc<str>,
    /// `bridge/health`: how it is, retained.
    pub bridge_health: Arc<str>,
    /// `event`: what happened.
    pub event: Arc<str>,
    /// By [`NodeIndex`](crate::process_image::NodeIndex).
    pub nodes: Vec<NodeTopics>,
    /// By [`AlarmIndex`](crate::process_image::AlarmIndex).
    pub alarms: Vec<Arc<str>>,
    /// By [`LineIndex`](crate::process_image::LineIndex).
    pub lines: Vec<LineTopics>,
    /// `bridge/response/serial_send`: what became of requests to send on a line.
    pub serial_response: Arc<str>,
    /// `bridge/request/<verb>` and `bridge/response/<verb>`.
    pub requests: Vec<VerbTopics>,
}

/// The topics of one serial line.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct LineTopics {
    /// `<node>/serial/<number>/rx`: messages that came in.
    pub rx: Arc<str>,
    /// `<node>/serial/<number>/tx`: what is to go out; the only topics that are subscribed.
    pub tx: Arc<str>,
}

/// The topics of one node, its alarms apart.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct NodeTopics {
    /// `<node>/state`: all its published tags.
    pub state: Arc<str>,
    /// `<node>/availability`: whether it is there.
    pub availability: Arc<str>,
}

impl Topics {
    /// The topics of everything in the table.
    #[must_use]
    pub fn new(base: &str, table: &TagTable) -> Self {
        let prefix = format!("{base}/{}", level(&table.gateway));
        let topic = |rest: &str| Arc::<str>::from(format!("{prefix}/{rest}"));
        let node_topics = |name: &str| NodeTopics {
            state: topic(&format!("{}/state", level(name))),
            availability: topic(&format!("{}/availability", level(name))),
        };
        let line_topics = |line: &LineDef| {
            let node = table.node(line.node).map_or("node", |node| node.name.as_str());
            let path = format!("{}/serial/{}", level(node), line.number);
            LineTopics { rx: topic(&format!("{path}/rx")), tx: topic(&format!("{path}/tx")) }
        };
        Self {
            bridge_state: topic("bridge/state"),
            bridge_info: topic("bridge/info"),
            bridge_health: topic("bridge/health"),
            event: topic("event"),
            nodes: table.nodes.iter().map(|node| node_topics(&node.name)).collect(),
            lines: table.lines.iter().map(line_topics).collect(),
            serial_response: topic("bridge/response/serial_send"),
            requests: VERBS.map(|verb| verb_topics(verb, topic)).to_vec(),
            alarms: table.alarms.iter().map(|alarm| topic(&alarm_path(table, alarm))).collect(),
        }
    }
}

fn verb_topics(verb: &'static str, topic: impl Fn(&str) -> Arc<str>) -> VerbTopics {
    let (request, response) = (format!("bridge/request/{verb}"), format!("bridge/response/{verb}"));
    VerbTopics { verb, request: topic(&request), response: topic(&response) }
}

/// The path of an alarm below the gateway's prefix.
fn alarm_path(table: &TagTable, alarm: &AlarmDef) -> String {
    let name = level(&alarm.name);
    let mut path = String::new();
    // Writing into a string cannot fail.
    let _ = match alarm.owner {
        AlarmOwner::Gateway => write!(path, "bridge/alarm/{name}"),
        AlarmOwner::Bus(bus) => {
            let bus = table.buses.get(bus.0).map_or("bus", |bus| bus.name.as_str());
            write!(path, "bridge/alarm/{}_{name}", level(bus))
        }
        AlarmOwner::Node(node) => {
            let node = table.node(node).map_or("node", |node| node.name.as_str());
            write!(path, "{}/alarm/{name}", level(node))
        }
    };
    path
}

/// A name as one level of a topic: what would split it, or act as a wildcard, becomes `_`. The configuration refuses
/// such names; this keeps the promise to the broker whoever built the table.
fn level(name: &str) -> String {
    let safe = |c: char| if matches!(c, '/' | '+' | '#') || c.is_control() { '_' } else { c };
    let level: String = name.chars().map(safe).collect();
    if level.is_empty() { "_".to_owned() } else { level }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_name_stays_one_level() {
        assert_eq!(level("engine1"), "engine1");
        assert_eq!(level("a/b+c#d\0"), "a_b_c_d_");
        assert_eq!(level(""), "_");
    }
}
