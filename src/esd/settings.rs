//! What a network and its modules are to do. Plain data; checked by whoever reads it from a file.

use std::time::Duration;

use super::identifiers::{ModuleKind, ModuleNumber};
use super::parameters::{CanTxMode, SerialBits, SerialMode};
use crate::can::CanId;

/// The modules of one bus.
#[derive(Clone, Debug, PartialEq)]
pub struct NetworkSettings {
    /// Send nothing at all: what modules send is taken, nothing is sent to their lines, and none is managed.
    pub passive: bool,
    /// The identifier on which modules answer requests (`CTxId`, R-ESD-055). Without one no module is managed.
    pub reply_id: Option<CanId>,
    /// How long an answer may take, 1..=10000 ms (R-ESD-053).
    pub reply_timeout: Duration,
    /// How often a request without an answer is repeated (R-ESD-053).
    pub repetitions: u8,
    /// Bit rate of the bus in bit/s: what is sent to serial lines takes a part of it only, so that others keep theirs.
    pub bit_rate: u32,
    /// The modules; no identifier twice. Of two equal ones the first counts.
    pub modules: Vec<ModuleSettings>,
}

impl Default for NetworkSettings {
    fn default() -> Self {
        Self {
            passive: false,
            reply_id: None,
            reply_timeout: Duration::from_millis(100),
            repetitions: 2,
            bit_rate: 125_000,
            modules: Vec::new(),
        }
    }
}

/// One module.
#[derive(Clone, Debug, PartialEq)]
pub struct ModuleSettings {
    /// The number that it listens to.
    pub number: ModuleNumber,
    /// Its kind.
    pub kind: ModuleKind,
    /// What is done with it by commands; `None`: only its data frames are exchanged.
    pub management: Option<ManagementSettings>,
    /// Its serial lines, in the order of their numbers; those that are left out are not used.
    pub channels: Vec<ChannelSettings>,
}

/// How a module is managed.
#[derive(Clone, Debug, PartialEq)]
pub struct ManagementSettings {
    /// What its coding switch is to say; another is told of as [`NotConfigured`](super::ModuleEvent::NotConfigured). `None`:
    /// not asked for.
    pub switch: Option<u8>,
    /// A module that tells the type of another is left alone. Off: it is managed all the same, as the codes of the types are
    /// derived and not proved (R-ESD-058).
    pub check_kind: bool,
    /// Identifiers and parameters are compared with what is wanted, and written where they differ (compare first).
    /// Off: they are only compared.
    pub configure: bool,
    /// Store the parameters in the module after something was written. Off unless asked for: the memory wears out, and to
    /// store is an operator's decision (R-ESD-073).
    pub store: bool,
    /// First Tx activate delay that it is to have; `None`: whatever it has (R-ESD-090).
    pub first_tx_delay: Option<Duration>,
    /// In its CAN Tx mode `MinChar` stands in the high half of its byte, and `MaxChar` in the low one: which it is, only
    /// public copies of the manual say (R-ESD-092).
    pub min_char_high: bool,
    /// How often its status is asked for.
    pub status_period: Duration,
    /// Its watchdog; `None`: off, and its life is told by the answers to status requests.
    pub watchdog: Option<WatchdogSettings>,
    /// A module that showed nothing at all for so long since the bus came up is reported. It may be silent for its first Tx
    /// activate delay (R-ESD-033).
    pub never_seen_after: Duration,
}

/// The watchdog of a module (R-ESD-081..089): it resets itself when it is not asked in time. So where it is used, a
/// gateway that stops without saying so resets the module.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct WatchdogSettings {
    /// Identifier of requests and replies (`WTxId`).
    pub id: CanId,
    /// Time between two requests (`WDtime`), 20..=65535 ms.
    pub time: Duration,
    /// After so many times this without a request the module resets itself, 1..=255. The gateway calls the module lost
    /// after as many replies that did not come.
    pub factor: u8,
    /// How it is asked.
    pub mode: WatchdogMode,
}

/// How the watchdog of a module is triggered (R-ESD-087).
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum WatchdogMode {
    /// By a remote frame on its identifier.
    #[default]
    Remote,
    /// By a supervisor command on the INIT-Id, for buses that carry no remote frames.
    Command,
}

/// A serial line.
#[derive(Clone, Debug, PartialEq)]
pub struct ChannelSettings {
    /// Its number, 1..=5.
    pub number: u8,
    /// Identifier of what comes in on the line (`TxId`: the module transmits).
    pub tx_id: CanId,
    /// Identifier of what is to go out on the line (`RxId`: the module receives).
    pub rx_id: CanId,
    /// How the module is to pack what comes in; `None`: whatever it has.
    pub can_tx_mode: Option<CanTxMode>,
    /// Rates and format of the line that the module is to have; `None`: whatever it has.
    pub serial_mode: Option<SerialMode>,
    /// What of `serial_mode` is asked for: the other bits stay as the module has them (R-ESD-099).
    pub serial_bits: SerialBits,
    /// Stop bits of a line whose stop bit field is set, 1 or 2; cleared, it has the other number. Which it is, the manual does
    /// not tell (R-ESD-099).
    pub stop_bit_set: u8,
    /// Shortest time between two frames to the line, beside the pace of the line, which is kept always (R-ESD-037).
    pub gap: Option<Duration>,
    /// How long the line needs for one byte to go out: what the pace follows from until the module tells what it has. It is that
    /// of [`serial_mode`](Self::serial_mode), or of the default of the module.
    pub byte_time: Duration,
    /// Whether the other end of the line can hold up what is sent to it.
    pub flow_control: FlowControl,
    /// What makes a message of the bytes that come in.
    pub framing: Framing,
}

/// Whether the other end of a line can hold up what is sent to it.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum FlowControl {
    /// It cannot, or by CTS, which the module sees to and nobody hears of.
    #[default]
    None,
    /// By XOFF (0x13) until XON (0x11), which are no data then. After a minute without XON what waits is given up, and the
    /// line is tried again with what comes next. Up to 16 bytes may be on their way
    /// when XOFF comes.
    XonXoff,
}

/// What makes a message of the bytes that come in on a line (R-ESD-034): an end mark, or as many bytes, or a pause,
/// whichever comes first.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Framing {
    /// The bytes that end a message and are no part of it; empty: none. At most 8.
    pub delimiter: Vec<u8>,
    /// A message is at most so long, 1..=1024 bytes.
    pub longest: usize,
    /// A message ends when nothing came for so long; `None`: it does not.
    pub idle: Option<Duration>,
}
