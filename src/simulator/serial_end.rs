//! Outside ends of simulated serial channels: a pseudo-terminal or a TCP server for each. \[IO\]
//!
//! A wire knows nobody: while nobody has the pseudo-terminal open, or no client is connected, what goes out is lost. Somebody
//! who is there but does not read makes it wait for a while ([`CHUNKS`]); beyond, it is lost and counted. What comes in is
//! taken at the pace of the line, so that whoever sends faster has to wait.

use std::fs::{File, OpenOptions};
use std::io::{self, Read, Write};
use std::os::fd::AsFd;
use std::path::PathBuf;
use std::pin::Pin;
use std::task::{Context, Poll, ready};
use std::time::Duration;

use nix::errno::Errno;
use nix::fcntl::OFlag;
use nix::poll::{PollFd, PollFlags, PollTimeout, poll};
use nix::pty::{PtyMaster, grantpt, posix_openpt, ptsname_r, unlockpt};
use nix::sys::termios::{SetArg, cfmakeraw, tcgetattr, tcsetattr};
use tokio::io::unix::AsyncFd;
use tokio::io::{AsyncRead, AsyncReadExt, AsyncWrite, AsyncWriteExt, ReadBuf, split};
use tokio::net::TcpListener;
use tokio::sync::{mpsc, watch};
use tokio::time::{interval, sleep, timeout};
use tokio_util::task::AbortOnDropHandle;

use super::serial_place::{PlaceKind, SerialPlace};

/// Pieces of output, most of them of one byte, that wait for somebody who does not read: some seconds of a fast line.
pub const CHUNKS: usize = 16 * 1024;
/// Most bytes that are read at once.
const PIECE: usize = 256;
/// How often a pseudo-terminal is looked at that nobody has open.
const OPEN_PERIOD: Duration = Duration::from_millis(50);
/// How long a client that has said its last gets answers.
const LAST_ANSWERS: Duration = Duration::from_secs(1);
/// After a client could not be accepted.
const ACCEPT_PAUSE: Duration = Duration::from_secs(1);

/// An end that is open, but not in use yet.
#[derive(Debug)]
pub struct SerialEnd {
    channel: u8,
    port: Port,
}

#[derive(Debug)]
enum Port {
    Pty(PtyMaster, Link),
    Tcp(TcpListener),
}

/// The name of a pseudo-terminal; it goes when the simulation goes.
#[derive(Debug)]
struct Link {
    path: PathBuf,
    device: PathBuf,
}

impl Drop for Link {
    fn drop(&mut self) {
        if std::fs::read_link(&self.path).is_ok_and(|target| target == self.device) {
            // A name that cannot be removed leads nowhere, and the next simulation replaces it.
            let _ = std::fs::remove_file(&self.path);
        }
    }
}

impl SerialEnd {
    /// Opens the pseudo-terminal, or listens.
    ///
    /// # Errors
    /// What the system says.
    pub async fn open(place: &SerialPlace) -> io::Result<Self> {
        let port = match &place.kind {
            PlaceKind::Pty(path) => open_pty(path.clone())?,
            PlaceKind::Tcp(address) => Port::Tcp(TcpListener::bind(address).await?),
        };
        Ok(Self { channel: place.channel, port })
    }

    /// Its channel, from 1.
    #[must_use]
    pub fn channel(&self) -> u8 {
        self.channel
    }

    /// Where it can be reached.
    #[must_use]
    pub fn describe(&self) -> String {
        match &self.port {
            Port::Pty(_, link) => format!("{} ({})", link.path.display(), link.device.display()),
            Port::Tcp(listener) => listener
                .local_addr()
                .map_or_else(|error| error.to_string(), |address| format!("tcp {address}")),
        }
    }
}

/// A raw terminal, closed on its far side, with a link to it.
fn open_pty(path: PathBuf) -> io::Result<Port> {
    let master = posix_openpt(OFlag::O_RDWR | OFlag::O_NOCTTY | OFlag::O_NONBLOCK)?;
    grantpt(&master)?;
    unlockpt(&master)?;
    let device = PathBuf::from(ptsname_r(&master)?);
    let far_side = OpenOptions::new().read(true).write(true).open(&device)?;
    let mut settings = tcgetattr(&far_side)?;
    cfmakeraw(&mut settings);
    tcsetattr(&far_side, SetArg::TCSANOW, &settings)?;
    if std::fs::symlink_metadata(&path).is_ok_and(|there| there.is_symlink()) {
        std::fs::remove_file(&path)?;
    }
    std::os::unix::fs::symlink(&device, &path)?;
    Ok(Port::Pty(master, Link { path, device }))
}

/// What comes from an end.
#[derive(Debug)]
pub enum Heard {
    /// Bytes for the line.
    Bytes(Vec<u8>),
    /// Something to report.
    Said(String),
}

/// An end in use, as the simulation sees it.
#[derive(Debug)]
pub struct Wire {
    /// From 1.
    pub channel: u8,
    /// Bytes that were taken from it.
    received: u64,
    /// Bytes that it may send in all.
    allowed: watch::Sender<u64>,
    pieces: mpsc::Sender<Vec<u8>>,
    _task: AbortOnDropHandle<()>,
}

impl Wire {
    /// Puts an end into use: what comes from it goes into the queue, with its channel.
    #[must_use]
    pub fn start(end: SerialEnd, heard: mpsc::Sender<(u8, Heard)>) -> Self {
        let (allowed, supply) = watch::channel(0);
        let (pieces, output) = mpsc::channel(CHUNKS);
        let channel = end.channel;
        let far = Far { channel, taken: 0, allowed: supply, heard, output };
        let task = tokio::spawn(async move {
            match end.port {
                Port::Pty(master, link) => far.serve_pty(master, link).await,
                Port::Tcp(listener) => far.serve_tcp(listener).await,
            }
        });
        Self { channel, received: 0, allowed, pieces, _task: AbortOnDropHandle::new(task) }
    }

    /// So many bytes came from it.
    pub fn received(&mut self, bytes: usize) {
        self.received += u64::try_from(bytes).unwrap_or_default();
    }

    /// The line takes so many bytes more.
    pub fn allow(&mut self, room: usize) {
        let total = self.received + u64::try_from(room).unwrap_or_default();
        self.allowed.send_if_modified(|allowed| std::mem::replace(allowed, total.max(*allowed)) < total);
    }

    /// Bytes go out; whether there was a place for them.
    pub fn send(&mut self, bytes: Vec<u8>) -> bool {
        self.pieces.try_send(bytes).is_ok()
    }
}

/// The task's side of an end.
struct Far {
    channel: u8,
    taken: u64,
    allowed: watch::Receiver<u64>,
    heard: mpsc::Sender<(u8, Heard)>,
    output: mpsc::Receiver<Vec<u8>>,
}

impl Far {
    async fn say(&self, text: String) {
        // An error here says that the simulation has ended.
        let _ =
            self.heard.send((self.channel, Heard::Said(format!("channel {}: {text}", self.channel)))).await;
    }

    async fn serve_tcp(mut self, listener: TcpListener) {
        loop {
            let (stream, peer) = tokio::select! {
                accepted = listener.accept() => match accepted {
                    Ok(accepted) => accepted,
                    Err(error) => {
                        self.say(format!("a client could not be accepted: {error}")).await;
                        sleep(ACCEPT_PAUSE).await;
                        continue;
                    }
                },
                lost = self.output.recv() => match lost {
                    Some(_) => continue,
                    None => return,
                },
            };
            // Without it answers only wait longer.
            let _ = stream.set_nodelay(true);
            self.say(format!("{peer} is connected")).await;
            self.converse(stream).await;
            self.say(format!("{peer} has gone")).await;
        }
    }

    async fn serve_pty(mut self, master: PtyMaster, _link: Link) {
        let mut looks = interval(OPEN_PERIOD);
        loop {
            while !is_open(&master) {
                tokio::select! {
                    _ = looks.tick() => {}
                    lost = self.output.recv() => if lost.is_none() { return },
                }
            }
            match PtyPort::new(&master) {
                Ok(port) => {
                    self.say("opened".to_owned()).await;
                    self.converse(port).await;
                    self.say("closed".to_owned()).await;
                }
                Err(error) => {
                    self.say(format!("the pseudo-terminal cannot be used: {error}")).await;
                    return;
                }
            }
        }
    }

    /// Until the other side has gone, or the simulation ends.
    async fn converse(&mut self, port: impl AsyncRead + AsyncWrite) {
        let (reader, writer) = split(port);
        let mut writing = std::pin::pin!(write(writer, &mut self.output));
        let reading = read(reader, self.channel, &mut self.taken, &mut self.allowed, &self.heard);
        tokio::select! {
            () = &mut writing => return,
            () = reading => {}
        }
        // Too late is as good as gone.
        let _ = timeout(LAST_ANSWERS, writing).await;
    }
}

/// Reads as much as the line takes, until the end.
async fn read(
    mut from: impl AsyncRead + Unpin,
    channel: u8,
    taken: &mut u64,
    allowed: &mut watch::Receiver<u64>,
    heard: &mpsc::Sender<(u8, Heard)>,
) {
    let mut buffer = [0; PIECE];
    loop {
        let Ok(allowed) = allowed.wait_for(|allowed| *allowed > *taken).await.map(|allowed| *allowed) else {
            return;
        };
        let Ok(place) = heard.reserve().await else { return };
        let room = usize::try_from(allowed - *taken).unwrap_or(PIECE).min(PIECE);
        let Some(piece) = buffer.get_mut(..room) else { return };
        let Ok(length @ 1..) = from.read(piece).await else { return };
        // Nothing can come between: what is taken is delivered.
        *taken += u64::try_from(length).unwrap_or_default();
        place.send((channel, Heard::Bytes(piece.get(..length).unwrap_or_default().to_vec())));
    }
}

async fn write(mut to: impl AsyncWrite + Unpin, output: &mut mpsc::Receiver<Vec<u8>>) {
    // Pieces may be of one byte, and more of them wait where this task did not get the processor for a while.
    let mut pieces = Vec::new();
    while output.recv_many(&mut pieces, CHUNKS).await > 0 {
        let bytes: Vec<u8> = pieces.drain(..).flatten().collect();
        if to.write_all(&bytes).await.is_err() || to.flush().await.is_err() {
            return;
        }
    }
}

/// Whether somebody has the far side open, or has left something there.
fn is_open(master: &PtyMaster) -> bool {
    let mut looked = [PollFd::new(master.as_fd(), PollFlags::POLLIN)];
    let found = poll(&mut looked, PollTimeout::ZERO).ok().and_then(|_| looked.first()?.revents());
    found.is_some_and(|found| !found.contains(PollFlags::POLLHUP) || found.contains(PollFlags::POLLIN))
}

/// The near side of a pseudo-terminal while somebody has the far side open. A new one for each time: the runtime does not
/// forget that a file was hung up.
struct PtyPort(AsyncFd<File>);

impl PtyPort {
    #[expect(
        deprecated,
        reason = "its successor is unsafe; a file keeps its descriptor, which is all that it asks for"
    )]
    fn new(master: &PtyMaster) -> io::Result<Self> {
        AsyncFd::new(File::from(master.as_fd().try_clone_to_owned()?)).map(Self)
    }
}

impl AsyncRead for PtyPort {
    fn poll_read(
        self: Pin<&mut Self>,
        cx: &mut Context<'_>,
        buffer: &mut ReadBuf<'_>,
    ) -> Poll<io::Result<()>> {
        loop {
            let mut ready = ready!(self.0.poll_read_ready(cx))?;
            match ready.try_io(|file| file.get_ref().read(buffer.initialize_unfilled())) {
                Ok(Ok(length)) => {
                    buffer.advance(length);
                    return Poll::Ready(Ok(()));
                }
                // So the system says that the far side was closed.
                Ok(Err(error)) if error.raw_os_error().map(Errno::from_raw) == Some(Errno::EIO) => {
                    return Poll::Ready(Ok(()));
                }
                Ok(Err(error)) => return Poll::Ready(Err(error)),
                Err(_) => {}
            }
        }
    }
}

impl AsyncWrite for PtyPort {
    fn poll_write(self: Pin<&mut Self>, cx: &mut Context<'_>, bytes: &[u8]) -> Poll<io::Result<usize>> {
        loop {
            let mut ready = ready!(self.0.poll_write_ready(cx))?;
            if let Ok(written) = ready.try_io(|file| file.get_ref().write(bytes)) {
                return Poll::Ready(written);
            }
        }
    }

    fn poll_flush(self: Pin<&mut Self>, _: &mut Context<'_>) -> Poll<io::Result<()>> {
        Poll::Ready(Ok(()))
    }

    fn poll_shutdown(self: Pin<&mut Self>, _: &mut Context<'_>) -> Poll<io::Result<()>> {
        Poll::Ready(Ok(()))
    }
}

#[cfg(test)]
#[path = "serial_end_tests.rs"]
mod tests;
