//! Node ids and identifiers: what no two nodes of a bus may share.

use std::collections::{BTreeMap, BTreeSet};

use super::super::installation::NodeEntry;
use super::super::table::BusDef;
use super::super::{At, SourceText};
use super::Installation;
use super::problems::Problems;
use crate::can::{BusIndex, CanId};
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

/// What is taken on each bus, and by whom.
#[derive(Debug, Default)]
pub struct Taken {
    node_ids: BTreeMap<(BusIndex, u64), String>,
    identifiers: BTreeMap<(BusIndex, CanId), String>,
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

    /// A node whose identifiers are not to be looked at.
    pub fn ignore(&mut self, name: &At<String>) {
        self.ignored.insert(name.value.clone());
    }

    /// The identifiers of SYNC and of TIME, where the configuration tells of them.
    pub fn broadcasts(&mut self, index: BusIndex, bus: &BusDef) {
        let sync = bus.sync.map(|sync| ("SYNC", sync.cob_id));
        let time = bus.time.map(|time| ("TIME", time.cob_id));
        for (what, id) in sync.into_iter().chain(time) {
            self.identifiers.insert((index, id), format!("{what} of bus `{}`", bus.name));
        }
    }

    /// An identifier must have one sender on its bus.
    pub fn identifiers(
        &mut self,
        problems: &mut Problems,
        config: &SourceText,
        name: &At<String>,
        bus: BusIndex,
        settings: &NodeSettings,
    ) {
        let mut all = vec![("emergency".to_owned(), cob_id::emcy(settings.id))];
        let tpdos = settings.pdos.iter().map(|pdo| (format!("TPDO {}", pdo.number), pdo.cob_id));
        let rpdos = settings.rpdos.iter().map(|pdo| (format!("RPDO {}", pdo.number), pdo.cob_id));
        for (what, cob_id) in tpdos.chain(rpdos) {
            if let Some(purpose) = restricted(cob_id) {
                let message = format!(
                    "{what} of node `{}` has identifier {cob_id}, which is kept for {purpose}",
                    name.value
                );
                problems.error(config, &name.span, message, "check `cob_id` in the mapping");
            }
            all.push((what, cob_id));
        }
        for (what, id) in all {
            let owner = format!("{what} of node `{}`", name.value);
            if self.ignored.contains(&name.value) {
                continue;
            }
            let Some(other) = self.identifiers.insert((bus, id), owner.clone()) else { continue };
            let message = format!("{other} and {owner} have the same identifier {id}");
            problems.error(
                config,
                &name.span,
                message,
                "every identifier has one sender: check `cob_id` in the mappings",
            );
        }
    }
}

/// What an identifier is kept for, so that it can be no PDO's.
pub fn restricted(id: CanId) -> Option<&'static str> {
    let CanId::Standard(id) = id else { return None };
    let id = u32::from(id);
    RESTRICTED.iter().find(|(first, last, _)| (*first..=*last).contains(&id)).map(|(_, _, purpose)| *purpose)
}
