//! The `[http]` table of the configuration.

use core::net::{IpAddr, Ipv4Addr, SocketAddr};
use std::path::PathBuf;

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use crate::tls::TlsServerSettings;

/// Where the page, the JSON interface, health and metrics are served.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct WebSettings {
    /// Address and port. Anyone who reaches it can read every value; nothing can be changed through it.
    #[schemars(with = "String")]
    pub listen: SocketAddr,
    /// Names with a dot under which this gateway is called in a browser's address, beside its addresses, `localhost` and its
    /// own name. Requests for other names are refused, so that a web page from elsewhere cannot read values through the
    /// browser of somebody in the plant.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub allowed_hosts: Vec<String>,
    /// Who may read: `anyone` who reaches the address, or `viewer`: clients that an [access.NAME] knows by password or token. The
    /// page asks for a login then; `/livez` and `/readyz` stay open.
    pub read: Readers,
    /// Take passwords also where they cross the network unencrypted: without [http.tls], from other hosts.
    pub plain_login: bool,
    /// With it the port speaks HTTP over TLS only; without it HTTP as it is.
    #[serde(skip_serializing_if = "WebTls::is_off")]
    pub tls: WebTls,
}

/// Who may read.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "lowercase")]
pub enum Readers {
    /// Whoever reaches the address.
    #[default]
    Anyone,
    /// Clients with a password or a token, whatever their role.
    Viewer,
}

/// By what clients of HTTP are known in the `[access.NAME]` tables.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct KnownBy {
    /// Somebody has a token.
    pub token: bool,
    /// Somebody has a password.
    pub password: bool,
}

impl WebSettings {
    /// What works but is probably not meant: the key, what happens, how to mend it.
    #[must_use]
    pub fn warnings(&self, known: KnownBy) -> Vec<(&'static str, &'static str, &'static str)> {
        let mut warnings = Vec::new();
        let mut tell = |applies: bool, key, message, hint| {
            if applies {
                warnings.push((key, message, hint));
            }
        };
        let is_plain = self.tls.is_off() && !self.listen.ip().is_loopback();
        tell(
            self.read == Readers::Viewer && known == KnownBy::default(),
            "read",
            "nobody can read by HTTP: no client has a password or a token",
            "add `password` or `token_file` to an [access.NAME]",
        );
        tell(
            is_plain && known.token,
            "listen",
            "tokens cross the network unencrypted",
            "add [http.tls], or listen on 127.0.0.1",
        );
        tell(
            is_plain && known.password && !self.plain_login,
            "listen",
            "nobody can log in from another host: passwords are not taken unencrypted",
            "add [http.tls]",
        );
        tell(
            is_plain && known.password && self.plain_login,
            "plain_login",
            "passwords cross the network unencrypted",
            "add [http.tls], and leave `plain_login` out",
        );
        tell(
            self.plain_login && !self.tls.is_off(),
            "plain_login",
            "`plain_login` means nothing with [http.tls]",
            "leave it out",
        );
        warnings
    }
}

/// The `[http.tls]` table. PEM; both files are read anew when they change.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct WebTls {
    /// The certificate of the gateway, followed by those between it and its authority.
    pub cert_file: PathBuf,
    /// Its private key, not encrypted.
    pub key_file: PathBuf,
}

impl WebTls {
    /// Whether nothing is set.
    #[must_use]
    pub fn is_off(&self) -> bool {
        *self == Self::default()
    }

    /// The files, where there is TLS.
    #[must_use]
    pub fn files(&self) -> Option<TlsServerSettings> {
        let Self { cert_file, key_file } = self.clone();
        (!self.is_off()).then_some(TlsServerSettings { cert_file, key_file, client_ca_file: None })
    }

    /// What cannot work: the key within the table, what is wrong, how to mend it.
    #[must_use]
    pub fn problem(&self) -> Option<(&'static str, &'static str, &'static str)> {
        match (self.cert_file.as_os_str().is_empty(), self.key_file.as_os_str().is_empty()) {
            (false, true) => Some((
                "cert_file",
                "a certificate without its private key cannot be shown to anybody",
                "add `key_file`",
            )),
            (true, false) => {
                Some(("key_file", "a private key without its certificate means nothing", "add `cert_file`"))
            }
            (true, true) | (false, false) => None,
        }
    }
}

impl Default for WebSettings {
    fn default() -> Self {
        Self {
            listen: SocketAddr::new(IpAddr::V4(Ipv4Addr::LOCALHOST), 8080),
            allowed_hosts: Vec::new(),
            read: Readers::Anyone,
            plain_login: false,
            tls: WebTls::default(),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_page_is_for_this_host_unless_told_otherwise() {
        let settings: WebSettings = toml::from_str("").unwrap();
        assert_eq!(settings.listen, "127.0.0.1:8080".parse().unwrap());
        assert!(toml::from_str::<WebSettings>("listen = 'everywhere'").is_err());
        assert!(toml::from_str::<WebSettings>("port = 1").is_err());
    }

    #[test]
    fn who_is_heard_by_others_and_who_can_get_nowhere_is_warned_of() {
        let both = KnownBy { token: true, password: true };
        let keys = |text: &str, known| {
            let settings: WebSettings = toml::from_str(text).unwrap();
            settings.warnings(known).into_iter().map(|warning| warning.0).collect::<Vec<_>>()
        };
        let none = KnownBy::default();
        let far = "listen = '0.0.0.0:8080'";
        assert_eq!(keys("", both), [""; 0]);
        assert_eq!(keys(far, none), [""; 0]);
        assert_eq!(keys("read = 'viewer'", none), ["read"]);
        assert_eq!(keys("read = 'viewer'", KnownBy { token: true, ..none }), [""; 0]);
        assert_eq!(keys(far, both), ["listen", "listen"]);
        assert_eq!(keys(&format!("{far}\nplain_login = true"), both), ["listen", "plain_login"]);
        let tls = format!("{far}\ntls = {{ cert_file = 'c', key_file = 'k' }}");
        assert_eq!(keys(&tls, both), [""; 0]);
        assert_eq!(keys(&format!("plain_login = true\n{tls}"), both), ["plain_login"]);
        assert!(toml::from_str::<WebSettings>("read = 'nobody'").is_err());
    }

    #[test]
    fn tls_needs_both_of_its_files() {
        let tls = |text: &str| toml::from_str::<WebTls>(text).unwrap();
        let key = |text: &str| tls(text).problem().map(|problem| problem.0);
        assert!(tls("").is_off() && tls("").files().is_none() && key("").is_none());
        assert_eq!((key("cert_file = 'c'"), key("key_file = 'k'")), (Some("cert_file"), Some("key_file")));
        let both = tls("cert_file = 'c'\nkey_file = 'k'");
        assert_eq!(both.problem(), None);
        assert_eq!(both.files().unwrap().key_file.to_str(), Some("k"));
        assert!(toml::from_str::<WebTls>("verify = false").is_err());
    }
}
