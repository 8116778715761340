//! What a reload changes: two installations side by side. Pure.

use std::path::Path;

use super::certificates;
use super::listeners::Listener;
use super::wiring::Installation;
use crate::can::BusIndex;
use crate::gateway::kept::Kept;
use crate::mapping::{LineDef, TagTable};
use crate::modbus::{MapFormat, ModbusSettings, map_text};
use crate::mqtt::MqttSettings;
use crate::mqtt::client::has_same_session;
use crate::process_image::{LineIndex, NodeIndex};

/// What becomes of a part.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Change {
    /// It does not notice.
    #[default]
    None,
    /// It goes on with what is new.
    Exchange,
    /// It ends in good order, where it runs, and begins again, where it is to.
    Anew,
}

/// What is to be done to go from one installation to another.
#[derive(Clone, Debug, Default)]
pub struct Plan {
    /// For people, one change each; empty where nothing changes.
    pub lines: Vec<String>,
    /// Addresses or topics that were published change their meaning: who reads them would be wrong.
    pub map_breaks: Vec<String>,
    /// The core goes on with another table; what stays.
    pub core: Option<Kept>,
    /// Others may ask for something, or for something else.
    pub access: bool,
    /// What Modbus and HTTP show is made anew; their sessions stay.
    pub shown: bool,
    /// Modbus TCP closes its connections and listens anew.
    pub modbus: bool,
    /// The same for Modbus/TCP Security.
    pub security: bool,
    /// Serial lines that speak Modbus are opened anew.
    pub rtu: bool,
    /// HTTP listens anew.
    pub http: bool,
    /// CiA 309-3 closes its connections and begins anew.
    pub cia309: bool,
    /// The TCP ports of serial lines close their connections and begin anew.
    pub serial: bool,
    /// The session with the broker.
    pub mqtt: Change,
    /// That of Sparkplug.
    pub sparkplug: Change,
    /// Other certificates are to be watched.
    pub certificates: bool,
}

impl Plan {
    /// Compares what runs with what is to run.
    #[must_use]
    pub fn new(old: &Installation, new: &Installation) -> Self {
        let same_interface =
            |from: BusIndex, to: BusIndex| old.interfaces.get(from.0) == new.interfaces.get(to.0);
        let core = (old.table != new.table || old.interfaces != new.interfaces)
            .then(|| Kept::new(&old.table, &new.table, same_interface));
        let other_map = old.map.hash() != new.map.hash();
        let shown = core.is_some() || other_map;
        let access = old.access != new.access;
        let limits = limits_differ(&old.modbus, &new.modbus);
        let mut plan = Self {
            shown: shown || old.modbus != new.modbus,
            access,
            modbus: limits || old.modbus.listen != new.modbus.listen,
            security: old.modbus.security != new.modbus.security
                || (limits && !(old.modbus.security.is_off() && new.modbus.security.is_off())),
            rtu: old.modbus.rtu != new.modbus.rtu,
            http: old.http != new.http || old.table.gateway != new.table.gateway,
            cia309: (core.is_some() && (old.cia309.listen.is_some() || new.cia309.listen.is_some()))
                || old.cia309 != new.cia309,
            serial: core.is_some() && has_ports(&old.table, &new.table),
            mqtt: mqtt(old, new, shown || has_requests(old) != has_requests(new)),
            sparkplug: sparkplug(old, new, shown),
            certificates: certificates::watched(old) != certificates::watched(new),
            core,
            ..Self::default()
        };
        plan.tell_buses_and_nodes(old, new);
        plan.compare_maps(old, new);
        plan.tell_doors(old, new);
        plan.tell_sessions(old, new);
        plan
    }

    /// Whether there is anything to do.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        let doors = self.modbus || self.security || self.rtu || self.http || self.cia309 || self.serial;
        let sessions = self.mqtt != Change::None || self.sparkplug != Change::None;
        self.core.is_none() && !(doors || sessions || self.shown || self.access || self.certificates)
    }

    /// Whether a listener ends, where it runs, and begins again, where it is to. One that does not keeps its addresses.
    #[must_use]
    pub fn begins_anew(&self, listener: Listener) -> bool {
        match listener {
            Listener::Modbus => self.modbus,
            Listener::Security => self.security,
            Listener::Http => self.http,
            Listener::Cia309 => self.cia309,
            Listener::Serial => self.serial,
        }
    }

    /// Listeners that were lost listen again, whether their settings changed or not.
    pub fn listen_again(&mut self, lost: impl IntoIterator<Item = Listener>) {
        for listener in lost {
            let (begins, what) = match listener {
                Listener::Modbus => (&mut self.modbus, "Modbus"),
                Listener::Security => (&mut self.security, "Modbus/TCP Security"),
                Listener::Http => (&mut self.http, "HTTP"),
                Listener::Cia309 => (&mut self.cia309, "CiA 309-3"),
                Listener::Serial => (&mut self.serial, "serial lines"),
            };
            *begins = true;
            self.lines.push(format!("{what}: was lost when its address was taken; tried again"));
        }
    }

    /// For each node of the new installation its place in the old one, where it goes on as it is.
    #[must_use]
    pub fn kept_nodes(&self, new: &Installation) -> Vec<Option<NodeIndex>> {
        match &self.core {
            Some(kept) => kept.nodes.clone(),
            None => (0..new.table.nodes.len()).map(|node| Some(NodeIndex(node))).collect(),
        }
    }

    /// The same for serial lines.
    #[must_use]
    pub fn kept_lines(&self, new: &Installation) -> Vec<Option<LineIndex>> {
        match &self.core {
            Some(kept) => kept.lines.clone(),
            None => (0..new.table.lines.len()).map(|line| Some(LineIndex(line))).collect(),
        }
    }

    fn tell_doors(&mut self, old: &Installation, new: &Installation) {
        let stays = old.modbus != new.modbus && !(self.modbus || self.security || self.rtu);
        for (changes, what) in [
            (self.access, "[access]: who may ask for what changed; it holds from now on"),
            (
                self.modbus,
                "Modbus: addresses or limits of [modbus] changed; connections are closed and it listens anew",
            ),
            (stays, "Modbus: [modbus] changed; connections stay"),
            (self.security, "Modbus/TCP Security: connections are closed and it listens anew"),
            (self.rtu, "Modbus RTU: serial lines are opened anew"),
            (self.http, "HTTP: [http] or the name of the gateway changed; it listens anew"),
            (self.cia309, "CiA 309-3: connections are closed and it begins anew"),
            (self.serial, "serial lines: connections to their TCP ports are closed and they listen anew"),
        ] {
            self.lines.extend(changes.then(|| what.to_owned()));
        }
    }

    fn tell_sessions(&mut self, old: &Installation, new: &Installation) {
        let pair = old.mqtt.as_ref().zip(new.mqtt.as_ref());
        let same_name = old.table.gateway == new.table.gateway;
        let is_same = pair.is_some_and(|(old, new)| same_name && has_same_session(old, new));
        let what = match (self.mqtt, &old.mqtt, &new.mqtt) {
            (Change::None, _, _) => None,
            (_, None, _) => Some("MQTT: a session with the broker begins"),
            (_, Some(_), None) => Some("MQTT: the session with the broker ends"),
            (Change::Exchange, _, _) if is_same => Some("MQTT: the session goes on; everything is told anew"),
            (Change::Exchange | Change::Anew, _, _) => Some("MQTT: the session ends and another one begins"),
        };
        self.lines.extend(what.map(str::to_owned));
        let what = match self.sparkplug {
            Change::None => None,
            Change::Exchange if is_same => Some("Sparkplug: everything is born anew"),
            Change::Exchange | Change::Anew => Some("Sparkplug: its session ends, or another one begins"),
        };
        self.lines.extend(what.map(str::to_owned));
    }

    fn tell_buses_and_nodes(&mut self, old: &Installation, new: &Installation) {
        let Some(kept) = &self.core else { return };
        let (before, after) = (&old.table, &new.table);
        for (bus, from) in after.buses.iter().zip(&kept.buses) {
            let known = before.buses.iter().any(|each| each.name == bus.name);
            if from.is_none() {
                let what = if known {
                    "interface or role changed: it is opened anew, and its nodes begin anew"
                } else {
                    "new"
                };
                self.lines.push(format!("bus {}: {what}", bus.name));
            } else if from.and_then(|from| before.buses.get(from.0)) != Some(bus) {
                self.lines.push(format!("bus {}: settings changed; its nodes go on", bus.name));
            }
        }
        let gone = before.buses.iter().filter(|bus| after.buses.iter().all(|each| each.name != bus.name));
        self.lines.extend(gone.map(|bus| format!("bus {}: removed", bus.name)));
        for (node, from) in after.nodes.iter().zip(&kept.nodes) {
            match (from, before.find_node(&node.name)) {
                (Some(_), _) => {}
                (None, Some(_)) => self.lines.push(format!("node {}: changed; it begins anew", node.name)),
                (None, None) => self.lines.push(format!("node {}: new", node.name)),
            }
        }
        let gone = before.nodes.iter().filter(|node| after.find_node(&node.name).is_none());
        self.lines
            .extend(gone.map(|node| format!("node {}: removed; nothing is sent to it any more", node.name)));
        let stay = kept.nodes.iter().flatten().count();
        if stay < after.nodes.len() || after.nodes.len() != before.nodes.len() {
            self.lines.push(format!("{stay} of {} nodes go on as they are", after.nodes.len()));
        } else if before != after {
            self.lines.push("how nodes are shown changes; all go on as they are".to_owned());
        }
    }

    fn compare_maps(&mut self, old: &Installation, new: &Installation) {
        let text = |installation: &Installation| map_text::render(&installation.map, MapFormat::Json);
        match map_text::diff(&text(old), &text(new)) {
            Ok(diff) => {
                if diff.breaking {
                    self.map_breaks.clone_from(&diff.lines);
                }
                self.lines.extend(diff.lines.into_iter().map(|line| format!("map: {line}")));
            }
            // Both are our own; were one not readable, nobody could say that nothing moves.
            Err(error) => self.map_breaks.push(error.to_string()),
        }
    }
}

/// Whether requests that come through the broker are read.
fn has_requests(installation: &Installation) -> bool {
    installation.access.of_broker().is_some()
}

/// What becomes of the session with the broker. `shown`: what it tells is another thing.
fn mqtt(old: &Installation, new: &Installation, shown: bool) -> Change {
    match (&old.mqtt, &new.mqtt) {
        (None, None) => Change::None,
        (Some(before), Some(now)) => {
            if store(before, &old.table.gateway) != store(now, &new.table.gateway) {
                Change::Anew
            } else if before != now || shown {
                Change::Exchange
            } else {
                Change::None
            }
        }
        (Some(_), None) | (None, Some(_)) => Change::Anew,
    }
}

fn sparkplug(old: &Installation, new: &Installation, shown: bool) -> Change {
    let of = |installation: &Installation| installation.mqtt.clone().filter(|mqtt| mqtt.sparkplug.enabled);
    match (of(old), of(new)) {
        (None, None) => Change::None,
        (Some(before), Some(now)) if before == now && !shown => Change::None,
        (Some(_), Some(_)) => Change::Exchange,
        (Some(_), None) | (None, Some(_)) => Change::Anew,
    }
}

/// What makes the store on disk another one; `None` where the configuration wants none.
#[derive(Debug, PartialEq, Eq)]
struct StoreOf<'a> {
    folder: Option<&'a Path>,
    /// Part of the folder's name, where none is given.
    gateway: &'a str,
    bytes: u64,
    age_h: Option<u32>,
    sync: crate::store::Sync,
}

fn store<'a>(settings: &'a MqttSettings, gateway: &'a str) -> Option<StoreOf<'a>> {
    let folder = settings.buffer_dir.as_deref();
    let is_wanted = folder.is_none_or(|folder| !folder.as_os_str().is_empty());
    is_wanted.then_some(StoreOf {
        folder,
        gateway: if folder.is_none() { gateway } else { "" },
        bytes: settings.buffer_bytes,
        age_h: settings.buffer_age_h,
        sync: settings.buffer_sync,
    })
}

/// Whether others may come, or not as many. All else of `[modbus]`, addresses apart, is taken in while connections go on.
fn limits_differ(old: &ModbusSettings, new: &ModbusSettings) -> bool {
    let of = |settings: &ModbusSettings| {
        (
            settings.max_connections,
            settings.max_connections_per_client,
            settings.allow.clone(),
            settings.reserved.clone(),
        )
    };
    of(old) != of(new)
}

fn has_ports(old: &TagTable, new: &TagTable) -> bool {
    let has = |line: &LineDef| line.tcp.is_some();
    old.lines.iter().chain(&new.lines).any(has)
}
