//! What can be ordered of a running `DetCon`, by a scenario or by a line of text. Pure.

use std::fmt;
use std::time::Duration;

use super::super::order::{millis, number, switch, switched_off, unknown, unless_off};
use super::super::slave::SlaveOrder;
use super::cadence::INHIBIT_TIME;
use super::protocol::DetconSettings;
use super::values::{Channel, StatusBit, Tpdo, Values};

/// Raw intensity of a knocking cylinder unless told: 63 %, between the two limits.
pub const KNOCK_LEVEL: u8 = 160;
/// How long the trip bit is set unless told.
pub const TRIP_PULSE: Duration = Duration::from_millis(100);

/// An order to a device. Faults and values stay as ordered until ordered otherwise.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Control {
    /// What every slave understands.
    Slave(SlaveOrder),
    /// Guard requests are not answered.
    MuteGuarding(bool),
    /// A TPDO is not sent; all of them when `None`.
    MutePdo(Option<Tpdo>, bool),
    /// The toggle bit no longer changes.
    StuckToggle(bool),
    /// A TPDO has a wrong length, 0..=8, or its own again.
    WrongLength(Tpdo, Option<u8>),
    /// Guard replies come this late.
    LateReplies(Option<Duration>),
    /// Reserved bits are set.
    ReservedBits(bool),
    /// A cylinder knocks with this raw intensity.
    Knock(Channel, Option<u8>),
    /// A sensor is bad.
    SensorBad(Channel, bool),
    /// The engine is tripped; the trip bit is set this long, at least [`INHIBIT_TIME`].
    Trip(Duration),
    /// A value has this raw content, whatever the engine does.
    Set(Point, u8),
    /// A value is the engine's again.
    Clear(Point),
    /// No fault, no knock, all values the engine's. Power stays as it is.
    ClearAll,
}

/// A value that can be set, by the name of its tag.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Point {
    /// A status bit: 0 or another.
    Status(StatusBit),
    /// `analog_output`, raw.
    AnalogOutput,
    /// `ignition_reduction_limit`, raw.
    IgnitionReductionLimit,
    /// `immediate_stop_limit`, raw.
    ImmediateStopLimit,
    /// `knock_intensity_7`, raw.
    Intensity(Channel),
    /// `used_sensor_7`: 0 or another.
    Used(Channel),
    /// `bad_input_7`: 0 or another.
    Bad(Channel),
}

impl Point {
    /// Puts `raw` into the values.
    pub fn write(self, values: &mut Values, raw: u8) {
        match self {
            Self::Status(bit) => values.set_status(bit, raw != 0),
            Self::AnalogOutput => values.analog_output = raw,
            Self::IgnitionReductionLimit => values.ignition_reduction_limit = raw,
            Self::ImmediateStopLimit => values.immediate_stop_limit = raw,
            Self::Intensity(channel) => values.set_intensity(channel, raw),
            Self::Used(channel) => values.set_used(channel, raw != 0),
            Self::Bad(channel) => values.set_bad(channel, raw != 0),
        }
    }

    /// By its name; `Err` tells which names there are.
    pub fn parse(name: &str) -> Result<Self, String> {
        if let Some(bit) = StatusBit::ALL.into_iter().find(|bit| bit.word() == name) {
            return Ok(Self::Status(bit));
        }
        let numbered = |prefix| name.strip_prefix(prefix).and_then(|number| number.parse().ok());
        let channel = |prefix| numbered(prefix).and_then(Channel::new);
        match name {
            "analog_output" => Some(Self::AnalogOutput),
            "ignition_reduction_limit" => Some(Self::IgnitionReductionLimit),
            "immediate_stop_limit" => Some(Self::ImmediateStopLimit),
            _ => channel("knock_intensity_")
                .map(Self::Intensity)
                .or_else(|| channel("used_sensor_").map(Self::Used))
                .or_else(|| channel("bad_input_").map(Self::Bad)),
        }
        .ok_or_else(|| unknown_point(name))
    }
}

fn unknown_point(name: &str) -> String {
    if name == "engine_knocking" {
        return "`engine_knocking` follows from `knock`; let a cylinder knock".to_owned();
    }
    let bits = StatusBit::ALL.map(StatusBit::word).join(", ");
    format!(
        "there is no value `{name}`; there are {bits}, analog_output, ignition_reduction_limit, \
         immediate_stop_limit, and knock_intensity_N, used_sensor_N, bad_input_N with N from 1 to 20"
    )
}

impl fmt::Display for Point {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Status(bit) => f.write_str(bit.word()),
            Self::AnalogOutput => f.write_str("analog_output"),
            Self::IgnitionReductionLimit => f.write_str("ignition_reduction_limit"),
            Self::ImmediateStopLimit => f.write_str("immediate_stop_limit"),
            Self::Intensity(channel) => write!(f, "knock_intensity_{channel}"),
            Self::Used(channel) => write!(f, "used_sensor_{channel}"),
            Self::Bad(channel) => write!(f, "bad_input_{channel}"),
        }
    }
}

/// What the line protocol understands besides what every slave does, for people.
pub const HELP: &str = "\
knock CHANNEL on|off|LEVEL    a cylinder knocks (LEVEL raw, 0 to 255)
sensor CHANNEL bad|good       a sensor is reported bad
trip [MS]                     trip pulse of at least 100 ms; the engine stops and starts again after 10 s
set NAME RAW                  a value, whatever the engine does: set trip 1, set knock_intensity_3 200
clear NAME                    the value is the engine's again
clear all                     no fault, no knock, no value set
mute guarding on|off          guard requests are not answered
mute pdos on|off              no TPDO is sent
mute pdo N on|off             TPDO N is not sent
stuck toggle on|off           the toggle bit no longer changes
wrong length PDO DLC|off      TPDO with DLC bytes (0 to 8)
late replies MS|off           guard replies come so much later
reserved bits on|off          reserved bits are set";

/// The order in a line, if a device that is like this takes it: what would do nothing is refused with the reason.
pub fn check(settings: &DetconSettings, words: &[&str]) -> Result<Control, String> {
    let control = parse(words)?;
    if let Control::Knock(channel, _) | Control::SensorBad(channel, _) = control
        && channel.get() > settings.cylinders
    {
        let cylinders = settings.cylinders;
        return Err(format!(
            "the engine has {cylinders} cylinders; give a channel up to that, or set `cylinders` in a scenario"
        ));
    }
    if let Control::Trip(pulse) = control
        && pulse < INHIBIT_TIME
    {
        let (pulse, shortest) = (pulse.as_millis(), INHIBIT_TIME.as_millis());
        return Err(format!(
            "a trip pulse of {pulse} ms can begin and end between two TPDO3; give at least {shortest}"
        ));
    }
    Ok(control)
}

/// The order that ends another; `None` where it does not last.
#[must_use]
pub fn undo(words: &[&str]) -> Option<String> {
    match words {
        ["trip" | "clear", ..] => None,
        ["sensor", channel, "bad"] => Some(format!("sensor {channel} good")),
        ["set", name, _] => Some(format!("clear {name}")),
        others => switched_off(others),
    }
}

fn parse(words: &[&str]) -> Result<Control, String> {
    if let Some(order) = SlaveOrder::parse(words) {
        return order.map(Control::Slave);
    }
    Ok(match words {
        ["mute", "guarding", to] => Control::MuteGuarding(switch(to)?),
        ["mute", "pdos", to] => Control::MutePdo(None, switch(to)?),
        ["mute", "pdo", pdo, to] => Control::MutePdo(Some(parse_tpdo(pdo)?), switch(to)?),
        ["stuck", "toggle", to] => Control::StuckToggle(switch(to)?),
        ["wrong", "length", pdo, dlc] => {
            Control::WrongLength(parse_tpdo(pdo)?, unless_off(dlc, |dlc| number(dlc, "a DLC", 0, 8))?)
        }
        ["late", "replies", delay] => Control::LateReplies(unless_off(delay, millis)?),
        ["reserved", "bits", to] => Control::ReservedBits(switch(to)?),
        ["knock", channel, "on"] => Control::Knock(parse_channel(channel)?, Some(KNOCK_LEVEL)),
        ["knock", channel, level] => Control::Knock(
            parse_channel(channel)?,
            unless_off(level, |level| number(level, "a raw intensity", 0, 255))?,
        ),
        ["sensor", channel, "bad"] => Control::SensorBad(parse_channel(channel)?, true),
        ["sensor", channel, "good"] => Control::SensorBad(parse_channel(channel)?, false),
        ["trip"] => Control::Trip(TRIP_PULSE),
        ["trip", pulse] => Control::Trip(millis(pulse)?),
        ["set", name, raw] => Control::Set(Point::parse(name)?, number(raw, "a raw value", 0, 255)?),
        ["clear", "all"] => Control::ClearAll,
        ["clear", name] => Control::Clear(Point::parse(name)?),
        _ => return Err(unknown()),
    })
}

fn parse_tpdo(word: &str) -> Result<Tpdo, String> {
    let tpdo = word.parse().ok().and_then(Tpdo::from_number);
    tpdo.ok_or_else(|| format!("`{word}` is not a TPDO; give a number from 1 to 4"))
}

fn parse_channel(word: &str) -> Result<Channel, String> {
    let channel = word.parse().ok().and_then(Channel::new);
    channel.ok_or_else(|| format!("`{word}` is not a channel; give a number from 1 to 20"))
}

#[cfg(test)]
mod tests {
    use super::super::super::order::Order;
    use super::super::super::slave;
    use super::*;
    use crate::canopen::NodeId;

    fn control(line: &str) -> Result<Control, String> {
        let order: Order =
            line.parse().map_err(|error: crate::simulator::SimulatorError| error.to_string())?;
        check(&DetconSettings { cylinders: 20, ..DetconSettings::default() }, &order.words())
    }

    fn order(line: &str) -> Control {
        control(line).unwrap()
    }

    #[test]
    fn every_line_of_the_help_is_understood() {
        let seven = Channel::new(7).unwrap();
        for (line, control) in [
            ("power off", Control::Slave(SlaveOrder::Power(false))),
            ("knock 7 on", Control::Knock(seven, Some(KNOCK_LEVEL))),
            ("knock 7 200", Control::Knock(seven, Some(200))),
            ("knock 7 off", Control::Knock(seven, None)),
            ("sensor 7 bad", Control::SensorBad(seven, true)),
            ("sensor 7 good", Control::SensorBad(seven, false)),
            ("trip", Control::Trip(TRIP_PULSE)),
            ("trip 250", Control::Trip(Duration::from_millis(250))),
            ("set trip 1", Control::Set(Point::Status(StatusBit::Trip), 1)),
            ("set knock_intensity_7 200", Control::Set(Point::Intensity(seven), 200)),
            ("clear bad_input_7", Control::Clear(Point::Bad(seven))),
            ("clear all", Control::ClearAll),
            ("mute guarding on", Control::MuteGuarding(true)),
            ("mute pdos on", Control::MutePdo(None, true)),
            ("mute pdo 3 off", Control::MutePdo(Some(Tpdo::Three), false)),
            ("stuck toggle on", Control::StuckToggle(true)),
            ("wrong length 3 1", Control::WrongLength(Tpdo::Three, Some(1))),
            ("wrong length 3 off", Control::WrongLength(Tpdo::Three, None)),
            ("late replies 150", Control::LateReplies(Some(Duration::from_millis(150)))),
            ("second master on", Control::Slave(SlaveOrder::SecondMaster(true))),
            ("duplicate on", Control::Slave(SlaveOrder::Duplicate(true))),
            ("reserved bits on", Control::ReservedBits(true)),
            ("refuse start on", Control::Slave(SlaveOrder::RefuseStart(true))),
            ("boot loop off", Control::Slave(SlaveOrder::BootLoop(None))),
        ] {
            assert_eq!(order(line), control, "{line}");
            let first = line.split(' ').next().unwrap();
            assert!(
                HELP.lines().chain(slave::HELP.lines()).any(|help| help.starts_with(first)),
                "{first} is not in the help"
            );
        }
    }

    #[test]
    fn a_line_can_name_one_of_several_devices() {
        let order: Order = "  node 2   power on ".parse().unwrap();
        assert_eq!(order.node, NodeId::new(2).map(Into::into));
        assert_eq!(parse(&order.words()), Ok(Control::Slave(SlaveOrder::Power(true))));
    }

    #[test]
    fn what_is_not_understood_is_refused_with_the_way_to_mend_it() {
        for (line, mend) in [
            ("", "help"),
            ("explode", "help"),
            ("power maybe", "neither `on` nor `off`"),
            ("knock 21 on", "1 to 20"),
            ("knock 7 256", "0 to 255"),
            ("mute pdo 5 on", "1 to 4"),
            ("wrong length 3 9", "0 to 8"),
            ("late replies soon", "milliseconds"),
            ("set nothing 1", "analog_output"),
            ("set knock_intensity_21 1", "from 1 to 20"),
            ("set engine_knocking 1", "knock"),
            ("node 255 trip", "1 to 254"),
            ("node 1 node 1 trip", "help"),
        ] {
            let error = control(line).unwrap_err();
            assert!(error.contains(mend), "{error}");
        }
    }

    #[test]
    fn a_point_has_the_name_that_it_is_found_by() {
        for name in
            ["trip", "eeprom_fault", "analog_output", "knock_intensity_20", "used_sensor_1", "bad_input_9"]
        {
            assert_eq!(Point::parse(name).unwrap().to_string(), name);
        }
    }

    #[test]
    fn an_order_that_would_do_nothing_is_refused_with_the_reason() {
        let settings = DetconSettings::default();
        let try_it = |line: &str| check(&settings, &line.split(' ').collect::<Vec<_>>());
        for (line, reason) in [
            ("knock 18 on", "16 cylinders"),
            ("knock 17 off", "16 cylinders"),
            ("sensor 18 bad", "16 cylinders"),
            ("trip 0", "at least 100"),
            ("trip 99", "at least 100"),
        ] {
            let error = try_it(line).unwrap_err();
            assert!(error.contains(reason), "{line}: {error}");
        }
        for line in ["knock 16 on", "sensor 16 bad", "trip 100", "set knock_intensity_18 3"] {
            assert!(try_it(line).is_ok(), "{line}");
        }
    }

    #[test]
    fn every_order_that_lasts_has_one_that_ends_it() {
        let undone = |line: &str| undo(&line.split(' ').collect::<Vec<_>>());
        for (line, end) in [
            ("power off", "power on"),
            ("knock 7 180", "knock 7 off"),
            ("sensor 3 bad", "sensor 3 good"),
            ("set trip 1", "clear trip"),
            ("mute pdo 3 on", "mute pdo 3 off"),
            ("wrong length 3 1", "wrong length 3 off"),
            ("boot loop 1000", "boot loop off"),
        ] {
            assert_eq!(undone(line).as_deref(), Some(end));
            assert!(control(end).is_ok(), "{end}");
        }
        for line in ["trip", "trip 100", "clear all", "clear trip", "knock 7 off", "sensor 3 good"] {
            assert_eq!(undone(line), None, "{line}");
        }
    }
}
