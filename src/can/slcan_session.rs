//! The conversation with a LAWICEL adapter: setting it up (`C`, `S`, `O` or `L`), then reading and writing side by side. \[IO\]

use std::convert::Infallible;
use std::io;
use std::sync::{Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use tokio::io::{AsyncRead, AsyncReadExt, AsyncWrite, AsyncWriteExt};
use tokio::sync::{mpsc, watch};
use tokio::time::{MissedTickBehavior, interval, timeout};

use super::slcan::{Decoder, Incoming, bit_rate_command, encode};
use super::slcan_answers::{Answers, Command, Ending, FLAGS_EVERY};
use super::{BusError, BusEvent, CanFrame};
use crate::time::Clock;

/// An adapter that has not answered a command by now never answers.
const ANSWER_TIME: Duration = Duration::from_millis(300);
/// After the answer to the closing of the channel, silence of this length means that the adapter has said all it had to.
const SILENCE: Duration = Duration::from_millis(50);
/// How long the adapter may go on after it was told to be silent.
const LONGEST_CHATTER: Duration = Duration::from_millis(500);
/// How long the port may take one frame.
const WRITE_TIME: Duration = Duration::from_secs(1);

/// What is wanted of an adapter.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Adapter {
    /// The interface as written in the configuration, for messages.
    pub name: String,
    /// Bit rate of the CAN bus in bit/s, one of [`BIT_RATES`](super::BIT_RATES); `None` leaves what the adapter has.
    pub bit_rate: Option<u32>,
    /// Open the channel to listen only (`L`): nothing is sent, not even the acknowledging of frames.
    pub listen_only: bool,
}

/// What the halves of the bus and its task share.
#[derive(Debug)]
pub struct Desk {
    /// What is wanted.
    pub adapter: Adapter,
    /// The clock.
    pub clock: Clock,
    /// To the reader.
    pub events: mpsc::Sender<Result<BusEvent, BusError>>,
    answers: Mutex<Answers>,
}

/// Why a conversation ended.
#[derive(Debug)]
pub struct Failure {
    /// There is nothing to talk to.
    absent: bool,
    source: io::Error,
}

impl Failure {
    /// There is nothing to talk to.
    #[must_use]
    pub fn gone(source: io::Error) -> Self {
        Self { absent: true, source }
    }

    /// The adapter is there.
    #[must_use]
    pub fn other(text: impl Into<String>) -> Self {
        Self { absent: false, source: io::Error::other(text.into()) }
    }

    /// For the interface of that name.
    #[must_use]
    pub fn into_error(self, interface: String) -> BusError {
        let source = self.source;
        if self.absent { BusError::Absent { interface, source } } else { BusError::Io { interface, source } }
    }
}

/// What ends reading and writing.
enum Ended {
    OpenAnew,
    Failed(Failure),
}

impl From<Failure> for Ended {
    fn from(failure: Failure) -> Self {
        Self::Failed(failure)
    }
}

impl From<Ending> for Ended {
    fn from(ending: Ending) -> Self {
        match ending {
            Ending::OpenAnew => Self::OpenAnew,
            Ending::Silent => {
                Self::Failed(Failure::gone(io::Error::new(io::ErrorKind::TimedOut, ending.to_string())))
            }
            Ending::Closed => Self::Failed(Failure::other(ending.to_string())),
        }
    }
}

impl Desk {
    /// For one opening of the port.
    #[must_use]
    pub fn new(adapter: Adapter, clock: Clock, events: mpsc::Sender<Result<BusEvent, BusError>>) -> Self {
        Self { adapter, clock, events, answers: Mutex::default() }
    }

    /// What is known of the adapter.
    pub fn answers(&self) -> MutexGuard<'_, Answers> {
        // The state is whole after every statement, so a panic elsewhere leaves a good one.
        self.answers.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// An error here says that nobody reads any more; the task is about to be stopped.
    async fn tell(&self, event: BusEvent) {
        let _ = self.events.send(Ok(event)).await;
    }

    /// Gives back the frames that did not leave and those that still wait: going out late is worse than not at all.
    pub async fn give_back(&self, to_send: &mut mpsc::Receiver<CanFrame>) {
        let lost = self.answers().handle_closed();
        for frame in lost {
            self.tell(BusEvent::NotSent { frame, at: self.clock.now() }).await;
        }
        while let Ok(frame) = to_send.try_recv() {
            self.tell(BusEvent::NotSent { frame, at: self.clock.now() }).await;
        }
    }
}

/// Sets the adapter up and talks with it, again if need be, until that fails. `opened` says whether frames can be sent.
///
/// # Errors
/// Always, and then the port is to be opened again.
pub async fn converse<P: AsyncRead + AsyncWrite + Send + Unpin>(
    desk: &Desk,
    mut port: P,
    to_send: &mut mpsc::Receiver<CanFrame>,
    opened: &watch::Sender<bool>,
) -> Result<Infallible, Failure> {
    loop {
        let opening = set_up(&mut port, &desk.adapter).await?;
        let link = desk.answers().handle_opened(opening.answered, desk.adapter.bit_rate);
        desk.tell(BusEvent::Link { link, at: desk.clock.now() }).await;
        opened.send_replace(true);
        if let Some(frame) = opening.first {
            desk.tell(BusEvent::Frame { frame, at: desk.clock.now() }).await;
        }
        let (input, output) = tokio::io::split(&mut port);
        let Err(ended) = tokio::select! {
            ended = read_for_ever(desk, input, opening.decoder) => ended,
            ended = write_for_ever(desk, output, to_send) => ended,
        };
        opened.send_replace(false);
        desk.give_back(to_send).await;
        match ended {
            Ended::OpenAnew => tracing::debug!(interface = desk.adapter.name, "opening the channel anew"),
            Ended::Failed(failure) => return Err(failure),
        }
    }
}

/// What came of setting an adapter up.
#[derive(Default)]
struct Opening {
    /// The adapter has answered something.
    answered: bool,
    decoder: Decoder,
    /// A frame that came before the answer.
    first: Option<CanFrame>,
}

async fn set_up<P: AsyncRead + AsyncWrite + Unpin>(
    port: &mut P,
    adapter: &Adapter,
) -> Result<Opening, Failure> {
    port.write_all(b"\rC\r").await.map_err(Failure::gone)?;
    let mut opening = Opening { answered: await_silence(port).await?, ..Opening::default() };
    if let Some(bit_rate) = adapter.bit_rate {
        let command = bit_rate_command(bit_rate)
            .ok_or_else(|| Failure::other(format!("no LAWICEL adapter has the bit rate {bit_rate}")))?;
        ask(port, &mut opening, &command).await?;
    }
    ask(port, &mut opening, if adapter.listen_only { "L" } else { "O" }).await?;
    Ok(opening)
}

/// Waits until the adapter has answered the closing of its channel, if it does, and then throws away what else it says, as
/// it was in the middle of something. An answer that came later would be taken for that to the next command. Whether it
/// answered.
async fn await_silence<P: AsyncRead + Unpin>(port: &mut P) -> Result<bool, Failure> {
    let mut bytes = [0; 1_024];
    let mut decoder = Decoder::default();
    let mut answered = false;
    let chatter = async {
        loop {
            let patience = if answered { SILENCE } else { ANSWER_TIME };
            let Ok(read) = timeout(patience, port.read(&mut bytes)).await else { return Ok(()) };
            let read = read.map_err(Failure::gone)?;
            if read == 0 {
                return Err(closed());
            }
            for byte in bytes.get(..read).unwrap_or_default() {
                answered |= matches!(decoder.push(*byte), Some(Incoming::Done | Incoming::Refused));
            }
        }
    };
    timeout(LONGEST_CHATTER, chatter).await.unwrap_or(Ok(()))?;
    Ok(answered)
}

/// Sends a command and waits for its answer, or for a frame, which shows that the channel is open, or until it is clear
/// that this adapter does not answer.
async fn ask<P: AsyncRead + AsyncWrite + Unpin>(
    port: &mut P,
    opening: &mut Opening,
    command: &str,
) -> Result<(), Failure> {
    port.write_all(format!("{command}\r").as_bytes()).await.map_err(Failure::gone)?;
    let answer = async {
        loop {
            let byte = match port.read_u8().await {
                Ok(byte) => byte,
                Err(error) if error.kind() == io::ErrorKind::UnexpectedEof => return Err(closed()),
                Err(error) => return Err(Failure::gone(error)),
            };
            match opening.decoder.push(byte) {
                Some(Incoming::Done) => return Ok(None),
                Some(Incoming::Frame(frame)) => return Ok(Some(frame)),
                Some(Incoming::Refused) => {
                    return Err(Failure::other(refusal(command)));
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
    if let Ok(first) = timeout(ANSWER_TIME, answer).await {
        opening.first = first?;
        opening.answered = true;
    } else {
        tracing::debug!(command, "the adapter does not answer; going on without");
    }
    Ok(())
}

fn refusal(command: &str) -> String {
    if command == "L" {
        "the adapter refuses to listen only (`L`), as the passive role demands; opened with `O` it would acknowledge \
         frames, and disturb the bus at a wrong bit rate: use an adapter that knows `L`"
            .to_owned()
    } else {
        format!("the adapter refuses the command `{command}`")
    }
}

fn closed() -> Failure {
    Failure::gone(io::Error::new(io::ErrorKind::UnexpectedEof, "the adapter closed the connection"))
}

async fn read_for_ever<R: AsyncRead + Unpin>(
    desk: &Desk,
    mut input: R,
    mut decoder: Decoder,
) -> Result<Infallible, Ended> {
    let mut bytes = [0; 4_096];
    loop {
        let read = input.read(&mut bytes).await.map_err(Failure::gone)?;
        if read == 0 {
            return Err(closed().into());
        }
        let now = desk.clock.now();
        for byte in bytes.get(..read).unwrap_or_default() {
            let Some(incoming) = decoder.push(*byte) else { continue };
            let (link, event) = desk.answers().handle_incoming(incoming, now)?;
            if let Some(link) = link {
                desk.tell(BusEvent::Link { link, at: now }).await;
            }
            if let Some(event) = event {
                desk.tell(event).await;
            }
        }
    }
}

async fn write_for_ever<W: AsyncWrite + Unpin>(
    desk: &Desk,
    mut output: W,
    to_send: &mut mpsc::Receiver<CanFrame>,
) -> Result<Infallible, Ended> {
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
                if !desk.answers().handle_timeout(desk.clock.now().instant)? {
                    continue;
                }
                line.push_str("F\r");
                Command::AskFlags
            }
        };
        desk.answers().handle_sending(command, desk.clock.now().instant);
        timeout(WRITE_TIME, output.write_all(line.as_bytes()))
            .await
            .unwrap_or_else(|_| Err(io::ErrorKind::TimedOut.into()))
            .map_err(Failure::gone)?;
        desk.answers().handle_written();
    }
}
