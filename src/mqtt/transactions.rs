//! Requests that were carried out lately, pure: one that comes again is answered as before and not done again.
//!
//! A broker delivers with quality of service 1 at least once, and a client that got no answer asks again.

use std::collections::{BTreeMap, VecDeque};
use std::time::Duration;

use crate::gateway::command::request::Reply;
use crate::time::Instant;

/// How long a request is remembered.
pub const REMEMBERED: Duration = Duration::from_secs(600);

/// Requests that are remembered. With so many within [`REMEMBERED`] no further one is taken.
const MOST: usize = 1_024;

/// The verb and the transaction.
type Id = (&'static str, String);

/// What is remembered.
#[derive(Debug, Default)]
pub(super) struct Transactions {
    known: BTreeMap<Id, Known>,
    /// By their age, the oldest first.
    order: VecDeque<(Instant, Id)>,
}

#[derive(Debug)]
struct Known {
    payload: Vec<u8>,
    /// `None`: it is under way.
    reply: Option<Reply>,
}

/// What is to be done with a request.
#[derive(Debug, PartialEq, Eq)]
pub(super) enum Seen {
    /// It is new.
    New,
    /// It was answered like this.
    Answered(Reply),
    /// It is under way; its answer comes.
    UnderWay,
    /// Another request had the same transaction.
    Other,
    /// Too many are remembered.
    Full,
}

impl Transactions {
    /// Whether a request was there before.
    pub(super) fn look(&mut self, now: Instant, id: &Id, payload: &[u8]) -> Seen {
        while self.order.front().is_some_and(|(at, _)| *at + REMEMBERED <= now) {
            if let Some((_, id)) = self.order.pop_front() {
                self.known.remove(&id);
            }
        }
        match self.known.get(id) {
            Some(known) if known.payload != payload => Seen::Other,
            Some(Known { reply: Some(reply), .. }) => Seen::Answered(reply.clone()),
            Some(_) => Seen::UnderWay,
            None if self.known.len() >= MOST => Seen::Full,
            None => Seen::New,
        }
    }

    /// A new request was handed in.
    pub(super) fn begin(&mut self, now: Instant, id: Id, payload: &[u8]) {
        self.order.push_back((now, id.clone()));
        self.known.insert(id, Known { payload: payload.to_vec(), reply: None });
    }

    /// It was answered.
    pub(super) fn end(&mut self, id: &Id, reply: &Reply) {
        if let Some(known) = self.known.get_mut(id) {
            known.reply = Some(reply.clone());
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::gateway::command::Outcome;

    fn at(secs: u64) -> Instant {
        Instant::from_millis(secs * 1000)
    }

    #[test]
    fn a_request_that_comes_again_is_answered_as_before_for_ten_minutes() {
        let (mut seen, id) = (Transactions::default(), ("write", "a1".to_owned()));
        assert_eq!(seen.look(at(0), &id, b"x"), Seen::New);
        seen.begin(at(0), id.clone(), b"x");
        assert_eq!(seen.look(at(1), &id, b"x"), Seen::UnderWay);
        let reply = Reply::new("write", Outcome::Timeout);
        seen.end(&id, &reply);
        assert_eq!(seen.look(at(599), &id, b"x"), Seen::Answered(reply));
        assert_eq!(seen.look(at(599), &id, b"y"), Seen::Other);
        assert_eq!(seen.look(at(599), &("nmt", "a1".to_owned()), b"x"), Seen::New, "of another verb");
        assert_eq!(seen.look(at(600), &id, b"x"), Seen::New);
    }

    #[test]
    fn no_more_are_taken_than_can_be_remembered() {
        let mut seen = Transactions::default();
        for number in 0..MOST {
            let id = ("write", number.to_string());
            assert_eq!(seen.look(at(0), &id, b""), Seen::New);
            seen.begin(at(0), id, b"");
        }
        let one_more = ("write", "one more".to_owned());
        assert_eq!(seen.look(at(599), &one_more, b""), Seen::Full);
        assert_eq!(seen.look(at(600), &one_more, b""), Seen::New);
    }
}
