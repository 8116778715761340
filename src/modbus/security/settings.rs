//! The `[modbus.security]` table of the configuration.

// Addresses only; `core` has no sockets.
use core::net::SocketAddr;
use std::collections::BTreeSet;
use std::path::PathBuf;

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use super::rights::Right;
use super::role::LONGEST_ROLE;
use crate::tls::TlsServerSettings;

/// Modbus/TCP Security: TLS with certificates on both sides. Off unless `listen` has an address.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct SecuritySettings {
    /// Addresses to listen on, `IP:PORT`; the port of the standard is 802.
    pub listen: Vec<SocketAddr>,
    /// The gateway's certificate, PEM, followed by those between it and its authority, and that one's.
    pub cert_file: PathBuf,
    /// Its private key, PEM, not encrypted.
    pub key_file: PathBuf,
    /// Certificates of the authorities that clients must have theirs from, PEM.
    pub client_ca_file: PathBuf,
    /// What clients may do, by the role in their certificate. A role that is not here may do nothing.
    pub roles: Vec<RoleEntry>,
    /// What clients may do whose certificate has no role: nothing unless given.
    pub no_role: Vec<Right>,
}

/// What one role may do.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct RoleEntry {
    /// The role, exactly as it stands in certificates.
    pub name: String,
    /// `read`, `write`.
    pub rights: Vec<Right>,
}

impl SecuritySettings {
    /// Whether anything listens.
    #[must_use]
    pub fn is_off(&self) -> bool {
        self.listen.is_empty()
    }

    /// Whether no key is set.
    #[must_use]
    pub fn is_default(&self) -> bool {
        *self == Self::default()
    }

    /// The files.
    #[must_use]
    pub fn tls(&self) -> TlsServerSettings {
        TlsServerSettings {
            cert_file: self.cert_file.clone(),
            key_file: self.key_file.clone(),
            client_ca_file: Some(self.client_ca_file.clone()),
        }
    }

    /// What cannot work: the key within the table, what is wrong, how to mend it.
    #[must_use]
    pub fn problems(&self) -> Vec<(&'static str, String, &'static str)> {
        let mut problems = Vec::new();
        if self.is_off() {
            if !self.is_default() {
                let hint = "add `listen = [\"0.0.0.0:802\"]`, or take [modbus.security] away";
                problems.push(("listen", "nothing listens for Modbus/TCP Security".to_owned(), hint));
            }
            return problems;
        }
        for (key, file) in [
            ("cert_file", &self.cert_file),
            ("key_file", &self.key_file),
            ("client_ca_file", &self.client_ca_file),
        ] {
            if file.as_os_str().is_empty() {
                let message =
                    format!("`{key}` is missing: both sides of Modbus/TCP Security show a certificate");
                problems.push((key, message, "name the PEM file"));
            }
        }
        let mut names = BTreeSet::new();
        for RoleEntry { name, .. } in &self.roles {
            if name.is_empty() || name.len() > LONGEST_ROLE || name.chars().any(char::is_control) {
                let message = format!("{name:?} cannot be a role");
                problems.push(("roles", message, "a role has 1 to 256 bytes and no control characters"));
            }
            if !names.insert(name) {
                let message = format!("the role `{name}` stands here twice");
                problems.push(("roles", message, "put its rights together"));
            }
        }
        problems
    }

    /// That nobody could do anything, with a hint.
    #[must_use]
    pub fn warning(&self) -> Option<(String, String)> {
        let rights = self.roles.iter().flat_map(|role| &role.rights).chain(&self.no_role).count();
        (!self.is_off() && rights == 0).then(|| {
            (
                "no role may do anything: every request by Modbus/TCP Security will be answered by exception 01".to_owned(),
                "add for example `roles = [{ name = \"Operator\", rights = [\"read\"] }]`".to_owned(),
            )
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn read(text: &str) -> SecuritySettings {
        toml::from_str(text).unwrap()
    }

    const FILES: &str = "listen = ['127.0.0.1:802']\ncert_file = 'c'\nkey_file = 'k'\nclient_ca_file = 'a'\n";

    #[test]
    fn without_the_table_nothing_listens_and_with_it_all_files_are_needed() {
        assert!(read("").is_off() && read("").problems().is_empty() && read("").warning().is_none());
        let keys =
            |text: &str| read(text).problems().into_iter().map(|problem| problem.0).collect::<Vec<_>>();
        assert_eq!(keys("cert_file = 'c'"), ["listen"]);
        assert_eq!(keys("listen = ['127.0.0.1:802']"), ["cert_file", "key_file", "client_ca_file"]);
        assert_eq!(keys(FILES), [""; 0]);
        assert!(toml::from_str::<SecuritySettings>("port = 802").is_err());
    }

    #[test]
    fn mbs_r25_roles_and_their_rights_are_the_users() {
        let rights = "roles = [{ name = 'Leser', rights = ['read'] }, { name = 'Leser', rights = [] }]";
        let problems = read(&format!("{FILES}{rights}")).problems();
        assert_eq!(problems.len(), 1);
        assert!(problems[0].1.contains("`Leser` stands here twice"));
        assert!(read(FILES).warning().unwrap().0.contains("exception 01"));
        assert!(read(&format!("{FILES}no_role = ['read']")).warning().is_none());
        assert!(read(&format!("{FILES}roles = [{{ name = '', rights = [] }}]")).problems().len() == 1);
        assert!(toml::from_str::<SecuritySettings>("no_role = ['admin']").is_err());
    }
}
