//! Derived tags: values computed from other tags of the node, with what they have to remember.
//!
//! Quality is the worst of what was looked at, with two refinements. Where candidates have a validity tag, those that
//! are known to be invalid are left out; with none left the value is bad (no input), and the last one stays
//! (R-DET-084). What is not known to be invalid takes its part: a validity that cannot be used spoils the result
//! (R-DET-087). Edges are looked for only in values that can be used: a bit that goes stale and comes back as it was
//! has no edge. A bit that is already set when it is received for the first time counts as a rise, so that a latch
//! shows it.

use std::collections::VecDeque;
use std::time::Duration;

use crate::mapping::{Derived, codec};
use crate::process_image::{Quality, Reason, Sample, TagIndex, Value};
use crate::time::{Instant, Now};

/// "Never, or too long ago" of [`Derived::SecondsSinceRise`].
const NEVER_ROSE: u64 = 65_535;

/// Edges that [`Derived::EdgesWithin`] remembers; the count stops there.
const MOST_RECENT_EDGES: usize = 1_000;

/// What came out.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Computed {
    pub(super) raw: Value,
    pub(super) value: Value,
    pub(super) quality: Quality,
}

impl Computed {
    fn plain(value: Value, quality: Quality) -> Self {
        Self { raw: value, value, quality }
    }
}

/// What a derived tag remembers between evaluations; most kinds use nothing of it.
#[derive(Debug, Default)]
pub(super) struct Memory {
    /// The source as it was when it could last be used.
    level: bool,
    rises: u16,
    latched: bool,
    risen_at: Option<Instant>,
    recent: VecDeque<Instant>,
}

impl Memory {
    /// Looks for an edge; the new level where there is one.
    fn observe(&mut self, now: Now, source: &Sample) -> Option<bool> {
        let level = source.value.is_true();
        if !source.quality.is_usable() || level == self.level {
            return None;
        }
        self.level = level;
        if level {
            self.rises = self.rises.wrapping_add(1);
            self.latched = true;
            self.risen_at = Some(source.received_at.unwrap_or(now.instant));
        }
        Some(level)
    }

    /// Opens a latch whose source is not set. Whether that changed it.
    pub(super) fn acknowledge(&mut self) -> bool {
        let opens = self.latched && !self.level;
        self.latched &= self.level;
        opens
    }

    fn seconds_since_rise(&self, now: Now) -> u64 {
        self.risen_at.map_or(NEVER_ROSE, |at| now.instant.since(at).as_secs().min(NEVER_ROSE))
    }

    fn edges_within(&mut self, now: Now, window: Duration) -> u64 {
        while self.recent.front().is_some_and(|at| now.instant.since(*at) > window) {
            self.recent.pop_front();
        }
        u64::try_from(self.recent.len()).unwrap_or(u64::MAX)
    }

    fn remember_edge(&mut self, at: Instant) {
        if self.recent.len() == MOST_RECENT_EDGES {
            self.recent.pop_front();
        }
        self.recent.push_back(at);
    }
}

/// Whether the value changes by mere time, so that it has to be evaluated once a second.
pub(super) fn runs_with_time(derived: &Derived, memory: &Memory, now: Now) -> bool {
    match derived {
        Derived::SecondsSinceRise { .. } => memory.seconds_since_rise(now) < NEVER_ROSE,
        Derived::EdgesWithin { .. } => !memory.recent.is_empty(),
        Derived::Bit { .. }
        | Derived::Pack { .. }
        | Derived::Logic { .. }
        | Derived::Maximum { .. }
        | Derived::ArgMaximum { .. }
        | Derived::Margin { .. }
        | Derived::Count { .. }
        | Derived::RisingEdges { .. }
        | Derived::Latch { .. }
        | Derived::Constant { .. } => false,
    }
}

/// What a derived tag shows before there is anything to compute it from: zero, of the kind that it will be of.
pub(super) fn nothing(derived: &Derived) -> Value {
    match derived {
        Derived::Bit { .. } | Derived::Logic { .. } | Derived::Latch { .. } => Value::Bool(false),
        Derived::Maximum { .. } | Derived::Margin { .. } | Derived::Constant { .. } => Value::Float(0.0),
        Derived::Pack { .. }
        | Derived::ArgMaximum { .. }
        | Derived::Count { .. }
        | Derived::RisingEdges { .. }
        | Derived::SecondsSinceRise { .. }
        | Derived::EdgesWithin { .. } => Value::Unsigned(0),
    }
}

/// The value of a derived tag now; `before` is what it was. For [`Derived::RisingEdges`] also the edge of its source,
/// where there was one.
pub(super) fn evaluate(
    now: Now,
    derived: &Derived,
    memory: &mut Memory,
    before: &Sample,
    tags: &[Sample],
) -> (Computed, Option<(TagIndex, bool)>) {
    let computed = match derived {
        Derived::Bit { of, bit } => {
            let source = sample(tags, *of);
            let set = codec::raw_bits(source.raw).checked_shr(u32::from(*bit)).unwrap_or(0) & 1 == 1;
            Computed::plain(Value::Bool(set), source.quality)
        }
        Derived::Pack { of } => pack(tags, of),
        Derived::Logic { when } => {
            let (holds, quality) = when.evaluate(&|tag| {
                let source = sample(tags, tag);
                (source.value, source.quality)
            });
            Computed::plain(Value::Bool(holds), quality)
        }
        Derived::Maximum { among, valid } => match highest(tags, among, valid.as_deref()) {
            Ok(best) => Computed { raw: best.sample.raw, value: best.sample.value, quality: best.quality },
            Err(quality) => Computed { raw: before.raw, value: before.value, quality },
        },
        Derived::ArgMaximum { among, valid, numbers } => match highest(tags, among, valid.as_deref()) {
            Ok(best) => {
                let number = numbers.get(best.place).copied().map_or(0, u64::from);
                Computed::plain(Value::Unsigned(number), best.quality)
            }
            Err(quality) => Computed::plain(before.value, quality),
        },
        Derived::Margin { among, valid, limit } => {
            let limit = sample(tags, *limit);
            match highest(tags, among, valid.as_deref()) {
                Ok(best) => {
                    let margin = limit.value.as_f64() - best.sample.value.as_f64();
                    Computed::plain(Value::Float(margin), best.quality.worst(limit.quality))
                }
                Err(quality) => Computed::plain(before.value, quality.worst(limit.quality)),
            }
        }
        Derived::Count { of } => count(tags, of),
        Derived::RisingEdges { of } => {
            let source = sample(tags, *of);
            let edge = memory.observe(now, source).map(|level| (*of, level));
            let computed = Computed::plain(Value::Unsigned(u64::from(memory.rises)), source.quality);
            return (computed, edge);
        }
        Derived::SecondsSinceRise { of } => {
            let source = sample(tags, *of);
            memory.observe(now, source);
            Computed::plain(Value::Unsigned(memory.seconds_since_rise(now)), source.quality)
        }
        Derived::Latch { of } => {
            let source = sample(tags, *of);
            memory.observe(now, source);
            Computed::plain(Value::Bool(memory.latched), source.quality)
        }
        Derived::EdgesWithin { of, window } => {
            let source = sample(tags, *of);
            if memory.observe(now, source) == Some(true) {
                memory.remember_edge(now.instant);
            }
            Computed::plain(Value::Unsigned(memory.edges_within(now, *window)), source.quality)
        }
        Derived::Constant { value } => Computed::plain(Value::Float(*value), Quality::Good),
    };
    (computed, None)
}

fn sample(tags: &[Sample], tag: TagIndex) -> &Sample {
    tags.get(tag.0).unwrap_or(&Sample::NEVER)
}

fn pack(tags: &[Sample], of: &[TagIndex]) -> Computed {
    let (bits, quality) = of.iter().rev().fold((0_u64, Quality::Good), |(bits, quality), tag| {
        let source = sample(tags, *tag);
        (bits << 1 | u64::from(source.value.is_true()), quality.worst(source.quality))
    });
    Computed::plain(Value::Unsigned(bits), quality)
}

fn count(tags: &[Sample], of: &[TagIndex]) -> Computed {
    let (number, quality) = of.iter().fold((0_u64, Quality::Good), |(number, quality), tag| {
        let source = sample(tags, *tag);
        (number + u64::from(source.value.is_true()), quality.worst(source.quality))
    });
    Computed::plain(Value::Unsigned(number), quality)
}

/// The best candidate.
struct Best<'a> {
    place: usize,
    sample: &'a Sample,
    /// The worst of all valid candidates: any of them could have been the highest.
    quality: Quality,
}

/// The highest valid candidate, the first among equals; a NaN never is the highest unless there is nothing else.
/// Where no candidate is valid: the quality that tells why.
fn highest<'a>(
    tags: &'a [Sample],
    among: &[TagIndex],
    valid: Option<&[TagIndex]>,
) -> Result<Best<'a>, Quality> {
    let mut best: Option<Best<'a>> = None;
    // The worst of what tells which of them are valid: one that cannot be used may leave out the wrong ones.
    let mut validity = Quality::Good;
    for (place, tag) in among.iter().enumerate() {
        let candidate = sample(tags, *tag);
        if let Some(tells) = valid.and_then(|valid| valid.get(place)) {
            let tells = sample(tags, *tells);
            if !tells.quality.is_usable() || tells.value.is_true() {
                validity = validity.worst(tells.quality);
            }
            if !tells.value.is_true() {
                continue;
            }
        }
        best = Some(match best {
            None => Best { place, sample: candidate, quality: candidate.quality },
            Some(so_far) => {
                let quality = so_far.quality.worst(candidate.quality);
                let (old, new) = (so_far.sample.value.as_f64(), candidate.value.as_f64());
                if new > old || (old.is_nan() && !new.is_nan()) {
                    Best { place, sample: candidate, quality }
                } else {
                    Best { quality, ..so_far }
                }
            }
        });
    }
    let why = if validity.is_usable() { Quality::Bad(Reason::NoInput) } else { validity };
    best.map(|best| Best { quality: best.quality.worst(validity), ..best }).ok_or(why)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::mapping::Expression;

    fn good(value: Value) -> Sample {
        Sample { raw: value, value, quality: Quality::Good, ..Sample::NEVER }
    }

    fn number(value: f64) -> Sample {
        good(Value::Float(value))
    }

    fn bit(value: bool) -> Sample {
        good(Value::Bool(value))
    }

    fn with(quality: Quality, sample: Sample) -> Sample {
        Sample { quality, ..sample }
    }

    fn indexes(range: std::ops::Range<usize>) -> Vec<TagIndex> {
        range.map(TagIndex).collect()
    }

    fn once(derived: &Derived, tags: &[Sample]) -> (Value, Quality) {
        let before = Sample { value: nothing(derived), ..Sample::NEVER };
        let (computed, _) = evaluate(Now::from_millis(0), derived, &mut Memory::default(), &before, tags);
        (computed.value, computed.quality)
    }

    const STALE: Quality = Quality::Stale(Reason::PdoTimeout);
    const NO_INPUT: Quality = Quality::Bad(Reason::NoInput);

    #[test]
    fn a_bit_of_a_number() {
        let tags = [good(Value::Unsigned(0x8001))];
        let of = TagIndex(0);
        assert_eq!(once(&Derived::Bit { of, bit: 15 }, &tags), (Value::Bool(true), Quality::Good));
        assert_eq!(once(&Derived::Bit { of, bit: 14 }, &tags), (Value::Bool(false), Quality::Good));
        assert_eq!(once(&Derived::Bit { of, bit: 200 }, &tags), (Value::Bool(false), Quality::Good));
    }

    #[test]
    fn bits_packed_into_a_number_the_first_lowest() {
        let tags = [bit(true), bit(false), with(STALE, bit(true))];
        assert_eq!(once(&Derived::Pack { of: indexes(0..3) }, &tags), (Value::Unsigned(5), STALE));
        assert_eq!(once(&Derived::Count { of: indexes(0..2) }, &tags), (Value::Unsigned(1), Quality::Good));
    }

    #[test]
    fn a_condition_has_the_worst_quality_of_its_tags() {
        let when = Expression::And(vec![Expression::Tag(TagIndex(0)), Expression::Tag(TagIndex(1))]);
        let tags = [bit(true), with(STALE, bit(true))];
        assert_eq!(once(&Derived::Logic { when }, &tags), (Value::Bool(true), STALE));
    }

    #[test]
    fn r_det_086_the_highest_is_looked_for_among_valid_candidates_only() {
        let tags = [number(3.0), number(9.0), number(3.0), bit(true), bit(false), bit(true), number(10.0)];
        let (among, valid) = (indexes(0..3), Some(indexes(3..6)));
        let maximum = Derived::Maximum { among: among.clone(), valid: valid.clone() };
        assert_eq!(once(&maximum, &tags), (Value::Float(3.0), Quality::Good));
        let which =
            Derived::ArgMaximum { among: among.clone(), valid: valid.clone(), numbers: vec![4, 5, 9] };
        assert_eq!(once(&which, &tags), (Value::Unsigned(4), Quality::Good), "the first among equals");
        let margin = Derived::Margin { among, valid, limit: TagIndex(6) };
        assert_eq!(once(&margin, &tags), (Value::Float(7.0), Quality::Good));
    }

    #[test]
    fn a_candidate_that_is_left_out_does_not_spoil_the_quality_and_a_valid_one_does() {
        let derived = Derived::Maximum { among: indexes(0..2), valid: Some(indexes(2..4)) };
        let left_out = [number(3.0), with(STALE, number(9.0)), bit(true), bit(false)];
        assert_eq!(once(&derived, &left_out), (Value::Float(3.0), Quality::Good));
        let valid = [number(3.0), with(STALE, number(1.0)), bit(true), bit(true)];
        assert_eq!(once(&derived, &valid), (Value::Float(3.0), STALE));
    }

    #[test]
    fn r_det_087_an_unknown_validity_spoils_the_quality() {
        let derived = Derived::Maximum { among: indexes(0..2), valid: Some(indexes(2..4)) };
        let values = [number(3.0), number(9.0)];
        for (validity, quality) in [
            (Sample::NEVER, Quality::NEVER),
            (with(STALE, bit(false)), STALE),
            (with(Quality::Uncertain(Reason::NodeLost), bit(false)), Quality::Good),
        ] {
            let tags = [values[0], values[1], bit(true), validity];
            assert_eq!(once(&derived, &tags), (Value::Float(3.0), quality));
        }
        let believed = [values[0], values[1], bit(true), with(STALE, bit(true))];
        assert_eq!(once(&derived, &believed), (Value::Float(9.0), STALE), "valid when it was known last");
    }

    #[test]
    fn with_no_valid_candidate_the_value_is_bad_says_why_and_the_last_one_stays() {
        let derived = Derived::Maximum { among: indexes(0..1), valid: Some(indexes(1..2)) };
        assert_eq!(once(&derived, &[number(3.0), bit(false)]), (Value::Float(0.0), NO_INPUT));
        assert_eq!(once(&derived, &[number(3.0), Sample::NEVER]), (Value::Float(0.0), Quality::NEVER));
        let (before, tags) = (number(7.0), [number(3.0), bit(false)]);
        let (computed, _) = evaluate(Now::from_millis(0), &derived, &mut Memory::default(), &before, &tags);
        assert_eq!((computed.value, computed.quality), (Value::Float(7.0), NO_INPUT));
    }

    #[test]
    fn a_number_that_is_none_is_never_the_highest() {
        let derived = Derived::Maximum { among: indexes(0..3), valid: None };
        let (value, _) = once(&derived, &[number(f64::NAN), number(-1.0), number(f64::NAN)]);
        assert_eq!(value, Value::Float(-1.0));
    }

    /// Feeds levels of a bit, one second apart; `None` is a stale moment.
    fn run(derived: &Derived, levels: &[Option<bool>]) -> Vec<Value> {
        let mut memory = Memory::default();
        let mut last = false;
        let steps = (0_u64..).zip(levels);
        steps
            .map(|(second, level)| {
                last = level.unwrap_or(last);
                let quality = if level.is_some() { Quality::Good } else { STALE };
                let tags = [with(quality, bit(last))];
                evaluate(Now::from_millis(second * 1_000), derived, &mut memory, &Sample::NEVER, &tags)
                    .0
                    .value
            })
            .collect()
    }

    const PULSES: [Option<bool>; 7] =
        [Some(true), None, Some(true), Some(false), None, Some(true), Some(false)];

    #[test]
    fn rises_are_counted_the_first_reception_included_and_staleness_is_no_edge() {
        let counts = [1, 1, 1, 1, 1, 2, 2].map(Value::Unsigned);
        assert_eq!(run(&Derived::RisingEdges { of: TagIndex(0) }, &PULSES), counts);
    }

    #[test]
    fn the_count_of_rises_wraps_at_16_bit() {
        let mut memory = Memory { rises: u16::MAX, ..Memory::default() };
        let derived = Derived::RisingEdges { of: TagIndex(0) };
        let (computed, edge) =
            evaluate(Now::from_millis(0), &derived, &mut memory, &Sample::NEVER, &[bit(true)]);
        assert_eq!((computed.value, edge), (Value::Unsigned(0), Some((TagIndex(0), true))));
    }

    #[test]
    fn seconds_since_a_rise_run_on_without_data_and_end_at_65535() {
        let derived = Derived::SecondsSinceRise { of: TagIndex(0) };
        assert_eq!(run(&derived, &[Some(false)]), [Value::Unsigned(65_535)]);
        assert_eq!(run(&derived, &PULSES), [0, 1, 2, 3, 4, 0, 1].map(Value::Unsigned));
        let mut memory = Memory::default();
        evaluate(Now::from_millis(0), &derived, &mut memory, &Sample::NEVER, &[bit(true)]);
        assert!(runs_with_time(&derived, &memory, Now::from_millis(65_534_999)));
        assert!(!runs_with_time(&derived, &memory, Now::from_millis(65_535_000)));
    }

    #[test]
    fn a_latch_stays_until_it_is_acknowledged_while_its_source_is_false() {
        let derived = Derived::Latch { of: TagIndex(0) };
        let mut memory = Memory::default();
        let value = |memory: &mut Memory, level| {
            evaluate(Now::from_millis(0), &derived, memory, &Sample::NEVER, &[bit(level)]).0.value
        };
        assert_eq!(value(&mut memory, false), Value::Bool(false));
        assert_eq!(value(&mut memory, true), Value::Bool(true));
        assert!(!memory.acknowledge(), "its source is still set");
        assert_eq!(value(&mut memory, false), Value::Bool(true));
        assert!(memory.acknowledge());
        assert_eq!(value(&mut memory, false), Value::Bool(false));
    }

    #[test]
    fn edges_leave_the_window_with_time() {
        let derived = Derived::EdgesWithin { of: TagIndex(0), window: Duration::from_secs(2) };
        let levels = [Some(true), Some(false), Some(true), Some(false), Some(false), Some(false)];
        assert_eq!(run(&derived, &levels), [1, 1, 2, 1, 1, 0].map(Value::Unsigned));
    }
}
