//! What the CANopen master needs to know of a node: from the mapping, changed by the installation.

use std::collections::BTreeMap;
use std::time::Duration;

use super::super::At;
use super::super::SourceText;
use super::super::file::{MappingFile, MappingWord, TagSection, TpdoSection};
use super::super::installation::{ErrorControlWord, NodeEntry, TpdoEntry};
use super::boot;
use super::emergency;
use super::problems::Problems;
use super::tags::Context;
use super::{rpdo, sync, writable};
use crate::canopen::boot::BootSettings;
use crate::canopen::object::{MappedObject, ObjectId};
use crate::canopen::sdo::SdoSettings;
use crate::canopen::{ErrorControl, GuardingSettings, NodeId, NodeSettings, PdoSettings, StartSettings};

/// A node that has shown no frame for so long after the start is reported (R-DET-001).
const NEVER_SEEN_AFTER: Duration = Duration::from_secs(5);
/// Longest time that a TPDO may take, in ms.
const LONGEST_PERIOD: u64 = 3_600_000;
/// No TPDO is called late sooner than this, however fast SYNC is.
const SHORTEST_TIMEOUT: Duration = Duration::from_millis(10);

/// The settings of a node.
pub fn settings(problems: &mut Problems, context: &Context<'_>, id: NodeId) -> NodeSettings {
    let error_control = error_control(problems, context);
    let steps = boot::steps(problems, context);
    let mut polls = boot::polls(problems, context);
    polls.extend(emergency::poll(problems, context));
    let pdos = context.tpdos.iter().map(|tpdo| {
        let pdo = pdo(problems, context, id, tpdo);
        // Whether one that is adopted has an event timer is seen when the device is asked.
        if pdo.timeout.is_none() && !(tpdo.is_adopted() && is_untimed(context, tpdo.section)) {
            warn_of_silence(problems, context, tpdo, error_control == ErrorControl::None);
        }
        pdo
    });
    NodeSettings {
        id,
        pdos: pdos.collect(),
        error_control,
        start: start(problems, context),
        // Without SDO none of the steps is done, but what they would see to is believed.
        sdo: ((!steps.is_empty() || !polls.is_empty() || writable::any(context))
            && context.entry.configure != Some(false))
        .then(|| sdo(problems, context)),
        boot: BootSettings { steps, self_starting: is_self_starting(context), ..BootSettings::default() },
        polls,
        rpdos: rpdo::settings(problems, context, id),
        emergency: context.file.emergency.cob_id.as_ref().map(|at| at.value.of(id)),
        never_seen_after: NEVER_SEEN_AFTER,
    }
}

fn sdo(problems: &mut Problems, context: &Context<'_>) -> SdoSettings {
    let (file, entry) = (&context.file.start, context.entry);
    let defaults = SdoSettings::default();
    let timeout = either(context, entry.sdo_timeout_ms.as_ref(), file.sdo_timeout_ms.as_ref());
    let store = either(context, entry.store_timeout_ms.as_ref(), file.store_timeout_ms.as_ref());
    SdoSettings {
        timeout: milliseconds(problems, timeout, "sdo_timeout_ms", 10..=60_000, defaults.timeout),
        store_timeout: milliseconds(
            problems,
            store,
            "store_timeout_ms",
            100..=60_000,
            defaults.store_timeout,
        ),
        ..defaults
    }
}

/// Whether the node starts by itself.
fn is_self_starting(context: &Context<'_>) -> bool {
    context.entry.self_starting.or(context.file.start.self_starting).unwrap_or(false)
}

/// The heartbeat that the node is to send, with the file that it stands in.
pub fn heartbeat<'a>(context: &'a Context<'_>) -> Option<(&'a SourceText, &'a At<u64>)> {
    either(context, context.entry.heartbeat_ms.as_ref(), context.file.error_control.heartbeat_ms.as_ref())
}

/// A TPDO without a timeout: its values stay good for ever, so that has to be meant. Where nothing else watches the node it
/// cannot be.
fn warn_of_silence(problems: &mut Problems, context: &Context<'_>, tpdo: &Tpdo<'_>, unwatched: bool) {
    let off = either(context, context.entry.pdo_timeout_ms.as_ref(), tpdo.section.timeout_ms.as_ref());
    let (source, span) = off.map_or((context.source, &tpdo.key.span), |(source, at)| (source, &at.span));
    if unwatched {
        let message = format!(
            "TPDO {} is not supervised and the node neither guarded nor sends heartbeats: nobody would notice that the \
             device is gone",
            tpdo.key.value
        );
        problems.warning(source, span, message, "give the TPDO a time-out, or the node an error control");
    } else if off.is_none() {
        let message = format!(
            "TPDO {} is not supervised: when it no longer comes, its last values stay good",
            tpdo.key.value
        );
        let hint = "give it `period_ms` or `timeout_ms`; `timeout_ms = 0` says that it is meant so";
        problems.warning(source, span, message, hint);
    }
}

/// A number that the installation may set instead of the mapping, with the file that it stands in.
pub fn either<'a>(
    context: &Context<'a>,
    installation: Option<&'a At<u64>>,
    mapping: Option<&'a At<u64>>,
) -> Option<(&'a SourceText, &'a At<u64>)> {
    installation.map(|at| (context.config, at)).or(mapping.map(|at| (context.source, at)))
}

fn milliseconds(
    problems: &mut Problems,
    number: Option<(&SourceText, &At<u64>)>,
    what: &str,
    limits: std::ops::RangeInclusive<u64>,
    default: Duration,
) -> Duration {
    number.map_or(default, |(source, at)| problems.milliseconds(source, Some(at), what, limits, default))
}

fn error_control(problems: &mut Problems, context: &Context<'_>) -> ErrorControl {
    let (file, entry) = (&context.file.error_control, context.entry);
    let defaults = GuardingSettings::default();
    let guard_time = either(context, entry.guard_time_ms.as_ref(), file.guard_time_ms.as_ref());
    let reply = either(context, entry.guard_reply_ms.as_ref(), file.guard_reply_ms.as_ref());
    let factor = either(context, entry.life_time_factor.as_ref(), file.life_time_factor.as_ref());
    let timeout = heartbeat_timeout(problems, context);
    let life_time_factor =
        factor.map(|(source, at)| problems.within(source, at, "life_time_factor", 1..=255));
    let rtr_dlc = file.rtr_dlc.as_ref().map(|at| problems.within(context.source, at, "rtr_dlc", 0..=8));
    let settle = problems.milliseconds(
        context.source,
        file.settle_ms.as_ref(),
        "settle_ms",
        0..=10_000,
        defaults.settle,
    );
    let off = guard_time.is_some_and(|(_, at)| at.value == 0);
    let guard_time = if off {
        Duration::ZERO
    } else {
        milliseconds(problems, guard_time, "guard_time_ms", 20..=65_535, defaults.guard_time)
    };
    let mut reply_timeout =
        milliseconds(problems, reply, "guard_reply_ms", 1..=65_535, defaults.reply_timeout);
    if reply_timeout > guard_time && !off {
        if let Some((source, at)) = reply {
            let message = format!(
                "guard_reply_ms {} is longer than guard_time_ms {}",
                at.value,
                guard_time.as_millis()
            );
            let hint = "a reply must come before the next request: use the guard time at most";
            problems.error(source, &at.span, message, hint);
        }
        reply_timeout = guard_time;
    }
    match kind(problems, context) {
        ErrorControlWord::None => ErrorControl::None,
        ErrorControlWord::Guarding if off => ErrorControl::None,
        ErrorControlWord::Heartbeat => ErrorControl::Heartbeat { timeout },
        ErrorControlWord::Guarding => ErrorControl::Guarding(GuardingSettings {
            guard_time,
            life_time_factor: byte(life_time_factor, defaults.life_time_factor),
            reply_timeout,
            toggle: entry.toggle_check.unwrap_or(file.toggle_check).into(),
            toggle_resync: file.toggle_resync,
            rtr_dlc: byte(rtr_dlc, defaults.rtr_dlc),
            settle,
        }),
    }
}

/// How the node is watched. A device that sends heartbeats answers no guard requests (CiA 301, 7.2.8.2.2; R-DST-063).
fn kind(problems: &mut Problems, context: &Context<'_>) -> ErrorControlWord {
    let (file, entry) = (&context.file.error_control, context.entry);
    let kind = entry.error_control.as_ref().map_or(file.kind, |at| at.value);
    if kind == ErrorControlWord::Guarding
        && let Some((source, heartbeat)) = heartbeat(context)
    {
        let own = entry.heartbeat_ms.is_some();
        let at = entry.error_control.as_ref().filter(|_| !own).map(|at| (context.config, &at.span));
        let (source, span) = at.unwrap_or((source, &heartbeat.span));
        let message = "the device is told to send heartbeats and cannot be guarded as well";
        let hint = if own {
            "write `error_control = \"heartbeat\"`, or leave `heartbeat_ms` out"
        } else {
            "use `heartbeat`, or take `heartbeat_ms` out of the mapping"
        };
        problems.error(source, span, message, hint);
    }
    kind
}

/// The time after which a heartbeat is missed. One that is not longer than the time between two misses every one of them.
fn heartbeat_timeout(problems: &mut Problems, context: &Context<'_>) -> Duration {
    let (file, entry) = (&context.file.error_control, context.entry);
    // The time-out of the mapping is meant for the heartbeat of the mapping.
    let own = file.heartbeat_timeout_ms.as_ref().filter(|_| entry.heartbeat_ms.is_none());
    let after = either(context, entry.heartbeat_timeout_ms.as_ref(), own);
    let heartbeat = heartbeat(context).map(|(_, at)| at.value);
    if let Some(((source, at), heartbeat)) =
        after.zip(heartbeat).filter(|((_, at), every)| at.value <= *every)
    {
        let message =
            format!("heartbeat_timeout_ms {} is not longer than heartbeat_ms {heartbeat}", at.value);
        let hint = "give the time-out about three times the heartbeat, or leave it out";
        problems.error(source, &at.span, message, hint);
    }
    let usual = Duration::from_millis(3 * heartbeat.map_or(500, |millis| millis.min(65_535)));
    milliseconds(problems, after, "heartbeat_timeout_ms", 10..=65_535, usual)
}

fn byte(number: Option<u64>, default: u8) -> u8 {
    number.and_then(|number| u8::try_from(number).ok()).unwrap_or(default)
}

fn start(problems: &mut Problems, context: &Context<'_>) -> StartSettings {
    let (file, entry) = (&context.file.start, context.entry);
    let defaults = StartSettings::default();
    let delay = either(context, entry.start_delay_ms.as_ref(), file.start_delay_ms.as_ref());
    let confirm = either(context, entry.start_confirm_ms.as_ref(), file.start_confirm_ms.as_ref());
    let retry = either(context, entry.start_retry_ms.as_ref(), file.start_retry_ms.as_ref());
    StartSettings {
        auto_start: entry.auto_start.or(file.auto_start).unwrap_or(defaults.auto_start)
            && !is_self_starting(context),
        delay: milliseconds(problems, delay, "start_delay_ms", 0..=65_535, defaults.delay),
        confirm: milliseconds(problems, confirm, "start_confirm_ms", 10..=65_535, defaults.confirm),
        retry: milliseconds(problems, retry, "start_retry_ms", 10..=65_535, defaults.retry),
        reset_on_recovery: entry.reset_on_recovery.unwrap_or(file.reset_on_recovery),
    }
}

fn pdo(problems: &mut Problems, context: &Context<'_>, id: NodeId, pdo: &Tpdo<'_>) -> PdoSettings {
    let (source, key, tpdo) = (context.source, pdo.key, pdo.section);
    let number = pdo_number(problems, source, "tpdo", key);
    let length = checked_length(problems, source, &pdo.frame());
    let millis = |problems: &mut Problems, at: &Option<At<u64>>, what: &str| {
        at.as_ref().map(|at| Duration::from_millis(problems.within(source, at, what, 1..=LONGEST_PERIOD)))
    };
    let period = millis(problems, &tpdo.period_ms, "period_ms");
    let shortest_period = millis(problems, &tpdo.shortest_period_ms, "shortest_period_ms");
    let cycle = sync::cycle(problems, context, pdo);
    let timeout = either(context, context.entry.pdo_timeout_ms.as_ref(), tpdo.timeout_ms.as_ref());
    let timeout = match timeout {
        Some((_, at)) if at.value == 0 => None,
        None if cycle.is_synchronous => cycle.period.map(|period| (3 * period).max(SHORTEST_TIMEOUT)),
        None => period.or(event_timer(context, pdo)).map(|period| 3 * period),
        Some((source, at)) => {
            Some(Duration::from_millis(problems.within(source, at, "timeout", 10..=LONGEST_PERIOD)))
        }
    };
    for bits in &tpdo.reserved_bits {
        let [first, count] = bits.value;
        if count == 0 || first.saturating_add(count) > length * 8 {
            let message = format!(
                "bits {first} to {} do not lie in {length} bytes",
                first.saturating_add(count).saturating_sub(1)
            );
            let hint = "write [first bit, how many]; byte b bit i is bit 8 b + i";
            problems.error(source, &bits.span, message, hint);
        }
    }
    PdoSettings {
        number,
        cob_id: tpdo.cob_id.value.of(id),
        length: u8::try_from(length).unwrap_or(8),
        strict_length: context.entry.strict_dlc.unwrap_or(tpdo.strict_dlc),
        timeout,
        synchronous: cycle.is_synchronous,
        shortest_period: shortest_period.map(|shortest| cycle.period.map_or(shortest, |it| it.min(shortest))),
    }
}

/// Whether nothing says within which time a TPDO has to come.
pub fn is_untimed(context: &Context<'_>, tpdo: &TpdoSection) -> bool {
    context.entry.pdo_timeout_ms.is_none() && tpdo.timeout_ms.is_none() && tpdo.period_ms.is_none()
}

/// The event timer, where it runs.
fn event_timer(context: &Context<'_>, tpdo: &Tpdo<'_>) -> Option<Duration> {
    let (_, at) = tpdo.event_timer(context)?;
    Some(Duration::from_millis(at.value)).filter(|timer| !timer.is_zero())
}

/// The number of a PDO, by the name of its table; 0 where that is none, which is told.
pub fn pdo_number(problems: &mut Problems, source: &SourceText, word: &str, key: &At<String>) -> u16 {
    let number = key.value.parse::<u16>().ok().filter(|number| (1..=512).contains(number));
    if number.is_none_or(|number| number.to_string() != key.value) {
        let message = format!("`{}` is not the number of a {}", key.value, word.to_uppercase());
        problems.error(source, &key.span, message, format!("write [{word}.1] to [{word}.512]"));
    }
    number.unwrap_or_default()
}

/// The frame of a PDO, whichever way it goes.
#[derive(Clone, Copy, Debug)]
pub struct Frame<'a> {
    /// `TPDO` or `RPDO`.
    pub what: &'static str,
    /// Its number as it is written.
    pub key: &'a At<String>,
    /// What it carries.
    pub maps: &'a [At<String>],
    /// Its bytes, where they do not follow from that.
    pub length: Option<&'a At<u64>>,
    /// The device says how long it is.
    pub is_adopted: bool,
}

impl Frame<'_> {
    /// Its bytes, from what it maps or as they are written.
    pub fn length(&self) -> Option<u64> {
        let mapped = self.maps.iter().filter_map(|entry| mapped(&entry.value));
        let bits: u64 = mapped.map(|each| u64::from(each.bits)).sum();
        if self.maps.is_empty() { self.length.map(|at| at.value) } else { Some(bits.div_ceil(8)) }
    }
}

/// The bytes of a PDO; 8 where they are not known, which is told.
pub fn checked_length(problems: &mut Problems, source: &SourceText, frame: &Frame<'_>) -> u64 {
    for entry in frame.maps {
        if mapped(&entry.value).is_none() {
            let message = format!("`{}` is no mapped object", entry.value);
            problems.error(source, &entry.span, message, "write index, sub-index and bits: \"0x6130:1/32\"");
        }
    }
    if let (Some(at), Some(length)) = (frame.length, frame.length())
        && at.value != length
        && frame.maps.iter().all(|entry| mapped(&entry.value).is_some())
    {
        let message =
            format!("`maps` of {} {} takes {length} bytes, not {}", frame.what, frame.key.value, at.value);
        problems.error(source, &at.span, message, "leave `length` out: it follows from `maps`");
    }
    let span = frame.maps.first().map(|entry| &entry.span).or(frame.length.map(|at| &at.span));
    let Some((length, span)) = frame.length().zip(span) else {
        if frame.is_adopted {
            return 8;
        }
        let message = format!("the length of {} {} is not known", frame.what, frame.key.value);
        problems.error(source, &frame.key.span, message, "give it `length`, or `maps`");
        return 8;
    };
    problems.within(source, &At { value: length, span: span.clone() }, "length", 1..=8)
}

/// What TPDOs have in a device as it is shipped.
pub fn shipped_lengths(problems: &mut Problems, context: &Context<'_>) -> BTreeMap<u16, u8> {
    let lengths = context.tpdos.iter().filter_map(|tpdo| {
        let at = tpdo.section.shipped_length.as_ref()?;
        let length = problems.within(context.source, at, "shipped_length", 1..=8);
        Some((u16::try_from(tpdo.number).ok()?, u8::try_from(length).ok()?))
    });
    lengths.collect()
}

/// `0x6130:1/32`.
pub fn mapped(text: &str) -> Option<MappedObject> {
    let (object, bits) = text.split_once('/')?;
    let bits: u8 = bits.parse().ok().filter(|bits| (1..=64).contains(bits))?;
    Some(MappedObject { object: object.parse().ok()?, bits })
}

/// An object by its text.
pub fn object(problems: &mut Problems, source: &SourceText, text: &At<String>) -> Option<ObjectId> {
    match text.value.parse::<ObjectId>() {
        Ok(object) => Some(object),
        Err(error) => {
            problems.error(source, &text.span, error.to_string(), "for example \"0x6130:1\"");
            None
        }
    }
}

/// Where an object stands in a PDO that carries these.
pub fn bit_of(maps: &[At<String>], object: ObjectId) -> Option<u64> {
    let mut bit = 0;
    for entry in maps {
        let entry = mapped(&entry.value)?;
        if entry.object == object {
            return Some(bit);
        }
        bit += u64::from(entry.bits);
    }
    None
}

/// The number of the TPDO that the file has an object in, and its bit there. One that is adopted counts for nothing: the
/// device has the last word on it.
pub fn in_pdo(context: &Context<'_>, object: ObjectId) -> Option<(u64, u64)> {
    let mut known = context.tpdos.iter().filter(|tpdo| !tpdo.is_adopted());
    known.find_map(|tpdo| Some((tpdo.number, bit_of(&tpdo.section.maps, object)?)))
}

/// The object and period of a tag that no TPDO maps.
pub fn polled<'a>(context: &Context<'_>, section: &'a TagSection) -> Option<(ObjectId, &'a At<u64>)> {
    let object = section.object.as_ref()?.value.parse().ok()?;
    Some((object, section.poll_ms.as_ref()?))
        .filter(|_| in_pdo(context, object).is_none() && section.rpdo.is_none())
}

/// The object of a tag that is looked for in the TPDOs that are adopted.
pub fn adopted(context: &Context<'_>, section: &TagSection) -> Option<ObjectId> {
    let object = section.object.as_ref()?.value.parse().ok()?;
    let adopts = context.tpdos.iter().any(Tpdo::is_adopted);
    Some(object).filter(|object| adopts && section.rpdo.is_none() && in_pdo(context, *object).is_none())
}

/// One TPDO of a mapping.
#[derive(Clone, Copy, Debug)]
pub struct Tpdo<'a> {
    /// Its number.
    pub number: u64,
    /// The number as it is written.
    pub key: &'a At<String>,
    /// Its entry.
    pub section: &'a TpdoSection,
    /// What the installation changes of it.
    pub changes: Option<&'a TpdoEntry>,
}

impl<'a> Tpdo<'a> {
    /// All of a mapping, by their numbers.
    pub fn all(file: &'a MappingFile, entry: &'a NodeEntry) -> Vec<Self> {
        let number = |key: &At<String>| key.value.parse().unwrap_or(u64::MAX);
        let tpdo = |(key, section)| Self { number: number(key), key, section, changes: entry.tpdo.get(key) };
        let mut all: Vec<Self> = file.tpdo.iter().map(tpdo).collect();
        all.sort_by_key(|tpdo| tpdo.number);
        all
    }

    /// Its transmission type, with the file that it stands in.
    pub fn transmission_type<'c>(&self, context: &'c Context<'_>) -> Option<(&'c SourceText, &'c At<u64>)>
    where
        'a: 'c,
    {
        let changed = self.changes.and_then(|changes| changes.transmission_type.as_ref());
        either(context, changed, self.section.transmission_type.as_ref())
    }

    /// Its event timer.
    pub fn event_timer<'c>(&self, context: &'c Context<'_>) -> Option<(&'c SourceText, &'c At<u64>)>
    where
        'a: 'c,
    {
        let changed = self.changes.and_then(|changes| changes.event_timer_ms.as_ref());
        either(context, changed, self.section.event_timer_ms.as_ref())
    }

    /// Its inhibit time.
    pub fn inhibit_time<'c>(&self, context: &'c Context<'_>) -> Option<(&'c SourceText, &'c At<u64>)>
    where
        'a: 'c,
    {
        let changed = self.changes.and_then(|changes| changes.inhibit_time_us.as_ref());
        either(context, changed, self.section.inhibit_time_us.as_ref())
    }

    /// Whether it is taken as the device has it.
    pub fn is_adopted(&self) -> bool {
        self.section.mapping == MappingWord::Adopt
    }

    /// Its frame.
    pub fn frame(&self) -> Frame<'a> {
        let section = self.section;
        Frame {
            what: "TPDO",
            key: self.key,
            maps: &section.maps,
            length: section.length.as_ref(),
            is_adopted: self.is_adopted(),
        }
    }

    /// Whether its number is none.
    pub fn is_misnamed(&self) -> bool {
        self.number == u64::MAX
    }

    /// Its reserved bits as a mask.
    pub fn reserved_bits(&self) -> u64 {
        let bits = self.section.reserved_bits.iter().flat_map(|bits| {
            let [first, count] = bits.value;
            first..first.saturating_add(count).min(64)
        });
        bits.filter(|bit| *bit < 64).fold(0, |mask, bit| mask | 1 << bit)
    }
}
