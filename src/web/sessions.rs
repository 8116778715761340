//! Who is logged in, pure. Sessions are in memory only: a restart ends them all.

use std::sync::Arc;
use std::time::Duration;

use crate::gateway::command::PasswordHash;
use crate::time::Instant;

/// Bytes of the secret that a browser keeps.
pub const SECRET: usize = 32;
/// After so long without a login or command a session can only read.
pub const IDLE: Duration = Duration::from_secs(30 * 60);
/// No session lasts longer.
pub const LONGEST: Duration = Duration::from_secs(12 * 3_600);
/// Sessions of one name; a further one takes the place of the one that was not used for longest.
const MOST_OF_ONE: usize = 16;
/// Sessions in all; a further one takes the place of the one that was not used for longest.
const MOST: usize = 64;

/// What the browser of a session keeps.
pub type Secret = [u8; SECRET];

/// What a session is used for.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Use {
    /// Looking, which a page does by itself.
    Read,
    /// Something that a person does.
    Act,
}

/// Whose a session is.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Holder {
    /// Of the `[access.NAME]`.
    pub name: Arc<str>,
    /// Of the password by which it began: with another one it is over.
    pub password: PasswordHash,
}

/// All sessions.
#[derive(Debug, Default)]
pub struct Sessions {
    all: Vec<Session>,
}

struct Session {
    secret: Secret,
    holder: Holder,
    begun: Instant,
    acted: Instant,
}

impl std::fmt::Debug for Session {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Session").field("holder", &self.holder).finish_non_exhaustive()
    }
}

impl Sessions {
    /// Somebody logged in.
    pub fn begin(&mut self, now: Instant, secret: Secret, holder: Holder) {
        self.forget(now);
        let of_one = self.all.iter().filter(|session| session.holder.name == holder.name).count();
        if of_one >= MOST_OF_ONE {
            self.evict(|session| session.holder.name == holder.name);
        } else if self.all.len() >= MOST {
            self.evict(|_| true);
        }
        self.all.push(Session { secret, holder, begun: now, acted: now });
    }

    /// Whose session this secret is, if it is good for this use.
    pub fn find(&mut self, now: Instant, given: &Secret, usage: Use) -> Option<Holder> {
        self.forget(now);
        let session = self.all.iter_mut().find(|session| is_same(&session.secret, given))?;
        if usage == Use::Act {
            if session.acted + IDLE <= now {
                return None;
            }
            session.acted = now;
        }
        Some(session.holder.clone())
    }

    /// Whose session this secret is, if it could act now; nothing is used by that.
    #[must_use]
    pub fn look(&self, now: Instant, given: &Secret) -> Option<Holder> {
        let found = self.all.iter().find(|session| is_same(&session.secret, given))?;
        let lives = found.begun + LONGEST > now && found.acted + IDLE > now;
        lives.then(|| found.holder.clone())
    }

    /// A session is over.
    pub fn end(&mut self, given: &Secret) {
        self.all.retain(|session| !is_same(&session.secret, given));
    }

    fn forget(&mut self, now: Instant) {
        self.all.retain(|session| session.begun + LONGEST > now);
    }

    fn evict(&mut self, may_go: impl Fn(&Session) -> bool) {
        let places = self.all.iter().enumerate().filter(|(_, session)| may_go(session));
        if let Some(place) = places.min_by_key(|(_, session)| session.acted).map(|(place, _)| place) {
            self.all.remove(place);
        }
    }
}

/// Takes the same time whatever the two are.
fn is_same(one: &Secret, other: &Secret) -> bool {
    let differ = one.iter().zip(other).fold(0, |differ, (one, other)| differ | (one ^ other));
    std::hint::black_box(differ) == 0
}

/// A secret as hexadecimal digits, for a cookie.
#[must_use]
pub fn to_text(secret: &Secret) -> String {
    secret.map(|byte| format!("{byte:02x}")).concat()
}

/// The secret of a cookie; `None` for anything else.
#[must_use]
pub fn from_text(text: &str) -> Option<Secret> {
    let digits = text.as_bytes();
    if digits.len() != 2 * SECRET {
        return None;
    }
    let mut secret = [0; SECRET];
    for (byte, pair) in secret.iter_mut().zip(digits.chunks_exact(2)) {
        let pair = core::str::from_utf8(pair).ok().filter(|pair| !pair.starts_with('+'))?;
        *byte = u8::from_str_radix(pair, 16).ok()?;
    }
    Some(secret)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn at(secs: u64) -> Instant {
        Instant::from_millis(secs * 1000)
    }

    fn holder(name: &str) -> Holder {
        let text =
            "$argon2id$v=19$m=19456,t=2,p=1$c2FsdHNhbHRzYWx0$i1ZbHXvRKg4oGAMRmRf2WRWM3kLHSDBTbq4/jXrsxgI";
        Holder { name: name.into(), password: PasswordHash::parse(text).unwrap() }
    }

    fn secret(number: u8) -> Secret {
        [number; SECRET]
    }

    #[test]
    fn cr_2_6_half_an_hour_after_the_last_deed_a_session_only_reads_and_after_twelve_hours_it_is_over() {
        let mut sessions = Sessions::default();
        sessions.begin(at(0), secret(1), holder("maria"));
        let minutes = |count: u64| at(count * 60);
        assert!(sessions.find(minutes(29), &secret(1), Use::Act).is_some());
        assert!(sessions.find(minutes(58), &secret(1), Use::Act).is_some(), "each deed counts anew");
        // Looking does not: the page of somebody who went away looks by itself.
        for minute in 59..88 {
            assert!(sessions.find(minutes(minute), &secret(1), Use::Read).is_some());
            assert!(sessions.look(minutes(minute), &secret(1)).is_some());
        }
        assert!(sessions.find(minutes(88), &secret(1), Use::Act).is_none());
        assert!(sessions.look(minutes(88), &secret(1)).is_none());
        assert!(sessions.find(minutes(719), &secret(1), Use::Read).is_some());
        assert!(sessions.find(minutes(720), &secret(1), Use::Read).is_none());
        sessions.begin(at(0), secret(2), holder("maria"));
        for minute in (0..720).step_by(20) {
            assert!(sessions.find(minutes(minute), &secret(2), Use::Act).is_some());
        }
        assert!(sessions.find(minutes(720), &secret(2), Use::Act).is_none(), "however busy it is");
    }

    #[test]
    fn only_the_whole_secret_is_a_session_and_logging_out_ends_one() {
        let mut sessions = Sessions::default();
        sessions.begin(at(0), secret(1), holder("maria"));
        sessions.begin(at(0), secret(2), holder("jo"));
        let mut near = secret(1);
        near[31] ^= 1;
        assert_eq!(sessions.find(at(1), &near, Use::Read), None);
        assert_eq!(&*sessions.find(at(1), &secret(2), Use::Act).unwrap().name, "jo");
        sessions.end(&secret(1));
        assert_eq!(sessions.find(at(1), &secret(1), Use::Read), None);
        assert!(sessions.find(at(1), &secret(2), Use::Read).is_some());
    }

    #[test]
    fn sessions_are_bounded_and_one_name_pushes_out_its_own() {
        let mut sessions = Sessions::default();
        sessions.begin(at(0), secret(200), holder("jo"));
        for number in 0..100 {
            sessions.begin(at(u64::from(number)), secret(number), holder("maria"));
        }
        assert_eq!(sessions.all.len(), MOST_OF_ONE + 1);
        assert!(sessions.find(at(100), &secret(200), Use::Read).is_some());
        assert!(sessions.find(at(100), &secret(83), Use::Read).is_none());
        assert!(sessions.find(at(100), &secret(84), Use::Read).is_some());
        for number in 0..100 {
            sessions.begin(at(200), secret(number), holder(&format!("name-{number}")));
        }
        assert_eq!(sessions.all.len(), MOST);
    }

    #[test]
    fn a_cookie_is_64_hexadecimal_digits() {
        let all: Secret = core::array::from_fn(|place| u8::try_from(place * 7 % 256).unwrap());
        assert_eq!(from_text(&to_text(&all)), Some(all));
        for wrong in
            ["", "00", &"g".repeat(64), &"0".repeat(63), &"0".repeat(65), &"+1".repeat(32), &"ä".repeat(32)]
        {
            assert_eq!(from_text(wrong), None, "{wrong}");
        }
    }
}
