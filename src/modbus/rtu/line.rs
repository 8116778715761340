//! Answers what is asked on one serial line. \[IO\]

use std::collections::BTreeSet;
use std::io;
use std::time::Duration;

use tokio::io::{AsyncRead, AsyncReadExt, AsyncWrite, AsyncWriteExt};
use tokio_util::sync::CancellationToken;

use super::receiver::{self, LONGEST, Receiver, Request};
use super::settings::RtuSettings;
use crate::modbus::caller::Caller;
use crate::modbus::connection::Shared;
use crate::modbus::frame::Frame;
use crate::modbus::writers::is_write;
use crate::modbus::{general_reference, service};
use crate::process_image::Current;

/// A port that cannot be opened, or has gone, is tried again after this time.
const TRY_AGAIN: Duration = Duration::from_secs(2);
/// A port that held for this long works: its troubles are over.
const STEADY: Duration = Duration::from_secs(60);
/// Causes of trouble that are told of; when there are more, further ones are not.
const MOST_CAUSES: usize = 8;
/// What stands before the unit id in an answer by TCP.
const TCP_HEADER: usize = 6;

/// Why a port did not work since it last did, so that one that comes and goes does not fill the log.
#[derive(Debug, Default)]
struct Troubles(BTreeSet<String>);

impl Troubles {
    /// Whether to tell of this cause.
    fn is_news(&mut self, cause: &str) -> bool {
        self.0.len() < MOST_CAUSES && self.0.insert(cause.to_owned())
    }

    /// Whether there were any; there are none any more.
    fn end(&mut self) -> bool {
        !std::mem::take(&mut self.0).is_empty()
    }
}

/// Answers until `stop`, whatever becomes of the port.
pub async fn run(settings: RtuSettings, shared: Current<Shared>, stop: CancellationToken) {
    let device = settings.device.display().to_string();
    tracing::info!(device, baud = settings.baud, parity = ?settings.parity, "Modbus RTU");
    let mut troubles = Troubles::default();
    loop {
        let ended = match open(&settings) {
            Ok(port) => {
                let serving = serve(port, &shared, &device, settings.pause());
                tokio::select! {
                    () = stop.cancelled() => return,
                    error = hold(serving, &device, &mut troubles) => error,
                }
            }
            Err(error) => error,
        };
        let text = ended.to_string();
        if troubles.is_news(&text) {
            tracing::warn!(
                device,
                "no Modbus RTU: {text}; check `device` in [[modbus.rtu]], that it is plugged in, and that the user of the gateway \
                 may use it (on Debian: is in the group `dialout`); tried again every {} s",
                TRY_AGAIN.as_secs()
            );
        }
        tokio::select! {
            () = stop.cancelled() => return,
            () = tokio::time::sleep(TRY_AGAIN) => {}
        }
    }
}

/// Serves until the port breaks; tells when it is over its troubles.
async fn hold(serving: impl Future<Output = io::Error>, device: &str, troubles: &mut Troubles) -> io::Error {
    let mut serving = std::pin::pin!(serving);
    tokio::select! {
        error = &mut serving => return error,
        () = tokio::time::sleep(STEADY) => {}
    }
    if troubles.end() {
        tracing::info!(device, "Modbus RTU has worked for {} s again", STEADY.as_secs());
    }
    serving.await
}

#[cfg(feature = "serial")]
fn open(settings: &RtuSettings) -> io::Result<tokio_serial::SerialStream> {
    use tokio_serial::{Parity, SerialPortBuilderExt, StopBits};

    use super::settings::Parity as Wanted;
    let (parity, stop_bits) = match settings.parity {
        Wanted::Even => (Parity::Even, StopBits::One),
        Wanted::Odd => (Parity::Odd, StopBits::One),
        Wanted::None => (Parity::None, StopBits::Two),
    };
    let device = settings.device.to_string_lossy();
    let port = tokio_serial::new(device, settings.baud).parity(parity).stop_bits(stop_bits);
    Ok(port.open_native_async()?)
}

#[cfg(not(feature = "serial"))]
fn open(_: &RtuSettings) -> io::Result<tokio::io::DuplexStream> {
    Err(io::Error::other("this cangate was built without serial ports (feature `serial`)"))
}

/// Answers until the port breaks; why it did.
async fn serve(
    mut port: impl AsyncRead + AsyncWrite + Unpin,
    current: &Current<Shared>,
    device: &str,
    pause: Duration,
) -> io::Error {
    let mut receiver = Receiver::default();
    let mut buffer = [0; LONGEST];
    let mut discarded = 0;
    loop {
        let read = port.read(&mut buffer);
        let read =
            if receiver.is_waiting() { tokio::time::timeout(pause, read).await } else { Ok(read.await) };
        let request = match read {
            Err(_elapsed) => receiver.handle_pause(),
            Ok(Ok(0)) => return io::ErrorKind::UnexpectedEof.into(),
            Ok(Ok(count)) => {
                receiver.handle_bytes(buffer.get(..count).unwrap_or_default());
                receiver.poll_output()
            }
            Ok(Err(error)) => return error,
        };
        let shared = current.get();
        shared.counters.rtu_discarded(receiver.discarded().saturating_sub(discarded));
        discarded = receiver.discarded();
        let Some(answer) = request.and_then(|request| answer(&shared, device, &request)) else { continue };
        receiver.handle_sent(&answer);
        let sent = tokio::time::timeout(shared.send_timeout, port.write_all(&answer)).await;
        match sent {
            Ok(Ok(())) => {}
            Ok(Err(error)) => return error,
            Err(_elapsed) => return io::ErrorKind::TimedOut.into(),
        }
    }
}

/// The answer, with its check; `None` where none is due: a request for all units, or for a unit that is not ours.
fn answer(shared: &Shared, device: &str, request: &Request) -> Option<Vec<u8>> {
    let Shared { bank, reader, clock, counters, writers, .. } = shared;
    if matches!(request.unit, 0 | 255) || bank.map().unit(request.unit).is_none() {
        return None;
    }
    let asked = Frame { transaction: 0, unit: request.unit, pdu: &request.pdu };
    let changes = is_write(asked.pdu) || general_reference::is_general_reference(asked.pdu);
    if let Some(writers) = writers.as_ref().filter(|_| changes) {
        let client = (device.to_owned(), &Caller::WITHOUT_TLS);
        writers.refuse(client, asked.unit, asked.pdu, "serial lines are for reading");
    }
    let mut out = Vec::with_capacity(TCP_HEADER + LONGEST);
    let exception = reader.read(|image| service::answer(bank, image, clock.now(), &asked, &mut out));
    counters.request(exception);
    out.drain(..TCP_HEADER);
    receiver::close(&mut out);
    Some(out)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::modbus::fixture;

    async fn ask(far: &mut tokio::io::DuplexStream, body: &[u8]) -> Option<Vec<u8>> {
        let mut request = body.to_vec();
        receiver::close(&mut request);
        far.write_all(&request).await.unwrap();
        let mut answer = vec![0; LONGEST];
        let count = tokio::time::timeout(Duration::from_secs(1), far.read(&mut answer)).await.ok()?.unwrap();
        answer.truncate(count);
        Some(answer)
    }

    #[tokio::test(start_paused = true)]
    async fn a_port_that_comes_and_goes_is_told_of_once_for_each_cause_until_it_has_held_for_a_minute() {
        let mut troubles = Troubles::default();
        let breaks_after = |secs| async move {
            tokio::time::sleep(Duration::from_secs(secs)).await;
            io::Error::from(io::ErrorKind::UnexpectedEof)
        };
        let mut told = 0;
        for _ in 0..1000 {
            told += usize::from(troubles.is_news("No such file or directory"));
            let error = hold(breaks_after(1), "x", &mut troubles).await;
            told += usize::from(troubles.is_news(&error.to_string()));
        }
        assert_eq!(told, 2);
        hold(breaks_after(61), "x", &mut troubles).await;
        assert!(troubles.is_news("No such file or directory"), "a new trouble");
        let news = (0..1000).filter(|cause| troubles.is_news(&cause.to_string())).count();
        assert_eq!(news, MOST_CAUSES - 1);
    }

    #[test]
    fn writes_and_objects_are_refused_and_told_of_but_not_those_of_other_devices() {
        let (desk, _queue) = crate::gateway::Desk::new(1);
        let writers = crate::modbus::writers::Writers::new(desk.clone());
        let shared = Shared { writers: Some(writers), ..fixture::shared() };
        let ask = |unit, pdu: &[u8]| answer(&shared, "/dev/ttyS0", &Request { unit, pdu: pdu.to_vec() });
        assert_eq!(ask(247, &[6, 0, 90, 0, 1]).unwrap()[..3], [247, 0x86, 2]);
        assert_eq!(ask(247, &[43, 13, 1, 0, 1, 0x20, 0, 0, 0, 0, 0, 1, 7]).unwrap()[..3], [247, 0xAB, 1]);
        assert_eq!(ask(9, &[6, 0, 90, 0, 1]), None);
        assert!(ask(247, &[4, 0, 90, 0, 1]).is_some());
        assert_eq!(desk.refused()[0].1, 2);
    }

    #[tokio::test(start_paused = true)]
    async fn registers_are_read_as_by_tcp_and_other_units_are_left_to_their_devices() {
        let (near, mut far) = tokio::io::duplex(1024);
        let shared = Current::new(fixture::shared());
        let serving = tokio::spawn(async move {
            (serve(near, &shared, "x", Duration::from_millis(22)).await, shared.get())
        });
        // The test pattern of the gateway: 0x1234.
        let mut expected = vec![247, 4, 2, 0x12, 0x34];
        receiver::close(&mut expected);
        assert_eq!(ask(&mut far, &[247, 4, 0, 90, 0, 1]).await, Some(expected));
        let mut refused = vec![247, 0x84, 2];
        receiver::close(&mut refused);
        assert_eq!(ask(&mut far, &[247, 4, 0xFF, 0, 0, 1]).await, Some(refused));
        for unit in [0, 255, 9] {
            assert_eq!(ask(&mut far, &[unit, 4, 0, 90, 0, 1]).await, None, "unit {unit}");
        }
        far.write_all(b"noise").await.unwrap();
        tokio::time::sleep(Duration::from_millis(30)).await;
        assert!(ask(&mut far, &[247, 4, 0, 90, 0, 1]).await.is_some(), "after noise and a pause");
        drop(far);
        let (error, shared) = serving.await.unwrap();
        assert_eq!(error.kind(), io::ErrorKind::UnexpectedEof);
        assert_eq!((shared.counters.values().requests, shared.counters.values().rtu_discarded), (3, 1));
    }
}
