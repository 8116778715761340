//! A full bus: frames at a steady rate, counted.

use std::time::{Duration, Instant};

use socketcan::{CanDataFrame, CanSocket, EmbeddedFrame, Socket, StandardId};

use super::bus::BUS;

/// What a flood was.
#[derive(Clone, Copy, Debug)]
pub struct Sent {
    /// Frames of each identifier asked for.
    pub each: u32,
    /// All of them.
    pub frames: u32,
    /// How long it took.
    pub time: Duration,
}

/// How often a burst is sent; the smallest that a machine with a 100 Hz clock keeps.
const BURST_PERIOD: Duration = Duration::from_millis(10);

/// What is made up for after a delay; more would be a burst such as no bus can carry.
const CAUGHT_UP: Duration = Duration::from_millis(200);

/// Sends `rate` frames a second for `time`, the identifiers in turn, each frame with other data. The number of frames is
/// exact; a sender that was kept from running for long takes longer.
pub fn flood(ids: &[(u16, usize)], rate: u32, time: Duration) -> Sent {
    let socket = CanSocket::open(BUS).unwrap();
    let each = rate * u32::try_from(time.as_secs()).unwrap() / u32::try_from(ids.len()).unwrap();
    let begin = Instant::now();
    let (mut frames, mut behind) = (0, Duration::ZERO);
    for round in 0..each {
        for (id, length) in ids {
            let data = u64::from(round).to_le_bytes();
            let frame = CanDataFrame::new(StandardId::new(*id).unwrap(), &data[..*length]).unwrap();
            socket.write_frame_insist(&frame).unwrap();
            frames += 1;
        }
        let due = BURST_PERIOD * (frames * 100 / rate) + behind;
        let now = begin.elapsed();
        behind += now.saturating_sub(due + CAUGHT_UP);
        std::thread::sleep(due.saturating_sub(now));
    }
    Sent { each, frames, time: begin.elapsed() }
}
