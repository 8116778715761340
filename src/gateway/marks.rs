//! Places that changed: a set that allocates nothing once it is made.

/// Some of the places `0..size`, in the order in which they were marked, each once.
#[derive(Debug, Default)]
pub(super) struct Marks {
    flags: Vec<bool>,
    list: Vec<usize>,
}

impl Marks {
    /// None of `size` places.
    pub(super) fn new(size: usize) -> Self {
        Self { flags: vec![false; size], list: Vec::with_capacity(size) }
    }

    /// Marks a place; nothing where there is no such place.
    pub(super) fn mark(&mut self, place: usize) {
        if let Some(flag) = self.flags.get_mut(place)
            && !std::mem::replace(flag, true)
        {
            self.list.push(place);
        }
    }

    /// Takes all marks.
    pub(super) fn drain(&mut self) -> impl Iterator<Item = usize> + '_ {
        let Self { flags, list } = self;
        list.drain(..).inspect(|place| {
            if let Some(flag) = flags.get_mut(*place) {
                *flag = false;
            }
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_place_is_marked_once_until_it_is_taken() {
        let mut marks = Marks::new(3);
        for place in [2, 0, 2, 7] {
            marks.mark(place);
        }
        assert_eq!(marks.drain().collect::<Vec<_>>(), [2, 0]);
        marks.mark(2);
        assert_eq!(marks.drain().collect::<Vec<_>>(), [2]);
    }
}
