//! What a client may do, pure (MB-TCP-Security v36, R-25 to R-31).

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use super::role::PeerRole;
use super::settings::SecuritySettings;
use crate::modbus::general_reference;

/// One thing that a client may do.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "lowercase")]
pub enum Right {
    /// Read registers, bits, identification, and objects where they are offered.
    Read,
    /// Write them, as far as anything can be written.
    Write,
}

/// What one client may do.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Rights {
    /// It may read.
    pub read: bool,
    /// It may write.
    pub write: bool,
}

impl Rights {
    /// Those of whoever comes without TLS: nobody can know who it is, and what may be written is decided elsewhere.
    pub const WITHOUT_TLS: Self = Self { read: true, write: true };

    /// These.
    #[must_use]
    pub fn of(rights: &[Right]) -> Self {
        Self { read: rights.contains(&Right::Read), write: rights.contains(&Right::Write) }
    }

    /// Those of a role, by the table of the settings.
    #[must_use]
    pub fn of_role(role: &PeerRole, settings: &SecuritySettings) -> Self {
        match &role.0 {
            None => Self::of(&settings.no_role),
            Some(name) => settings
                .roles
                .iter()
                .find(|entry| entry.name == *name)
                .map_or(Self { read: false, write: false }, |entry| Self::of(&entry.rights)),
        }
    }

    /// Whether there is none.
    #[must_use]
    pub fn is_empty(self) -> bool {
        !self.read && !self.write
    }

    /// Whether a request may be made at all. One that is not understood is answered by its own exception.
    #[must_use]
    pub fn allow(self, pdu: &[u8]) -> bool {
        match pdu.first() {
            Some(5 | 6 | 15 | 16 | 22) => self.write,
            Some(23) => self.read && self.write,
            _ if general_reference::is_general_reference(pdu) => {
                let writes = general_reference::decode(pdu).is_ok_and(|reference| reference.writes());
                if writes { self.write } else { self.read }
            }
            _ => self.read,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn mbs_r31_each_function_needs_its_right() {
        let rights = |read, write| Rights { read, write };
        for function in 0..=255_u8 {
            let needs = match function {
                5 | 6 | 15 | 16 | 22 => (false, true),
                23 => (true, true),
                _ => (true, false),
            };
            let pdu = [function, 0, 0, 0, 1];
            assert!(rights(true, true).allow(&pdu) && !rights(false, false).allow(&pdu));
            assert_eq!(rights(true, false).allow(&pdu), !needs.1, "{function}");
            assert_eq!(rights(false, true).allow(&pdu), !needs.0, "{function}");
        }
        // FC 43/13: object 0x1000 of node 1, read and written.
        let read = [0x2B, 0x0D, 0, 0, 1, 0x10, 0, 0, 0, 0, 0, 4];
        assert!(rights(true, false).allow(&read) && !rights(false, true).allow(&read));
        let mut write = read.to_vec();
        write[2] = 0x01;
        write.extend([1, 2, 3, 4]);
        assert!(general_reference::decode(&write).is_ok_and(|reference| reference.writes()));
        assert!(!rights(true, false).allow(&write) && rights(false, true).allow(&write));
    }

    #[test]
    fn mbs_r23_r25_a_role_has_the_rights_of_the_table_and_an_unknown_one_none() {
        let settings: SecuritySettings = toml::from_str(
            "roles = [{ name = 'Operator', rights = ['read'] }, { name = 'Engineer', rights = ['read', 'write'] }]",
        )
        .unwrap();
        let rights = |role: Option<&str>| Rights::of_role(&PeerRole(role.map(str::to_owned)), &settings);
        assert_eq!(rights(Some("Operator")), Rights { read: true, write: false });
        assert_eq!(rights(Some("Engineer")), Rights { read: true, write: true });
        // The whole text is the role.
        for other in [None, Some("operator"), Some("Operator "), Some("Operator,Engineer"), Some("")] {
            assert!(rights(other).is_empty(), "{other:?}");
        }
    }
}
