//! `cangate buffer plan`: how long what is kept for the broker lasts. \[IO\]

use super::args::{BufferArguments, BufferCommand, PlanArguments};
use super::output::{print_error, write_out};
use super::{Exit, load};
use crate::mqtt::plan::{Load, Plan};

/// Prints the plan.
pub(super) fn run(arguments: &BufferArguments) -> Exit {
    let BufferCommand::Plan(arguments) = &arguments.command;
    match load::configuration(&arguments.config) {
        Ok(loaded) => {
            let Some(settings) = &loaded.settings.mqtt else {
                print_error("this configuration has no [mqtt]: nothing is kept for a broker");
                return Exit::Configuration;
            };
            let plan = Plan::new(&loaded.table, settings);
            write_out(&text(&plan, arguments, settings.buffer_bytes), None)
        }
        Err(exit) => exit,
    }
}

fn text(plan: &Plan, arguments: &PlanArguments, configured: u64) -> String {
    let mut lines = vec![format!("{:<20}{:>12}{:>14}{:>14}", "node", "bytes", "per hour", "load")];
    for node in &plan.nodes {
        for (load, (bytes, states)) in Load::ALL.into_iter().zip(node.loads) {
            lines.push(format!("{:<20}{bytes:>12}{states:>14.0}{:>14}", node.name, load.word()));
        }
    }
    lines.push(String::new());
    let heading = match arguments.hours {
        Some(hours) => format!("{hours} h need"),
        None => format!("{} last", size(as_f64(arguments.bytes.unwrap_or(configured)))),
    };
    lines.push(format!("{:<12}{:>14}{heading:>20}", "load", "a day"));
    let answers = match arguments.hours {
        Some(hours) => plan.bytes(hours).map(size),
        None => plan.hours(arguments.bytes.unwrap_or(configured)).map(duration),
    };
    for ((load, rate), answer) in Load::ALL.into_iter().zip(plan.bytes_per_hour).zip(answers) {
        lines.push(format!("{:<12}{:>14}{answer:>20}", load.word(), size(rate * 24.0)));
    }
    lines.push(String::new());
    lines.push(
        "worst case: every node changes all the time (a state every history_interval_ms), an event a second; typical: every \
         node changes every\n3 s, an event a minute; quiet: nothing changes. When the room is used up the oldest states \
         leave, then events."
            .to_owned(),
    );
    lines.join("\n") + "\n"
}

fn size(bytes: f64) -> String {
    let units = ["B", "KiB", "MiB", "GiB", "TiB"];
    let mut left = bytes;
    let mut unit = 0;
    while left >= 1024.0 && unit + 1 < units.len() {
        left /= 1024.0;
        unit += 1;
    }
    format!("{left:.1} {}", units.get(unit).copied().unwrap_or_default())
}

fn duration(hours: f64) -> String {
    if hours >= 72.0 { format!("{:.1} days", hours / 24.0) } else { format!("{hours:.1} h") }
}

#[expect(clippy::as_conversions, clippy::cast_precision_loss, reason = "a figure for people")]
fn as_f64(bytes: u64) -> f64 {
    bytes as f64
}

/// A number of bytes: `1073741824`, `512M`, `1G` (powers of 1024).
pub(super) fn parse_size(text: &str) -> Result<u64, String> {
    let wrong = || format!("`{text}` is not a size; write 1073741824, 512M or 1G");
    let text_without = text.trim_end_matches("iB").trim_end_matches('B');
    let (digits, factor) = match text_without.chars().last() {
        Some('k' | 'K') => (text_without.get(..text_without.len() - 1), 1 << 10),
        Some('M') => (text_without.get(..text_without.len() - 1), 1 << 20),
        Some('G') => (text_without.get(..text_without.len() - 1), 1 << 30),
        Some('T') => (text_without.get(..text_without.len() - 1), 1 << 40),
        Some(_) | None => (Some(text_without), 1_u64),
    };
    let count: u64 = digits.unwrap_or_default().trim().parse().map_err(|_| wrong())?;
    count.checked_mul(factor).filter(|bytes| *bytes > 0).ok_or_else(wrong)
}

/// A number of hours above zero.
pub(super) fn parse_hours(text: &str) -> Result<f64, String> {
    let hours = text.parse().ok().filter(|hours: &f64| hours.is_finite() && *hours > 0.0);
    hours.ok_or_else(|| format!("`{text}` is not a number of hours"))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sizes_are_read_and_written() {
        assert_eq!(parse_size("1073741824"), Ok(1 << 30));
        assert_eq!(
            (parse_size("1G"), parse_size("512MiB"), parse_size("3K")),
            (Ok(1 << 30), Ok(512 << 20), Ok(3072))
        );
        for wrong in ["", "G", "-1", "1.5G", "0", "99999999999T", "é"] {
            assert!(parse_size(wrong).is_err(), "{wrong}");
        }
        assert_eq!(size(1024.0 * 1536.0), "1.5 MiB");
        assert!(parse_hours("0").is_err() && parse_hours("nan").is_err() && parse_hours("1.5").is_ok());
    }
}
