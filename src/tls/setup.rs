//! What was read from files becomes the settings of rustls, pure: TLS 1.2 and 1.3, ring, nothing resumed.

use std::sync::Arc;

use rustls::client::Resumption;
use rustls::crypto::CryptoProvider;
use rustls::pki_types::{CertificateDer, PrivateKeyDer, UnixTime};
use rustls::server::danger::{ClientCertVerified, ClientCertVerifier};
use rustls::server::{NoServerSessionStorage, WebPkiClientVerifier};
use rustls::sign::CertifiedKey;
use rustls::version::{TLS12, TLS13};
use rustls::{
    CertificateError, ClientConfig, DigitallySignedStruct, DistinguishedName, Error, InconsistentKeys,
    RootCertStore, ServerConfig, SignatureScheme,
};

use super::TlsError;

/// Looks at the certificate of a client whom an authority vouches for; an error ends the handshake.
pub type ClientCheck = fn(&[u8]) -> Result<(), String>;

/// A certificate with those above it, and its key.
#[derive(Debug)]
pub struct Identity {
    /// Own certificate first. Not empty.
    pub chain: Vec<CertificateDer<'static>>,
    /// The key of the first.
    pub key: PrivateKeyDer<'static>,
}

fn provider() -> Arc<CryptoProvider> {
    Arc::new(rustls::crypto::ring::default_provider())
}

/// Settings of a client. `files` are those of the identity, for messages.
///
/// # Errors
/// Certificate and key cannot be used, or not together.
pub fn client(
    authorities: RootCertStore,
    identity: Option<Identity>,
    files: (&str, &str),
) -> Result<ClientConfig, TlsError> {
    let builder = ClientConfig::builder_with_provider(provider())
        .with_protocol_versions(&[&TLS13, &TLS12])
        .map_err(|error| refused(&error))?
        .with_root_certificates(authorities);
    let mut config = match identity {
        None => builder.with_no_client_auth(),
        Some(identity) => {
            check(&identity, files)?;
            builder.with_client_auth_cert(identity.chain, identity.key).map_err(|error| refused(&error))?
        }
    };
    // A resumed session would not look at the server's certificate again, nor show a new one of ours.
    config.resumption = Resumption::disabled();
    Ok(config)
}

/// Settings of a server. With `authorities` clients must show a certificate of theirs, which `also` looks at.
///
/// # Errors
/// Certificate and key cannot be used, or not together.
pub fn server(
    identity: Identity,
    authorities: Option<(RootCertStore, Option<ClientCheck>)>,
    files: (&str, &str),
) -> Result<ServerConfig, TlsError> {
    check(&identity, files)?;
    let builder = ServerConfig::builder_with_provider(provider())
        .with_protocol_versions(&[&TLS13, &TLS12])
        .map_err(|error| refused(&error))?;
    let builder = match authorities {
        None => builder.with_no_client_auth(),
        Some((authorities, also)) => {
            let inner = WebPkiClientVerifier::builder_with_provider(Arc::new(authorities), provider())
                .build()
                .map_err(|error| TlsError::Refused(error.to_string()))?;
            builder.with_client_cert_verifier(Arc::new(Verifier { inner, also }))
        }
    };
    let mut config =
        builder.with_single_cert(identity.chain, identity.key).map_err(|error| refused(&error))?;
    // Each connection shows its certificate, and nobody lives on from a session of a role that was taken away.
    config.session_storage = Arc::new(NoServerSessionStorage {});
    config.send_tls13_tickets = 0;
    Ok(config)
}

fn refused(error: &Error) -> TlsError {
    TlsError::Refused(error.to_string())
}

fn check(identity: &Identity, (cert_file, key_file): (&str, &str)) -> Result<(), TlsError> {
    match CertifiedKey::from_der(identity.chain.clone(), identity.key.clone_key(), &provider()) {
        Ok(_) => Ok(()),
        Err(Error::InconsistentKeys(InconsistentKeys::KeyMismatch)) => {
            Err(TlsError::Mismatch { cert_file: cert_file.to_owned(), key_file: key_file.to_owned() })
        }
        Err(Error::InvalidCertificate(error)) => Err(TlsError::Damaged {
            file: cert_file.to_owned(),
            what: "certificate",
            error: error.to_string(),
        }),
        Err(Error::General(error)) => Err(TlsError::Kind { file: key_file.to_owned(), error }),
        Err(other) => Err(refused(&other)),
    }
}

/// Clients need a certificate of an authority, and one that a check of ours takes.
#[derive(Debug)]
struct Verifier {
    inner: Arc<dyn ClientCertVerifier>,
    also: Option<ClientCheck>,
}

/// Why a check of ours did not take a certificate.
#[derive(Debug, thiserror::Error)]
#[error("{0}")]
struct NotTaken(String);

impl ClientCertVerifier for Verifier {
    fn root_hint_subjects(&self) -> &[DistinguishedName] {
        self.inner.root_hint_subjects()
    }

    fn verify_client_cert(
        &self,
        end_entity: &CertificateDer<'_>,
        intermediates: &[CertificateDer<'_>],
        now: UnixTime,
    ) -> Result<ClientCertVerified, Error> {
        let verified = self.inner.verify_client_cert(end_entity, intermediates, now)?;
        if let Some(check) = self.also {
            check(end_entity.as_ref()).map_err(|text| {
                let error: Arc<dyn std::error::Error + Send + Sync> = Arc::new(NotTaken(text));
                Error::InvalidCertificate(CertificateError::Other(rustls::OtherError(error)))
            })?;
        }
        Ok(verified)
    }

    fn verify_tls12_signature(
        &self,
        message: &[u8],
        cert: &CertificateDer<'_>,
        dss: &DigitallySignedStruct,
    ) -> Result<rustls::client::danger::HandshakeSignatureValid, Error> {
        self.inner.verify_tls12_signature(message, cert, dss)
    }

    fn verify_tls13_signature(
        &self,
        message: &[u8],
        cert: &CertificateDer<'_>,
        dss: &DigitallySignedStruct,
    ) -> Result<rustls::client::danger::HandshakeSignatureValid, Error> {
        self.inner.verify_tls13_signature(message, cert, dss)
    }

    fn supported_verify_schemes(&self) -> Vec<SignatureScheme> {
        self.inner.supported_verify_schemes()
    }
}
