//! The role of a client, in an extension of its certificate (MB-TCP-Security v36, R-16 to ), pure.

use std::fmt;

use x509_parser::der_parser::asn1_rs::{Any, FromDer, Tag};
use x509_parser::der_parser::oid;
use x509_parser::prelude::X509Certificate;

/// Longest role, in bytes.
pub const LONGEST_ROLE: usize = 256;

/// The role of a client whose certificate is trusted; `None`: its certificate has none (the NULL role).
#[derive(Clone, Debug, Default, PartialEq, Eq, PartialOrd, Ord)]
pub struct PeerRole(pub Option<String>);

impl fmt::Display for PeerRole {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match &self.0 {
            Some(role) => write!(f, "role `{role}`"),
            None => f.write_str("no role"),
        }
    }
}

/// What is wrong with the role in a certificate.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum RoleError {
    /// It cannot be read at all.
    #[error("it cannot be read: {0}")]
    Certificate(String),
    ///
    #[error("it has {0} roles (extension 1.3.6.1.4.1.50316.802.1), and may have one")]
    Several(usize),
    ///
    #[error("its role (extension 1.3.6.1.4.1.50316.802.1) is no ASN.1 UTF8String")]
    NoText,
    /// Nothing that a table of roles could hold.
    #[error("its role is empty, longer than {LONGEST_ROLE} bytes, or has control characters")]
    Odd,
}

impl PeerRole {
    /// Of a certificate, DER.
    ///
    /// # Errors
    /// It has more than one role, or one that is not written as the standard has it.
    pub fn of_certificate(der: &[u8]) -> Result<Self, RoleError> {
        let (_, certificate) =
            X509Certificate::from_der(der).map_err(|error| RoleError::Certificate(error.to_string()))?;
        let oid = oid!(1.3.6.1.4.1.50316.802.1);
        let roles: Vec<&[u8]> = certificate
            .extensions()
            .iter()
            .filter(|extension| extension.oid == oid)
            .map(|extension| extension.value)
            .collect();
        match roles.as_slice() {
            [] => Ok(Self(None)),
            [role] => text(role).map(|role| Self(Some(role))),
            several => Err(RoleError::Several(several.len())),
        }
    }
}

/// [`PeerRole::of_certificate`] as a check during the handshake: what is wrong ends it.
///
/// # Errors
/// As there, in words.
pub fn check(der: &[u8]) -> Result<(), String> {
    PeerRole::of_certificate(der).map(|_| ()).map_err(|error| error.to_string())
}

fn text(value: &[u8]) -> Result<String, RoleError> {
    let (rest, any) = Any::from_der(value).map_err(|_| RoleError::NoText)?;
    if !rest.is_empty() || any.header.tag() != Tag::Utf8String || any.header.constructed() {
        return Err(RoleError::NoText);
    }
    let text = std::str::from_utf8(any.data).map_err(|_| RoleError::NoText)?;
    if text.is_empty() || text.len() > LONGEST_ROLE || text.chars().any(char::is_control) {
        return Err(RoleError::Odd);
    }
    Ok(text.to_owned())
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A certificate with these extensions of a role.
    fn role(contents: &[&[u8]]) -> Result<Option<String>, RoleError> {
        let mut params = rcgen::CertificateParams::new(vec![]).unwrap();
        let oid = [1, 3, 6, 1, 4, 1, 50316, 802, 1];
        params.custom_extensions = contents
            .iter()
            .map(|content| rcgen::CustomExtension::from_oid_content(&oid, content.to_vec()))
            .collect();
        let key = rcgen::KeyPair::generate().unwrap();
        let certificate = params.self_signed(&key).unwrap();
        PeerRole::of_certificate(certificate.der()).map(|role| role.0)
    }

    #[test]
    fn mbs_r16_r22_r23_the_role_is_one_utf8_string_or_none() {
        assert_eq!(role(&[]), Ok(None));
        assert_eq!(role(&[b"\x0C\x08Operator"]), Ok(Some("Operator".into())));
        assert_eq!(role(&["\x0C\u{4}Pr\u{fc}".as_bytes()]), Ok(Some("Pr\u{fc}".into())));
    }

    #[test]
    fn mbs_r65_of_two_roles_none_counts() {
        // x509-parser and rustls read both; nobody is to choose.
        assert_eq!(role(&[b"\x0C\x01a", b"\x0C\x01b"]), Err(RoleError::Several(2)));
    }

    #[test]
    fn roles_that_are_written_otherwise_are_refused() {
        let wrong: [&[u8]; 8] = [
            b"",
            b"Operator",
            // PrintableString, OCTET STRING.
            b"\x13\x08Operator",
            b"\x04\x08Operator",
            // No UTF-8, too short, something behind it, nothing.
            b"\x0C\x02\xFF\xFE",
            b"\x0C\x09Operator",
            b"\x0C\x08OperatorX",
            b"\x2C\x0A\x0C\x08Operator",
        ];
        for content in wrong {
            assert_eq!(role(&[content]), Err(RoleError::NoText), "{content:?}");
        }
        let long = [&b"\x0C\x82\xF0\x00"[..], &vec![b'x'; 0xF000]].concat();
        for content in [&b"\x0C\x00"[..], b"\x0C\x02a\n", &long] {
            assert_eq!(role(&[content]), Err(RoleError::Odd));
        }
    }

    #[test]
    fn bytes_that_are_no_certificate_have_no_role() {
        assert!(check(b"").is_err() && check(&[0x30; 64]).is_err());
    }
}
