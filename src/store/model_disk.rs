//! A disk for tests: it can fill up, fail, be killed in the middle of a write, and lose what was not made sure of.

use std::collections::BTreeMap;

use super::disk::{Disk, DiskError};
use super::log::length;

#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub(crate) struct ModelFile {
    pub(crate) bytes: Vec<u8>,
    /// So much of it would outlive a power cut.
    pub(crate) durable: usize,
    /// Its name would.
    pub(crate) named: bool,
}

#[derive(Clone, Debug, Default)]
pub(crate) struct ModelDisk {
    pub(crate) files: BTreeMap<String, ModelFile>,
    /// Removed, and would be there again after a power cut.
    removed: BTreeMap<String, ModelFile>,
    /// Most bytes of all files.
    pub(crate) capacity: Option<usize>,
    /// Every call fails so.
    pub(crate) fault: Option<DiskError>,
    /// Calls that fail, and the beginnings of the names of files for which they do.
    pub(crate) failing: Vec<(&'static str, &'static str)>,
    /// Reading fails, though writing works.
    pub(crate) unreadable: bool,
    /// Calls that change something until the process is killed in one of them.
    pub(crate) kill_in: Option<u64>,
    /// The share of that last write that gets there, in 256ths.
    pub(crate) torn: u8,
    pub(crate) killed: bool,
}

impl ModelDisk {
    fn may_act(&mut self, call: &str, name: &str) -> Result<bool, DiskError> {
        if self.killed {
            return Err(DiskError::Failed("killed".into()));
        }
        if self.is_failing(call, name) {
            return Err(DiskError::Failed(format!("cannot {call}: I/O error")));
        }
        if let Some(fault) = &self.fault {
            return Err(fault.clone());
        }
        let last = match &mut self.kill_in {
            Some(0) => true,
            Some(left) => {
                *left -= 1;
                false
            }
            None => false,
        };
        self.killed = last;
        Ok(!last)
    }

    fn is_failing(&self, call: &str, name: &str) -> bool {
        self.failing.iter().any(|(failing, names)| *failing == call && name.starts_with(names))
    }

    fn killed<T>() -> Result<T, DiskError> {
        Err(DiskError::Failed("killed".into()))
    }

    pub(crate) fn bytes(&self) -> usize {
        self.files.values().map(|file| file.bytes.len()).sum()
    }

    /// The next process: files as the system holds them.
    pub(crate) fn after_kill(&self) -> Self {
        Self { files: self.files.clone(), capacity: self.capacity, ..Self::default() }
    }

    /// The next boot: of what was not made sure of, `share` 256ths are there, then zeros where there is `garbage`.
    pub(crate) fn after_power_cut(&self, share: u8, garbage: bool) -> Self {
        let mut files: BTreeMap<String, ModelFile> = BTreeMap::new();
        for (name, file) in self.files.iter().chain(&self.removed) {
            if !file.named && share < 128 {
                continue;
            }
            let kept = file.durable + (file.bytes.len() - file.durable) * usize::from(share) / 256;
            let mut bytes = file.bytes[..kept].to_vec();
            if garbage {
                bytes.resize(file.bytes.len(), 0);
            }
            files.insert(name.clone(), ModelFile { durable: bytes.len(), bytes, named: true });
        }
        Self { files, capacity: self.capacity, ..Self::default() }
    }
}

impl Disk for ModelDisk {
    fn open(&mut self) -> Result<Vec<(String, u64)>, DiskError> {
        if let Some(fault) = &self.fault {
            return Err(fault.clone());
        }
        Ok(self.files.iter().map(|(name, file)| (name.clone(), length(file.bytes.len()))).collect())
    }

    fn create(&mut self, name: &str) -> Result<(), DiskError> {
        if !self.may_act("create", name)? {
            return Self::killed();
        }
        self.files.insert(name.to_owned(), ModelFile::default());
        Ok(())
    }

    fn append(&mut self, name: &str, bytes: &[u8]) -> Result<(), DiskError> {
        let whole = self.may_act("append", name)?;
        let room = self.capacity.map_or(usize::MAX, |capacity| capacity.saturating_sub(self.bytes()));
        let file = self.files.get_mut(name).ok_or_else(|| DiskError::Failed("no such file".into()))?;
        let torn = bytes.len() * usize::from(self.torn) / 256;
        let taken = if whole { bytes.len() } else { torn }.min(room);
        file.bytes.extend_from_slice(&bytes[..taken]);
        match (whole, taken == bytes.len()) {
            (true, true) => Ok(()),
            (true, false) => Err(DiskError::Full("no space left on device".into())),
            (false, _) => Self::killed(),
        }
    }

    fn sync(&mut self, name: &str) -> Result<(), DiskError> {
        if !self.may_act("sync", name)? {
            return Self::killed();
        }
        let file = self.files.get_mut(name).ok_or_else(|| DiskError::Failed("no such file".into()))?;
        file.durable = file.bytes.len();
        self.files.values_mut().for_each(|file| file.named = true);
        self.removed.clear();
        Ok(())
    }

    fn read(&mut self, name: &str, offset: u64, most: usize) -> Result<Vec<u8>, DiskError> {
        if self.killed {
            return Self::killed();
        }
        if let Some(fault) = &self.fault {
            return Err(fault.clone());
        }
        if self.unreadable || self.is_failing("read", name) {
            return Err(DiskError::Failed("I/O error".into()));
        }
        let file = self.files.get(name).ok_or_else(|| DiskError::Failed("no such file".into()))?;
        let offset = usize::try_from(offset).unwrap().min(file.bytes.len());
        Ok(file.bytes[offset..file.bytes.len().min(offset.saturating_add(most))].to_vec())
    }

    fn remove(&mut self, name: &str) -> Result<(), DiskError> {
        if !self.may_act("remove", name)? {
            return Self::killed();
        }
        if let Some(file) = self.files.remove(name) {
            self.removed.insert(name.to_owned(), file);
        }
        Ok(())
    }
}
