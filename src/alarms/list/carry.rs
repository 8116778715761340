//! Alarms that stay go on in another list.

use super::{AlarmEvent, AlarmList, Expiry, Timer};
use crate::process_image::AlarmIndex;
use crate::time::Now;
use std::cmp::Reverse;

impl AlarmList {
    /// Takes over the state of alarms: `from` tells for each place here the place in `old`, where it stays. Delays that run go on.
    /// An alarm whose cause did not stay is as if the cause had gone.
    pub fn take_over(&mut self, mut old: Self, from: &[Option<AlarmIndex>], now: Now) {
        self.now = old.now;
        for (place, from) in from.iter().enumerate() {
            let Some(before) = from.and_then(|from| old.alarms.get_mut(from.0)) else { continue };
            let rank = self.suppression.rank(place);
            let Some(alarm) = self.alarms.get_mut(place) else { continue };
            std::mem::swap(alarm, before);
            // The rules of the new list; the old one's have its places.
            std::mem::swap(&mut alarm.spec, &mut before.spec);
            alarm.delay = alarm.delay.map(|timer| {
                let what =
                    if timer.leads_to() { Expiry::On { rank } } else { Expiry::Off { rank: Reverse(rank) } };
                Timer { what, alarm: place, ..timer }
            });
            self.timers.extend(alarm.delay);
        }
        for group in self.groups.values_mut() {
            let is_active = |place: &&usize| {
                self.alarms.get(**place).is_some_and(|alarm| alarm.machine.state().is_active())
            };
            group.active = group.members.iter().filter(is_active).count();
        }
        self.count_causes(now);
    }

    fn count_causes(&mut self, now: Now) {
        let mut causes = vec![0; self.alarms.len()];
        for (place, _) in
            self.alarms.iter().enumerate().filter(|(_, alarm)| alarm.machine.suppresses_others())
        {
            for consequence in self.suppression.consequences(place) {
                if let Some(count) = causes.get_mut(*consequence) {
                    *count += 1;
                }
            }
        }
        for (place, count) in causes.into_iter().enumerate() {
            let Some(alarm) = self.alarms.get_mut(place) else { continue };
            alarm.causes = count;
            let event = if count == 0 { AlarmEvent::Unsuppress } else { AlarmEvent::Suppress };
            alarm.machine.handle(event);
            self.show(now, place);
        }
    }
}
