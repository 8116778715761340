//! Keeps what was made of files as long as they stay the same. \[IO\]
//!
//! The files are looked at before each handshake. A new certificate often comes in two steps, and for a moment its key is not
//! there yet: then, and whenever the new files cannot be used, those before stay at work.

use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, PoisonError};

use rustls::{ClientConfig, ServerConfig};

use super::certificate::{Certificate, Validity};
use super::error::TlsError;
use super::files::{self, Loaded, Stamp};
use super::settings::{TlsClientSettings, TlsServerSettings};
use super::setup::ClientCheck;
use crate::time::Clock;

/// What a TLS client connects with.
pub type ClientKeeper = Keeper<TlsClientSettings>;
/// What a TLS server accepts with.
pub type ServerKeeper = Keeper<(TlsServerSettings, Option<ClientCheck>)>;

/// Files that become the settings of connections.
pub trait Source: Send + Sync + 'static {
    /// Of connections.
    type Config: Send + Sync;

    /// The files, in an order that stays.
    fn files(&self) -> Vec<&Path>;

    /// Whether what is loaded also hangs on other things than these files.
    fn is_open(&self) -> bool {
        false
    }

    /// Reads them.
    fn load(&self) -> Result<Loaded<Self::Config>, TlsError>;
}

impl Source for TlsClientSettings {
    type Config = ClientConfig;

    fn files(&self) -> Vec<&Path> {
        [&self.ca_file, &self.cert_file, &self.key_file].into_iter().flatten().map(PathBuf::as_path).collect()
    }

    /// The host's own authorities.
    fn is_open(&self) -> bool {
        self.ca_file.is_none()
    }

    fn load(&self) -> Result<Loaded<ClientConfig>, TlsError> {
        files::load_client(self)
    }
}

impl Source for (TlsServerSettings, Option<ClientCheck>) {
    type Config = ServerConfig;

    fn files(&self) -> Vec<&Path> {
        let TlsServerSettings { cert_file, key_file, client_ca_file } = &self.0;
        [cert_file.as_path(), key_file].into_iter().chain(client_ca_file.as_deref()).collect()
    }

    fn load(&self) -> Result<Loaded<ServerConfig>, TlsError> {
        files::load_server(&self.0, self.1)
    }
}

/// Keeps what was made of the files.
#[derive(Debug)]
pub struct Keeper<S: Source> {
    /// For the log: `[mqtt.tls]`.
    table: &'static str,
    source: S,
    clock: Clock,
    kept: Mutex<Kept<S::Config>>,
}

#[derive(Debug)]
struct Kept<C> {
    /// What works, with our own certificate.
    good: Option<(Arc<C>, Option<Certificate>)>,
    /// The files of which `good` or `bad` was made.
    seen: Option<Vec<Stamp>>,
    /// What was wrong with the newest files.
    bad: Option<TlsError>,
}

impl<S: Source> Keeper<S> {
    /// Nothing is read yet.
    #[must_use]
    pub fn new(table: &'static str, source: S, clock: Clock) -> Self {
        Self { table, source, clock, kept: Mutex::new(Kept { good: None, seen: None, bad: None }) }
    }

    /// What to connect with now; the files are read where they changed. Takes as long as a disk does.
    ///
    /// # Errors
    /// The files cannot be used, and there were none before them that could.
    pub fn current(&self) -> Result<Arc<S::Config>, TlsError> {
        let mut kept = self.kept.lock().unwrap_or_else(PoisonError::into_inner);
        let stamps: Vec<Stamp> = self.source.files().into_iter().map(files::stamp).collect();
        let same = kept.seen.as_ref() == Some(&stamps);
        // A certificate that was too young may be valid by now, and the host's authorities have no stamp.
        let again = self.source.is_open() || matches!(kept.bad, Some(TlsError::NotValid { .. }));
        if !same || again {
            let loaded = self.source.load().and_then(|loaded| self.judge(&kept, loaded));
            match loaded {
                Ok(loaded) => self.take_up(&mut kept, loaded, same),
                Err(error) => self.complain(&mut kept, error),
            }
            kept.seen = Some(stamps);
        }
        match (&kept.good, &kept.bad) {
            (Some((config, _)), _) => Ok(Arc::clone(config)),
            (None, Some(error)) => Err(error.clone()),
            (None, None) => Err(TlsError::Refused("nothing was loaded".to_owned())),
        }
    }

    /// The same from a task, which must not wait for a disk.
    ///
    /// # Errors
    /// As [`current`](Self::current).
    pub async fn current_async(self: &Arc<Self>) -> Result<Arc<S::Config>, TlsError> {
        let keeper = Arc::clone(self);
        let read = tokio::task::spawn_blocking(move || keeper.current()).await;
        read.unwrap_or_else(|error| Err(TlsError::Refused(error.to_string())))
    }

    /// A certificate that is not valid now is worse than one that is.
    fn judge(
        &self,
        kept: &Kept<S::Config>,
        loaded: Loaded<S::Config>,
    ) -> Result<Loaded<S::Config>, TlsError> {
        let now = self.clock.now().utc;
        let works = |own: &Certificate| own.validity(now) == Validity::Valid;
        let old = kept.good.as_ref().and_then(|(_, own)| own.as_ref());
        match &loaded.own {
            Some((file, own)) if old.is_some_and(works) && !works(own) => Err(TlsError::NotValid {
                file: file.display().to_string(),
                complaint: own.complaint(now).unwrap_or_default(),
            }),
            Some(_) | None => Ok(loaded),
        }
    }

    fn take_up(&self, kept: &mut Kept<S::Config>, loaded: Loaded<S::Config>, same: bool) {
        let Loaded { config, own, warnings } = loaded;
        let (table, now) = (self.table, self.clock.now().utc);
        let renewed = kept.good.is_some() && (!same || kept.bad.is_some());
        kept.bad = None;
        if !same {
            for warning in warnings {
                tracing::warn!("{table}: {warning}");
            }
            if let Some(complaint) = own.as_ref().and_then(|(_, own)| own.complaint(now)) {
                tracing::warn!("{table}: our own certificate {complaint}; others will not take it");
            }
        }
        if renewed {
            tracing::info!("{table}: new certificates are taken up");
        }
        kept.good = Some((Arc::new(config), own.map(|(_, own)| own)));
    }

    fn complain(&self, kept: &mut Kept<S::Config>, error: TlsError) {
        if kept.good.is_some() && kept.bad.as_ref() != Some(&error) {
            tracing::warn!("{}: {error}; what was read before stays in use", self.table);
        }
        kept.bad = Some(error);
    }
}
