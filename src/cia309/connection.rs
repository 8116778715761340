//! One client: reads lines, answers each before it looks at the next, knows when to give up. \[IO\]

use std::sync::Arc;
use std::time::Duration;

use tokio::io::{AsyncReadExt, AsyncWriteExt};

use super::lines::{LONGEST_LINE, Lines, TooLong};
use super::session::{Session, Step};
use crate::gateway::command::{Authority, CommandSource, Desk};
use crate::mapping::TagTable;
use crate::slots::{Leave, Place};
use crate::time::Clock;

/// What all connections share.
#[derive(Clone, Debug)]
pub struct Shared {
    /// Buses and nodes.
    pub table: Arc<TagTable>,
    /// Where the gateway is asked.
    pub desk: Desk,
    /// Writes and NMT commands are taken.
    pub writes: bool,
    /// Time.
    pub clock: Clock,
    /// How long a connection may be without a whole line.
    pub idle_timeout: Option<Duration>,
}

/// Bytes that are read at once. While a line is being answered nothing more is read, so that a client that sends without end
/// waits in its own buffers.
const INPUT: usize = 2_048;
/// A client must take an answer within this.
const SEND_TIMEOUT: Duration = Duration::from_secs(5);

/// Serves a client until it, the network or a time-out ends it, or its place is wanted; why is for the log.
pub async fn serve<S>(stream: S, peer: String, shared: &Shared, place: &Place) -> &'static str
where
    S: AsyncReadExt + AsyncWriteExt + Unpin,
{
    let session = Session::new(Arc::clone(&shared.table), shared.writes);
    let mut connection = Connection { stream, peer, shared, place, session, lines: Lines::default() };
    tokio::select! {
        end = connection.run() => end,
        leave = place.must_leave() => match leave {
            Leave::Evicted => "evicted",
            Leave::Stopped => "stopped",
        },
    }
}

struct Connection<'a, S> {
    stream: S,
    peer: String,
    shared: &'a Shared,
    place: &'a Place,
    session: Session,
    lines: Lines,
}

impl<S: AsyncReadExt + AsyncWriteExt + Unpin> Connection<'_, S> {
    async fn run(&mut self) -> &'static str {
        let mut input = vec![0; INPUT];
        let mut heard = self.shared.clock.now().instant;
        loop {
            match self.work_off().await {
                // The time runs from line to line: bytes that dribble in do not prolong it.
                Ok(true) => heard = self.shared.clock.now().instant,
                Ok(false) => {}
                Err(end) => return end,
            }
            let read = self.stream.read(&mut input);
            let read = match self.shared.idle_timeout {
                None => read.await,
                Some(timeout) => {
                    let until = self.shared.clock.deadline(heard + timeout);
                    match tokio::time::timeout_at(until, read).await {
                        Ok(read) => read,
                        Err(_elapsed) => return "idle",
                    }
                }
            };
            match read {
                Ok(0) => return "closed",
                Ok(count) => self.lines.push(input.get(..count).unwrap_or_default()),
                Err(_) => return "broken",
            }
        }
    }

    /// Answers all lines that are complete. Whether there was one.
    ///
    /// A line that is too long is the last one: it could be the beginning of an HTTP request with a very long address, which a
    /// web page made the browser of somebody in the plant send, and what follows it would be of that page's choice.
    async fn work_off(&mut self) -> Result<bool, &'static str> {
        let mut any = false;
        while let Some(line) = self.lines.next_line() {
            any = true;
            let answer = match line {
                Err(TooLong) => {
                    self.send(Session::too_long(LONGEST_LINE)).await?;
                    return Err("too_long");
                }
                Ok(line) => match self.session.handle_line(line) {
                    Step::Nothing => continue,
                    Step::End => return Err("http"),
                    Step::Last(text) => {
                        self.send(text).await?;
                        return Err("no_text");
                    }
                    // Who asks for nothing that is known keeps nobody else out.
                    Step::NotUnderstood(text) => text,
                    Step::Answer(text) => {
                        self.place.touch(self.shared.clock.now().instant);
                        text
                    }
                    Step::Refused(text, told) => {
                        self.place.touch(self.shared.clock.now().instant);
                        let source = CommandSource::cia309(self.peer.clone());
                        self.shared.desk.refuse(source, told.verb, told.text);
                        text
                    }
                    Step::Ask(action, asked) => {
                        self.place.touch(self.shared.clock.now().instant);
                        let source = CommandSource::cia309(self.peer.clone());
                        let opened = Authority::Objects { write: self.shared.writes };
                        asked.answer(&self.shared.desk.ask(source, &opened, action).await)
                    }
                },
            };
            self.send(answer).await?;
        }
        Ok(any)
    }

    async fn send(&mut self, mut line: String) -> Result<(), &'static str> {
        line.push_str("\r\n");
        match tokio::time::timeout(SEND_TIMEOUT, self.stream.write_all(line.as_bytes())).await {
            Ok(Ok(())) => Ok(()),
            Ok(Err(_)) => Err("broken"),
            Err(_elapsed) => Err("slow_client"),
        }
    }
}
