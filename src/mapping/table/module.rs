//! Values of esd modules and of their serial lines, and what a bus with such modules needs.

use std::time::Duration;

use crate::can::CanId;
use crate::esd::{ModuleSettings, NetworkSettings};

/// What the modules of a bus have in common.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct EsdBusDef {
    /// The identifier on which modules answer requests (R-ESD-055); `None`: no module is managed.
    pub reply_id: Option<CanId>,
    /// How long an answer may take, 1..=10000 ms (R-ESD-053).
    pub reply_timeout: Duration,
    /// How often a request without an answer is repeated, 0..=10 (R-ESD-053).
    pub repetitions: u8,
    /// `MinChar` stands in the high half of its byte (R-ESD-092).
    pub min_char_high: bool,
    /// Stop bits of a line whose stop bit field is set, 1 or 2 (R-ESD-099).
    pub stop_bit_set: u8,
}

impl Default for EsdBusDef {
    fn default() -> Self {
        let NetworkSettings { reply_id, reply_timeout, repetitions, .. } = NetworkSettings::default();
        Self { reply_id, reply_timeout, repetitions, min_char_high: false, stop_bit_set: 2 }
    }
}

/// A value that a module tells of itself.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ModuleValue {
    /// Its CAN status byte (R-ESD-074).
    Status,
    /// What its coding switch says (R-ESD-059).
    ActiveSwitch,
    /// The code of its type (R-ESD-058).
    ModuleType,
}

/// A value that the gateway counts of a serial line (R-ESD-038).
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum LineValue {
    /// Bytes that came in.
    BytesReceived,
    /// Frames in which they came.
    FramesReceived,
    /// Bytes that were handed to the bus.
    BytesSent,
    /// Frames in which they went.
    FramesSent,
    /// Bytes that were given up: the bus went down, or the module was lost or started anew.
    BytesNotSent,
    /// Bytes that wait to be sent.
    BytesWaiting,
    /// Messages that came in.
    MessagesReceived,
    /// Seconds since a byte came in last; 65535 = never, or longer ago than 65534 s.
    SecondsSinceReceived,
    /// Seconds since a byte was handed to the bus last; 65535 = never, or longer ago than 65534 s.
    SecondsSinceSent,
}

impl LineValue {
    /// All, in the order of their carriers.
    pub const ALL: [Self; 9] = [
        Self::BytesReceived,
        Self::FramesReceived,
        Self::BytesSent,
        Self::FramesSent,
        Self::BytesNotSent,
        Self::BytesWaiting,
        Self::MessagesReceived,
        Self::SecondsSinceReceived,
        Self::SecondsSinceSent,
    ];

    /// What it is, in words.
    #[must_use]
    pub fn text(self) -> &'static str {
        match self {
            Self::BytesReceived => "bytes received",
            Self::FramesReceived => "frames received",
            Self::BytesSent => "bytes sent",
            Self::FramesSent => "frames sent",
            Self::BytesNotSent => "bytes given up",
            Self::BytesWaiting => "bytes waiting",
            Self::MessagesReceived => "messages received",
            Self::SecondsSinceReceived => "seconds since the last byte received",
            Self::SecondsSinceSent => "seconds since the last byte sent",
        }
    }

    /// Bits that it has.
    #[must_use]
    pub fn width(self) -> u8 {
        match self {
            Self::SecondsSinceReceived | Self::SecondsSinceSent => 16,
            Self::BytesReceived
            | Self::FramesReceived
            | Self::BytesSent
            | Self::FramesSent
            | Self::BytesNotSent
            | Self::BytesWaiting
            | Self::MessagesReceived => 64,
        }
    }
}

impl ModuleValue {
    /// All, in the order of their carriers.
    pub const ALL: [Self; 3] = [Self::Status, Self::ActiveSwitch, Self::ModuleType];

    /// What it is, in words.
    #[must_use]
    pub fn text(self) -> &'static str {
        match self {
            Self::Status => "CAN status byte",
            Self::ActiveSwitch => "coding switch",
            Self::ModuleType => "module type",
        }
    }
}

/// A value of a module or of one of its lines: what a carrier of its node carries, as 8 bytes, the lowest first.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ModuleCarrier {
    /// Of the line at this place among the [channels](ModuleSettings::channels) of the module.
    Line(usize, LineValue),
    /// Of the module itself.
    Module(ModuleValue),
}

impl ModuleCarrier {
    /// Its place among the carriers of a module with so many channels: the lines come first, one after the other, then the
    /// module.
    #[must_use]
    pub fn place(self, channels: usize) -> usize {
        match self {
            Self::Line(channel, value) => channel * LineValue::ALL.len() + place_in(&LineValue::ALL, &value),
            Self::Module(value) => channels * LineValue::ALL.len() + place_in(&ModuleValue::ALL, &value),
        }
    }

    /// What stands at a place.
    #[must_use]
    pub fn at(place: usize, channels: usize) -> Option<Self> {
        let each = LineValue::ALL.len();
        match place.checked_sub(channels * each) {
            Some(place) => ModuleValue::ALL.get(place).map(|value| Self::Module(*value)),
            None => LineValue::ALL.get(place % each).map(|value| Self::Line(place / each, *value)),
        }
    }

    /// How many a module has.
    #[must_use]
    pub fn count(module: &ModuleSettings) -> usize {
        module.channels.len() * LineValue::ALL.len() + ModuleValue::ALL.len()
    }

    /// How many of them, from the first on, come to have a value: a module that is not managed is not asked for any.
    #[must_use]
    pub fn told(module: &ModuleSettings) -> usize {
        let own = if module.management.is_some() { ModuleValue::ALL.len() } else { 0 };
        module.channels.len() * LineValue::ALL.len() + own
    }

    /// Bits that it has.
    #[must_use]
    pub fn width(self) -> u8 {
        match self {
            Self::Line(_, value) => value.width(),
            Self::Module(_) => 8,
        }
    }

    /// What it is, in words: `channel 1 bytes received`.
    #[must_use]
    pub fn text(self, module: &ModuleSettings) -> String {
        match self {
            Self::Line(place, value) => {
                let number = module.channels.get(place).map_or(0, |channel| channel.number);
                format!("channel {number} {}", value.text())
            }
            Self::Module(value) => value.text().to_owned(),
        }
    }
}

fn place_in<T: PartialEq>(all: &[T], value: &T) -> usize {
    all.iter().position(|each| each == value).unwrap_or(0)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_value_of_a_module_has_a_carrier_of_its_own() {
        for channels in [1, 5] {
            for place in 0..channels * LineValue::ALL.len() + ModuleValue::ALL.len() {
                let carrier = ModuleCarrier::at(place, channels).unwrap();
                assert_eq!(carrier.place(channels), place, "{carrier:?}");
            }
            assert_eq!(ModuleCarrier::at(channels * 9 + 3, channels), None);
        }
    }
}
