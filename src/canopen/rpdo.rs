//! RPDOs of one node: what the gateway sends it, and when.
//!
//! Nothing is sent unless the node takes part: it is operational, heard, configured, and not ordered elsewhere. Nothing is
//! sent of an RPDO of which not all values are known, or that the node takes otherwise than its mapping file.

use std::time::Duration;

use super::{RpdoIndex, RpdoSettings, RpdoTrigger};
use crate::can::CanFrame;
use crate::time::Instant;

/// A change that did not leave is sent again after this long.
const RETRY: Duration = Duration::from_millis(100);

/// The RPDOs of one node.
#[derive(Debug)]
pub(super) struct Rpdos {
    rpdos: Vec<Rpdo>,
    running: bool,
}

#[derive(Debug)]
struct Rpdo {
    settings: RpdoSettings,
    /// `None` until all its values are known.
    data: Option<[u8; 8]>,
    /// The node takes it as the mapping file says, as far as is known.
    agreed: bool,
    /// The data is to be sent although no time for it has come.
    changed: bool,
    due: Option<Instant>,
    sent: Option<Instant>,
    /// SYNCs since it was sent.
    syncs: u8,
}

/// An RPDO that is sent now.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Sent {
    pub(super) rpdo: RpdoIndex,
    pub(super) data: [u8; 8],
    pub(super) frame: CanFrame,
}

impl Rpdos {
    /// Without data: nothing is sent.
    pub(super) fn new(settings: Vec<RpdoSettings>) -> Self {
        let rpdo = |settings| Rpdo {
            settings,
            data: None,
            agreed: true,
            changed: false,
            due: None,
            sent: None,
            syncs: 0,
        };
        Self { rpdos: settings.into_iter().map(rpdo).collect(), running: false }
    }

    /// Whether the node has none.
    pub(super) fn is_empty(&self) -> bool {
        self.rpdos.is_empty()
    }

    /// The settings of one.
    pub(super) fn settings(&self, index: RpdoIndex) -> Option<&RpdoSettings> {
        self.rpdos.get(index.0).map(|rpdo| &rpdo.settings)
    }

    /// The node takes part, or no longer; whether that is news. When it begins, everything is sent.
    pub(super) fn set_running(&mut self, now: Instant, running: bool) -> bool {
        if std::mem::replace(&mut self.running, running) == running {
            return false;
        }
        for rpdo in &mut self.rpdos {
            rpdo.changed = true;
            rpdo.syncs = 0;
            rpdo.plan(now, running);
        }
        true
    }

    /// What one carries; `None` where a value is missing.
    pub(super) fn set_data(&mut self, now: Instant, index: RpdoIndex, data: Option<[u8; 8]>) {
        let running = self.running;
        if let Some(rpdo) = self.rpdos.get_mut(index.0).filter(|rpdo| rpdo.data != data) {
            rpdo.data = data;
            rpdo.changed = true;
            rpdo.plan(now, running);
        }
    }

    /// Whether the node takes one as the mapping file says.
    pub(super) fn set_agreed(&mut self, now: Instant, index: RpdoIndex, agreed: bool) {
        let running = self.running;
        if let Some(rpdo) = self.rpdos.get_mut(index.0) {
            rpdo.agreed = agreed;
            rpdo.plan(now, running);
        }
    }

    /// A SYNC was sent, or heard: those that follow it are due.
    pub(super) fn handle_sync(&mut self, now: Instant) {
        for rpdo in self.rpdos.iter_mut().filter(|_| self.running) {
            let RpdoTrigger::Sync(every) = rpdo.settings.trigger else { continue };
            rpdo.syncs = rpdo.syncs.saturating_add(1);
            let wanted = if every == 0 { rpdo.changed } else { rpdo.syncs >= every };
            rpdo.due = (wanted && rpdo.is_ready(self.running)).then_some(now);
        }
    }

    /// The next that is due; call until `None`.
    pub(super) fn take_due(&mut self, now: Instant) -> Option<Sent> {
        let due = |rpdo: &Rpdo| rpdo.due.is_some_and(|due| due <= now);
        let place = self.rpdos.iter().position(due)?;
        let rpdo = self.rpdos.get_mut(place)?;
        rpdo.due = None;
        let data = rpdo.data?;
        let length = usize::from(rpdo.settings.length);
        let frame = CanFrame::data_frame(rpdo.settings.cob_id, data.get(..length)?)?;
        rpdo.changed = false;
        rpdo.syncs = 0;
        rpdo.sent = Some(now);
        rpdo.plan(now, true);
        Some(Sent { rpdo: RpdoIndex(place), data, frame })
    }

    /// A frame of ours did not leave: which RPDO it was. It is sent again, with what it carries then.
    pub(super) fn handle_not_sent(&mut self, now: Instant, frame: &CanFrame) -> Option<RpdoIndex> {
        let is_it = |rpdo: &Rpdo| rpdo.settings.cob_id == frame.id() && !frame.is_remote();
        let place = self.rpdos.iter().position(is_it)?;
        let running = self.running;
        let rpdo = self.rpdos.get_mut(place)?;
        rpdo.changed = true;
        match rpdo.settings.trigger {
            // It follows the next SYNC, however many it waits for as a rule.
            RpdoTrigger::Sync(every) => rpdo.syncs = every,
            RpdoTrigger::Event if rpdo.is_ready(running) => rpdo.due = Some(now + RETRY),
            RpdoTrigger::Event => {}
        }
        Some(RpdoIndex(place))
    }

    /// When the next is due.
    pub(super) fn poll_timeout(&self) -> Option<(Instant, &'static str)> {
        self.rpdos.iter().filter_map(|rpdo| rpdo.due).min().map(|due| (due, "RPDO"))
    }
}

impl Rpdo {
    fn is_ready(&self, running: bool) -> bool {
        running && self.agreed && self.data.is_some()
    }

    /// When it is due: a change as soon as the inhibit time allows, the same again after the refresh time, but no sooner. After a SYNC
    /// nothing is planned before that comes.
    fn plan(&mut self, now: Instant, running: bool) {
        let earliest = self.sent.map_or(now, |sent| now.max(sent + self.settings.inhibit));
        let refresh = self.settings.refresh.map(|refresh| refresh.max(self.settings.inhibit));
        let refresh = refresh.zip(self.sent).map(|(refresh, sent)| (sent + refresh).max(now));
        self.due = match self.settings.trigger {
            _ if !self.is_ready(running) => None,
            RpdoTrigger::Sync(_) => None,
            RpdoTrigger::Event if self.changed => Some(earliest),
            RpdoTrigger::Event => refresh,
        };
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::can::CanId;

    fn at(millis: u64) -> Instant {
        Instant::from_millis(millis)
    }

    fn one(trigger: RpdoTrigger, refresh: Option<u64>) -> Rpdos {
        Rpdos::new(vec![RpdoSettings {
            number: 1,
            cob_id: CanId::Standard(0x201),
            length: 2,
            trigger,
            refresh: refresh.map(Duration::from_millis),
            inhibit: Duration::from_millis(10),
        }])
    }

    fn set(rpdos: &mut Rpdos, millis: u64, byte: u8) {
        rpdos.set_data(at(millis), RpdoIndex(0), Some([byte, 0, 0, 0, 0, 0, 0, 0]));
    }

    /// What is sent up to a time, as `time frame`.
    fn run(rpdos: &mut Rpdos, end: u64) -> Vec<String> {
        let mut sent = Vec::new();
        while let Some((due, _)) = rpdos.poll_timeout().filter(|(due, _)| *due <= at(end)) {
            while let Some(Sent { frame, .. }) = rpdos.take_due(due) {
                sent.push(format!("{} {frame}", due.as_millis()));
            }
        }
        sent
    }

    #[test]
    fn nothing_is_sent_before_the_node_takes_part_and_all_values_are_known() {
        let mut rpdos = one(RpdoTrigger::Event, Some(100));
        assert!(rpdos.set_running(at(0), true));
        assert_eq!(run(&mut rpdos, 1000), Vec::<String>::new(), "no data");
        rpdos.set_running(at(1000), false);
        set(&mut rpdos, 1000, 7);
        assert_eq!(run(&mut rpdos, 2000), Vec::<String>::new(), "not running");
        assert!(rpdos.set_running(at(2000), true));
        assert!(!rpdos.set_running(at(2001), true));
        assert_eq!(run(&mut rpdos, 2250), ["2000 201#0700", "2100 201#0700", "2200 201#0700"]);
        rpdos.set_data(at(2260), RpdoIndex(0), None);
        assert_eq!(run(&mut rpdos, 9000), Vec::<String>::new(), "a value is missing again");
    }

    #[test]
    fn a_change_is_sent_at_once_but_not_faster_than_the_inhibit_time() {
        let mut rpdos = one(RpdoTrigger::Event, None);
        rpdos.set_running(at(0), true);
        let mut sent = Vec::new();
        for millis in 0..35_u8 {
            set(&mut rpdos, millis.into(), millis);
            sent.extend(run(&mut rpdos, millis.into()));
        }
        assert_eq!(sent, ["0 201#0000", "10 201#0A00", "20 201#1400", "30 201#1E00"]);
        assert_eq!(run(&mut rpdos, 60_000), ["40 201#2200"], "the last one is not lost");
        set(&mut rpdos, 70_000, 34);
        assert_eq!(run(&mut rpdos, 80_000), Vec::<String>::new(), "no change, no frame");
    }

    #[test]
    fn the_same_is_not_sent_again_faster_than_the_inhibit_time() {
        let mut rpdos = one(RpdoTrigger::Event, Some(4));
        set(&mut rpdos, 0, 1);
        rpdos.set_running(at(0), true);
        assert_eq!(run(&mut rpdos, 25), ["0 201#0100", "10 201#0100", "20 201#0100"]);
    }

    #[test]
    fn a_synchronous_one_that_did_not_leave_follows_the_next_sync() {
        for every in [0, 5] {
            let mut rpdos = one(RpdoTrigger::Sync(every), None);
            rpdos.set_running(at(0), true);
            set(&mut rpdos, 0, 1);
            let mut syncs = 1..=20_u64;
            let mut next = |rpdos: &mut Rpdos| {
                syncs.find_map(|sync| {
                    rpdos.handle_sync(at(100 * sync));
                    rpdos.take_due(at(100 * sync)).map(|sent| (sync, sent.frame))
                })
            };
            let (sync, frame) = next(&mut rpdos).unwrap();
            rpdos.handle_not_sent(at(100 * sync + 1), &frame);
            assert_eq!(next(&mut rpdos), Some((sync + 1, frame)), "type {every}");
        }
    }

    #[test]
    fn a_node_that_takes_it_otherwise_is_sent_nothing() {
        let mut rpdos = one(RpdoTrigger::Event, Some(100));
        rpdos.set_agreed(at(0), RpdoIndex(0), false);
        set(&mut rpdos, 0, 1);
        rpdos.set_running(at(0), true);
        assert_eq!(run(&mut rpdos, 1000), Vec::<String>::new());
        rpdos.set_agreed(at(1000), RpdoIndex(0), true);
        assert_eq!(run(&mut rpdos, 1050), ["1000 201#0100"]);
    }

    #[test]
    fn synchronous_ones_follow_every_nth_sync_and_acyclic_ones_the_next_after_a_change() {
        for (every, expected) in [(1, vec![1, 2, 3, 4, 5, 6]), (3, vec![3, 6]), (0, vec![1, 4])] {
            let mut rpdos = one(RpdoTrigger::Sync(every), None);
            rpdos.set_running(at(0), true);
            set(&mut rpdos, 0, 1);
            let mut after = Vec::new();
            for sync in 1..=6 {
                if sync == 4 {
                    set(&mut rpdos, 350, 2);
                }
                assert_eq!(rpdos.take_due(at(100 * sync - 1)), None, "not between two");
                rpdos.handle_sync(at(100 * sync));
                after.extend(rpdos.take_due(at(100 * sync)).map(|_| sync));
            }
            assert_eq!(after, expected, "type {every}");
        }
    }

    #[test]
    fn a_change_that_did_not_leave_is_sent_again_with_what_holds_then() {
        let mut rpdos = one(RpdoTrigger::Event, None);
        rpdos.set_running(at(0), true);
        set(&mut rpdos, 0, 1);
        let Sent { frame, .. } = rpdos.take_due(at(0)).unwrap();
        assert_eq!(rpdos.handle_not_sent(at(0), &frame), Some(RpdoIndex(0)));
        assert_eq!(rpdos.handle_not_sent(at(0), &"181#01".parse().unwrap()), None);
        set(&mut rpdos, 50, 2);
        assert_eq!(run(&mut rpdos, 1000), ["50 201#0200"]);
        let frame = "201#0200".parse().unwrap();
        rpdos.handle_not_sent(at(1000), &frame);
        assert_eq!(run(&mut rpdos, 2000), ["1100 201#0200"]);
        rpdos.handle_not_sent(at(2000), &frame);
        rpdos.set_running(at(2000), false);
        assert_eq!(run(&mut rpdos, 9000), Vec::<String>::new());
    }
}
