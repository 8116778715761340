//! A LAWICEL adapter on a serial port or behind TCP. \[IO\]
//!
//! A task of its own opens the port, sets the adapter up (`C`, `S`, `O` or `L`) and then reads and writes side by side. When
//! anything fails, the bus ends with an error and is to be opened again. Once a second the adapter is asked for its
//! status flags (`F`): they tell an error-passive controller, an adapter that answered before and does so no more is
//! given up, and one that refuses has closed its channel. Adapters that always refuse the question or never answer at all
//! are used without it.

use std::io;
use std::sync::Arc;
use std::time::Duration;

use nix::sys::socket::{setsockopt, sockopt};
use tokio::io::{AsyncRead, AsyncWrite};
use tokio::net::TcpStream;
use tokio::sync::{mpsc, watch};
use tokio::time::timeout;
use tokio_util::task::AbortOnDropHandle;

use super::slcan_session::{Adapter, Desk, Failure, converse};
use super::{BusError, BusEvent, BusReader, BusWriter, CanFrame, Tally};
use crate::time::Clock;

/// Events that wait for the reader; then reading waits, and the adapter's own buffer fills.
const EVENTS: usize = 256;
/// Frames that wait for the port; then sending fails.
const FRAMES: usize = 8;
/// How long a TCP connection may take.
const CONNECT_TIME: Duration = Duration::from_secs(3);
/// How long a sender waits for a port that is not open yet, and for a place in the queue.
const SEND_TIME: Duration = Duration::from_millis(500);

/// Opens an adapter on a serial port: the device file, and its speed in baud. Returns at once; the port is opened by a task
/// that ends with the reader.
#[must_use]
pub fn open_serial(adapter: Adapter, device: String, baud: u32, clock: Clock) -> (SlcanReader, SlcanWriter) {
    start(adapter, clock, async move { serial_port(&device, baud) })
}

/// Opens an adapter behind TCP: name or address, without the brackets of IPv6, and port. Returns at once, as
/// [`open_serial`].
#[must_use]
pub fn open_tcp(adapter: Adapter, host: String, port: u16, clock: Clock) -> (SlcanReader, SlcanWriter) {
    start(adapter, clock, async move { connect(&host, port).await })
}

fn start<P: AsyncRead + AsyncWrite + Send + Unpin>(
    adapter: Adapter,
    clock: Clock,
    port: impl Future<Output = Result<P, Failure>> + Send + 'static,
) -> (SlcanReader, SlcanWriter) {
    let name = adapter.name.clone();
    let (events, told) = mpsc::channel(EVENTS);
    let (frames, mut to_send) = mpsc::channel(FRAMES);
    let (opened, is_open) = watch::channel(false);
    let desk = Arc::new(Desk::new(adapter, clock, events));
    let shared = Arc::clone(&desk);
    let task = tokio::spawn(async move {
        let ended = match port.await {
            Ok(port) => converse(&shared, port, &mut to_send, &opened).await,
            Err(failure) => Err(failure),
        };
        let Err(failure) = ended;
        to_send.close();
        shared.give_back(&mut to_send).await;
        // An error here says that nobody reads any more.
        let _ = shared.events.send(Err(failure.into_error(shared.adapter.name.clone()))).await;
    });
    let reader = SlcanReader { desk, events: told, _task: AbortOnDropHandle::new(task) };
    (reader, SlcanWriter { name, frames, is_open })
}

/// The receiving half of an adapter.
#[derive(Debug)]
pub struct SlcanReader {
    desk: Arc<Desk>,
    events: mpsc::Receiver<Result<BusEvent, BusError>>,
    _task: AbortOnDropHandle<()>,
}

impl BusReader for SlcanReader {
    async fn recv(&mut self) -> Result<BusEvent, BusError> {
        let closed = || Err(not_open(&self.desk.adapter.name));
        self.events.recv().await.unwrap_or_else(closed)
    }

    fn tally(&self) -> Tally {
        self.desk.answers().tally()
    }
}

/// The sending half of an adapter.
#[derive(Debug)]
pub struct SlcanWriter {
    name: String,
    frames: mpsc::Sender<CanFrame>,
    is_open: watch::Receiver<bool>,
}

impl BusWriter for SlcanWriter {
    async fn send(&mut self, frame: &CanFrame) -> Result<(), BusError> {
        let opened = timeout(SEND_TIME, self.is_open.wait_for(|open| *open));
        if !opened.await.is_ok_and(|open| open.is_ok()) {
            return Err(not_open(&self.name));
        }
        match timeout(SEND_TIME, self.frames.send(*frame)).await {
            Ok(Ok(())) => Ok(()),
            Ok(Err(_)) => Err(not_open(&self.name)),
            Err(_) => Err(BusError::Busy { interface: self.name.clone() }),
        }
    }
}

fn not_open(name: &str) -> BusError {
    BusError::Io { interface: name.to_owned(), source: io::ErrorKind::NotConnected.into() }
}

#[cfg(feature = "serial")]
fn serial_port(device: &str, baud: u32) -> Result<tokio_serial::SerialStream, Failure> {
    use tokio_serial::SerialPortBuilderExt;
    tokio_serial::new(device, baud).open_native_async().map_err(|error| Failure::gone(error.into()))
}

#[cfg(not(feature = "serial"))]
fn serial_port(_: &str, _: u32) -> Result<TcpStream, Failure> {
    Err(Failure::other("this cangate was built without serial ports (feature `serial`)"))
}

async fn connect(host: &str, port: u16) -> Result<TcpStream, Failure> {
    let connected = timeout(CONNECT_TIME, TcpStream::connect((host, port))).await;
    let stream = connected.unwrap_or_else(|_| Err(io::ErrorKind::TimedOut.into())).map_err(Failure::gone)?;
    configure(&stream).map_err(Failure::gone)?;
    Ok(stream)
}

/// Frames are small and must not wait for each other. An adapter that vanished without a word is noticed after 10 s, also
/// one that answers no questions, and on a bus where nothing is sent.
fn configure(stream: &TcpStream) -> io::Result<()> {
    stream.set_nodelay(true)?;
    setsockopt(stream, sockopt::KeepAlive, &true)?;
    setsockopt(stream, sockopt::TcpKeepIdle, &4)?;
    setsockopt(stream, sockopt::TcpKeepInterval, &2)?;
    setsockopt(stream, sockopt::TcpKeepCount, &3)?;
    setsockopt(stream, sockopt::TcpUserTimeout, &10_000)?;
    Ok(())
}

#[cfg(test)]
#[path = "slcan_port_tests.rs"]
mod tests;
