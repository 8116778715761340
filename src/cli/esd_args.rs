//! What can be typed after `cangate esd`.

use std::time::Duration;

use clap::Args;

use super::esd_job::{Job, Reply};
use crate::can::CanId;
use crate::can::interface::Interface;
use crate::canopen::cob_id::is_predefined;
use crate::esd::{CanBitRate, ModuleNumber, Order, Setting};

/// `cangate esd`
#[derive(Args, Debug)]
pub struct EsdArguments {
    /// What to do.
    #[command(subcommand)]
    pub command: EsdCommand,
}

/// What to do.
#[derive(Debug, clap::Subcommand)]
pub enum EsdCommand {
    /// Find modules that have news: they started, or had a CAN error, and nobody has seen to that.
    Scan {
        /// The bus.
        #[command(flatten)]
        bus: BusOptions,
        /// Where they answer.
        #[command(flatten)]
        reply: ReplyOptions,
        /// Find those without news too: ask each number from 1 to 254, which takes half a minute.
        #[arg(long)]
        all: bool,
    },
    /// Show all that a module tells of itself. Nothing is changed.
    Show {
        /// Which module.
        #[command(flatten)]
        one: OneOptions,
    },
    /// Start a module anew with what it has stored. It is silent for some seconds, and what waits in it is lost.
    Reset {
        /// Which module, or all.
        #[command(flatten)]
        target: TargetOptions,
    },
    /// Start a module anew with default parameters. Needs --yes.
    DefaultReset {
        /// Which module, or all.
        #[command(flatten)]
        target: TargetOptions,
    },
    /// Hold the serial lines of a module: what comes in is kept, nothing is passed on.
    Suspend {
        /// Which module, or all.
        #[command(flatten)]
        target: TargetOptions,
        /// Where it answers.
        #[command(flatten)]
        reply: ReadBackOptions,
    },
    /// Let a module that was suspended go on.
    Continue {
        /// Which module, or all.
        #[command(flatten)]
        target: TargetOptions,
        /// Where it answers.
        #[command(flatten)]
        reply: ReadBackOptions,
    },
    /// Let a module forget the CAN error that it had.
    ClearError {
        /// Which module, or all.
        #[command(flatten)]
        target: TargetOptions,
        /// Where it answers.
        #[command(flatten)]
        reply: ReadBackOptions,
    },
    /// Let a module store its parameters and its number. Needs --yes.
    Store {
        /// Which module.
        #[command(flatten)]
        one: OneOptions,
        /// Yes, overwrite what is stored.
        #[arg(long)]
        yes: bool,
    },
    /// Set the CAN bit rate that a module has once it was stored and the module reset. Needs --yes.
    SetBitRate {
        /// Which module.
        #[command(flatten)]
        one: OneOptions,
        /// In kbit/s: 1000, 800, 666.6, 500, 333.3, 250, 166.6, 125, 100, 66.6, 50, 33.3, 20, 12.5 or 10.
        #[arg(value_name = "KBIT", value_parser = bit_rate)]
        bit_rate: CanBitRate,
        /// Send its index in the table of the manual instead of two registers, for a module that takes it in that form.
        #[arg(long)]
        by_index: bool,
        /// Yes, with a wrong one the module is lost to this bus.
        #[arg(long)]
        yes: bool,
    },
}

/// The bus.
#[derive(Args, Clone, Debug)]
pub struct BusOptions {
    /// The interface, for example `can0`.
    #[arg(short, long)]
    pub interface: Interface,
}

/// Where modules answer.
#[derive(Args, Clone, Copy, Debug)]
pub struct ReplyOptions {
    /// The identifier on which modules answer, 0x6E0 to 0x6FF; nobody else on the bus may use it.
    #[arg(long, value_name = "ID", value_parser = reply_id)]
    pub reply_id: u16,
    /// How long an answer may take, in ms.
    #[arg(long, default_value_t = 100, value_name = "MS", value_parser = clap::value_parser!(u32).range(10..=10_000))]
    pub timeout_ms: u32,
}

impl ReplyOptions {
    fn reply(self) -> Reply {
        Reply { id: self.reply_id, timeout: Duration::from_millis(self.timeout_ms.into()) }
    }
}

/// One module.
#[derive(Args, Clone, Debug)]
pub struct OneOptions {
    /// The bus.
    #[command(flatten)]
    pub bus: BusOptions,
    /// Its number, 1 to 254 or 0x01 to 0xFE: by default the value of its coding switch.
    #[arg(long, value_name = "NUMBER", value_parser = module_number)]
    pub module: ModuleNumber,
    /// Where it answers.
    #[command(flatten)]
    pub reply: ReplyOptions,
}

/// One module, or all.
#[derive(Args, Clone, Debug)]
pub struct TargetOptions {
    /// The bus.
    #[command(flatten)]
    pub bus: BusOptions,
    /// Its number, 1 to 254 or 0x01 to 0xFE: by default the value of its coding switch.
    #[arg(long, value_name = "NUMBER", value_parser = module_number, required_unless_present = "all")]
    pub module: Option<ModuleNumber>,
    /// All modules of the bus. Needs --yes.
    #[arg(long, conflicts_with = "module")]
    pub all: bool,
    /// Yes, it is meant.
    #[arg(long)]
    pub yes: bool,
}

/// Where a module answers when it is asked what came of an order; many that are asked at once cannot be told apart.
#[derive(Args, Clone, Copy, Debug)]
pub struct ReadBackOptions {
    /// The identifier on which the module answers, 0x6E0 to 0x6FF; nobody else on the bus may use it.
    #[arg(long, value_name = "ID", value_parser = reply_id, required_unless_present = "all", conflicts_with = "all")]
    pub reply_id: Option<u16>,
    /// How long an answer may take, in ms.
    #[arg(long, default_value_t = 100, value_name = "MS", value_parser = clap::value_parser!(u32).range(10..=10_000))]
    pub timeout_ms: u32,
}

impl ReadBackOptions {
    fn reply(self) -> Option<Reply> {
        let timeout = Duration::from_millis(self.timeout_ms.into());
        self.reply_id.map(|id| Reply { id, timeout })
    }
}

impl EsdCommand {
    /// Where, and what is to be done.
    ///
    /// # Errors
    /// It must be confirmed (R-ESD-073); the text says why.
    pub(super) fn job(&self) -> Result<(Interface, Job), String> {
        let order = |target: &TargetOptions, order, reply| {
            confirm(
                target.yes || !target.all,
                "it acts on every module of the bus, also on those that you do not think of",
            )?;
            Ok((target.bus.interface.clone(), Job::Order { module: target.module, order, reply }))
        };
        let set = |one: &OneOptions, setting| {
            let (module, reply) = (one.module, one.reply.reply());
            Ok((one.bus.interface.clone(), Job::Set { module, setting, reply }))
        };
        match self {
            Self::Scan { bus, reply, all } => {
                Ok((bus.interface.clone(), Job::Scan { reply: reply.reply(), ask_each: *all }))
            }
            Self::Show { one } => {
                Ok((one.bus.interface.clone(), Job::Show { module: one.module, reply: one.reply.reply() }))
            }
            Self::Reset { target } => order(target, Order::Reset, None),
            Self::DefaultReset { target } => {
                confirm(
                    target.yes,
                    "rates, packing and identifiers of its lines will be those of its coding switch and its maker",
                )?;
                order(target, Order::DefaultReset, None)
            }
            Self::Suspend { target, reply } => order(target, Order::Suspend, reply.reply()),
            Self::Continue { target, reply } => order(target, Order::Continue, reply.reply()),
            Self::ClearError { target, reply } => order(target, Order::ClearCanError, reply.reply()),
            Self::Store { one, yes } => {
                confirm(
                    *yes,
                    "what is stored in it now will be gone, and its coding switch no longer sets its number",
                )?;
                set(one, Setting::Store)
            }
            Self::SetBitRate { one, bit_rate, by_index, yes } => {
                confirm(*yes, "once stored, a wrong bit rate makes it disturb the whole bus")?;
                let form = if *by_index { [0, bit_rate.index] } else { bit_rate.registers };
                set(one, Setting::BitRate(form))
            }
        }
    }
}

fn confirm(yes: bool, why: &str) -> Result<(), String> {
    if yes { Ok(()) } else { Err(format!("{why}; add --yes if it is meant")) }
}

fn number(text: &str) -> Option<u16> {
    let hexadecimal = text.strip_prefix("0x").or_else(|| text.strip_prefix("0X"));
    hexadecimal.map_or_else(|| text.parse().ok(), |digits| u16::from_str_radix(digits, 16).ok())
}

fn module_number(text: &str) -> Result<ModuleNumber, String> {
    let module = number(text).and_then(|number| ModuleNumber::new(u8::try_from(number).ok()?));
    module.ok_or_else(|| {
        format!(
            "`{text}` is no module number: it is 1 to 254, or 0x01 to 0xFE; all modules are called by --all"
        )
    })
}

fn reply_id(text: &str) -> Result<u16, String> {
    let id = number(text).filter(|id| *id <= 0x7FF);
    let id = id.ok_or_else(|| format!("`{text}` is no identifier: it is 0x001 to 0x7FF"))?;
    if is_predefined(CanId::Standard(id)) {
        return Err(format!(
            "an answer on 0x{id:03X} could be taken for a command or a message of a CANopen device; 0x6E0 to 0x6FF are used by none"
        ));
    }
    Ok(id)
}

/// As people write it: `66.6`.
pub(super) fn kbit(rate: CanBitRate) -> String {
    let bits = rate.bits_per_second();
    let tenth = bits % 1000 / 100;
    if tenth == 0 { format!("{}", bits / 1000) } else { format!("{}.{tenth}", bits / 1000) }
}

fn bit_rate(text: &str) -> Result<CanBitRate, String> {
    CanBitRate::all().find(|rate| kbit(*rate) == text).ok_or_else(|| {
        let all: Vec<String> = CanBitRate::all().map(kbit).collect();
        format!("modules do not have `{text}` kbit/s: they have {}", all.join(", "))
    })
}
