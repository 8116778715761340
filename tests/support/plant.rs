//! A made-up installation, small enough to read: two engines on one bus, and images of it.

use std::sync::Arc;

use cangate::mapping::{AlarmDef, Sketch, SourceText, TagTable};
use cangate::process_image::{
    AlarmState, AlarmStatus, BusState, BusStatus, Event, EventKind, NmtState, NodeStatus, PdoStatus,
    ProcessImage, Quality, Reason, Revision, Sample, Value,
};
use cangate::time::{Instant, Now, Timestamp};

/// Alarms: `mqtt_down` of the gateway, `bus_off` of the bus, then these of each engine.
const ALARMS: [&str; 3] = ["node_lost", "pdo_timeout_1", "trip"];

/// The wall clock of the made-up images: a moment in November 2025.
pub const MORNING_MS: i64 = 1_763_760_000_123;

/// `millis` after [`MORNING_MS`] and after the start.
pub fn at(millis: u64) -> Now {
    Now {
        instant: Instant::from_millis(millis),
        utc: Timestamp::from_millis(MORNING_MS + i64::try_from(millis).unwrap()),
    }
}

const ENGINE: &str = r#"
format = 1

[device]
vendor = "MOTORTECH"
model = "DetCon20"
description = "Anti-knock controller"

[publish]
fast_while = "engine_knocking"

[tpdo.1]
cob_id = "$NODEID+0x180"
length = 8
timeout_ms = 1500

[[tag]]
name = "knock_intensity_1"
description = "What `knock_intensity_1` means."
tpdo = 1
bit = 0
type = "u8"
unit = "%"
decimals = 2
deadband = 0.5
valid = "sensor_used_1"

[[tag]]
name = "sensor_used_1"
description = "What `sensor_used_1` means."
tpdo = 1
bit = 8
type = "bool"

[[tag]]
name = "trip"
description = "What `trip` means."
tpdo = 1
bit = 9
type = "bool"

[[tag]]
name = "engine_knocking"
description = "What `engine_knocking` means."
tpdo = 1
bit = 10
type = "bool"

[[alarm]]
name = "trip"
when = "trip"
value = "knock_intensity_1"
priority = "critical"
text = ""
action = ""
"#;

/// Two engines, or as many as asked for.
///
/// Of the built-in alarms only a few are there, so that a test can name each by its place.
pub fn table(engines: u8) -> Arc<TagTable> {
    let mapping = SourceText::new("motortech-detcon", ENGINE);
    let sketch = (1..=engines).fold(Sketch::new().mapping(mapping), |sketch, id| {
        sketch.node(&format!("engine{id}"), id, "motortech-detcon", |_| ())
    });
    let mut table = sketch.build().unwrap().0;
    let kept =
        |alarm: &AlarmDef| ["mqtt_down", "bus_off"].into_iter().chain(ALARMS).any(|name| name == alarm.name);
    table.alarms.retain(kept);
    for (place, node) in table.nodes.iter_mut().enumerate() {
        let first = 2 + place * ALARMS.len();
        node.alarms = first..first + ALARMS.len();
    }
    for alarm in &mut table.alarms {
        // Their places are others now.
        alarm.suppressed_by.clear();
        alarm.text = format!("The text of {}.", alarm.name);
        alarm.action = "Look at the \"engine\".".into();
        alarm.bit = None;
    }
    Arc::new(table)
}

/// An image in which all engines run and are well, at 0 ms.
pub fn image(table: &TagTable) -> ProcessImage {
    let mut image =
        ProcessImage::new(table.tags.len(), table.nodes.len(), table.buses.len(), table.alarms.len());
    image.revision = Revision(1);
    image.clock_synchronised = true;
    image.buses[0] = BusStatus {
        state: BusState::ErrorActive,
        load_permille: Some(123),
        frames_per_second: 40,
        frames_received: 1000,
        frames_sent: 20,
        ..BusStatus::default()
    };
    for (place, def) in table.nodes.iter().enumerate() {
        image.nodes[place] = NodeStatus {
            online: true,
            nmt: Some(NmtState::Operational),
            supervised: true,
            newest_data: Some(at(0).utc),
            data_good: true,
            pdos: vec![PdoStatus {
                number: 1,
                last_received: Some(Instant::START),
                usable: true,
                ..PdoStatus::default()
            }],
            ..NodeStatus::default()
        };
        let values = [Value::Float(12.549_019_6), Value::Bool(true), Value::Bool(false), Value::Bool(false)];
        for (tag, value) in def.tags.clone().zip(values) {
            image.tags[tag] = good(value);
        }
    }
    image
}

/// A good sample of 0 ms.
pub fn good(value: Value) -> Sample {
    Sample {
        raw: value,
        value,
        quality: Quality::Good,
        received: at(0).utc,
        received_at: Some(Instant::START),
        revision: Revision(1),
    }
}

/// An engine is lost: offline, its values bad, its alarm raised.
pub fn lose(image: &mut ProcessImage, table: &TagTable, node: usize, at: Now) {
    image.revision = Revision(image.revision.0 + 1);
    image.nodes[node].online = false;
    image.nodes[node].nmt = None;
    image.nodes[node].reason = "no guarding reply for 1.5 s".into();
    image.nodes[node].data_good = false;
    image.nodes[node].pdos.iter_mut().for_each(|pdo| pdo.usable = false);
    for tag in table.nodes[node].tags.clone() {
        image.tags[tag].quality = Quality::Bad(Reason::NodeLost);
    }
    image.alarms[table.nodes[node].alarms.start] = AlarmStatus {
        state: AlarmState::Unacknowledged,
        since: Some(at.utc),
        count: 1,
        first_out: true,
        value: None,
        revision: image.revision,
    };
}

/// An event for the journal: the `seq`-th.
pub fn event(seq: u64) -> Event {
    Event {
        seq,
        ts: at(seq).utc,
        kind: EventKind::Node,
        node: Some("engine1".into()),
        bus: None,
        name: "state".into(),
        from: "pre_operational".into(),
        to: "operational".into(),
        alarm: None,
        priority: None,
        value: None,
        text: String::new(),
    }
}

/// Appends events up to `seq` to the journal.
pub fn happen(image: &mut ProcessImage, seq: u64) {
    image.revision = Revision(image.revision.0 + 1);
    for seq in image.journal.newest() + 1..=seq {
        image.journal.append(event(seq));
    }
}
