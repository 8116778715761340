//! Contents of the topics, version 1. Members may be added; none changes its meaning or leaves.

use super::buffer::BufferReport;
use super::json::{JsonWriter, is_representable};
use super::outbox::OutboxReport;
use crate::base64;
use crate::mapping::{AlarmDef, LineEncoding, Objection, Source, TagDef, TagTable};
use crate::process_image::{
    AlarmStatus, Event, NmtState, NodeIndex, NodeStatus, Priority, ProcessImage, Quality, Sample,
    SerialMessage, TagIndex, Value,
};
use crate::store::Class;
use crate::time::{Now, Timestamp};

/// What does not change while the program runs.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Identity {
    /// Stream id of states and messages of serial lines, and of events where there is no store: made new at every start;
    /// `sid` and `seq` together name a message of a topic for ever.
    pub sid: String,
    /// Version of the program.
    pub version: String,
    /// Version of the register map's layout.
    pub map_version: u32,
    /// Hash of the register map, in hexadecimal.
    pub map_hash: String,
    /// When the program started.
    pub started: Now,
}

/// Which message of its stream this is.
#[derive(Clone, Copy, Debug)]
pub struct Stamp<'a> {
    /// Stream id.
    pub sid: &'a str,
    /// Counts up by one with every message of its topic.
    pub seq: u64,
}

/// `bridge/state` while a session is up.
pub const ONLINE: &str = r#"{"state":"online"}"#;
/// `bridge/state` when the gateway stopped, or by last will.
pub const OFFLINE: &str = r#"{"state":"offline"}"#;

/// How every payload of version 1 begins.
const VERSION: &str = "{\"v\":1,";

/// Reason of a value that is no number.
pub const NOT_A_NUMBER: &str = "not_a_number";

/// `<node>/state`: all published tags of a node.
pub fn state(out: &mut String, table: &TagTable, image: &ProcessImage, node: NodeIndex, stamp: Stamp<'_>) {
    let Some(def) = table.node(node) else { return };
    let status = image.node(node);
    let published = || {
        let tags = table.tags.get(def.tags.clone()).unwrap_or_default();
        let places = def.tags.clone().map(TagIndex);
        places.zip(tags).filter(|(_, tag)| tag.published).map(|(index, tag)| (tag, image.tag(index)))
    };
    // What is sent to the device says nothing of how far its own values can be trusted; nor does what nobody asks it for.
    let received = published()
        .filter(|(tag, _)| !matches!(tag.source, Source::Rpdo { .. }) && def.is_asked_for(&tag.source));
    let quality = received.map(|(_, sample)| sample.quality).max().unwrap_or(Quality::Good);
    let mut json = JsonWriter::object(out);
    json.integer("v", 1);
    json.optional_integer("ts", status.and_then(|status| status.newest_data).map(Timestamp::as_millis));
    json.text("sid", stamp.sid);
    json.integer("seq", stamp.seq);
    json.text("quality", quality.word());
    json.optional_text("nmt", status.and_then(|status| status.nmt).map(NmtState::word));
    json.nested("tags", |tags| {
        for (tag, sample) in published() {
            tags.value(&tag.name, sample.shown(def.zero_on_bad), tag.decimals);
        }
    });
    json.nested("bad", |bad| {
        for (tag, sample) in published() {
            if let Some(reason) = reason(image, tag, sample) {
                bad.text(&tag.name, reason);
            }
        }
    });
    units(&mut json, table, image, node);
    json.finish();
}

/// `units`: those of published tags that are shown in the device's own; no member where a node has no such tag.
fn units(json: &mut JsonWriter<'_>, table: &TagTable, image: &ProcessImage, node: NodeIndex) {
    let own = || {
        let of_node = image.units.iter().filter_map(|(tag, unit)| Some((table.tag(*tag)?, unit)));
        of_node.filter(|(tag, _)| tag.node == node && tag.published)
    };
    if own().next().is_some() {
        json.nested("units", |units| own().for_each(|(tag, unit)| units.text(&tag.name, unit)));
    }
}

/// Why a value should not be used as it stands; `None` for a good one.
fn reason(image: &ProcessImage, tag: &TagDef, sample: &Sample) -> Option<&'static str> {
    let objection = tag.objection(image, sample).map(Objection::word);
    objection.or_else(|| (!is_representable(sample.value)).then_some(NOT_A_NUMBER))
}

/// `<node>/availability`.
pub fn availability(out: &mut String, status: &NodeStatus) {
    if status.online {
        out.clear();
        out.push_str(ONLINE);
        return;
    }
    let reason = if status.reason.is_empty() { "not seen yet" } else { &status.reason };
    let mut json = JsonWriter::object(out);
    json.text("state", "offline");
    json.text("reason", reason);
    json.finish();
}

/// `<node>/alarm/<alarm>` and `bridge/alarm/...`.
pub fn alarm(out: &mut String, table: &TagTable, def: &AlarmDef, status: &AlarmStatus) {
    let mut json = JsonWriter::object(out);
    json.integer("v", 1);
    json.text("state", status.state.word());
    json.bool("active", status.state.is_active());
    json.bool("acknowledged", !status.state.is_unacknowledged());
    json.text("priority", def.priority.word());
    json.optional_integer("ts", status.since.map(Timestamp::as_millis));
    json.integer("count", status.count);
    json.bool("first_out", status.first_out);
    json.value("value", status.value, table.decimals(def.value));
    json.text("text", &def.told(status.value));
    json.text("action", &def.action);
    json.finish();
}

/// `event`: one entry of the journal.
pub fn event(out: &mut String, table: &TagTable, event: &Event, sid: &str) {
    let alarm = event.alarm.and_then(|alarm| table.alarms.get(alarm.0));
    let mut json = JsonWriter::object(out);
    json.integer("v", 1);
    json.text("sid", sid);
    json.integer("seq", event.seq);
    json.integer("ts", event.ts.as_millis());
    json.text("kind", event.kind.word());
    json.optional_text("node", event.node.as_deref());
    json.optional_text("bus", event.bus.as_deref());
    json.text("name", &event.name);
    json.text("from", &event.from);
    json.text("to", &event.to);
    json.optional_text("priority", event.priority.map(Priority::word));
    json.value("value", event.value, table.decimals(alarm.and_then(|alarm| alarm.value)));
    json.text("text", &event.text);
    json.finish();
}

/// In place of events that left the journal before they could be read: the number of the last of them, and how many.
pub fn events_missed(out: &mut String, sid: &str, last: u64, missed: u64, at: Timestamp) {
    let text = "More events came at once than the journal holds; the oldest were lost.";
    lost_events(out, sid, (last, missed, at), text);
}

fn lost_events(out: &mut String, sid: &str, (last, missed, at): (u64, u64, Timestamp), text: &str) {
    let mut json = JsonWriter::object(out);
    json.integer("v", 1);
    json.text("sid", sid);
    json.integer("seq", last);
    json.integer("ts", at.as_millis());
    json.text("kind", "gateway");
    json.null("node");
    json.null("bus");
    json.text("name", "events_missed");
    json.text("from", "");
    json.text("to", "");
    json.null("priority");
    json.integer("value", missed);
    json.text("text", text);
    json.finish();
}

/// In place of events that the store lost, because there was no room or because they were damaged: the number of the last
/// of them, and how many.
pub fn events_lost(out: &mut String, sid: &str, last: u64, missing: u64, at: Timestamp) {
    let text =
        "Events were lost before they could be sent: there was no room for them, or the disk damaged them.";
    lost_events(out, sid, (last, missing, at), text);
}

/// An event without what [`with_stream`] puts before it. Both go together: stream and number of an event that is kept are
/// known when it comes out of the store.
#[must_use]
pub fn without_stream<'a>(event: &'a str, sid: &str, seq: u64) -> &'a str {
    let head = stream_head(sid, seq);
    event.strip_prefix(head.as_str()).unwrap_or(event)
}

/// An event with its stream and number.
#[must_use]
pub fn with_stream(sid: &str, seq: u64, rest: &str) -> String {
    stream_head(sid, seq) + rest
}

/// How every event begins.
fn stream_head(sid: &str, seq: u64) -> String {
    let mut head = String::new();
    let mut json = JsonWriter::object(&mut head);
    json.integer("v", 1);
    json.text("sid", sid);
    json.integer("seq", seq);
    head.push(',');
    head
}

/// `<node>/history`: a state of another time.
#[must_use]
pub fn historical(state: &str) -> String {
    let rest = state.strip_prefix(VERSION).unwrap_or_default();
    format!("{VERSION}\"historical\":true,{rest}")
}

/// `<node>/serial/<number>/rx`: a message that came in on a serial line, and how many before it left the image before they
/// could be read.
pub fn serial_message(
    out: &mut String,
    message: &SerialMessage,
    encoding: LineEncoding,
    sid: &str,
    missed: u64,
) {
    let text = match encoding {
        LineEncoding::Text => std::str::from_utf8(&message.bytes).ok().filter(|text| is_plain(text)),
        LineEncoding::Base64 => None,
    };
    let mut json = JsonWriter::object(out);
    json.integer("v", 1);
    json.integer("ts", message.at.as_millis());
    json.text("sid", sid);
    json.integer("seq", message.number);
    json.text("encoding", if text.is_some() { "text" } else { "base64" });
    match text {
        Some(text) => json.text("data", text),
        None => json.text("data", &base64::encode(&message.bytes)),
    }
    json.integer("bytes", number(message.bytes.len()));
    json.text("end", message.end);
    json.integer("missed", missed);
    json.finish();
}

/// Whether a text has no control characters but tabs: others are data, and many readers lose them.
fn is_plain(text: &str) -> bool {
    text.chars().all(|c| c == '\t' || !c.is_control())
}

/// `bridge/response/serial_send`: what became of a request. `transaction` is `None` where it was no text.
pub fn serial_response(
    out: &mut String,
    (node, channel): (&str, u8),
    transaction: Option<&str>,
    (result, message): (&str, &str),
) {
    let mut json = JsonWriter::object(out);
    json.optional_text("transaction", transaction);
    json.text("node", node);
    json.integer("channel", channel);
    json.text("result", result);
    json.text("message", message);
    json.finish();
}

/// `bridge/info`: what this gateway is and what belongs to it.
pub fn info(out: &mut String, table: &TagTable, identity: &Identity) {
    let mut json = JsonWriter::object(out);
    json.integer("v", 1);
    json.text("gateway", &table.gateway);
    json.text("software", "cangate");
    json.text("version", &identity.version);
    json.text("sid", &identity.sid);
    json.integer("started", identity.started.utc.as_millis());
    json.integer("map_version", identity.map_version);
    json.text("map_hash", &identity.map_hash);
    json.array("buses", |buses| {
        for bus in &table.buses {
            buses.element(|json| {
                json.text("name", &bus.name);
                json.integer("bit_rate", bus.bit_rate);
            });
        }
    });
    json.array("nodes", |nodes| {
        for node in &table.nodes {
            nodes.element(|json| {
                json.text("name", &node.name);
                json.optional_text("bus", table.buses.get(node.bus.0).map(|bus| bus.name.as_str()));
                json.integer("id", node.number());
                json.integer("unit_id", node.unit_id);
                json.text("mapping", &node.device.mapping);
                json.text("vendor", &node.device.vendor);
                json.text("model", &node.device.model);
            });
        }
    });
    json.finish();
}

/// `bridge/health`: counters, and how much the outbox can still take.
pub fn health(
    out: &mut String,
    table: &TagTable,
    image: &ProcessImage,
    identity: &Identity,
    now: Now,
    (outbox, buffer): (&OutboxReport, Option<&BufferReport>),
) {
    let uptime = now.instant.since(identity.started.instant);
    let count =
        |what: fn(&AlarmStatus) -> bool| number(image.alarms.iter().filter(|alarm| what(alarm)).count());
    let mut json = JsonWriter::object(out);
    json.integer("v", 1);
    json.integer("ts", now.utc.as_millis());
    json.integer("uptime_s", uptime.as_secs());
    json.bool("clock_synchronised", image.clock_synchronised);
    json.integer("nodes_configured", number(image.nodes.len()));
    json.integer("nodes_online", number(image.nodes.iter().filter(|node| node.online).count()));
    json.integer("alarms_active", count(|alarm| alarm.state.is_active()));
    json.integer("alarms_unacknowledged", count(|alarm| alarm.state.is_unacknowledged()));
    json.array("buses", |buses| {
        for (def, bus) in table.buses.iter().zip(&image.buses) {
            buses.element(|json| {
                json.text("name", &def.name);
                json.text("state", bus.state.word());
                let percent = bus.load_permille.map(|permille| Value::Float(f64::from(permille) / 10.0));
                json.value("load_percent", percent, 1);
                json.integer("frames_per_second", bus.frames_per_second);
                for (name, _, count) in bus.named() {
                    json.integer(name, count);
                }
            });
        }
    });
    json.nested("outbox", |json| outbox_members(json, outbox, uptime.as_secs()));
    if let Some(buffer) = buffer {
        json.nested("buffer", |json| buffer_members(json, buffer));
    }
    json.finish();
}

fn outbox_members(json: &mut JsonWriter<'_>, outbox: &OutboxReport, uptime_s: u64) {
    json.integer("messages", number(outbox.messages));
    json.integer("messages_limit", number(outbox.messages_limit));
    json.integer("bytes", number(outbox.bytes));
    json.integer("bytes_limit", number(outbox.bytes_limit));
    json.value("hours_left", outbox.hours_left(uptime_s).map(Value::Float), 1);
    json.integer("sent", outbox.sent);
    json.integer("sent_again", outbox.sent_again);
    json.integer("acknowledged", outbox.acknowledged);
    json.integer("superseded", outbox.superseded);
    json.integer("too_large", outbox.too_large);
    json.integer("events_missed", outbox.events_missed);
    // Only MQTT 5 lets a broker refuse a message.
    if outbox.refused > 0 {
        json.integer("refused", outbox.refused);
    }
    json.nested("dropped", |json| {
        for (class, dropped) in outbox.dropped() {
            json.integer(class, dropped);
        }
    });
}

fn buffer_members(json: &mut JsonWriter<'_>, buffer: &BufferReport) {
    let store = &buffer.store;
    json.text("state", store.state.word());
    json.text("reason", &store.reason);
    json.integer("bytes", store.bytes);
    json.integer("bytes_limit", store.bytes_limit);
    json.value("hours_left", buffer.hours_left.map(Value::Float), 1);
    for (name, counts) in [("waiting", store.records), ("dropped", store.dropped), ("damaged", store.damaged)]
    {
        json.nested(name, |json| {
            for (class, count) in Class::ALL.into_iter().zip(counts) {
                json.integer(class.word(), count);
            }
        });
    }
    json.integer("faults", store.faults);
    json.value("written_per_payload", store.written_per_payload().map(Value::Float), 2);
}

fn number(count: usize) -> u64 {
    u64::try_from(count).unwrap_or(u64::MAX)
}
