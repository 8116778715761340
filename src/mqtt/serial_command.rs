//! What is to be sent on a serial line, as a message of a command topic asks for it, pure; and the answer.
//!
//! A JSON object with `transaction` is a request, which is answered:
//! `{"transaction":"a1","data":"START\r\n","encoding":"text"}`. What looks like one and is no JSON is refused. Everything else goes
//! out as it is and is not answered.

use std::sync::Arc;

use serde_json::Value;

use crate::base64;
use crate::gateway::command::Outcome;

/// Bytes that may go out at once.
pub const MOST_BYTES: usize = 4_096;

/// What a message asks for.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct SerialCommand {
    /// Comes back with the answer; `None`: no answer is wanted.
    pub transaction: Option<String>,
    /// What is to go out.
    pub bytes: Vec<u8>,
}

/// A request that cannot be carried out.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Refused {
    /// Comes back with the answer; `None`: none was readable.
    pub transaction: Option<String>,
    /// Whether an answer is wanted.
    pub answer: bool,
    /// Why.
    pub why: String,
}

/// The answer to a request.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct SerialAnswer {
    /// The node of the line.
    pub node: Arc<str>,
    /// The number of the line at its node.
    pub number: u8,
    /// That of the request.
    pub transaction: Option<String>,
    /// `ok`, `rejected`, `busy`, `node_unavailable`, `timeout`, `failed` or `unknown_line`.
    pub result: &'static str,
    /// Why not; empty for `ok`.
    pub message: String,
}

impl SerialCommand {
    /// Reads a message.
    ///
    /// # Errors
    /// A request with a member that is missing, unknown or of the wrong kind, or that is no JSON; no bytes, or too many of them.
    pub fn read(payload: &[u8]) -> Result<Self, Refused> {
        let request = match serde_json::from_slice::<Value>(payload) {
            Ok(Value::Object(members)) if members.contains_key("transaction") => Some(members),
            Ok(_) => None,
            Err(error) => match damaged(payload, &error) {
                Some(refused) => return Err(refused),
                None => None,
            },
        };
        let answer = request.is_some();
        let command = match &request {
            Some(members) => Self::of_request(members)?,
            None => Self { transaction: None, bytes: payload.to_vec() },
        };
        let why = match command.bytes.len() {
            0 => "there is nothing to send".to_owned(),
            1..=MOST_BYTES => return Ok(command),
            bytes => format!("these are {bytes} bytes, but at most {MOST_BYTES} are sent at once"),
        };
        Err(Refused { transaction: command.transaction, answer, why })
    }

    fn of_request(members: &serde_json::Map<String, Value>) -> Result<Self, Refused> {
        let transaction = members.get("transaction").and_then(Value::as_str).map(str::to_owned);
        let refused =
            |why: &str| Refused { transaction: transaction.clone(), answer: true, why: why.to_owned() };
        let known = ["transaction", "data", "encoding"];
        if let Some(unknown) = members.keys().find(|name| !known.contains(&name.as_str())) {
            let shown: String = unknown.chars().take(40).collect();
            return Err(refused(&format!("there is no member `{shown}`; there are {}", known.join(", "))));
        }
        if transaction.is_none() {
            return Err(refused("`transaction` must be text"));
        }
        let data = members.get("data").and_then(Value::as_str);
        let data = data.ok_or_else(|| refused("`data` must be there, and be text"))?;
        let bytes = match members.get("encoding").map(Value::as_str) {
            None | Some(Some("text")) => data.as_bytes().to_vec(),
            Some(Some("base64")) => base64::decode(data).ok_or_else(|| refused("`data` is no base64"))?,
            Some(_) => return Err(refused("`encoding` must be \"text\" or \"base64\"")),
        };
        Ok(Self { transaction, bytes })
    }
}

/// What somebody meant as a request, though it is no JSON; with the transaction, as far as that can be read. `None`: it was
/// not meant as one.
fn damaged(payload: &[u8], error: &serde_json::Error) -> Option<Refused> {
    const NAME: &[u8] = br#""transaction""#;
    let text = payload.strip_prefix(b"\xEF\xBB\xBF").unwrap_or(payload);
    let object = text.trim_ascii_start().strip_prefix(b"{")?;
    let place = object.windows(NAME.len()).position(|part| part == NAME)?;
    let value = object.get(place + NAME.len()..)?.trim_ascii_start().strip_prefix(b":");
    let transaction = value.and_then(|value| {
        serde_json::Deserializer::from_slice(value).into_iter::<String>().next().and_then(Result::ok)
    });
    let why = format!("it looks like a request and is no JSON: {error}");
    Some(Refused { answer: transaction.is_some(), transaction, why })
}

/// What an outcome is called in an answer, and what is to be said of it.
#[must_use]
pub fn result(outcome: Outcome) -> (&'static str, String) {
    match outcome {
        Outcome::Done => ("ok", String::new()),
        Outcome::Rejected(why) | Outcome::Forbidden(why) => ("rejected", why),
        Outcome::Busy => ("busy", "too much waits for this line; try again".to_owned()),
        Outcome::NodeUnavailable => ("node_unavailable", "the module is not there".to_owned()),
        Outcome::Timeout => ("timeout", "not in time".to_owned()),
        Outcome::Unknown => ("unknown_line", "there is no such line".to_owned()),
        Outcome::Failed(why) => ("failed", why),
        Outcome::Read(_) | Outcome::Aborted(_) => ("failed", "another answer than expected".to_owned()),
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn sent(payload: &str) -> Vec<u8> {
        SerialCommand::read(payload.as_bytes()).unwrap().bytes
    }

    fn refused(payload: &str) -> Refused {
        SerialCommand::read(payload.as_bytes()).unwrap_err()
    }

    #[test]
    fn a_request_has_a_transaction_and_data_as_text_or_base64() {
        let read = SerialCommand::read(br#"{"transaction":"a1","data":"START\r\n"}"#).unwrap();
        assert_eq!(read, SerialCommand { transaction: Some("a1".into()), bytes: b"START\r\n".to_vec() });
        assert_eq!(sent(r#"{"transaction":"a","data":"µ","encoding":"text"}"#), "µ".as_bytes());
        assert_eq!(sent(r#"{"transaction":"a","data":"AP8=","encoding":"base64"}"#), [0, 255]);
    }

    #[test]
    fn what_is_no_request_goes_out_as_it_is() {
        for payload in ["START\r\n", "17", "{", r#"{"data":"x"}"#, "[1]", "null", r#""transaction""#] {
            let read = SerialCommand::read(payload.as_bytes()).unwrap();
            assert_eq!(read, SerialCommand { transaction: None, bytes: payload.as_bytes().to_vec() });
        }
        assert_eq!(SerialCommand::read(&[0xFF, 0]).unwrap().bytes, [0xFF, 0]);
    }

    #[test]
    fn a_wrong_request_is_refused_and_nothing_of_it_goes_out() {
        let why = |payload| {
            let refused = refused(payload);
            assert!(refused.answer);
            assert_eq!(refused.transaction.as_deref(), Some("a"));
            refused.why
        };
        assert!(why(r#"{"transaction":"a"}"#).contains("`data`"));
        assert!(why(r#"{"transaction":"a","data":7}"#).contains("`data`"));
        assert!(why(r#"{"transaction":"a","data":"x","encodng":"base64"}"#).contains("`encodng`"));
        assert!(why(r#"{"transaction":"a","data":"x","encoding":"hex"}"#).contains("`encoding`"));
        assert!(why(r#"{"transaction":"a","data":"x","encoding":7}"#).contains("`encoding`"));
        assert!(why(r#"{"transaction":"a","data":"?","encoding":"base64"}"#).contains("no base64"));
        assert!(why(r#"{"transaction":"a","data":""}"#).contains("nothing"));
        let unreadable = refused(r#"{"transaction":7,"data":"x"}"#);
        assert_eq!((unreadable.transaction, unreadable.answer), (None, true));
    }

    #[test]
    fn a_request_that_is_no_json_does_not_go_out_and_is_answered_where_its_transaction_can_be_read() {
        for payload in [
            r#"{"transaction":"a","data":"STO"#,
            r#"{"transaction" : "a", "data":"x",}"#,
            "\u{FEFF}{\"transaction\":\"a\",\"data\":\"x\"}",
            "\r\n {\"data\":\"\n\",\"transaction\":\"a\"}",
            r#"{"transaction":"a","data":"x"}{"transaction":"b","data":"y"}"#,
        ] {
            let refused = refused(payload);
            assert_eq!((refused.transaction.as_deref(), refused.answer), (Some("a"), true), "{payload}");
            assert!(refused.why.contains("no JSON"), "{}", refused.why);
        }
        for payload in [r#"{"transaction":"a"#, r#"{"transaction":7,"data"}"#, r#"{"transaction""#] {
            let refused = refused(payload);
            assert_eq!((refused.transaction, refused.answer), (None, false), "{payload}");
        }
        let latin = SerialCommand::read(b"{\"transaction\":\"a\",\"data\":\"\xB5\"}").unwrap_err();
        assert_eq!((latin.transaction.as_deref(), latin.answer), (Some("a"), true));
        assert_eq!(sent("transaction {"), b"transaction {");
        assert_eq!(sent("{transaction"), b"{transaction");
    }

    #[test]
    fn too_many_bytes_are_refused() {
        assert_eq!(sent(&"x".repeat(4096)).len(), 4096);
        let refused = refused(&"x".repeat(4097));
        assert!(!refused.answer && refused.why.contains("4097"));
        assert!(!super::SerialCommand::read(b"").unwrap_err().answer);
    }

    proptest! {
        #[test]
        fn no_payload_panics_and_what_is_taken_is_bounded(payload: Vec<u8>) {
            if let Ok(command) = SerialCommand::read(&payload) {
                prop_assert!((1..=MOST_BYTES).contains(&command.bytes.len()));
            }
        }
    }
}
