//! CAN buses inside the process, for `cangate demo` and for tests. \[IO\]
//!
//! Every participant hears all others and not itself, in one order for all, as on a real bus. There is no bit rate,
//! no arbitration and no error. A participant that reads too slowly loses the oldest frames and counts them in
//! [`Tally::overruns`] (its own among them); it never holds up the others.

use std::collections::BTreeMap;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Mutex, PoisonError};

use tokio::sync::broadcast::{self, error::RecvError};

use super::{BusError, BusEvent, BusReader, BusWriter, CanFrame, Link, Tally};
use crate::time::Clock;

/// How many frames a participant may be behind before it loses some: half a second of a full 1 Mbit/s bus.
const CAPACITY: usize = 4_096;

/// The buses of this process that somebody has open, by name.
static BUSES: Mutex<BTreeMap<String, broadcast::WeakSender<Sent>>> = Mutex::new(BTreeMap::new());

/// Makes participants tell their own frames from those of others; never used twice in a process.
static NEXT_PARTICIPANT: AtomicU64 = AtomicU64::new(0);

#[derive(Clone, Copy, Debug)]
struct Sent {
    by: u64,
    frame: CanFrame,
}

/// A bus that only those hear who hold a copy of it. Tests use it; programs [`join`] a bus by name.
#[derive(Clone, Debug)]
pub struct VirtualBus {
    frames: broadcast::Sender<Sent>,
}

impl Default for VirtualBus {
    fn default() -> Self {
        Self::with_capacity(CAPACITY)
    }
}

impl VirtualBus {
    /// A bus on which a participant may be `frames` behind (rounded up to a power of two) before it loses some.
    #[must_use]
    pub fn with_capacity(frames: usize) -> Self {
        Self { frames: broadcast::Sender::new(frames.max(1)) }
    }

    /// A new participant, its two halves. It hears what is sent from now on.
    #[must_use]
    pub fn join(&self, clock: Clock) -> (VirtualReader, VirtualWriter) {
        let id = NEXT_PARTICIPANT.fetch_add(1, Ordering::Relaxed);
        let reader = VirtualReader {
            id,
            clock,
            frames: self.frames.subscribe(),
            // Without this the reader of a bus whose writers are gone would fail instead of waiting.
            _bus: self.clone(),
            told_link: false,
            overruns: 0,
        };
        (reader, VirtualWriter { id, bus: self.clone() })
    }
}

/// Joins the bus of that name, which is made when nobody has it open and ends when the last participant leaves.
#[must_use]
pub fn join(name: &str, clock: Clock) -> (VirtualReader, VirtualWriter) {
    // Nothing that holds this lock can panic half-way, so a poisoned registry is still a good one.
    let mut buses = BUSES.lock().unwrap_or_else(PoisonError::into_inner);
    buses.retain(|_, frames| frames.strong_count() > 0);
    let bus = match buses.get(name).and_then(broadcast::WeakSender::upgrade) {
        Some(frames) => VirtualBus { frames },
        None => VirtualBus::default(),
    };
    buses.insert(name.to_owned(), bus.frames.downgrade());
    bus.join(clock)
}

/// The receiving half of a participant.
#[derive(Debug)]
pub struct VirtualReader {
    id: u64,
    clock: Clock,
    frames: broadcast::Receiver<Sent>,
    _bus: VirtualBus,
    told_link: bool,
    overruns: u64,
}

impl BusReader for VirtualReader {
    async fn recv(&mut self) -> Result<BusEvent, BusError> {
        if !self.told_link {
            self.told_link = true;
            return Ok(BusEvent::Link { link: Link::ErrorActive, at: self.clock.now() });
        }
        loop {
            match self.frames.recv().await {
                Ok(sent) if sent.by == self.id => {}
                Ok(sent) => return Ok(BusEvent::Frame { frame: sent.frame, at: self.clock.now() }),
                Err(RecvError::Lagged(lost)) => self.overruns = self.overruns.saturating_add(lost),
                Err(RecvError::Closed) => {
                    return Err(BusError::Io {
                        interface: "virtual".to_owned(),
                        source: std::io::Error::from(std::io::ErrorKind::BrokenPipe),
                    });
                }
            }
        }
    }

    fn tally(&self) -> Tally {
        Tally { overruns: self.overruns, ..Tally::default() }
    }
}

/// The sending half of a participant.
#[derive(Debug)]
pub struct VirtualWriter {
    id: u64,
    bus: VirtualBus,
}

impl BusWriter for VirtualWriter {
    /// Never fails: with nobody there to listen, the frame is simply not heard.
    async fn send(&mut self, frame: &CanFrame) -> Result<(), BusError> {
        // An error here says that nobody listens, and this participant's own reader may be among the dropped.
        let _ = self.bus.frames.send(Sent { by: self.id, frame: *frame });
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn frame(number: u16) -> CanFrame {
        CanFrame::data_frame(crate::can::CanId::Standard(0x181), &number.to_le_bytes()).unwrap()
    }

    async fn next_frame(reader: &mut VirtualReader) -> CanFrame {
        loop {
            if let BusEvent::Frame { frame, .. } = reader.recv().await.unwrap() {
                return frame;
            }
        }
    }

    #[tokio::test]
    async fn everyone_hears_the_others_and_not_itself() {
        let bus = VirtualBus::default();
        let clock = Clock::start();
        let (mut reader_a, mut writer_a) = bus.join(clock);
        let (mut reader_b, mut writer_b) = bus.join(clock);
        let (mut reader_c, _writer_c) = bus.join(clock);
        writer_a.send(&frame(1)).await.unwrap();
        writer_b.send(&frame(2)).await.unwrap();
        assert_eq!(next_frame(&mut reader_a).await, frame(2));
        assert_eq!(next_frame(&mut reader_b).await, frame(1));
        assert_eq!([next_frame(&mut reader_c).await, next_frame(&mut reader_c).await], [frame(1), frame(2)]);
    }

    #[tokio::test]
    async fn the_first_event_says_that_the_link_is_up() {
        let (mut reader, _writer) = VirtualBus::default().join(Clock::start());
        assert!(matches!(reader.recv().await.unwrap(), BusEvent::Link { link: Link::ErrorActive, .. }));
    }

    #[tokio::test]
    async fn a_slow_participant_loses_the_oldest_frames_and_counts_them() {
        let bus = VirtualBus::with_capacity(8);
        let (mut slow, _) = bus.join(Clock::start());
        let (_, mut writer) = bus.join(Clock::start());
        for number in 0..20 {
            writer.send(&frame(number)).await.unwrap();
        }
        assert_eq!(next_frame(&mut slow).await, frame(12));
        assert_eq!(slow.tally().overruns, 12);
    }

    #[tokio::test]
    async fn a_name_is_one_bus_and_another_name_another() {
        let clock = Clock::start();
        let (mut here, _w) = join("one-bus", clock);
        let (mut elsewhere, _v) = join("another-bus", clock);
        let (_, mut writer) = join("one-bus", clock);
        let (_, mut far_writer) = join("another-bus", clock);
        writer.send(&frame(7)).await.unwrap();
        far_writer.send(&frame(8)).await.unwrap();
        assert_eq!(next_frame(&mut here).await, frame(7));
        assert_eq!(next_frame(&mut elsewhere).await, frame(8));
    }

    #[tokio::test]
    async fn a_bus_that_all_have_left_is_forgotten() {
        drop(join("left-bus", Clock::start()));
        drop(join("unrelated", Clock::start()));
        let _still_here = join("somebody", Clock::start());
        let buses = BUSES.lock().unwrap_or_else(PoisonError::into_inner);
        assert!(!buses.contains_key("left-bus"));
    }
}
