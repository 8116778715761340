//! What can be ordered of a running device, as text: by a control line or by a step of a scenario. Pure.
//!
//! A line is words; each device understands its own (`detcon::control`, `dst_p92c::action`). Here is what all have in
//! common: to whom a line is, switches, numbers, times.

use std::str::FromStr;
use std::time::Duration;

use super::device::DeviceNumber;
use super::error::SimulatorError;

/// A control line: `knock 7 on`, or `node 2 knock 7 on` for one of several devices.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Order {
    /// Which device; all when `None`.
    pub node: Option<DeviceNumber>,
    /// What it is to do.
    pub words: Vec<String>,
}

/// What the line protocol understands besides what each device does.
pub const HELP: &str = "\
node N LINE                   LINE for one of several devices
help                          this text";

impl Order {
    /// The words, as devices take them.
    #[must_use]
    pub fn words(&self) -> Vec<&str> {
        self.words.iter().map(String::as_str).collect()
    }
}

impl FromStr for Order {
    type Err = SimulatorError;

    fn from_str(line: &str) -> Result<Self, SimulatorError> {
        let words: Vec<&str> = line.split_whitespace().collect();
        let owned = |words: &[&str]| words.iter().map(|word| (*word).to_owned()).collect();
        match words.as_slice() {
            ["node", number, rest @ ..] => {
                let node = number.parse().map_err(|reason| refused(line, reason))?;
                Ok(Self { node: Some(node), words: owned(rest) })
            }
            all => Ok(Self { node: None, words: owned(all) }),
        }
    }
}

/// The error for a line, with the reason why a device does not take it.
#[must_use]
pub fn refused(line: &str, reason: String) -> SimulatorError {
    SimulatorError::Control { line: line.trim().to_owned(), reason }
}

/// The reason when no word of a line is known.
#[must_use]
pub fn unknown() -> String {
    "type `help` for what can be ordered".to_owned()
}

/// `on` or `off`.
pub fn switch(word: &str) -> Result<bool, String> {
    match word {
        "on" => Ok(true),
        "off" => Ok(false),
        other => Err(format!("`{other}` is neither `on` nor `off`")),
    }
}

/// `off`, or what `parse` reads.
pub fn unless_off<T>(word: &str, parse: impl FnOnce(&str) -> Result<T, String>) -> Result<Option<T>, String> {
    if word == "off" { Ok(None) } else { parse(word).map(Some) }
}

/// A number from `low` to `high`.
pub fn number(word: &str, what: &str, low: u8, high: u8) -> Result<u8, String> {
    let number = word.parse().ok().filter(|number| (low..=high).contains(number));
    number.ok_or_else(|| format!("`{word}` is not {what}; give a number from {low} to {high}"))
}

/// A time in milliseconds, up to seven weeks.
pub fn millis(word: &str) -> Result<Duration, String> {
    let millis = word.parse().map(|millis: u32| Duration::from_millis(u64::from(millis)));
    millis.map_err(|_| format!("`{word}` is not a time; give milliseconds, for example 150"))
}

/// A bit rate of a bus in kbit/s; 0 = any.
pub fn kbit(word: &str) -> Result<u16, String> {
    const USUAL: [u16; 10] = [0, 10, 20, 50, 100, 125, 250, 500, 800, 1000];
    let kbit = word.parse().ok().filter(|kbit| USUAL.contains(kbit));
    kbit.ok_or_else(|| format!("`{word}` is not a bit rate in kbit/s; give 10 to 1000, or 0 for any"))
}

/// What ends an order that ends in a switch or a number: the same with `off`. `None` for what is an end itself.
#[must_use]
pub fn switched_off(words: &[&str]) -> Option<String> {
    match words {
        ["power", "off"] => Some("power on".to_owned()),
        [.., "off" | "good"] | [] | [_] => None,
        [subject @ .., _] => Some(format!("{} off", subject.join(" "))),
    }
}
