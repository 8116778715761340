//! TLS: certificates and keys in files become the settings of connections, and failures become words.
//!
//! TLS 1.2 and 1.3 only, by rustls with ring; the name of a server and the dates of certificates are always checked.
//! A changed file is taken up at the next handshake; a new file that cannot be used leaves the old one at work, and the log
//! says so. Nothing is resumed: each connection shows its certificate anew.
//!
//! Pure:
//! - [`settings`]: the keys that name the files.
//! - [`certificate`]: what stands in a certificate: whose it is, from when, until when.
//! - [`reason`]: why a handshake failed, in plain words.
//! - [`error`]: what is wrong with a file.
//! - [`setup`]: what was read becomes the settings of rustls.
//! - [`random`]: random bytes for secrets.
//! - [`own_host`]: a client that asks the gateway on its own host whether it is well.
//! - [`told`]: which refused handshakes the log has been told of.
//!
//! On the outside:
//! - [`files`] \[IO\]: reads certificates and keys.
//! - [`keeper`] \[IO\]: keeps what was read as long as the files stay the same.
//! - [`handshake`] \[IO\]: the server's side of a handshake, within its time.
//! - [`lives`] \[IO\]: for how many days certificates are valid yet.

pub mod certificate;
pub mod error;
pub mod files;
pub mod handshake;
pub mod keeper;
pub mod lives;
pub mod own_host;
pub mod random;
pub mod reason;
pub mod settings;
pub mod setup;
pub mod told;

pub use certificate::{Certificate, Validity};
pub use error::TlsError;
pub use keeper::{ClientKeeper, ServerKeeper};
pub use lives::{Life, Watched};
pub use reason::Reason;
pub use settings::{TlsClientSettings, TlsServerSettings};
pub use told::Told;
