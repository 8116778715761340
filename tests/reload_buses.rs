//! Buses come and go while the gateway runs: a new one works from its first moment, one that goes is left in order.

use std::net::SocketAddr;
use std::sync::{Arc, Mutex};

use cangate::can::interface::Interface;
use cangate::can::task::Sending;
use cangate::can::{self, BusEvent, BusIndex, CanFrame};
use cangate::simulator::{self, task::BusEnd};
use cangate::supervisor::{self, Ended, Reloads, Tasks};
use cangate::time::Clock;
use tokio::sync::mpsc;
use tokio_util::sync::CancellationToken;

use crate::reload::{fresh, reloads, status};
use crate::support::ports::free_address;
use crate::support::until;

/// A gateway in this process.
struct Here {
    http: SocketAddr,
    text: Arc<Mutex<String>>,
    ask: mpsc::Sender<()>,
    clock: Clock,
    stop: CancellationToken,
}

impl Here {
    fn new() -> (Self, Reloads) {
        let text = Arc::new(Mutex::new(String::new()));
        let ((ask, asked), shared) = (mpsc::channel(1), Arc::clone(&text));
        let read = move || fresh(&shared.lock().unwrap());
        let reloads = Reloads { read: Some(Arc::new(read)), ..Reloads::none(asked) };
        let (clock, stop) = (Clock::start(), CancellationToken::new());
        (Self { http: free_address(), text, ask, clock, stop }, reloads)
    }

    fn write(&self, more: &str) {
        let http = self.http;
        *self.text.lock().unwrap() = format!(
            "version = 1\n[gateway]\nname = 'hall'\nallow_map_change = true\n[modbus]\nlisten = []\n[http]\nlisten = '{http}'\n{more}"
        );
    }

    /// Runs the gateway, beside these tasks, until the proof is done.
    async fn run(&self, tasks: Tasks, reloads: Reloads, proof: impl Future<Output = ()>) {
        let first = fresh(&self.text.lock().unwrap()).unwrap();
        let bound = supervisor::bind(first.installation, self.clock).await.unwrap();
        let proof = async {
            proof.await;
            self.stop.cancel();
        };
        let (ended, ()) = tokio::join!(bound.run_with_reloads(tasks, self.stop.clone(), reloads), proof);
        assert_eq!(ended, Ended::Stopped);
    }

    /// Takes in what was written.
    async fn reload(&self) {
        let before = reloads(self.http).await;
        self.ask.send(()).await.unwrap();
        until("the file is taken in", async || (reloads(self.http).await > before).then_some(())).await;
    }

    async fn bus_is(&self, name: &str, state: &str) {
        until(&format!("bus {name} is {state}"), async || {
            let status = status(self.http).await;
            let bus = status["buses"].as_array().unwrap().iter().find(|bus| bus["name"] == name)?.clone();
            (bus["state"] == state).then_some(())
        })
        .await;
    }
}

#[tokio::test]
async fn p29_a_bus_that_comes_with_a_reload_works_from_its_first_moment() {
    let (here, reloads) = Here::new();
    let first = "[bus.can0]\ninterface = 'virtual:first-of-two'\n";
    here.write(first);
    here.run(Tasks::default(), reloads, async {
        here.bus_is("can0", "error_active").await;
        // One that tells its link before the gateway knows of it would do so once and for all.
        for round in 0..8 {
            here.write(&format!("{first}[bus.can9]\ninterface = 'virtual:second-of-two-{round}'\n"));
            here.reload().await;
            here.bus_is("can9", "error_active").await;
        }
        here.write(first);
        here.reload().await;
        here.bus_is("can0", "error_active").await;
    })
    .await;
}

/// The simulated devices of the demo, and one who takes note of all frames.
async fn devices(bus: &str, clock: Clock, heard: Arc<Mutex<Vec<String>>>, stop: CancellationToken) {
    let interface = || Interface::Virtual(bus.to_owned());
    let (to_us, events) = mpsc::channel(256);
    let (transmit, to_send) = mpsc::channel(256);
    let (_, lines) = mpsc::channel(1);
    let (report, _) = mpsc::channel(1);
    let end = BusEnd { events, transmit };
    let devices = simulator::task::run(simulator::demo(), end, lines, report, clock, stop.clone());
    let (to_spy, mut frames) = mpsc::channel(256);
    let (_silent, nothing) = mpsc::channel::<CanFrame>(1);
    let spy = async {
        while let Some((_, event)) = frames.recv().await {
            if let BusEvent::Frame { frame, .. } = event {
                heard.lock().unwrap().push(frame.to_string());
            }
        }
    };
    tokio::join!(
        can::task::run(BusIndex(0), interface(), Sending::Untold, to_us, to_send, clock, stop.clone()),
        can::task::run(BusIndex(0), interface(), Sending::Never, to_spy, nothing, clock, stop.clone()),
        devices,
        spy
    );
}

#[tokio::test]
async fn p29_r_esd_088_watchdogs_of_modules_are_switched_off_when_their_bus_goes_or_is_opened_anew() {
    const BUS: &str = "bus-that-goes";
    let (here, reloads) = Here::new();
    let heard = Arc::<Mutex<Vec<String>>>::default();
    let mut tasks = Tasks::default();
    tasks.spawn("devices", devices(BUS, here.clock, Arc::clone(&heard), here.stop.clone()));
    let at = |bus: &str| {
        format!(
            "[bus.can0]\ninterface = 'virtual:{bus}'\nbit_rate = 1000000\n[bus.can0.esd]\nreply_id = 0x6E0\n\
             [node.serial]\nbus = 'can0'\nid = 0x1A\nmapping = 'esd-can-cbm-sio4'\nwatchdog_id = 0x6E1\nwatchdog_ms = 2000\n"
        )
    };
    let wait_for = async |frame: &str| {
        let is_heard = || heard.lock().unwrap().iter().any(|each| each == frame);
        until(frame, async || is_heard().then_some(())).await;
        heard.lock().unwrap().clear();
    };
    here.write(&at(BUS));
    here.run(tasks, reloads, async {
        wait_for("6E1#R1").await;
        // Opened anew, elsewhere.
        here.write(&at("where-nobody-is"));
        here.reload().await;
        wait_for("700#8105001A0000").await;
        here.bus_is("can0", "error_active").await;
        here.write(&at(BUS));
        here.reload().await;
        wait_for("6E1#R1").await;
        // Gone.
        here.write("[bus.can1]\ninterface = 'virtual:where-nobody-is'\n");
        here.reload().await;
        wait_for("700#8105001A0000").await;
    })
    .await;
}
