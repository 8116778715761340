//! Node ids and identifiers: what no two nodes of a bus may share.

use std::collections::{BTreeMap, BTreeSet};
use std::ops::Range;

use super::super::installation::NodeEntry;
use super::super::table::BusDef;
use super::super::{At, SourceText};
use super::Installation;
use super::problems::Problems;
use crate::can::{BusIndex, CanId};
use crate::canopen::sdo::request_id;
use crate::canopen::{NodeSettings, cob_id};

/// Identifiers that CiA 301 keeps for other things than PDOs.
const RESTRICTED: [(u32, u32, &str); 7] = [
    (0x000, 0x07F, "NMT and its neighbours"),
    (0x101, 0x180, "TIME and its neighbours"),
    (0x581, 0x5FF, "SDO answers"),
    (0x601, 0x67F, "SDO requests"),
    (0x6E0, 0x6FF, "reserved identifiers"),
    (0x701, 0x77F, "node guarding and heartbeat"),
    (0x780, 0x7FF, "layer setting services"),
];

/// The line of what everybody knows: it stands in no file.
pub const NOWHERE: usize = usize::MAX;

/// What is taken on each bus, and by whom.
#[derive(Debug, Default)]
pub struct Taken {
    node_ids: BTreeMap<(BusIndex, u64), String>,
    module_numbers: BTreeMap<(BusIndex, u64), String>,
    /// With the line in which the owner stands.
    identifiers: BTreeMap<(BusIndex, CanId), (String, usize)>,
    /// Nodes whose bus or id is wrong: what follows from that for their identifiers needs no telling.
    ignored: BTreeSet<String>,
}

impl Taken {
    /// A node id must be unique on its bus, and not the gateway's own (R-DET-004).
    pub fn node_id(
        &mut self,
        problems: &mut Problems,
        installation: &Installation<'_>,
        name: &At<String>,
        entry: &NodeEntry,
        bus: BusIndex,
    ) {
        let id = &entry.id;
        let hint = "every node of a bus needs its own id, set in the device";
        if let Some(other) = self.node_ids.insert((bus, id.value), name.value.clone()) {
            let message = format!(
                "nodes `{other}` and `{}` have the same id {} on bus `{}`",
                name.value, id.value, entry.bus.value
            );
            problems.error(installation.config, &id.span, message, hint);
            self.ignore(name);
        }
        let own = installation.buses.values().nth(bus.0).and_then(|bus| bus.own_node_id.as_ref());
        if own.is_some_and(|own| own.value == id.value) {
            let message = format!("node id {} is the gateway's own on bus `{}`", id.value, entry.bus.value);
            problems.error(installation.config, &id.span, message, hint);
        }
    }

    /// A module number must be unique on its bus. It may be a node id: the two are different worlds.
    pub fn module_number(
        &mut self,
        problems: &mut Problems,
        config: &SourceText,
        name: &At<String>,
        entry: &NodeEntry,
        bus: BusIndex,
    ) {
        let id = &entry.id;
        if let Some(other) = self.module_numbers.insert((bus, id.value), name.value.clone()) {
            let message = format!(
                "modules `{other}` and `{}` have the same number {} on bus `{}`",
                name.value, id.value, entry.bus.value
            );
            let hint =
                "every module of a bus needs its own: that of its coding switch, or another stored in it";
            problems.error(config, &id.span, message, hint);
            self.ignore(name);
        }
    }

    /// A node whose identifiers are not to be looked at.
    pub fn ignore(&mut self, name: &At<String>) {
        self.ignored.insert(name.value.clone());
    }

    /// Whether the identifiers of a node are not to be looked at.
    pub fn ignores(&self, name: &At<String>) -> bool {
        self.ignored.contains(&name.value)
    }

    /// All identifiers of a bus.
    pub fn of_bus(&self, bus: BusIndex) -> impl Iterator<Item = CanId> + '_ {
        self.identifiers.keys().filter(move |(of, _)| *of == bus).map(|(_, id)| *id)
    }

    /// Who has an identifier.
    pub fn owner(&self, bus: BusIndex, id: CanId) -> Option<&str> {
        self.identifiers.get(&(bus, id)).map(|(owner, _)| owner.as_str())
    }

    /// Takes an identifier, or tells who has it already, with the line where that is another than this one.
    pub fn take(&mut self, bus: BusIndex, id: CanId, owner: &str, line: usize) -> Result<(), String> {
        match self.identifiers.get(&(bus, id)) {
            None => {
                self.identifiers.insert((bus, id), (owner.to_owned(), line));
                Ok(())
            }
            Some((other, at)) if *at == line || *at == NOWHERE => Err(other.clone()),
            Some((other, at)) => Err(format!("{other} (line {at})")),
        }
    }

    /// The identifiers of SYNC and of TIME: as the configuration tells, else as everybody knows them.
    pub fn broadcasts(
        &mut self,
        problems: &mut Problems,
        installation: &Installation<'_>,
        index: BusIndex,
        bus: &BusDef,
    ) {
        let entry = installation.buses.iter().nth(index.0);
        let at = |span: Option<&Range<usize>>| span.or(entry.map(|(name, _)| &name.span)).cloned();
        let spans = [
            at(entry.and_then(|(_, entry)| entry.sync.as_ref()).map(|sync| &sync.span)),
            at(entry.and_then(|(_, entry)| entry.time.as_ref()).map(|time| &time.span)),
        ];
        let sync = ("SYNC", bus.sync.map_or(cob_id::SYNC, |sync| sync.cob_id));
        let time = ("TIME", bus.time.map_or(cob_id::TIME, |time| time.cob_id));
        for ((what, id), span) in [sync, time].into_iter().zip(spans) {
            let owner = format!("{what} of bus `{}`", bus.name);
            self.claim(problems, installation.config, index, id, &owner, &span.unwrap_or_default());
        }
    }

    /// An identifier must have one sender on its bus (R-DET-004). All of a node's are looked at, though only those of its
    /// PDOs can be chosen.
    pub fn identifiers(
        &mut self,
        problems: &mut Problems,
        installation: &Installation<'_>,
        name: &At<String>,
        bus: BusIndex,
        settings: &NodeSettings,
    ) {
        if self.ignored.contains(&name.value) {
            return;
        }
        let (config, node, id) = (installation.config, &name.value, settings.id);
        for (what, id) in [
            ("SDO answers", cob_id::sdo_answer(id)),
            ("SDO requests", request_id(id)),
            ("heartbeat and guarding", cob_id::error_control(id)),
        ] {
            let owner = format!("{what} of node `{node}`");
            self.claim(problems, config, bus, id, &owner, &name.span);
        }
        let emergency = settings.emergency.unwrap_or_else(|| cob_id::emcy(settings.id));
        let tpdos = settings.pdos.iter().map(|pdo| (format!("TPDO {}", pdo.number), pdo.cob_id));
        let rpdos = settings.rpdos.iter().map(|pdo| (format!("RPDO {}", pdo.number), pdo.cob_id));
        for (what, id) in std::iter::once(("emergency".to_owned(), emergency)).chain(tpdos).chain(rpdos) {
            let owner = format!("{what} of node `{node}`");
            let Some(purpose) = restricted(id) else {
                self.claim(problems, config, bus, id, &owner, &name.span);
                continue;
            };
            let whose = other_node(installation, name, bus, id);
            let whose = whose.map_or_else(String::new, |other| format!(", here of node `{other}`"));
            let message = format!("{owner} has identifier {id}, which is kept for {purpose}{whose}");
            problems.error(config, &name.span, message, "check `cob_id` in the mapping");
        }
    }

    fn claim(
        &mut self,
        problems: &mut Problems,
        config: &SourceText,
        bus: BusIndex,
        id: CanId,
        owner: &str,
        span: &Range<usize>,
    ) {
        let (line, _) = config.position(span.start);
        let Err(other) = self.take(bus, id, owner, line) else { return };
        let message = format!("{other} and {owner} have the same identifier {id}");
        let hint = "every identifier has one sender on its bus: check the `cob_id` of both, in the configuration and in \
                    the mappings";
        problems.error(config, span, message, hint);
    }
}

/// The other node of a bus whose id is in an identifier that is kept for a service of nodes.
fn other_node<'a>(
    installation: &'a Installation<'_>,
    name: &At<String>,
    bus: BusIndex,
    id: CanId,
) -> Option<&'a str> {
    let CanId::Standard(number) = id else { return None };
    let bus = installation.buses.keys().nth(bus.0)?;
    let is_service = matches!(number >> 7, 0xB | 0xC | 0xE);
    let mut nodes = installation.nodes.iter();
    let (other, _) = nodes.find(|(_, entry)| {
        is_service && entry.bus.value == bus.value && entry.id.value == u64::from(number & 0x7F)
    })?;
    (other.value != name.value).then_some(other.value.as_str())
}

/// What an identifier is kept for, so that it can be no PDO's.
pub fn restricted(id: CanId) -> Option<&'static str> {
    let CanId::Standard(id) = id else { return None };
    let id = u32::from(id);
    RESTRICTED.iter().find(|(first, last, _)| (*first..=*last).contains(&id)).map(|(_, _, purpose)| *purpose)
}
