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
mod tests {
    use tokio::io::{AsyncBufReadExt, BufReader, DuplexStream};

    use super::*;

    /// The test's side of an adapter in memory.
    struct Adapter<P> {
        port: BufReader<P>,
    }

    impl<P: AsyncRead + AsyncWrite + Unpin> Adapter<P> {
        fn new(port: P) -> Self {
            Self { port: BufReader::new(port) }
        }

        /// The next command, without its carriage return; questions for flags are not answered.
        async fn command(&mut self) -> String {
            loop {
                let mut line = Vec::new();
                self.port.read_until(b'\r', &mut line).await.unwrap();
                assert_eq!(line.pop(), Some(b'\r'), "the gateway hung up");
                let line = String::from_utf8(line).unwrap();
                if !line.is_empty() && line != "F" {
                    return line;
                }
            }
        }

        async fn say(&mut self, text: &str) {
            self.port.get_mut().write_all(text.as_bytes()).await.unwrap();
        }

        /// Answers the commands that open the channel.
        async fn set_up(&mut self, bit_rate: Option<&str>) {
            assert_eq!(self.command().await, "C");
            // Refused, as it was not open; and a frame that was on its way.
            self.say("\x07t7FF0\r").await;
            if let Some(command) = bit_rate {
                assert_eq!(self.command().await, command);
                self.say("\r").await;
            }
            assert_eq!(self.command().await, "O");
            self.say("\r").await;
        }
    }

    /// The task's side, on a port in memory.
    fn on_duplex(bit_rate: Option<u32>) -> (Adapter<DuplexStream>, SlcanReader, SlcanWriter) {
        let (near, far) = tokio::io::duplex(1_024);
        let (events, told) = mpsc::channel(EVENTS);
        let (frames, to_send) = mpsc::channel(FRAMES);
        let (opened, is_open) = watch::channel(false);
        let name = "slcan:test".to_owned();
        let desk =
            Arc::new(Desk { name: name.clone(), clock: Clock::start(), events, state: Mutex::default() });
        let shared = Arc::clone(&desk);
        let task = tokio::spawn(async move {
            let Err(Failure { source, .. }) = converse(&shared, near, bit_rate, to_send, &opened).await;
            let interface = shared.name.clone();
            let _ = shared.events.send(Err(BusError::Absent { interface, source })).await;
        });
        let reader = SlcanReader { desk, events: told, _task: AbortOnDropHandle::new(task) };
        (Adapter::new(far), reader, SlcanWriter { name, frames, is_open })
    }

    async fn next_link(reader: &mut SlcanReader) -> Link {
        match reader.recv().await.unwrap() {
            BusEvent::Link { link, .. } => link,
            BusEvent::Frame { frame, .. } => panic!("{frame}"),
            BusEvent::NotSent { .. } | BusEvent::Counters { .. } => panic!("no link"),
        }
    }

    async fn next_frame(reader: &mut SlcanReader) -> String {
        match reader.recv().await.unwrap() {
            BusEvent::Frame { frame, .. } => frame.to_string(),
            BusEvent::Link { link, .. } => panic!("{link:?}"),
            BusEvent::NotSent { .. } | BusEvent::Counters { .. } => panic!("no frame"),
        }
    }

    fn frame(text: &str) -> CanFrame {
        text.parse().unwrap()
    }

    #[tokio::test(start_paused = true)]
    async fn r_det_089_the_adapter_is_closed_set_to_its_bit_rate_and_opened() {
        let (mut adapter, mut reader, _writer) = on_duplex(Some(125_000));
        adapter.set_up(Some("S4")).await;
        assert_eq!(next_link(&mut reader).await, Link::ErrorActive);
        assert_eq!(reader.tally().bit_rate, Some(125_000));
    }

    #[tokio::test(start_paused = true)]
    async fn frames_go_both_ways() {
        let (mut adapter, mut reader, mut writer) = on_duplex(None);
        adapter.set_up(None).await;
        adapter.say("t18120102\rr70").await;
        adapter.say("11\rT000001810\r").await;
        assert_eq!(next_link(&mut reader).await, Link::ErrorActive);
        assert_eq!(next_frame(&mut reader).await, "181#0102");
        assert_eq!(next_frame(&mut reader).await, "701#R1");
        assert_eq!(next_frame(&mut reader).await, "00000181#");
        writer.send(&frame("701#R1")).await.unwrap();
        writer.send(&frame("000#0101")).await.unwrap();
        assert_eq!(adapter.command().await, "r7011");
        assert_eq!(adapter.command().await, "t00020101");
    }

    #[tokio::test(start_paused = true)]
    async fn an_adapter_that_never_answers_is_used_all_the_same() {
        let (mut adapter, mut reader, mut writer) = on_duplex(Some(250_000));
        for command in ["C", "S5", "O"] {
            assert_eq!(adapter.command().await, command);
        }
        assert_eq!(next_link(&mut reader).await, Link::ErrorActive);
        tokio::time::sleep(Duration::from_secs(60)).await;
        adapter.say("t18110A\r").await;
        assert_eq!(next_frame(&mut reader).await, "181#0A");
        writer.send(&frame("000#0101")).await.unwrap();
        assert_eq!(adapter.command().await, "t00020101");
    }

    #[tokio::test(start_paused = true)]
    async fn a_refused_bit_rate_ends_the_bus_and_names_the_command() {
        let (mut adapter, mut reader, _writer) = on_duplex(Some(800_000));
        assert_eq!(adapter.command().await, "C");
        assert_eq!(adapter.command().await, "S7");
        adapter.say("\x07").await;
        let error = reader.recv().await.unwrap_err().to_string();
        assert!(error.contains("refuses the command `S7`"), "{error}");
    }

    #[tokio::test(start_paused = true)]
    async fn p20_a_frame_that_the_adapter_refuses_is_given_back() {
        let (mut adapter, mut reader, mut writer) = on_duplex(None);
        adapter.set_up(None).await;
        assert_eq!(next_link(&mut reader).await, Link::ErrorActive);
        adapter.say("F00\r").await;
        for text in ["000#0101", "701#R1", "000#0102"] {
            writer.send(&frame(text)).await.unwrap();
            adapter.command().await;
        }
        adapter.say("z\r\x07\r").await;
        let event = reader.recv().await.unwrap();
        assert!(matches!(event, BusEvent::NotSent { frame: back, .. } if back == frame("701#R1")));
    }

    #[tokio::test(start_paused = true)]
    async fn status_flags_tell_error_passive_errors_and_losses() {
        let (mut adapter, mut reader, _writer) = on_duplex(None);
        adapter.set_up(None).await;
        assert_eq!(next_link(&mut reader).await, Link::ErrorActive);
        adapter.say("FA8\r").await;
        assert_eq!(next_link(&mut reader).await, Link::ErrorPassive);
        adapter.say("F00\r").await;
        assert_eq!(next_link(&mut reader).await, Link::ErrorActive);
        let tally = reader.tally();
        assert_eq!((tally.error_frames, tally.overruns), (1, 1));
    }

    #[tokio::test(start_paused = true)]
    async fn bus_off_ends_with_the_next_frame() {
        let (mut adapter, mut reader, _writer) = on_duplex(None);
        adapter.set_up(None).await;
        assert_eq!(next_link(&mut reader).await, Link::ErrorActive);
        adapter.say("sb000256\rF00\rt1810\r").await;
        assert_eq!(next_link(&mut reader).await, Link::BusOff);
        assert_eq!(next_link(&mut reader).await, Link::ErrorActive);
        assert_eq!(next_frame(&mut reader).await, "181#");
    }

    #[tokio::test(start_paused = true)]
    async fn an_adapter_that_stops_answering_is_given_up() {
        let (mut adapter, mut reader, _writer) = on_duplex(None);
        adapter.set_up(None).await;
        assert_eq!(next_link(&mut reader).await, Link::ErrorActive);
        adapter.say("F00\r").await;
        let error = reader.recv().await.unwrap_err().to_string();
        assert!(error.contains("does not answer any more"), "{error}");
    }

    #[tokio::test(start_paused = true)]
    async fn p20_nothing_is_queued_for_an_adapter_that_is_not_open() {
        let (frames, mut to_send) = mpsc::channel(FRAMES);
        let (_opened, is_open) = watch::channel(false);
        let mut writer = SlcanWriter { name: "slcan:test".into(), frames, is_open };
        assert!(writer.send(&frame("701#R1")).await.is_err());
        assert!(to_send.try_recv().is_err());
    }

    #[tokio::test]
    async fn an_adapter_behind_tcp_is_reached_and_its_end_is_noticed() {
        let listener = tokio::net::TcpListener::bind("127.0.0.1:0").await.unwrap();
        let text = format!("slcan+tcp://{}?bitrate=500000", listener.local_addr().unwrap());
        let (mut reader, mut writer) = open(&text.parse().unwrap(), Clock::start());
        let mut adapter = Adapter::new(listener.accept().await.unwrap().0);
        adapter.set_up(Some("S6")).await;
        assert_eq!(next_link(&mut reader).await, Link::ErrorActive);
        writer.send(&frame("000#0101")).await.unwrap();
        assert_eq!(adapter.command().await, "t00020101");
        adapter.say("t18110A\r").await;
        assert_eq!(next_frame(&mut reader).await, "181#0A");
        drop(adapter);
        assert!(matches!(reader.recv().await, Err(BusError::Absent { .. })));
        assert!(writer.send(&frame("000#0101")).await.is_err());
    }

    #[tokio::test]
    async fn nobody_behind_the_tcp_port_is_an_absent_interface() {
        let listener = tokio::net::TcpListener::bind("127.0.0.1:0").await.unwrap();
        let text = format!("slcan+tcp://{}", listener.local_addr().unwrap());
        drop(listener);
        let (mut reader, _writer) = open(&text.parse().unwrap(), Clock::start());
        assert!(matches!(reader.recv().await, Err(BusError::Absent { .. })));
    }

    #[cfg(feature = "serial")]
    #[tokio::test]
    async fn p21_an_adapter_on_a_serial_port_is_reached_and_its_unplugging_is_noticed() {
        use tokio_serial::SerialPort;
        let (near, far) = tokio_serial::SerialStream::pair().unwrap();
        let text = format!("slcan:{}?bitrate=250000", far.name().unwrap());
        drop(far);
        let (mut reader, mut writer) = open(&text.parse().unwrap(), Clock::start());
        let mut adapter = Adapter::new(near);
        adapter.set_up(Some("S5")).await;
        assert_eq!(next_link(&mut reader).await, Link::ErrorActive);
        adapter.say("r7011\r").await;
        assert_eq!(next_frame(&mut reader).await, "701#R1");
        writer.send(&frame("701#R1")).await.unwrap();
        assert_eq!(adapter.command().await, "r7011");
        drop(adapter);
        assert!(matches!(reader.recv().await, Err(BusError::Absent { .. })));
        let (mut reader, _writer) = open(&text.parse().unwrap(), Clock::start());
        assert!(matches!(reader.recv().await, Err(BusError::Absent { .. })), "it is not there any more");
    }
}
