//! Reads certificates and keys. \[IO\]

use std::fs::{self, File, Metadata};
use std::io::Read;
use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};

use rustls::RootCertStore;
use rustls::pki_types::pem::{Error as PemError, PemObject};
use rustls::pki_types::{CertificateDer, PrivateKeyDer};

use super::certificate::Certificate;
use super::error::TlsError;
use super::settings::{TlsClientSettings, TlsServerSettings};
use super::setup::{self, ClientCheck, Identity};

/// Largest file that is read, in bytes.
const LARGEST_FILE: u64 = 4 * 1024 * 1024;
/// Bits of a file's mode that let everybody read or write it.
const OTHERS: u32 = 0o006;

/// What was made of some files.
#[derive(Debug)]
pub struct Loaded<C> {
    /// The settings for rustls.
    pub config: C,
    /// Our own certificate and its file, where there is one.
    pub own: Option<(PathBuf, Certificate)>,
    /// What works but should be mended.
    pub warnings: Vec<String>,
}

/// How a file is told from another one of the same name; `None` where there is none.
pub type Stamp = Option<(u64, u64, u64, i64, i64, i64, i64)>;

/// What tells the state of a file: a new file, new content, or new rights make a new stamp.
#[must_use]
pub fn stamp(path: &Path) -> Stamp {
    let read = |file: Metadata| {
        (file.dev(), file.ino(), file.len(), file.mtime(), file.mtime_nsec(), file.ctime(), file.ctime_nsec())
    };
    fs::metadata(path).ok().map(read)
}

/// The files of a client become its settings.
///
/// # Errors
/// Which file is wrong, why, and how to mend it.
pub fn load_client(settings: &TlsClientSettings) -> Result<Loaded<rustls::ClientConfig>, TlsError> {
    let mut warnings = Vec::new();
    let authorities = match &settings.ca_file {
        Some(path) => authorities(path)?,
        None => authorities_of_the_host()?,
    };
    let (cert_file, key_file) = (settings.cert_file.as_deref(), settings.key_file.as_deref());
    let pair = cert_file.zip(key_file);
    let identity = pair.map(|(cert_file, key_file)| identity(cert_file, key_file, &mut warnings));
    let (own, identity) = identity.transpose()?.map_or((None, None), |(own, it)| (Some(own), Some(it)));
    let names = pair.map(|(cert_file, key_file)| (name(cert_file), name(key_file))).unwrap_or_default();
    let config = setup::client(authorities, identity, (&names.0, &names.1))?;
    Ok(Loaded { config, own, warnings })
}

/// The files of a server become its settings; `also` looks at the certificates of its clients.
///
/// # Errors
/// Which file is wrong, why, and how to mend it.
pub fn load_server(
    settings: &TlsServerSettings,
    also: Option<ClientCheck>,
) -> Result<Loaded<rustls::ServerConfig>, TlsError> {
    let mut warnings = Vec::new();
    let TlsServerSettings { cert_file, key_file, client_ca_file } = settings;
    let (own, identity) = identity(cert_file, key_file, &mut warnings)?;
    let authorities = client_ca_file.as_deref().map(authorities).transpose()?;
    let authorities = authorities.map(|authorities| (authorities, also));
    let config = setup::server(identity, authorities, (&name(cert_file), &name(key_file)))?;
    Ok(Loaded { config, own: Some(own), warnings })
}

/// The certificates of a file, in its order. Not empty.
///
/// # Errors
/// What is wrong with the file.
pub fn certificates(path: &Path) -> Result<Vec<CertificateDer<'static>>, TlsError> {
    let text = read(path)?;
    let certificates: Result<Vec<_>, _> = CertificateDer::pem_slice_iter(&text).collect();
    let certificates = certificates.map_err(|error| damaged(path, "certificate", &error))?;
    if certificates.is_empty() {
        let hint = if contains(&text, b"PRIVATE KEY-----") {
            "it holds a private key: have the names of the two files been mixed up?"
        } else if text.first() == Some(&0x30) {
            "it looks like DER: `openssl x509 -inform der -in FILE -out FILE.pem` makes PEM of it"
        } else {
            "name the file that the authority sent, as PEM"
        };
        let file = name(path);
        return Err(TlsError::Nothing { file, what: "certificate", label: "CERTIFICATE", hint });
    }
    Ok(certificates)
}

fn identity(
    cert_file: &Path,
    key_file: &Path,
    warnings: &mut Vec<String>,
) -> Result<((PathBuf, Certificate), Identity), TlsError> {
    let chain = certificates(cert_file)?;
    let damaged = |error| TlsError::Damaged { file: name(cert_file), what: "certificate", error };
    let first = chain.first().ok_or_else(|| damaged("it is empty".to_owned()))?;
    let own = Certificate::read(first).map_err(damaged)?;
    let key = key(key_file)?;
    if let Ok(file) = fs::metadata(key_file)
        && file.mode() & OTHERS != 0
    {
        warnings.push(format!(
            "everybody on this host can read the private key `{}`: `chmod 600` it",
            key_file.display()
        ));
    }
    Ok(((cert_file.to_owned(), own), Identity { chain, key }))
}

fn key(path: &Path) -> Result<PrivateKeyDer<'static>, TlsError> {
    let text = read(path)?;
    match PrivateKeyDer::from_pem_slice(&text) {
        Ok(key) => Ok(key),
        Err(PemError::NoItemsFound) => {
            let hint = if contains(&text, b"ENCRYPTED PRIVATE KEY-----") {
                "it is encrypted: `openssl pkey -in FILE -out FILE.plain` takes the passphrase away; protect the file by its mode instead"
            } else if contains(&text, b"CERTIFICATE-----") {
                "it holds a certificate: have the names of the two files been mixed up?"
            } else if text.first() == Some(&0x30) {
                "it looks like DER: `openssl pkey -inform der -in FILE -out FILE.pem` makes PEM of it"
            } else {
                "name the file that was made with the certificate's request"
            };
            let file = name(path);
            Err(TlsError::Nothing { file, what: "private key", label: "PRIVATE KEY", hint })
        }
        Err(error) => Err(damaged(path, "private key", &error)),
    }
}

fn authorities(path: &Path) -> Result<RootCertStore, TlsError> {
    let mut authorities = RootCertStore::empty();
    for certificate in certificates(path)? {
        authorities.add(certificate).map_err(|error| TlsError::Damaged {
            file: name(path),
            what: "certificate",
            error: error.to_string(),
        })?;
    }
    Ok(authorities)
}

/// Those that the host trusts; what is odd about single ones of them is the host's affair.
fn authorities_of_the_host() -> Result<RootCertStore, TlsError> {
    let found = rustls_native_certs::load_native_certs();
    let mut authorities = RootCertStore::empty();
    let (taken, _) = authorities.add_parsable_certificates(found.certs);
    if taken == 0 {
        let error = found.errors.first().map_or_else(String::new, |error| format!(": {error}"));
        return Err(TlsError::NoAuthorities { error });
    }
    Ok(authorities)
}

fn read(path: &Path) -> Result<Vec<u8>, TlsError> {
    let unreadable =
        |error: std::io::Error| TlsError::Unreadable { file: name(path), error: error.to_string() };
    let file = File::open(path).map_err(unreadable)?;
    let mut text = Vec::new();
    file.take(LARGEST_FILE + 1).read_to_end(&mut text).map_err(unreadable)?;
    if u64::try_from(text.len()).unwrap_or(u64::MAX) > LARGEST_FILE {
        return Err(TlsError::TooLarge { file: name(path), limit: LARGEST_FILE });
    }
    Ok(text)
}

fn damaged(path: &Path, what: &'static str, error: &PemError) -> TlsError {
    TlsError::Damaged { file: name(path), what, error: error.to_string() }
}

fn name(path: &Path) -> String {
    path.display().to_string()
}

fn contains(text: &[u8], part: &[u8]) -> bool {
    text.windows(part.len()).any(|window| window == part)
}
