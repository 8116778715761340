//! Refused requests on their way to the journal: somebody who asks again and again for what is not given cannot push alarms out
//! of it.

use std::collections::BTreeMap;
use std::time::Duration;

use super::CommandSource;
use crate::mapping::AlarmOwner;
use crate::process_image::{Event, Value};
use crate::time::Instant;

/// Refusals that are alike are journalled once in this time.
const WINDOW: Duration = Duration::from_secs(60);

/// Kinds of refusals that are counted apart. Those of further sources are counted as if they were of one.
const MOST_KINDS: usize = 64;

/// A request and what came of it.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct Report {
    /// Who asked.
    pub(super) source: CommandSource,
    /// Its word in the journal.
    pub(super) name: &'static str,
    /// It is an event of the kind "command", and not one of what it is about.
    pub(super) is_command: bool,
    pub(super) about: AlarmOwner,
    /// What came of it, in a word.
    pub(super) outcome: &'static str,
    /// What was asked for, and why it was not done.
    pub(super) text: String,
    /// How many requests it tells of.
    pub(super) count: u64,
}

impl Report {
    pub(super) fn fill(self, event: &mut Event) {
        event.from = self.source.to_string();
        self.outcome.clone_into(&mut event.to);
        event.text = self.text;
        // So that a reader can add up without reading texts.
        event.value = (self.count > 1).then_some(Value::Unsigned(self.count));
    }
}

/// The source, wherever on its host it asks from; the name; the outcome.
type Kind = (String, &'static str, &'static str);

/// Refusals that were journalled less than [`WINDOW`] ago, each with those alike that came since.
#[derive(Debug, Default)]
pub(super) struct Refusals {
    kinds: BTreeMap<Kind, Since>,
}

#[derive(Debug)]
struct Since {
    ends: Instant,
    /// How many, and the last of them.
    folded: Option<(u64, Report)>,
}

impl Refusals {
    /// A request was refused. Gives it back if it is to be journalled; else it is counted.
    pub(super) fn admit(&mut self, now: Instant, mut report: Report) -> Option<Report> {
        self.kinds.retain(|_, since| since.folded.is_some() || since.ends > now);
        let mut kind = (report.source.without_port().to_string(), report.name, report.outcome);
        if self.kinds.len() >= MOST_KINDS && !self.kinds.contains_key(&kind) {
            kind.0 = String::new();
        }
        let Some(since) = self.kinds.get_mut(&kind) else {
            self.kinds.insert(kind, Since { ends: now + WINDOW, folded: None });
            if report.count > 1 {
                report.text = format!("{} of these at once, the last: {}", report.count, report.text);
            }
            return Some(report);
        };
        let before = since.folded.take().map_or(0, |(count, _)| count);
        since.folded = Some((before.saturating_add(report.count), report));
        None
    }

    /// The last of each kind that was counted for long enough; its text tells how many.
    pub(super) fn take_due(&mut self, now: Instant) -> Vec<Report> {
        let due = self.kinds.values_mut().filter(|since| since.ends <= now);
        due.filter_map(|since| {
            let (count, mut report) = since.folded.take()?;
            since.ends = now + WINDOW;
            report.count = count;
            report.text =
                format!("{count} more of these within {} s, the last: {}", WINDOW.as_secs(), report.text);
            Some(report)
        })
        .collect()
    }

    /// The same of all kinds, whatever their time; nothing is remembered after it.
    pub(super) fn take_all(&mut self) -> Vec<Report> {
        let latest = self.kinds.values().map(|since| since.ends).max();
        let all = latest.map(|latest| self.take_due(latest)).unwrap_or_default();
        self.kinds.clear();
        all
    }

    /// When the next count is due.
    pub(super) fn poll_timeout(&self) -> Option<Instant> {
        self.kinds.values().filter(|since| since.folded.is_some()).map(|since| since.ends).min()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn refusal(who: &str, outcome: &'static str, text: &str) -> Report {
        Report {
            source: CommandSource::modbus(who.to_owned()),
            name: "sdo_write",
            is_command: true,
            about: AlarmOwner::Gateway,
            outcome,
            text: text.to_owned(),
            count: 1,
        }
    }

    fn at(seconds: u64) -> Instant {
        Instant::from_millis(seconds * 1000)
    }

    #[test]
    fn the_first_is_journalled_and_then_one_count_a_minute_from_whatever_port_they_come() {
        let mut refusals = Refusals::default();
        let mut told = Vec::new();
        for second in 0..150 {
            told.extend(refusals.take_due(at(second)));
            let peer = format!("10.0.0.7:{}", 1000 + second);
            told.extend(refusals.admit(at(second), refusal(&peer, "rejected", &second.to_string())));
        }
        let texts: Vec<&str> = told.iter().map(|report| report.text.as_str()).collect();
        assert_eq!(
            texts,
            [
                "0",
                "59 more of these within 60 s, the last: 59",
                "60 more of these within 60 s, the last: 119"
            ]
        );
        assert_eq!(refusals.poll_timeout(), Some(at(180)));
        assert_eq!(refusals.take_due(at(180)).len(), 1, "no refusal is forgotten");
        assert_eq!((refusals.take_due(at(240)).len(), refusals.poll_timeout()), (0, None));
        assert!(refusals.admit(at(240), refusal("10.0.0.7:1", "rejected", "")).is_some(), "a new beginning");
    }

    #[test]
    fn what_is_not_alike_is_journalled_by_itself() {
        let mut refusals = Refusals::default();
        for (who, outcome) in [
            ("10.0.0.7:1", "rejected"),
            ("10.0.0.8:1", "rejected"),
            ("10.0.0.7:1", "aborted"),
            ("[fd00::1]:1", "rejected"),
        ] {
            assert!(refusals.admit(at(0), refusal(who, outcome, "")).is_some(), "{who} {outcome}");
            assert!(refusals.admit(at(1), refusal(who, outcome, "")).is_none(), "{who} {outcome}");
        }
    }

    #[test]
    fn s2_however_many_sources_there_are_the_kinds_are_bounded_and_every_refusal_is_told_of() {
        let mut refusals = Refusals::default();
        let mut told = 0;
        for source in 0..10_000_u32 {
            let peer = format!("{}:1", core::net::Ipv4Addr::from_bits(source));
            told += usize::from(refusals.admit(at(0), refusal(&peer, "rejected", "")).is_some());
        }
        assert_eq!((told, refusals.kinds.len()), (MOST_KINDS + 1, MOST_KINDS + 1));
        let due = refusals.take_due(at(60));
        assert!(due[0].text.starts_with(&format!("{} more", 10_000 - told)), "{}", due[0].text);
    }
}
