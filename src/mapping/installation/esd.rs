//! What the configuration says of esd modules and their serial lines.

use schemars::JsonSchema;
use serde::Deserialize;

use super::super::At;
use super::super::table::LineEncoding;
use crate::esd::{FlowControl, MinChar, Parity, WatchdogMode};

/// `[bus.NAME.esd]`: modules of esd on a bus.
#[derive(Clone, Debug, Default, PartialEq, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct EsdEntry {
    /// The identifier on which modules answer requests, 0x001..=0x7FF; nobody else may use it (R-ESD-055). Without it no
    /// module of the bus is managed.
    pub reply_id: Option<At<u64>>,
    /// How long an answer may take, 1..=10000 ms (R-ESD-053). Default: 100.
    pub reply_timeout_ms: Option<At<u64>>,
    /// How often a request without an answer is repeated, 0..=10 (R-ESD-053). Default: 2.
    pub repetitions: Option<At<u64>>,
    /// Which of `max_char` and `min_char` stands in the high half of their byte in these modules (R-ESD-092). Default: `max_char`.
    pub high_half: Option<HighHalfWord>,
    /// Stop bits of a line whose stop bit field is set in these modules, 1 or 2 (R-ESD-099). Default: 2.
    pub stop_bit_set: Option<At<u64>>,
}

/// `high_half`.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum HighHalfWord {
    /// As public copies of the manual say.
    MaxChar,
    /// The other way round.
    MinChar,
}

/// `[node.NAME.channel.NUMBER]`: a serial line of a module that is used.
#[derive(Clone, Debug, Default, PartialEq, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct ChannelEntry {
    /// One sentence.
    #[serde(default)]
    pub description: String,
    /// Identifier of what comes in on the line, 0x001..=0x7FF. Default: as the coding switch says (R-ESD-014).
    pub tx_id: Option<At<u64>>,
    /// Identifier of what is to go out on the line, 0x001..=0x7FF. Default: as the coding switch says (R-ESD-014).
    pub rx_id: Option<At<u64>>,
    /// Bit rate of the line in bit/s, both ways (R-ESD-096).
    pub baud: Option<At<u64>>,
    /// Bit rate from the line to the module, where the two differ.
    pub receive_baud: Option<At<u64>>,
    /// Bit rate from the module to the line, where the two differ.
    pub transmit_baud: Option<At<u64>>,
    /// Bits of a character, 5..=8 (R-ESD-102).
    pub data_bits: Option<At<u64>>,
    /// Parity (R-ESD-100).
    pub parity: Option<At<ParityWord>>,
    /// Stop bits, 1 or 2 (R-ESD-099).
    pub stop_bits: Option<At<u64>>,
    /// The module waits for CTS before it sends to the line (R-ESD-098).
    pub cts: Option<At<bool>>,
    /// The RTS bit of the module (R-ESD-097).
    pub rts: Option<At<bool>>,
    /// A frame is sent as soon as so many characters came in, 1..=8 (R-ESD-026).
    pub min_char: Option<At<u64>>,
    /// A frame is sent when this character came in, instead of `min_char` (R-ESD-093).
    pub end_mark: Option<At<EndMarkWord>>,
    /// Most characters of a frame, 1..=8 (R-ESD-026).
    pub max_char: Option<At<u64>>,
    /// At least so long between two frames, 0..=255 ms (R-ESD-028).
    pub inhibit_ms: Option<At<u64>>,
    /// Time between two frames to the line, 0..=60000 ms. Default: as long as the line needs for their bytes (R-ESD-037).
    pub tx_gap_ms: Option<At<u64>>,
    /// Whether the device on the line can hold up what is sent to it. Default: none.
    #[serde(default)]
    pub flow_control: FlowControlWord,
    /// What ends a message and is no part of it, at most 8 ASCII characters; empty: nothing. Default: CR and LF.
    pub delimiter: Option<At<String>>,
    /// A message is at most so long, 1..=1024 bytes. Default: 256.
    pub max_message: Option<At<u64>>,
    /// A message ends when nothing came for so long, 1..=60000 ms; 0 = it does not. Default: 100.
    pub idle_ms: Option<At<u64>>,
    /// Address and port of a TCP server that offers the line. Default: none.
    pub listen: Option<At<String>>,
    /// Who may connect: addresses or ranges such as `10.0.0.0/8`. Default: everybody who can reach the address.
    pub allow: Option<At<Vec<At<String>>>>,
    /// Connections at the same time, 1..=64. Default: 8.
    pub max_connections: Option<At<u64>>,
    /// Whether what TCP clients send goes out on the line. Default: true.
    pub write: Option<At<bool>>,
    /// Publish its messages by MQTT. Default: true.
    pub mqtt: Option<bool>,
    /// How they are written there. Default: text.
    #[serde(default)]
    pub encoding: EncodingOfLineWord,
    /// Send to the line what comes on its command topic. Default: false.
    #[serde(default)]
    pub mqtt_write: At<bool>,
    /// Address of the register from which on its last message stands, its length in bytes first. Default: none.
    pub text_register: Option<At<u64>>,
    /// Registers of its text, 1..=64, two bytes in each. Default: 32.
    pub text_length: Option<At<u64>>,
}

/// `parity`.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum ParityWord {
    /// No parity bit.
    None,
    /// Even.
    Even,
    /// Odd.
    Odd,
}

impl From<ParityWord> for Parity {
    fn from(word: ParityWord) -> Self {
        match word {
            ParityWord::None => Self::None,
            ParityWord::Even => Self::Even,
            ParityWord::Odd => Self::Odd,
        }
    }
}

/// `end_mark`: the character that makes a module send what came in.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum EndMarkWord {
    /// Carriage return, which is sent.
    Cr,
    /// Line feed, which is sent.
    Lf,
    /// Carriage return, which is not sent.
    CrDropped,
    /// Line feed, which is not sent.
    LfDropped,
    /// Carriage return; neither it nor line feeds are sent.
    CrDropsBoth,
    /// Line feed; neither it nor carriage returns are sent.
    LfDropsBoth,
}

impl EndMarkWord {
    /// Whether the end mark itself does not arrive.
    #[must_use]
    pub fn is_dropped(self) -> bool {
        !matches!(self, Self::Cr | Self::Lf)
    }
}

impl From<EndMarkWord> for MinChar {
    fn from(word: EndMarkWord) -> Self {
        match word {
            EndMarkWord::Cr => Self::Cr,
            EndMarkWord::Lf => Self::Lf,
            EndMarkWord::CrDropped => Self::CrDropped,
            EndMarkWord::LfDropped => Self::LfDropped,
            EndMarkWord::CrDropsBoth => Self::CrDropsBoth,
            EndMarkWord::LfDropsBoth => Self::LfDropsBoth,
        }
    }
}

/// `flow_control`.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum FlowControlWord {
    /// It cannot, or by CTS, which the module sees to.
    #[default]
    None,
    /// By XOFF until XON; the two are no data then.
    XonXoff,
}

impl From<FlowControlWord> for FlowControl {
    fn from(word: FlowControlWord) -> Self {
        match word {
            FlowControlWord::None => Self::None,
            FlowControlWord::XonXoff => Self::XonXoff,
        }
    }
}

/// How bytes of a line are written into text.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum EncodingOfLineWord {
    /// As text; a message that is none is written as Base64.
    #[default]
    Text,
    /// As Base64.
    Base64,
}

impl From<EncodingOfLineWord> for LineEncoding {
    fn from(word: EncodingOfLineWord) -> Self {
        match word {
            EncodingOfLineWord::Text => Self::Text,
            EncodingOfLineWord::Base64 => Self::Base64,
        }
    }
}

/// `watchdog_by`.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum WatchdogWord {
    /// By remote frame.
    #[default]
    Remote,
    /// By a command on the INIT-Id.
    Command,
}

impl From<WatchdogWord> for WatchdogMode {
    fn from(word: WatchdogWord) -> Self {
        match word {
            WatchdogWord::Remote => Self::Remote,
            WatchdogWord::Command => Self::Command,
        }
    }
}
