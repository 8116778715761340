//! Who writes to a line, pure: one connection at a time, so that what two send is never mixed.

use std::sync::atomic::{AtomicU64, Ordering};

/// The writer's seat of a line.
#[derive(Debug, Default)]
pub struct Seat {
    /// 0: nobody.
    holder: AtomicU64,
}

impl Seat {
    /// Whether a connection has the seat, which it takes where it is free. `connection` is not 0.
    pub fn take(&self, connection: u64) -> bool {
        let taken = self.holder.compare_exchange(0, connection, Ordering::AcqRel, Ordering::Acquire);
        taken.map_or_else(|holder| holder == connection, |_| true)
    }

    /// A connection gives the seat up. Nothing where it does not have it.
    pub fn leave(&self, connection: u64) {
        let _ = self.holder.compare_exchange(connection, 0, Ordering::AcqRel, Ordering::Acquire);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_first_keeps_the_seat_until_it_leaves() {
        let seat = Seat::default();
        assert!(seat.take(7) && seat.take(7));
        assert!(!seat.take(8));
        seat.leave(8);
        assert!(!seat.take(8), "only who has it can give it up");
        seat.leave(7);
        assert!(seat.take(8));
        assert!(!seat.take(7));
    }
}
