//! Tests of LAWICEL adapters: the test is the adapter, in memory, behind TCP or on a pseudo-terminal.

use nix::sys::socket::getsockopt;
use tokio::io::{AsyncBufReadExt, AsyncReadExt, AsyncWriteExt, BufReader, DuplexStream};

use super::*;
use crate::can::Link;

/// The test's side of an adapter.
struct Played<P> {
    port: BufReader<P>,
}

impl<P: AsyncRead + AsyncWrite + Unpin> Played<P> {
    fn new(port: P) -> Self {
        Self { port: BufReader::new(port) }
    }

    /// The next line, without its carriage return.
    async fn line(&mut self) -> String {
        let mut line = Vec::new();
        self.port.read_until(b'\r', &mut line).await.unwrap();
        assert_eq!(line.pop(), Some(b'\r'), "the gateway hung up");
        String::from_utf8(line).unwrap()
    }

    /// The next command; questions for flags are not answered.
    async fn command(&mut self) -> String {
        loop {
            let line = self.line().await;
            if !line.is_empty() && line != "F" {
                return line;
            }
        }
    }

    /// Waits for the next question for flags; there must be no command before it.
    async fn question(&mut self) {
        assert_eq!(self.line().await, "F");
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

fn adapter(bit_rate: Option<u32>) -> Adapter {
    Adapter { name: "slcan:test".to_owned(), bit_rate, listen_only: false }
}

/// The task's side, on a port in memory.
fn on_duplex(bit_rate: Option<u32>) -> (Played<DuplexStream>, SlcanReader, SlcanWriter) {
    on_duplex_of(1_024, bit_rate)
}

/// The same, on a port that holds so many bytes that nobody has read.
fn on_duplex_of(bytes: usize, bit_rate: Option<u32>) -> (Played<DuplexStream>, SlcanReader, SlcanWriter) {
    let (near, far) = tokio::io::duplex(bytes);
    let (reader, writer) = start(adapter(bit_rate), Clock::start(), async { Ok(near) });
    (Played::new(far), reader, writer)
}

async fn next_link(reader: &mut SlcanReader) -> Link {
    let event = reader.recv().await.unwrap();
    let BusEvent::Link { link, .. } = event else { panic!("no link: {event:?}") };
    link
}

async fn next_frame(reader: &mut SlcanReader) -> String {
    let event = reader.recv().await.unwrap();
    let BusEvent::Frame { frame, .. } = event else { panic!("no frame: {event:?}") };
    frame.to_string()
}

fn frame(text: &str) -> CanFrame {
    text.parse().unwrap()
}

#[tokio::test(start_paused = true)]
async fn r_det_089_the_adapter_is_closed_set_to_its_bit_rate_and_opened() {
    let (mut played, mut reader, _writer) = on_duplex(Some(125_000));
    played.set_up(Some("S4")).await;
    assert_eq!(next_link(&mut reader).await, Link::ErrorActive);
    assert_eq!(reader.tally().bit_rate, Some(125_000));
}

#[tokio::test(start_paused = true)]
async fn the_passive_role_opens_an_adapter_to_listen_only_or_not_at_all() {
    let passive = || {
        let (near, far) = tokio::io::duplex(1_024);
        let adapter = Adapter { listen_only: true, ..adapter(Some(125_000)) };
        let (reader, writer) = start(adapter, Clock::start(), async { Ok(near) });
        (Played::new(far), reader, writer)
    };
    for (answer, opens) in [("\r", true), ("\x07", false)] {
        let (mut played, mut reader, _writer) = passive();
        assert_eq!(played.command().await, "C");
        played.say("\r").await;
        assert_eq!(played.command().await, "S4");
        played.say("\r").await;
        assert_eq!(played.command().await, "L");
        played.say(answer).await;
        if opens {
            assert_eq!(next_link(&mut reader).await, Link::ErrorActive);
            continue;
        }
        let error = reader.recv().await.unwrap_err().to_string();
        assert!(error.contains("refuses to listen only"), "{error}");
        let mut rest = Vec::new();
        played.port.read_to_end(&mut rest).await.unwrap();
        assert_eq!(rest, b"", "it hangs up and does not try `O`");
    }
}

#[tokio::test(start_paused = true)]
async fn frames_go_both_ways() {
    let (mut played, mut reader, mut writer) = on_duplex(None);
    played.set_up(None).await;
    played.say("t18120102\rr70").await;
    played.say("11\rT000001810\r").await;
    assert_eq!(next_link(&mut reader).await, Link::ErrorActive);
    assert_eq!(next_frame(&mut reader).await, "181#0102");
    assert_eq!(next_frame(&mut reader).await, "701#R1");
    assert_eq!(next_frame(&mut reader).await, "00000181#");
    writer.send(&frame("701#R1")).await.unwrap();
    writer.send(&frame("000#0101")).await.unwrap();
    assert_eq!(played.command().await, "r7011");
    assert_eq!(played.command().await, "t00020101");
}

#[tokio::test(start_paused = true)]
async fn an_adapter_that_never_answers_is_used_all_the_same() {
    let (mut played, mut reader, mut writer) = on_duplex(Some(250_000));
    for command in ["C", "S5", "O"] {
        assert_eq!(played.command().await, command);
    }
    assert_eq!(next_link(&mut reader).await, Link::ErrorActive);
    tokio::time::sleep(Duration::from_secs(60)).await;
    played.say("t18110A\r").await;
    assert_eq!(next_frame(&mut reader).await, "181#0A");
    writer.send(&frame("000#0101")).await.unwrap();
    assert_eq!(played.command().await, "t00020101");
}

#[tokio::test(start_paused = true)]
async fn a_refused_bit_rate_ends_the_bus_and_names_the_command() {
    let (mut played, mut reader, _writer) = on_duplex(Some(800_000));
    assert_eq!(played.command().await, "C");
    assert_eq!(played.command().await, "S7");
    played.say("\x07").await;
    let error = reader.recv().await.unwrap_err().to_string();
    assert!(error.contains("refuses the command `S7`"), "{error}");
}

#[tokio::test(start_paused = true)]
async fn p20_a_frame_that_the_adapter_refuses_is_given_back() {
    let (mut played, mut reader, mut writer) = on_duplex(None);
    played.set_up(None).await;
    assert_eq!(next_link(&mut reader).await, Link::ErrorActive);
    played.say("F00\r").await;
    for text in ["000#0101", "701#R1", "000#0102"] {
        writer.send(&frame(text)).await.unwrap();
        played.command().await;
    }
    played.say("z\r\x07\r").await;
    let event = reader.recv().await.unwrap();
    assert!(matches!(event, BusEvent::NotSent { frame: back, .. } if back == frame("701#R1")));
}

#[tokio::test(start_paused = true)]
async fn status_flags_tell_error_passive_errors_and_losses() {
    let (mut played, mut reader, _writer) = on_duplex(None);
    played.set_up(None).await;
    assert_eq!(next_link(&mut reader).await, Link::ErrorActive);
    played.say("FA8\r").await;
    assert_eq!(next_link(&mut reader).await, Link::ErrorPassive);
    played.say("F00\r").await;
    assert_eq!(next_link(&mut reader).await, Link::ErrorActive);
    let tally = reader.tally();
    assert_eq!((tally.error_frames, tally.overruns), (1, 1));
}

#[tokio::test(start_paused = true)]
async fn bus_off_ends_with_the_next_frame() {
    let (mut played, mut reader, _writer) = on_duplex(None);
    played.set_up(None).await;
    assert_eq!(next_link(&mut reader).await, Link::ErrorActive);
    played.say("sb000256\rF00\rt1810\r").await;
    assert_eq!(next_link(&mut reader).await, Link::BusOff);
    assert_eq!(next_link(&mut reader).await, Link::ErrorActive);
    assert_eq!(next_frame(&mut reader).await, "181#");
}

#[tokio::test(start_paused = true)]
async fn an_adapter_that_stops_answering_is_given_up() {
    let (mut played, mut reader, _writer) = on_duplex(None);
    played.set_up(None).await;
    assert_eq!(next_link(&mut reader).await, Link::ErrorActive);
    played.say("F00\r").await;
    let error = reader.recv().await.unwrap_err().to_string();
    assert!(error.contains("does not answer any more"), "{error}");
}

#[tokio::test(start_paused = true)]
async fn an_adapter_behind_a_slow_link_may_answer_late() {
    let (mut played, mut reader, _writer) = on_duplex(Some(125_000));
    assert_eq!(played.command().await, "C");
    tokio::time::sleep(Duration::from_millis(120)).await;
    // A frame of a channel that is still open; the refusal, or what there is of an answer, comes later.
    played.say("t7FF0\r").await;
    tokio::time::sleep(Duration::from_millis(120)).await;
    played.say("\x07").await;
    assert_eq!(played.command().await, "S4");
    played.say("\r").await;
    assert_eq!(played.command().await, "O");
    played.say("\r").await;
    assert_eq!(next_link(&mut reader).await, Link::ErrorActive);
}

#[tokio::test(start_paused = true)]
async fn p21_an_adapter_that_was_reset_is_opened_again() {
    let (mut played, mut reader, _writer) = on_duplex(None);
    played.set_up(None).await;
    assert_eq!(next_link(&mut reader).await, Link::ErrorActive);
    for answer in ["F00\r", "F00\r", "\x07", "\x07"] {
        played.question().await;
        played.say(answer).await;
    }
    let error = reader.recv().await.unwrap_err();
    assert!(error.to_string().contains("closed its channel"), "{error}");
}

#[tokio::test(start_paused = true)]
async fn p21_an_adapter_that_starts_when_its_port_is_opened_is_set_up_when_it_has_started() {
    let (mut played, mut reader, mut writer) = on_duplex(Some(125_000));
    for swallowed in ["C", "S4", "O"] {
        assert_eq!(played.command().await, swallowed);
    }
    assert_eq!(next_link(&mut reader).await, Link::ErrorActive);
    played.question().await;
    played.question().await;
    played.say("\x07").await;
    played.set_up(Some("S4")).await;
    assert_eq!(next_link(&mut reader).await, Link::ErrorActive);
    writer.send(&frame("000#0101")).await.unwrap();
    assert_eq!(played.command().await, "t00020101");
}

#[tokio::test(start_paused = true)]
async fn the_channel_is_opened_anew_when_the_controller_stays_off_the_bus() {
    let (mut played, mut reader, _writer) = on_duplex(Some(125_000));
    played.set_up(Some("S4")).await;
    assert_eq!(next_link(&mut reader).await, Link::ErrorActive);
    played.say("sb000256\r").await;
    assert_eq!(next_link(&mut reader).await, Link::BusOff);
    played.set_up(Some("S4")).await;
    assert_eq!(next_link(&mut reader).await, Link::ErrorActive);
}

#[tokio::test(start_paused = true)]
async fn p20_frames_that_wait_when_the_adapter_is_lost_are_given_back() {
    let (mut played, mut reader, mut writer) = on_duplex_of(64, None);
    played.set_up(None).await;
    assert_eq!(next_link(&mut reader).await, Link::ErrorActive);
    let mut taken = 0;
    while writer.send(&frame("701#R1")).await.is_ok() {
        taken += 1;
    }
    let mut given_back = 0;
    let error = loop {
        match reader.recv().await {
            Ok(BusEvent::NotSent { frame: back, .. }) if back == frame("701#R1") => given_back += 1,
            Ok(other) => panic!("{other:?}"),
            Err(error) => break error,
        }
    };
    assert!(matches!(error, BusError::Absent { .. }), "{error}");
    assert!(taken > FRAMES + 1, "{taken} frames were taken");
    assert_eq!(given_back, FRAMES + 1, "the queue, and one that was being written");
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
    let port = listener.local_addr().unwrap().port();
    let (mut reader, mut writer) = open_tcp(adapter(Some(500_000)), "127.0.0.1".into(), port, Clock::start());
    let mut played = Played::new(listener.accept().await.unwrap().0);
    played.set_up(Some("S6")).await;
    assert_eq!(next_link(&mut reader).await, Link::ErrorActive);
    writer.send(&frame("000#0101")).await.unwrap();
    assert_eq!(played.command().await, "t00020101");
    played.say("t18110A\r").await;
    assert_eq!(next_frame(&mut reader).await, "181#0A");
    drop(played);
    assert!(matches!(reader.recv().await, Err(BusError::Absent { .. })));
    assert!(writer.send(&frame("000#0101")).await.is_err());
}

#[tokio::test]
async fn a_tcp_connection_that_is_half_open_is_noticed_after_ten_seconds() {
    let listener = tokio::net::TcpListener::bind("127.0.0.1:0").await.unwrap();
    let stream = connect("127.0.0.1", listener.local_addr().unwrap().port()).await.unwrap();
    assert!(getsockopt(&stream, sockopt::KeepAlive).unwrap());
    let idle = getsockopt(&stream, sockopt::TcpKeepIdle).unwrap();
    let interval = getsockopt(&stream, sockopt::TcpKeepInterval).unwrap();
    assert_eq!(idle + interval * getsockopt(&stream, sockopt::TcpKeepCount).unwrap(), 10);
    assert_eq!(getsockopt(&stream, sockopt::TcpUserTimeout).unwrap(), 10_000);
}

#[tokio::test]
async fn nobody_behind_the_tcp_port_is_an_absent_interface() {
    let listener = tokio::net::TcpListener::bind("127.0.0.1:0").await.unwrap();
    let port = listener.local_addr().unwrap().port();
    drop(listener);
    let (mut reader, _writer) = open_tcp(adapter(None), "127.0.0.1".into(), port, Clock::start());
    assert!(matches!(reader.recv().await, Err(BusError::Absent { .. })));
}

#[cfg(feature = "serial")]
#[tokio::test]
async fn p21_an_adapter_on_a_serial_port_is_reached_and_its_unplugging_is_noticed() {
    use tokio_serial::SerialPort;
    let (near, far) = tokio_serial::SerialStream::pair().unwrap();
    let device = far.name().unwrap();
    drop(far);
    let open = || open_serial(adapter(Some(250_000)), device.clone(), 115_200, Clock::start());
    let (mut reader, mut writer) = open();
    let mut played = Played::new(near);
    played.set_up(Some("S5")).await;
    assert_eq!(next_link(&mut reader).await, Link::ErrorActive);
    played.say("r7011\r").await;
    assert_eq!(next_frame(&mut reader).await, "701#R1");
    writer.send(&frame("701#R1")).await.unwrap();
    assert_eq!(played.command().await, "r7011");
    drop(played);
    assert!(matches!(reader.recv().await, Err(BusError::Absent { .. })));
    let (mut reader, _writer) = open();
    assert!(matches!(reader.recv().await, Err(BusError::Absent { .. })), "it is not there any more");
}
