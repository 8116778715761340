//! One client of a serial line: what comes in goes to it, what it sends goes out. \[IO\]

use std::collections::VecDeque;
use std::net::SocketAddr;
use std::sync::{Mutex, PoisonError};
use std::time::Duration;

use tokio::io::{AsyncReadExt, AsyncWriteExt, Interest};
use tokio::net::TcpStream;
use tokio::net::tcp::{ReadHalf, WriteHalf};
use tokio::sync::watch;

use super::end::End;
use super::opening::{Opening, Verdict};
use super::seat::Seat;
use super::told::{Reason, Told};
use crate::gateway::command::desk::Answer;
use crate::gateway::command::{Action, Authority, CommandSource, Desk, Outcome};
use crate::process_image::serial::BYTES;
use crate::process_image::{ImageReader, LineIndex};
use crate::slots::{Leave, Place};
use crate::time::Clock;

/// What the connections of a line share.
#[derive(Debug)]
pub struct Line {
    /// For the log: serial line 1 of `scales`.
    pub name: String,
    /// Which it is.
    pub index: LineIndex,
    /// Why nothing that clients send ever goes out; `None`: it does.
    pub mute: Option<&'static str>,
    /// Who writes.
    pub seat: Seat,
    /// Clients that were told of lately.
    pub told: Mutex<Told>,
    /// Where the bytes stand.
    pub reader: ImageReader,
    /// Where bytes are handed in.
    pub desk: Desk,
    /// Time.
    pub clock: Clock,
}

impl Line {
    /// Whether a client is to be told of now for a reason: how often there was one and it was not told.
    #[must_use]
    pub fn due(&self, reason: Reason, peer: SocketAddr) -> Option<u64> {
        let now = self.clock.now().instant;
        self.told.lock().unwrap_or_else(PoisonError::into_inner).due(reason, peer.ip(), now)
    }
}

/// What wakes the connections of a line.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct News {
    /// Bytes can be sent to it.
    pub open: bool,
    /// How many came in: the cursor of the next.
    pub received: u64,
}

/// One connection, from its side of the line.
#[derive(Debug)]
pub struct Client {
    /// Not 0, and no other of this line has had it.
    pub number: u64,
    /// Who it is.
    pub peer: SocketAddr,
    /// The first byte that it gets.
    pub cursor: u64,
    /// The state of the line.
    pub news: watch::Receiver<News>,
}

/// Bytes that are handed in at once.
const PIECE: usize = 1_024;
/// Pieces that are handed in and not answered: one goes out while the next waits, so that the line never pauses.
const PIECES: usize = 2;
/// Bytes that are given to a client at once.
const CHUNK: usize = 8_192;
/// Pause after the desk was full.
const BUSY_PAUSE: Duration = Duration::from_millis(20);
/// How long first bytes are held back that could begin what a browser sends: it sends all of that at once.
const HOLD: Duration = Duration::from_millis(200);
/// While the line is closed, how often to look whether the client has gone.
const LOOK: Duration = Duration::from_secs(1);

/// Serves a client until it, the network or a failure ends it, or its place is wanted.
pub async fn serve(mut stream: TcpStream, client: Client, line: &Line, place: &Place) -> End {
    let number = client.number;
    // Who only reads asks for nothing, and is no less than who sends.
    place.touch(line.clock.now().instant);
    let (from, to) = stream.split();
    let sender = Sender {
        from,
        news: client.news.clone(),
        number,
        peer: client.peer,
        line,
        place,
        asks: VecDeque::new(),
        went: 0,
        opening: Opening::default(),
    };
    let end = tokio::select! {
        end = deliver(to, client, line, place) => end,
        end = sender.run() => end,
        leave = place.must_leave() => match leave {
            Leave::Evicted => End::Evicted,
            Leave::Stopped => End::Stopped,
        },
    };
    line.seat.leave(number);
    end
}

/// Gives a client what comes in.
async fn deliver(mut to: WriteHalf<'_>, mut client: Client, line: &Line, place: &Place) -> End {
    loop {
        client.news.borrow_and_update();
        let cursor = &mut client.cursor;
        let (bytes, missed) = line.reader.read(|image| {
            let line = image.lines.get(line.index.0);
            line.map_or_else(Default::default, |line| line.read(cursor, CHUNK))
        });
        if missed > 0 {
            return End::Slow { missed };
        }
        if bytes.is_empty() {
            if client.news.changed().await.is_err() {
                // The server ends.
                return End::Stopped;
            }
            continue;
        }
        let kept = client.cursor.saturating_add(u64::try_from(BYTES).unwrap_or(u64::MAX));
        // Looked at while it takes nothing, too: it is told of when the first byte is gone, not when it wakes up.
        let gone = client.news.wait_for(|news| news.received > kept);
        let missed = tokio::select! {
            written = to.write_all(&bytes) => match written {
                Ok(()) => None,
                Err(error) => return End::broken(&error),
            },
            Ok(news) = gone => Some(news.received - kept),
        };
        if let Some(missed) = missed {
            return End::Slow { missed };
        }
        place.touch(line.clock.now().instant);
    }
}

/// What a client sends, on its way to the line.
struct Sender<'a> {
    from: ReadHalf<'a>,
    news: watch::Receiver<News>,
    number: u64,
    peer: SocketAddr,
    line: &'a Line,
    place: &'a Place,
    /// Pieces that are handed in, the oldest first: their lengths, and their answers, which come in the same order.
    asks: VecDeque<(usize, Answer)>,
    /// Bytes of pieces that went out.
    went: u64,
    opening: Opening,
}

/// What came from a client.
enum Heard {
    /// So many bytes; 0: it sends nothing more.
    Bytes(usize),
    /// It sends nothing more, and what it had sent while the line was closed is dropped: so many bytes.
    Gone(usize),
}

impl Sender<'_> {
    async fn run(mut self) -> End {
        let mut piece = vec![0; PIECE];
        loop {
            let room = self.asks.len() < PIECES;
            let heard = tokio::select! {
                answered = answered(&mut self.asks), if !self.asks.is_empty() => match self.settle(answered) {
                    Ok(()) => continue,
                    Err(end) => return end,
                },
                heard = read(&mut self.from, &mut self.news, self.line.mute.is_none(), &mut piece), if room => heard,
                () = tokio::time::sleep(HOLD), if room && self.opening.holds() => match self.release().await {
                    Ok(()) => continue,
                    Err(end) => return end,
                },
            };
            let count = match heard {
                Ok(Heard::Bytes(0)) => return self.finish().await,
                Ok(Heard::Bytes(count)) => count,
                Ok(Heard::Gone(dropped)) => return self.drop_rest(dropped).await,
                Err(end) => return end,
            };
            self.place.touch(self.line.clock.now().instant);
            let bytes = piece.get(..count).unwrap_or_default();
            if let Err(end) = self.take(bytes).await {
                return end;
            }
        }
    }

    /// Takes what was read.
    async fn take(&mut self, bytes: &[u8]) -> Result<(), End> {
        if let Some(why) = self.line.mute {
            let (Line { name, .. }, peer) = (self.line, self.peer);
            if let Some(untold) = self.line.due(Reason::Mute, peer) {
                tracing::warn!(
                    %peer,
                    untold,
                    "{name}: this client sends, but {why}: what it sends is thrown away (told once a minute)"
                );
            }
            return Ok(());
        }
        match self.opening.take(bytes) {
            Verdict::Pass(bytes) => self.hand_in(&bytes).await,
            Verdict::Hold => Ok(()),
            Verdict::Refuse => Err(End::Http),
        }
    }

    /// Lets the first bytes go that were held back.
    async fn release(&mut self) -> Result<(), End> {
        let held = self.opening.release();
        if held.is_empty() { Ok(()) } else { self.hand_in(&held).await }
    }

    /// Hands a piece in. The pieces stay in order: each is in the queue of the gateway before the next is tried.
    async fn hand_in(&mut self, bytes: &[u8]) -> Result<(), End> {
        if !self.line.seat.take(self.number) {
            return Err(End::NotTheWriter);
        }
        loop {
            let source = CommandSource::serial(self.peer.to_string());
            let action = Action::SerialSend { line: self.line.index, bytes: bytes.to_vec() };
            match self.line.desk.hand_in(source, &Authority::SerialLine, action) {
                Ok(answer) => {
                    self.asks.push_back((bytes.len(), answer));
                    return Ok(());
                }
                Err(Outcome::Busy) => tokio::time::sleep(BUSY_PAUSE).await,
                Err(outcome) => return Err(self.not_sent(bytes.len(), outcome)),
            }
        }
    }

    /// The client sends nothing more: what it has sent goes out, another one may write. It still gets what comes in until it
    /// is gone, which keep-alive finds out.
    async fn finish(mut self) -> End {
        if let Err(end) = self.release().await {
            return end;
        }
        while !self.asks.is_empty() {
            let answered = answered(&mut self.asks).await;
            if let Err(end) = self.settle(answered) {
                return end;
            }
        }
        self.line.seat.leave(self.number);
        match self.from.ready(Interest::ERROR).await {
            Ok(_) => End::Closed,
            Err(error) => End::broken(&error),
        }
    }

    /// The client ended its sending while the line was closed: what it sent was meant for then, and is dropped. It still gets
    /// what comes in.
    async fn drop_rest(mut self, dropped: usize) -> End {
        let dropped = dropped.saturating_add(self.opening.release().len());
        let (Line { name, .. }, peer) = (self.line, self.peer);
        if dropped > 0
            && let Some(untold) = self.line.due(Reason::Dropped, peer)
        {
            tracing::warn!(
                %peer,
                dropped,
                untold,
                "{name}: this client ended its sending while the line was closed: {dropped} bytes of it are dropped (told once a \
                 minute; {untold} times since it was told last)"
            );
        }
        self.finish().await
    }

    /// What came of the oldest piece.
    fn settle(&mut self, (bytes, outcome): (usize, Outcome)) -> Result<(), End> {
        if outcome == Outcome::Done {
            self.went = self.went.saturating_add(u64::try_from(bytes).unwrap_or(u64::MAX));
            return Ok(());
        }
        Err(self.not_sent(bytes, outcome))
    }

    /// A piece of so many bytes did not go out, and so do those behind it.
    fn not_sent(&self, bytes: usize, outcome: Outcome) -> End {
        let behind = self.asks.iter().map(|(bytes, _)| bytes).sum();
        let none = |why: &str| format!("0 of {bytes} bytes were handed to the bus: {why}");
        let why = match outcome {
            Outcome::Failed(why) => why,
            Outcome::Rejected(why) | Outcome::Forbidden(why) => none(&why),
            Outcome::NodeUnavailable => none("the module is not there"),
            Outcome::Busy => none("too many want to send to this line"),
            Outcome::Timeout => none("not in time"),
            Outcome::Unknown => none("there is no such line"),
            Outcome::Done | Outcome::Read(_) | Outcome::Aborted(_) => none("another answer than expected"),
        };
        End::NotSent { before: self.went, why, behind }
    }
}

/// Waits for the answer to the oldest. Cancel-safe.
async fn answered(asks: &mut VecDeque<(usize, Answer)>) -> (usize, Outcome) {
    let Some((bytes, answer)) = asks.front_mut() else { std::future::pending().await };
    let answered = (*bytes, answer.wait().await);
    asks.pop_front();
    answered
}

/// Reads once the line is open. Cancel-safe.
///
/// While the line is closed, nothing is read. What a client has sent meanwhile goes out once it is open again, unless the
/// client has ended its sending: it does not wait for an answer any more, and the command of minutes ago would surprise
/// everybody.
async fn read(
    from: &mut ReadHalf<'_>,
    news: &mut watch::Receiver<News>,
    write: bool,
    piece: &mut [u8],
) -> Result<Heard, End> {
    loop {
        if write
            && !news.borrow_and_update().open
            && let Some(dropped) = opened(from, news, piece).await?
        {
            return Ok(Heard::Gone(dropped));
        }
        tokio::select! {
            biased;
            _ = news.wait_for(|news| !news.open), if write => {}
            read = from.read(piece) => return read.map(Heard::Bytes).map_err(|error| End::broken(&error)),
        }
    }
}

/// Waits until the line is open; how many bytes of a client were dropped that ended its sending before.
async fn opened(
    from: &ReadHalf<'_>,
    news: &mut watch::Receiver<News>,
    piece: &mut [u8],
) -> Result<Option<usize>, End> {
    loop {
        let open = tokio::select! {
            opened = news.wait_for(|news| news.open) => opened.map(|_| true).map_err(|_| End::Stopped)?,
            () = tokio::time::sleep(LOOK) => false,
        };
        if has_gone(from).await {
            let mut dropped = 0_usize;
            // At most what the system keeps of it.
            while let Ok(count @ 1..) = from.try_read(piece) {
                dropped = dropped.saturating_add(count);
            }
            return Ok(Some(dropped));
        }
        if open {
            return Ok(None);
        }
    }
}

/// Whether the other end sends nothing more, however much of what it has sent still waits.
async fn has_gone(from: &ReadHalf<'_>) -> bool {
    let ready = tokio::time::timeout(Duration::ZERO, from.ready(Interest::READABLE)).await;
    matches!(ready, Ok(Ok(ready)) if ready.is_read_closed())
}
