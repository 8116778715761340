//! The keys that name the files of a TLS client or server.

use std::path::{Path, PathBuf};

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// Files of a TLS client. PEM; all are read anew when they change.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct TlsClientSettings {
    /// Certificates of the certification authorities that the server may have its certificate from; without it those that
    /// the host trusts.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub ca_file: Option<PathBuf>,
    /// Our certificate, for servers that ask for one, followed by those between it and its authority. Only with `key_file`.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub cert_file: Option<PathBuf>,
    /// Its private key, not encrypted.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub key_file: Option<PathBuf>,
}

impl TlsClientSettings {
    /// Whether no key is set.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        *self == Self::default()
    }

    /// What does not fit together: the key that it is about, what is wrong, how to mend it.
    #[must_use]
    pub fn problems(&self) -> Option<(&'static str, &'static str, &'static str)> {
        match (&self.cert_file, &self.key_file) {
            (Some(_), None) => Some((
                "cert_file",
                "a certificate without its private key cannot be shown to anybody",
                "add `key_file`, or take `cert_file` away",
            )),
            (None, Some(_)) => Some((
                "key_file",
                "a private key without its certificate means nothing",
                "add `cert_file`, or take `key_file` away",
            )),
            (Some(_), Some(_)) | (None, None) => None,
        }
    }

    /// Files with certificates.
    #[must_use]
    pub fn certificates(&self) -> Vec<&Path> {
        [&self.cert_file, &self.ca_file].into_iter().flatten().map(PathBuf::as_path).collect()
    }
}

/// Files of a TLS server. PEM; all are read anew when they change.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct TlsServerSettings {
    /// The certificate of the gateway, followed by those between it and its authority.
    pub cert_file: PathBuf,
    /// Its private key, not encrypted.
    pub key_file: PathBuf,
    /// Certificates of the authorities that clients must have theirs from. With it nobody without a certificate gets in;
    /// without it clients are not asked for one.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub client_ca_file: Option<PathBuf>,
}

impl TlsServerSettings {
    /// Files with certificates.
    #[must_use]
    pub fn certificates(&self) -> Vec<&Path> {
        std::iter::once(self.cert_file.as_path()).chain(self.client_ca_file.as_deref()).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_certificate_and_its_key_come_together_or_not_at_all() {
        let key = |text: &str| {
            toml::from_str::<TlsClientSettings>(text).unwrap().problems().map(|problem| problem.0)
        };
        assert_eq!(key(""), None);
        assert_eq!(key("ca_file = 'ca'"), None);
        assert_eq!(key("cert_file = 'c'\nkey_file = 'k'"), None);
        assert_eq!(key("cert_file = 'c'"), Some("cert_file"));
        assert_eq!(key("key_file = 'k'"), Some("key_file"));
        assert!(toml::from_str::<TlsClientSettings>("insecure = true").is_err());
        assert!(toml::from_str::<TlsServerSettings>("cert_file = 'c'").is_err());
    }
}
