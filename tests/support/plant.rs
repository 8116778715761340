//! A made-up installation, small enough to read: two engines on one bus, and images of it.

use std::sync::Arc;
use std::time::Duration;

use cangate::can::{BusIndex, CanId};
use cangate::canopen::settings::{ErrorControl, GuardingSettings, PdoSettings, StartSettings};
use cangate::canopen::{NodeId, NodeSettings, Role};
use cangate::mapping::{
    AlarmCondition, AlarmDef, AlarmOwner, BuiltIn, BusDef, DeviceDef, Field, FieldKind, NodeDef, OnLoss,
    PublishDef, Scale, Source, TagDef, TagTable,
};
use cangate::process_image::{
    AlarmState, AlarmStatus, BusState, BusStatus, Event, EventKind, NmtState, NodeIndex, NodeStatus,
    PdoStatus, Priority, ProcessImage, Quality, Reason, Revision, Sample, TagIndex, Value,
};
use cangate::time::{Instant, Now, Timestamp};

/// Tags of each engine, in this order.
pub const TAGS: [&str; 4] = ["knock_intensity_1", "sensor_used_1", "trip", "engine_knocking"];
/// Alarms: the gateway's, the bus's, then these of each engine.
pub const ALARMS: [&str; 3] = ["node_lost", "pdo_timeout_1", "trip"];

/// The wall clock of the made-up images: a moment in November 2025.
pub const MORNING_MS: i64 = 1_763_760_000_123;

/// `millis` after [`MORNING_MS`] and after the start.
pub fn at(millis: u64) -> Now {
    Now {
        instant: Instant::from_millis(millis),
        utc: Timestamp::from_millis(MORNING_MS + i64::try_from(millis).unwrap()),
    }
}

/// Two engines, or as many as asked for.
pub fn table(engines: usize) -> Arc<TagTable> {
    let mut table = TagTable {
        gateway: "hall-1".into(),
        buses: vec![BusDef {
            name: "can0".into(),
            role: Role::Master,
            bit_rate: 125_000,
            start_broadcast: false,
        }],
        ..TagTable::default()
    };
    table.alarms.push(alarm("mqtt_down", AlarmOwner::Gateway, BuiltIn::MqttDown, Priority::Medium));
    table.alarms.push(alarm("bus_off", AlarmOwner::Bus(BusIndex(0)), BuiltIn::BusOff, Priority::High));
    for place in 0..engines {
        engine(&mut table, NodeIndex(place));
    }
    Arc::new(table)
}

fn engine(table: &mut TagTable, node: NodeIndex) {
    let (tags, alarms) = (table.tags.len(), table.alarms.len());
    for name in TAGS {
        table.tags.push(tag(node, name, tags));
    }
    let owner = AlarmOwner::Node(node);
    table.alarms.push(alarm(ALARMS[0], owner, BuiltIn::NodeLost, Priority::High));
    table.alarms.push(alarm(ALARMS[1], owner, BuiltIn::PdoTimeout(0), Priority::Medium));
    table.alarms.push(alarm(ALARMS[2], owner, BuiltIn::PdoTimeout(0), Priority::Critical));
    let id = u8::try_from(node.0 + 1).unwrap();
    table.nodes.push(NodeDef {
        name: format!("engine{id}"),
        bus: BusIndex(0),
        canopen: NodeSettings {
            id: NodeId::new(id).unwrap(),
            error_control: ErrorControl::Guarding(GuardingSettings::default()),
            start: StartSettings::default(),
            pdos: vec![PdoSettings {
                number: 1,
                cob_id: CanId::standard(0x180 + u16::from(id)).unwrap(),
                length: 8,
                strict_length: false,
                timeout: Some(Duration::from_millis(1500)),
                shortest_period: None,
            }],
            never_seen_after: Duration::from_secs(3),
        },
        device: DeviceDef {
            mapping: "motortech-detcon".into(),
            vendor: "MOTORTECH".into(),
            model: "DetCon20".into(),
            description: "Anti-knock controller".into(),
        },
        unit_id: id,
        offset: 0,
        on_loss: OnLoss::Invalid,
        zero_on_bad: false,
        tags: tags..table.tags.len(),
        alarms: alarms..table.alarms.len(),
        reserved_bits: vec![0],
        publish: PublishDef {
            min_interval: Duration::from_millis(500),
            fast_interval: Duration::from_millis(100),
            fast_while: Some(TagIndex(tags + 3)),
            max_interval: Duration::from_secs(10),
        },
    });
}

fn tag(node: NodeIndex, name: &str, first: usize) -> TagDef {
    let number = name == TAGS[0];
    TagDef {
        node,
        name: name.into(),
        description: format!("What `{name}` means."),
        unit: if number { "%".into() } else { String::new() },
        decimals: 2,
        source: Source::Pdo {
            pdo: 0,
            field: Field {
                bit: 0,
                width: if number { 8 } else { 1 },
                kind: if number { FieldKind::Unsigned } else { FieldKind::Bool },
                big_endian: false,
                invert: false,
            },
            scale: Scale::IDENTITY,
        },
        valid: number.then_some(TagIndex(first + 1)),
        registers: Vec::new(),
        published: true,
        deadband: if number { 0.5 } else { 0.0 },
    }
}

fn alarm(name: &str, owner: AlarmOwner, condition: BuiltIn, priority: Priority) -> AlarmDef {
    AlarmDef {
        name: name.into(),
        owner,
        condition: AlarmCondition::BuiltIn(condition),
        priority,
        on_delay: Duration::ZERO,
        off_delay: Duration::ZERO,
        latch: false,
        suppressed_by: Vec::new(),
        first_out: false,
        bit: None,
        value: (name == "trip").then_some(TagIndex(0)),
        text: format!("The text of {name}."),
        action: "Look at the \"engine\".".into(),
    }
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
            pdos: vec![PdoStatus { number: 1, last_received: Some(Instant::START), ..PdoStatus::default() }],
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
