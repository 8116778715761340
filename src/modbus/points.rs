//! The register map as a list for people and tools: one point for each tag's place, each register of the fixed blocks,
//! each alarm bit; and the hash of that list.

use serde::{Deserialize, Serialize};

use super::WordOrder;
use super::command_block;
use super::event_ring;
use super::gateway_block::{self, BUS_BLOCK, GATEWAY_BLOCK};
use super::line_text;
use super::node_block::{self, NODE_BLOCK, Row};
use super::register_map::alarm_groups;
use super::source::{cob_id, source_text};
use super::writing::{ACKNOWLEDGE_ALL, Writable};
use crate::mapping::{DEVICE_UNIT, Encoding, LineDef, NodeDef, RegisterDef, Space, TagDef, TagTable};
use crate::process_image::{AlarmIndex, TagIndex};

/// The map of an installation as `map --format json` prints it.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct MapDocument {
    /// Version of the layout.
    pub version: u16,
    /// 16 hexadecimal digits.
    pub hash: String,
    /// All that is published.
    pub points: Vec<Point>,
}

/// One published place.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Point {
    /// Name of the node; empty for the gateway's own.
    pub node: String,
    /// Name of the tag; one with a dot is a register of a fixed block and no tag of the device.
    pub tag: String,
    /// Modbus unit id.
    pub unit_id: u8,
    /// `input_register`, `holding_register`, `discrete_input` or `coil`.
    pub table: Table,
    /// 0-based, as on the wire, offset added.
    pub address: u32,
    /// Registers, or bits.
    pub count: u16,
    /// How the value is written; `event` is a record of the event ring, `text` bytes, two in each register.
    #[serde(rename = "type")]
    pub kind: String,
    /// Engineering units per count.
    pub scale: f64,
    /// Engineering unit; empty for none.
    pub engineering_unit: String,
    /// Six digits: the table's digit and the 1-based number.
    pub reference: String,
    /// Whether a client may write it.
    pub writable: bool,
    /// MQTT topic that carries the same; empty for none.
    pub topic: String,
    /// Where the value comes from.
    pub source: String,
    /// One sentence.
    pub description: String,
    /// Identifier of the PDO that carries it, `0x306`; empty for none (R-ESD-124). It is no promise, and not part of the JSON.
    #[serde(skip)]
    pub cob_id: String,
}

/// A Modbus table. What can be read as an input register can be read as a holding register at the same address, and
/// likewise discrete inputs as coils; a point is listed once, under the table that is meant for it.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Table {
    /// FC 4, and FC 3.
    InputRegister,
    /// FC 3, 6, 16.
    HoldingRegister,
    /// FC 2, and FC 1.
    DiscreteInput,
    /// FC 1, 5, 15.
    Coil,
}

impl Table {
    /// The word in the map.
    #[must_use]
    pub fn word(self) -> &'static str {
        match self {
            Self::InputRegister => "input_register",
            Self::HoldingRegister => "holding_register",
            Self::DiscreteInput => "discrete_input",
            Self::Coil => "coil",
        }
    }

    /// The first digit of a reference.
    #[must_use]
    pub fn digit(self) -> char {
        match self {
            Self::InputRegister => '3',
            Self::HoldingRegister => '4',
            Self::DiscreteInput => '1',
            Self::Coil => '0',
        }
    }

    /// The table that shows the same at the same address.
    #[must_use]
    pub fn twin(self) -> Self {
        match self {
            Self::InputRegister | Self::HoldingRegister => Self::HoldingRegister,
            Self::DiscreteInput | Self::Coil => Self::Coil,
        }
    }

    /// An address as six digits.
    #[must_use]
    pub fn reference(self, address: u32) -> String {
        format!("{}{:05}", self.digit(), address + 1)
    }
}

impl From<Space> for Table {
    fn from(space: Space) -> Self {
        match space {
            Space::Register => Self::InputRegister,
            Space::Bit => Self::DiscreteInput,
        }
    }
}

/// All points: node by node, then the gateway; registers before bits, by address.
#[must_use]
pub fn points(table: &TagTable, gateway_unit_id: u8, base_topic: &str) -> Vec<Point> {
    let prefix = format!("{base_topic}/{}", table.gateway);
    let mut points = Vec::new();
    for node in &table.nodes {
        let mut of_node = node_points(table, node, &format!("{prefix}/{}", node.name));
        of_node.sort_by_key(|point| (point.table, point.address));
        points.append(&mut of_node);
    }
    points.extend(gateway_points(table, gateway_unit_id));
    points
}

/// Marks what can be written, and adds what only can be written: the command block and the coils.
pub fn add_writes(points: &mut Vec<Point>, table: &TagTable, writable: &Writable, gateway_unit_id: u8) {
    for def in writable.tags.iter().filter_map(|tag| table.tag(*tag)) {
        let node = table.node(def.node).map_or("", |node| node.name.as_str());
        let raw = [Encoding::Raw16, Encoding::Raw32].map(Encoding::word);
        let of_tag =
            |point: &&mut Point| point.node == node && point.tag == def.name && !raw.contains(&&*point.kind);
        for point in points.iter_mut().filter(of_tag) {
            point.writable = true;
            point.table = point.table.twin();
            point.reference = point.table.reference(point.address);
        }
    }
    if !writable.commands {
        return;
    }
    let gateway = Point { unit_id: gateway_unit_id, source: "gateway".into(), ..Point::blank() };
    for (place, name, writable, text) in command_block::ROWS {
        let address = u32::from(command_block::ADDRESS + place);
        points.push(Point {
            tag: name.into(),
            writable,
            description: text.into(),
            ..gateway.at(Table::HoldingRegister, address, Encoding::U16)
        });
    }
    let coil = |blank: Point, text: &str| Point {
        tag: "alarm.acknowledge_all".into(),
        writable: true,
        description: text.into(),
        ..blank.at(Table::Coil, ACKNOWLEDGE_ALL.into(), Encoding::Bool)
    };
    points.push(coil(gateway.clone(), "1 acknowledges all alarms; write only"));
    for node in &table.nodes {
        if table.nodes.iter().filter(|other| other.unit_id == node.unit_id).count() == 1 {
            let blank = Point { node: node.name.clone(), unit_id: node.unit_id, ..gateway.clone() };
            points.push(coil(blank, "1 acknowledges all alarms of the node; write only"));
        }
    }
}

fn node_points(table: &TagTable, node: &NodeDef, topic: &str) -> Vec<Point> {
    let blank = Point { node: node.name.clone(), unit_id: node.unit_id, ..Point::blank() };
    let offset = u32::from(node.offset);
    let mut points: Vec<Point> = NODE_BLOCK.iter().map(|row| blank.row(row, offset, row.name)).collect();
    for tag in node.tags.clone().map(TagIndex) {
        let Some(def) = table.tag(tag) else { continue };
        for register in &def.registers {
            points.push(tag_point(&blank, table, node, def, register, topic));
        }
    }
    let is_of_node = |line: &&LineDef| table.node(line.node).is_some_and(|owner| owner.name == node.name);
    let lines = table.lines.iter().filter(is_of_node);
    points.extend(lines.flat_map(|line| line_text::points(&blank, node, line, topic)));
    for (bit, alarms) in alarm_groups(table, node) {
        let Some((name, text, topic)) = alarm_names(table, &alarms, topic) else { continue };
        let bits = [
            (node_block::ACTIVE_BITS, "active", "Active"),
            (node_block::UNACKNOWLEDGED_BITS, "unacknowledged", "Unacknowledged"),
        ];
        for (first, state, word) in bits {
            points.push(Point {
                tag: format!("alarm.{name}.{state}"),
                description: format!("{word}: {text}"),
                topic: topic.clone(),
                source: "alarm".into(),
                ..blank.at(Table::DiscreteInput, offset + u32::from(first) + u32::from(bit), Encoding::Bool)
            });
        }
    }
    points
}

fn tag_point(
    blank: &Point,
    table: &TagTable,
    node: &NodeDef,
    def: &TagDef,
    register: &RegisterDef,
    topic: &str,
) -> Point {
    let raw = matches!(register.encoding, Encoding::Raw16 | Encoding::Raw32);
    let address = u32::from(node.offset) + u32::from(register.address);
    Point {
        tag: def.name.clone(),
        scale: register.resolution,
        engineering_unit: if raw { String::new() } else { def.unit.clone() },
        topic: if def.published { format!("{topic}/state") } else { String::new() },
        source: source_text(table, node, &def.source),
        cob_id: cob_id(node, &def.source).unwrap_or_default(),
        description: if raw {
            format!("{} (as on the bus)", def.description)
        } else if def.unit == DEVICE_UNIT && def.device_unit.is_some() {
            format!("{} (in the device's unit)", def.description)
        } else {
            def.description.clone()
        },
        ..blank.at(register.space.into(), address, register.encoding)
    }
}

/// Name, text and topic of the alarms that share a bit: of the one, or of the array. The topic of an array is a filter
/// that all its topics match, and those of the node's other alarms too.
fn alarm_names(table: &TagTable, alarms: &[AlarmIndex], topic: &str) -> Option<(String, String, String)> {
    let mut defs = alarms.iter().filter_map(|alarm| table.alarms.get(alarm.0));
    let first = defs.next()?;
    Some(match defs.next_back() {
        None => (first.name.clone(), first.text.clone(), format!("{topic}/alarm/{}", first.name)),
        Some(last) => {
            let name = first.name.trim_end_matches(|c: char| c.is_ascii_digit()).trim_end_matches('_');
            let text = format!("one of {} .. {}", first.name, last.name);
            (name.to_owned(), text, format!("{topic}/alarm/+"))
        }
    })
}

fn gateway_points(table: &TagTable, unit_id: u8) -> Vec<Point> {
    let blank = Point { unit_id, ..Point::blank() };
    let mut points: Vec<Point> = GATEWAY_BLOCK.iter().map(|row| blank.row(row, 0, row.name)).collect();
    for (place, bus) in table.buses.iter().enumerate() {
        let Some(first) = gateway_block::bus_address(place) else { continue };
        let name = |row: &Row<_>| format!("bus.{}.{}", bus.name, row.name);
        points.extend(BUS_BLOCK.iter().map(|row| blank.row(row, first.into(), &name(row))));
    }
    points.push(Point {
        tag: "event.newest".into(),
        description: "Sequence number of the newest event; 0 = none yet".into(),
        source: "gateway".into(),
        ..blank.at(Table::InputRegister, event_ring::ADDRESS.into(), Encoding::U32)
    });
    for place in 0..event_ring::RECORDS {
        let address = event_ring::FIRST_RECORD + place * event_ring::RECORD;
        points.push(Point {
            tag: format!("event.record_{place}"),
            count: event_ring::RECORD,
            kind: "event".into(),
            description: format!("The newest event whose sequence number is {place} modulo 32"),
            source: "gateway".into(),
            ..blank.at(Table::InputRegister, address.into(), Encoding::U16)
        });
    }
    points.sort_by_key(|point| point.address);
    points
}

impl Point {
    fn blank() -> Self {
        Self {
            node: String::new(),
            tag: String::new(),
            unit_id: 0,
            table: Table::InputRegister,
            address: 0,
            count: 1,
            kind: String::new(),
            scale: 1.0,
            engineering_unit: String::new(),
            reference: String::new(),
            writable: false,
            topic: String::new(),
            source: String::new(),
            description: String::new(),
            cob_id: String::new(),
        }
    }

    /// The same, at an address.
    pub(super) fn at(&self, table: Table, address: u32, encoding: Encoding) -> Self {
        Self {
            table,
            address,
            count: encoding.count(),
            kind: encoding.word().into(),
            reference: table.reference(address),
            ..self.clone()
        }
    }

    /// The same, as a register of a fixed block that begins at `first`.
    fn row<S>(&self, row: &Row<S>, first: u32, name: &str) -> Self {
        Self {
            tag: name.into(),
            scale: row.scale,
            engineering_unit: row.unit.into(),
            source: "gateway".into(),
            description: row.description.into(),
            ..self.at(Table::InputRegister, first + u32::from(row.address), row.encoding)
        }
    }
}

/// FNV-1a, 64 bits, over all that tells a client where and how to read. Texts for people are left out: another wording is
/// no other map. So is what stands in a register whose value is not valid (`on_loss`, `zero_on_bad`).
#[must_use]
pub fn hash(version: u16, points: &[Point], word_order: WordOrder) -> u64 {
    let mut hash = Fnv::new();
    hash.field(&version.to_string());
    hash.field(word_order.letters());
    for point in points {
        hash.field(&point.node);
        hash.field(&point.tag);
        hash.field(&point.unit_id.to_string());
        hash.field(point.table.word());
        hash.field(&point.address.to_string());
        hash.field(&point.count.to_string());
        hash.field(&point.kind);
        hash.field(&point.scale.to_string());
        hash.field(&point.engineering_unit);
        hash.field(if point.writable { "writable" } else { "read only" });
        hash.field(&point.topic);
    }
    hash.0
}

/// A hash as the map and MQTT print it.
#[must_use]
pub fn hash_text(hash: u64) -> String {
    format!("{hash:016x}")
}

struct Fnv(u64);

impl Fnv {
    fn new() -> Self {
        Self(0xcbf2_9ce4_8422_2325)
    }

    /// Adds a text and an end mark, so that `a` `bc` is not `ab` `c`.
    fn field(&mut self, text: &str) {
        self.add(text.as_bytes());
        self.add(&[0xFF]);
    }

    fn add(&mut self, bytes: &[u8]) {
        for &byte in bytes {
            self.0 = (self.0 ^ u64::from(byte)).wrapping_mul(0x0000_0100_0000_01b3);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_hash_is_fnv_1a() {
        // Test vectors of draft-eastlake-fnv, appendix C.
        for (text, expected) in
            [("", 0xcbf2_9ce4_8422_2325), ("a", 0xaf63_dc4c_8601_ec8c), ("foobar", 0x8594_4171_f739_67e8)]
        {
            let mut hash = Fnv::new();
            hash.add(text.as_bytes());
            assert_eq!(hash.0, expected, "{text}");
        }
        let (mut one, mut other) = (Fnv::new(), Fnv::new());
        one.field("a");
        one.field("bc");
        other.field("ab");
        other.field("c");
        assert_ne!(one.0, other.0);
    }

    #[test]
    fn references_count_from_one() {
        assert_eq!(Table::InputRegister.reference(100), "300101");
        assert_eq!(Table::HoldingRegister.reference(0), "400001");
        assert_eq!(Table::DiscreteInput.reference(65_535), "165536");
        assert_eq!(Table::Coil.reference(7), "000008");
    }
}
