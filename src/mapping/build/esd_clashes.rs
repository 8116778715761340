//! Identifiers of esd modules against all others of their bus (R-ESD-022), and coding switches that would be safe.

use std::collections::BTreeSet;
use std::ops::Range;

use super::super::installation::{BusEntry, NodeEntry};
use super::super::table::{BusDef, NodeDef, TagTable};
use super::super::{At, SourceText};
use super::Installation;
use super::network::{NOWHERE, Taken};
use super::problems::Problems;
use crate::can::{BusIndex, CanId};
use crate::canopen::cob_id;
use crate::esd::{ChannelSettings, INIT_ID, ModuleKind, ModuleSettings};

/// Identifiers of layer setting services.
const LSS: [CanId; 2] = [CanId::Standard(0x7E4), CanId::Standard(0x7E5)];
/// Identifiers by which several masters agree on one (CiA 302-2): the values of 0x071 to 0x073 and 0x076.
const FLYING_MASTER: [u16; 4] = [0x071, 0x072, 0x073, 0x076];
/// Coding switches whose identifiers no CANopen device has by default, and which outrank little.
const PREFERRED: std::ops::RangeInclusive<u8> = 0x1A..=0x25;
/// How many of them are proposed.
const PROPOSED: usize = 3;
/// Where a free identifier for answers is looked for: CiA keeps these for nothing that is sent every day.
const FOR_ANSWERS: std::ops::RangeInclusive<u16> = 0x780..=0x7E3;

/// A module, and where the configuration tells of it.
struct Module<'a> {
    name: &'a At<String>,
    entry: &'a NodeEntry,
    settings: &'a ModuleSettings,
}

/// Checks the identifiers of all modules of all buses. Those of CANopen have been claimed before.
pub fn check(problems: &mut Problems, installation: &Installation<'_>, taken: &mut Taken, table: &TagTable) {
    for (index, bus) in table.buses.iter().enumerate() {
        let index = BusIndex(index);
        let of_bus = table.nodes.iter().filter(|node| node.bus == index);
        let modules: Vec<Module<'_>> = of_bus
            .filter_map(|node| module(installation, node))
            .filter(|it| !taken.ignores(it.name))
            .collect();
        let Some((name, entry)) = installation.buses.iter().nth(index.0) else { continue };
        if modules.is_empty() && entry.esd.is_none() {
            continue;
        }
        Work { problems, config: installation.config, taken, index, bus, name, entry, modules: &modules }
            .check();
    }
}

fn module<'a>(installation: &'a Installation<'_>, node: &'a NodeDef) -> Option<Module<'a>> {
    let (name, entry) = installation.nodes.iter().find(|(name, _)| name.value == node.name)?;
    Some(Module { name, entry, settings: node.protocol.module()? })
}

/// The work on one bus.
struct Work<'a> {
    problems: &'a mut Problems,
    config: &'a SourceText,
    taken: &'a mut Taken,
    index: BusIndex,
    bus: &'a BusDef,
    name: &'a At<String>,
    entry: &'a BusEntry,
    modules: &'a [Module<'a>],
}

/// An identifier of a module, and the key that sets it where it does not follow from the coding switch.
struct Own<'a> {
    id: CanId,
    owner: String,
    key: Option<(&'static str, &'a Range<usize>)>,
}

impl Work<'_> {
    fn check(mut self) {
        let bus = &self.bus.name;
        let mut reserved = vec![(cob_id::NMT, format!("NMT commands of bus `{bus}`"))];
        reserved.extend(LSS.map(|id| (id, format!("LSS of bus `{bus}`"))));
        if let Some(own) = &self.bus.own_heartbeat {
            reserved
                .push((cob_id::error_control(own.node), format!("the gateway's heartbeat on bus `{bus}`")));
        }
        let init = format!("the INIT-Id of bus `{bus}`");
        for (id, owner) in reserved {
            // Where a CANopen device has it already, that was told.
            let _ = self.taken.take(self.index, id, &owner, NOWHERE);
        }
        let span = self.entry.esd.as_ref().map_or(&self.name.span, |esd| &esd.span).clone();
        self.claim(
            INIT_ID,
            &init,
            &span,
            "every esd module hears commands there: give the other an identifier of its own",
        );
        self.reply_id();
        for module in self.modules {
            self.module(module);
        }
        for module in self.modules {
            self.switch_identifiers(module);
        }
    }

    /// The identifier of answers must be nobody's.
    fn reply_id(&mut self) {
        let at = self.entry.esd.as_ref().and_then(|esd| esd.value.reply_id.as_ref());
        let (Some(at), Some(id)) = (at, self.bus.esd.reply_id) else { return };
        let (span, modules) = (at.span.clone(), self.modules);
        let used = self.used(None);
        let free = FOR_ANSWERS.filter_map(CanId::standard).find(|id| !used.contains(id));
        let hint = match free {
            Some(free) => {
                format!("modules need an identifier of their own to answer on; 0x{free} is free here")
            }
            None => "modules need an identifier of their own to answer on".to_owned(),
        };
        // Modules come later: without this the other would be blamed.
        let of_module = modules.iter().flat_map(identifiers).find(|own| own.id == id);
        let owner = format!("the reply identifier of bus `{}`", self.bus.name);
        if let Some(own) = of_module {
            let message = format!("{owner} and {} have the same identifier {id}", own.owner);
            self.problems.error(self.config, &span, message, hint);
            return;
        }
        if self.taken.owner(self.index, id).is_none() && cob_id::is_predefined(id) {
            let message = format!(
                "an answer on {owner}, {id}, could be taken for a command or a message of a CANopen device"
            );
            self.problems.error(self.config, &span, message, hint);
            return;
        }
        self.claim(id, &owner, &span, hint);
    }

    /// The first clash of those identifiers that follow from the coding switch, and each of the others.
    fn module(&mut self, module: &Module<'_>) {
        let hint = self.hint(module);
        let own = identifiers(module);
        let flying = own.iter().find(|own| FLYING_MASTER.iter().any(|kept| own.id == CanId::Standard(*kept)));
        if let Some(own) = flying {
            self.warn_of_flying_master(module, own, &hint);
        }
        let mut clashes: Vec<String> = Vec::new();
        for Own { id, owner, key } in own {
            let span = key.map_or(&module.name.span, |(_, span)| span);
            let (line, _) = self.config.position(span.start);
            let Err(other) = self.taken.take(self.index, id, &owner, line) else { continue };
            let message = format!("{owner} and {other} have the same identifier {id}");
            match key {
                Some((key, span)) => {
                    let hint =
                        format!("every identifier has one sender on its bus: give this one another `{key}`");
                    self.problems.error(self.config, span, message, hint);
                }
                None => clashes.push(message),
            }
        }
        let Some(first) = clashes.first() else { return };
        let message = match clashes.len() - 1 {
            0 => first.clone(),
            more => format!("{first}; so it is with {more} more of its identifiers"),
        };
        let span = module.entry.coding_switch.as_ref().map_or(&module.entry.id.span, |at| &at.span);
        self.problems.error(self.config, span, message, hint);
    }

    /// Identifiers of its own are written into a module by commands: before that, and after a reset that lost them, it has
    /// those of its coding switch.
    fn switch_identifiers(&mut self, module: &Module<'_>) {
        let own: BTreeSet<String> = identifiers(module).into_iter().map(|own| own.owner).collect();
        let mut clashes = Vec::new();
        for first in at_first(module) {
            let of_others = self.modules.iter().filter(|other| other.name != module.name).flat_map(at_first);
            let at_first_too =
                of_others.into_iter().find(|other| other.id == first.id).map(|other| other.owner);
            let other = self.taken.owner(self.index, first.id).filter(|owner| !own.contains(*owner));
            let Some(other) = other.map(ToOwned::to_owned).or(at_first_too) else { continue };
            let Own { id, owner, key } = first;
            clashes.push((format!("{owner} and {other} have the same identifier {id}"), key));
        }
        let Some((first, key)) = clashes.first() else { return };
        let management = module.settings.management.as_ref();
        let stored = management.is_some_and(|it| it.configure && it.store);
        let when = if stored { "" } else { ", and after a reset unless stored" };
        let more = match clashes.len() - 1 {
            0 => String::new(),
            more => format!("; so it is with {more} more of its identifiers"),
        };
        let message = format!("until it is configured{when}, {first}{more}");
        let span = key.map_or(&module.name.span, |(_, span)| span);
        let hint = match (self.free_switches(module), stored) {
            (Some(free), _) => format!("set its coding switch to a value that is free here: {free}"),
            (None, true) => "configure it before it is connected to this bus".to_owned(),
            (None, false) => {
                "configure it before it is connected to this bus, and let it store its identifiers \
                 (`save_after_config = true`)"
                    .to_owned()
            }
        };
        self.problems.warning(self.config, span, message, hint);
    }

    fn warn_of_flying_master(&mut self, module: &Module<'_>, own: &Own<'_>, hint: &str) {
        let message = format!(
            "{} has identifier {}, by which CANopen masters agree on one of them (CiA 302-2)",
            own.owner, own.id
        );
        let span = module.entry.coding_switch.as_ref().map_or(&module.entry.id.span, |at| &at.span);
        let span = own.key.map_or(span, |(_, span)| span);
        self.problems.warning(self.config, span, message, hint);
    }

    fn claim(&mut self, id: CanId, owner: &str, span: &Range<usize>, hint: impl Into<String>) {
        let (line, _) = self.config.position(span.start);
        if let Err(other) = self.taken.take(self.index, id, owner, line) {
            let message = format!("{owner} and {other} have the same identifier {id}");
            self.problems.error(self.config, span, message, hint);
        }
    }

    /// All identifiers of the bus, those of one module left out.
    fn used(&self, but: Option<&Module<'_>>) -> BTreeSet<CanId> {
        let others = self.modules.iter().filter(|other| but.is_none_or(|but| but.name != other.name));
        let mut used: BTreeSet<CanId> = self.taken.of_bus(self.index).collect();
        used.extend(
            others.flat_map(|other| identifiers(other).into_iter().chain(at_first(other))).map(|own| own.id),
        );
        used.extend(self.bus.esd.reply_id);
        used.extend(FLYING_MASTER.map(CanId::Standard));
        used
    }

    /// What to do about a module that meets others.
    fn hint(&self, module: &Module<'_>) -> String {
        let own = "a `tx_id` and `rx_id` of their own, and let it store them (`save_after_config`)";
        match self.free_switches(module) {
            None => format!(
                "every identifier has one sender on its bus: no value of the coding switch is free here; give the channels \
                 {own}"
            ),
            Some(free) => format!(
                "every identifier has one sender on its bus: coding switch values that are free here are {free}; or give \
                 its channels {own}"
            ),
        }
    }

    /// Coding switches that would do; `None` where there is none.
    fn free_switches(&self, module: &Module<'_>) -> Option<String> {
        let kind = module.settings.kind;
        let used = self.used(Some(module));
        // A module of another switch has another number as well, as long as no other is stored in it.
        let numbers: BTreeSet<u8> = self
            .modules
            .iter()
            .filter(|other| other.name != module.name)
            .map(|other| other.settings.number.get())
            .collect();
        let safe: Vec<String> = safe_switches(kind, &used)
            .filter(|switch| !numbers.contains(switch))
            .take(PROPOSED)
            .map(|switch| format!("0x{switch:02X}"))
            .collect();
        (!safe.is_empty()).then(|| safe.join(", "))
    }
}

/// The values of the coding switch with which a module meets nobody, the best first.
fn safe_switches(kind: ModuleKind, used: &BTreeSet<CanId>) -> impl Iterator<Item = u8> + '_ {
    let above = *PREFERRED.end() + 1..=kind.highest_switch();
    let below = (1..*PREFERRED.start()).rev();
    PREFERRED.chain(above).chain(below).filter(move |switch| {
        (1..=kind.channels()).all(|channel| {
            kind.identifiers(*switch, channel).is_some_and(|ids| ids.iter().all(|id| !used.contains(id)))
        })
    })
}

/// The identifiers of a module: what its lines send, what they are sent, its watchdog.
fn identifiers<'a>(module: &Module<'a>) -> Vec<Own<'a>> {
    let (name, settings) = (&module.name.value, module.settings);
    let entry_of =
        |channel: &ChannelSettings| module.entry.channel.get(&At::nowhere(channel.number.to_string()));
    let transmit = settings.channels.iter().map(|channel| Own {
        id: channel.tx_id,
        owner: format!("serial channel {} (TxId) of node `{name}`", channel.number),
        key: entry_of(channel).and_then(|entry| entry.tx_id.as_ref()).map(|at| ("tx_id", &at.span)),
    });
    let receive = settings.channels.iter().map(|channel| Own {
        id: channel.rx_id,
        owner: format!("serial channel {} (RxId) of node `{name}`", channel.number),
        key: entry_of(channel).and_then(|entry| entry.rx_id.as_ref()).map(|at| ("rx_id", &at.span)),
    });
    let watchdog = settings.management.as_ref().and_then(|management| management.watchdog);
    let watchdog = watchdog.map(|watchdog| Own {
        id: watchdog.id,
        owner: format!("the watchdog of node `{name}`"),
        key: module.entry.watchdog_id.as_ref().map(|at| ("watchdog_id", &at.span)),
    });
    transmit.chain(receive).chain(watchdog).collect()
}

/// The identifiers of the coding switch that the channels of a module have as long as their own are not written into it.
fn at_first<'a>(module: &Module<'a>) -> Vec<Own<'a>> {
    let at = module.entry.coding_switch.as_ref().unwrap_or(&module.entry.id);
    // That a switch gives no identifiers was told.
    let Ok(switch) = u8::try_from(at.value) else { return Vec::new() };
    let mut first = Vec::new();
    let all = identifiers(module);
    for channel in &module.settings.channels {
        let of_switch = module.settings.kind.identifiers(switch, channel.number);
        let now = [channel.tx_id, channel.rx_id];
        for (id, now) in of_switch.into_iter().flatten().zip(now).filter(|(id, now)| id != now) {
            let Some(own) = all.iter().find(|own| own.id == now) else { continue };
            first.push(Own { id, owner: own.owner.clone(), key: own.key });
        }
    }
    first
}
