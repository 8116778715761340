//! `cangate demo`: simulated engines, a press and serial lines, a broker and the gateway in one process. \[IO\]

use std::fmt::Write;
use std::io;
use std::net::{IpAddr, Ipv4Addr, Ipv6Addr, SocketAddr};

use tokio::sync::{mpsc, oneshot};
use tokio_util::sync::CancellationToken;

use super::args::DemoArguments;
use super::output::{block_on, print_error, print_line, stop_on_signal};
use super::{Exit, load, run};
use crate::can::interface::Interface;
use crate::can::task::Sending;
use crate::can::{self, BusIndex};
use crate::mqtt::settings::BrokerUrl;
use crate::simulator;
use crate::simulator::task::BusEnd;
use crate::slots::{ServerName, listening};
use crate::supervisor::{self, Installation, Tasks};
use crate::time::Clock;

/// The configuration of the demo but for its serial lines; what a user would write for two engines, a pressure transmitter
/// and a module with serial lines. Where the servers listen, the options say.
const CONFIGURATION: &str = r#"
version = 1
[gateway]
name = "demo"
[bus.demo]
interface = "virtual:demo"
[bus.demo.esd]
reply_id = 0x6E0
[node.engine1]
bus = "demo"
id = 1
mapping = "motortech-detcon"
[node.engine2]
bus = "demo"
id = 2
mapping = "motortech-detcon"
[node.hydraulics]
bus = "demo"
id = 5
mapping = "danfoss-dst-p92c"
[node.serial]
bus = "demo"
id = 0x1A
mapping = "esd-can-cbm-sio4"
[modbus]
listen = []
[http]
listen = "127.0.0.1:0"
[mqtt]
buffer_dir = ""
"#;

/// What is at the serial lines of the module, from channel 1 on, and what to do there.
const LINES: [(&str, &str); 3] =
    [("scanner", "reads every 5 s"), ("balance", "type S and Enter"), ("echo", "type something")];

/// Frames and events that wait between the devices and their bus.
const QUEUE: usize = 256;

/// Runs until a signal.
pub(super) fn run(options: &DemoArguments) -> Exit {
    block_on(async {
        let doors = doors(options.serial).await;
        match load::installation_from_text(&configuration(&doors), "demo") {
            Ok(installation) => show(options, installation, &doors).await,
            Err(exit) => exit,
        }
    })
}

async fn show(options: &DemoArguments, mut installation: Installation, doors: &[Door]) -> Exit {
    installation.modbus.listen = vec![options.modbus];
    installation.http.listen = options.http;
    let stop = match stop_on_signal() {
        Ok(stop) => stop,
        Err(exit) => return exit,
    };
    let broker = match Broker::start(options).await {
        Ok(broker) => broker,
        Err(text) => {
            print_error(&text);
            return Exit::Io;
        }
    };
    let broker_url: BrokerUrl = match broker.url().parse() {
        Ok(url) => url,
        Err(error) => {
            print_error(&format!("--broker: {error}"));
            return Exit::Usage;
        }
    };
    if let Some(mqtt) = &mut installation.mqtt {
        mqtt.url = broker_url.clone();
    }
    let clock = Clock::start();
    let bound = match supervisor::bind(installation, clock).await {
        Ok(bound) => bound,
        Err(error) => {
            print_error(&format!(
                "{error}; choose other addresses with --modbus, --mqtt, --http and --serial"
            ));
            return Exit::Io;
        }
    };
    tell(&bound, &broker_url, doors);
    // A demo whose devices or broker died would go on without a word.
    let mut tasks = Tasks::default();
    tasks.spawn("simulated devices", simulate(clock, stop.clone()));
    let (back, broker_back) = oneshot::channel();
    tasks.spawn("broker", broker.watch(stop.clone(), back));
    let exit = run::ended(&bound.run(tasks, stop).await);
    // After the gateway, so that it can say goodbye.
    if let Ok(broker) = broker_back.await {
        broker.stop().await;
    }
    exit
}

/// Where a serial line listens, or why it cannot.
type Door = (SocketAddr, io::Result<()>);

/// The TCP ports of the serial lines. The demo does without those that are taken.
async fn doors(first: SocketAddr) -> Vec<Door> {
    let mut address = first;
    // Held until all are there, so that the system does not give one free port to two of them.
    let mut listeners = Vec::new();
    for (device, _) in LINES {
        listeners.push((address, listening::bind(&ServerName::new(device, "--serial"), address).await));
        if address.port() != 0 {
            address.set_port(address.port().saturating_add(1));
        }
    }
    let told = listeners.iter().map(|(address, listener)| match listener {
        Ok(listener) => {
            listener.local_addr().map_or_else(|error| (*address, Err(error)), |bound| (bound, Ok(())))
        }
        Err(error) => (*address, Err(error.source.kind().into())),
    });
    told.collect()
}

/// The whole configuration.
fn configuration(doors: &[Door]) -> String {
    let mut text = CONFIGURATION.to_owned();
    for (channel, ((device, _), (address, free))) in (1..).zip(LINES.iter().zip(doors)) {
        // Writing to a text does not fail.
        let _ = write!(
            text,
            "[node.serial.channel.{channel}]\ndescription = \"{device}\"\nmax_char = 8\ninhibit_ms = 8\n"
        );
        if free.is_ok() {
            let _ = writeln!(text, "listen = \"{address}\"");
        }
    }
    text
}

/// The devices on their virtual bus.
async fn simulate(clock: Clock, stop: CancellationToken) {
    let interface = Interface::Virtual("demo".to_owned());
    let (events_to_us, events) = mpsc::channel(QUEUE);
    let (transmit, to_send) = mpsc::channel(QUEUE);
    // No orders: the demo tells its story by itself.
    let (_, lines) = mpsc::channel(1);
    let bus =
        can::task::run(BusIndex(0), interface, Sending::Untold, events_to_us, to_send, clock, stop.clone());
    let end = BusEnd { events, transmit };
    // No reports either: what the devices do is seen through the gateway.
    let (report, _) = mpsc::channel(1);
    tokio::join!(bus, simulator::task::run(simulator::demo(), end, lines, report, clock, stop));
}

/// The lines that a newcomer can paste, and what there is to see.
fn tell(bound: &supervisor::Bound, broker: &BrokerUrl, doors: &[Door]) {
    let modbus = bound.modbus_addresses().first().copied();
    let (host, port) =
        modbus.map_or((String::new(), 0), |address| (reachable(address).ip().to_string(), address.port()));
    let (broker_host, broker_port) = host_and_port(broker);
    let subscribe = format!("mosquitto_sub -h {broker_host} -p {broker_port} -v -t");
    let mut lines = vec![
        "cangate demo: two simulated engines, a press and serial lines; Ctrl-C ends it. Connect from another terminal:"
            .to_owned(),
        String::new(),
        format!("  engine 1     mbpoll -m tcp -a 1 -0 -r 100 -c 20 -t 3 -1 -p {port} {host}"),
        format!("  hydraulics   mbpoll -m tcp -a 5 -0 -r 100 -c 1 -t 3:float -B -1 -p {port} {host}"),
    ];
    lines.extend(LINES.iter().zip(doors).map(|(line, door)| tell_line(*line, door)));
    lines.extend([
        format!("  MQTT         {subscribe} 'cangate/#'"),
        format!("  serial lines {subscribe} 'cangate/demo/serial/serial/+/rx'"),
        format!("  page         http://{}/", reachable(bound.http_address())),
        String::new(),
        "Engine 1 knocks on cylinder 7 within ten seconds (register 106, unit 1), and again every minute. The press of the"
            .to_owned(),
        "hydraulics (unit 5) raises its pressure from 180 to 320 bar every 20 s: registers 100 and 101, a float in bar; 104,"
            .to_owned(),
        "tenths of a degree. Unit 2 is the other engine, 26 the module with the serial lines, 247 the gateway."
            .to_owned(),
        "`cangate demo --help`: how to move the ports.".to_owned(),
        String::new(),
    ]);
    for line in lines {
        if !print_line(&line) {
            return;
        }
    }
}

/// How to get at what is at a serial line, or why one cannot.
fn tell_line((device, what): (&str, &str), (address, free): &Door) -> String {
    match free {
        Ok(()) => {
            let address = reachable(*address);
            let connect = format!("nc {} {}", address.ip(), address.port());
            format!("  {device:<12} {connect:<20} ({what})")
        }
        Err(error) => {
            format!("  {device:<12} no TCP port: {address}: {error}; `--serial ADDRESS` moves all three")
        }
    }
}

/// An address that can be connected to: whoever listens on all addresses (`0.0.0.0`) is reached at the loopback address,
/// through the published port of a container too.
fn reachable(address: SocketAddr) -> SocketAddr {
    match address.ip() {
        IpAddr::V4(ip) if ip.is_unspecified() => SocketAddr::new(Ipv4Addr::LOCALHOST.into(), address.port()),
        IpAddr::V6(ip) if ip.is_unspecified() => SocketAddr::new(Ipv6Addr::LOCALHOST.into(), address.port()),
        IpAddr::V4(_) | IpAddr::V6(_) => address,
    }
}

/// The same for a broker, as its clients take it.
fn host_and_port(broker: &BrokerUrl) -> (String, u16) {
    let host = match broker.host.parse::<IpAddr>() {
        Ok(ip) => reachable(SocketAddr::new(ip, broker.port)).ip().to_string(),
        Err(_) => broker.host.clone(),
    };
    (host, broker.port)
}

/// The broker that the demo publishes to.
enum Broker {
    #[cfg(feature = "embedded-broker")]
    Inside(crate::mqtt::broker::EmbeddedBroker),
    Outside(String),
}

impl Broker {
    async fn start(options: &DemoArguments) -> Result<Self, String> {
        match &options.broker {
            Some(url) => Ok(Self::Outside(url.clone())),
            None => Self::start_inside(options.mqtt).await,
        }
    }

    #[cfg(feature = "embedded-broker")]
    async fn start_inside(address: SocketAddr) -> Result<Self, String> {
        let broker = crate::mqtt::broker::EmbeddedBroker::start(address).await;
        broker.map(Self::Inside).map_err(|error| {
            let there = host_and_port(&BrokerUrl { host: address.ip().to_string(), port: address.port(), tls: false });
            let there = BrokerUrl { host: there.0, port: there.1, tls: false };
            format!(
                "{error} Use the broker that is there already with `--broker {there}`, or choose another address with \
                 --mqtt."
            )
        })
    }

    #[cfg(not(feature = "embedded-broker"))]
    async fn start_inside(address: SocketAddr) -> Result<Self, String> {
        Err(format!(
            "this binary was built without a broker (feature `embedded-broker`) for {address}; use --broker mqtt://HOST"
        ))
    }

    fn url(&self) -> String {
        match self {
            #[cfg(feature = "embedded-broker")]
            Self::Inside(broker) => format!("mqtt://{}", broker.local_addr()),
            Self::Outside(url) => url.clone(),
        }
    }

    /// Returns early when the broker ends by itself; else gives it `back` at the stop.
    async fn watch(mut self, stop: CancellationToken, back: oneshot::Sender<Self>) {
        let ended = async {
            match &mut self {
                #[cfg(feature = "embedded-broker")]
                Self::Inside(broker) => broker.ended().await,
                Self::Outside(_) => std::future::pending().await,
            }
        };
        tokio::select! {
            () = ended => return,
            () = stop.cancelled() => {}
        }
        // Nobody takes it back only when the process is about to end anyhow.
        let _ = back.send(self);
    }

    #[cfg_attr(
        not(feature = "embedded-broker"),
        expect(clippy::unused_async, reason = "nothing to stop without a broker")
    )]
    async fn stop(self) {
        match self {
            #[cfg(feature = "embedded-broker")]
            Self::Inside(broker) => broker.shutdown().await,
            Self::Outside(_) => {}
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[tokio::test]
    async fn the_devices_of_the_demo_are_the_nodes_that_its_gateway_knows() {
        let text = configuration(&doors("127.0.0.1:0".parse().unwrap()).await);
        let installation = load::installation_from_text(&text, "demo").unwrap();
        let configured: Vec<u8> =
            installation.table.nodes.iter().map(crate::mapping::NodeDef::number).collect();
        let simulated: Vec<u8> = simulator::demo().iter().map(|plan| plan.node.get()).collect();
        assert_eq!(configured, simulated);
    }

    #[tokio::test]
    async fn where_a_serial_port_is_taken_the_line_has_none_and_says_so_and_the_others_are_as_always() {
        let any = doors("127.0.0.1:0".parse().unwrap()).await;
        assert!(any.iter().all(|(address, free)| free.is_ok() && address.port() != 0), "{any:?}");
        // Some port has one below and one above it that are free.
        let (taken, doors) = loop {
            let taken = std::net::TcpListener::bind("127.0.0.1:0").unwrap();
            let mut first = taken.local_addr().unwrap();
            first.set_port(first.port() - 1);
            let doors = doors(first).await;
            if let [(_, Ok(())), (_, Err(_)), (_, Ok(()))] = doors.as_slice() {
                break (taken, doors);
            }
        };
        let address = taken.local_addr().unwrap();
        let said = tell_line(LINES[1], &doors[1]);
        assert!(said.contains(&format!("balance      no TCP port: {address}")), "{said}");
        assert!(said.contains("--serial"), "{said}");
        let installation = load::installation_from_text(&configuration(&doors), "demo").unwrap();
        let listens: Vec<Option<u16>> =
            installation.table.lines.iter().map(|line| Some(line.tcp.as_ref()?.listen.port())).collect();
        assert_eq!(listens, [Some(address.port() - 1), None, Some(address.port() + 1)]);
        let said = tell_line(LINES[2], &doors[2]);
        assert!(said.contains(&format!("nc 127.0.0.1 {} ", address.port() + 1)), "{said}");
    }

    #[test]
    fn what_is_printed_can_be_pasted_wherever_the_demo_listens() {
        let shown = |address: &str| reachable(address.parse().unwrap()).to_string();
        assert_eq!(shown("0.0.0.0:5020"), "127.0.0.1:5020");
        assert_eq!(shown("[::]:5020"), "[::1]:5020");
        assert_eq!(shown("192.0.2.7:5020"), "192.0.2.7:5020");
        for (url, host, port) in [
            ("mqtt://[::1]:1884", "::1", 1884),
            ("mqtt://[::1]", "::1", 1883),
            ("mqtt://0.0.0.0:1883", "127.0.0.1", 1883),
            ("mqtt://mosquitto", "mosquitto", 1883),
        ] {
            assert_eq!(host_and_port(&url.parse().unwrap()), (host.to_owned(), port), "{url}");
        }
    }

    #[cfg(feature = "embedded-broker")]
    #[tokio::test]
    async fn where_a_broker_listens_already_the_demo_offers_to_use_it() {
        let taken = tokio::net::TcpListener::bind("127.0.0.1:0").await.unwrap();
        let address = taken.local_addr().unwrap();
        let error = Broker::start_inside(address).await.err().unwrap();
        assert!(error.contains(&format!("--broker mqtt://{address}`")), "{error}");
    }
}
