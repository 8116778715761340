//! What a mapping says of an esd module for serial lines, which speaks no CANopen.

use schemars::JsonSchema;
use serde::Deserialize;

use super::super::At;
use crate::esd::ModuleKind;

/// `[esd]`: the device is a module of esd that carries serial lines over CAN.
#[derive(Clone, Debug, PartialEq, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct EsdSection {
    /// Which one.
    pub module: At<ModuleKindWord>,
}

/// A kind of module.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum ModuleKindWord {
    /// CAN-CBM-SIO1: one serial line.
    Sio1,
    /// CAN-CBM-SIO4: five serial lines.
    Sio4,
}

impl From<ModuleKindWord> for ModuleKind {
    fn from(word: ModuleKindWord) -> Self {
        match word {
            ModuleKindWord::Sio1 => Self::Sio1,
            ModuleKindWord::Sio4 => Self::Sio4,
        }
    }
}

/// What a tag of such a module shows. The first three are of the module, the others of one of its lines.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum ModuleWord {
    /// Its CAN status byte.
    Status,
    /// What its coding switch says.
    ActiveSwitch,
    /// The code of its type.
    ModuleType,
    /// Bytes that came in on the line.
    BytesReceived,
    /// Frames in which they came.
    FramesReceived,
    /// Bytes for the line that were handed to the bus.
    BytesSent,
    /// Frames in which they went.
    FramesSent,
    /// Bytes for the line that were given up.
    BytesNotSent,
    /// Bytes for the line that wait.
    BytesWaiting,
    /// Messages that came in.
    MessagesReceived,
    /// Seconds since a byte came in last; 65535 = never.
    SecondsSinceReceived,
    /// Seconds since a byte was handed to the bus last; 65535 = never.
    SecondsSinceSent,
}
