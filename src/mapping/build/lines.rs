//! Serial lines of esd modules: how the module is to drive them.

use std::time::Duration;

use super::super::installation::ChannelEntry;
use super::super::{At, SourceText};
use super::esd::identifier;
use super::line_keys;
use super::problems::Problems;
use super::tags::Context;
use crate::esd::{
    CanTxMode, ChannelSettings, Framing, LineFormat, MinChar, ModuleKind, Parity, Rate, SerialBits,
    SerialMode,
};

/// The fastest that a RS-232 line can be, and each of the four lines of a SIO4 while all are used, in bit/s (R-ESD-007,
/// R-ESD-009).
const FASTEST_EVERYWHERE: u32 = 38_400;
/// Messages that are offered are not longer, in bytes.
const USUAL_MESSAGE: u64 = 256;
/// A pause of so many ms ends a message.
const USUAL_PAUSE: u64 = 100;

/// The lines of a module as they are configured: the number of each, and its table.
pub fn used<'a>(context: &Context<'a>, kind: ModuleKind) -> Vec<(u8, &'a At<String>, &'a ChannelEntry)> {
    let numbered = context.entry.channel.iter().filter_map(|(key, entry)| {
        let number = number(&key.value, kind)?;
        Some((number, key, entry))
    });
    numbered.collect()
}

fn number(key: &str, kind: ModuleKind) -> Option<u8> {
    let number = key.parse::<u8>().ok()?;
    ((1..=kind.channels()).contains(&number) && number.to_string() == key).then_some(number)
}

/// All lines that the module has, also those that are not used: what they send is heard all the same.
pub fn channels(
    problems: &mut Problems,
    context: &Context<'_>,
    name: &str,
    kind: ModuleKind,
    switch: u8,
) -> Vec<ChannelSettings> {
    for key in context.entry.channel.keys().filter(|key| number(&key.value, kind).is_none()) {
        let (message, hint) = match kind {
            ModuleKind::Sio1 => ("has only channel 1", format!("write [node.{name}.channel.1]")),
            ModuleKind::Sio4 => {
                ("has channels 1 to 5", format!("write [node.{name}.channel.1] to [node.{name}.channel.5]"))
            }
        };
        let message = format!("there is no channel `{}`: a {} {message}", key.value, kind.model());
        problems.error(context.config, &key.span, message, hint);
    }
    let used = used(context, kind);
    let unused = ChannelEntry::default();
    let mut channels = Vec::new();
    for number in 1..=kind.channels() {
        let entry = used.iter().find(|(used, _, _)| *used == number).map(|(_, _, entry)| *entry);
        let Some([tx_id, rx_id]) = kind.identifiers(switch, number) else { continue };
        let entry = entry.unwrap_or(&unused);
        let mut own = |at: &Option<At<u64>>, what: &str, default| match at {
            Some(at) => identifier(problems, context.config, at, what),
            None => default,
        };
        let (tx_id, rx_id) = (own(&entry.tx_id, "tx_id", tx_id), own(&entry.rx_id, "rx_id", rx_id));
        let terminal = kind.is_terminal(number);
        let serial_mode = serial_mode(problems, context.config, entry, terminal);
        let can_tx_mode = can_tx_mode(problems, context.config, entry);
        channels.push(ChannelSettings {
            number,
            tx_id,
            rx_id,
            can_tx_mode,
            serial_mode,
            serial_bits: serial_bits(entry, terminal),
            stop_bit_set: context.bus.as_ref().map_or(2, |bus| bus.esd.stop_bit_set),
            gap: entry.tx_gap_ms.as_ref().map(|at| {
                Duration::from_millis(problems.within(context.config, at, "tx_gap_ms", 0..=60_000))
            }),
            byte_time: byte_time(serial_mode, terminal),
            flow_control: entry.flow_control.into(),
            framing: framing(problems, context.config, entry, can_tx_mode),
        });
    }
    warn_of_rates(problems, context, kind, &channels);
    line_keys::check(problems, context, kind, &channels);
    channels
}

/// How long the line needs for a byte. The terminal interface always has one stop bit (R-ESD-012).
fn byte_time(mode: Option<SerialMode>, terminal: bool) -> Duration {
    let Some(mode) = mode.or_else(|| SerialMode::from_value(SerialMode::DEFAULT_VALUE)) else {
        return Duration::ZERO;
    };
    let stop_bits = if terminal { 1 } else { mode.format.stop_bits };
    SerialMode { format: LineFormat { stop_bits, ..mode.format }, ..mode }.byte_time()
}

/// What is said of rates and format of a line, as bits of the one value that they are (R-ESD-099: the others are not changed).
/// The interface on the DSUB9 connector has one stop bit and ignores CTS, whatever those bits are.
fn serial_bits(entry: &ChannelEntry, terminal: bool) -> SerialBits {
    let baud = entry.baud.is_some();
    let parity = entry.parity.as_ref().map(|at| Parity::from(at.value));
    SerialBits::default()
        .and(baud || entry.receive_baud.is_some(), SerialBits::RECEIVE)
        .and(baud || entry.transmit_baud.is_some(), SerialBits::TRANSMIT)
        .and(entry.data_bits.is_some(), SerialBits::DATA_BITS)
        .and(parity.is_some(), SerialBits::PARITY_MODE)
        .and(parity.is_some_and(|parity| parity != Parity::None), SerialBits::PARITY_TYPE)
        .and(entry.stop_bits.is_some() && !terminal, SerialBits::STOP_BITS)
        .and(entry.cts.is_some() && !terminal, SerialBits::CTS)
        .and(entry.rts.is_some(), SerialBits::RTS)
}

/// Rates and format of a line, what is not said of them as in a module as it is shipped; `None`: nothing is said.
fn serial_mode(
    problems: &mut Problems,
    config: &SourceText,
    entry: &ChannelEntry,
    terminal: bool,
) -> Option<SerialMode> {
    if serial_bits(entry, false) == SerialBits::default() {
        return None;
    }
    let shipped = SerialMode::from_value(SerialMode::DEFAULT_VALUE)?;
    let separate = entry.receive_baud.as_ref().or(entry.transmit_baud.as_ref());
    if let (Some(_), Some(at)) = (&entry.baud, separate) {
        let message = "`baud` is the bit rate of both directions";
        problems.error(
            config,
            &at.span,
            message,
            "write either `baud`, or `receive_baud` and `transmit_baud`",
        );
    }
    let small = |number: u64| u8::try_from(number).unwrap_or(u8::MAX);
    let data_bits = entry.data_bits.as_ref().map(|at| small(problems.within(config, at, "data_bits", 5..=8)));
    let stop_bits = entry.stop_bits.as_ref().map(|at| small(problems.within(config, at, "stop_bits", 1..=2)));
    let format = LineFormat {
        data_bits: data_bits.unwrap_or(shipped.format.data_bits),
        parity: entry.parity.as_ref().map_or(shipped.format.parity, |at| at.value.into()),
        stop_bits: stop_bits.unwrap_or(shipped.format.stop_bits),
    };
    if terminal {
        check_terminal(problems, config, entry, format);
    }
    let mut rate = |at: Option<&At<u64>>, default: Rate| {
        at.or(entry.baud.as_ref()).and_then(|at| rate(problems, config, at)).unwrap_or(default)
    };
    Some(SerialMode {
        receive: rate(entry.receive_baud.as_ref(), shipped.receive),
        transmit: rate(entry.transmit_baud.as_ref(), shipped.transmit),
        rts: entry.rts.as_ref().map_or(shipped.rts, |at| at.value),
        cts: entry.cts.as_ref().map_or(shipped.cts, |at| at.value),
        format,
    })
}

fn rate(problems: &mut Problems, config: &SourceText, at: &At<u64>) -> Option<Rate> {
    let rate = u32::try_from(at.value).ok().and_then(Rate::new);
    if rate.is_none() {
        let message = format!("{} bit/s is no bit rate of a serial line of these modules", at.value);
        problems.error(config, &at.span, message, format!("use one of {:?}", Rate::all()));
    }
    rate
}

/// What the interface on the DSUB9 connector cannot do (R-ESD-012).
fn check_terminal(problems: &mut Problems, config: &SourceText, entry: &ChannelEntry, format: LineFormat) {
    let hint = "use 8 data bits, or 7 with parity";
    let span = entry.data_bits.as_ref().map(|at| &at.span).or(entry.parity.as_ref().map(|at| &at.span));
    if let (5 | 6, Some(span)) = (format.data_bits, span) {
        let message =
            format!("the channel on the DSUB9 connector cannot have {} data bits", format.data_bits);
        problems.error(config, span, message, hint);
    }
    if let (7, Parity::None, Some(span)) = (format.data_bits, format.parity, span) {
        let message = "the channel on the DSUB9 connector cannot have 7 data bits without parity";
        problems.error(config, span, message, hint);
    }
    if let (2, Some(at)) = (format.stop_bits, &entry.stop_bits) {
        let message = "the channel on the DSUB9 connector always has one stop bit";
        problems.error(config, &at.span, message, "leave `stop_bits` out, or use another channel");
    }
    if let Some(at) = entry.cts.as_ref().filter(|at| at.value) {
        let message = "the channel on the DSUB9 connector ignores CTS";
        problems.error(config, &at.span, message, "leave `cts` out, or use another channel");
    }
}

/// Rates that not every line can have. Which interface a channel has is for its plug-in card to say.
fn warn_of_rates(
    problems: &mut Problems,
    context: &Context<'_>,
    kind: ModuleKind,
    channels: &[ChannelSettings],
) {
    let used = used(context, kind);
    let all_four = kind == ModuleKind::Sio4 && (1..=4).all(|four| used.iter().any(|(it, _, _)| *it == four));
    for (number, key, entry) in used {
        let mode = channels.iter().find(|channel| channel.number == number);
        let Some(mode) = mode.and_then(|channel| channel.serial_mode) else { continue };
        let fastest = mode.receive.bits_per_second().max(mode.transmit.bits_per_second());
        if fastest <= FASTEST_EVERYWHERE {
            continue;
        }
        let given = [&entry.baud, &entry.receive_baud, &entry.transmit_baud];
        let span = given.into_iter().flatten().next().map_or(&key.span, |at| &at.span);
        let (message, hint) = if all_four && !kind.is_terminal(number) {
            (
                format!(
                    "channels 1 to 4 can have more than {FASTEST_EVERYWHERE} bit/s only while not all are used"
                ),
                "lower the rate, or leave one of the four channels unused",
            )
        } else {
            (
                format!("{fastest} bit/s is more than a RS-232 line can have, {FASTEST_EVERYWHERE} bit/s"),
                "see that the channel is RS-422 or RS-485, or lower the rate",
            )
        };
        problems.warning(context.config, span, message, hint);
    }
}

/// How a channel is to pack what comes in; `None`: as the module has it. The parameter is one value, too.
fn can_tx_mode(problems: &mut Problems, config: &SourceText, entry: &ChannelEntry) -> Option<CanTxMode> {
    let shipped = CanTxMode::DEFAULT;
    let given = [
        entry.min_char.is_some(),
        entry.end_mark.is_some(),
        entry.max_char.is_some(),
        entry.inhibit_ms.is_some(),
    ];
    if !given.contains(&true) {
        return None;
    }
    let mut number = |at: &Option<At<u64>>, what: &str, limits| {
        let number = at.as_ref().map(|at| problems.within(config, at, what, limits))?;
        u8::try_from(number).ok()
    };
    let min = number(&entry.min_char, "min_char", 1..=8);
    let max = number(&entry.max_char, "max_char", 1..=8);
    let inhibit = number(&entry.inhibit_ms, "inhibit_ms", 0..=255).unwrap_or(shipped.inhibit);
    // Who asks for more than single characters wants frames that hold them.
    let collects = entry.end_mark.is_some() || min.is_some_and(|min| min > 1);
    let max_char = max.unwrap_or(if collects { 8 } else { shipped.max_char });
    if let (Some(at), Some(_)) = (&entry.min_char, &entry.end_mark) {
        let message = "a channel sends after a number of characters, or after an end mark";
        problems.error(config, &at.span, message, "leave `min_char` or `end_mark` out");
    }
    if let (Some(at), Some(min)) = (&entry.min_char, min)
        && min > max_char
    {
        let message = format!("min_char {min} is more than max_char {max_char}");
        let hint = "lower `min_char` or raise `max_char`: frames of so many characters would never be sent";
        problems.error(config, &at.span, message, hint);
    }
    let min_char = match (&entry.end_mark, min) {
        (Some(mark), _) => mark.value.into(),
        (None, Some(min)) => MinChar::Bytes(min),
        (None, None) => shipped.min_char,
    };
    Some(CanTxMode { inhibit, max_char, min_char })
}

/// What makes a message of what comes in.
fn framing(
    problems: &mut Problems,
    config: &SourceText,
    entry: &ChannelEntry,
    mode: Option<CanTxMode>,
) -> Framing {
    let dropped = entry.end_mark.as_ref().is_some_and(|mark| mark.value.is_dropped());
    let delimiter = match &entry.delimiter {
        None if dropped => Vec::new(),
        None => b"\r\n".to_vec(),
        Some(at) => {
            let bytes = at.value.as_bytes();
            if !at.value.is_ascii() || bytes.len() > 8 {
                let message = format!("{:?} cannot be the end of a message", at.value);
                problems.error(
                    config,
                    &at.span,
                    message,
                    "use at most 8 ASCII characters, such as \"\\r\\n\"",
                );
            }
            if dropped && bytes.iter().any(|byte| matches!(byte, b'\r' | b'\n')) {
                let message = "the module does not pass on its end mark, so `delimiter` never comes in";
                let hint = "leave `delimiter` out, or use an `end_mark` that is passed on: \"cr\" or \"lf\"";
                problems.warning(config, &at.span, message, hint);
            }
            bytes.to_vec()
        }
    };
    let longest = entry.max_message.as_ref();
    let longest = longest.map_or(USUAL_MESSAGE, |at| problems.within(config, at, "max_message", 1..=1024));
    let idle = entry.idle_ms.as_ref();
    let idle = idle.map_or(USUAL_PAUSE, |at| problems.within(config, at, "idle_ms", 0..=60_000));
    let inhibit = mode.map_or(CanTxMode::DEFAULT.inhibit, |mode| mode.inhibit);
    let places = [&entry.idle_ms, &entry.inhibit_ms];
    if let Some(at) = places.into_iter().flatten().next()
        && (1..=u64::from(inhibit)).contains(&idle)
    {
        let message = format!(
            "messages end after {idle} ms without data, but the module leaves {inhibit} ms between its frames"
        );
        problems.warning(config, &at.span, message, "make `idle_ms` longer than `inhibit_ms`");
    }
    Framing {
        delimiter,
        longest: usize::try_from(longest).unwrap_or(1024),
        idle: (idle > 0).then(|| Duration::from_millis(idle)),
    }
}
