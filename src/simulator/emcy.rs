//! What is wrong with a device, as its emergency messages tell it (CiA 301, 7.2.7). Pure.

/// Errors that a device can have at once. One more is not told.
const MOST: usize = 16;

/// The errors that are there, and what the bus was told of them.
#[derive(Clone, Debug)]
pub struct Errors {
    /// The bits of the error register that a code stands for, besides bit 0.
    register_bits: fn(u16) -> u8,
    /// Oldest first.
    active: Vec<u16>,
    told: Vec<u16>,
}

impl Errors {
    /// No errors.
    #[must_use]
    pub fn new(register_bits: fn(u16) -> u8) -> Self {
        Self { register_bits, active: Vec::new(), told: Vec::new() }
    }

    /// An error begins or ends.
    pub fn set(&mut self, code: u16, on: bool) {
        let there = self.active.contains(&code);
        if on && !there && code != 0 && self.active.len() < MOST {
            self.active.push(code);
        } else if !on {
            self.active.retain(|active| *active != code);
        }
    }

    /// Whether there is any.
    #[must_use]
    pub fn any(&self) -> bool {
        !self.active.is_empty()
    }

    /// The newest; 0 = none.
    #[must_use]
    pub fn code(&self) -> u16 {
        self.active.last().copied().unwrap_or_default()
    }

    /// The error register (object 0x1001).
    #[must_use]
    pub fn register(&self) -> u8 {
        let generic = u8::from(self.any());
        self.active.iter().fold(generic, |register, code| register | (self.register_bits)(*code))
    }

    /// Nothing was told yet: as after power-on, where a device without errors has nothing to tell.
    pub fn forget_what_was_told(&mut self) {
        self.told.clear();
    }

    /// The emergency message that is due because the situation has changed since the last.
    pub fn take_message(&mut self) -> Option<[u8; 8]> {
        if self.told == self.active {
            return None;
        }
        self.told.clone_from(&self.active);
        let [low, high] = self.code().to_le_bytes();
        Some([low, high, self.register(), 0, 0, 0, 0, 0])
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn r_dst_074_075_076_each_change_is_told_with_the_newest_code_until_none_is_left() {
        let mut errors = Errors::new(|code| if code == 0xF011 { 0x20 } else { 0x08 });
        assert_eq!(errors.take_message(), None);
        errors.set(0xF011, true);
        assert_eq!(errors.take_message(), Some([0x11, 0xF0, 0x21, 0, 0, 0, 0, 0]));
        errors.set(0xF011, true);
        assert_eq!(errors.take_message(), None);
        errors.set(0x4000, true);
        assert_eq!(errors.take_message(), Some([0x00, 0x40, 0x29, 0, 0, 0, 0, 0]));
        errors.set(0x4000, false);
        assert_eq!(errors.take_message(), Some([0x11, 0xF0, 0x21, 0, 0, 0, 0, 0]));
        errors.set(0xF011, false);
        assert_eq!(errors.take_message(), Some([0; 8]));
    }

    #[test]
    fn there_is_a_bound_to_misery() {
        let mut errors = Errors::new(|_| 0);
        for code in 0..100 {
            errors.set(code, true);
        }
        assert_eq!(errors.active.len(), MOST);
    }
}
