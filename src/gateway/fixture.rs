//! A small tag table for tests of this room: one bus, two nodes of the same kind.

use std::time::Duration;

use crate::can::{BusIndex, CanId};
use crate::canopen::{
    ErrorControl, GuardingSettings, NodeId, NodeSettings, PdoSettings, Role, StartSettings,
};
use crate::mapping::{
    AlarmCondition, AlarmDef, AlarmOwner, BuiltIn, BusDef, Derived, DeviceDef, Expression, Field, FieldKind,
    NodeDef, OnLoss, PublishDef, Scale, Source, TagDef, TagTable,
};
use crate::process_image::{NodeIndex, Priority, TagIndex};

/// TPDO1, 2 bytes: `level` (byte 0, 0..255 = 0..100 %) and bit `trip` (byte 1 bit 0); byte 1 bit 7 is reserved.
/// TPDO2, 1 byte: `limit`. Derived: `trips`, `trip_latched`, `margin`, `trip_age`.
pub(super) const TAGS: [&str; 7] = ["level", "trip", "limit", "trips", "trip_latched", "margin", "trip_age"];

/// The table.
pub(super) fn table() -> TagTable {
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
    table.alarms.push(alarm("mqtt_down", AlarmOwner::Gateway, AlarmCondition::BuiltIn(BuiltIn::MqttDown)));
    for (name, built_in) in [
        ("bus_off", BuiltIn::BusOff),
        ("interface_down", BuiltIn::InterfaceDown),
        ("bus_silent", BuiltIn::BusSilent),
        ("frames_lost", BuiltIn::FramesLost),
        ("bus_load_high", BuiltIn::HighLoad),
    ] {
        let owner = AlarmOwner::Bus(BusIndex(0));
        table.alarms.push(alarm(name, owner, AlarmCondition::BuiltIn(built_in)));
    }
    for number in 0..2 {
        add_node(&mut table, NodeIndex(number));
    }
    table
}

fn add_node(table: &mut TagTable, node: NodeIndex) {
    let first = table.tags.len();
    let at = |offset: usize| TagIndex(first + offset);
    let percent = Scale { multiply: 100.0, divide: 255.0, add: 0.0 };
    let pdo = |pdo, bit, width, kind, scale| Source::Pdo {
        pdo,
        field: Field { bit, width, kind, big_endian: false, invert: false },
        scale,
    };
    let sources = [
        pdo(0, 0, 8, FieldKind::Unsigned, percent),
        pdo(0, 8, 1, FieldKind::Bool, Scale::IDENTITY),
        pdo(1, 0, 8, FieldKind::Unsigned, percent),
        Source::Derived(Derived::RisingEdges { of: at(1) }),
        Source::Derived(Derived::Latch { of: at(1) }),
        Source::Derived(Derived::Margin { among: vec![at(0)], valid: None, limit: at(2) }),
        Source::Derived(Derived::SecondsSinceRise { of: at(1) }),
    ];
    for (name, source) in TAGS.iter().zip(sources) {
        table.tags.push(tag(node, name, source));
    }
    let first_alarm = table.alarms.len();
    let owner = AlarmOwner::Node(node);
    for (name, built_in) in [
        ("node_lost", BuiltIn::NodeLost),
        ("node_never_seen", BuiltIn::NodeNeverSeen),
        ("pdo_timeout_1", BuiltIn::PdoTimeout(0)),
        ("pdo_timeout_2", BuiltIn::PdoTimeout(1)),
        ("node_restarted", BuiltIn::Restarted),
    ] {
        table.alarms.push(alarm(name, owner, AlarmCondition::BuiltIn(built_in)));
    }
    table.alarms.push(alarm("trip", owner, AlarmCondition::Tags(Expression::Tag(at(1)))));
    let id = NodeId::new(u8::try_from(node.0 + 1).unwrap()).unwrap();
    table.nodes.push(NodeDef {
        name: format!("engine{id}"),
        bus: BusIndex(0),
        canopen: settings(id),
        device: DeviceDef { mapping: "small".into(), ..DeviceDef::default() },
        unit_id: id.get(),
        offset: 0,
        on_loss: OnLoss::Invalid,
        zero_on_bad: false,
        tags: first..table.tags.len(),
        alarms: first_alarm..table.alarms.len(),
        reserved_bits: vec![0x8000, 0],
        publish: PublishDef {
            min_interval: Duration::from_millis(500),
            fast_interval: Duration::from_millis(100),
            fast_while: None,
            max_interval: Duration::from_secs(10),
        },
    });
}

fn settings(id: NodeId) -> NodeSettings {
    let pdo = |number: u16, base: u16, length| PdoSettings {
        number,
        cob_id: CanId::Standard(base + u16::from(id.get())),
        length,
        strict_length: false,
        timeout: Some(Duration::from_millis(1_500)),
        shortest_period: None,
    };
    NodeSettings {
        id,
        error_control: ErrorControl::Guarding(GuardingSettings::default()),
        start: StartSettings::default(),
        pdos: vec![pdo(1, 0x180, 2), pdo(2, 0x280, 1)],
        never_seen_after: Duration::from_secs(10),
    }
}

fn tag(node: NodeIndex, name: &str, source: Source) -> TagDef {
    TagDef {
        node,
        name: name.into(),
        description: String::new(),
        unit: String::new(),
        decimals: 2,
        source,
        valid: None,
        registers: Vec::new(),
        published: true,
        deadband: 0.0,
    }
}

fn alarm(name: &str, owner: AlarmOwner, condition: AlarmCondition) -> AlarmDef {
    AlarmDef {
        name: name.into(),
        owner,
        condition,
        priority: Priority::High,
        on_delay: Duration::ZERO,
        off_delay: Duration::ZERO,
        latch: false,
        suppressed_by: Vec::new(),
        first_out: false,
        bit: None,
        value: None,
        text: String::new(),
        action: String::new(),
    }
}
