//! What goes with the image that its readers have now.
//!
//! A reload makes another image from another table. A view is given both, and all that it makes of them, in one piece, so that
//! it never reads a new image by an old table; whoever works with the piece before finishes with that.

use std::sync::{Arc, Mutex, PoisonError};

/// A piece that can be exchanged as a whole while others use it. Clones share it.
#[derive(Debug)]
pub struct Current<T>(Arc<Mutex<Arc<T>>>);

impl<T> Current<T> {
    /// Holds this.
    #[must_use]
    pub fn new(piece: T) -> Self {
        Self(Arc::new(Mutex::new(Arc::new(piece))))
    }

    /// The piece as it is now; who works with it goes on with it when it is exchanged.
    #[must_use]
    pub fn get(&self) -> Arc<T> {
        Arc::clone(&self.0.lock().unwrap_or_else(PoisonError::into_inner))
    }

    /// Whoever asks from now on gets this.
    pub fn set(&self, piece: T) {
        *self.0.lock().unwrap_or_else(PoisonError::into_inner) = Arc::new(piece);
    }
}

impl<T> Clone for Current<T> {
    fn clone(&self) -> Self {
        Self(Arc::clone(&self.0))
    }
}

impl<T> From<T> for Current<T> {
    fn from(piece: T) -> Self {
        Self::new(piece)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn who_has_a_piece_keeps_it_and_who_comes_later_gets_the_new_one() {
        let current = Current::new(1);
        let before = current.get();
        current.clone().set(2);
        assert_eq!((*before, *current.get()), (1, 2));
    }
}
