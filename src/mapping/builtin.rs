//! The alarms that every gateway, bus and node has, whatever the device.
//!
//! Their conditions are watched by the gateway itself; here is what each is like and what it tells the operator. Priorities
//! and delays follow the alarm catalogue of the manual; those of a node can be changed by its mapping and by the
//! installation.

use std::time::Duration;

use super::table::BuiltIn;
use crate::process_image::Priority;

/// What a built-in alarm is like.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct BuiltinAlarm {
    /// Its name; `{}` stands for the number of a TPDO.
    pub name: &'static str,
    /// What the gateway watches.
    pub condition: BuiltIn,
    /// How urgent.
    pub priority: Priority,
    /// In ms.
    pub on_delay_ms: u64,
    /// In ms.
    pub off_delay_ms: u64,
    /// Stays until acknowledged and reset.
    pub latch: bool,
    /// Names of the alarms that tell the cause, of the same owner or of the bus.
    pub suppressed_by: &'static [&'static str],
    /// Bit at discrete inputs 128 and 160, for those of a node.
    pub bit: Option<u8>,
    /// What it means.
    pub text: &'static str,
    /// What the operator should do.
    pub action: &'static str,
}

impl BuiltinAlarm {
    /// The on-delay.
    #[must_use]
    pub fn on_delay(&self) -> Duration {
        Duration::from_millis(self.on_delay_ms)
    }

    /// The off-delay.
    #[must_use]
    pub fn off_delay(&self) -> Duration {
        Duration::from_millis(self.off_delay_ms)
    }
}

const BUS_TROUBLE: &[&str] = &["bus_off", "interface_down", "bus_silent"];
const BUS_GONE: &[&str] = &["bus_off", "interface_down"];
/// What tells the cause of most that happens to a node.
pub(super) const BUS_TROUBLE_OR_LOST: &[&str] = &["bus_off", "interface_down", "bus_silent", "node_lost"];
/// A device that is not the right one is given no heartbeat.
const BUS_TROUBLE_OR_OTHER: &[&str] = &["bus_off", "interface_down", "bus_silent", "identity_mismatch"];
const NO_START: &[&str] = &["bus_off", "interface_down", "bus_silent", "node_lost", "identity_mismatch"];

/// Those of the gateway.
pub const OF_GATEWAY: &[BuiltinAlarm] = &[
    MQTT_DOWN,
    ACCESS_REFUSED,
    CONFIGURATION_REJECTED,
    CERTIFICATE_EXPIRES,
    CERTIFICATE_EXPIRES_SOON,
    CERTIFICATE_EXPIRED,
    BUFFER_FILLING,
    BUFFER_FAULT,
];

const MQTT_DOWN: BuiltinAlarm = BuiltinAlarm {
    name: "mqtt_down",
    condition: BuiltIn::MqttDown,
    priority: Priority::Medium,
    on_delay_ms: 60_000,
    off_delay_ms: 5_000,
    latch: false,
    suppressed_by: &[],
    bit: None,
    text: "There is no session with the MQTT broker.",
    action: "Check the broker, the network between and the settings under [mqtt]; Modbus is not concerned.",
};

const CONFIGURATION_REJECTED: BuiltinAlarm = BuiltinAlarm {
    name: "configuration_rejected",
    condition: BuiltIn::ConfigurationRejected,
    priority: Priority::Medium,
    on_delay_ms: 0,
    off_delay_ms: 0,
    latch: false,
    suppressed_by: &[],
    bit: None,
    text: "A changed configuration was refused; the gateway goes on with the one before.",
    action: "Mend the file as the log and the event say, try it with `cangate check`, and load it again.",
};

const CERTIFICATE_EXPIRES: BuiltinAlarm = BuiltinAlarm {
    name: "certificate_expires",
    condition: BuiltIn::CertificateExpires,
    priority: Priority::Low,
    on_delay_ms: 0,
    off_delay_ms: 0,
    latch: false,
    suppressed_by: &[],
    bit: None,
    text: "A certificate of TLS expires within a month.",
    action: "See in /api/v1/status (`certificates`) which file it is in, and put a new one there; no restart is needed.",
};

const CERTIFICATE_EXPIRES_SOON: BuiltinAlarm = BuiltinAlarm {
    name: "certificate_expires_soon",
    condition: BuiltIn::CertificateExpiresSoon,
    priority: Priority::High,
    on_delay_ms: 0,
    off_delay_ms: 0,
    latch: false,
    suppressed_by: &[],
    bit: None,
    text: "A certificate of TLS expires within a week.",
    action: "See in /api/v1/status (`certificates`) which file it is in, and put a new one there; no restart is needed.",
};

const CERTIFICATE_EXPIRED: BuiltinAlarm = BuiltinAlarm {
    name: "certificate_expired",
    condition: BuiltIn::CertificateExpired,
    priority: Priority::Critical,
    on_delay_ms: 0,
    off_delay_ms: 0,
    latch: false,
    suppressed_by: &[],
    bit: None,
    text: "A certificate of TLS has expired: others no longer accept connections with it.",
    action: "See in /api/v1/status (`certificates`) which file it is in, and put a new one there; no restart is needed.",
};

const ACCESS_REFUSED: BuiltinAlarm = BuiltinAlarm {
    name: "access_refused",
    condition: BuiltIn::AccessRefused,
    priority: Priority::Medium,
    on_delay_ms: 0,
    off_delay_ms: 300_000,
    latch: false,
    suppressed_by: &[],
    bit: None,
    text: "Somebody asks again and again for what is not allowed: five requests or more were refused within a minute.",
    action: "The events of kind \"command\" with \"forbidden\" tell who. Find out whether it is a mistake of a client or of an [access] table, or somebody who should not be there.",
};

const BUFFER_FILLING: BuiltinAlarm = BuiltinAlarm {
    name: "buffer_filling",
    condition: BuiltIn::BufferFilling,
    priority: Priority::Medium,
    on_delay_ms: 0,
    off_delay_ms: 10_000,
    latch: false,
    suppressed_by: &[],
    bit: None,
    text: "What is kept for the MQTT broker fills 80 % of its room; when it is full the oldest leaves.",
    action: "Bring the broker back, or give the buffer more room (buffer_bytes); bridge/health tells how many hours are left.",
};

const BUFFER_FAULT: BuiltinAlarm = BuiltinAlarm {
    name: "buffer_fault",
    condition: BuiltIn::BufferFault,
    priority: Priority::High,
    on_delay_ms: 0,
    off_delay_ms: 60_000,
    latch: false,
    suppressed_by: &[],
    bit: None,
    text: "The disk on which messages for the MQTT broker are kept cannot be used; memory holds them meanwhile.",
    action: "See in the log what failed, then check room, permissions and health of the disk of buffer_dir.",
};

/// Those of each bus, a cause before what it suppresses.
pub const OF_BUS: &[BuiltinAlarm] = &[
    BuiltinAlarm {
        name: "bus_off",
        condition: BuiltIn::BusOff,
        priority: Priority::Critical,
        on_delay_ms: 0,
        off_delay_ms: 0,
        latch: false,
        suppressed_by: &[],
        bit: None,
        text: "The CAN controller has left the bus after too many transmit errors.",
        action: "Check wiring, termination and shield; a wrong bit rate does the same.",
    },
    BuiltinAlarm {
        name: "interface_down",
        condition: BuiltIn::InterfaceDown,
        priority: Priority::High,
        on_delay_ms: 0,
        off_delay_ms: 0,
        latch: false,
        suppressed_by: &[],
        bit: None,
        text: "The CAN interface is missing or switched off.",
        action: "Check that the adapter is plugged in and that the host brings the interface up.",
    },
    BuiltinAlarm {
        name: "bus_silent",
        condition: BuiltIn::BusSilent,
        priority: Priority::High,
        on_delay_ms: 0,
        off_delay_ms: 0,
        latch: false,
        suppressed_by: BUS_GONE,
        bit: None,
        text: "Nobody sends anything on the bus although nodes are expected there.",
        action: "Check the cable, the termination and the supply of the devices; a wrong bit rate silences a bus too.",
    },
    BuiltinAlarm {
        name: "error_passive",
        condition: BuiltIn::ErrorPassive,
        priority: Priority::Medium,
        on_delay_ms: 1_000,
        off_delay_ms: 5_000,
        latch: false,
        suppressed_by: BUS_GONE,
        bit: None,
        text: "The CAN controller counts many errors, or nobody acknowledges its frames.",
        action: "Check that at least one other device is switched on, then bit rate, wiring and termination.",
    },
    BuiltinAlarm {
        name: "frames_lost",
        condition: BuiltIn::FramesLost,
        priority: Priority::High,
        on_delay_ms: 0,
        off_delay_ms: 60_000,
        latch: false,
        suppressed_by: &[],
        bit: None,
        text: "The host dropped received frames because it was too busy.",
        action: "Find out what loads the host; short pulses may have been missed.",
    },
    BuiltinAlarm {
        name: "bus_load_high",
        condition: BuiltIn::HighLoad,
        priority: Priority::Low,
        on_delay_ms: 10_000,
        off_delay_ms: 30_000,
        latch: false,
        suppressed_by: &[],
        bit: None,
        text: "The bus is loaded above 80 %.",
        action: "Look for a device that sends too often, or plan a higher bit rate.",
    },
    BuiltinAlarm {
        name: "foreign_master",
        condition: BuiltIn::ForeignMaster,
        priority: Priority::Medium,
        on_delay_ms: 0,
        off_delay_ms: 60_000,
        latch: true,
        suppressed_by: &[],
        bit: None,
        text: "Somebody else acts as a master on this bus.",
        action: "See in the events what was seen, find the other master or tool, and let only one of the two be master.",
    },
    BuiltinAlarm {
        name: "foreign_producer",
        condition: BuiltIn::ForeignProducer,
        priority: Priority::Medium,
        on_delay_ms: 0,
        off_delay_ms: 60_000,
        latch: false,
        suppressed_by: &[],
        bit: None,
        text: "Somebody else sends SYNC or TIME, which this gateway sends too.",
        action: "Find the other producer; let one of the two send it ([bus.NAME.sync], [bus.NAME.time]).",
    },
];

/// Those of each node, a cause before what it suppresses. `pdo_timeout_{}` is there once for each TPDO. A CANopen device has all
/// but the last; an esd module those that [`is_of_module`] tells.
pub const OF_NODE: &[BuiltinAlarm] = &[
    BuiltinAlarm {
        name: "identity_mismatch",
        condition: BuiltIn::IdentityMismatch,
        priority: Priority::High,
        on_delay_ms: 0,
        off_delay_ms: 0,
        latch: false,
        suppressed_by: BUS_TROUBLE,
        bit: Some(10),
        text: "Another device answers than the one that its mapping is for; it is not started.",
        action: "Check which device has this node id, and which mapping the configuration names for it.",
    },
    BuiltinAlarm {
        name: "node_lost",
        condition: BuiltIn::NodeLost,
        priority: Priority::High,
        on_delay_ms: 0,
        off_delay_ms: 0,
        latch: false,
        suppressed_by: BUS_TROUBLE_OR_OTHER,
        bit: Some(0),
        text: "The device no longer answers; its values are not valid.",
        action: "Check its supply and its CAN cable.",
    },
    BuiltinAlarm {
        name: "node_never_seen",
        condition: BuiltIn::NodeNeverSeen,
        priority: Priority::High,
        on_delay_ms: 0,
        off_delay_ms: 0,
        latch: false,
        suppressed_by: BUS_TROUBLE,
        bit: Some(1),
        text: "The device has not shown a single frame since the gateway started.",
        action: "Check that it is switched on, that it is set to CANopen, and its node id and bit rate.",
    },
    BuiltinAlarm {
        name: "node_start_failed",
        condition: BuiltIn::NotOperational,
        priority: Priority::Medium,
        on_delay_ms: 0,
        off_delay_ms: 0,
        latch: false,
        suppressed_by: NO_START,
        bit: Some(2),
        text: "The device does not become operational although it was told to start several times.",
        action: "Look whether another master stops it; else restart the device.",
    },
    BuiltinAlarm {
        name: "pdo_timeout_{}",
        condition: BuiltIn::PdoTimeout(0),
        priority: Priority::Medium,
        on_delay_ms: 0,
        off_delay_ms: 0,
        latch: false,
        suppressed_by: BUS_TROUBLE_OR_LOST,
        bit: Some(3),
        text: "TPDO {} no longer comes; the values that it carries are stale.",
        action: "Check the PDO settings of the device and the load of the bus.",
    },
    BuiltinAlarm {
        name: "node_restarted",
        condition: BuiltIn::Restarted,
        priority: Priority::Medium,
        on_delay_ms: 0,
        off_delay_ms: 0,
        latch: true,
        suppressed_by: &[],
        bit: Some(4),
        text: "The device restarted although nobody ordered it.",
        action: "Look for dips of its supply; acknowledge and reset when clarified.",
    },
    BuiltinAlarm {
        name: "pdo_length",
        condition: BuiltIn::PdoLength,
        priority: Priority::Medium,
        on_delay_ms: 0,
        off_delay_ms: 60_000,
        latch: false,
        suppressed_by: &[],
        bit: Some(5),
        text: "The device sends process data of another length than its mapping says.",
        action: "Check that the mapping belongs to this device and its firmware.",
    },
    BuiltinAlarm {
        name: "duplicate_node",
        condition: BuiltIn::DuplicateNode,
        priority: Priority::High,
        on_delay_ms: 0,
        off_delay_ms: 0,
        latch: true,
        suppressed_by: &[],
        bit: Some(7),
        text: "Two devices seem to use this node id.",
        action: "Disconnect one device after the other to find both, then give each its own node id.",
    },
    BuiltinAlarm {
        name: "foreign_guard_master",
        condition: BuiltIn::ForeignGuardMaster,
        priority: Priority::Low,
        on_delay_ms: 0,
        off_delay_ms: 0,
        latch: false,
        suppressed_by: &[],
        bit: Some(8),
        text: "Somebody else guards this device, so both see wrong toggle bits.",
        action: "Let only one master guard it, or make this gateway passive on the bus.",
    },
    BuiltinAlarm {
        name: "guard_toggle",
        condition: BuiltIn::GuardToggle,
        priority: Priority::Low,
        on_delay_ms: 0,
        off_delay_ms: 60_000,
        latch: false,
        suppressed_by: &["node_lost", "foreign_guard_master"],
        bit: Some(6),
        text: "Answers to node guarding repeat their toggle bit.",
        action: "Look for a second master that guards this device.",
    },
    BuiltinAlarm {
        name: "emergency",
        condition: BuiltIn::Emergency,
        priority: Priority::Low,
        on_delay_ms: 0,
        off_delay_ms: 0,
        latch: false,
        suppressed_by: BUS_TROUBLE_OR_LOST,
        bit: Some(9),
        text: "The device reports an error that its mapping does not name.",
        action: "Look up the error code in the manual of the device.",
    },
    BuiltinAlarm {
        name: "module_not_configured",
        condition: BuiltIn::NotConfigured,
        priority: Priority::Medium,
        on_delay_ms: 0,
        off_delay_ms: 0,
        latch: false,
        suppressed_by: NO_START,
        bit: Some(11),
        text: "The module is not set up as the configuration wants it, and could not be made so.",
        action: "See in the events what differs; change the configuration, or let it configure the module.",
    },
];

/// Whether a condition is watched of an esd module: those that are about CANopen are not.
#[must_use]
pub fn is_of_module(condition: BuiltIn) -> bool {
    matches!(
        condition,
        BuiltIn::IdentityMismatch
            | BuiltIn::NodeLost
            | BuiltIn::NodeNeverSeen
            | BuiltIn::Restarted
            | BuiltIn::NotConfigured
    )
}
