//! How many messages of command topics were thrown away and not told of, pure.

use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

/// A count. Clones are the same one.
#[derive(Clone, Debug, Default)]
pub(super) struct ThrownAway(Arc<AtomicU64>);

impl ThrownAway {
    /// One more.
    pub(super) fn count(&self) {
        self.0.fetch_add(1, Ordering::Relaxed);
    }

    /// How many, which are told of now; `None` where there was none.
    pub(super) fn take(&self) -> Option<u64> {
        Some(self.0.swap(0, Ordering::Relaxed)).filter(|count| *count > 0)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn each_is_told_of_once() {
        let thrown_away = ThrownAway::default();
        assert_eq!(thrown_away.take(), None);
        let writer = thrown_away.clone();
        (0..100).for_each(|_| writer.count());
        assert_eq!((thrown_away.take(), thrown_away.take()), (Some(100), None));
        writer.count();
        assert_eq!(thrown_away.take(), Some(1));
    }
}
