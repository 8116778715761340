//! An answer that is used again for a moment, pure: however many ask, the image is locked a few times a second.

use std::time::Duration;

use crate::time::Instant;

/// How old an answer may be.
pub const MOMENT: Duration = Duration::from_millis(200);

/// The last answer, and when it was made.
#[derive(Debug)]
pub struct Recent<T> {
    last: Option<(Instant, T)>,
}

impl<T: Clone> Recent<T> {
    /// Nothing yet.
    #[must_use]
    pub const fn new() -> Self {
        Self { last: None }
    }

    /// The last answer if it is younger than [`MOMENT`], else a new one.
    pub fn get(&mut self, now: Instant, make: impl FnOnce() -> T) -> T {
        match &self.last {
            Some((since, answer)) if now.since(*since) < MOMENT => answer.clone(),
            _ => {
                let answer = make();
                self.last = Some((now, answer.clone()));
                answer
            }
        }
    }
}

impl<T: Clone> Default for Recent<T> {
    fn default() -> Self {
        Self::new()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_answer_is_made_anew_after_a_moment_and_not_before() {
        let mut recent = Recent::new();
        let mut made = 0;
        let mut get = |millis| {
            recent.get(Instant::from_millis(millis), || {
                made += 1;
                made
            })
        };
        assert_eq!([1000, 1000, 1199, 1200, 1300, 1399, 1400].map(&mut get), [1, 1, 1, 2, 2, 2, 3]);
    }
}
