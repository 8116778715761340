//! What can be ordered of a running esd module, by a scenario or by a line of text. Pure.

use super::super::order::{self, switch, switched_off, unknown};
use super::line::LineKind;
use super::parameters::Model;
use super::settings::SioSettings;

/// An order to a module. Faults and values stay as ordered until ordered otherwise.
#[derive(Clone, Debug, PartialEq)]
pub enum Action {
    /// Switches the power.
    Power(bool),
    /// Power off and on again.
    PowerCycle,
    /// A reset as by command.
    Reset,
    /// Turns the coding switches.
    Switch(u8),
    /// The line end of a channel, from 1, sends bytes.
    Send(u8, Vec<u8>),
    /// The line end of a channel, from 1, switches CTS.
    Cts(u8, bool),
    /// Puts so many kg on the balance of a channel, from 1.
    Weight(u8, f64),
    /// Something is no longer sent; `None` = nothing at all is.
    Mute(Option<Voice>, bool),
    /// The module notes an error of the CAN.
    Error,
    /// The controller's own error stands.
    ErrorStands(bool),
    /// The CAN plug is out.
    Unplug(bool),
    /// What is in the EEPROM can no longer be read.
    EepromError,
    /// The toggle bit no longer changes.
    StuckToggle(bool),
    /// The bus runs at so many kbit/s; 0 = it takes every bit rate.
    Bus(u16),
    /// No fault, CTS on everywhere. Power, parameters and switches stay as they are.
    ClearAll,
}

/// Something that a module sends.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Voice {
    /// Replies to requests.
    Replies,
    /// Replies of the watchdog.
    Watchdog,
    /// Frames with data.
    Data,
}

/// What the line protocol understands, for people.
pub const HELP: &str = "\
power on|off                  supply of the module
power cycle                   power off and on again
reset                         reset, as by command
switch HEX                    turns the coding switches, for example `switch 1A`
send CH TEXT                  the device on a serial line sends; \\r \\n \\t \\\\ in TEXT, or hex:0D0A
cts CH on|off                 the device on a serial line switches CTS
weight CH KG                  something is put on a balance
mute on|off                   the module sends nothing
mute VOICE on|off             replies, watchdog or data are not sent
error                         the module notes a CAN error (bit 2 of its status)
error on|off                  a CAN error that stands: clearing it does not help
unplug on|off                 the CAN plug is out
eeprom error                  what it has stored can no longer be read
stuck toggle on|off           bit 7 of the watchdog replies no longer changes
bus KBIT                      the bit rate of the bus; 0 = any
clear all                     no fault, CTS on";

/// The order in a line; what would do nothing is refused with the reason.
pub fn parse(model: Model, words: &[&str]) -> Result<Action, String> {
    Ok(match words {
        ["power", "cycle"] => Action::PowerCycle,
        ["power", to] => Action::Power(switch(to)?),
        ["reset"] => Action::Reset,
        ["switch", value] => Action::Switch(parse_switch(model, value)?),
        ["send", channel, text @ ..] => {
            Action::Send(parse_channel(model, channel)?, parse_text(&text.join(" "))?)
        }
        ["cts", channel, to] => Action::Cts(parse_channel(model, channel)?, switch(to)?),
        ["weight", channel, kg] => Action::Weight(parse_channel(model, channel)?, parse_weight(kg)?),
        ["mute", to @ ("on" | "off")] => Action::Mute(None, switch(to)?),
        ["mute", voice, to] => Action::Mute(Some(parse_voice(voice)?), switch(to)?),
        ["error"] => Action::Error,
        ["error", to] => Action::ErrorStands(switch(to)?),
        ["unplug", to] => Action::Unplug(switch(to)?),
        ["eeprom", "error"] => Action::EepromError,
        ["stuck", "toggle", to] => Action::StuckToggle(switch(to)?),
        ["bus", kbit] => Action::Bus(order::kbit(kbit)?),
        ["clear", "all"] => Action::ClearAll,
        _ => return Err(unknown()),
    })
}

/// As [`parse`], for a module that is like this: what nothing at its lines would do is refused too.
pub fn check(settings: &SioSettings, words: &[&str]) -> Result<Action, String> {
    let action = parse(settings.model, words)?;
    if let Action::Weight(channel, _) = action {
        let line = settings.lines.get(usize::from(channel).saturating_sub(1));
        if line != Some(&LineKind::Balance) {
            return Err(format!(
                "channel {channel} has no balance; `lines` in the scenario says what is where"
            ));
        }
    }
    Ok(action)
}

/// The order that ends another; `None` where it does not last.
#[must_use]
pub fn undo(words: &[&str]) -> Option<String> {
    match words {
        ["cts", channel, "off"] => Some(format!("cts {channel} on")),
        ["power", "off"] | ["mute" | "unplug" | "stuck" | "error", .., "on"] => switched_off(words),
        _ => None,
    }
}

fn parse_channel(model: Model, word: &str) -> Result<u8, String> {
    order::number(word, "a channel", 1, model.channels())
}

fn parse_switch(model: Model, word: &str) -> Result<u8, String> {
    let digits = word.strip_prefix("0x").unwrap_or(word);
    let value = u8::from_str_radix(digits, 16).ok().filter(|value| *value <= model.highest_switch());
    value.filter(|_| !digits.starts_with('+')).ok_or_else(|| {
        let highest = model.highest_switch();
        format!("`{word}` is not what the coding switches can be at; give 00 to {highest:02X} (hexadecimal)")
    })
}

fn parse_weight(word: &str) -> Result<f64, String> {
    let kg = word.parse().ok().filter(|kg| (-1000.0..=100_000.0).contains(kg));
    kg.ok_or_else(|| format!("`{word}` is not a weight; give kilograms, for example 12.45"))
}

fn parse_voice(word: &str) -> Result<Voice, String> {
    match word {
        "replies" => Ok(Voice::Replies),
        "watchdog" => Ok(Voice::Watchdog),
        "data" => Ok(Voice::Data),
        other => Err(format!("`{other}` cannot be muted; there are replies, watchdog and data")),
    }
}

/// Text with escapes, or `hex:` and pairs of digits.
fn parse_text(text: &str) -> Result<Vec<u8>, String> {
    let bytes = match text.strip_prefix("hex:") {
        Some(digits) => parse_hex(digits)?,
        None => unescape(text)?,
    };
    if bytes.is_empty() { Err("there is nothing to send".to_owned()) } else { Ok(bytes) }
}

fn parse_hex(digits: &str) -> Result<Vec<u8>, String> {
    let wrong = || format!("`{digits}` is not bytes; give pairs of hexadecimal digits, for example hex:0D0A");
    let digits: Vec<u8> = digits.bytes().filter(|byte| *byte != b' ').collect();
    let value = |digit: u8| char::from(digit).to_digit(16).and_then(|value| u8::try_from(value).ok());
    digits
        .chunks(2)
        .map(|pair| match *pair {
            [high, low] => value(high).zip(value(low)).map(|(high, low)| high << 4 | low).ok_or_else(wrong),
            _ => Err(wrong()),
        })
        .collect()
}

fn unescape(text: &str) -> Result<Vec<u8>, String> {
    let mut bytes = Vec::new();
    let mut rest = text.bytes();
    while let Some(byte) = rest.next() {
        bytes.push(match (byte, byte == b'\\') {
            (_, true) => match rest.next() {
                Some(b'r') => b'\r',
                Some(b'n') => b'\n',
                Some(b't') => b'\t',
                Some(b'\\') => b'\\',
                _ => return Err(format!("`{text}`: after `\\` comes r, n, t or another `\\`")),
            },
            (byte, false) => byte,
        });
    }
    Ok(bytes)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn order(line: &str) -> Result<Action, String> {
        parse(Model::Sio4, &line.split(' ').collect::<Vec<_>>())
    }

    #[test]
    fn every_line_of_the_help_is_understood() {
        for (line, action) in [
            ("power off", Action::Power(false)),
            ("power cycle", Action::PowerCycle),
            ("reset", Action::Reset),
            ("switch 1A", Action::Switch(0x1A)),
            ("switch 0xcb", Action::Switch(0xCB)),
            ("send 1 Hello world\\r\\n", Action::Send(1, b"Hello world\r\n".to_vec())),
            ("send 5 hex:0D0a", Action::Send(5, vec![13, 10])),
            ("cts 2 off", Action::Cts(2, false)),
            ("weight 2 0.5", Action::Weight(2, 0.5)),
            ("mute on", Action::Mute(None, true)),
            ("mute watchdog off", Action::Mute(Some(Voice::Watchdog), false)),
            ("error", Action::Error),
            ("error on", Action::ErrorStands(true)),
            ("unplug on", Action::Unplug(true)),
            ("eeprom error", Action::EepromError),
            ("stuck toggle on", Action::StuckToggle(true)),
            ("bus 250", Action::Bus(250)),
            ("clear all", Action::ClearAll),
        ] {
            assert_eq!(order(line).as_ref(), Ok(&action), "{line}");
            let first = line.split(' ').next().unwrap();
            assert!(HELP.lines().any(|help| help.starts_with(first)), "{first} is not in the help");
        }
    }

    #[test]
    fn what_would_do_nothing_or_is_not_understood_is_refused_with_the_way_to_mend_it() {
        for (line, mend) in [
            ("explode", "help"),
            ("switch CC", "00 to CB"),
            ("switch 100", "00 to CB"),
            ("send 6 x", "1 to 5"),
            ("send 1", "nothing to send"),
            ("send 1 hex:0", "pairs"),
            ("send 1 hex:zz", "pairs"),
            ("send 1 a\\q", "r, n, t"),
            ("cts 0 on", "1 to 5"),
            ("weight 2 heavy", "kilograms"),
            ("mute pdo on", "replies, watchdog and data"),
            ("unplug maybe", "neither `on` nor `off`"),
            ("bus 33", "10 to 1000"),
        ] {
            let error = order(line).unwrap_err();
            assert!(error.contains(mend), "{line}: {error}");
        }
        assert!(parse(Model::Sio1, &["cts", "2", "on"]).is_err());
        assert!(parse(Model::Sio1, &["switch", "CC"]).is_ok());
    }

    #[test]
    fn every_order_that_lasts_has_one_that_ends_it() {
        let undone = |line: &str| undo(&line.split(' ').collect::<Vec<_>>());
        for (line, end) in [
            ("power off", "power on"),
            ("cts 3 off", "cts 3 on"),
            ("mute on", "mute off"),
            ("mute data on", "mute data off"),
            ("error on", "error off"),
            ("unplug on", "unplug off"),
            ("stuck toggle on", "stuck toggle off"),
        ] {
            assert_eq!(undone(line).as_deref(), Some(end));
            assert!(order(end).is_ok(), "{end}");
        }
        for line in ["power cycle", "reset", "error", "send 1 on", "switch 1A", "eeprom error", "clear all"] {
            assert_eq!(undone(line), None, "{line}");
        }
    }
}
