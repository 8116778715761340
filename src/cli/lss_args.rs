//! What can be typed after `cangate lss`.

use std::time::Duration;

use clap::Args;

use super::lss::WHICH;
use super::lss_job::LssTask;
use super::tool_args::node_id;
use crate::can::interface::Interface;
use crate::canopen::NodeId;
use crate::canopen::lss::{
    LssActivation, LssAddress, LssBitRate, LssChange, LssError, LssJob, LssRange, LssTarget,
};

/// `cangate lss`
#[derive(Args, Debug)]
pub struct LssArguments {
    /// The interface, for example `can0`.
    #[arg(short, long)]
    pub interface: Interface,
    /// What to do.
    #[command(subcommand)]
    pub command: LssCommand,
}

/// What to do.
#[derive(Debug, clap::Subcommand)]
pub enum LssCommand {
    /// Find a device without node id, or with --vendor and --product all devices of that kind.
    Scan {
        /// What is known of the address.
        #[command(flatten)]
        known: AddressOptions,
    },
    /// Ask a device for its address and node id.
    Inquire {
        /// Which device.
        #[command(flatten)]
        address: AddressOptions,
        /// It is confirmed that there is one LSS device on the bus.
        #[arg(long)]
        only_one_device: bool,
    },
    /// Give a device another node id: heartbeat off, NMT stop, configure, store, activate, states as before.
    SetNodeId {
        /// Which device, and how.
        #[command(flatten)]
        change: ChangeOptions,
        /// The new node id.
        #[arg(long, value_name = "NEW", value_parser = node_id)]
        to: NodeId,
        /// Another bit rate as well, in kbit/s.
        #[arg(long, value_name = "KBIT", value_parser = bit_rate)]
        bit_rate: Option<LssBitRate>,
    },
    /// Give a device another bit rate, which it uses when it is switched off and on.
    SetBitRate {
        /// Which device, and how.
        #[command(flatten)]
        change: ChangeOptions,
        /// The bit rate in kbit/s: 1000, 800, 500, 250, 125, 50, 20 or 10.
        #[arg(long, value_name = "KBIT", value_parser = bit_rate)]
        bit_rate: LssBitRate,
    },
    /// Tell all devices to leave LSS configuration state.
    SwitchWaiting,
}

/// The address of a device, its identity object 0x1018; decimal, or hexadecimal with 0x.
#[derive(Args, Clone, Copy, Debug, Default)]
pub struct AddressOptions {
    /// Vendor id, 0x1018:1.
    #[arg(long, value_parser = number)]
    pub vendor: Option<u32>,
    /// Product code, 0x1018:2.
    #[arg(long, value_parser = number)]
    pub product: Option<u32>,
    /// Revision number, 0x1018:3.
    #[arg(long, value_parser = number)]
    pub revision: Option<u32>,
    /// Serial number, 0x1018:4.
    #[arg(long, value_parser = number)]
    pub serial: Option<u32>,
}

impl AddressOptions {
    /// Whether none of it was said.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        [self.vendor, self.product, self.revision, self.serial].iter().all(Option::is_none)
    }

    /// The address, where all of it was said; `None` where nothing was.
    pub fn address(&self) -> Result<Option<LssAddress>, String> {
        match (self.vendor, self.product, self.revision, self.serial) {
            (None, None, None, None) => Ok(None),
            (Some(vendor), Some(product), Some(revision), Some(serial)) => {
                Ok(Some(LssAddress { vendor, product, revision, serial }))
            }
            _ => Err("an address has four parts: --vendor, --product, --revision and --serial".to_owned()),
        }
    }

    /// All addresses of a vendor's product, narrowed by what else was said.
    #[must_use]
    pub fn range(&self) -> Option<LssRange> {
        let all = |part: Option<u32>| part.map_or((0, u32::MAX), |part| (part, part));
        let (vendor, product) = self.vendor.zip(self.product)?;
        Some(LssRange { vendor, product, revision: all(self.revision), serial: all(self.serial) })
    }
}

/// Which device is changed, and how.
#[derive(Args, Clone, Copy, Debug)]
pub struct ChangeOptions {
    /// Its present node id. Unless its address is given, its identity is read there by SDO, and only the device of that
    /// address obeys. Without it ALL nodes of the bus are stopped while it goes on.
    #[arg(long, value_name = "OLD", value_parser = node_id)]
    pub node: Option<NodeId>,
    /// Its address.
    #[command(flatten)]
    pub address: AddressOptions,
    /// It is confirmed that there is one LSS device on the bus: all that are there would obey.
    #[arg(long, conflicts_with_all = ["vendor", "product", "revision", "serial"])]
    pub only_one_device: bool,
    /// Stop all nodes of the bus while it goes on, not only this one.
    #[arg(long)]
    pub stop_all: bool,
}

impl ChangeOptions {
    /// The change. A new bit rate takes effect when the device is switched off and on: no device can be reached at two bit
    /// rates at once.
    pub(super) fn task(
        &self,
        node_id: Option<NodeId>,
        bit_rate: Option<LssBitRate>,
    ) -> Result<LssTask, String> {
        let activation = match bit_rate {
            Some(_) => LssActivation::PowerCycle,
            None => LssActivation::Now { delay: Duration::ZERO },
        };
        let target = match self.address.address()? {
            Some(address) => LssTarget::Address(address),
            None => LssTarget::OnlySlave { confirmed: self.only_one_device },
        };
        let (node, stop_all) = (self.node, self.stop_all);
        let change = LssChange { target, node, stop_all, node_id, bit_rate, activation };
        let task = match (target, self.node) {
            (LssTarget::OnlySlave { confirmed: false }, None) => {
                return Err(format!(
                    "{}{WHICH}, or --node, where its identity is read",
                    LssError::NotConfirmed
                ));
            }
            (LssTarget::OnlySlave { confirmed: false }, Some(node)) => LssTask::of_node(change, node),
            (LssTarget::OnlySlave { confirmed: true } | LssTarget::Address(_), _) => {
                LssTask::new(vec![LssJob::Change(change)])
            }
        };
        Ok(task)
    }
}

fn number(text: &str) -> Result<u32, String> {
    let hexadecimal = text.strip_prefix("0x").or_else(|| text.strip_prefix("0X"));
    let number = hexadecimal.map_or_else(|| text.parse().ok(), |digits| u32::from_str_radix(digits, 16).ok());
    number.ok_or_else(|| format!("`{text}` is no number of 32 bits: write 573 or 0x23D"))
}

fn bit_rate(text: &str) -> Result<LssBitRate, String> {
    let rate = text.parse().ok().and_then(LssBitRate::from_kbit);
    rate.ok_or_else(|| {
        format!("`{text}` is no bit rate of CiA 305: it is 1000, 800, 500, 250, 125, 50, 20 or 10 kbit/s")
    })
}
