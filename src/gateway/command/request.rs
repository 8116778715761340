//! Requests as JSON, pure: what a verb and its members ask for, and what is answered. The same by MQTT and HTTP.

use serde::Serialize;
use serde_json::{Map, Value as Json};

use super::{Action, NmtRequest, ObjectId, Outcome};
use crate::canopen::object::DataType;
use crate::mapping::{AlarmOwner, TagTable};
use crate::process_image::{AlarmIndex, NodeIndex, TagIndex, Value};

/// What can be asked for.
pub const VERBS: [&str; 7] =
    ["acknowledge", "acknowledge_all", "reset", "nmt", "write", "sdo_read", "sdo_write"];

/// Members that belong to the way that a request came, and not to what it asks for.
const OF_THE_WAY: [&str; 2] = ["transaction", "expires"];

/// Tags that one request may write.
const MOST_WRITES: usize = 64;

/// What is answered.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct Reply {
    /// `ok`, `unknown_tag`, `unknown_alarm`, `unknown_node`, `rejected`, `busy`, `node_unavailable`, `timeout`, `aborted` or `failed`.
    pub result: &'static str,
    /// Why not; empty for `ok`.
    pub message: String,
    /// The SDO abort code, of `aborted`.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub code: Option<String>,
    /// What was read: bytes as hexadecimal digits, the first on CAN first.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub data: Option<String>,
}

impl Reply {
    /// A request that was refused before it was one.
    #[must_use]
    pub fn rejected(why: impl Into<String>) -> Self {
        Self::of("rejected", why)
    }

    fn of(result: &'static str, message: impl Into<String>) -> Self {
        Self { result, message: message.into(), code: None, data: None }
    }

    /// The answer to a verb.
    #[must_use]
    pub fn new(verb: &str, outcome: Outcome) -> Self {
        match outcome {
            Outcome::Done => Self::of("ok", ""),
            Outcome::Read(bytes) => Self {
                data: Some(DataType::OctetString.decode(&bytes).unwrap_or_default().replace(' ', "")),
                ..Self::of("ok", "")
            },
            Outcome::Unknown => match verb {
                "write" => Self::of("unknown_tag", "there is no such tag"),
                "acknowledge" | "reset" => Self::of("unknown_alarm", "there is no such alarm"),
                _ => Self::of("unknown_node", "there is no such node"),
            },
            Outcome::Rejected(why) | Outcome::Forbidden(why) => Self::rejected(why),
            Outcome::Busy => Self::of("busy", "too much waits; try again"),
            Outcome::NodeUnavailable => Self::of("node_unavailable", "the node cannot take it now"),
            Outcome::Aborted(code) => {
                Self { code: Some(format!("0x{:08X}", code.0)), ..Self::of("aborted", code.to_string()) }
            }
            Outcome::Timeout => Self::of("timeout", "the node did not answer in time"),
            Outcome::Failed(why) => Self::of("failed", why),
        }
    }
}

/// Reads what a verb and its members ask for.
///
/// # Errors
/// The answer: there is no such verb, node, alarm or tag; a member is missing, unknown or of the wrong kind.
pub fn read(verb: &str, members: &Map<String, Json>, table: &TagTable) -> Result<Action, Reply> {
    let request = Members { verb, all: members, table };
    match verb {
        "acknowledge" => {
            request.only(&["alarm", "node", "bus", "count"])?;
            let raise = members
                .get("count")
                .map(|count| count.as_u64().ok_or_else(|| Reply::rejected("`count` must be a whole number")));
            Ok(Action::Acknowledge { alarm: request.alarm()?, raise: raise.transpose()? })
        }
        "acknowledge_all" => {
            request.only(&["node"])?;
            let node = members.contains_key("node").then(|| request.node());
            Ok(Action::AcknowledgeAll { node: node.transpose()? })
        }
        "reset" => {
            request.only(&["alarm", "node", "bus"])?;
            Ok(Action::Reset { alarm: request.alarm()? })
        }
        "nmt" => {
            request.only(&["node", "request"])?;
            Ok(Action::Nmt { node: request.node()?, request: nmt(request.text("request")?)? })
        }
        "write" => request.writes(),
        "sdo_read" => {
            request.only(&["node", "object"])?;
            let (node, object) = (request.node()?, request.object()?);
            Ok(Action::SdoRead { node, object, len: None, timeout: None })
        }
        "sdo_write" => {
            request.only(&["node", "object", "data"])?;
            let data = hexadecimal(request.text("data")?)
                .ok_or_else(|| Reply::rejected("`data` must be an even number of hexadecimal digits"))?;
            let (node, object) = (request.node()?, request.object()?);
            Ok(Action::SdoWrite { node, object, data, timeout: None })
        }
        _ => Err(Reply::rejected(format!("there is no such request; there are {}", VERBS.join(", ")))),
    }
}

struct Members<'a> {
    verb: &'a str,
    all: &'a Map<String, Json>,
    table: &'a TagTable,
}

impl<'a> Members<'a> {
    /// A member that nobody knows was meant for something: nothing is done then.
    fn only(&self, known: &[&str]) -> Result<(), Reply> {
        let strange =
            |name: &&String| !known.contains(&name.as_str()) && !OF_THE_WAY.contains(&name.as_str());
        match self.all.keys().find(strange) {
            Some(name) => {
                let shown: String = name.chars().take(40).collect();
                let known = known.join(", ");
                Err(Reply::rejected(format!("`{}` has no member `{shown}`; it has {known}", self.verb)))
            }
            None => Ok(()),
        }
    }

    fn text(&self, name: &str) -> Result<&'a str, Reply> {
        let text = self.all.get(name).and_then(Json::as_str);
        text.ok_or_else(|| Reply::rejected(format!("`{name}` must be there, and be text")))
    }

    fn node(&self) -> Result<NodeIndex, Reply> {
        let node = self.table.find_node(self.text("node")?);
        node.ok_or_else(|| Reply::new("nmt", Outcome::Unknown))
    }

    fn object(&self) -> Result<ObjectId, Reply> {
        self.text("object")?.parse().map_err(|error| Reply::rejected(format!("`object`: {error}")))
    }

    /// The alarm of this name, of a node, of a bus, or of the gateway where neither is named.
    fn alarm(&self) -> Result<AlarmIndex, Reply> {
        let name = self.text("alarm")?;
        let of = (self.all.contains_key("node"), self.all.contains_key("bus"));
        let owner = match of {
            (false, false) => AlarmOwner::Gateway,
            (true, false) => AlarmOwner::Node(self.node()?),
            (false, true) => {
                let bus = self.text("bus")?;
                let place = self.table.buses.iter().position(|def| def.name == bus);
                let place = place.ok_or_else(|| Reply::new("acknowledge", Outcome::Unknown))?;
                AlarmOwner::Bus(crate::can::BusIndex(place))
            }
            (true, true) => return Err(Reply::rejected("an alarm is of a node or of a bus, not of both")),
        };
        let place = self.table.alarms.iter().position(|alarm| alarm.owner == owner && alarm.name == name);
        place.map(AlarmIndex).ok_or_else(|| Reply::new("acknowledge", Outcome::Unknown))
    }

    /// `node`, `tag` and `value`, or `values` with each `node/tag`.
    fn writes(&self) -> Result<Action, Reply> {
        let unknown = || Reply::new("write", Outcome::Unknown);
        let Some(values) = self.all.get("values") else {
            self.only(&["node", "tag", "value"])?;
            let node = self.table.find_node(self.text("node")?).ok_or_else(unknown)?;
            let tag = self.table.find_tag(node, self.text("tag")?).ok_or_else(unknown)?;
            let value = self.all.get("value").and_then(value);
            let value = value
                .ok_or_else(|| Reply::rejected("`value` must be there, and be a number or true or false"))?;
            return Ok(Action::WriteTags { writes: vec![(tag, value)] });
        };
        self.only(&["values"])?;
        let values = values.as_object().ok_or_else(|| Reply::rejected("`values` must be an object"))?;
        if values.len() > MOST_WRITES {
            return Err(Reply::rejected(format!("at most {MOST_WRITES} tags are written at once")));
        }
        let write = |(name, json): (&String, &Json)| -> Result<(TagIndex, Value), Reply> {
            let (node, tag) = name.split_once('/').ok_or_else(unknown)?;
            let node = self.table.find_node(node).ok_or_else(unknown)?;
            let tag = self.table.find_tag(node, tag).ok_or_else(unknown)?;
            let value = value(json).ok_or_else(|| Reply::rejected("values are numbers, or true or false"))?;
            Ok((tag, value))
        };
        Ok(Action::WriteTags { writes: values.iter().map(write).collect::<Result<_, _>>()? })
    }
}

fn value(json: &Json) -> Option<Value> {
    match json {
        Json::Bool(bit) => Some(Value::Bool(*bit)),
        Json::Number(number) => number
            .as_u64()
            .map(Value::Unsigned)
            .or_else(|| number.as_i64().map(Value::Signed))
            .or_else(|| number.as_f64().map(Value::Float)),
        Json::Null | Json::String(_) | Json::Array(_) | Json::Object(_) => None,
    }
}

fn nmt(word: &str) -> Result<NmtRequest, Reply> {
    Ok(match word {
        "start" => NmtRequest::Start,
        "stop" => NmtRequest::Stop,
        "enter_pre_operational" => NmtRequest::EnterPreOperational,
        "reset_node" => NmtRequest::ResetNode,
        "reset_communication" => NmtRequest::ResetCommunication,
        _ => {
            return Err(Reply::rejected(
                "`request` is start, stop, enter_pre_operational, reset_node or reset_communication",
            ));
        }
    })
}

fn hexadecimal(text: &str) -> Option<Vec<u8>> {
    let digits: Vec<char> = text.chars().collect();
    let digit = |letter: char| letter.to_digit(16).and_then(|digit| u8::try_from(digit).ok());
    digits
        .chunks(2)
        .map(|pair| match *pair {
            [high, low] => Some(digit(high)? << 4 | digit(low)?),
            _ => None,
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;
    use crate::canopen::sdo::AbortCode;
    use crate::mapping::Sketch;

    fn table() -> TagTable {
        Sketch::new().node("engine1", 1, "motortech-detcon", |_| ()).build().unwrap().0
    }

    fn asked(verb: &str, json: &str) -> Result<Action, Reply> {
        let json: Json = serde_json::from_str(json).unwrap();
        read(verb, json.as_object().unwrap(), &table())
    }

    #[test]
    fn every_verb_is_read() {
        let (table, node) = (table(), NodeIndex(0));
        let tag = |name: &str| table.find_tag(node, name).unwrap();
        let alarm = |owner: AlarmOwner, name: &str| {
            let mut alarms = table.alarms.iter();
            AlarmIndex(alarms.position(|alarm| alarm.owner == owner && alarm.name == name).unwrap())
        };
        let trip = alarm(AlarmOwner::Node(node), "trip");
        let object = ObjectId::new(0x1017, 0);
        for (verb, json, action) in [
            (
                "acknowledge",
                r#"{"node":"engine1","alarm":"trip"}"#,
                Action::Acknowledge { alarm: trip, raise: None },
            ),
            (
                "acknowledge",
                r#"{"transaction":"a","node":"engine1","alarm":"trip","count":3}"#,
                Action::Acknowledge { alarm: trip, raise: Some(3) },
            ),
            (
                "acknowledge",
                r#"{"alarm":"mqtt_down"}"#,
                Action::Acknowledge { alarm: alarm(AlarmOwner::Gateway, "mqtt_down"), raise: None },
            ),
            (
                "reset",
                r#"{"bus":"can0","alarm":"bus_off"}"#,
                Action::Reset { alarm: alarm(AlarmOwner::Bus(crate::can::BusIndex(0)), "bus_off") },
            ),
            ("acknowledge_all", "{}", Action::AcknowledgeAll { node: None }),
            ("acknowledge_all", r#"{"node":"engine1"}"#, Action::AcknowledgeAll { node: Some(node) }),
            (
                "nmt",
                r#"{"node":"engine1","request":"stop"}"#,
                Action::Nmt { node, request: NmtRequest::Stop },
            ),
            (
                "write",
                r#"{"node":"engine1","tag":"trip","value":true}"#,
                Action::WriteTags { writes: vec![(tag("trip"), Value::Bool(true))] },
            ),
            (
                "write",
                r#"{"values":{"engine1/trip":-1,"engine1/knock_intensity_1":1.5},"expires":1}"#,
                Action::WriteTags {
                    writes: vec![
                        (tag("knock_intensity_1"), Value::Float(1.5)),
                        (tag("trip"), Value::Signed(-1)),
                    ],
                },
            ),
            (
                "sdo_read",
                r#"{"node":"engine1","object":"0x1017:0"}"#,
                Action::SdoRead { node, object, len: None, timeout: None },
            ),
            (
                "sdo_write",
                r#"{"node":"engine1","object":"0x1017:0","data":"e803"}"#,
                Action::SdoWrite { node, object, data: vec![0xE8, 3], timeout: None },
            ),
        ] {
            assert_eq!(asked(verb, json), Ok(action), "{verb} {json}");
        }
    }

    #[test]
    fn what_is_wrong_is_refused_whole_and_named() {
        for (verb, json, result, message) in [
            ("fly", "{}", "rejected", "no such request"),
            ("acknowledge", "{}", "rejected", "`alarm`"),
            ("acknowledge", r#"{"alarm":"trip"}"#, "unknown_alarm", ""),
            ("acknowledge", r#"{"alarm":"trip","node":"engine1","bus":"can0"}"#, "rejected", "not of both"),
            ("acknowledge", r#"{"alarm":"trip","node":"engine1","count":-1}"#, "rejected", "`count`"),
            ("acknowledge_all", r#"{"nod":"engine1"}"#, "rejected", "`nod`"),
            ("acknowledge_all", r#"{"node":"engine9"}"#, "unknown_node", ""),
            ("nmt", r#"{"node":"engine1","request":"explode"}"#, "rejected", "start, stop"),
            ("write", r#"{"node":"engine1","tag":"x","value":1}"#, "unknown_tag", ""),
            ("write", r#"{"node":"x","tag":"trip","value":1}"#, "unknown_tag", ""),
            ("write", r#"{"node":"engine1","tag":"trip","value":"1"}"#, "rejected", "`value`"),
            ("write", r#"{"values":{"engine1/trip":1},"tag":"trip"}"#, "rejected", "`tag`"),
            ("write", r#"{"values":{"engine1/trip":1,"engine1/x":1}}"#, "unknown_tag", ""),
            ("sdo_read", r#"{"node":"engine1","object":"1017"}"#, "rejected", "`object`"),
            ("sdo_write", r#"{"node":"engine1","object":"0x1017:0","data":"123"}"#, "rejected", "`data`"),
            ("sdo_write", r#"{"node":"engine1","object":"0x1017:0","data":"1µ"}"#, "rejected", "`data`"),
        ] {
            let reply = asked(verb, json).unwrap_err();
            assert_eq!(reply.result, result, "{verb} {json}");
            assert!(reply.message.contains(message), "{verb} {json}: {}", reply.message);
        }
    }

    #[test]
    fn the_outcomes_have_the_words_of_the_interface() {
        for (outcome, result) in [
            (Outcome::Done, "ok"),
            (Outcome::Unknown, "unknown_tag"),
            (Outcome::Rejected("why".into()), "rejected"),
            (Outcome::Forbidden("why".into()), "rejected"),
            (Outcome::Busy, "busy"),
            (Outcome::NodeUnavailable, "node_unavailable"),
            (Outcome::Timeout, "timeout"),
            (Outcome::Aborted(AbortCode(0x0609_0030)), "aborted"),
            (Outcome::Failed("why".into()), "failed"),
        ] {
            assert_eq!(Reply::new("write", outcome).result, result);
        }
        let json = |outcome| serde_json::to_value(Reply::new("sdo_read", outcome)).unwrap();
        assert_eq!(
            json(Outcome::Read(vec![0x94, 1])),
            serde_json::json!({"result": "ok", "message": "", "data": "9401"})
        );
        assert_eq!(json(Outcome::Aborted(AbortCode(0x0609_0030)))["code"], "0x06090030");
    }

    proptest! {
        #[test]
        fn whatever_comes_is_read_or_refused(verb in "[a-z_]{0,12}", text in ".{0,60}", number: f64) {
            let table = table();
            for verb in VERBS.into_iter().chain([verb.as_str()]) {
                for member in ["node", "alarm", "values", "value", "object", "data", "request", "count"] {
                    for json in [serde_json::json!({member: text}), serde_json::json!({member: number})] {
                        let _ = read(verb, json.as_object().unwrap(), &table);
                    }
                }
            }
        }
    }
}
