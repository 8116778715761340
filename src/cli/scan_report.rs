//! What a scan found: for people as a table, for machines and `cangate init` as JSON.

use std::collections::BTreeMap;
use std::fmt::Write;
use std::time::Duration;

use serde::{Deserialize, Serialize};

use crate::can::CanId;
use crate::canopen::NodeId;
use crate::canopen::census::{Census, NodeRecord, Reports, Traffic};
use crate::canopen::object::ObjectId;
use crate::canopen::probe::Identity;
use crate::mapping::fingerprint::{Candidate, Fit, Sighting};

/// Version of the JSON form.
pub const VERSION: u32 = 1;

/// What a scan found.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct ScanReport {
    /// Of the form, 1.
    pub version: u32,
    /// The interface as the user wrote it.
    pub interface: String,
    /// Bit rate in bit/s, where the interface tells it.
    pub bit_rate: Option<u32>,
    /// Whether nodes were asked, or only listened to.
    pub active: bool,
    /// Frames heard.
    pub frames: u64,
    /// Frames lost on the way to us.
    pub lost_frames: u64,
    /// Whether somebody else commands or guards nodes.
    pub other_master: bool,
    /// Nodes that were heard, or to whom somebody talked, by id.
    pub nodes: Vec<FoundNode>,
    /// NMT commands of somebody else.
    pub nmt: Vec<FoundNmt>,
    /// SYNC.
    pub sync: Option<FoundTraffic>,
    /// TIME.
    pub time: Option<FoundTraffic>,
    /// Frames of an LSS master or slave.
    pub lss_frames: u64,
    /// Identifiers that stand for nothing in the predefined connection set.
    pub unknown: Vec<FoundTraffic>,
    /// Frames of more such identifiers.
    pub unknown_more: u64,
}

/// A node id.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct FoundNode {
    /// The node id.
    pub id: u8,
    /// Whether the node itself was heard, or frames were only sent to it.
    pub heard: bool,
    /// NMT state: `initialising`, `stopped`, `operational`, `pre_operational`.
    pub state: Option<String>,
    /// Boot-up messages.
    pub boot_ups: u64,
    /// How it tells its state: `heartbeat` or `guarding`.
    pub error_control: Option<String>,
    /// Time between two heartbeats, ms.
    pub heartbeat_ms: Option<u64>,
    /// Time between two guard requests of somebody else, ms.
    pub guarded_ms: Option<u64>,
    /// Guard requests of somebody else.
    pub guard_requests: u64,
    /// TPDOs of the predefined connection set.
    pub tpdos: Vec<FoundTraffic>,
    /// RPDOs: somebody sends to it.
    pub rpdos: Vec<FoundTraffic>,
    /// EMCY error codes.
    pub emergencies: Vec<FoundEmergency>,
    /// SDO requests that somebody else sent to it.
    pub sdo_requests: u64,
    /// SDO answers, those to us included.
    pub sdo_answers: u64,
    /// Device type, object 0x1000.
    pub device_type: Option<u32>,
    /// Vendor id, object 0x1018:1.
    pub vendor: Option<u32>,
    /// Product code, object 0x1018:2.
    pub product: Option<u32>,
    /// Revision number, object 0x1018:3.
    pub revision: Option<u32>,
    /// Serial number, object 0x1018:4.
    pub serial: Option<u32>,
    /// Device name, object 0x1008.
    pub name: Option<String>,
    /// Transmission type of TPDO1, object 0x1800:2; up to 240 it follows SYNC.
    #[serde(default)]
    pub tpdo1_type: Option<u32>,
    /// Heartbeat time that the node is set to, object 0x1017, ms; 0 = none.
    #[serde(default)]
    pub heartbeat_set_ms: Option<u32>,
    /// Mappings that fit, the best first.
    pub mappings: Vec<FoundMapping>,
    /// Why two devices may share the id.
    pub suspicions: Vec<String>,
}

/// A mapping that fits.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct FoundMapping {
    /// Its name.
    pub mapping: String,
    /// Maker.
    pub vendor: String,
    /// Model.
    pub model: String,
    /// Whether it is more than a possibility.
    pub probable: bool,
    /// Whether the node says so itself.
    #[serde(default)]
    pub certain: bool,
}

/// Frames of one identifier.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct FoundTraffic {
    /// The identifier, hexadecimal: three digits, or eight for 29 bit.
    pub id: String,
    /// How many.
    pub count: u64,
    /// Their lengths in bytes.
    pub lengths: Vec<u8>,
    /// Mean time between two of them, ms.
    pub period_ms: Option<u64>,
}

/// An NMT command.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct FoundNmt {
    /// Command byte.
    pub command: u8,
    /// Node id, 0 = all.
    pub node: u8,
    /// How often.
    pub count: u64,
}

/// An EMCY error code.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct FoundEmergency {
    /// The code.
    pub code: u16,
    /// How often.
    pub count: u64,
}

fn millis(period: Option<Duration>) -> Option<u64> {
    u64::try_from(period?.as_millis()).ok()
}

fn traffic(id: CanId, traffic: &Traffic) -> FoundTraffic {
    FoundTraffic {
        id: id.to_string(),
        count: traffic.count,
        lengths: traffic.dlcs.iter().copied().collect(),
        period_ms: millis(traffic.period()),
    }
}

fn some_traffic(id: u16, seen: &Traffic) -> Option<FoundTraffic> {
    (seen.count > 0).then(|| traffic(CanId::Standard(id), seen))
}

/// What the fingerprint is taken of.
#[must_use]
pub fn sighting(node: NodeId, record: &NodeRecord, identity: Option<&Identity>) -> Sighting {
    let tpdos = record.seen_tpdos().map(|(number, seen)| (tpdo_id(node, number), seen.dlcs.clone()));
    Sighting {
        node,
        tpdos: tpdos.collect(),
        listened: record.listened(),
        heartbeat: record.reports.map(|reports| reports == Reports::Heartbeat),
        name: identity.and_then(|identity| identity.name.clone()),
        identity: identity.map(told).unwrap_or_default(),
    }
}

/// What of an identity was read, by object.
fn told(identity: &Identity) -> BTreeMap<ObjectId, u32> {
    let device_type = (ObjectId::new(0x1000, 0), identity.device_type);
    let parts = (1..).zip(identity.identity).map(|(sub, part)| (ObjectId::new(0x1018, sub), part));
    std::iter::once(device_type).chain(parts).filter_map(|(object, value)| Some((object, value?))).collect()
}

/// A node that says to be one device and sends what another sends is two.
fn two_devices(candidates: &[Candidate]) -> Option<String> {
    let says = candidates.iter().find(|found| found.fit == Fit::Certain && !found.sends)?;
    let sends = candidates.iter().find(|found| found.fit >= Fit::Probable && found.sends)?;
    let name = |found: &Candidate| format!("{} {}", found.device.vendor, found.device.model);
    Some(format!("it says to be {}, but its process data are those of {}", name(says), name(sends)))
}

fn tpdo_id(node: NodeId, number: u16) -> CanId {
    CanId::Standard(0x080 + number * 0x100 + u16::from(node.get()))
}

/// A node of a census.
#[must_use]
pub fn found_node(
    node: NodeId,
    record: &NodeRecord,
    identity: Option<&Identity>,
    candidates: Vec<Candidate>,
) -> FoundNode {
    let number = u16::from(node.get());
    let rpdos = (1..).zip(&record.rpdos);
    let [vendor, product, revision, serial] = identity.map(|identity| identity.identity).unwrap_or_default();
    let heartbeat = record.reports == Some(Reports::Heartbeat);
    FoundNode {
        id: node.get(),
        heard: record.is_heard() || identity.is_some(),
        state: record.state.map(|state| state.word().to_owned()),
        boot_ups: record.boot_ups,
        error_control: record.reports.map(|reports| {
            let word = match reports {
                Reports::Heartbeat => "heartbeat",
                Reports::Guarding => "guarding",
            };
            word.to_owned()
        }),
        heartbeat_ms: millis(record.states.period()).filter(|_| heartbeat),
        guarded_ms: millis(record.guard_requests.period()),
        guard_requests: record.guard_requests.count,
        tpdos: record.seen_tpdos().map(|(number, seen)| traffic(tpdo_id(node, number), seen)).collect(),
        rpdos: rpdos.filter_map(|(place, seen)| some_traffic(0x100 + place * 0x100 + number, seen)).collect(),
        emergencies: record
            .emergencies
            .iter()
            .map(|(code, count)| FoundEmergency { code: *code, count: *count })
            .collect(),
        sdo_requests: record.sdo_requests,
        sdo_answers: record.sdo_answers,
        device_type: identity.and_then(|identity| identity.device_type),
        vendor,
        product,
        revision,
        serial,
        name: identity.and_then(|identity| identity.name.clone()),
        tpdo1_type: identity.and_then(|identity| identity.tpdo1_type),
        heartbeat_set_ms: identity.and_then(|identity| identity.heartbeat),
        suspicions: record
            .suspicions
            .iter()
            .map(|suspicion| suspicion.text().to_owned())
            .chain(two_devices(&candidates))
            .collect(),
        mappings: candidates.into_iter().map(found_mapping).collect(),
    }
}

fn found_mapping(candidate: Candidate) -> FoundMapping {
    FoundMapping {
        mapping: candidate.mapping,
        vendor: candidate.device.vendor,
        model: candidate.device.model,
        probable: candidate.fit >= Fit::Probable,
        certain: candidate.fit == Fit::Certain,
    }
}

impl ScanReport {
    /// What stands beside the nodes of a census; the nodes are still to be added.
    #[must_use]
    pub fn of(
        census: &Census,
        interface: &str,
        bit_rate: Option<u32>,
        lost_frames: u64,
        active: bool,
    ) -> Self {
        let nmt = census.nmt.iter();
        Self {
            version: VERSION,
            interface: interface.to_owned(),
            bit_rate,
            active,
            frames: census.frames,
            lost_frames,
            other_master: census.has_master(),
            nodes: Vec::new(),
            nmt: nmt
                .map(|((command, node), count)| FoundNmt { command: *command, node: *node, count: *count })
                .collect(),
            sync: some_traffic(0x080, &census.sync),
            time: some_traffic(0x100, &census.time),
            lss_frames: census.lss,
            unknown: census.unknown.iter().map(|(id, seen)| traffic(*id, seen)).collect(),
            unknown_more: census.unknown_more,
        }
    }

    /// For people.
    #[must_use]
    pub fn table(&self) -> String {
        let mut rows = vec![["node", "state", "what it is", "what was seen"].map(str::to_owned)];
        rows.extend(self.nodes.iter().map(|node| {
            let state = node.state.as_deref().unwrap_or("not told").replace('_', "-");
            [node.id.to_string(), state, what(node), seen(node)]
        }));
        let width = |column: usize| {
            rows.iter()
                .filter_map(|row| row.get(column))
                .map(|cell| cell.chars().count())
                .max()
                .unwrap_or_default()
        };
        let widths = [width(0), width(1), width(2)];
        let mut text = String::new();
        if self.nodes.is_empty() {
            text.push_str("no node was heard\n");
        } else {
            for [node, state, what, seen] in &rows {
                let [a, b, c] = widths;
                // Writing to a String cannot fail.
                let _ = writeln!(text, "{node:>a$}  {state:<b$}  {what:<c$}  {seen}");
            }
        }
        for node in &self.nodes {
            for suspicion in &node.suspicions {
                let _ = writeln!(text, "! two devices may share node id {}: {suspicion}", node.id);
            }
        }
        for line in self.beside() {
            let _ = writeln!(text, "{line}");
        }
        text
    }

    /// What belongs to no node.
    fn beside(&self) -> Vec<String> {
        let mut lines = Vec::new();
        if self.other_master {
            let commands: Vec<String> = self.nmt.iter().map(nmt).collect();
            let commands =
                if commands.is_empty() { "guard requests".to_owned() } else { commands.join(", ") };
            lines.push(format!("another master is at work: {commands}"));
        }
        for (name, seen) in [("SYNC", &self.sync), ("TIME", &self.time)] {
            lines.extend(
                seen.as_ref().map(|seen| format!("{name}: {}, its producer cannot be told", rate(seen))),
            );
        }
        if self.lss_frames > 0 {
            lines.push(format!("LSS: {} frames", self.lss_frames));
        }
        lines.extend(
            self.unknown.iter().map(|seen| format!("unknown identifier {}: {}", seen.id, rate(seen))),
        );
        if self.unknown_more > 0 {
            lines.push(format!("{} frames of more unknown identifiers", self.unknown_more));
        }
        if self.lost_frames > 0 {
            lines.push(format!(
                "{} frames were lost on the way: periods and counts are too low",
                self.lost_frames
            ));
        }
        lines
    }
}

fn nmt(seen: &FoundNmt) -> String {
    let command = match seen.command {
        0x01 => "start".to_owned(),
        0x02 => "stop".to_owned(),
        0x80 => "pre-operational".to_owned(),
        0x81 => "reset node".to_owned(),
        0x82 => "reset communication".to_owned(),
        other => format!("command 0x{other:02X}"),
    };
    let node = if seen.node == 0 { "all".to_owned() } else { format!("node {}", seen.node) };
    format!("{command} {node} ({} times)", seen.count)
}

fn lengths(seen: &FoundTraffic) -> String {
    let lengths: Vec<String> = seen.lengths.iter().map(ToString::to_string).collect();
    lengths.join(" or ")
}

fn rate(seen: &FoundTraffic) -> String {
    let period = seen.period_ms.map_or_else(String::new, |period| format!(", every {period} ms"));
    format!("{} frames of {} bytes{period}", seen.count, lengths(seen))
}

fn what(node: &FoundNode) -> String {
    let mut words = Vec::new();
    if let Some(best) = node.mappings.first() {
        let doubt = if best.probable { "" } else { "perhaps " };
        words.push(format!("{doubt}{} {}", best.vendor, best.model));
        let equal = |other: &FoundMapping| !best.certain && other.probable == best.probable;
        if node.mappings.get(1).is_some_and(equal) {
            words.push(format!("or {} more", node.mappings.len() - 1));
        }
    }
    words.extend(node.name.as_ref().map(|name| format!("\"{name}\"")));
    if node.mappings.is_empty() {
        words.extend(node.device_type.map(|device_type| format!("profile {}", device_type & 0xFFFF)));
    }
    words.extend(node.vendor.map(|vendor| format!("vendor 0x{vendor:X}")));
    words.extend(node.serial.map(|serial| format!("serial {serial}")));
    if !words.is_empty() {
        words.join(", ")
    } else if node.heard {
        "unknown".to_owned()
    } else {
        "not heard itself".to_owned()
    }
}

fn seen(node: &FoundNode) -> String {
    let mut words = Vec::new();
    let period =
        |period: Option<u64>| period.map_or_else(String::new, |period| format!(" every {period} ms"));
    for tpdo in &node.tpdos {
        // The number stands in the hundreds of the identifier: 0x181, 0x281.
        let number = tpdo.id.chars().next().unwrap_or('?');
        words.push(format!("TPDO{number} {} bytes{}", lengths(tpdo), period(tpdo.period_ms)));
    }
    if node.error_control.as_deref() == Some("heartbeat") {
        words.push(format!("heartbeat{}", period(node.heartbeat_ms)));
    } else if node.guard_requests == 0 && node.error_control.is_some() {
        words.push("answers guard requests".to_owned());
    }
    if node.guard_requests > 0 {
        words.push(format!("guarded by another master{}", period(node.guarded_ms)));
    }
    if let Some(kind) = node.tpdo1_type.filter(|kind| *kind <= 240 && node.tpdos.is_empty()) {
        words.push(format!("TPDO1 only after SYNC (transmission type {kind}), once started"));
    }
    if node.heartbeat_set_ms == Some(0) && node.error_control.is_none() {
        words.push("no heartbeat".to_owned());
    }
    if node.boot_ups > 0 {
        words.push(format!("{} boot-up", node.boot_ups));
    }
    for emergency in &node.emergencies {
        words.push(format!("EMCY 0x{:04X} ({} times)", emergency.code, emergency.count));
    }
    if !node.rpdos.is_empty() {
        let ids: Vec<&str> = node.rpdos.iter().map(|rpdo| rpdo.id.as_str()).collect();
        words.push(format!("somebody sends it {}", ids.join(", ")));
    }
    if node.sdo_requests > 0 {
        words.push(format!("{} SDO requests of somebody else", node.sdo_requests));
    } else if node.sdo_answers > 0 {
        words.push("SDO".to_owned());
    }
    words.join(", ")
}
