//! A LAWICEL adapter on a serial port or behind TCP. \[IO\]
//!
//! A task of its own opens the port, sets the adapter up (`C`, `S`, `O`) and then reads and writes side by side. When
//! anything fails, the bus ends with an error and is to be opened again. Once a second the adapter is asked for its
//! status flags (`F`): they tell an error-passive controller, and an adapter that answered before and does so no more is
//! given up. Adapters that refuse the question or never answer at all are used without it.

use std::collections::VecDeque;
use std::io;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use tokio::io::{AsyncRead, AsyncReadExt, AsyncWrite, AsyncWriteExt};
use tokio::net::TcpStream;
use tokio::sync::{mpsc, watch};
use tokio::time::{MissedTickBehavior, interval, timeout};
use tokio_util::task::AbortOnDropHandle;

use super::controller::{ErrorReport, LinkTracker};
use super::interface::Interface;
use super::slcan::{Decoder, Flags, Incoming, bit_rate_command, encode};
use super::{BusError, BusEvent, BusReader, BusWriter, CanFrame, Link, Tally};
use crate::time::{Clock, Instant, Now};

/// Events that wait for the reader; then reading waits, and the adapter's own buffer fills.
const EVENTS: usize = 256;
/// Frames that wait for the port; then sending fails.
const FRAMES: usize = 8;
/// How long a TCP connection may take.
const CONNECT_TIME: Duration = Duration::from_secs(3);
/// An adapter that has not answered a command by now never answers.
const ANSWER_TIME: Duration = Duration::from_millis(300);
/// After closing the channel, silence of this length means that the adapter has said all it had to.
const SILENCE: Duration = Duration::from_millis(50);
/// How long the adapter may go on after it was told to be silent.
const LONGEST_CHATTER: Duration = Duration::from_millis(500);
/// How long the port may take one frame.
const WRITE_TIME: Duration = Duration::from_secs(1);
/// How long a sender waits for a port that is not open yet, and for a place in the queue.
const SEND_TIME: Duration = Duration::from_millis(500);
/// How often the status flags are asked for.
const FLAGS_EVERY: Duration = Duration::from_secs(1);
/// Unanswered questions for the flags after which an adapter that had answered is taken for dead.
const LOST_ANSWERS: u32 = 3;
/// An answer that is not there by now does not come.
const FORGET_AFTER: Duration = Duration::from_secs(2);
/// Commands that may await their answers.
const OPEN_COMMANDS: usize = 64;

/// Opens a LAWICEL adapter; returns at once. The port is opened by a task that ends with the reader.
#[must_use]
pub fn open(interface: &Interface, clock: Clock) -> (SlcanReader, SlcanWriter) {
    let name = interface.to_string();
    let (events, told) = mpsc::channel(EVENTS);
    let (frames, to_send) = mpsc::channel(FRAMES);
    let (opened, is_open) = watch::channel(false);
    let desk = Arc::new(Desk { name: name.clone(), clock, events, state: Mutex::default() });
    let shared = Arc::clone(&desk);
    let interface = interface.clone();
    let task = tokio::spawn(async move {
        let error = drive(&shared, &interface, to_send, &opened).await;
        let source = error.source;
        let interface = shared.name.clone();
        let error = if error.absent {
            BusError::Absent { interface, source }
        } else {
            BusError::Io { interface, source }
        };
        // An error here says that nobody reads any more.
        let _ = shared.events.send(Err(error)).await;
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
        let closed = || Err(not_open(&self.desk.name));
        self.events.recv().await.unwrap_or_else(closed)
    }

    fn tally(&self) -> Tally {
        self.desk.state().tally
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

/// What the halves and the task share.
#[derive(Debug)]
struct Desk {
    name: String,
    clock: Clock,
    events: mpsc::Sender<Result<BusEvent, BusError>>,
    state: Mutex<State>,
}

#[derive(Debug, Default)]
struct State {
    tally: Tally,
    /// Commands in the order in which they were sent; answers come in the same order and bear no name.
    commands: VecDeque<(Command, Instant)>,
    flags: Asking,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Command {
    Send(CanFrame),
    AskFlags,
}

/// What is known about an adapter's answers to `F`.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Asking {
    /// Has never answered; was asked this often.
    New(u32),
    /// Has answered; since then was asked this often in vain.
    Answers(u32),
    /// Refuses the question, or does not know it.
    Never,
}

impl Default for Asking {
    fn default() -> Self {
        Self::New(0)
    }
}

/// Why the task ends.
struct Failure {
    /// There is nothing to talk to.
    absent: bool,
    source: io::Error,
}

impl Failure {
    fn gone(source: io::Error) -> Self {
        Self { absent: true, source }
    }

    fn other(text: impl Into<String>) -> Self {
        Self { absent: false, source: io::Error::other(text.into()) }
    }
}

impl Desk {
    fn state(&self) -> MutexGuard<'_, State> {
        // The state is whole after every statement, so a panic elsewhere leaves a good one.
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// An error here says that nobody reads any more; the task is about to be stopped.
    async fn tell(&self, event: BusEvent) {
        let _ = self.events.send(Ok(event)).await;
    }
}

async fn drive(
    desk: &Desk,
    interface: &Interface,
    to_send: mpsc::Receiver<CanFrame>,
    opened: &watch::Sender<bool>,
) -> Failure {
    let ended = match interface {
        Interface::Slcan { device, bit_rate, baud } => match open_serial(device, *baud) {
            Ok(port) => converse(desk, port, Some(*bit_rate), to_send, opened).await,
            Err(failure) => Err(failure),
        },
        Interface::SlcanTcp { host, port, bit_rate } => match connect(host, *port).await {
            Ok(port) => converse(desk, port, *bit_rate, to_send, opened).await,
            Err(failure) => Err(failure),
        },
        Interface::SocketCan(_) | Interface::Virtual(_) => Err(Failure::other("this is no LAWICEL adapter")),
    };
    let Err(failure) = ended;
    failure
}

#[cfg(feature = "serial")]
fn open_serial(device: &str, baud: u32) -> Result<tokio_serial::SerialStream, Failure> {
    use tokio_serial::SerialPortBuilderExt;
    tokio_serial::new(device, baud).open_native_async().map_err(|error| Failure::gone(error.into()))
}

#[cfg(not(feature = "serial"))]
fn open_serial(_: &str, _: u32) -> Result<TcpStream, Failure> {
    Err(Failure::other("this cangate was built without serial ports (feature `serial`)"))
}

async fn connect(host: &str, port: u16) -> Result<TcpStream, Failure> {
    let stream = timeout(CONNECT_TIME, TcpStream::connect((host, port)))
        .await
        .unwrap_or_else(|_| Err(io::ErrorKind::TimedOut.into()))
        .map_err(Failure::gone)?;
    // Frames are small and must not wait for each other.
    stream.set_nodelay(true).map_err(Failure::gone)?;
    Ok(stream)
}

/// Sets the adapter up, then talks with it until that fails.
async fn converse<P: AsyncRead + AsyncWrite + Send + Unpin>(
    desk: &Desk,
    mut port: P,
    bit_rate: Option<u32>,
    to_send: mpsc::Receiver<CanFrame>,
    opened: &watch::Sender<bool>,
) -> Result<std::convert::Infallible, Failure> {
    let mut decoder = Decoder::default();
    port.write_all(b"\rC\r").await.map_err(Failure::gone)?;
    await_silence(&mut port).await?;
    if let Some(bit_rate) = bit_rate {
        let command = bit_rate_command(bit_rate)
            .ok_or_else(|| Failure::other(format!("no LAWICEL adapter has the bit rate {bit_rate}")))?;
        ask(&mut port, &mut decoder, &command).await?;
    }
    let first = ask(&mut port, &mut decoder, "O").await?;
    desk.state().tally.bit_rate = bit_rate;
    let mut tracker = LinkTracker::default();
    tracker.handle_frame();
    desk.tell(BusEvent::Link { link: Link::ErrorActive, at: desk.clock.now() }).await;
    opened.send_replace(true);
    if let Some(frame) = first {
        desk.tell(BusEvent::Frame { frame, at: desk.clock.now() }).await;
    }
    let (input, output) = tokio::io::split(port);
    let ended = tokio::select! {
        ended = read_for_ever(desk, input, decoder, tracker) => ended,
        ended = write_for_ever(desk, output, to_send) => ended,
    };
    opened.send_replace(false);
    ended
}

/// Throws away what an adapter says that was in the middle of something.
async fn await_silence<P: AsyncRead + Unpin>(port: &mut P) -> Result<(), Failure> {
    let mut thrown_away = [0; 1_024];
    let chatter = async {
        while let Ok(read) = timeout(SILENCE, port.read(&mut thrown_away)).await {
            if read.map_err(Failure::gone)? == 0 {
                return Err(closed());
            }
        }
        Ok(())
    };
    timeout(LONGEST_CHATTER, chatter).await.unwrap_or(Ok(()))
}

/// Sends a command and waits for its answer, or for a frame, which shows that the channel is open, or until it is clear
/// that this adapter does not answer.
async fn ask<P: AsyncRead + AsyncWrite + Unpin>(
    port: &mut P,
    decoder: &mut Decoder,
    command: &str,
) -> Result<Option<CanFrame>, Failure> {
    port.write_all(format!("{command}\r").as_bytes()).await.map_err(Failure::gone)?;
    let answer = async {
        loop {
            let byte = match port.read_u8().await {
                Ok(byte) => byte,
                Err(error) if error.kind() == io::ErrorKind::UnexpectedEof => return Err(closed()),
                Err(error) => return Err(Failure::gone(error)),
            };
            match decoder.push(byte) {
                Some(Incoming::Done) => return Ok(None),
                Some(Incoming::Frame(frame)) => return Ok(Some(frame)),
                Some(Incoming::Refused) => {
                    return Err(Failure::other(format!("the adapter refuses the command `{command}`")));
                }
                Some(
                    Incoming::Fd
                    | Incoming::Sent
                    | Incoming::Flags(_)
                    | Incoming::State(_)
                    | Incoming::BusError
                    | Incoming::Garbage,
                )
                | None => {}
            }
        }
    };
    timeout(ANSWER_TIME, answer).await.unwrap_or_else(|_| {
        tracing::debug!(command, "the adapter does not answer; going on without");
        Ok(None)
    })
}

fn closed() -> Failure {
    Failure::gone(io::Error::new(io::ErrorKind::UnexpectedEof, "the adapter closed the connection"))
}

async fn read_for_ever<R: AsyncRead + Unpin>(
    desk: &Desk,
    mut input: R,
    mut decoder: Decoder,
    mut tracker: LinkTracker,
) -> Result<std::convert::Infallible, Failure> {
    let mut bytes = [0; 4_096];
    loop {
        let read = input.read(&mut bytes).await.map_err(Failure::gone)?;
        if read == 0 {
            return Err(closed());
        }
        let now = desk.clock.now();
        for byte in bytes.get(..read).unwrap_or_default() {
            let Some(incoming) = decoder.push(*byte) else { continue };
            let (link, event) = desk.handle(incoming, &mut tracker, now);
            if let Some(link) = link {
                desk.tell(BusEvent::Link { link, at: now }).await;
            }
            if let Some(event) = event {
                desk.tell(event).await;
            }
        }
    }
}

impl Desk {
    /// What an answer changes of the link, and what else it tells.
    fn handle(
        &self,
        incoming: Incoming,
        tracker: &mut LinkTracker,
        now: Now,
    ) -> (Option<Link>, Option<BusEvent>) {
        let mut state = self.state();
        match incoming {
            Incoming::Frame(frame) => (tracker.handle_frame(), Some(BusEvent::Frame { frame, at: now })),
            Incoming::Fd => {
                state.tally.fd_frames = state.tally.fd_frames.saturating_add(1);
                (None, None)
            }
            Incoming::BusError => {
                state.tally.error_frames = state.tally.error_frames.saturating_add(1);
                (None, None)
            }
            Incoming::State(link) => (tell(tracker, link), None),
            Incoming::Flags(flags) => {
                state.handle_flags(flags);
                let link = if flags.error_passive() { Link::ErrorPassive } else { Link::ErrorActive };
                // The flags do not know bus-off.
                if tracker.link() == Link::BusOff { (None, None) } else { (tell(tracker, link), None) }
            }
            Incoming::Done | Incoming::Sent => {
                state.answered(now.instant);
                (None, None)
            }
            Incoming::Refused => match state.answered(now.instant) {
                Some(Command::Send(frame)) => (None, Some(BusEvent::NotSent { frame, at: now })),
                Some(Command::AskFlags) => {
                    state.flags = Asking::Never;
                    (None, None)
                }
                None => (None, None),
            },
            Incoming::Garbage => {
                tracing::debug!(interface = self.name, "the adapter sent a line that means nothing");
                (None, None)
            }
        }
    }
}

fn tell(tracker: &mut LinkTracker, link: Link) -> Option<Link> {
    tracker.handle_error(ErrorReport { link: Some(link), is_error: false })
}

impl State {
    fn handle_flags(&mut self, flags: Flags) {
        self.flags = Asking::Answers(0);
        while self.commands.pop_front().is_some_and(|(command, _)| command != Command::AskFlags) {}
        let tally = &mut self.tally;
        tally.overruns = tally.overruns.saturating_add(u64::from(flags.lost_frames()));
        tally.error_frames = tally.error_frames.saturating_add(u64::from(flags.bus_error()));
    }

    /// The command that an answer without a name belongs to.
    fn answered(&mut self, now: Instant) -> Option<Command> {
        self.forget(now);
        self.commands.pop_front().map(|(command, _)| command)
    }

    fn sent(&mut self, command: Command, now: Instant) {
        self.forget(now);
        if self.commands.len() < OPEN_COMMANDS {
            self.commands.push_back((command, now));
        }
    }

    /// Answers that did not come: many adapters are silent about frames that they took.
    fn forget(&mut self, now: Instant) {
        while self.commands.front().is_some_and(|(_, sent)| now.since(*sent) > FORGET_AFTER) {
            self.commands.pop_front();
        }
    }

    /// Whether to ask for the flags now.
    fn ask_flags(&mut self) -> Result<bool, Failure> {
        match &mut self.flags {
            Asking::New(in_vain) if *in_vain >= LOST_ANSWERS => self.flags = Asking::Never,
            Asking::Answers(in_vain) if *in_vain >= LOST_ANSWERS => {
                let text = "the adapter does not answer any more";
                return Err(Failure::gone(io::Error::new(io::ErrorKind::TimedOut, text)));
            }
            Asking::New(in_vain) | Asking::Answers(in_vain) => *in_vain += 1,
            Asking::Never => {}
        }
        Ok(self.flags != Asking::Never)
    }
}

async fn write_for_ever<W: AsyncWrite + Unpin>(
    desk: &Desk,
    mut output: W,
    mut to_send: mpsc::Receiver<CanFrame>,
) -> Result<std::convert::Infallible, Failure> {
    let mut flags = interval(FLAGS_EVERY);
    flags.set_missed_tick_behavior(MissedTickBehavior::Delay);
    let mut line = String::new();
    loop {
        line.clear();
        let command = tokio::select! {
            Some(frame) = to_send.recv() => {
                encode(&frame, &mut line);
                Command::Send(frame)
            }
            _ = flags.tick() => {
                if !desk.state().ask_flags()? {
                    continue;
                }
                line.push_str("F\r");
                Command::AskFlags
            }
        };
        desk.state().sent(command, desk.clock.now().instant);
        timeout(WRITE_TIME, output.write_all(line.as_bytes()))
            .await
            .unwrap_or_else(|_| Err(io::ErrorKind::TimedOut.into()))
            .map_err(Failure::gone)?;
    }
}

#[cfg(test)]
#[path = "slcan_port_tests.rs"]
mod tests;
