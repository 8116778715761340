//! SocketCAN without the program around it: what the kernel does to an open socket, and what we make of it.

use std::fs;
use std::future::Future;
use std::process::{Child, Command};
use std::time::Duration;

use cangate::can::task;
use cangate::can::{
    AnyReader, AnyWriter, BusError, BusEvent, BusIndex, BusReader, BusWriter, CanFrame, Interface, Link, open,
};
use cangate::time::Clock;
use tokio::io::{AsyncReadExt, AsyncWriteExt, WriteHalf};
use tokio::sync::{mpsc, watch};
use tokio_serial::{SerialPort, SerialStream};
use tokio_util::sync::CancellationToken;

use crate::harness::bus::{ip as run_ip, take_the_bus};
use crate::harness::process::run;

/// Long enough for a machine that stalls; what is awaited comes at once otherwise.
const PATIENCE: Duration = Duration::from_secs(10);

/// Runs a test while no other runs.
fn alone(test: impl Future<Output = ()>) {
    let _bus = take_the_bus();
    tokio::runtime::Builder::new_current_thread().enable_all().build().unwrap().block_on(test);
}

fn ip(arguments: &str) {
    run_ip(&arguments.split(' ').collect::<Vec<_>>());
}

fn cansend(interface: &str, frame: &str) {
    let (good, _, stderr) = run("cansend", &[interface, frame]);
    assert!(good, "cansend {interface} {frame}: {stderr}");
}

/// An interface of its own for one test; gone when dropped.
struct Vcan(&'static str);

impl Vcan {
    fn new(name: &'static str) -> Self {
        let vcan = Self(name);
        vcan.add();
        vcan
    }

    fn add(&self) {
        ip(&format!("link add {} type vcan", self.0));
        ip(&format!("link set {} mtu 72 up", self.0));
    }

    fn open(&self) -> Bus {
        Bus::open(self.0, Clock::start())
    }
}

impl Drop for Vcan {
    fn drop(&mut self) {
        let _ = Command::new("ip").args(["link", "del", self.0]).output();
    }
}

/// An open bus.
struct Bus {
    reader: AnyReader,
    writer: AnyWriter,
}

impl Bus {
    fn open(name: &str, clock: Clock) -> Self {
        let (reader, writer) = open(&Interface::SocketCan(name.to_owned()), false, clock).unwrap();
        Self { reader, writer }
    }

    async fn send(&mut self, frame: &CanFrame) -> Result<(), BusError> {
        self.writer.send(frame).await
    }
}

async fn next(bus: &mut Bus) -> Result<BusEvent, BusError> {
    tokio::time::timeout(PATIENCE, bus.reader.recv()).await.expect("nothing came")
}

async fn next_link(bus: &mut Bus) -> Link {
    match next(bus).await.unwrap() {
        BusEvent::Link { link, .. } => link,
        other => panic!("{other:?} instead of a link"),
    }
}

async fn next_frame(bus: &mut Bus) -> CanFrame {
    match next(bus).await.unwrap() {
        BusEvent::Frame { frame, .. } => frame,
        other => panic!("{other:?} instead of a frame"),
    }
}

#[test]
fn frames_go_both_ways_and_our_own_do_not_come_back() {
    alone(async {
        let vcan = Vcan::new("sock0");
        let mut a = vcan.open();
        let mut b = vcan.open();
        assert_eq!(next_link(&mut a).await, Link::ErrorActive);
        assert_eq!(next_link(&mut b).await, Link::ErrorActive);
        for text in ["181#00FF80017FFE3340", "701#R1", "701#R0", "00000181#0102", "000#0101"] {
            let frame: CanFrame = text.parse().unwrap();
            a.send(&frame).await.unwrap();
            assert_eq!(next_frame(&mut b).await, frame);
        }
        let answer: CanFrame = "701#05".parse().unwrap();
        b.send(&answer).await.unwrap();
        assert_eq!(next_frame(&mut a).await, answer);
    });
}

#[test]
fn a_frame_is_stamped_with_the_time_at_which_the_kernel_received_it() {
    alone(async {
        let vcan = Vcan::new("sock1");
        let clock = Clock::start();
        let mut bus = Bus::open("sock1", clock);
        assert_eq!(next_link(&mut bus).await, Link::ErrorActive);
        cansend(vcan.0, "181#01");
        let sent = clock.now();
        std::thread::sleep(Duration::from_millis(1_500));
        let BusEvent::Frame { at, .. } = next(&mut bus).await.unwrap() else { panic!("no frame") };
        assert!(at.instant <= sent.instant, "{at:?} {sent:?}");
        assert!(at.utc <= sent.utc, "{at:?} {sent:?}");
        let apart = (sent.utc.as_micros() - at.utc.as_micros())
            - i64::try_from(sent.instant.since(at.instant).as_micros()).unwrap();
        assert!(apart.abs() < 300_000, "{apart} us");
    });
}

#[test]
fn an_interface_that_is_not_there_and_one_that_is_no_can_are_refused() {
    alone(async {
        let refused =
            |name: &str| open(&Interface::SocketCan(name.into()), false, Clock::start()).unwrap_err();
        assert!(matches!(refused("nosuch0"), BusError::Absent { .. }));
        assert!(refused("lo").to_string().contains("no CAN interface"), "{}", refused("lo"));
    });
}

#[test]
fn an_interface_that_goes_down_and_up_is_used_again() {
    alone(async {
        let vcan = Vcan::new("sock2");
        let mut bus = vcan.open();
        assert_eq!(next_link(&mut bus).await, Link::ErrorActive);
        for _ in 0..3 {
            ip("link set sock2 down");
            assert_eq!(next_link(&mut bus).await, Link::Down);
            let error = bus.send(&"000#0101".parse().unwrap()).await.unwrap_err();
            assert!(matches!(error, BusError::Down { .. }), "{error}");
            ip("link set sock2 up");
            assert_eq!(next_link(&mut bus).await, Link::ErrorActive);
            cansend(vcan.0, "181#01");
            assert_eq!(next_frame(&mut bus).await.to_string(), "181#01");
        }
    });
}

#[test]
fn an_interface_that_is_down_at_the_start_is_said_to_be() {
    alone(async {
        let vcan = Vcan::new("sock3");
        ip("link set sock3 down");
        let mut bus = vcan.open();
        assert_eq!(next_link(&mut bus).await, Link::Down);
        ip("link set sock3 up");
        assert_eq!(next_link(&mut bus).await, Link::ErrorActive);
    });
}

#[test]
fn a_deleted_interface_ends_the_bus_even_if_another_took_its_name() {
    alone(async {
        let vcan = Vcan::new("sock4");
        for made_anew in [false, true] {
            if !made_anew && std::fs::metadata("/sys/class/net/sock4").is_err() {
                vcan.add();
            }
            let mut bus = vcan.open();
            assert_eq!(next_link(&mut bus).await, Link::ErrorActive);
            ip("link del sock4");
            vcan.add();
            let error = loop {
                match next(&mut bus).await {
                    Ok(BusEvent::Link { link, .. }) => assert_eq!(link, Link::Down),
                    Ok(other) => panic!("{other:?}"),
                    Err(error) => break error,
                }
            };
            assert!(matches!(error, BusError::Absent { .. }), "{error}");
        }
    });
}

#[test]
fn error_frames_tell_the_state_of_the_controller() {
    alone(async {
        let vcan = Vcan::new("sock5");
        let mut bus = vcan.open();
        assert_eq!(next_link(&mut bus).await, Link::ErrorActive);
        cansend(vcan.0, "20000204#0020000000008205");
        assert_eq!(next_link(&mut bus).await, Link::ErrorPassive);
        cansend(vcan.0, "20000088#0000000000000000");
        cansend(vcan.0, "20000040#0000000000000000");
        assert_eq!(next_link(&mut bus).await, Link::BusOff);
        // A vcan has no controller that could stay off: a frame shows that the bus works.
        cansend(vcan.0, "181#01");
        assert_eq!(next_link(&mut bus).await, Link::ErrorActive);
        assert_eq!(next_frame(&mut bus).await.to_string(), "181#01");
        cansend(vcan.0, "20000040#0000000000000000");
        assert_eq!(next_link(&mut bus).await, Link::BusOff);
        cansend(vcan.0, "20000100#0000000000000000");
        assert_eq!(next_link(&mut bus).await, Link::ErrorActive);
        assert_eq!(bus.reader.tally().error_frames, 1);
    });
}

#[test]
fn r_det_006_fd_frames_are_counted_and_not_given() {
    alone(async {
        let vcan = Vcan::new("sock6");
        let Bus { mut reader, writer: _writer } = vcan.open();
        cansend(vcan.0, "181##10011223344");
        cansend(vcan.0, "181#02");
        let frame = loop {
            if let BusEvent::Frame { frame, .. } = reader.recv().await.unwrap() {
                break frame;
            }
        };
        assert_eq!(frame.to_string(), "181#02");
        assert_eq!(reader.tally().fd_frames, 1);
    });
}

#[test]
fn p24_frames_that_the_kernel_drops_are_counted_exactly() {
    alone(async {
        let vcan = Vcan::new("sock7");
        let mut sender = vcan.open();
        let Bus { mut reader, writer: _writer } = vcan.open();
        let frame: CanFrame = "181#0011223344556677".parse().unwrap();
        let sent = 60_000_u64;
        for _ in 0..sent {
            sender.send(&frame).await.unwrap();
        }
        let mut received = 0_u64;
        // The kernel tells of dropped frames with the next frame that it could keep.
        while received + reader.tally().overruns < sent {
            if let Ok(event) = tokio::time::timeout(Duration::from_secs(2), reader.recv()).await {
                received += u64::from(matches!(event.unwrap(), BusEvent::Frame { .. }));
            } else {
                cansend(vcan.0, "182#01");
                received -= 1;
            }
        }
        println!("{received} received, {} dropped", reader.tally().overruns);
        assert!(received >= 10_000, "a receive buffer for {received} frames");
        assert!(reader.tally().overruns > 0, "nothing was dropped, so nothing is proved");
        assert_eq!(received + reader.tally().overruns, sent);
    });
}

/// The task of a bus, with the test in the gateway's place.
struct Task {
    events: mpsc::Receiver<(BusIndex, BusEvent)>,
    transmit: mpsc::Sender<CanFrame>,
    stop: CancellationToken,
}

impl Task {
    fn start(interface: &str) -> Self {
        let (events, told) = mpsc::channel(1_024);
        let (transmit, to_send) = mpsc::channel(64);
        let stop = CancellationToken::new();
        let interface: Interface = interface.parse().unwrap();
        tokio::spawn(task::run(
            BusIndex(0),
            interface,
            task::Sending::Told,
            events,
            to_send,
            Clock::start(),
            stop.clone(),
        ));
        Self { events: told, transmit, stop }
    }

    /// The next event that is not the report of the counters, nor of a frame that was sent.
    async fn next(&mut self) -> BusEvent {
        loop {
            let event = tokio::time::timeout(PATIENCE, self.events.recv()).await.expect("nothing came");
            let (_, event) = event.unwrap();
            if !matches!(event, BusEvent::Counters { .. } | BusEvent::Sent { .. }) {
                return event;
            }
        }
    }

    async fn wait_for_link(&mut self, wanted: Link) {
        loop {
            if let BusEvent::Link { link, .. } = self.next().await
                && link == wanted
            {
                return;
            }
        }
    }
}

#[test]
fn p21_the_task_binds_to_an_interface_that_appears_goes_and_comes_again() {
    alone(async {
        let mut task = Task::start("sock8");
        task.wait_for_link(Link::Absent).await;
        let vcan = Vcan::new("sock8");
        for _ in 0..5 {
            task.wait_for_link(Link::ErrorActive).await;
            cansend(vcan.0, "181#01");
            assert!(matches!(task.next().await, BusEvent::Frame { .. }));
            ip("link del sock8");
            task.wait_for_link(Link::Absent).await;
            let request: CanFrame = "701#R1".parse().unwrap();
            task.transmit.send(request).await.unwrap();
            assert!(matches!(task.next().await, BusEvent::NotSent { frame, .. } if frame == request));
            vcan.add();
        }
        task.stop.cancel();
    });
}

/// A serial CAN interface of the kernel, with the test as its adapter: unlike a vcan it has a controller, and a queue.
struct SerialCan {
    adapter: WriteHalf<SerialStream>,
    daemon: Child,
    reading: watch::Sender<bool>,
}

impl SerialCan {
    async fn new(name: &'static str) -> Self {
        let (adapter, far) = SerialStream::pair().unwrap();
        let daemon = Command::new("slcand").args(["-F", &far.name().unwrap(), name]).spawn().unwrap();
        let path = format!("/sys/class/net/{name}");
        for _ in 0..1_000 {
            if fs::metadata(&path).is_ok() {
                break;
            }
            tokio::time::sleep(Duration::from_millis(10)).await;
        }
        let (mut input, adapter) = tokio::io::split(adapter);
        let (reading, mut read) = watch::channel(true);
        // The kernel waits until its commands are read.
        tokio::spawn(async move {
            let mut written = vec![0; 4_096];
            while read.wait_for(|reading| *reading).await.is_ok() {
                tokio::select! {
                    _ = input.read(&mut written) => {}
                    _ = read.changed() => {}
                }
            }
        });
        tokio::task::spawn_blocking(move || {
            ip(&format!("link set {name} type can bitrate 500000"));
            ip(&format!("link set {name} up"));
        })
        .await
        .unwrap();
        Self { adapter, daemon, reading }
    }

    async fn say(&mut self, text: &str) {
        self.adapter.write_all(text.as_bytes()).await.unwrap();
    }
}

impl Drop for SerialCan {
    fn drop(&mut self) {
        let _ = self.daemon.kill();
        let _ = self.daemon.wait();
    }
}

#[test]
fn p19_the_state_of_a_controller_is_followed_from_error_frames_and_from_the_host() {
    alone(async {
        let mut serial = SerialCan::new("slcan0").await;
        let mut bus = Bus::open("slcan0", Clock::start());
        assert_eq!(next_link(&mut bus).await, Link::ErrorActive);
        serial.say("sp130005\r").await;
        assert_eq!(next_link(&mut bus).await, Link::ErrorPassive);
        serial.say("sa000000\r").await;
        assert_eq!(next_link(&mut bus).await, Link::ErrorActive);
        serial.say("sb000256\r").await;
        assert_eq!(next_link(&mut bus).await, Link::BusOff);
        // The controller stays off: what is still received does not prove the contrary, and the host knows.
        serial.say("t1811AA\r").await;
        assert_eq!(next_frame(&mut bus).await.to_string(), "181#AA");
        tokio::task::spawn_blocking(|| ip("link set slcan0 down")).await.unwrap();
        assert_eq!(next_link(&mut bus).await, Link::Down);
        tokio::task::spawn_blocking(|| ip("link set slcan0 up")).await.unwrap();
        assert_eq!(next_link(&mut bus).await, Link::ErrorActive);
        assert_eq!(bus.reader.tally().bit_rate, Some(500_000));
    });
}

#[test]
fn p20_a_queue_that_does_not_move_takes_a_few_frames_and_refuses_the_rest() {
    alone(async {
        let serial = SerialCan::new("slcan1").await;
        let mut bus = Bus::open("slcan1", Clock::start());
        assert_eq!(next_link(&mut bus).await, Link::ErrorActive);
        serial.reading.send_replace(false);
        let (mut taken, mut refused) = (0, 0);
        while refused < 5 {
            assert!(taken < 5_000, "the queue never fills");
            match bus.send(&"00000701#0011223344556677".parse().unwrap()).await {
                Ok(()) => taken += 1,
                Err(BusError::Busy { .. }) => refused += 1,
                Err(other) => panic!("{other}"),
            }
        }
        println!("{taken} frames were taken");
        // Once it moves, it takes frames again.
        serial.reading.send_replace(true);
        tokio::time::timeout(PATIENCE, async {
            while bus.send(&"701#R1".parse().unwrap()).await.is_err() {}
        })
        .await
        .expect("the queue stays full");
    });
}
