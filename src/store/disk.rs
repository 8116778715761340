//! What the store asks of a disk.

/// Why the disk did not do it.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum DiskError {
    /// No room.
    #[error("{0}")]
    Full(String),
    /// Anything else: read-only, broken, not allowed, gone.
    #[error("{0}")]
    Failed(String),
}

/// A folder of files that only grow. Names are ASCII.
pub trait Disk {
    /// Makes the folder usable by this process alone, and gives its files: name and length in bytes.
    ///
    /// # Errors
    /// It cannot be made or read, or another process uses it.
    fn open(&mut self) -> Result<Vec<(String, u64)>, DiskError>;

    /// Makes an empty file; one of this name is emptied.
    ///
    /// # Errors
    /// As the system says.
    fn create(&mut self, name: &str) -> Result<(), DiskError>;

    /// Adds bytes at the end of a file. When it fails, any part of them may be there.
    ///
    /// # Errors
    /// As the system says.
    fn append(&mut self, name: &str, bytes: &[u8]) -> Result<(), DiskError>;

    /// Returns when a file and its name would outlive a power cut.
    ///
    /// # Errors
    /// As the system says; then it is unknown what of it would.
    fn sync(&mut self, name: &str) -> Result<(), DiskError>;

    /// Reads at most `most` bytes from `offset`; fewer only at the end of the file.
    ///
    /// # Errors
    /// As the system says.
    fn read(&mut self, name: &str, offset: u64, most: usize) -> Result<Vec<u8>, DiskError>;

    /// Removes a file. After a power cut it may be there again.
    ///
    /// # Errors
    /// As the system says.
    fn remove(&mut self, name: &str) -> Result<(), DiskError>;
}

/// No disk, for a store in memory alone, which calls none of these. Every call fails.
#[derive(Clone, Copy, Debug, Default)]
pub struct NoDisk;

impl NoDisk {
    fn none<T>() -> Result<T, DiskError> {
        Err(DiskError::Failed("there is no disk".to_owned()))
    }
}

impl Disk for NoDisk {
    fn open(&mut self) -> Result<Vec<(String, u64)>, DiskError> {
        Self::none()
    }

    fn create(&mut self, _: &str) -> Result<(), DiskError> {
        Self::none()
    }

    fn append(&mut self, _: &str, _: &[u8]) -> Result<(), DiskError> {
        Self::none()
    }

    fn sync(&mut self, _: &str) -> Result<(), DiskError> {
        Self::none()
    }

    fn read(&mut self, _: &str, _: u64, _: usize) -> Result<Vec<u8>, DiskError> {
        Self::none()
    }

    fn remove(&mut self, _: &str) -> Result<(), DiskError> {
        Self::none()
    }
}
