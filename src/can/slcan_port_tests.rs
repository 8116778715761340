//! Tests of LAWICEL adapters: the test is the adapter, in memory, behind TCP or on a pseudo-terminal.

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
    let desk = Arc::new(Desk { name: name.clone(), clock: Clock::start(), events, state: Mutex::default() });
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
