//! The register map: which unit and address shows what. Built once from the tag table, immutable.

use std::collections::BTreeMap;

use super::address_space::{AddressSpace, AddressSpaceBuilder};
use super::event_ring::{self, EventCodes, EventField};
use super::gateway_block::{self, BUS_BLOCK, BusRegister, GATEWAY_BLOCK, GatewayRegister, MAP_VERSION};
use super::identification::Identification;
use super::line_text::{self, LineRegister};
use super::node_block::{self, NODE_BLOCK, NodeRegister};
use super::points::{self, Point};
use super::writing::Writable;
use super::{ModbusSettings, WordOrder};
use crate::mapping::{Encoding, NodeDef, OnLoss, RegisterDef, Space, TagTable};
use crate::process_image::{AlarmIndex, NodeIndex, TagIndex};

/// The register map of an installation.
#[derive(Clone, Debug)]
pub struct RegisterMap {
    gateway_unit_id: u8,
    word_order: WordOrder,
    units: BTreeMap<u8, Unit>,
    events: EventCodes,
    points: Vec<Point>,
    writable: Writable,
    hash: u64,
}

/// What one unit id shows.
#[derive(Clone, Debug)]
pub struct Unit {
    /// Read by FC 3 and 4.
    pub registers: AddressSpace<RegisterShow>,
    /// Read by FC 1 and 2.
    pub bits: AddressSpace<BitShow>,
    /// Read by FC 43/14.
    pub identification: Identification,
}

/// What an entry of the register space shows.
#[derive(Clone, Copy, Debug)]
pub enum RegisterShow {
    /// The value of a tag.
    Tag(TagRegister),
    /// A register of a node's block.
    Node(NodeIndex, NodeRegister),
    /// A register of the gateway.
    Gateway(GatewayRegister),
    /// A register of a bus, by its place in the configuration.
    Bus(usize, BusRegister),
    /// A register of the last message of a serial line.
    Line(LineRegister),
    /// Sequence number of the newest event.
    NewestEvent,
    /// A field of a record of the event ring.
    Event(u16, EventField),
}

/// A tag in the register space.
#[derive(Clone, Copy, Debug)]
pub struct TagRegister {
    /// Which.
    pub tag: TagIndex,
    /// How it is written.
    pub encoding: Encoding,
    /// Engineering units per count.
    pub resolution: f64,
    /// What is shown when the value is not usable.
    pub on_loss: OnLoss,
    /// Where the last value would be shown, show 0.
    pub zero_on_bad: bool,
}

/// What an entry of the bit space shows.
#[derive(Clone, Debug)]
pub enum BitShow {
    /// A bool tag.
    Tag(TagRegister),
    /// A bool tag that tells whether other tags mean anything: true only while it is, and it and they are good.
    Validity {
        /// The tags that it vouches for.
        vouches_for: Vec<TagIndex>,
    },
    /// Whether one of these alarms is active.
    Active(Vec<AlarmIndex>),
    /// Whether one of these alarms is unacknowledged.
    Unacknowledged(Vec<AlarmIndex>),
}

/// Why an installation has no register map.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum MapError {
    /// Two owners of one address.
    #[error(
        "unit {unit_id}, {table}: {first} and {second} both stand at address {address}; move one of them, or give one node another `offset` or `unit_id`"
    )]
    Overlap {
        /// Unit id.
        unit_id: u8,
        /// Which table.
        table: &'static str,
        /// The first address that both want.
        address: u32,
        /// One owner.
        first: String,
        /// The other.
        second: String,
    },
    /// An address above 65,535.
    #[error(
        "unit {unit_id}, {table}: {owner} would stand at address {address}, but 65535 is the last; lower the `offset` of its node"
    )]
    BeyondEnd {
        /// Unit id.
        unit_id: u8,
        /// Which table.
        table: &'static str,
        /// The address.
        address: u32,
        /// Whose it is.
        owner: String,
    },
    /// A node has the unit id of the gateway.
    #[error(
        "node `{node}` has unit id {unit_id}, which is the gateway's own; change its `unit_id`, or `gateway_unit_id` in [modbus]"
    )]
    UnitTaken {
        /// The node.
        node: String,
        /// Its unit id.
        unit_id: u8,
    },
}

/// Registers, or bits, of a device block are published up to the next multiple of this.
const ROUND_REGISTERS: u32 = 10;
const ROUND_BITS: u32 = 16;

impl RegisterMap {
    /// The map of an installation. `base_topic` is that of MQTT, for the list of points.
    ///
    /// # Errors
    /// Two owners of one address, an address beyond the last, or a node on the gateway's unit id.
    pub fn build(table: &TagTable, settings: &ModbusSettings, base_topic: &str) -> Result<Self, MapError> {
        Self::build_for(table, settings, base_topic, Writable::default())
    }

    /// The same where some of it can be written.
    ///
    /// # Errors
    /// As [`build`](Self::build).
    pub fn build_for(
        table: &TagTable,
        settings: &ModbusSettings,
        base_topic: &str,
        writable: Writable,
    ) -> Result<Self, MapError> {
        let gateway_unit_id = settings.gateway_unit_id;
        let mut points = points::points(table, gateway_unit_id, base_topic);
        points::add_writes(&mut points, table, &writable, gateway_unit_id);
        let hash = points::hash(MAP_VERSION, &points, settings.word_order);
        let mut builders: BTreeMap<u8, UnitBuilder> = BTreeMap::new();
        for (index, node) in table.nodes.iter().enumerate() {
            if node.unit_id == gateway_unit_id || matches!(node.unit_id, 0 | 255) {
                return Err(MapError::UnitTaken { node: node.name.clone(), unit_id: node.unit_id });
            }
            builders.entry(node.unit_id).or_default().add_node(table, NodeIndex(index), node);
        }
        builders.entry(gateway_unit_id).or_default().add_gateway(table);
        let mut units = BTreeMap::new();
        for (unit_id, builder) in builders {
            let first_node = builder.first_node.and_then(|node| table.node(node));
            let unit = Unit {
                registers: builder.registers.build(unit_id, "input registers")?,
                bits: builder.bits.build(unit_id, "discrete inputs")?,
                identification: match first_node {
                    Some(node) => Identification::of_node(table, node, hash),
                    None => Identification::of_gateway(table, hash),
                },
            };
            units.insert(unit_id, unit);
        }
        let word_order = settings.word_order;
        Ok(Self {
            gateway_unit_id,
            word_order,
            units,
            events: EventCodes::new(table),
            points,
            writable,
            hash,
        })
    }

    /// What a unit id shows; 0 and 255 are the gateway, as its own id is. `None` for an unknown one.
    #[must_use]
    pub fn unit(&self, unit_id: u8) -> Option<&Unit> {
        self.units.get(&if matches!(unit_id, 0 | 255) { self.gateway_unit_id } else { unit_id })
    }

    /// What can be written.
    #[must_use]
    pub fn writable(&self) -> &Writable {
        &self.writable
    }

    /// The gateway's own unit id, beside 0 and 255.
    #[must_use]
    pub fn gateway_unit_id(&self) -> u8 {
        self.gateway_unit_id
    }

    /// Whether a unit id is the gateway's.
    #[must_use]
    pub fn is_gateway(&self, unit_id: u8) -> bool {
        matches!(unit_id, 0 | 255) || unit_id == self.gateway_unit_id
    }

    /// The unit ids, lowest first; 0 and 255 apart.
    pub fn unit_ids(&self) -> impl Iterator<Item = u8> {
        self.units.keys().copied()
    }

    /// Order of the registers of a 32-bit value.
    #[must_use]
    pub fn word_order(&self) -> WordOrder {
        self.word_order
    }

    /// What the event ring shows for names.
    #[must_use]
    pub fn events(&self) -> &EventCodes {
        &self.events
    }

    /// All that is published, in the order of `cangate map`.
    #[must_use]
    pub fn points(&self) -> &[Point] {
        &self.points
    }

    /// Of all that a client depends on: a different map has a different hash.
    #[must_use]
    pub fn hash(&self) -> u64 {
        self.hash
    }

    /// The hash as `map` and MQTT print it: 16 hexadecimal digits.
    #[must_use]
    pub fn hash_text(&self) -> String {
        points::hash_text(self.hash)
    }
}

#[derive(Debug, Default)]
struct UnitBuilder {
    registers: AddressSpaceBuilder<RegisterShow>,
    bits: AddressSpaceBuilder<BitShow>,
    first_node: Option<NodeIndex>,
}

impl UnitBuilder {
    fn add_node(&mut self, table: &TagTable, index: NodeIndex, node: &NodeDef) {
        self.first_node.get_or_insert(index);
        let offset = u32::from(node.offset);
        self.add_node_block(index, node);
        self.add_alarm_bits(table, node);
        let mut registers_end = u32::from(node_block::REGISTERS);
        let mut bits_end = u32::from(node_block::BITS);
        let vouched = vouched_for(table, node);
        for tag in node.tags.clone().map(TagIndex) {
            let Some(def) = table.tag(tag) else { continue };
            for register in &def.registers {
                let end = u32::from(register.address) + u32::from(register.encoding.count());
                let claim = offset + u32::from(register.address)..offset + end;
                let owner = format!("tag `{}` of node `{}`", def.name, node.name);
                let shown = tag_register(tag, register, node);
                match register.space {
                    Space::Register => {
                        registers_end = registers_end.max(end);
                        self.registers.show(claim.start, register.encoding.count(), RegisterShow::Tag(shown));
                        self.registers.claim(claim, owner);
                    }
                    Space::Bit => {
                        bits_end = bits_end.max(end);
                        let show = match vouched.get(&tag) {
                            Some(tags) => BitShow::Validity { vouches_for: tags.clone() },
                            None => BitShow::Tag(shown),
                        };
                        self.bits.show(claim.start, 1, show);
                        self.bits.claim(claim, owner);
                    }
                }
            }
        }
        for (address, shown, owner) in line_text::of_node(table, index, node) {
            let first = offset + u32::from(address);
            let mut end = first;
            for (address, register) in (first..).zip(shown) {
                self.registers.show(address, 1, RegisterShow::Line(register));
                end = address + 1;
            }
            registers_end = registers_end.max(end - offset);
            self.registers.claim(first..end, owner);
        }
        self.registers.publish(offset..offset + registers_end.next_multiple_of(ROUND_REGISTERS));
        self.bits.publish(offset..offset + bits_end.next_multiple_of(ROUND_BITS));
    }

    fn add_node_block(&mut self, index: NodeIndex, node: &NodeDef) {
        let offset = u32::from(node.offset);
        let owner = format!("the node block of `{}`", node.name);
        self.registers.claim(offset..offset + u32::from(node_block::REGISTERS), owner);
        for row in NODE_BLOCK {
            let address = offset + u32::from(row.address);
            self.registers.show(address, row.encoding.count(), RegisterShow::Node(index, row.show));
        }
    }

    fn add_alarm_bits(&mut self, table: &TagTable, node: &NodeDef) {
        let offset = u32::from(node.offset);
        let (active, unacknowledged) = (
            offset + u32::from(node_block::ACTIVE_BITS),
            offset + u32::from(node_block::UNACKNOWLEDGED_BITS),
        );
        self.bits.claim(
            active..offset + u32::from(node_block::BITS),
            format!("the alarms of node `{}`", node.name),
        );
        for (bit, alarms) in alarm_groups(table, node) {
            self.bits.show(active + u32::from(bit), 1, BitShow::Active(alarms.clone()));
            self.bits.show(unacknowledged + u32::from(bit), 1, BitShow::Unacknowledged(alarms));
        }
    }

    fn add_gateway(&mut self, table: &TagTable) {
        let registers = &mut self.registers;
        let records_end = event_ring::FIRST_RECORD + event_ring::RECORDS * event_ring::RECORD;
        registers.publish(0..u32::from(gateway_block::REGISTERS));
        registers.publish(
            u32::from(event_ring::ADDRESS)..u32::from(records_end).next_multiple_of(ROUND_REGISTERS),
        );
        for row in GATEWAY_BLOCK {
            registers.show(row.address.into(), row.encoding.count(), RegisterShow::Gateway(row.show));
        }
        for bus in 0..table.buses.len() {
            let Some(first) = gateway_block::bus_address(bus) else { continue };
            for row in BUS_BLOCK {
                registers.show(
                    (first + row.address).into(),
                    row.encoding.count(),
                    RegisterShow::Bus(bus, row.show),
                );
            }
        }
        registers.show(event_ring::ADDRESS.into(), 2, RegisterShow::NewestEvent);
        for place in 0..event_ring::RECORDS {
            let record = event_ring::FIRST_RECORD + place * event_ring::RECORD;
            for (at, field) in event_ring::FIELDS {
                registers.show((record + at).into(), field.count(), RegisterShow::Event(place, field));
            }
        }
    }
}

fn tag_register(tag: TagIndex, register: &RegisterDef, node: &NodeDef) -> TagRegister {
    TagRegister {
        tag,
        encoding: register.encoding,
        resolution: register.resolution,
        on_loss: node.on_loss,
        zero_on_bad: node.zero_on_bad,
    }
}

/// The tags that name another as their validity, by that other.
fn vouched_for(table: &TagTable, node: &NodeDef) -> BTreeMap<TagIndex, Vec<TagIndex>> {
    let mut vouched: BTreeMap<TagIndex, Vec<TagIndex>> = BTreeMap::new();
    for tag in node.tags.clone().map(TagIndex) {
        if let Some(valid) = table.tag(tag).and_then(|def| def.valid) {
            vouched.entry(valid).or_default().push(tag);
        }
    }
    vouched
}

/// The alarms of a node by their bit, 0..=31.
#[must_use]
pub fn alarm_groups(table: &TagTable, node: &NodeDef) -> BTreeMap<u8, Vec<AlarmIndex>> {
    let mut groups: BTreeMap<u8, Vec<AlarmIndex>> = BTreeMap::new();
    for index in node.alarms.clone() {
        if let Some(bit) = table.alarms.get(index).and_then(|alarm| alarm.bit).filter(|bit| *bit < 32) {
            groups.entry(bit).or_default().push(AlarmIndex(index));
        }
    }
    groups
}
