//! What the store does when its disk fails, comes late, or comes back. Pure.

use super::{RETRY_INTERVAL, Store};
use crate::store::disk::{Disk, DiskError};
use crate::store::log::Log;
use crate::store::record::Class;
use crate::store::recovery::recover;
use crate::store::report::State;
use crate::time::Now;

impl<D: Disk> Store<D> {
    /// Does something with the disk; the store goes on in memory when it fails.
    pub(super) fn attempt(&mut self, now: Now, act: impl FnOnce(&mut Self) -> Result<(), DiskError>) {
        if self.state == State::Good
            && let Err(error) = act(self)
        {
            self.fail(now, &error);
        }
    }

    pub(super) fn fail(&mut self, now: Now, error: &DiskError) {
        self.faults = self.faults.saturating_add(1);
        self.set_fault(now, error);
        self.logs.iter_mut().for_each(Log::fall_back);
        self.leave_stream();
        self.trim();
    }

    /// A start would not know of numbers that only memory holds: they belong to a new stream.
    fn leave_stream(&mut self) {
        let fresh = (self.settings.fresh)();
        let events = self.log(Class::Event);
        events.stream = fresh;
        let unread = events.cursor.position;
        for record in events.ring.iter_mut().filter(|record| record.position >= unread) {
            record.stream = fresh;
        }
    }

    fn set_fault(&mut self, now: Now, error: &DiskError) {
        self.state = match error {
            DiskError::Full(_) => State::Full,
            DiskError::Failed(_) => State::Faulty,
        };
        self.reason = error.to_string().into();
        self.retry_at = now.instant + RETRY_INTERVAL;
    }

    /// Tries a disk that failed again.
    pub(super) fn retry(&mut self, now: Now) {
        if !self.state.is_fault() || now.instant < self.retry_at {
            return;
        }
        let was_opened = self.opened;
        let tried = if was_opened { self.resume(now) } else { self.attach(now) };
        match tried {
            Ok(()) => {
                self.state = State::Good;
                self.reason = "".into();
            }
            // What was read from it just now is the past of this store: from here on it is one fault more.
            Err(error) if self.opened != was_opened => self.fail(now, &error),
            Err(error) => self.set_fault(now, &error),
        }
    }

    fn resume(&mut self, now: Now) -> Result<(), DiskError> {
        let around = self.around(now.utc);
        let newest_file = self.log(Class::Event).newest_file();
        let Self { disk, logs, .. } = self;
        // Events last: else a sample that fails would leave numbers of theirs on disk, and those after them in memory.
        let resumed = logs.iter_mut().rev().try_for_each(|log| log.resume(disk, around));
        if resumed.is_err() {
            logs.iter_mut().for_each(Log::fall_back);
            if self.log(Class::Event).newest_file() != newest_file {
                // A part got there and could not be taken back: a start would go on behind it.
                self.leave_stream();
            }
        }
        resumed
    }

    /// Takes over what the disk holds; what memory holds comes behind it.
    pub(super) fn attach(&mut self, now: Now) -> Result<(), DiskError> {
        let files = self.disk.open()?;
        let around = self.around(now.utc);
        let fresh = (self.settings.fresh)();
        let mut found = Vec::new();
        for class in Class::ALL {
            found.push(recover(&mut self.disk, class, &files, around, fresh)?);
        }
        self.opened = true;
        for (place, mut log) in found.into_iter().enumerate() {
            let Some(memory) = self.logs.get_mut(place) else { continue };
            if memory.next > 1 {
                (log.stream, log.number) = (memory.stream, memory.number);
            }
            for mut record in std::mem::take(&mut memory.ring) {
                record.position = log.next;
                log.next += 1;
                log.put_aside(record);
            }
            log.counts.dropped = memory.counts.dropped;
            *memory = log;
        }
        self.epoch = self.epoch.wrapping_add(1);
        let Self { disk, logs, .. } = self;
        let begin = |log: &mut Log| {
            if log.open && log.ring.is_empty() { log.sync(disk) } else { log.resume(disk, around) }
        };
        logs.iter_mut().rev().try_for_each(begin)
    }
}
