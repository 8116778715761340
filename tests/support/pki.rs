//! Certification authorities and certificates, made for a test, as files.

use std::path::{Path, PathBuf};
use std::time::Duration;

use cangate::time::Clock;
use rcgen::{
    BasicConstraints, CertificateParams, CustomExtension, DnType, IsCa, Issuer, KeyPair, KeyUsagePurpose,
    date_time_ymd,
};
use tempfile::TempDir;

const DAY: u64 = 86_400;

/// A folder for the files of one test.
pub struct Folder(pub TempDir);

impl Folder {
    pub fn new() -> Self {
        Self(tempfile::tempdir().unwrap())
    }

    pub fn path(&self, name: &str) -> PathBuf {
        self.0.path().join(name)
    }

    /// Writes a file; a new file takes the place of the one before in one step, as programs that renew certificates do it.
    pub fn write(&self, name: &str, text: &str) -> PathBuf {
        let (path, new) = (self.path(name), self.path(&format!("{name}.new")));
        std::fs::write(&new, text).unwrap();
        std::fs::set_permissions(&new, std::os::unix::fs::PermissionsExt::from_mode(0o600)).unwrap();
        std::fs::rename(&new, &path).unwrap();
        path
    }

    /// Writes `NAME.pem` and `NAME.key`.
    pub fn write_pair(&self, name: &str, pair: &Pair) -> (PathBuf, PathBuf) {
        (self.write(&format!("{name}.pem"), &pair.certificate), self.write(&format!("{name}.key"), &pair.key))
    }
}

/// A certificate and its key, PEM.
pub struct Pair {
    pub certificate: String,
    pub key: String,
    pub der: Vec<u8>,
}

/// A certification authority.
pub struct Authority {
    issuer: Issuer<'static, KeyPair>,
    pub pem: String,
}

impl Authority {
    pub fn new(name: &str) -> Self {
        let mut params = params(name, &[]);
        params.is_ca = IsCa::Ca(BasicConstraints::Unconstrained);
        params.key_usages = vec![KeyUsagePurpose::KeyCertSign, KeyUsagePurpose::CrlSign];
        let key = KeyPair::generate().unwrap();
        let pem = params.self_signed(&key).unwrap().pem();
        Self { issuer: Issuer::new(params, key), pem }
    }

    /// A certificate for `localhost` and 127.0.0.1.
    pub fn host(&self) -> Pair {
        self.make("localhost", &["localhost", "127.0.0.1"], |_| {})
    }

    /// One for these names, changed before it is signed.
    pub fn make(&self, name: &str, names: &[&str], change: impl FnOnce(&mut CertificateParams)) -> Pair {
        let mut params = params(name, names);
        change(&mut params);
        let key = KeyPair::generate().unwrap();
        let certificate = params.signed_by(&key, &self.issuer).unwrap();
        Pair { certificate: certificate.pem(), key: key.serialize_pem(), der: certificate.der().to_vec() }
    }

    /// One for a Modbus client with these roles, each in an extension of its own.
    pub fn with_roles(&self, roles: &[&str]) -> Pair {
        self.make("plc", &[], |params| {
            for role in roles {
                params.custom_extensions.push(role_extension(&utf8_string(role.as_bytes())));
            }
        })
    }
}

fn params(name: &str, names: &[&str]) -> CertificateParams {
    let names: Vec<String> = names.iter().map(|name| (*name).to_owned()).collect();
    let mut params = CertificateParams::new(names).unwrap();
    params.distinguished_name = rcgen::DistinguishedName::new();
    params.distinguished_name.push(DnType::CommonName, name);
    params.not_before = date_time_ymd(2020, 1, 1);
    params.not_after = date_time_ymd(2090, 1, 1);
    params
}

/// The extension that carries the role of a Modbus client, with this content.
pub fn role_extension(content: &[u8]) -> CustomExtension {
    CustomExtension::from_oid_content(&[1, 3, 6, 1, 4, 1, 50316, 802, 1], content.to_vec())
}

/// ASN.1 UTF8String, DER.
pub fn utf8_string(text: &[u8]) -> Vec<u8> {
    tagged(0x0C, text)
}

/// ASN.1 of this tag, DER.
pub fn tagged(tag: u8, text: &[u8]) -> Vec<u8> {
    let length = text.len();
    let mut bytes = vec![tag];
    match u8::try_from(length) {
        Ok(short) if short < 128 => bytes.push(short),
        _ => {
            bytes.push(0x82);
            bytes.extend(u16::try_from(length).unwrap().to_be_bytes());
        }
    }
    [&bytes, text].concat()
}

/// Lets it expire so many days from now.
pub fn expires_in(params: &mut CertificateParams, days: i64) {
    let today = u64::try_from(Clock::start().now().utc.as_secs()).unwrap();
    // An hour more, so that the day does not change while the test runs.
    let then = today.checked_add_signed(days * 86_400).unwrap() + 3_600;
    params.not_after = date_time_ymd(1970, 1, 1) + Duration::from_secs(then);
}

/// Lets it be valid from tomorrow on.
pub fn begins_tomorrow(params: &mut CertificateParams) {
    let today = u64::try_from(Clock::start().now().utc.as_secs()).unwrap();
    params.not_before = date_time_ymd(1970, 1, 1) + Duration::from_secs(today + DAY);
}

pub fn name(path: &Path) -> String {
    path.display().to_string()
}
