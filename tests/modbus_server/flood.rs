//! A flood of strangers, and a listed PLC in the middle of it.

use std::net::{Ipv4Addr, SocketAddr};
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Duration;

use cangate::modbus::ModbusSettings;
use cangate::time::Clock;
use tokio::net::{TcpSocket, TcpStream};
use tokio::task::JoinSet;

use crate::support::modbus::{RawClient, serve};

/// Strangers that poll as fast as they can.
const POLLING: usize = 64;
/// Connections that strangers open and leave, per second, as far as this machine can.
const CONNECTS: u64 = 1_000;
/// By so many of them.
const CONNECTORS: u64 = 50;
/// A PLC polls so often.
const CYCLE: Duration = Duration::from_millis(20);

/// How long each phase lasts: 2 s, or CANGATE_FLOOD_S.
fn phase() -> Duration {
    let seconds = std::env::var("CANGATE_FLOOD_S").ok().and_then(|text| text.parse().ok());
    Duration::from_secs(seconds.unwrap_or(2))
}

async fn from(address: [u8; 4], server: SocketAddr) -> Option<TcpStream> {
    let socket = TcpSocket::new_v4().unwrap();
    socket.bind(SocketAddr::from((Ipv4Addr::from(address), 0))).ok()?;
    socket.connect(server).await.ok()
}

/// Polls for a phase, in one connection or with one for each poll: how often, the median and the worst time to the answer. Every
/// poll must be answered.
async fn poll(server: SocketAddr, address: [u8; 4], connect_each_time: bool) -> (usize, [Duration; 2]) {
    let clock = Clock::start();
    let mut client = RawClient(from(address, server).await.unwrap());
    let mut times = Vec::new();
    while clock.now().instant.as_millis() < u64::try_from(phase().as_millis()).unwrap() {
        let asked = clock.now().instant;
        if connect_each_time {
            client = RawClient(from(address, server).await.unwrap());
        }
        assert!(client.works().await, "poll {} of {address:?} is not answered", times.len());
        times.push(clock.now().instant.since(asked));
        tokio::time::sleep(CYCLE).await;
    }
    times.sort();
    (times.len(), [times[times.len() / 2], times[times.len() - 1]])
}

fn strangers(server: SocketAddr, connects: &Arc<AtomicU64>, answers: &Arc<AtomicU64>) -> JoinSet<()> {
    let mut flood = JoinSet::new();
    for number in 0..POLLING {
        let answers = Arc::clone(answers);
        flood.spawn(async move {
            loop {
                let Some(stream) = from([127, 0, 1, u8::try_from(number).unwrap() + 1], server).await else {
                    continue;
                };
                let mut client = RawClient(stream);
                while client.works().await {
                    answers.fetch_add(1, Ordering::Relaxed);
                }
            }
        });
    }
    for number in 0..CONNECTORS {
        let connects = Arc::clone(connects);
        flood.spawn(async move {
            let mut tick = tokio::time::interval(Duration::from_millis(CONNECTORS * 1_000 / CONNECTS));
            let address = [127, 0, 2, u8::try_from(number).unwrap() + 1];
            loop {
                tick.tick().await;
                if let Some(stream) = from(address, server).await {
                    connects.fetch_add(1, Ordering::Relaxed);
                    // Without a goodbye, so that no port waits for one.
                    let _ = stream.set_zero_linger();
                }
            }
        });
    }
    flood
}

#[tokio::test(flavor = "multi_thread", worker_threads = 4)]
async fn p25_f41_f42_in_a_flood_of_strangers_every_poll_of_a_listed_plc_is_answered() {
    let reserved = vec!["127.0.0.2".parse().unwrap(), "127.0.0.3".parse().unwrap()];
    let server = serve(ModbusSettings { reserved, ..ModbusSettings::default() }).await;
    let address = server.address;
    let (polls, quiet) = poll(address, [127, 0, 0, 2], false).await;
    assert!(polls > 0);
    let (connects, answers) = (Arc::default(), Arc::default());
    let mut flood = strangers(address, &connects, &answers);
    let steady = tokio::spawn(poll(address, [127, 0, 0, 2], false));
    let anew = tokio::spawn(poll(address, [127, 0, 0, 3], true));
    let ((polls, flooded), (connections, reconnected)) = (steady.await.unwrap(), anew.await.unwrap());
    flood.shutdown().await;
    println!(
        "quiet: median {:?}, worst {:?}; in the flood ({} connects, {} answers to strangers): {polls} polls, median {:?}, worst {:?}; \
         {connections} with a connection each: median {:?}, worst {:?}",
        quiet[0],
        quiet[1],
        connects.load(Ordering::Relaxed),
        answers.load(Ordering::Relaxed),
        flooded[0],
        flooded[1],
        reconnected[0],
        reconnected[1],
    );
    assert!(polls > 0 && connections > 0);
    assert!(connects.load(Ordering::Relaxed) > 0 && answers.load(Ordering::Relaxed) > 0);
    server.until(|counters| counters.open <= 2).await;
}
