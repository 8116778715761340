//! What can be ordered of a running DST P92C, by a scenario or by a line of text. Pure.

use std::time::Duration;

use super::super::order::{self, millis, switch, switched_off, unknown, unless_off};
use super::super::sdo_server::Abort;
use super::super::slave::SlaveOrder;
use super::object_table::{Entry, Key, Type, find};

/// An order to a device. Faults and values stay as ordered until ordered otherwise.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Action {
    /// What every slave understands.
    Slave(SlaveOrder),
    /// Power off and on again.
    PowerCycle,
    /// The pressure goes to so many bar within a time; `None` = it is the plant's again.
    Pressure(Option<f64>, Duration),
    /// The temperature in °C; `None` = it is the plant's again.
    Temperature(Option<f64>),
    /// A sensor is broken: 1 pressure, 2 temperature.
    SensorBad(u8, bool),
    /// An error that the device reports; `None` ends all that were ordered.
    Emcy(Option<u16>),
    /// Something is no longer sent.
    Mute(Voice, bool),
    /// SDO answers come this much later.
    LateSdo(Option<Duration>),
    /// Each SDO access to an entry fails with this code.
    Abort(Key, Option<Abort>),
    /// The device finds an error each time that it starts.
    BootError(bool),
    /// A number of the dictionary, as its bits; `None` = measured again, or the default.
    Set(Key, Option<u32>),
    /// The bus runs at so many kbit/s; 0 = it takes every bit rate.
    Bus(u16),
    /// No fault, nothing ordered. Power and parameters stay as they are.
    ClearAll,
}

/// Something that a device sends.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Voice {
    /// SDO answers.
    Sdo,
    /// Heartbeats; boot-up messages still go out.
    Heartbeat,
    /// Emergency messages.
    Emcy,
    /// TPDO1.
    Pdo,
}

/// What the line protocol understands besides what every slave does, for people.
pub const HELP: &str = "\
pressure BAR [MS]|off         the pressure, at once or within MS milliseconds; off = the plant's own
temperature C|off             the temperature
sensor 1|2 bad|good           a sensor is broken: 1 pressure, 2 temperature
emcy CODE|clear               an error with this code (hex), until `emcy clear`
mute VOICE on|off             sdo, heartbeat, emcy or pdo is not sent
late sdo MS|off               SDO answers come so much later
abort INDEX SUB CODE|off      each SDO access to this entry fails with this code (all hex)
boot error on|off             the device finds an error whenever it starts
set INDEX SUB VALUE|off       a number of the dictionary (INDEX and SUB hex), against plant and access
bus KBIT                      the bit rate of the bus; 0 = any
power cycle                   power off and on again
clear all                     no fault, nothing ordered";

/// The order in a line; what would do nothing is refused with the reason.
pub fn parse(words: &[&str]) -> Result<Action, String> {
    if let ["power", "cycle"] = words {
        return Ok(Action::PowerCycle);
    }
    if let Some(order) = SlaveOrder::parse(words) {
        return order.map(Action::Slave);
    }
    Ok(match words {
        ["pressure", "off"] => Action::Pressure(None, Duration::ZERO),
        ["pressure", bar] => Action::Pressure(Some(real(bar, "a pressure", PRESSURES)?), Duration::ZERO),
        ["pressure", bar, ramp] => Action::Pressure(Some(real(bar, "a pressure", PRESSURES)?), millis(ramp)?),
        ["temperature", celsius] => {
            Action::Temperature(unless_off(celsius, |word| real(word, "a temperature", TEMPERATURES))?)
        }
        ["sensor", sensor, "bad"] => Action::SensorBad(parse_sensor(sensor)?, true),
        ["sensor", sensor, "good"] => Action::SensorBad(parse_sensor(sensor)?, false),
        ["emcy", "clear"] => Action::Emcy(None),
        ["emcy", code] => Action::Emcy(Some(parse_code(code)?)),
        ["mute", voice, to] => Action::Mute(parse_voice(voice)?, switch(to)?),
        ["late", "sdo", delay] => Action::LateSdo(unless_off(delay, millis)?),
        ["abort", index, sub, code] => {
            let key = parse_key(index, sub)?;
            entry(key)?;
            Action::Abort(key, unless_off(code, |code| hex(code, "an abort code").map(Abort))?)
        }
        ["boot", "error", to] => Action::BootError(switch(to)?),
        ["set", index, sub, value] => {
            let key = parse_key(index, sub)?;
            let entry = entry(key)?;
            Action::Set(key, unless_off(value, |value| parse_value(entry, value))?)
        }
        ["bus", kbit] => Action::Bus(order::kbit(kbit)?),
        ["clear", "all"] => Action::ClearAll,
        _ => return Err(unknown()),
    })
}

/// The order that ends another; `None` where it does not last.
#[must_use]
pub fn undo(words: &[&str]) -> Option<String> {
    match words {
        ["power", "cycle"] | ["clear" | "bus", ..] | [.., "clear"] => None,
        ["pressure", bar, ..] if *bar != "off" => Some("pressure off".to_owned()),
        ["sensor", sensor, "bad"] => Some(format!("sensor {sensor} good")),
        ["emcy", _] => Some("emcy clear".to_owned()),
        others => switched_off(others),
    }
}

const PRESSURES: (f64, f64) = (-10.0, 10_000.0);
const TEMPERATURES: (f64, f64) = (-273.15, 1000.0);

fn real(word: &str, what: &str, (low, high): (f64, f64)) -> Result<f64, String> {
    let number = word.parse().ok().filter(|number| (low..=high).contains(number));
    number.ok_or_else(|| format!("`{word}` is not {what}; give a number from {low} to {high}"))
}

fn parse_sensor(word: &str) -> Result<u8, String> {
    match word {
        "1" => Ok(1),
        "2" => Ok(2),
        other => Err(format!("there is no sensor `{other}`; 1 is the pressure, 2 the temperature")),
    }
}

fn hex(word: &str, what: &str) -> Result<u32, String> {
    let digits = word.strip_prefix("0x").unwrap_or(word);
    let number = u32::from_str_radix(digits, 16).ok().filter(|_| !digits.starts_with('+'));
    number.ok_or_else(|| format!("`{word}` is not {what}; give a hexadecimal number"))
}

fn parse_code(word: &str) -> Result<u16, String> {
    let code = hex(word, "an error code").ok().and_then(|code| u16::try_from(code).ok());
    code.filter(|code| *code != 0).ok_or_else(|| {
        format!("`{word}` is not an error code; give 1 to FFFF (hexadecimal), for example F011, or `clear`")
    })
}

fn parse_key(index: &str, sub: &str) -> Result<Key, String> {
    let index_number = u16::try_from(hex(index, "an index")?);
    let sub_number = u8::try_from(hex(sub, "a sub-index")?);
    let index =
        index_number.map_err(|_| format!("`{index}` is not an index; give 0 to FFFF (hexadecimal)"))?;
    let sub = sub_number.map_err(|_| format!("`{sub}` is not a sub-index; give 0 to FF (hexadecimal)"))?;
    Ok((index, sub))
}

fn entry(key: Key) -> Result<&'static Entry, String> {
    find(key).ok_or_else(|| format!("the device has no object {:04X}/{:02X}", key.0, key.1))
}

fn parse_value(entry: &Entry, word: &str) -> Result<u32, String> {
    let wrong = || format!("`{word}` is not a number of this object; give decimal, or 0x and hexadecimal");
    let within = |low: i64, high: i64| {
        let number = match word.strip_prefix("0x") {
            Some(digits) => i64::from_str_radix(digits, 16).ok(),
            None => word.parse().ok(),
        };
        number.filter(|number| (low..=high).contains(number)).ok_or_else(wrong)
    };
    let bits = |number: i64| number.to_le_bytes();
    let low_bits = |[a, b, c, d, ..]: [u8; 8]| u32::from_le_bytes([a, b, c, d]);
    match entry.kind {
        Type::U8 => within(0, 0xFF).map(bits).map(low_bits),
        Type::U16 => within(0, 0xFFFF).map(bits).map(low_bits),
        Type::I16 => within(-0x8000, 0x7FFF).map(bits).map(low_bits),
        Type::U32 => within(0, 0xFFFF_FFFF).map(bits).map(low_bits),
        Type::I32 => within(-0x8000_0000, 0x7FFF_FFFF).map(bits).map(low_bits),
        Type::F32 => word.parse().map(f32::to_bits).map_err(|_| wrong()),
        Type::Text => Err("a text cannot be set".to_owned()),
    }
}

fn parse_voice(word: &str) -> Result<Voice, String> {
    match word {
        "sdo" => Ok(Voice::Sdo),
        "heartbeat" => Ok(Voice::Heartbeat),
        "emcy" => Ok(Voice::Emcy),
        "pdo" => Ok(Voice::Pdo),
        other => Err(format!("`{other}` cannot be muted; there are sdo, heartbeat, emcy and pdo")),
    }
}

#[cfg(test)]
mod tests {
    use super::super::super::slave;
    use super::*;

    fn order(line: &str) -> Result<Action, String> {
        parse(&line.split(' ').collect::<Vec<_>>())
    }

    #[test]
    fn every_line_of_the_help_is_understood() {
        let second = Duration::from_secs(1);
        for (line, action) in [
            ("power off", Action::Slave(SlaveOrder::Power(false))),
            ("power cycle", Action::PowerCycle),
            ("pressure 250.5", Action::Pressure(Some(250.5), Duration::ZERO)),
            ("pressure 250 1000", Action::Pressure(Some(250.0), second)),
            ("pressure off", Action::Pressure(None, Duration::ZERO)),
            ("temperature -20", Action::Temperature(Some(-20.0))),
            ("sensor 2 bad", Action::SensorBad(2, true)),
            ("emcy F011", Action::Emcy(Some(0xF011))),
            ("emcy clear", Action::Emcy(None)),
            ("mute heartbeat on", Action::Mute(Voice::Heartbeat, true)),
            ("late sdo 1000", Action::LateSdo(Some(second))),
            ("abort 1017 0 06090030", Action::Abort((0x1017, 0), Some(Abort::RANGE))),
            ("abort 1017 0 off", Action::Abort((0x1017, 0), None)),
            ("boot error on", Action::BootError(true)),
            ("boot loop off", Action::Slave(SlaveOrder::BootLoop(None))),
            ("set 6150 1 0xF9", Action::Set((0x6150, 1), Some(0xF9))),
            ("set 9130 1 -1000", Action::Set((0x9130, 1), Some(0xFFFF_FC18))),
            ("set 6130 1 1.5", Action::Set((0x6130, 1), Some(0x3FC0_0000))),
            ("set 6130 1 off", Action::Set((0x6130, 1), None)),
            ("bus 250", Action::Bus(250)),
            ("clear all", Action::ClearAll),
        ] {
            assert_eq!(order(line).as_ref(), Ok(&action), "{line}");
            let first = line.split(' ').next().unwrap();
            let mut help = HELP.lines().chain(slave::HELP.lines());
            assert!(help.any(|help| help.starts_with(first)), "{first} is not in the help");
        }
    }

    #[test]
    fn what_would_do_nothing_or_is_not_understood_is_refused_with_the_way_to_mend_it() {
        for (line, mend) in [
            ("explode", "help"),
            ("pressure high", "-10 to 10000"),
            ("pressure nan", "-10 to 10000"),
            ("temperature -300", "-273.15"),
            ("sensor 3 bad", "1 is the pressure"),
            ("emcy 0", "`clear`"),
            ("emcy 10000", "1 to FFFF"),
            ("mute lss on", "sdo, heartbeat, emcy and pdo"),
            ("mute sdo maybe", "neither `on` nor `off`"),
            ("set 2000 0 1", "no object 2000/00"),
            ("set 1018 5 1", "no object 1018/05"),
            ("set 1800 2 256", "decimal, or 0x"),
            ("set 1008 0 1", "a text"),
            ("abort 2000 0 off", "no object"),
            ("abort 1017 0 code", "hexadecimal"),
            ("bus 33", "10 to 1000"),
        ] {
            let error = order(line).unwrap_err();
            assert!(error.contains(mend), "{line}: {error}");
        }
    }

    #[test]
    fn every_order_that_lasts_has_one_that_ends_it() {
        let undone = |line: &str| undo(&line.split(' ').collect::<Vec<_>>());
        for (line, end) in [
            ("pressure 300 2000", "pressure off"),
            ("temperature 130", "temperature off"),
            ("sensor 1 bad", "sensor 1 good"),
            ("emcy F011", "emcy clear"),
            ("mute sdo on", "mute sdo off"),
            ("late sdo 100", "late sdo off"),
            ("abort 1017 0 06090030", "abort 1017 0 off"),
            ("set 6150 1 3", "set 6150 1 off"),
            ("boot error on", "boot error off"),
            ("power off", "power on"),
        ] {
            assert_eq!(undone(line).as_deref(), Some(end));
            assert!(order(end).is_ok(), "{end}");
        }
        for line in ["power cycle", "clear all", "bus 250", "emcy clear", "pressure off"] {
            assert_eq!(undone(line), None, "{line}");
        }
    }
}
