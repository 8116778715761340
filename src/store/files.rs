//! A folder on a real disk. \[IO\]

use std::fs::{self, File, OpenOptions};
use std::io::{self, ErrorKind, Read as _, Seek as _, SeekFrom, Write as _};
use std::path::{Path, PathBuf};

use nix::fcntl::{Flock, FlockArg};

use super::disk::{Disk, DiskError};

/// The file whose lock says that a process uses the folder.
const LOCK: &str = "lock";
/// Files that are being written: one of each class.
const MOST_OPEN: usize = 2;

/// A folder of this process alone.
#[derive(Debug)]
pub struct Files {
    folder: PathBuf,
    lock: Option<Flock<File>>,
    /// Those that are appended to, newest last.
    writing: Vec<(String, File)>,
    /// The one that was read last.
    reading: Option<(String, File)>,
    /// Files whose names may not outlive a power cut yet.
    unnamed: bool,
}

impl Files {
    /// A folder that need not be there yet.
    #[must_use]
    pub fn new(folder: &Path) -> Self {
        Self { folder: folder.to_owned(), lock: None, writing: Vec::new(), reading: None, unnamed: false }
    }

    fn told(&self, what: &str, error: &io::Error) -> DiskError {
        let text = format!("cannot {what} `{}`: {error}", self.folder.display());
        let full = [ErrorKind::StorageFull, ErrorKind::QuotaExceeded, ErrorKind::FileTooLarge];
        if full.contains(&error.kind()) { DiskError::Full(text) } else { DiskError::Failed(text) }
    }

    fn take_lock(&mut self) -> Result<(), DiskError> {
        if self.lock.is_some() {
            return Ok(());
        }
        let path = self.folder.join(LOCK);
        let file = OpenOptions::new().create(true).truncate(false).write(true).open(path);
        let file = file.map_err(|error| self.told("use", &error))?;
        let locked = Flock::lock(file, FlockArg::LockExclusiveNonblock).map_err(|_| {
            DiskError::Failed(format!(
                "another process uses `{}`: give each gateway its own folder",
                self.folder.display()
            ))
        })?;
        self.lock = Some(locked);
        Ok(())
    }

    fn writer(&mut self, name: &str) -> io::Result<&mut File> {
        if let Some(place) = self.writing.iter().position(|(open, _)| open == name) {
            let found = self.writing.remove(place);
            self.writing.push(found);
        } else {
            let file = OpenOptions::new().append(true).open(self.folder.join(name))?;
            self.keep(name, file);
        }
        self.writing.last_mut().map(|(_, file)| file).ok_or_else(|| ErrorKind::NotFound.into())
    }

    fn keep(&mut self, name: &str, file: File) {
        self.writing.retain(|(open, _)| open != name);
        if self.writing.len() >= MOST_OPEN {
            self.writing.remove(0);
        }
        self.writing.push((name.to_owned(), file));
    }

    fn read_from(&mut self, name: &str, offset: u64, most: usize) -> io::Result<Vec<u8>> {
        if self.reading.as_ref().is_none_or(|(open, _)| open != name) {
            self.reading = Some((name.to_owned(), File::open(self.folder.join(name))?));
        }
        let Some((_, file)) = &mut self.reading else { return Ok(Vec::new()) };
        file.seek(SeekFrom::Start(offset))?;
        let mut bytes = Vec::new();
        file.take(u64::try_from(most).unwrap_or(u64::MAX)).read_to_end(&mut bytes)?;
        Ok(bytes)
    }
}

impl Disk for Files {
    fn open(&mut self) -> Result<Vec<(String, u64)>, DiskError> {
        fs::create_dir_all(&self.folder).map_err(|error| self.told("make", &error))?;
        self.take_lock()?;
        let list = || -> io::Result<Vec<(String, u64)>> {
            let mut files = Vec::new();
            for entry in fs::read_dir(&self.folder)? {
                let entry = entry?;
                let about = entry.metadata()?;
                if let (Ok(name), true) = (entry.file_name().into_string(), about.is_file()) {
                    files.push((name, about.len()));
                }
            }
            files.sort();
            Ok(files)
        };
        list().map_err(|error| self.told("list", &error))
    }

    fn create(&mut self, name: &str) -> Result<(), DiskError> {
        let path = self.folder.join(name);
        let file = OpenOptions::new().create(true).append(true).open(path);
        let emptied = file.and_then(|file| file.set_len(0).map(|()| file));
        let file = emptied.map_err(|error| self.told("write into", &error))?;
        self.keep(name, file);
        self.unnamed = true;
        Ok(())
    }

    fn append(&mut self, name: &str, bytes: &[u8]) -> Result<(), DiskError> {
        let written = self.writer(name).and_then(|file| file.write_all(bytes));
        written.map_err(|error| self.told("write into", &error))
    }

    fn sync(&mut self, name: &str) -> Result<(), DiskError> {
        let mut synced = self.writer(name).and_then(|file| file.sync_data());
        if self.unnamed && synced.is_ok() {
            synced = File::open(&self.folder).and_then(|folder| folder.sync_all());
            self.unnamed = synced.is_err();
        }
        synced.map_err(|error| self.told("make sure of what was written into", &error))
    }

    fn read(&mut self, name: &str, offset: u64, most: usize) -> Result<Vec<u8>, DiskError> {
        let read = self.read_from(name, offset, most);
        if read.is_err() {
            self.reading = None;
        }
        read.map_err(|error| self.told("read from", &error))
    }

    fn remove(&mut self, name: &str) -> Result<(), DiskError> {
        self.writing.retain(|(open, _)| open != name);
        self.reading = self.reading.take().filter(|(open, _)| open != name);
        match fs::remove_file(self.folder.join(name)) {
            Err(error) if error.kind() != ErrorKind::NotFound => Err(self.told("remove from", &error)),
            Ok(()) | Err(_) => Ok(()),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_written_is_read_and_a_second_process_is_kept_out() {
        let folder = tempfile::tempdir().unwrap();
        let place = folder.path().join("deep/buffer");
        let mut disk = Files::new(&place);
        assert_eq!(disk.open().unwrap(), [("lock".to_owned(), 0)]);
        disk.create("a.log").unwrap();
        disk.append("a.log", b"hello ").unwrap();
        disk.append("a.log", b"world").unwrap();
        disk.sync("a.log").unwrap();
        assert_eq!(disk.read("a.log", 6, 3).unwrap(), b"wor");
        assert_eq!(disk.read("a.log", 6, 30).unwrap(), b"world");
        assert_eq!(disk.read("a.log", 600, 30).unwrap(), b"");
        let refused = Files::new(&place).open().unwrap_err();
        assert!(refused.to_string().contains("another process"), "{refused}");
        drop(disk);
        let mut again = Files::new(&place);
        assert_eq!(again.open().unwrap(), [("a.log".to_owned(), 11), ("lock".to_owned(), 0)]);
        again.remove("a.log").unwrap();
        again.remove("a.log").unwrap();
        assert!(again.read("a.log", 0, 1).is_err());
    }
}
