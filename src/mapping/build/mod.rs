//! From the mapping files and the installation's tables to the tag table, or to everything that is wrong with them.
//!
//! - this file: what an installation is, and the way through its buses and nodes.
//! - `items`: the tags of a mapping, arrays unrolled. `tags`, `fields`, `derived`: what they become; `units`: those of the device.
//! - `node`: what the CANopen master needs to know; `boot`: what it does before it starts the node.
//! - `alarms`: alarms, their order and what suppresses them. `emergency`: errors that emergency messages tell of.
//! - `writable`: objects that may be written by SDO.
//! - `broadcasts`: SYNC and TIME of a bus; `sync`: PDOs that go with SYNC; `rpdo`: what nodes are sent.
//! - `esd`: nodes that are esd modules; `lines`: their serial lines, `line_keys`: what these ask in vain; `offers`: where these are offered.
//! - `addresses`, `network`, `esd_clashes`: what must not happen twice among nodes. `load`: whether a bus can carry it all.
//! - `order`: causes before consequences. `problems`: where messages are collected.
//! - [`sketch`]: an installation without a configuration file.

mod addresses;
mod alarms;
mod boot;
mod broadcasts;
mod derived;
mod emergency;
mod esd;
mod esd_clashes;
mod fields;
mod items;
mod line_keys;
mod lines;
mod load;
mod network;
mod node;
mod offers;
mod order;
mod problems;
mod rpdo;
pub mod sketch;
mod sync;
mod tags;
#[cfg(test)]
mod tests;
mod units;
mod writable;

// Addresses only; nothing here opens a socket.
use core::net::SocketAddr;
use std::collections::BTreeMap;
use std::time::Duration;

use self::addresses::Claims;
use self::items::{Element, Items};
use self::load::Load;
use self::network::Taken;
use self::node::Tpdo;
pub use self::offers::share_port;
use self::problems::Problems;
pub use self::problems::{is_name, is_snake_case, sort_problems};
use self::rpdo::Rpdo;
pub use self::sketch::Sketch;
use self::tags::Context;
use super::file::MappingFile;
use super::installation::{BusEntry, NodeEntry, ProducerWord, SyncEntry};
use super::reader::{self, Read};
use super::shipped::{SHIPPED, shipped};
use super::suggest::closest;
use super::table::{BusDef, DeviceDef, NodeDef, Protocol, PublishDef, TagTable};
use super::{At, Diagnostic, SourceText};
use crate::can::{BIT_RATES, BusIndex, DEFAULT_BIT_RATE};
use crate::canopen::NodeId;
use crate::esd::{ModuleKind, ModuleNumber};
use crate::process_image::{NodeIndex, TagIndex};

/// Version of the mapping format that this program reads.
pub const FORMAT: u64 = 1;

/// The period of SYNC, in ms, on a bus that is not known.
const SYNC_OF_A_CHECK: u64 = 100;

/// All that an installation is made of.
#[derive(Clone, Copy, Debug)]
pub struct Installation<'a> {
    /// Name of the gateway.
    pub gateway: &'a str,
    /// The Modbus unit id of the gateway itself, which no node may have.
    pub gateway_unit_id: u8,
    /// The configuration file, for positions.
    pub config: &'a SourceText,
    /// `[bus.*]`.
    pub buses: &'a BTreeMap<At<String>, BusEntry>,
    /// `[node.*]`.
    pub nodes: &'a BTreeMap<At<String>, NodeEntry>,
    /// Mapping files by the name that nodes call them; one that is missing here is looked for among the shipped ones.
    pub mappings: &'a BTreeMap<String, SourceText>,
    /// Where the gateway listens apart from serial lines, and who does.
    pub listeners: &'a [(SocketAddr, String)],
    /// Names of buses and mappings that could not be read: that they are missing is not told again.
    pub lost: &'a [String],
}

/// Builds the tag table of an installation; with it come the warnings. Or everything that is wrong, warnings included.
pub fn build(installation: &Installation<'_>) -> Result<(TagTable, Vec<Diagnostic>), Vec<Diagnostic>> {
    let mut problems = Problems::default();
    let buses = buses(&mut problems, installation);
    let files = mapping_files(&mut problems, installation);
    let mut builder = Builder {
        installation,
        table: TagTable {
            gateway: installation.gateway.to_owned(),
            alarms: alarms::of_gateway_and_buses(buses.len()),
            buses,
            ..TagTable::default()
        },
        taken: Taken::default(),
        load: Load::default(),
        claims: Vec::new(),
        ports: installation.listeners.to_vec(),
    };
    for (index, bus) in builder.table.buses.iter().enumerate() {
        builder.taken.broadcasts(&mut problems, installation, BusIndex(index), bus);
    }
    for (name, entry) in installation.nodes {
        builder.node(&mut problems, &files, name, entry);
    }
    let Builder { load, claims, table, .. } = &mut builder;
    load.check(&mut problems, installation, &table.buses);
    for (node, offset) in addresses::place(&mut problems, installation.config, claims) {
        table.nodes.get_mut(node.0).into_iter().for_each(|def| def.offset = offset);
    }
    addresses::check_nodes(&mut problems, installation.config, claims);
    esd_clashes::check(&mut problems, installation, &mut builder.taken, &builder.table);
    if problems.has_errors() { Err(problems.sorted()) } else { Ok((builder.table, problems.sorted())) }
}

/// Checks one mapping by itself, as if one node of an installation used it. Warnings, or everything that is wrong.
pub fn check_mapping(source: &SourceText) -> Result<Vec<Diagnostic>, Vec<Diagnostic>> {
    // Whether its bus has SYNC is not for the mapping to say.
    let sync = SyncEntry {
        producer: ProducerWord::Other,
        period_ms: Some(At::nowhere(SYNC_OF_A_CHECK)),
        ..SyncEntry::default()
    };
    let sketch = Sketch::new().bus(|bus| bus.sync = Some(At::nowhere(sync)));
    let sketch = sketch.mapping(source.clone()).node("check", 1, &source.name, |_| ());
    sketch.build().map(|(_, warnings)| warnings)
}

fn buses(problems: &mut Problems, installation: &Installation<'_>) -> Vec<BusDef> {
    let config = installation.config;
    let mut buses = Vec::new();
    for (name, entry) in installation.buses {
        problems.name(config, name, "bus");
        let bit_rate = entry.bit_rate.as_ref().map_or(Some(DEFAULT_BIT_RATE), |bit_rate| {
            let known = BIT_RATES.into_iter().find(|known| u64::from(*known) == bit_rate.value);
            if known.is_none() {
                let message = format!("{} bit/s is no bit rate of CANopen", bit_rate.value);
                problems.error(config, &bit_rate.span, message, format!("use one of {BIT_RATES:?}"));
            }
            known
        });
        buses.push(BusDef {
            name: name.value.clone(),
            role: entry.role.into(),
            bit_rate: bit_rate.unwrap_or(DEFAULT_BIT_RATE),
            start_broadcast: entry.start_broadcast,
            sync: broadcasts::sync(problems, config, entry),
            time: broadcasts::time(problems, config, entry),
            own_heartbeat: broadcasts::own_heartbeat(problems, config, entry),
            esd: esd::bus(problems, config, entry),
        });
    }
    buses
}

/// A mapping file that was read.
struct ReadMapping {
    source: SourceText,
    read: Read<MappingFile>,
}

fn mapping_files(problems: &mut Problems, installation: &Installation<'_>) -> BTreeMap<String, ReadMapping> {
    let mut files = BTreeMap::new();
    let mut names: Vec<&At<String>> = installation.nodes.values().map(|node| &node.mapping).collect();
    names.sort();
    names.dedup();
    for name in names {
        let own = installation.mappings.get(&name.value).cloned();
        let source = own.or_else(|| {
            shipped(&name.value).map(|text| SourceText::new(format!("mappings/{}.toml", name.value), text))
        });
        if let Some(source) = source
            && !installation.lost.contains(&name.value)
        {
            let mut read = reader::read::<MappingFile>(&source);
            problems.extend(read.problems.drain(..));
            if let Some(file) = &read.content
                && file.format.value != FORMAT
            {
                let message = format!("format {} is not known to this program", file.format.value);
                problems.error(&source, &file.format.span, message, format!("it reads format {FORMAT}"));
            }
            files.insert(name.value.clone(), ReadMapping { source, read });
        }
    }
    files
}

struct Builder<'a> {
    installation: &'a Installation<'a>,
    table: TagTable,
    taken: Taken,
    load: Load,
    claims: Vec<Claims>,
    /// Where the gateway and its serial lines listen, and whose it is.
    ports: Vec<(SocketAddr, String)>,
}

/// What the mapping of a node says that it speaks, with its number there.
#[derive(Clone, Copy)]
enum Speaks {
    Canopen(NodeId),
    Esd(ModuleKind, ModuleNumber),
}

impl Builder<'_> {
    fn node(
        &mut self,
        problems: &mut Problems,
        files: &BTreeMap<String, ReadMapping>,
        name: &At<String>,
        entry: &NodeEntry,
    ) {
        let config = self.installation.config;
        problems.name(config, name, "node");
        let bus = self.bus(problems, entry);
        let mapping = files.get(&entry.mapping.value);
        // Which numbers there are cannot be said where the section is wrong that says what the device is.
        if mapping.is_some_and(|mapping| mapping.read.lost.iter().any(|lost| lost == "esd")) {
            self.taken.ignore(name);
            return;
        }
        let module = mapping.and_then(|mapping| mapping.read.content.as_ref()?.esd.as_ref());
        let speaks = self.number(problems, name, entry, bus, module.map(|esd| esd.module.value.into()));
        let unit_id = self.unit_id(problems, entry);
        let Some(mapping) = mapping else {
            let mapping = &entry.mapping;
            if self.installation.lost.contains(&mapping.value) {
                return;
            }
            let message = format!("there is no mapping `{}`", mapping.value);
            let hint = match closest(&mapping.value, SHIPPED.iter().map(|(name, _)| *name)) {
                Some(close) => format!("did you mean `{close}`?"),
                None => "give the name of a file in `mappings/` without .toml, or a path to one".to_owned(),
            };
            problems.error(config, &mapping.span, message, hint);
            return;
        };
        let (Some(file), Some(speaks)) = (&mapping.read.content, speaks) else { return };
        let items = Items::new(problems, &mapping.source, file, &mapping.read.lost);
        let context = Context {
            source: &mapping.source,
            file,
            config,
            entry,
            bus: bus.and_then(|bus| self.table.buses.get(bus.0)).cloned(),
            tpdos: Tpdo::all(file, entry),
            rpdos: Rpdo::all(file),
            items,
            node: NodeIndex(self.table.nodes.len()),
            base: self.table.tags.len(),
        };
        esd::refuse_keys(problems, config, entry, module.is_some());
        self.add(problems, &context, name, bus.unwrap_or_default(), speaks, unit_id);
    }

    /// The number of a node in its world. What is wrong with it is told, and its identifiers are not looked at then.
    fn number(
        &mut self,
        problems: &mut Problems,
        name: &At<String>,
        entry: &NodeEntry,
        bus: Option<BusIndex>,
        module: Option<ModuleKind>,
    ) -> Option<Speaks> {
        let config = self.installation.config;
        let (what, limits) = if module.is_some() { ("module number", 1..=254) } else { ("node id", 1..=127) };
        let id = u8::try_from(problems.within(config, &entry.id, what, limits.clone())).ok()?;
        match (bus.filter(|_| limits.contains(&entry.id.value)), module) {
            (Some(bus), Some(_)) => self.taken.module_number(problems, config, name, entry, bus),
            (Some(bus), None) => self.taken.node_id(problems, self.installation, name, entry, bus),
            (None, _) => self.taken.ignore(name),
        }
        match module {
            Some(kind) => ModuleNumber::new(id).map(|number| Speaks::Esd(kind, number)),
            None => NodeId::new(id).map(Speaks::Canopen),
        }
    }

    fn bus(&self, problems: &mut Problems, entry: &NodeEntry) -> Option<BusIndex> {
        let name = &entry.bus;
        let found = self.installation.buses.keys().position(|bus| bus.value == name.value).map(BusIndex);
        if found.is_none() && !self.installation.lost.contains(&name.value) {
            let known = self.installation.buses.keys().map(|bus| bus.value.as_str());
            problems.unknown(self.installation.config, &name.span, "bus", &name.value, known);
        }
        found
    }

    fn unit_id(&self, problems: &mut Problems, entry: &NodeEntry) -> u64 {
        let config = self.installation.config;
        let at = entry.unit_id.as_ref().unwrap_or(&entry.id);
        if entry.unit_id.is_some() {
            problems.within(config, at, "unit_id", 1..=247);
        } else if (248..=254).contains(&at.value) {
            let message = format!("module number {} cannot be the Modbus unit id as well", at.value);
            problems.error(config, &at.span, message, "give the node a `unit_id` of 1 to 247");
        }
        if at.value == u64::from(self.installation.gateway_unit_id) {
            let message = format!("unit id {} is that of the gateway itself", at.value);
            let hint = "give the node another unit_id, or the gateway another gateway_unit_id under [modbus]";
            problems.error(config, &at.span, message, hint);
        }
        at.value
    }

    fn add(
        &mut self,
        problems: &mut Problems,
        context: &Context<'_>,
        name: &At<String>,
        bus: BusIndex,
        speaks: Speaks,
        unit_id: u64,
    ) {
        let (tags, places) = tags::tags(problems, context);
        let (protocol, lines) = match speaks {
            Speaks::Canopen(id) => {
                fields::check_overlaps(problems, context, &fields::all(context, &tags, &places));
                rpdo::check_contents(problems, context, &tags, &places);
                sync::check_changes(problems, context);
                let canopen = node::settings(problems, context, id);
                self.taken.identifiers(problems, self.installation, name, bus, &canopen);
                self.load.add(context, bus, &canopen);
                (Protocol::Canopen(Box::new(canopen)), Vec::new())
            }
            Speaks::Esd(kind, number) => {
                esd::refuse_sections(problems, context.source, context.file);
                let module = esd::settings(problems, context, &name.value, kind, number);
                let lines = offers::lines(problems, context, kind);
                offers::check_ports(problems, context, &name.value, &lines, &mut self.ports);
                self.load.add_lines(context, bus, &module, &lines);
                (Protocol::Esd(Box::new(module)), lines)
            }
        };
        self.claims.push(addresses::of_node(problems, context, name, unit_id, (&tags, &places), &lines));
        let emergency = emergency::definition(problems, context, protocol.polls());
        let base = self.table.alarms.len();
        let alarms = alarms::of_node(problems, context, protocol.pdos(), &places, bus, base);
        let (device, entry) = (&context.file.device, context.entry);
        self.table.nodes.push(NodeDef {
            name: name.value.clone(),
            bus,
            protocol,
            device: DeviceDef {
                mapping: mapping_name(&entry.mapping.value),
                vendor: device.vendor.clone(),
                model: device.model.clone(),
                description: device.description.clone(),
                shipped_lengths: node::shipped_lengths(problems, context),
            },
            unit_id: u8::try_from(unit_id).unwrap_or(1),
            offset: entry.offset.as_ref().and_then(|offset| offset.value.fixed()).unwrap_or(0),
            required: entry.required.unwrap_or(true),
            on_loss: entry.on_loss.into(),
            zero_on_bad: entry.zero_on_bad,
            tags: context.base..context.base + tags.len(),
            alarms: base..base + alarms.len(),
            rpdos: context.rpdos.iter().map(Rpdo::def).collect(),
            outputs: entry.outputs.value,
            reserved_bits: context.tpdos.iter().map(Tpdo::reserved_bits).collect(),
            emergency,
            publish: publish(problems, context, &places),
        });
        self.table.lines.extend(lines);
        self.table.tags.extend(tags);
        self.table.alarms.extend(alarms);
    }
}

/// A mapping's name without folder and ending.
fn mapping_name(reference: &str) -> String {
    let file = reference.rsplit('/').next().unwrap_or(reference);
    file.strip_suffix(".toml").unwrap_or(file).to_owned()
}

fn publish(problems: &mut Problems, context: &Context<'_>, places: &[usize]) -> PublishDef {
    let (source, section) = (context.source, &context.file.publish);
    let mut interval = |at: &Option<At<u64>>, what: &str, lowest: u64, default: u64| {
        problems.milliseconds(source, at.as_ref(), what, lowest..=3_600_000, Duration::from_millis(default))
    };
    let min_interval = interval(&section.min_interval_ms, "min_interval_ms", 10, 500);
    let fast_interval = interval(&section.fast_interval_ms, "fast_interval_ms", 10, 100);
    let max_interval = interval(&section.max_interval_ms, "max_interval_ms", 100, 10_000);
    let longest = min_interval.max(fast_interval);
    if longest > max_interval
        && let Some(at) = section.max_interval_ms.as_ref().or(section.min_interval_ms.as_ref())
    {
        let message = format!(
            "the longest interval {} ms is shorter than the shortest {} ms",
            max_interval.as_millis(),
            longest.as_millis()
        );
        problems.error(source, &at.span, message, "max_interval_ms must be the largest of the three");
    }
    let fast_while = section.fast_while.as_ref().and_then(|name| {
        let tag = context.bool_tag(problems, name, &Element::default(), "`fast_while`")?;
        places.get(tag.0).map(|place| TagIndex(context.base + place))
    });
    PublishDef { min_interval, fast_interval, fast_while, max_interval }
}
