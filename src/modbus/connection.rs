//! One client: reads requests, answers them in order, knows when to give up. \[IO\]
//!
//! Registers are answered at once. An object of a node takes as long as the node does; the requests behind it wait.

use std::net::SocketAddr;
use std::time::Duration;

use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio_util::sync::CancellationToken;

use super::counters::{Counters, End};
use super::frame::{self, Frame, LONGEST_FRAME, Parsed};
use super::general_reference::{self, Reference};
use super::pdu::{self, ExceptionCode};
use super::register_bank::RegisterBank;
use super::service;
use crate::gateway::command::{CommandSource, Desk};
use crate::process_image::ImageReader;
use crate::slots::Activity;
use crate::time::Clock;

/// What all connections share.
#[derive(Debug)]
pub struct Shared {
    /// Registers.
    pub bank: RegisterBank,
    /// Values.
    pub reader: ImageReader,
    /// Time.
    pub clock: Clock,
    /// Counters.
    pub counters: std::sync::Arc<Counters>,
    /// How long a connection may be silent.
    pub idle_timeout: Option<Duration>,
    /// How long a request may stay incomplete.
    pub partial_frame_timeout: Duration,
    /// How long an answer may wait.
    pub send_timeout: Duration,
    /// FC 43/13, where it is offered.
    pub objects: Option<Objects>,
}

/// Objects of nodes.
#[derive(Clone, Debug)]
pub struct Objects {
    /// Where the gateway is asked.
    pub desk: Desk,
    /// They may be written too.
    pub write: bool,
}

/// Bytes that are read ahead: several requests that a client sent without waiting.
const INPUT: usize = 4_096;
/// Answers of this many bytes are sent before the next request is looked at, so that a client that does not read them
/// cannot make the server hoard them.
const OUTPUT: usize = 16_384;

/// Serves a client until it, the network, a time-out or one of `stops` ends it.
pub async fn serve<S>(stream: S, peer: SocketAddr, shared: &Shared, activity: &Activity, stops: &Stops) -> End
where
    S: AsyncReadExt + AsyncWriteExt + Unpin,
{
    let input = vec![0; INPUT];
    let output = Vec::with_capacity(OUTPUT + LONGEST_FRAME);
    let mut connection = Connection { stream, peer, shared, activity, input, filled: 0, output };
    tokio::select! {
        end = connection.run() => end,
        () = stops.evict.cancelled() => End::Evicted,
        () = stops.stop.cancelled() => End::Stopped,
    }
}

/// What ends a connection from outside.
#[derive(Clone, Debug)]
pub struct Stops {
    /// It has to make room.
    pub evict: CancellationToken,
    /// The gateway stops.
    pub stop: CancellationToken,
}

struct Connection<'a, S> {
    stream: S,
    peer: SocketAddr,
    shared: &'a Shared,
    activity: &'a Activity,
    /// Of fixed length; `filled` bytes of it are not answered yet.
    input: Vec<u8>,
    filled: usize,
    output: Vec<u8>,
}

/// How far the requests in the input were answered.
enum Progress {
    /// All that are complete. `any`: there was at least one.
    Done { any: bool },
    /// There may be more, but the answers must leave first.
    Full,
    /// The next answer takes its time; those before it are to leave.
    Object(Asked),
    /// What came is no Modbus.
    Malformed,
}

/// A request for an object.
struct Asked {
    transaction: u16,
    unit: u8,
    /// `None`: it is not well formed.
    reference: Option<Reference>,
}

impl<S: AsyncReadExt + AsyncWriteExt + Unpin> Connection<'_, S> {
    async fn run(&mut self) -> End {
        let mut partial_until = None;
        loop {
            loop {
                let progress = self.answer();
                if let Err(end) = self.flush().await {
                    return end;
                }
                match progress {
                    Progress::Full => partial_until = None,
                    Progress::Object(asked) => {
                        partial_until = None;
                        self.answer_object(&asked).await;
                    }
                    Progress::Malformed => return End::Malformed,
                    Progress::Done { any } => {
                        if any || self.filled == 0 {
                            partial_until = None;
                        }
                        break;
                    }
                }
            }
            let now = self.shared.clock.now().instant;
            let (until, end) = if self.filled > 0 {
                let until = *partial_until.get_or_insert(now + self.shared.partial_frame_timeout);
                (Some(until), End::PartialFrame)
            } else {
                (self.shared.idle_timeout.map(|timeout| now + timeout), End::Idle)
            };
            let room = self.input.get_mut(self.filled..).unwrap_or_default();
            let read = self.stream.read(room);
            let read = match until {
                None => read.await,
                Some(until) => match tokio::time::timeout_at(self.shared.clock.deadline(until), read).await {
                    Ok(read) => read,
                    Err(_elapsed) => return end,
                },
            };
            match read {
                Ok(0) => return End::Closed,
                Ok(count) => self.filled += count,
                Err(_) => return End::Broken,
            }
        }
    }

    /// Answers the complete requests of the input into the output, and moves what is left to the beginning.
    fn answer(&mut self) -> Progress {
        let mut used = 0;
        let mut any = false;
        let progress = loop {
            if self.output.len() >= OUTPUT {
                break Progress::Full;
            }
            match frame::parse(self.input.get(used..self.filled).unwrap_or_default()) {
                Parsed::Incomplete => break Progress::Done { any },
                Parsed::Malformed => break Progress::Malformed,
                Parsed::Foreign { length } => {
                    self.shared.counters.foreign_frame();
                    used += length;
                }
                Parsed::Frame(request) => {
                    used += request.length();
                    if let Some(asked) = self.object_request(&request) {
                        break Progress::Object(asked);
                    }
                    let Shared { bank, reader, clock, counters, .. } = self.shared;
                    let now = clock.now();
                    let output = &mut self.output;
                    let exception = reader.read(|image| service::answer(bank, image, now, &request, output));
                    counters.request(exception);
                    self.activity.touch(now.instant);
                }
            }
            any = true;
        };
        self.input.copy_within(used..self.filled, 0);
        self.filled -= used;
        progress
    }

    /// Whether a request is for an object, and is to be asked of the gateway. One that is wrong is answered at once.
    fn object_request(&self, request: &Frame<'_>) -> Option<Asked> {
        self.shared.objects.as_ref().filter(|_| general_reference::is_general_reference(request.pdu))?;
        let reference = general_reference::decode(request.pdu).ok();
        Some(Asked { transaction: request.transaction, unit: request.unit, reference })
    }

    /// Appends the answer to a request for an object, once the gateway has given it.
    async fn answer_object(&mut self, asked: &Asked) {
        let result = self.ask_for_object(asked).await;
        let mut exception = None;
        frame::write(&mut self.output, asked.transaction, asked.unit, |out| match result {
            Ok(pdu) => out.extend_from_slice(&pdu),
            Err(code) => {
                pdu::write_exception(out, pdu::ENCAPSULATED, code);
                exception = Some(code);
            }
        });
        self.shared.counters.request(exception);
        self.activity.touch(self.shared.clock.now().instant);
    }

    /// In the order of the other functions: unit (0B), value (03), address (02).
    async fn ask_for_object(&self, asked: &Asked) -> Result<Vec<u8>, ExceptionCode> {
        let Shared { bank, objects, .. } = self.shared;
        let objects = objects.as_ref().ok_or(ExceptionCode::IllegalFunction)?;
        bank.map().unit(asked.unit).ok_or(ExceptionCode::GatewayTargetDevice)?;
        let reference = asked.reference.as_ref().ok_or(ExceptionCode::IllegalDataValue)?;
        if reference.writes() && !objects.write {
            return Err(ExceptionCode::IllegalDataValue);
        }
        let action = reference.action(bank.table(), asked.unit)?;
        let outcome = objects.desk.ask(CommandSource::Modbus(self.peer.to_string()), action).await;
        let mut pdu = Vec::new();
        reference.answer(&outcome, &mut pdu)?;
        Ok(pdu)
    }

    /// Sends all answers at once.
    async fn flush(&mut self) -> Result<(), End> {
        if self.output.is_empty() {
            return Ok(());
        }
        let sent = tokio::time::timeout(self.shared.send_timeout, self.stream.write_all(&self.output)).await;
        self.output.clear();
        match sent {
            Ok(Ok(())) => Ok(()),
            Ok(Err(_)) => Err(End::Broken),
            Err(_elapsed) => Err(End::SlowClient),
        }
    }
}

#[cfg(test)]
pub(super) mod tests {
    use crate::mapping::TagTable;
    use crate::modbus::{ModbusSettings, RegisterMap};
    use crate::process_image::{ProcessImage, process_image};
    use crate::slots::Slots;

    use super::*;

    /// A gateway without nodes.
    pub(in super::super) fn shared() -> Shared {
        let table = std::sync::Arc::new(TagTable::default());
        let settings = ModbusSettings::default();
        let map = RegisterMap::build(&table, &settings, "cangate").unwrap();
        let (_, reader) = process_image(ProcessImage::default());
        Shared {
            bank: RegisterBank::new(table, map.into()),
            reader,
            clock: Clock::start(),
            counters: std::sync::Arc::default(),
            idle_timeout: None,
            partial_frame_timeout: settings.partial_frame_timeout(),
            send_timeout: settings.send_timeout(),
            objects: None,
        }
    }

    #[tokio::test(start_paused = true)]
    async fn p17_of_a_client_that_does_not_read_no_more_is_taken_than_one_buffer_of_answers() {
        let (near, mut far) = tokio::io::duplex(64);
        let shared = shared();
        let asking = tokio::spawn(async move {
            // Unit 247, the registers 0 to 99: 12 bytes for 209.
            let request = [0, 1, 0, 0, 0, 6, 247, 4, 0, 0, 0, 100];
            let mut sent = 0;
            while far.write_all(&request).await.is_ok() {
                sent += 1;
            }
            sent
        });
        let activity = Slots::new(1).take([127, 0, 0, 1].into(), ()).activity;
        let stops = Stops { evict: CancellationToken::new(), stop: CancellationToken::new() };
        let peer = SocketAddr::from(([127, 0, 0, 1], 1));
        assert_eq!(serve(near, peer, &shared, &activity, &stops).await, End::SlowClient);
        assert_eq!(shared.clock.now().instant.as_millis(), 5_000);
        let answered = usize::try_from(shared.counters.values().requests).unwrap();
        assert!(answered <= OUTPUT / 209 + 1, "{answered} answers");
        assert!(asking.await.unwrap() <= answered + INPUT / 12 + 64 / 12 + 1);
    }
}
