//! Emergency messages (CiA 301, 7.2.7): what they say, which errors of a node are there, and which came before. Pure.

use std::collections::VecDeque;

use crate::time::Timestamp;

/// Errors of one node that are known to be there at once. One more takes the place of the oldest; of the oldest that the
/// mapping does not name, where there is one.
pub const MOST_ACTIVE: usize = 32;
/// Messages of one node that are remembered; the oldest leave.
pub const MOST_REMEMBERED: usize = 32;

/// What an emergency message says.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Emergency {
    /// Error code; 0 = error reset, or no error.
    pub code: u16,
    /// Error register, object 0x1001.
    pub register: u8,
    /// Manufacturer bytes.
    pub vendor: [u8; 5],
}

impl Emergency {
    /// Of the bytes of a frame (R-DET-091, R-DST-074); manufacturer bytes that are missing are 0. `None` where there is no
    /// error register.
    #[must_use]
    pub fn decode(data: &[u8]) -> Option<Self> {
        let [low, high, register, rest @ ..] = data else { return None };
        let mut vendor = [0; 5];
        for (to, from) in vendor.iter_mut().zip(rest) {
            *to = *from;
        }
        Some(Self { code: u16::from_le_bytes([*low, *high]), register: *register, vendor })
    }

    /// The bytes of the frame.
    #[must_use]
    pub fn encode(self) -> [u8; 8] {
        let mut data = [0; 8];
        let [low, high] = self.code.to_le_bytes();
        let bytes = [low, high, self.register].into_iter().chain(self.vendor);
        data.iter_mut().zip(bytes).for_each(|(to, from)| *to = from);
        data
    }
}

/// What an error code means, by its class or, where CiA 301 defines it, by itself.
#[must_use]
pub fn meaning(code: u16) -> &'static str {
    match code {
        0x8110 => "CAN overrun",
        0x8120 => "CAN error passive",
        0x8130 => "life guard or heartbeat error",
        0x8140 => "recovered from bus-off",
        0x8150 => "collision of identifiers",
        0x8210 => "PDO too short",
        0x8220 => "PDO too long",
        0x8230 => "DAM MPDO not processed",
        0x8240 => "unexpected length of SYNC",
        0x8250 => "RPDO timeout",
        _ => class(code),
    }
}

/// The class of an error code, by its high byte (CiA 301, table of error code classes).
#[must_use]
pub fn class(code: u16) -> &'static str {
    match code >> 8 {
        0x00 => "error reset or no error",
        0x10..=0x1F => "generic error",
        0x21 => "current, input side",
        0x22 => "current inside the device",
        0x23 => "current, output side",
        0x20..=0x2F => "current",
        0x31 => "mains voltage",
        0x32 => "voltage inside the device",
        0x33 => "output voltage",
        0x30..=0x3F => "voltage",
        0x41 => "ambient temperature",
        0x42 => "device temperature",
        0x40..=0x4F => "temperature",
        0x50..=0x5F => "device hardware",
        0x61 => "internal software",
        0x62 => "user software",
        0x63 => "data set",
        0x60..=0x6F => "device software",
        0x70..=0x7F => "additional modules",
        0x81 => "communication",
        0x82 => "protocol error",
        0x80..=0x8F => "monitoring",
        0x90..=0x9F => "external error",
        0xFF => "device specific",
        0xF0..=0xFE => "additional functions",
        _ => "class not defined",
    }
}

/// Names of the bits of the error register (object 0x1001), bit 0 first.
pub const REGISTER_BITS: [&str; 8] = [
    "generic",
    "current",
    "voltage",
    "temperature",
    "communication",
    "device profile",
    "reserved",
    "manufacturer",
];

/// Names of the bits that are set in an error register.
pub fn register_words(register: u8) -> impl Iterator<Item = &'static str> {
    REGISTER_BITS
        .into_iter()
        .enumerate()
        .filter_map(move |(bit, name)| (register >> bit & 1 == 1).then_some(name))
}

/// The bit of the error register that errors of a class set besides bit 0, where CiA 301 says so.
fn class_bit(code: u16) -> Option<u8> {
    match code >> 8 {
        0x20..=0x2F => Some(1),
        0x30..=0x3F => Some(2),
        0x40..=0x4F => Some(3),
        0x81 | 0x82 => Some(4),
        _ => None,
    }
}

/// What is known of an error code beforehand.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Known {
    /// Its entry among the errors that the mapping names.
    pub entry: usize,
    /// The bit of the error register that it sets besides bit 0, 1..=7, where that is known.
    pub register_bit: Option<u8>,
}

/// An error, or a message about one.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct ErrorRecord {
    /// When it was first told, for one that is there; for one that is remembered, when it was told last.
    pub at: Timestamp,
    /// What was told last.
    pub emergency: Emergency,
    /// How often it was told: in all while it is there, or in a row.
    pub count: u64,
    /// Its entry among the errors that the mapping names.
    pub entry: Option<usize>,
    /// Bits of the error register without which it is gone; 0: the register does not tell.
    bits: u8,
}

impl ErrorRecord {
    /// What its code means.
    #[must_use]
    pub fn meaning(&self) -> &'static str {
        meaning(self.emergency.code)
    }
}

/// The errors of one node.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct ErrorLog {
    last: Emergency,
    /// Oldest first.
    active: Vec<ErrorRecord>,
    /// Oldest first.
    history: VecDeque<ErrorRecord>,
}

impl ErrorLog {
    /// Takes a message. Code 0 with error register 0 ends all errors (R-DST-076). Any other ends those whose class has
    /// left the error register (R-DST-078): of a code without a class of its own, and without a known bit, the register
    /// tells only when it is 0.
    pub fn handle_message(&mut self, at: Timestamp, emergency: Emergency, known: Option<Known>) {
        self.last = emergency;
        if emergency.code == 0 && emergency.register == 0 {
            self.active.clear();
        } else {
            self.retain(emergency.register);
        }
        let record = record(at, emergency, known);
        if emergency.code != 0 {
            self.insert(record);
        }
        self.remember(record);
    }

    /// What the node said of its errors when it was asked: the error register, and the code of its newest error
    /// (0x1003:1; 0 = none, also where it does not tell; R-DST-081). Without a bit in the register that code is past.
    /// Whether it is an error that was not known to be there.
    pub fn handle_reading(
        &mut self,
        at: Timestamp,
        register: Option<u8>,
        code: u16,
        known: Option<Known>,
    ) -> bool {
        let code = if register == Some(0) { 0 } else { code };
        let emergency = Emergency { code, register: register.unwrap_or_default(), vendor: [0; 5] };
        match register {
            Some(register) if register != 0 => self.retain(register),
            Some(_) | None => self.active.clear(),
        }
        let is_new = code != 0 && !self.active.iter().any(|error| error.emergency.code == code);
        let same = self.last.code == code && self.last.register == emergency.register;
        if !same {
            self.last = emergency;
        }
        if is_new {
            let record = record(at, emergency, known);
            self.insert(record);
            self.remember(record);
        }
        is_new
    }

    /// The error register as it was read, outside of any message. Whether it changed anything.
    pub fn handle_register(&mut self, register: u8) -> bool {
        let before = (self.last, self.active.len());
        self.retain(register);
        self.last.register = register;
        if register == 0 && self.active.is_empty() {
            self.last = Emergency::default();
        }
        before != (self.last, self.active.len())
    }

    /// The node has booted: no error that it told before is there any more. What was told stays remembered.
    pub fn handle_boot_up(&mut self) {
        self.last = Emergency::default();
        self.active.clear();
    }

    /// What was told last; nothing after a boot-up.
    #[must_use]
    pub fn last(&self) -> Emergency {
        self.last
    }

    /// The errors that are there, the oldest first; [`MOST_ACTIVE`] at most.
    #[must_use]
    pub fn active(&self) -> &[ErrorRecord] {
        &self.active
    }

    /// What was told, the newest first; [`MOST_REMEMBERED`] at most. Repetitions of the newest are counted in it.
    pub fn history(&self) -> impl Iterator<Item = &ErrorRecord> {
        self.history.iter().rev()
    }

    /// Becomes equal to another, and allocates nothing that it has already.
    pub fn copy_from(&mut self, other: &Self) {
        let Self { last, active, history } = other;
        self.last = *last;
        self.active.clone_from(active);
        self.history.clone_from(history);
    }

    /// Keeps the errors that the error register does not rule out.
    fn retain(&mut self, register: u8) {
        self.active.retain(|error| match register {
            // A device that always sends 0 keeps no register.
            0 => error.emergency.register == 0,
            _ => error.bits == 0 || register & error.bits != 0,
        });
    }

    fn insert(&mut self, record: ErrorRecord) {
        let code = record.emergency.code;
        if let Some(error) = self.active.iter_mut().find(|error| error.emergency.code == code) {
            let count = error.count.saturating_add(1);
            *error = ErrorRecord { at: error.at, count, ..record };
            return;
        }
        if self.active.len() >= MOST_ACTIVE {
            let unnamed = self.active.iter().position(|error| error.entry.is_none());
            self.active.remove(unnamed.unwrap_or_default());
        }
        self.active.push(record);
    }

    fn remember(&mut self, record: ErrorRecord) {
        if let Some(newest) = self.history.back_mut().filter(|newest| newest.emergency == record.emergency) {
            let count = newest.count.saturating_add(1);
            *newest = ErrorRecord { count, ..record };
            return;
        }
        if self.history.len() >= MOST_REMEMBERED {
            self.history.pop_front();
        }
        self.history.push_back(record);
    }
}

fn record(at: Timestamp, emergency: Emergency, known: Option<Known>) -> ErrorRecord {
    let bit = known.and_then(|known| known.register_bit).or_else(|| class_bit(emergency.code));
    let bits = bit.map_or(0, |bit| 1_u8.checked_shl(bit.into()).unwrap_or(0)) & emergency.register;
    ErrorRecord { at, emergency, count: 1, entry: known.map(|known| known.entry), bits }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn at(millis: i64) -> Timestamp {
        Timestamp::from_millis(millis)
    }

    fn take(log: &mut ErrorLog, data: &[u8], known: Option<Known>) {
        log.handle_message(at(0), Emergency::decode(data).unwrap(), known);
    }

    fn codes(log: &ErrorLog) -> Vec<u16> {
        log.active().iter().map(|error| error.emergency.code).collect()
    }

    /// The first entry of a mapping, with its bit of the error register.
    fn entry(register_bit: u8) -> Known {
        Known { entry: 0, register_bit: Some(register_bit) }
    }

    #[test]
    fn v_dst_11_r_dst_074_079_the_worked_frames_are_decoded() {
        for (frame, code, register, class_word, words) in [
            ("11F0210000000000", 0xF011, 0x21, "additional functions", "generic device profile"),
            ("0040090000000000", 0x4000, 0x09, "temperature", "generic temperature"),
            ("0081110000000000", 0x8100, 0x11, "communication", "generic communication"),
            ("6361210000000000", 0x6163, 0x21, "internal software", "generic device profile"),
            ("6363210000000000", 0x6363, 0x21, "data set", "generic device profile"),
            ("6161810000000000", 0x6161, 0x81, "internal software", "generic manufacturer"),
            ("0063810000000000", 0x6300, 0x81, "data set", "generic manufacturer"),
            ("0000000000000000", 0x0000, 0x00, "error reset or no error", ""),
        ] {
            let data: crate::can::CanFrame = format!("081#{frame}").parse().unwrap();
            let emergency = Emergency::decode(data.data()).unwrap();
            assert_eq!(emergency, Emergency { code, register, vendor: [0; 5] });
            assert_eq!(emergency.encode(), data.data());
            assert_eq!(class(code), class_word);
            assert_eq!(register_words(register).collect::<Vec<_>>().join(" "), words);
        }
        assert_eq!(Emergency::decode(&[0x11, 0xF0]), None, "too short");
        assert_eq!(Emergency::decode(&[0x11, 0xF0, 1, 7]).unwrap().vendor, [7, 0, 0, 0, 0]);
        assert_eq!((meaning(0x8130), meaning(0x8100)), ("life guard or heartbeat error", "communication"));
    }

    #[test]
    fn r_dst_076_no_error_ends_all() {
        let mut log = ErrorLog::default();
        take(&mut log, &[0x11, 0xF0, 0x21], None);
        take(&mut log, &[0x00, 0x40, 0x29], None);
        assert_eq!(codes(&log), [0xF011, 0x4000]);
        take(&mut log, &[0; 8], None);
        assert_eq!(codes(&log), [0_u16; 0]);
        assert_eq!(log.last(), Emergency::default());
        assert_eq!(log.history().count(), 3, "all three are remembered");
    }

    #[test]
    fn r_dst_078_an_error_whose_class_has_left_the_register_is_gone() {
        let mut log = ErrorLog::default();
        take(&mut log, &[0x11, 0xF0, 0x21], Some(entry(5)));
        take(&mut log, &[0x00, 0x40, 0x29], None);
        take(&mut log, &[0x00, 0x81, 0x39], None);
        assert_eq!(codes(&log), [0xF011, 0x4000, 0x8100]);
        take(&mut log, &[0x00, 0x81, 0x31], None);
        assert_eq!(codes(&log), [0xF011, 0x8100], "temperature by its class");
        take(&mut log, &[0x00, 0x81, 0x11], None);
        assert_eq!(codes(&log), [0x8100], "the other by the bit that the mapping tells");
        take(&mut log, &[0x00, 0x50, 0x11], None);
        take(&mut log, &[0x00, 0x00, 0x01], None);
        assert_eq!(codes(&log), [0x5000], "one of several is over; this one has no bit of its own");
    }

    #[test]
    fn r_dst_078_a_register_that_a_device_does_not_keep_ends_nothing() {
        let mut log = ErrorLog::default();
        take(&mut log, &[0x00, 0x40, 0x00], None);
        take(&mut log, &[0x00, 0x50, 0x00], None);
        assert!(!log.handle_register(0), "it was 0 all the time");
        assert_eq!(codes(&log), [0x4000, 0x5000]);
        take(&mut log, &[0; 3], None);
        assert_eq!(codes(&log), [0_u16; 0]);
    }

    #[test]
    fn a_register_that_was_read_ends_errors_of_which_no_message_came() {
        let mut log = ErrorLog::default();
        take(&mut log, &[0x11, 0xF0, 0x21, 9], Some(entry(5)));
        assert!(!log.handle_register(0x21));
        assert!(log.handle_register(0x01));
        assert_eq!((codes(&log), log.last().register), (vec![], 0x01));
        assert!(log.handle_register(0));
        assert_eq!(log.last(), Emergency::default());
    }

    #[test]
    fn r_dst_081_of_what_is_read_only_a_code_with_a_register_counts() {
        let mut log = ErrorLog::default();
        assert!(log.handle_reading(at(5), Some(0x21), 0xF011, None));
        assert_eq!((codes(&log), log.last().code), (vec![0xF011], 0xF011));
        assert!(!log.handle_reading(at(6), Some(0x21), 0xF011, None), "known already");
        assert_eq!(log.history().count(), 1);
        for (register, code) in [(Some(0), 0), (None, 0), (Some(0), 0x4000)] {
            take(&mut log, &[0x11, 0xF0, 0x21], None);
            assert!(!log.handle_reading(at(7), register, code, None));
            assert_eq!((codes(&log), log.last().code), (vec![], 0), "{register:?} {code:04X}");
        }
        assert!(log.handle_reading(at(8), None, 0x4000, None), "a device without a register");
        assert!(!log.handle_reading(at(9), Some(0x21), 0, None), "an error without a code");
        assert_eq!((codes(&log), log.last().register), (vec![0x4000], 0x21));
    }

    #[test]
    fn after_a_boot_up_no_error_is_there_and_what_was_told_is_remembered() {
        let mut log = ErrorLog::default();
        take(&mut log, &[0x11, 0xF0, 0x21], None);
        log.handle_boot_up();
        assert_eq!((codes(&log), log.last()), (vec![], Emergency::default()));
        assert_eq!(log.history().count(), 1);
    }

    #[test]
    fn repetitions_of_the_newest_are_counted() {
        let mut log = ErrorLog::default();
        for millis in 0..5 {
            log.handle_message(at(millis), Emergency::decode(&[0, 0x50, 1]).unwrap(), None);
        }
        let newest = log.history().next().unwrap();
        assert_eq!((newest.at, newest.count, log.history().count()), (at(4), 5, 1));
        assert_eq!((log.active()[0].at, log.active()[0].count), (at(0), 5));
    }

    #[test]
    fn an_error_that_the_mapping_names_is_not_pushed_out_by_those_that_it_does_not() {
        let mut log = ErrorLog::default();
        take(&mut log, &[0x11, 0xF0, 0x01], Some(Known { entry: 3, register_bit: None }));
        for code in 0x5000_u16..0x5100 {
            let [low, high] = code.to_le_bytes();
            take(&mut log, &[low, high, 1], None);
        }
        assert_eq!((log.active().len(), log.history().count()), (MOST_ACTIVE, MOST_REMEMBERED));
        assert_eq!(codes(&log)[0], 0xF011);
    }

    proptest! {
        #[test]
        fn r_dst_078_any_messages_are_bounded_and_no_error_ends_them(
            messages in prop::collection::vec((any::<[u8; 8]>(), 0_usize..=8, any::<bool>()), 0..200),
        ) {
            let mut log = ErrorLog::default();
            for (data, length, named) in messages {
                let Some(emergency) = Emergency::decode(&data[..length]) else { continue };
                let known = named.then_some(Known { entry: 0, register_bit: Some(data[0]) });
                log.handle_message(at(0), emergency, known);
                prop_assert!(log.active().len() <= MOST_ACTIVE && log.history().count() <= MOST_REMEMBERED);
                prop_assert!(emergency.code == 0 || codes(&log).contains(&emergency.code));
                let mut copy = ErrorLog::default();
                copy.copy_from(&log);
                prop_assert_eq!(&copy, &log);
            }
            log.handle_message(at(0), Emergency::default(), None);
            prop_assert!(log.active().is_empty());
        }
    }
}
