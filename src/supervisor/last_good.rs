//! The texts of a configuration: which files they are, whether those changed, and a copy of the last good ones. \[IO\]

use std::collections::BTreeMap;
use std::fs;
use std::io::{self, Write};
use std::os::unix::fs::{MetadataExt, OpenOptionsExt};
use std::path::{Path, PathBuf};
use std::time::SystemTime;

use serde::{Deserialize, Serialize};

/// Name of the copy in the state directory.
const FILE: &str = "last-good.json";

/// The texts of a configuration.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Sources {
    /// The configuration file, as it was given.
    pub name: String,
    /// What it says.
    pub text: String,
    /// Mapping files that were asked for; `None`: there was none.
    pub mappings: BTreeMap<String, Option<String>>,
}

impl Sources {
    /// All files, also those that are not there and would count if they were.
    #[must_use]
    pub fn files(&self) -> Vec<PathBuf> {
        std::iter::once(&self.name).chain(self.mappings.keys()).map(PathBuf::from).collect()
    }

    /// Whether the files still say the same.
    fn are_current(&self) -> bool {
        let same = |name: &str, text: Option<&str>| fs::read_to_string(name).ok().as_deref() == text;
        same(&self.name, Some(&self.text))
            && self.mappings.iter().all(|(name, text)| same(name, text.as_deref()))
    }
}

/// Where the last good configuration is kept.
#[derive(Clone, Debug)]
pub struct LastGood {
    folder: PathBuf,
}

impl LastGood {
    /// In this folder.
    #[must_use]
    pub fn new(folder: impl Into<PathBuf>) -> Self {
        Self { folder: folder.into() }
    }

    /// The same, where files can be written there; tried by writing one.
    #[must_use]
    pub fn if_writable(folder: impl Into<PathBuf>) -> Option<Self> {
        let folder = folder.into();
        let probe = folder.join(".cangate-probe");
        let can = write_private(&probe, b"").is_ok();
        // It was ours; that it stays harms nobody.
        let _ = fs::remove_file(&probe);
        can.then_some(Self { folder })
    }

    /// Replaces the copy, as a whole or not at all; only the owner can read it.
    ///
    /// # Errors
    /// The folder or the disk does not take it; the copy of before is still there.
    pub fn keep(&self, sources: &Sources) -> io::Result<()> {
        if self.read().is_ok_and(|kept| kept == *sources) {
            return Ok(());
        }
        let text = serde_json::to_vec_pretty(sources)?;
        let temporary = self.folder.join(format!("{FILE}.new"));
        write_private(&temporary, &text)?;
        fs::rename(&temporary, self.folder.join(FILE))?;
        // The name is on the disk, too.
        fs::File::open(&self.folder)?.sync_all()
    }

    /// The copy.
    ///
    /// # Errors
    /// There is none, or it cannot be read.
    pub fn read(&self) -> io::Result<Sources> {
        Ok(serde_json::from_str(&fs::read_to_string(self.folder.join(FILE))?)?)
    }
}

fn write_private(path: &Path, text: &[u8]) -> io::Result<()> {
    let mut options = fs::OpenOptions::new();
    // A name that somebody else put there, or a link, is not written through.
    match fs::remove_file(path) {
        Err(error) if error.kind() != io::ErrorKind::NotFound => return Err(error),
        Ok(()) | Err(_) => {}
    }
    let mut file = options.write(true).create_new(true).mode(0o600).open(path)?;
    file.write_all(text)?;
    file.sync_all()
}

/// What a file looks like from outside; `None`: it is not there.
type Look = Option<(u64, u64, SystemTime)>;

/// Whether files changed.
#[derive(Clone, Debug)]
pub(super) struct Looks {
    files: Vec<PathBuf>,
    /// As they were when they were read last.
    taken: Vec<Look>,
    /// As they were a look ago.
    before: Vec<Look>,
}

impl Looks {
    /// As they are now.
    pub(super) fn new(files: Vec<PathBuf>) -> Self {
        let taken = look(&files);
        Self { files, before: taken.clone(), taken }
    }

    /// Of files that were read as these texts: one that changed since then counts as changed.
    pub(super) fn of(sources: &Sources) -> Self {
        let mut looks = Self::new(sources.files());
        if !sources.are_current() {
            looks.taken.fill(None);
            looks.taken.push(None);
        }
        looks
    }

    /// Whether they are others than those that were read, and the same as at the look before: nobody is writing them.
    pub(super) fn have_changed(&mut self) -> bool {
        let now = look(&self.files);
        let settled = now == self.before;
        self.before.clone_from(&now);
        settled && now != self.taken
    }

    /// They are read now.
    pub(super) fn take(&mut self) {
        self.taken = look(&self.files);
    }

    /// They were read as these texts. Where they are the files of before, the look that was taken then counts.
    pub(super) fn watch(&mut self, sources: &Sources) {
        if sources.files() != self.files {
            *self = Self::of(sources);
        }
    }

    /// These count too.
    pub(super) fn watch_too(&mut self, files: &[PathBuf]) {
        let more: Vec<PathBuf> = files.iter().filter(|file| !self.files.contains(file)).cloned().collect();
        self.taken.extend(look(&more));
        self.before.extend(look(&more));
        self.files.extend(more);
    }
}

fn look(files: &[PathBuf]) -> Vec<Look> {
    let of = |file: &PathBuf| {
        let data = fs::metadata(file).ok()?;
        Some((data.len(), data.ino(), data.modified().unwrap_or(SystemTime::UNIX_EPOCH)))
    };
    files.iter().map(of).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn sources(text: &str) -> Sources {
        let mappings = [("m.toml".to_owned(), Some("x".to_owned())), ("n.toml".to_owned(), None)].into();
        Sources { name: "/etc/cangate.toml".into(), text: text.into(), mappings }
    }

    #[test]
    fn the_copy_is_replaced_as_a_whole_and_nobody_else_can_read_it() {
        let folder = tempfile::tempdir().unwrap();
        let place = LastGood::if_writable(folder.path()).unwrap();
        assert!(place.read().is_err());
        for text in ["one", "two"] {
            place.keep(&sources(text)).unwrap();
            assert_eq!(place.read().unwrap(), sources(text));
        }
        let file = folder.path().join(FILE);
        assert_eq!(fs::metadata(&file).unwrap().mode() & 0o777, 0o600);
        assert_eq!(fs::read_dir(folder.path()).unwrap().count(), 1, "nothing else stays");
        fs::write(&file, "{\"name\":").unwrap();
        assert!(place.read().is_err(), "half a copy is none");
        assert!(LastGood::if_writable(folder.path().join("none")).is_none());
    }

    #[test]
    fn a_file_has_changed_when_it_stays_as_it_is_for_a_look() {
        let folder = tempfile::tempdir().unwrap();
        let [one, two] = ["one", "two"].map(|name| folder.path().join(name));
        fs::write(&one, "1").unwrap();
        let mut looks = Looks::new(vec![one.clone(), two.clone()]);
        assert!(!looks.have_changed() && !looks.have_changed());
        fs::write(&one, "12").unwrap();
        assert!(!looks.have_changed(), "it may be half written");
        fs::write(&one, "123").unwrap();
        assert!(!looks.have_changed());
        assert!(looks.have_changed());
        looks.take();
        assert!(!looks.have_changed());
        fs::write(&two, "a mapping that was not there").unwrap();
        assert!(!looks.have_changed() && looks.have_changed());
        looks.take();
        let read = Sources { name: one.display().to_string(), text: "0".into(), mappings: BTreeMap::new() };
        assert!(Looks::of(&read).have_changed(), "it changed since it was read");
        assert!(!Looks::of(&Sources { text: "123".into(), ..read }).have_changed());
        fs::remove_file(&one).unwrap();
        assert!(!looks.have_changed() && looks.have_changed());
    }
}
