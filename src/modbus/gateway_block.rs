//! The gateway's own registers: status, bitmaps of nodes, buses, test pattern.

use super::encoding::Cell;
use super::node_block::{NodeView, Row};
use crate::mapping::{Encoding, NodeDef, TagTable};
use crate::process_image::{AlarmState, BusState, BusStatus, NodeIndex, ProcessImage};
use crate::time::Now;

/// Registers of the fixed part.
pub const REGISTERS: u16 = 100;
/// Where the first bus stands.
pub const FIRST_BUS: u16 = 30;
/// Registers from one bus to the next.
pub const BUS_STRIDE: u16 = 10;
/// Buses that have a place.
pub const BUSES: u16 = 6;
/// Version of the layout that docs/modbus.md describes: register 20 and `version` of the map.
pub const MAP_VERSION: u16 = 1;

/// What a register of the gateway shows.
#[derive(Clone, Copy, Debug)]
pub enum GatewayRegister {
    /// +1 per second while the core runs.
    Heartbeat,
    /// Bits 0-5.
    StatusWord,
    /// Seconds since the start.
    Uptime,
    /// One word of the bitmap of online nodes.
    OnlineNodes(u8),
    /// One word of the bitmap of configured nodes.
    ConfiguredNodes(u8),
    /// Version of the layout.
    MapVersion,
    /// High 32 bits of the map's hash.
    MapHash,
    /// A number that never changes, for checking byte and word order.
    Pattern(Cell),
}

/// What a register of a bus shows.
#[derive(Clone, Copy, Debug)]
pub enum BusRegister {
    /// [`BusState::code`].
    State,
    /// Load in 0.1 %.
    Load,
    /// Frames per second.
    Frames,
    /// A counter, low 16 bits.
    Counter(fn(&BusStatus) -> u64),
}

const fn row<S>(
    address: u16,
    name: &'static str,
    unit: &'static str,
    show: S,
    description: &'static str,
) -> Row<S> {
    Row { address, encoding: Encoding::U16, name, scale: 1.0, unit, description, show }
}

const fn online(word: u8, name: &'static str) -> Row<GatewayRegister> {
    let text =
        "Bit n mod 16 of register 4 + n / 16: node id n is configured, and every node of that id is online";
    row(4 + widen(word), name, "", GatewayRegister::OnlineNodes(word), text)
}

const fn configured(word: u8, name: &'static str) -> Row<GatewayRegister> {
    let text = "Bit n mod 16 of register 12 + n / 16: node id n is configured";
    row(12 + widen(word), name, "", GatewayRegister::ConfiguredNodes(word), text)
}

/// `u16::from` is not for constants.
const fn widen(byte: u8) -> u16 {
    u16::from_be_bytes([0, byte])
}

const fn pattern(
    address: u16,
    encoding: Encoding,
    name: &'static str,
    cell: Cell,
    description: &'static str,
) -> Row<GatewayRegister> {
    Row { encoding, ..row(address, name, "", GatewayRegister::Pattern(cell), description) }
}

/// The fixed part, buses apart. What it leaves out is reserved and reads 0.
pub const GATEWAY_BLOCK: &[Row<GatewayRegister>] = &[
    row(
        0,
        "gateway.heartbeat",
        "",
        GatewayRegister::Heartbeat,
        "Counts up by one per second while the core of the gateway runs",
    ),
    row(
        1,
        "gateway.status",
        "",
        GatewayRegister::StatusWord,
        "Bit 0 all nodes healthy, 1 an alarm active, 2 an alarm unacknowledged, 3 MQTT connected, 4 clock \
         synchronised, 5 a bus is off",
    ),
    Row {
        encoding: Encoding::U32,
        ..row(2, "gateway.uptime", "s", GatewayRegister::Uptime, "Seconds since the gateway started")
    },
    online(0, "gateway.online_nodes_0_15"),
    online(1, "gateway.online_nodes_16_31"),
    online(2, "gateway.online_nodes_32_47"),
    online(3, "gateway.online_nodes_48_63"),
    online(4, "gateway.online_nodes_64_79"),
    online(5, "gateway.online_nodes_80_95"),
    online(6, "gateway.online_nodes_96_111"),
    online(7, "gateway.online_nodes_112_127"),
    configured(0, "gateway.configured_nodes_0_15"),
    configured(1, "gateway.configured_nodes_16_31"),
    configured(2, "gateway.configured_nodes_32_47"),
    configured(3, "gateway.configured_nodes_48_63"),
    configured(4, "gateway.configured_nodes_64_79"),
    configured(5, "gateway.configured_nodes_80_95"),
    configured(6, "gateway.configured_nodes_96_111"),
    configured(7, "gateway.configured_nodes_112_127"),
    row(20, "gateway.map_version", "", GatewayRegister::MapVersion, "Version of the layout of this map"),
    Row {
        encoding: Encoding::U32,
        ..row(
            21,
            "gateway.map_hash",
            "",
            GatewayRegister::MapHash,
            "The first 8 hexadecimal digits of the hash that `cangate map` prints: another hash, another map",
        )
    },
    pattern(90, Encoding::U16, "test.u16", Cell::Word(0x1234), "Always 0x1234 = 4660"),
    pattern(91, Encoding::U32, "test.u32", Cell::Double(0x1234_5678), "Always 0x12345678 = 305419896"),
    pattern(93, Encoding::F32, "test.f32", Cell::Double(1234.5_f32.to_bits()), "Always 1234.5"),
    pattern(95, Encoding::I16, "test.i16", Cell::Word((-2_i16).cast_unsigned()), "Always -2"),
    pattern(96, Encoding::I32, "test.i32", Cell::Double((-2_i32).cast_unsigned()), "Always -2"),
];

/// One bus, from its first register on.
pub const BUS_BLOCK: &[Row<BusRegister>] = &[
    row(0, "state", "", BusRegister::State, "0 absent, 1 down, 2 bus-off, 3 error passive, 4 error active"),
    Row {
        scale: 0.1,
        ..row(1, "load", "%", BusRegister::Load, "Load over the last second; 65535 = unknown")
    },
    row(2, "frames_per_second", "1/s", BusRegister::Frames, "Frames per second, received and sent"),
    row(3, "errors", "", BusRegister::Counter(|bus| bus.errors), "Error frames"),
    row(
        4,
        "bus_off_count",
        "",
        BusRegister::Counter(|bus| bus.bus_off_count),
        "Times that the controller went bus-off",
    ),
    row(5, "overruns", "", BusRegister::Counter(|bus| bus.overruns), "Frames that the kernel dropped"),
];

/// Where a bus stands, by its place in the configuration; `None` for those that have no place.
#[must_use]
pub fn bus_address(place: usize) -> Option<u16> {
    let place = u16::try_from(place).ok().filter(|place| *place < BUSES)?;
    Some(FIRST_BUS + place * BUS_STRIDE)
}

/// A register of a bus.
#[must_use]
pub fn bus_register(bus: &BusStatus, show: BusRegister) -> Cell {
    match show {
        BusRegister::State => Cell::Word(bus.state.code()),
        BusRegister::Load => Cell::Word(bus.load_permille.unwrap_or(u16::MAX)),
        BusRegister::Frames => Cell::saturated(bus.frames_per_second),
        BusRegister::Counter(counter) => Cell::low_word(counter(bus)),
    }
}

/// The gateway with all that its block is computed from.
#[derive(Clone, Copy, Debug)]
pub struct GatewayView<'a> {
    /// What there is.
    pub table: &'a TagTable,
    /// How it is.
    pub image: &'a ProcessImage,
    /// The moment.
    pub now: Now,
    /// Hash of the register map.
    pub map_hash: u64,
}

impl GatewayView<'_> {
    /// A register of the block; `heartbeat` is the gateway's counter.
    #[must_use]
    pub fn register(&self, show: GatewayRegister, heartbeat: u16) -> Cell {
        match show {
            GatewayRegister::Heartbeat => Cell::Word(heartbeat),
            GatewayRegister::StatusWord => Cell::Word(self.status_word()),
            GatewayRegister::Uptime => Cell::low_double(self.now.instant.as_millis() / 1_000),
            GatewayRegister::OnlineNodes(word) => {
                Cell::Word(self.bitmap(word, |index| self.is_online(index)))
            }
            GatewayRegister::ConfiguredNodes(word) => Cell::Word(self.bitmap(word, |_| true)),
            GatewayRegister::MapVersion => Cell::Word(MAP_VERSION),
            GatewayRegister::MapHash => Cell::low_double(self.map_hash >> 32),
            GatewayRegister::Pattern(cell) => cell,
        }
    }

    fn status_word(&self) -> u16 {
        let any_alarm =
            |such: fn(AlarmState) -> bool| self.image.alarms.iter().any(|alarm| such(alarm.state));
        let facts = [
            self.all_nodes_healthy(),
            any_alarm(AlarmState::is_active),
            any_alarm(AlarmState::is_unacknowledged),
            self.image.mqtt_connected,
            self.image.clock_synchronised,
            self.image.buses.iter().any(|bus| bus.state == BusState::BusOff),
        ];
        facts.into_iter().rev().fold(0, |word, fact| (word << 1) | u16::from(fact))
    }

    fn all_nodes_healthy(&self) -> bool {
        (0..self.table.nodes.len()).all(|index| {
            NodeView::new(self.table, self.image, NodeIndex(index), self.now)
                .is_some_and(|node| node.is_healthy())
                || self.image.node(NodeIndex(index)).is_some_and(|node| node.may_be_absent)
        })
    }

    fn is_online(&self, index: usize) -> bool {
        self.image.node(NodeIndex(index)).is_some_and(|node| node.online)
    }

    /// Word `word` of a bitmap by node id. Two buses may have a node of the same id: then the bit needs both.
    fn bitmap(&self, word: u8, such: impl Fn(usize) -> bool) -> u16 {
        let id = |node: &NodeDef| node.canopen().map_or(0, |settings| settings.id.get());
        // A module has no node id: its number is another kind of number.
        let in_word = |node: &NodeDef| node.canopen().is_some() && id(node) / 16 == word;
        let bits = |wanted: bool| {
            let nodes = self.table.nodes.iter().enumerate();
            nodes
                .filter(|(index, node)| in_word(node) && such(*index) == wanted)
                .fold(0_u16, |bits, (_, node)| bits | 1 << (id(node) % 16))
        };
        bits(true) & !bits(false)
    }
}
