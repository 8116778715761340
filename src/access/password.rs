//! Passwords, pure: what of them is kept is a hash by Argon2id, as text in the PHC string format.

use std::fmt;
use std::sync::Arc;

use argon2::password_hash::{PasswordHash as Phc, PasswordHasher, PasswordVerifier, SaltString};
use argon2::{ARGON2ID_IDENT, Argon2, Params, Version};

/// Memory that checking a password may take, in KiB: from the least that is advised to what a small host can spare.
const MEMORY: core::ops::RangeInclusive<u32> = 7_168..=65_536;
/// Rounds over that memory.
const ROUNDS: core::ops::RangeInclusive<u32> = 1..=10;
/// Lanes in it.
const LANES: core::ops::RangeInclusive<u32> = 1..=4;
/// Bytes of the hash itself.
const LENGTH: core::ops::RangeInclusive<usize> = 16..=64;
/// Fewest bytes of salt.
const SHORTEST_SALT: usize = 8;

/// Random bytes that make equal passwords into different hashes.
pub const SALT: usize = 16;
/// The shortest password that is made into a hash, in characters.
pub const SHORTEST_PASSWORD: usize = 12;
/// The longest, in bytes.
pub const LONGEST_PASSWORD: usize = 256;

/// Why a text is not the hash of a password, or why none can be made. The text itself is never told.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum PasswordError {
    /// It has another form; perhaps it is a password.
    #[error("this is no Argon2id hash, which begins with `$argon2id$v=19$`")]
    Form,
    /// It would be too cheap to guess by, or too dear to check.
    #[error(
        "the hash takes {memory} KiB, {rounds} rounds and {lanes} lanes; 7168 to 65536 KiB, 1 to 10 rounds and 1 to 4 lanes are possible"
    )]
    Cost {
        /// In KiB.
        memory: u32,
        /// `t`.
        rounds: u32,
        /// `p`.
        lanes: u32,
    },
    /// A password that is too short or too long.
    #[error("a password has {SHORTEST_PASSWORD} characters or more, and at most {LONGEST_PASSWORD} bytes")]
    Length,
    /// Said by the library.
    #[error("it cannot be made into a hash")]
    Hashing,
}

/// The hash of a password. Never shown by `Debug`.
#[derive(Clone, PartialEq, Eq)]
pub struct PasswordHash(Arc<str>);

impl fmt::Debug for PasswordHash {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("PasswordHash(..)")
    }
}

impl PasswordHash {
    /// A text that is one; white space around it does not count.
    ///
    /// # Errors
    /// What is wrong with it.
    pub fn parse(text: &str) -> Result<Self, PasswordError> {
        let text = text.trim();
        let hash = Phc::new(text).map_err(|_| PasswordError::Form)?;
        let is_whole = hash.hash.is_some_and(|output| LENGTH.contains(&output.len()));
        let mut bytes = [0; 64];
        let salt = hash.salt.and_then(|salt| salt.decode_b64(&mut bytes).ok().map(<[u8]>::len));
        let is_salted = salt.is_some_and(|length| length >= SHORTEST_SALT);
        let version = hash.version == Some(Version::V0x13.into());
        if hash.algorithm != ARGON2ID_IDENT || !version || !is_whole || !is_salted {
            return Err(PasswordError::Form);
        }
        let params = Params::try_from(&hash).map_err(|_| PasswordError::Form)?;
        let (memory, rounds, lanes) = (params.m_cost(), params.t_cost(), params.p_cost());
        if !MEMORY.contains(&memory) || !ROUNDS.contains(&rounds) || !LANES.contains(&lanes) {
            return Err(PasswordError::Cost { memory, rounds, lanes });
        }
        Ok(Self(text.into()))
    }

    /// Of a password. Takes 19 MiB and some hundredths of a second.
    ///
    /// # Errors
    /// It is too short or too long.
    pub fn of(password: &str, salt: [u8; SALT]) -> Result<Self, PasswordError> {
        if password.chars().count() < SHORTEST_PASSWORD || password.len() > LONGEST_PASSWORD {
            return Err(PasswordError::Length);
        }
        let salt = SaltString::encode_b64(&salt).map_err(|_| PasswordError::Hashing)?;
        let hash = Argon2::default().hash_password(password.as_bytes(), &salt);
        let hash = hash.map_err(|_| PasswordError::Hashing)?;
        Ok(Self(hash.to_string().into()))
    }

    /// Whether it was made of this password. Takes the memory and the time that it says, whatever the password.
    #[must_use]
    pub fn is_of(&self, password: &str) -> bool {
        // Nobody has a longer one; it must not cost more.
        let password = password.as_bytes().get(..LONGEST_PASSWORD + 1).unwrap_or(password.as_bytes());
        let Ok(hash) = Phc::new(&self.0) else { return false };
        let verified = Argon2::default().verify_password(password, &hash);
        verified.is_ok() && password.len() <= LONGEST_PASSWORD
    }

    /// The text, for whoever made it.
    #[must_use]
    pub fn as_str(&self) -> &str {
        &self.0
    }
}

/// Where the hash of a password stands.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum PasswordPlace {
    /// In the configuration.
    Here(PasswordHash),
    /// In a file, which is read when it is needed.
    File(String),
}

#[cfg(test)]
mod tests {
    use super::*;

    const PASSWORD: &str = "correct horse";

    #[test]
    fn cr_1_5_a_password_is_known_again_by_its_hash_and_no_other_is() {
        let hash = PasswordHash::of(PASSWORD, [7; SALT]).unwrap();
        assert!(hash.as_str().starts_with("$argon2id$v=19$m=19456,t=2,p=1$"));
        let hash = PasswordHash::parse(&format!("{}\n", hash.as_str())).unwrap();
        assert!(hash.is_of(PASSWORD));
        for other in ["", "correct horsf", "correct horse ", "Correct horse"] {
            assert!(!hash.is_of(other), "{other}");
        }
        let other = PasswordHash::of(PASSWORD, [8; SALT]).unwrap();
        assert_ne!(hash, other, "the salt makes two of one");
        let long = "x".repeat(LONGEST_PASSWORD);
        let hash = PasswordHash::of(&long, [7; SALT]).unwrap();
        assert!(hash.is_of(&long) && !hash.is_of(&format!("{long}y")));
    }

    #[test]
    fn cr_1_7_what_is_too_short_or_too_long_is_made_into_none() {
        for wrong in ["", "eleven char", &"x".repeat(LONGEST_PASSWORD + 1)] {
            assert_eq!(PasswordHash::of(wrong, [7; SALT]), Err(PasswordError::Length));
        }
        assert!(PasswordHash::of("zwölf Ümläut", [7; SALT]).is_ok(), "characters count, not bytes");
    }

    #[test]
    fn only_argon2id_of_a_sane_cost_counts_and_no_text_is_told() {
        let salt = "c2FsdHNhbHRzYWx0";
        let output = "i1ZbHXvRKg4oGAMRmRf2WRWM3kLHSDBTbq4/jXrsxgI";
        let phc = |head: &str| format!("${head}${salt}${output}");
        assert!(PasswordHash::parse(&phc("argon2id$v=19$m=19456,t=2,p=1")).is_ok());
        for wrong in [
            "",
            "secret-secret-secret",
            "$argon2id$",
            &phc("argon2i$v=19$m=19456,t=2,p=1"),
            &phc("argon2d$v=19$m=19456,t=2,p=1"),
            &phc("argon2id$v=16$m=19456,t=2,p=1"),
            &phc("argon2id$m=19456,t=2,p=1"),
            &phc("scrypt$ln=16,r=8,p=1"),
            &phc("argon2id$v=19$m=many"),
            &format!("$argon2id$v=19$m=19456,t=2,p=1${salt}"),
            &format!("$argon2id$v=19$m=19456,t=2,p=1$c2Fs${output}"),
            "$2b$12$R9h/cIPz0gi.URNNX3kh2OPST9/PgBkqquzi.Ss7KIUgO2t0jWMUW",
        ] {
            assert_eq!(PasswordHash::parse(wrong), Err(PasswordError::Form), "{wrong}");
        }
        for dear in ["m=4096,t=2,p=1", "m=1048576,t=2,p=1", "m=19456,t=100,p=1", "m=19456,t=2,p=16"] {
            let parsed = PasswordHash::parse(&phc(&format!("argon2id$v=19${dear}")));
            assert!(matches!(parsed, Err(PasswordError::Cost { .. })), "{dear}: {parsed:?}");
        }
        let hash = PasswordHash::parse(&phc("argon2id$v=19$m=19456,t=2,p=1")).unwrap();
        assert_eq!(format!("{hash:?}"), "PasswordHash(..)");
    }
}
