//! One client: reads lines, answers each before it looks at the next, knows when to give up. \[IO\]

use std::sync::Arc;
use std::time::Duration;

use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio_util::sync::CancellationToken;

use super::lines::{LONGEST_LINE, Lines, TooLong};
use super::session::{Session, Step};
use crate::gateway::command::{CommandSource, Desk};
use crate::mapping::TagTable;
use crate::slots::Activity;
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

/// What ends a connection from outside.
#[derive(Clone, Debug)]
pub struct Stops {
    /// It has to make room.
    pub evict: CancellationToken,
    /// The gateway stops.
    pub stop: CancellationToken,
}

/// Bytes that are read at once. While a line is being answered nothing more is read, so that a client that sends without end
/// waits in its own buffers.
const INPUT: usize = 2_048;
/// A client must take an answer within this.
const SEND_TIMEOUT: Duration = Duration::from_secs(5);

/// Serves a client until it, the network, a time-out or one of `stops` ends it; why is for the log.
pub async fn serve<S>(
    stream: S,
    peer: String,
    shared: &Shared,
    activity: &Activity,
    stops: &Stops,
) -> &'static str
where
    S: AsyncReadExt + AsyncWriteExt + Unpin,
{
    let session = Session::new(Arc::clone(&shared.table), shared.writes);
    let mut connection = Connection { stream, peer, shared, activity, session, lines: Lines::default() };
    tokio::select! {
        end = connection.run() => end,
        () = stops.evict.cancelled() => "evicted",
        () = stops.stop.cancelled() => "stopped",
    }
}

struct Connection<'a, S> {
    stream: S,
    peer: String,
    shared: &'a Shared,
    activity: &'a Activity,
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
    async fn work_off(&mut self) -> Result<bool, &'static str> {
        let mut any = false;
        while let Some(line) = self.lines.next_line() {
            any = true;
            self.activity.touch(self.shared.clock.now().instant);
            let answer = match line {
                Err(TooLong) => Session::too_long(LONGEST_LINE),
                Ok(line) => match self.session.handle_line(line) {
                    Step::Nothing => continue,
                    Step::End => return Err("http"),
                    Step::Answer(text) => text,
                    Step::Ask(action, asked) => {
                        let source = CommandSource::Cia309(self.peer.clone());
                        asked.answer(&self.shared.desk.ask(source, action).await)
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
