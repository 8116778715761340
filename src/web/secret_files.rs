//! Files with tokens and with hashes of passwords, read whenever they are needed. \[IO\]

use std::collections::BTreeMap;
use std::io::{self, Read};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use tokio::sync::Semaphore;
use tokio::task::JoinSet;

use crate::gateway::command::{Access, Grant, PasswordHash, PasswordPlace};
use crate::time::{Clock, Instant};

/// The longest file that is read, in bytes.
const LONGEST: u64 = 4_096;
/// A file that does not answer within this time is one that cannot be read.
const LIMIT: Duration = Duration::from_secs(2);
/// Readings of one file at the same time. Each has a thread, which a disk that does not answer keeps.
const AT_ONCE: usize = 4;
/// For how long a file that lets nobody in is not told of again.
const QUIET: Duration = Duration::from_secs(60);

/// Reads them; clones are the same ones. What is wrong with a file is told at most once a minute, and its content never.
#[derive(Clone, Debug)]
pub struct SecretFiles {
    clock: Clock,
    /// Those that are being read, or were told of a while ago.
    known: Arc<Mutex<BTreeMap<String, Known>>>,
}

#[derive(Debug)]
struct Known {
    turns: Arc<Semaphore>,
    told: Option<Instant>,
}

#[derive(Clone, Copy, Debug)]
enum Kind {
    Token,
    Password,
}

impl Kind {
    fn word(self) -> &'static str {
        match self {
            Self::Token => "token",
            Self::Password => "password",
        }
    }

    fn remedy(self) -> &'static str {
        match self {
            Self::Token => "it holds one token of 16 bytes or more",
            Self::Password => "it holds the one line that `cangate password` prints",
        }
    }
}

impl SecretFiles {
    /// None is known yet.
    #[must_use]
    pub fn new(clock: Clock) -> Self {
        Self { clock, known: Arc::default() }
    }

    /// All tokens that can be read, in the order of the names.
    pub async fn tokens(&self, access: &Access) -> Vec<(Arc<Grant>, String)> {
        let reading = access.tokens().map(|(grant, file)| {
            let (files, grant, file) = (self.clone(), Arc::clone(grant), file.to_owned());
            async move { Some((Arc::clone(&grant), files.read(&grant, Kind::Token, &file).await?)) }
        });
        all(reading.collect()).await
    }

    /// All hashes of passwords that can be read, in the order of the names.
    pub async fn passwords(&self, access: &Access) -> Vec<(Arc<Grant>, PasswordHash)> {
        let reading = access.passwords().map(|(grant, place)| {
            let (files, grant, place) = (self.clone(), Arc::clone(grant), place.clone());
            async move { Some((Arc::clone(&grant), files.password(&grant, &place).await?)) }
        });
        all(reading.collect()).await
    }

    /// The hash of a password, from wherever it stands.
    pub async fn password(&self, grant: &Grant, place: &PasswordPlace) -> Option<PasswordHash> {
        let file = match place {
            PasswordPlace::Here(hash) => return Some(hash.clone()),
            PasswordPlace::File(file) => file,
        };
        let text = self.read(grant, Kind::Password, file).await?;
        PasswordHash::parse(&text)
            .inspect_err(|error| self.tell(grant, Kind::Password, file, &error.to_string()))
            .ok()
    }

    async fn read(&self, grant: &Grant, kind: Kind, file: &str) -> Option<String> {
        let turns = self.turns(file);
        let path = file.to_owned();
        let reading = async move {
            let turn = turns.acquire_owned().await.map_err(io::Error::other)?;
            // Whoever waits for it gives up; the thread cannot, and keeps its turn until the disk answers.
            let reading = tokio::task::spawn_blocking(move || {
                let _turn = turn;
                read_whole(&path)
            });
            reading.await?
        };
        let in_vain = |_elapsed| Err(io::Error::new(io::ErrorKind::TimedOut, "its disk does not answer"));
        tokio::time::timeout(LIMIT, reading)
            .await
            .unwrap_or_else(in_vain)
            .inspect_err(|error| self.tell(grant, kind, file, &error.to_string()))
            .ok()
    }

    fn known(&self) -> MutexGuard<'_, BTreeMap<String, Known>> {
        self.known.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn turns(&self, file: &str) -> Arc<Semaphore> {
        let now = self.clock.now().instant;
        let mut known = self.known();
        let is_recent = |known: &Known| known.told.is_some_and(|told| now.since(told) < QUIET);
        known.retain(|_, known| Arc::strong_count(&known.turns) > 1 || is_recent(known));
        let new = || Known { turns: Arc::new(Semaphore::new(AT_ONCE)), told: None };
        Arc::clone(&known.entry(file.to_owned()).or_insert_with(new).turns)
    }

    fn tell(&self, grant: &Grant, kind: Kind, file: &str, why: &str) {
        let now = self.clock.now().instant;
        let mut known = self.known();
        let Some(known) = known.get_mut(file) else { return };
        if known.told.is_some_and(|told| now.since(told) < QUIET) {
            return;
        }
        known.told = Some(now);
        let (what, remedy) = (kind.word(), kind.remedy());
        tracing::warn!(
            access = %grant.name(),
            file,
            "nobody can log in by this {what} file: {why}; see that {remedy}, and that the user of the gateway may read it"
        );
    }
}

/// All are read at the same time, so that those that do not answer take no longer than one.
async fn all<T: Send + 'static>(reading: JoinSet<Option<(Arc<Grant>, T)>>) -> Vec<(Arc<Grant>, T)> {
    let mut read: Vec<_> = reading.join_all().await.into_iter().flatten().collect();
    read.sort_by(|(one, _), (other, _)| one.name().cmp(other.name()));
    read
}

fn read_whole(file: &str) -> io::Result<String> {
    let mut text = String::new();
    let read = std::fs::File::open(file)?.take(LONGEST + 1).read_to_string(&mut text)?;
    if u64::try_from(read).is_ok_and(|read| read <= LONGEST) {
        return Ok(text);
    }
    Err(io::Error::new(io::ErrorKind::InvalidData, format!("it has more than {LONGEST} bytes")))
}

#[cfg(test)]
mod tests {
    use std::path::{Path, PathBuf};

    use super::*;
    use crate::access::{AccessEntry, Role, SecretText};
    use crate::mapping::{At, SourceText, TagTable};

    /// Whoever opens a pipe waits until somebody writes into it, as on a disk that has gone.
    fn pipe(folder: &Path, name: &str) -> PathBuf {
        let pipe = folder.join(name);
        assert!(std::process::Command::new("mkfifo").arg(&pipe).status().unwrap().success());
        pipe
    }

    /// Those who wait for it go on, and those who have not come to it yet find nothing.
    fn release(pipe: &Path) {
        let end = std::fs::File::options().read(true).write(true).open(pipe).unwrap();
        std::fs::remove_file(pipe).unwrap();
        drop(end);
    }

    /// Time stands still while a file is read.
    async fn let_the_limit_pass() {
        for _ in 0..10 {
            tokio::task::yield_now().await;
        }
        tokio::time::advance(LIMIT).await;
    }

    #[tokio::test(start_paused = true)]
    async fn files_that_do_not_answer_hold_up_the_others_for_the_time_of_one() {
        const HASH: &str =
            "$argon2id$v=19$m=19456,t=2,p=1$c2FsdHNhbHRzYWx0$i1ZbHXvRKg4oGAMRmRf2WRWM3kLHSDBTbq4/jXrsxgI";
        let folder = tempfile::tempdir().unwrap();
        let pipes = ["a", "c", "d"].map(|name| pipe(folder.path(), name));
        let mut entries: BTreeMap<_, _> = pipes
            .iter()
            .map(|pipe| {
                let password_file = Some(At::nowhere(pipe.display().to_string()));
                let name = pipe.file_name().unwrap().to_string_lossy().into_owned();
                (At::nowhere(name), AccessEntry { password_file, ..AccessEntry::default() })
            })
            .collect();
        let password = Some(At::nowhere(SecretText(HASH.to_owned())));
        entries.insert(At::nowhere("b".to_owned()), AccessEntry { password, ..AccessEntry::default() });
        let access = Access::build(&SourceText::new("", ""), &entries, &TagTable::default()).0;
        let files = SecretFiles::new(Clock::start());
        let reading = tokio::spawn(async move { files.passwords(&access).await });
        let_the_limit_pass().await;
        let read = reading.await.unwrap();
        for pipe in &pipes {
            release(pipe);
        }
        assert_eq!(read.iter().map(|(grant, _)| &**grant.name()).collect::<Vec<_>>(), ["b"]);
    }

    #[tokio::test(start_paused = true)]
    async fn a_file_that_does_not_answer_keeps_a_few_threads_however_often_it_is_asked_for() {
        let folder = tempfile::tempdir().unwrap();
        let pipe = pipe(folder.path(), "a");
        let files = SecretFiles::new(Clock::start());
        let place = PasswordPlace::File(pipe.display().to_string());
        let grant = Arc::new(Grant::new("maria", Role::Viewer, []));
        let reading: JoinSet<_> = (0..50)
            .map(|_| {
                let (files, grant, place) = (files.clone(), Arc::clone(&grant), place.clone());
                async move { files.password(&grant, &place).await }
            })
            .collect();
        let_the_limit_pass().await;
        assert_eq!(reading.join_all().await, [const { None }; 50]);
        let threads = Arc::strong_count(&files.known()[&pipe.display().to_string()].turns) - 1;
        release(&pipe);
        assert_eq!(threads, AT_ONCE);
    }

    #[tokio::test(start_paused = true)]
    async fn a_file_that_lets_nobody_in_is_told_of_once_a_minute_with_its_remedy_and_never_its_content() {
        let folder = tempfile::tempdir().unwrap();
        let log = tempfile::NamedTempFile::new().unwrap();
        let writer = Mutex::new(log.reopen().unwrap());
        let subscriber = tracing_subscriber::fmt().with_ansi(false).with_writer(writer).finish();
        let _told = tracing::subscriber::set_default(subscriber);
        let told = || {
            let text = std::fs::read_to_string(log.path()).unwrap();
            std::fs::write(log.path(), "").unwrap();
            text
        };
        let (files, grant) = (SecretFiles::new(Clock::start()), Grant::new("maria", Role::Viewer, []));
        let (gone, wrong) = (folder.path().join("gone"), folder.path().join("wrong"));
        std::fs::write(&wrong, "the password itself").unwrap();
        for (file, why) in [(gone, "No such file"), (wrong, "this is no Argon2id hash")] {
            let file = file.display().to_string();
            let place = PasswordPlace::File(file.clone());
            for _ in 0..100 {
                assert_eq!(files.password(&grant, &place).await, None);
            }
            let text = told();
            assert_eq!(text.matches("WARN").count(), 1, "{text}");
            for part in ["access=maria", file.as_str(), why, "`cangate password`", "may read it"] {
                assert!(text.contains(part), "{part}: {text}");
            }
            assert!(!text.contains("the password itself"), "{text}");
            tokio::time::advance(QUIET).await;
            assert_eq!(files.password(&grant, &place).await, None);
            assert_eq!(told().matches("WARN").count(), 1);
        }
        tokio::time::advance(QUIET).await;
        drop(files.turns("another"));
        assert_eq!(files.known().len(), 1, "what was told of long ago is forgotten");
    }

    #[test]
    fn what_is_too_long_is_not_read() {
        let folder = tempfile::tempdir().unwrap();
        let lengths = [("long", 4_097), ("whole", 4_096)];
        for (name, length) in lengths {
            std::fs::write(folder.path().join(name), "x".repeat(length)).unwrap();
        }
        let read =
            lengths.map(|(name, _)| read_whole(&folder.path().join(name).display().to_string()).is_ok());
        assert_eq!(read, [false, true]);
    }
}
