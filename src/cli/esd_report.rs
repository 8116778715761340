//! What modules tell, for people. Pure.

use super::esd_args::kbit;
use super::esd_job::Answers;
use crate::esd::parameters::{FIRST_TX_DELAY, can_tx_mode_of, serial_mode_of};
use crate::esd::{
    Answer, CanBitRate, CanStatus, CanTxMode, MinChar, ModuleKind, ModuleNumber, Parity, Request, SerialMode,
};

/// Each with its own head, so that rows stand below it.
pub(super) const HEAD: &str = "module  type          switch  firmware  serial  TxIds      RxIds      status";

/// What a module is asked for a row.
pub(super) const ROW: [Request; 5] =
    [Request::ModuleType, Request::Switch, Request::SoftwareRevision, Request::SerialNumber, Request::Status];

/// What a module is asked before its channels.
pub(super) const MODULE: [Request; 12] = [
    Request::ModuleType,
    Request::Switch,
    Request::AsciiId,
    Request::SoftwareRevision,
    Request::SerialNumber,
    Request::SavedNumber,
    Request::ActiveNumber,
    Request::Status,
    Request::BitRate,
    Request::WatchdogId,
    Request::WatchdogTime,
    Request::Parameter(FIRST_TX_DELAY),
];

/// The kind of a module that was asked for its type.
pub(super) fn kind(answers: &Answers) -> Option<ModuleKind> {
    let Some(Answer::ModuleType(code)) = answer(answers, Request::ModuleType) else { return None };
    [ModuleKind::Sio1, ModuleKind::Sio4].into_iter().find(|kind| kind.code() == code)
}

/// The channels of a module, from 0; none of one that is not known.
pub(super) fn channels(answers: &Answers) -> std::ops::Range<u8> {
    0..kind(answers).map_or(0, ModuleKind::channels)
}

/// What is asked of a channel, 0 for the first, for a row.
pub(super) fn row_of_channel(channel: u8) -> [Request; 2] {
    [Request::TxId(channel), Request::RxId(channel)]
}

/// What is asked of a channel, 0 for the first.
pub(super) fn all_of_channel(channel: u8) -> [Request; 5] {
    [
        Request::TxId(channel),
        Request::RxId(channel),
        Request::TxActivateTime(channel),
        Request::Parameter(can_tx_mode_of(channel + 1)),
        Request::Parameter(serial_mode_of(channel + 1)),
    ]
}

fn answer(answers: &Answers, request: Request) -> Option<Answer> {
    answers.get(&request).copied().flatten()
}

/// As it was answered.
fn plain(answers: &Answers, request: Request) -> String {
    answer(answers, request).map_or_else(|| "no answer".to_owned(), |answer| answer.to_string())
}

/// A row of the list of modules.
pub(super) fn row(module: ModuleNumber, answers: &Answers) -> String {
    let ids = |of: fn(u8) -> Request| {
        let told: Vec<String> = channels(answers).map(|channel| plain(answers, of(channel))).collect();
        match told.as_slice() {
            [] => "?".to_owned(),
            [one] => one.clone(),
            [first, .., last] => format!("{first}..{}", last.trim_start_matches("0x")),
        }
    };
    let name = type_of(answers);
    let (switch, firmware) = (plain(answers, Request::Switch), plain(answers, Request::SoftwareRevision));
    let (serial, status) = (plain(answers, Request::SerialNumber), status(answers));
    let (tx, rx) = (ids(Request::TxId), ids(Request::RxId));
    format!(
        "{:<6}  {name:<12}  {switch:<6}  {firmware:<8}  {serial:<6}  {tx:<9}  {rx:<9}  {status}",
        module.to_string()
    )
}

/// The row of a module that was found and then said nothing.
pub(super) fn silent_row(module: ModuleNumber) -> String {
    format!("{:<6}  no answer", module.to_string())
}

fn type_of(answers: &Answers) -> String {
    kind(answers).map_or_else(|| plain(answers, Request::ModuleType), |kind| kind.model().to_owned())
}

/// All that a module told.
pub(super) fn all(module: ModuleNumber, answers: &Answers) -> Vec<String> {
    let mut lines = vec![format!("module {module}")];
    let mut line = |name: &str, text: String| lines.push(format!("  {name:<17} {text}"));
    line("type", format!("{} ({})", type_of(answers), plain(answers, Request::ModuleType)));
    line("name", plain(answers, Request::AsciiId));
    line("firmware", firmware(answers));
    line("serial number", plain(answers, Request::SerialNumber));
    line("coding switch", plain(answers, Request::Switch));
    line("number", numbers(answers));
    line("status", status(answers));
    line("CAN bit rate", bit_rate(answers));
    line("watchdog", watchdog(answers));
    line("first Tx delay", parameter(answers, FIRST_TX_DELAY, |value| format!("{value} ms")));
    for channel in channels(answers) {
        let number = channel + 1;
        lines.push(format!("channel {number}"));
        let mut line = |name: &str, text: String| lines.push(format!("  {name:<17} {text}"));
        line("from the line", plain(answers, Request::TxId(channel)));
        line("to the line", plain(answers, Request::RxId(channel)));
        line("Tx activate time", millis(answers, Request::TxActivateTime(channel)));
        line("packing", parameter(answers, can_tx_mode_of(number), packing));
        line("line", parameter(answers, serial_mode_of(number), serial));
    }
    lines
}

fn firmware(answers: &Answers) -> String {
    match answer(answers, Request::SoftwareRevision) {
        Some(Answer::Software(revision)) if revision.protocol() == 'C' => {
            format!("{revision}: for CAL/CMS, not the esd protocol")
        }
        _ => plain(answers, Request::SoftwareRevision),
    }
}

fn numbers(answers: &Answers) -> String {
    let active = plain(answers, Request::ActiveNumber);
    match answer(answers, Request::SavedNumber) {
        Some(Answer::Number(0)) => format!("{active}; none is stored: default parameters"),
        _ => format!("{active}; stored: {}", plain(answers, Request::SavedNumber)),
    }
}

/// The status byte and what its bits mean.
pub(super) fn status(answers: &Answers) -> String {
    match answer(answers, Request::Status) {
        Some(Answer::Status(status)) => format!("0x{:02X}: {}", status.0, bits(status)),
        _ => plain(answers, Request::Status),
    }
}

fn bits(status: CanStatus) -> String {
    let mut words = vec![if status.runs() { "runs" } else { "stopped" }];
    let named = [
        (status.is_suspended(), "suspended"),
        (status.had_can_error(), "had a CAN error"),
        (status.woke_with_defaults(), "default parameters"),
        (status.is_new_on_bus(), "new on the bus"),
    ];
    words.extend(named.into_iter().filter_map(|(holds, word)| holds.then_some(word)));
    words.join(", ")
}

/// The bit rate in its memory.
pub(super) fn bit_rate(answers: &Answers) -> String {
    match answer(answers, Request::BitRate) {
        Some(Answer::BitRate(registers)) => rate_text(registers),
        _ => plain(answers, Request::BitRate),
    }
}

/// A bit rate, from its registers or its index: no registers of the manual look like an index.
pub(super) fn rate_text(registers: [u8; 2]) -> String {
    let [first, second] = registers;
    if let (0, Some(rate)) = (first, CanBitRate::from_index(second)) {
        return format!("{} kbit/s (index 0x{second:X})", kbit(rate));
    }
    let rate = CanBitRate::from_registers(registers);
    let rate = rate.map_or_else(|| "none of the manual".to_owned(), |rate| format!("{} kbit/s", kbit(rate)));
    format!("{rate} (BTR 0x{first:02X} 0x{second:02X})")
}

fn watchdog(answers: &Answers) -> String {
    let time = match answer(answers, Request::WatchdogTime) {
        Some(Answer::WatchdogTime { millis: 0, .. }) => "off".to_owned(),
        _ => plain(answers, Request::WatchdogTime),
    };
    format!("{time}; identifier {}", plain(answers, Request::WatchdogId))
}

fn millis(answers: &Answers, request: Request) -> String {
    match answer(answers, request) {
        Some(Answer::Value(value)) => format!("{value} ms"),
        _ => plain(answers, request),
    }
}

/// A user parameter, and what it means.
fn parameter(answers: &Answers, number: u8, meaning: impl Fn(u16) -> String) -> String {
    match answer(answers, Request::Parameter(number)) {
        Some(Answer::Value(value)) => format!("0x{value:04X}: {}", meaning(value)),
        _ => plain(answers, Request::Parameter(number)),
    }
}

fn packing(value: u16) -> String {
    let Some(CanTxMode { inhibit, max_char, min_char }) = CanTxMode::from_value(value) else {
        return "not known".to_owned();
    };
    let when = match min_char {
        MinChar::Bytes(1) => "as soon as a character is there".to_owned(),
        MinChar::Bytes(count) => format!("as soon as {count} characters are there"),
        MinChar::Cr => "at CR".to_owned(),
        MinChar::Lf => "at LF".to_owned(),
        MinChar::CrDropped => "at CR, which is dropped".to_owned(),
        MinChar::LfDropped => "at LF, which is dropped".to_owned(),
        MinChar::CrDropsBoth => "at CR; CR and LF are dropped".to_owned(),
        MinChar::LfDropsBoth => "at LF; CR and LF are dropped".to_owned(),
    };
    format!("a frame {when}, of up to {max_char}; {inhibit} ms between frames")
}

fn serial(value: u16) -> String {
    let Some(mode) = SerialMode::from_value(value) else { return "not known".to_owned() };
    let (receive, transmit) = (mode.receive.bits_per_second(), mode.transmit.bits_per_second());
    let rate = if receive == transmit {
        format!("{receive} bit/s")
    } else {
        format!("receives {receive}, sends {transmit} bit/s")
    };
    let parity = match mode.format.parity {
        Parity::None => "no parity",
        Parity::Even => "even parity",
        Parity::Odd => "odd parity",
    };
    let (bits, stop) = (mode.format.data_bits, if mode.format.stop_bits == 2 { "set" } else { "clear" });
    let cts = if mode.cts { "CTS heeded" } else { "CTS ignored" };
    let rts = if mode.rts { "set" } else { "clear" };
    format!("{rate}, {bits} bits, {parity}, stop bit field {stop}, {cts}, RTS bit {rts}")
}
