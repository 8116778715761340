//! Whether the primary host application is online, from its STATE messages (Sparkplug 3.0, 5.4 and 6.4). Pure.

use serde::Deserialize;

/// What a STATE message changed.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Turn {
    /// The host is online, and was not.
    Came,
    /// It is not any more.
    Left,
    /// Nothing.
    None,
}

/// The primary host.
#[derive(Clone, Debug)]
pub struct PrimaryHost {
    topic: String,
    online: bool,
    /// Of the newest message that counted in this session.
    newest: Option<u64>,
}

/// A STATE message.
#[derive(Debug, Deserialize)]
struct State {
    online: bool,
    /// Milliseconds since 1970 UTC.
    timestamp: u64,
}

impl PrimaryHost {
    /// A host of which nothing is known.
    #[must_use]
    pub fn new(id: &str) -> Self {
        Self { topic: format!("spBv1.0/STATE/{id}"), online: false, newest: None }
    }

    /// Where its STATE is.
    #[must_use]
    pub fn topic(&self) -> &str {
        &self.topic
    }

    /// A session began: its STATE is told anew.
    pub fn handle_session_up(&mut self) {
        self.online = false;
        self.newest = None;
    }

    /// A STATE message. One that is older than the newest, or is none, changes nothing
    /// (tck-id-message-flow-edge-node-birth-publish-phid-wait-timestamp).
    pub fn handle_state(&mut self, payload: &[u8]) -> Turn {
        let Ok(state) = serde_json::from_slice::<State>(payload) else { return Turn::None };
        if self.newest.is_some_and(|newest| state.timestamp < newest) {
            return Turn::None;
        }
        self.newest = Some(state.timestamp);
        match (std::mem::replace(&mut self.online, state.online), state.online) {
            (false, true) => Turn::Came,
            (true, false) => Turn::Left,
            (true, true) | (false, false) => Turn::None,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn state(online: bool, timestamp: u64) -> Vec<u8> {
        format!(r#"{{"online":{online},"timestamp":{timestamp}}}"#).into_bytes()
    }

    #[test]
    fn tck_id_operational_behavior_edge_node_termination_host_offline_timestamp_an_older_state_changes_nothing()
     {
        let mut host = PrimaryHost::new("scada");
        assert_eq!(host.topic(), "spBv1.0/STATE/scada");
        assert_eq!(host.handle_state(&state(false, 5)), Turn::None);
        assert_eq!(host.handle_state(&state(true, 10)), Turn::Came);
        assert_eq!(host.handle_state(&state(true, 11)), Turn::None);
        assert_eq!(host.handle_state(&state(false, 10)), Turn::None, "older than the newest");
        assert_eq!(
            host.handle_state(&state(false, 11)),
            Turn::Left,
            "its last will has the time of its birth"
        );
        assert_eq!(host.handle_state(&state(true, 12)), Turn::Came);
    }

    #[test]
    fn what_is_no_state_changes_nothing_and_a_session_begins_anew() {
        let mut host = PrimaryHost::new("scada");
        for odd in
            [&b""[..], b"ONLINE", b"{}", br#"{"online":true}"#, br#"{"online":1,"timestamp":1}"#, b"\xFF"]
        {
            assert_eq!(host.handle_state(odd), Turn::None);
        }
        assert_eq!(host.handle_state(&state(true, 10)), Turn::Came);
        host.handle_session_up();
        assert_eq!(host.handle_state(&state(true, 1)), Turn::Came);
    }
}
