//! One client: reads requests, answers them in order, knows when to give up. \[IO\]
//!
//! Registers are answered at once. An object of a node takes as long as the node does; the requests behind it wait.

use std::net::SocketAddr;
use std::sync::Arc;
use std::time::Duration;

use tokio::io::{AsyncReadExt, AsyncWriteExt};

use super::accounts::{Accounts, Opened};
use super::caller::Caller;
use super::counters::{Counters, End};
use super::frame::{self, Frame, LONGEST_FRAME, Parsed};
use super::general_reference::{self, Reference};
use super::pdu::{self, ExceptionCode};
use super::register_bank::RegisterBank;
use super::service;
use super::writers::{Asking, Writers};
use crate::gateway::command::{Authority, CommandSource, Desk};
use crate::process_image::{Current, ImageReader};
use crate::slots::{Bucket, Leave, Place, Rate};
use crate::time::Clock;

/// What all connections share.
#[derive(Clone, Debug)]
pub struct Shared {
    /// Registers.
    pub bank: Arc<RegisterBank>,
    /// Values.
    pub reader: ImageReader,
    /// Time.
    pub clock: Clock,
    /// Counters.
    pub counters: Arc<Counters>,
    /// Counters of each client.
    pub accounts: Arc<Accounts>,
    /// How often a connection may ask, unless its client has a reserved place.
    pub rate: Option<Rate>,
    /// How long a connection may be silent.
    pub idle_timeout: Option<Duration>,
    /// How long a request may stay incomplete.
    pub partial_frame_timeout: Duration,
    /// How long an answer may wait.
    pub send_timeout: Duration,
    /// FC 43/13, where it is offered.
    pub objects: Option<Objects>,
    /// Who may write.
    pub writers: Option<Writers>,
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

/// Serves a client until it, the network or a time-out ends it, or its place is wanted.
pub async fn serve<S>(stream: S, peer: SocketAddr, current: &Current<Shared>, place: &Place) -> End
where
    S: AsyncReadExt + AsyncWriteExt + Unpin,
{
    serve_as(stream, peer, Caller::WITHOUT_TLS, current, place).await
}

/// The same for one of whom more is known.
pub async fn serve_as<S>(
    stream: S,
    peer: SocketAddr,
    caller: Caller,
    current: &Current<Shared>,
    place: &Place,
) -> End
where
    S: AsyncReadExt + AsyncWriteExt + Unpin,
{
    let input = vec![0; INPUT];
    let output = Vec::with_capacity(OUTPUT + LONGEST_FRAME);
    let shared = current.get();
    let account = shared.accounts.open(peer.ip());
    let (bucket, filled) = (Bucket::default(), 0);
    let mut connection =
        Connection { stream, peer, caller, account, bucket, current, shared, place, input, filled, output };
    tokio::select! {
        end = connection.run() => end,
        leave = place.must_leave() => match leave {
            Leave::Evicted => End::Evicted,
            Leave::Stopped => End::Stopped,
        },
    }
}

struct Connection<'a, S> {
    stream: S,
    peer: SocketAddr,
    caller: Caller,
    account: Opened,
    bucket: Bucket,
    current: &'a Current<Shared>,
    /// Of the moment at which the request that is worked off was looked at.
    shared: Arc<Shared>,
    place: &'a Place,
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
    /// The next request has to wait, as they come faster than they may; the answers before it are to leave.
    Wait(Duration),
    /// The next answer takes its time; those before it are to leave.
    Object(Asked),
    /// As is this one's, of a client that may write.
    Write(u16, Asking),
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
                    Progress::Wait(wait) => {
                        partial_until = None;
                        self.shared.counters.delayed();
                        self.account.delayed();
                        tokio::time::sleep(wait).await;
                    }
                    Progress::Object(asked) => {
                        partial_until = None;
                        self.answer_object(&asked).await;
                    }
                    Progress::Write(transaction, asking) => {
                        partial_until = None;
                        self.answer_write(transaction, &asking).await;
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
        self.shared = self.current.get();
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
                    if let Some(wait) = wait(&mut self.bucket, &self.shared, self.peer) {
                        break Progress::Wait(wait);
                    }
                    used += request.length();
                    if !self.caller.rights.allow(request.pdu) {
                        let (transaction, unit) = (request.transaction, request.unit);
                        let function = request.pdu.first().copied().unwrap_or_default();
                        self.tell_refused(&request, "its role has no right to this in [modbus.security]");
                        self.forbid(transaction, unit, function);
                        any = true;
                        continue;
                    }
                    if let Some(asked) = self.object_request(&request) {
                        break Progress::Object(asked);
                    }
                    if general_reference::is_general_reference(request.pdu) {
                        self.tell_refused(&request, "`canopen_objects` is \"off\"");
                    }
                    let writers = self.shared.writers.as_ref();
                    let (unit, pdu) = (request.unit, request.pdu);
                    if let Some(asking) = writers
                        .and_then(|writers| writers.take(&self.shared, (self.peer, &self.caller), unit, pdu))
                    {
                        break Progress::Write(request.transaction, asking);
                    }
                    let Shared { bank, reader, clock, .. } = &*self.shared;
                    let now = clock.now();
                    let output = &mut self.output;
                    let exception = reader.read(|image| service::answer(bank, image, now, &request, output));
                    self.count(exception);
                    self.place.touch(now.instant);
                }
            }
            any = true;
        };
        self.input.copy_within(used..self.filled, 0);
        self.filled -= used;
        progress
    }

    fn count(&self, exception: Option<ExceptionCode>) {
        self.shared.counters.request(exception);
        self.account.request(exception.is_some());
    }

    /// Answers a request that its client may not make: exception 01, before anything else is looked at (MBS R-31).
    fn forbid(&mut self, transaction: u16, unit: u8, function: u8) {
        frame::write(&mut self.output, transaction, unit, |out| {
            pdu::write_exception(out, function, ExceptionCode::IllegalFunction);
        });
        self.count(Some(ExceptionCode::IllegalFunction));
        self.shared.counters.forbidden();
        self.place.touch(self.shared.clock.now().instant);
    }

    /// Tells of a request that its client has no right to.
    fn tell_refused(&self, request: &Frame<'_>, why: &str) {
        if let Some(writers) = &self.shared.writers {
            writers.refuse((self.peer.to_string(), &self.caller), request.unit, request.pdu, why);
        }
    }

    /// Whether a request is for an object, and is to be asked of the gateway. One that is wrong is answered at once.
    fn object_request(&self, request: &Frame<'_>) -> Option<Asked> {
        self.shared.objects.as_ref().filter(|_| general_reference::is_general_reference(request.pdu))?;
        let reference = general_reference::decode(request.pdu).ok();
        Some(Asked { transaction: request.transaction, unit: request.unit, reference })
    }

    /// Appends the answer to a request for an object, once the gateway has given it.
    async fn answer_object(&mut self, asked: &Asked) {
        // While the device is asked, which can take seconds, its client is not one that has long been silent.
        self.place.touch(self.shared.clock.now().instant);
        let result = self.ask_for_object(asked).await;
        let mut exception = None;
        frame::write(&mut self.output, asked.transaction, asked.unit, |out| match result {
            Ok(pdu) => out.extend_from_slice(&pdu),
            Err(code) => {
                pdu::write_exception(out, pdu::ENCAPSULATED, code);
                exception = Some(code);
            }
        });
        self.count(exception);
        self.place.touch(self.shared.clock.now().instant);
    }

    /// In the order of the other functions: unit (0B), value (03), address (02).
    async fn ask_for_object(&self, asked: &Asked) -> Result<Vec<u8>, ExceptionCode> {
        let Shared { bank, objects, .. } = &*self.shared;
        let objects = objects.as_ref().ok_or(ExceptionCode::IllegalFunction)?;
        bank.map().unit(asked.unit).ok_or(ExceptionCode::GatewayTargetDevice)?;
        let reference = asked.reference.as_ref().ok_or(ExceptionCode::IllegalDataValue)?;
        let source = CommandSource::modbus(self.peer.to_string());
        if reference.writes() && !objects.write {
            let text = format!("{}: `canopen_objects` is \"read\"", reference.object());
            objects.desk.refuse(source, "sdo_write", text);
            return Err(ExceptionCode::IllegalDataValue);
        }
        let action = reference.action(bank.table(), asked.unit)?;
        let opened = Authority::Objects { write: objects.write };
        let outcome = objects.desk.ask(source, &opened, action).await;
        let mut pdu = Vec::new();
        reference.answer(&outcome, &mut pdu)?;
        Ok(pdu)
    }

    /// Appends the answer to a write, once the gateway has given it.
    async fn answer_write(&mut self, transaction: u16, asking: &Asking) {
        self.place.touch(self.shared.clock.now().instant);
        let result = match &self.shared.writers {
            Some(writers) => writers.answer(&self.shared, asking).await,
            None => Err(ExceptionCode::IllegalFunction),
        };
        let function = asking.pdu.first().copied().unwrap_or_default();
        frame::write(&mut self.output, transaction, asking.unit, |out| match &result {
            Ok(pdu) => out.extend_from_slice(pdu),
            Err(code) => pdu::write_exception(out, function, *code),
        });
        self.count(result.err());
        self.place.touch(self.shared.clock.now().instant);
    }

    /// Sends all answers at once.
    async fn flush(&mut self) -> Result<(), End> {
        if self.output.is_empty() {
            return Ok(());
        }
        let sending = async {
            self.stream.write_all(&self.output).await?;
            // What TLS has made of it must leave too.
            self.stream.flush().await
        };
        let sent = tokio::time::timeout(self.shared.send_timeout, sending).await;
        self.output.clear();
        match sent {
            Ok(Ok(())) => Ok(()),
            Ok(Err(_)) => Err(End::Broken),
            Err(_elapsed) => Err(End::SlowClient),
        }
    }
}

/// How long the next request has to wait; `None`: it was taken.
fn wait(bucket: &mut Bucket, shared: &Shared, peer: SocketAddr) -> Option<Duration> {
    let rate = shared.rate.filter(|_| !shared.accounts.is_reserved(Some(peer.ip())))?;
    bucket.take(shared.clock.now().instant, rate).err()
}

#[cfg(test)]
mod tests {
    use crate::mapping::Sketch;
    use crate::modbus::ModbusSettings;
    use crate::modbus::fixture::{shared, shared_of};
    use crate::slots::{Clients, Limits, ServerName};

    use super::*;

    const HOST: std::net::IpAddr = std::net::IpAddr::V4(std::net::Ipv4Addr::LOCALHOST);

    fn clients(places: usize) -> Clients {
        let stop = tokio_util::sync::CancellationToken::new();
        Clients::new(ServerName::new("Modbus", "[modbus]"), Limits::places(places), stop)
    }

    #[tokio::test(start_paused = true)]
    async fn who_waits_for_an_object_is_not_taken_for_one_who_never_asked() {
        let (near, mut far) = tokio::io::duplex(64);
        let (desk, mut commands) = Desk::new(1);
        let table = Sketch::new().node("node001", 1, "danfoss-dst-p92c", |_| ()).build().unwrap().0;
        let shared = Shared { objects: Some(Objects { desk, write: false }), ..shared_of(table) };
        let clients = clients(2);
        let [asks, sits_there] = [(); 2].map(|()| clients.take(HOST));
        let peer = SocketAddr::new(HOST, 1);
        let serving = tokio::spawn(async move { serve(near, peer, &shared.into(), &asks).await });
        // Unit 1, object 0x1000 of node 1.
        far.write_all(&[0, 1, 0, 0, 0, 13, 1, 0x2B, 0x0D, 0, 0, 1, 0x10, 0, 0, 0, 0, 0, 4]).await.unwrap();
        let waiting = commands.recv().await.unwrap();
        let _newcomer = clients.take(HOST);
        assert_eq!(sits_there.must_leave().await, Leave::Evicted);
        drop((waiting, far));
        assert_ne!(serving.await.unwrap(), End::Evicted);
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
        let (place, peer) = (clients(1).take(HOST), SocketAddr::new(HOST, 1));
        assert_eq!(serve(near, peer, &shared.clone().into(), &place).await, End::SlowClient);
        assert_eq!(shared.clock.now().instant.as_millis(), 5_000);
        let answered = usize::try_from(shared.counters.values().requests).unwrap();
        assert!(answered <= OUTPUT / 209 + 1, "{answered} answers");
        assert!(asking.await.unwrap() <= answered + INPUT / 12 + 64 / 12 + 1);
    }

    #[tokio::test(start_paused = true)]
    async fn cr_7_1_who_asks_faster_than_it_may_is_answered_later_and_in_full_but_reserved_clients_at_once() {
        for (reserved, millis, delayed) in [(vec![], 1_500, 15), (vec!["127.0.0.1".parse().unwrap()], 0, 0)] {
            let settings = ModbusSettings { max_requests_per_s: 10, reserved, ..ModbusSettings::default() };
            let accounts = Accounts::new(settings.reserved.clone()).into();
            let shared = Shared { rate: settings.rate(), accounts, ..shared() };
            let (near, mut far) = tokio::io::duplex(4_096);
            let (place, peer, current) =
                (clients(1).take(HOST), SocketAddr::new(HOST, 1), shared.clone().into());
            let clock = shared.clock;
            let asking = async move {
                // Unit 247, the test pattern: 12 bytes for 11.
                far.write_all(&[0, 1, 0, 0, 0, 6, 247, 4, 0, 90, 0, 1].repeat(25)).await.unwrap();
                let mut answers = vec![0; 25 * 11];
                far.read_exact(&mut answers).await.unwrap();
                (answers, clock.now().instant.as_millis())
            };
            let (end, (answers, at)) = tokio::join!(serve(near, peer, &current, &place), asking);
            assert_eq!((end, at), (End::Closed, millis));
            assert_eq!(answers, [0, 1, 0, 0, 0, 5, 247, 4, 2, 0x12, 0x34].repeat(25));
            let (values, client) = (shared.counters.values(), shared.accounts.values()[0]);
            assert_eq!((values.requests, values.exceptions), (25, [0; 12]));
            assert_eq!((values.delayed, client.delayed), (delayed, delayed));
        }
    }
}
