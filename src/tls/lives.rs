//! For how many days certificates are valid yet (G06). \[IO\]

use std::path::{Path, PathBuf};

use super::certificate::{Certificate, date, days_left};
use super::files;
use crate::time::Timestamp;

/// Files whose certificates are watched.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Watched(pub Vec<PathBuf>);

/// The certificate of a file that expires first.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Life {
    /// The file.
    pub file: String,
    /// Whose it is.
    pub subject: String,
    /// Until when it is valid.
    pub not_after: Timestamp,
    /// Whole days until then; negative once it has expired.
    pub days_left: i64,
}

impl Life {
    /// Until when it is valid: `2027-01-02T00:00:00Z`.
    #[must_use]
    pub fn expires(&self) -> String {
        date(self.not_after)
    }
}

impl Watched {
    /// Reads the files. One that cannot be read counts as it was `before`: as long as nothing good takes its place, the old
    /// certificate stays in use and goes on ageing. Takes as long as a disk does.
    #[must_use]
    pub fn lives(&self, now: Timestamp, before: &[Life]) -> Vec<Life> {
        let life = |path: &PathBuf| {
            let file = path.display().to_string();
            let (subject, not_after) = first_to_expire(path).or_else(|| {
                let life = before.iter().find(|life| life.file == file)?;
                Some((life.subject.clone(), life.not_after))
            })?;
            Some(Life { file, subject, not_after, days_left: days_left(now, not_after) })
        };
        self.0.iter().filter_map(life).collect()
    }
}

/// Whose certificate of a file expires first, and when; nothing where any of them cannot be read.
fn first_to_expire(path: &Path) -> Option<(String, Timestamp)> {
    let chain = files::certificates(path).ok()?;
    let read: Result<Vec<_>, _> = chain.iter().map(|certificate| Certificate::read(certificate)).collect();
    let first = read.ok()?.into_iter().min_by_key(|certificate| certificate.not_after)?;
    Some((first.subject, first.not_after))
}
