//! Puts things after those that they depend on.

/// An order in which everything comes after what it depends on, otherwise as given; and the members of a circle, where
/// there is one, from the one that was met first on. Places that do not exist are left out.
pub fn causes_first(depends_on: &[Vec<usize>]) -> (Vec<usize>, Vec<usize>) {
    let mut order = Vec::with_capacity(depends_on.len());
    let mut circle = Vec::new();
    let mut state = vec![State::New; depends_on.len()];
    for start in 0..depends_on.len() {
        // A stack of our own: a long chain must not exhaust that of the process.
        let mut path = vec![(start, 0)];
        while let Some((place, next)) = path.pop() {
            match state.get_mut(place) {
                Some(seen @ State::New) => *seen = State::Open,
                Some(State::Open) if next > 0 => {}
                Some(State::Open) => {
                    let from = path.iter().position(|(other, _)| *other == place).unwrap_or_default();
                    if circle.is_empty() {
                        circle = path.iter().skip(from).map(|(place, _)| *place).collect();
                    }
                    continue;
                }
                Some(State::Done) | None => continue,
            }
            if let Some(cause) = depends_on.get(place).and_then(|causes| causes.get(next)) {
                path.push((place, next + 1));
                path.push((*cause, 0));
            } else {
                state.get_mut(place).into_iter().for_each(|seen| *seen = State::Done);
                order.push(place);
            }
        }
    }
    (order, circle)
}

#[derive(Clone, Copy, Debug, PartialEq)]
enum State {
    New,
    Open,
    Done,
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn causes_come_first_and_the_given_order_is_kept_otherwise() {
        assert_eq!(causes_first(&[vec![], vec![], vec![]]), (vec![0, 1, 2], vec![]));
        assert_eq!(causes_first(&[vec![2], vec![0], vec![]]), (vec![2, 0, 1], vec![]));
        assert_eq!(causes_first(&[vec![1, 1], vec![]]), (vec![1, 0], vec![]));
    }

    #[test]
    fn a_circle_is_found_and_everything_still_has_a_place() {
        let (order, circle) = causes_first(&[vec![1], vec![2], vec![0], vec![]]);
        assert_eq!(order.len(), 4);
        assert_eq!(circle, [0, 1, 2]);
        assert_eq!(causes_first(&[vec![0]]).1, [0]);
    }

    #[test]
    fn a_long_chain_does_not_exhaust_the_stack() {
        let chain: Vec<Vec<usize>> = (0..200_000).map(|place| vec![place + 1]).collect();
        let (order, circle) = causes_first(&chain);
        assert_eq!((order.len(), order[0]), (200_000, 199_999));
        assert!(circle.is_empty());
    }
}
