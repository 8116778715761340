//! Tests of [`super`].

use super::*;
use crate::can::virtual_bus;
use crate::can::{BusReader, BusWriter};

/// Asks by a guard request and ends with the first answer, or with nothing.
struct Guard {
    requests: u32,
    due: Option<Instant>,
    outputs: Vec<Step<Option<String>>>,
}

impl Machine for Guard {
    type Output = Option<String>;

    fn handle_frame(&mut self, _: Now, frame: &CanFrame) {
        self.outputs.push(Step::Done(Some(frame.to_string())));
    }

    fn handle_not_sent(&mut self, _: Now, _: &CanFrame) {
        self.outputs.push(Step::Done(None));
    }

    fn handle_timeout(&mut self, now: Now) {
        if self.requests == 3 {
            self.outputs.push(Step::Done(None));
            return;
        }
        self.requests += 1;
        self.due = Some(now.instant + Duration::from_millis(500));
        self.outputs.push(Step::Transmit("701#R1".parse().unwrap()));
    }

    fn poll_output(&mut self) -> Option<Step<Self::Output>> {
        self.outputs.pop()
    }

    fn poll_timeout(&self) -> Option<Instant> {
        self.due
    }
}

fn guard() -> Guard {
    Guard { requests: 0, due: Some(Instant::START), outputs: Vec::new() }
}

async fn open(
    name: &str,
    listen_only: bool,
) -> (Session, virtual_bus::VirtualReader, virtual_bus::VirtualWriter) {
    let clock = Clock::start();
    let (reader, writer) = virtual_bus::join(name, clock);
    let interface = format!("virtual:{name}").parse().unwrap();
    let session = Session::open(&interface, listen_only, clock, CancellationToken::new()).await.unwrap();
    (session, reader, writer)
}

async fn heard(reader: &mut virtual_bus::VirtualReader) -> String {
    loop {
        if let BusEvent::Frame { frame, .. } = reader.recv().await.unwrap() {
            return frame.to_string();
        }
    }
}

#[tokio::test(start_paused = true)]
async fn a_machine_runs_to_its_end_over_a_bus() {
    let (mut session, mut reader, mut writer) = open("session-answer", false).await;
    let device = tokio::spawn(async move {
        assert_eq!(heard(&mut reader).await, "701#R1");
        writer.send(&"701#7F".parse().unwrap()).await.unwrap();
    });
    assert_eq!(session.run(&mut guard()).await.unwrap().as_deref(), Some("701#7F"));
    device.await.unwrap();
    session.close().await.unwrap();
}

#[tokio::test(start_paused = true)]
async fn a_machine_that_nobody_answers_ends_by_its_own_time_limits() {
    let (mut session, _reader, _writer) = open("session-silence", false).await;
    let mut machine = guard();
    assert_eq!(session.run(&mut machine).await.unwrap(), None);
    assert_eq!(machine.requests, 3);
    assert!(session.clock.now().instant >= Instant::from_millis(1500));
}

#[tokio::test(start_paused = true)]
async fn a_session_that_only_listens_cannot_send() {
    let (mut session, mut reader, _writer) = open("session-listens", true).await;
    assert!(matches!(session.send("000#0100".parse().unwrap()), Err(SessionError::ListensOnly { .. })));
    assert_eq!(session.run(&mut guard()).await.unwrap(), None, "the machine learns that nothing left");
    session.close().await.unwrap();
    let silence = tokio::time::timeout(Duration::from_secs(10), heard(&mut reader)).await;
    assert!(silence.is_err(), "{silence:?}");
}

#[tokio::test(start_paused = true)]
async fn closing_waits_until_all_frames_have_left() {
    let (session, mut reader, _writer) = open("session-close", false).await;
    for _ in 0..100 {
        session.send("000#0101".parse().unwrap()).unwrap();
    }
    session.close().await.unwrap();
    for _ in 0..100 {
        assert_eq!(heard(&mut reader).await, "000#0101");
    }
}

#[tokio::test(start_paused = true)]
async fn a_signal_ends_a_machine_that_waits() {
    let clock = Clock::start();
    let stop = CancellationToken::new();
    let interface = "virtual:session-stop".parse().unwrap();
    let mut session = Session::open(&interface, false, clock, stop.clone()).await.unwrap();
    stop.cancel();
    assert!(matches!(session.run(&mut guard()).await, Err(SessionError::Stopped)));
}

#[tokio::test(start_paused = true)]
async fn an_interface_that_is_not_there_is_given_up_after_three_seconds_with_the_way_to_mend_it() {
    let clock = Clock::start();
    let interface: Interface = "nocan77".parse().unwrap();
    let error = Session::open(&interface, false, clock, CancellationToken::new()).await.unwrap_err();
    assert_eq!(error.exit(), Exit::Io);
    assert!(error.to_string().contains("`nocan77` is not there"), "{error}");
    let down = SessionError::NotUp { interface: "can0".to_owned(), link: Link::Down }.to_string();
    assert!(down.contains("`ip link set can0 up type can bitrate"), "{down}");
}

#[test]
fn a_bus_inside_the_process_is_refused() {
    let error = check_company(&"virtual:demo".parse().unwrap()).unwrap_err();
    assert_eq!(error.exit(), Exit::Usage);
    assert!(check_company(&"can0".parse().unwrap()).is_ok());
}
