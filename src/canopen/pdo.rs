//! Reception of the TPDOs of one node: length rules (R-DET-080, R-DET-081) and timeout (R-DET-082).

use std::time::Duration;

use super::{PdoIndex, PdoSettings};
use crate::time::Instant;

/// The TPDOs of one node.
#[derive(Debug)]
pub(super) struct Pdos {
    pdos: Vec<Pdo>,
    /// The node is operational, or was told to be: frames are expected.
    supervised: bool,
}

#[derive(Debug)]
struct Pdo {
    settings: PdoSettings,
    /// When it is late; `None` where it is not supervised, and after it was reported until the next frame.
    deadline: Option<Instant>,
    /// Its length is not known: the node is being asked what it carries.
    asked: bool,
}

/// What a frame's length makes of it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Length {
    /// As the mapping says.
    Right,
    /// Too long; its first bytes count.
    TooLong,
    /// Too short, or too long where that is not tolerated: nothing of it counts.
    Discarded,
}

impl Pdos {
    /// Not supervised yet.
    pub(super) fn new(settings: Vec<PdoSettings>) -> Self {
        let pdos =
            settings.into_iter().map(|settings| Pdo { settings, deadline: None, asked: false }).collect();
        Self { pdos, supervised: false }
    }

    /// The node sends another number of bytes than was thought.
    pub(super) fn set_length(&mut self, index: PdoIndex, length: u8) {
        if let Some(pdo) = self.pdos.get_mut(index.0) {
            pdo.settings.length = length;
            pdo.asked = false;
        }
    }

    /// The node is asked what some TPDOs carry: until it has said so, every length is right.
    pub(super) fn forget_lengths(&mut self, asked: impl Fn(PdoIndex) -> bool) {
        for (place, pdo) in self.pdos.iter_mut().enumerate() {
            pdo.asked = asked(PdoIndex(place));
        }
    }

    /// The node sends by another event timer than was thought; what is awaited already is awaited as before.
    pub(super) fn set_timeout(&mut self, index: PdoIndex, timeout: Option<Duration>) {
        if let Some(pdo) = self.pdos.get_mut(index.0) {
            pdo.settings.timeout = timeout;
            pdo.deadline = pdo.deadline.filter(|_| timeout.is_some());
        }
    }

    /// Whether one follows SYNC.
    pub(super) fn is_synchronous(&self, index: PdoIndex) -> bool {
        self.pdos.get(index.0).is_some_and(|pdo| pdo.settings.synchronous)
    }

    /// How many bytes it has.
    pub(super) fn length(&self, index: PdoIndex) -> Option<u8> {
        self.pdos.get(index.0).map(|pdo| pdo.settings.length)
    }

    /// A frame of this length came. A discarded one does not count as received. `None`: there is no such TPDO.
    pub(super) fn receive(&mut self, now: Instant, index: PdoIndex, dlc: u8) -> Option<Length> {
        let pdo = self.pdos.get_mut(index.0)?;
        let length = match dlc.cmp(&pdo.settings.length) {
            _ if pdo.asked => Length::Right,
            std::cmp::Ordering::Less => Length::Discarded,
            std::cmp::Ordering::Greater if pdo.settings.strict_length => Length::Discarded,
            std::cmp::Ordering::Greater => Length::TooLong,
            std::cmp::Ordering::Equal => Length::Right,
        };
        if self.supervised && length != Length::Discarded {
            pdo.deadline = pdo.settings.timeout.map(|timeout| now + timeout);
        }
        Some(length)
    }

    /// The node was started, or is operational: from now on frames are expected. Does nothing while they are already.
    pub(super) fn supervise(&mut self, now: Instant) {
        if !self.supervised {
            self.supervised = true;
            for pdo in &mut self.pdos {
                pdo.deadline = pdo.settings.timeout.map(|timeout| now + timeout);
            }
        }
    }

    /// The node is not operational, or lost, or the bus cannot be used: no frames are expected.
    pub(super) fn stop(&mut self) {
        self.supervised = false;
        for pdo in &mut self.pdos {
            pdo.deadline = None;
        }
    }

    /// The next TPDO that is late, each told once until it is received again; call until `None`.
    pub(super) fn next_late(&mut self, now: Instant) -> Option<PdoIndex> {
        let late = |pdo: &Pdo| pdo.deadline.is_some_and(|deadline| deadline <= now);
        let index = self.pdos.iter().position(late)?;
        self.pdos.get_mut(index)?.deadline = None;
        Some(PdoIndex(index))
    }

    /// When the next one will be late.
    pub(super) fn poll_timeout(&self) -> Option<(Instant, &'static str)> {
        self.pdos.iter().filter_map(|pdo| pdo.deadline).min().map(|deadline| (deadline, "PDO timeout"))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::can::CanId;

    fn at(millis: u64) -> Instant {
        Instant::from_millis(millis)
    }

    fn pdos(lengths: &[u8], strict_length: bool) -> Pdos {
        let settings = lengths.iter().zip(1..).map(|(&length, number)| PdoSettings {
            number,
            cob_id: CanId::Standard(0x081 + 0x100 * number),
            length,
            strict_length,
            timeout: Some(Duration::from_millis(1500)),
            synchronous: false,
            shortest_period: None,
        });
        Pdos::new(settings.collect())
    }

    #[test]
    fn r_det_080_and_081_length_rules() {
        let mut tolerant = pdos(&[8, 6], false);
        let mut strict = pdos(&[8, 6], true);
        for dlc in 0..=8 {
            let expected = match dlc {
                8 => Length::Right,
                _ => Length::Discarded,
            };
            assert_eq!(tolerant.receive(at(0), PdoIndex(0), dlc), Some(expected));
            let (lenient, strictly) = match dlc {
                0..=5 => (Length::Discarded, Length::Discarded),
                6 => (Length::Right, Length::Right),
                _ => (Length::TooLong, Length::Discarded),
            };
            assert_eq!(tolerant.receive(at(0), PdoIndex(1), dlc), Some(lenient));
            assert_eq!(strict.receive(at(0), PdoIndex(1), dlc), Some(strictly));
        }
        assert_eq!(tolerant.receive(at(0), PdoIndex(2), 8), None);
    }

    #[test]
    fn r_det_082_each_tpdo_is_late_on_its_own_and_told_once() {
        let mut pdos = pdos(&[8, 8], false);
        assert_eq!(pdos.poll_timeout(), None, "not before the node is started");
        pdos.supervise(at(0));
        pdos.receive(at(1000), PdoIndex(1), 8);
        pdos.supervise(at(1400));
        assert_eq!(pdos.poll_timeout(), Some((at(1500), "PDO timeout")));
        assert_eq!(pdos.next_late(at(1499)), None);
        assert_eq!(pdos.next_late(at(1500)), Some(PdoIndex(0)));
        assert_eq!(pdos.next_late(at(1500)), None);
        assert_eq!(pdos.next_late(at(2500)), Some(PdoIndex(1)));
        pdos.receive(at(3000), PdoIndex(0), 8);
        assert_eq!(pdos.next_late(at(4499)), None);
        assert_eq!(pdos.next_late(at(4500)), Some(PdoIndex(0)));
    }

    #[test]
    fn r_det_080_a_short_frame_does_not_refresh_the_timeout() {
        let mut pdos = pdos(&[8], false);
        pdos.supervise(at(0));
        pdos.receive(at(1400), PdoIndex(0), 3);
        assert_eq!(pdos.next_late(at(1500)), Some(PdoIndex(0)));
    }

    #[test]
    fn a_node_that_is_not_operational_owes_no_tpdo() {
        let mut pdos = pdos(&[8], false);
        pdos.supervise(at(0));
        pdos.stop();
        pdos.receive(at(100), PdoIndex(0), 8);
        assert_eq!(pdos.next_late(at(60_000)), None);
    }
}
