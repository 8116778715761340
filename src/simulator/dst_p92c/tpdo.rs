//! TPDO1 of a DST P92C: what is in it and when it is due (sections 4 and 6 of the requirements). Pure.

use std::time::Duration;

use super::dictionary::Objects;
use super::object_table::Key;
use crate::can::CanId;
use crate::time::Instant;

/// Transmission type of a PDO that is sent after each SYNC (R-DST-040).
const SYNCHRONOUS: u32 = 0x01;
/// What is later than that starts a new count instead of catching up.
const TOLERANCE: Duration = Duration::from_millis(10);
/// Pressure and temperature, as float and as integer.
const MEASURED: [Key; 4] = [(0x6130, 1), (0x6130, 2), (0x9130, 1), (0x9130, 2)];

/// The PDO. Stopped when made.
#[derive(Clone, Debug, Default)]
pub struct Tpdo {
    running: bool,
    /// The event timer.
    timer: Option<Instant>,
    /// Something is to be told as soon as the inhibit time allows.
    wanted: Option<Instant>,
    /// The answer to a SYNC.
    after_sync: Option<Instant>,
    /// The last transmission; kept over stop and start, so that the inhibit time holds between them too.
    last: Option<Instant>,
    /// What the last one told, in the order of [`MEASURED`].
    told: [u32; 4],
}

impl Tpdo {
    /// The device became operational: the first comes at once, or after the first SYNC (R-DST-046).
    pub fn start(&mut self, now: Instant, objects: &Objects) {
        self.running = true;
        self.configure(now, objects);
        self.wanted = (!is_synchronous(objects)).then_some(now);
    }

    /// The device is no longer operational.
    pub fn stop(&mut self) {
        *self = Self { last: self.last, ..Self::default() };
    }

    /// Its parameters were written.
    pub fn configure(&mut self, now: Instant, objects: &Objects) {
        (self.timer, self.wanted, self.after_sync) = (None, None, None);
        if self.running && !is_synchronous(objects) {
            self.timer = event_timer(objects).map(|period| now + period);
        }
    }

    /// A SYNC was received; the answer comes after `delay`.
    pub fn handle_sync(&mut self, now: Instant, delay: Duration, objects: &Objects) {
        if self.running && is_synchronous(objects) {
            self.after_sync.get_or_insert(now + delay);
        }
    }

    /// The values may have changed (R-DST-042). The float and the integer delta hold beside each other.
    pub fn handle_values(&mut self, now: Instant, objects: &Objects) {
        if !self.running || is_synchronous(objects) || self.last.is_none() {
            return;
        }
        let changed = MEASURED.into_iter().zip(self.told).any(|(key, told)| {
            let (delta, change) = if key.0 == 0x6130 {
                let told = f64::from(f32::from_bits(told));
                (objects.float((0x6133, key.1)), (objects.float(key) - told).abs())
            } else {
                let change = objects.signed(key).abs_diff(told.cast_signed());
                (f64::from(objects.signed((0x9133, key.1))), f64::from(change))
            };
            delta > 0.0 && change >= delta
        });
        if changed {
            self.wanted.get_or_insert(now);
        }
    }

    /// When the next is due.
    #[must_use]
    pub fn due(&self, objects: &Objects) -> Option<Instant> {
        if self.after_sync.is_some() {
            return self.after_sync;
        }
        let asynchronous = [self.timer, self.wanted].into_iter().flatten().min()?;
        Some(self.last.map_or(asynchronous, |last| asynchronous.max(last + inhibit_time(objects))))
    }

    /// It is due: what is to be sent, unless the PDO is off.
    pub fn take(&mut self, now: Instant, objects: &Objects) -> Option<(CanId, Vec<u8>)> {
        let due = self.due(objects).unwrap_or(now);
        let counted_from = if now.since(due) <= TOLERANCE { due } else { now };
        if self.timer.is_some() {
            self.timer = event_timer(objects).map(|period| counted_from + period);
        }
        (self.wanted, self.after_sync, self.last) = (None, None, Some(now));
        self.told = MEASURED.map(|key| objects.raw(key));
        Some((identifier(objects)?, payload(objects)?))
    }
}

fn is_synchronous(objects: &Objects) -> bool {
    objects.raw((0x1800, 2)) == SYNCHRONOUS
}

/// 0 stops it (R-DST-041).
fn event_timer(objects: &Objects) -> Option<Duration> {
    let millis = objects.raw((0x1800, 5));
    (millis != 0).then(|| Duration::from_millis(u64::from(millis)))
}

/// In 100 us (R-DST-047).
fn inhibit_time(objects: &Objects) -> Duration {
    Duration::from_micros(100) * objects.raw((0x1800, 3))
}

/// `None` while the PDO is marked as not valid.
fn identifier(objects: &Objects) -> Option<CanId> {
    let cob_id = objects.raw((0x1800, 1));
    if cob_id & 0x8000_0000 != 0 {
        return None;
    }
    CanId::standard(u16::try_from(cob_id & 0x7FF).ok()?)
}

/// The mapped objects without gaps (R-DST-016); `None` while nothing is mapped (R-DST-021).
#[must_use]
pub fn payload(objects: &Objects) -> Option<Vec<u8>> {
    let count = u8::try_from(objects.raw((0x1A00, 0))).ok().filter(|count| *count > 0)?;
    let mut payload = Vec::new();
    for sub in 1..=count {
        // R-DST-015.
        let [_, sub, low, high] = objects.raw((0x1A00, sub)).to_le_bytes();
        payload.extend(objects.number((u16::from_le_bytes([low, high]), sub)));
    }
    payload.truncate(8);
    Some(payload)
}
