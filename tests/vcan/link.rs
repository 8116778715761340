//! A network between gateway and broker that loses every packet for a while, and tells nobody (promise P2).
//!
//! ```text
//! gateway --up0--veth-- [ router ] --veth--eth0-- [ office: mosquitto, mosquitto_sub ]
//! ```
//!
//! The router is a network namespace. When it forwards nothing, both ends keep their carrier and hear of no error.

use std::collections::BTreeSet;
use std::sync::atomic::{AtomicBool, AtomicU32, Ordering::SeqCst};
use std::time::Duration;

use crate::harness::broker::{Broker, Message, Subscriber};
use crate::harness::bus::{ip, take_the_bus};
use crate::harness::device::Device;
use crate::harness::gateway::{Setup, TOPICS};
use crate::harness::process::run;
use crate::harness::wait::{give_it, within};

const ROUTER: &str = "cangate-router";
const OFFICE: &str = "cangate-office";
const BROKER: &str = "10.79.0.2";

/// Keep-alive times in seconds; the longest is the test's most patient one.
const KEEP_ALIVES: [u16; 5] = [5, 10, 20, 60, 120];

/// The network; removed when dropped.
struct Network;

impl Network {
    fn lay() -> Self {
        let network = Self;
        for namespace in [ROUTER, OFFICE] {
            ip(&["netns", "add", namespace]);
            ip(&["-n", namespace, "link", "set", "lo", "up"]);
        }
        ip(&["link", "add", "up0", "type", "veth", "peer", "name", "inner", "netns", ROUTER]);
        ip(&["-n", ROUTER, "link", "add", "outer", "type", "veth", "peer", "name", "eth0", "netns", OFFICE]);
        for (namespace, interface, address) in [
            (None, "up0", "10.78.0.1/24"),
            (Some(ROUTER), "inner", "10.78.0.254/24"),
            (Some(ROUTER), "outer", "10.79.0.254/24"),
            (Some(OFFICE), "eth0", "10.79.0.2/24"),
        ] {
            let within = namespace.map_or(vec![], |namespace| vec!["-n", namespace]);
            ip(&[&within[..], &["addr", "add", address, "dev", interface]].concat());
            ip(&[&within[..], &["link", "set", interface, "up"]].concat());
        }
        ip(&["route", "add", "10.79.0.0/24", "via", "10.78.0.254"]);
        ip(&["-n", OFFICE, "route", "add", "default", "via", "10.79.0.254"]);
        Self::forward(true);
        network
    }

    /// Whether the router passes packets on, or drops them without a word.
    fn forward(on: bool) {
        let order = format!("echo {} >/proc/sys/net/ipv4/ip_forward", u8::from(on));
        let (good, _, stderr) = run("ip", &["netns", "exec", ROUTER, "sh", "-c", &order]);
        assert!(good, "{stderr}");
    }
}

impl Drop for Network {
    fn drop(&mut self) {
        let _ = run("ip", &["link", "del", "up0"]);
        for namespace in [ROUTER, OFFICE] {
            let _ = run("ip", &["netns", "del", namespace]);
        }
    }
}

/// Numbers that are the same in each run, for one seed.
struct Random(u64);

impl Random {
    fn below(&mut self, bound: u64) -> u64 {
        self.0 = self.0.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        (self.0 >> 33) % bound
    }
}

fn numbers(messages: &[Message]) -> Vec<u64> {
    messages.iter().map(|message| message.payload["seq"].as_u64().unwrap()).collect()
}

/// `CANGATE_TEST_CUTS` cuts (4 unless given), the keep-alive times in turn.
#[test]
fn p2_nothing_is_lost_between_the_failure_of_a_link_and_its_detection_whatever_the_keep_alive() {
    let cuts: usize = std::env::var("CANGATE_TEST_CUTS").map_or(4, |count| count.parse().unwrap());
    let _bus = take_the_bus();
    let _network = Network::lay();
    let broker = Broker::start_in(OFFICE, BROKER);
    let subscriber = Subscriber::start(&broker, TOPICS);
    let device = Device::start(1, 5);
    let mut random = Random(20_261_122);
    let keep_alives = KEEP_ALIVES.into_iter().cycle().take(cuts.clamp(1, KEEP_ALIVES.len()));
    for (place, keep_alive) in keep_alives.enumerate() {
        let share = cuts / KEEP_ALIVES.len() + usize::from(place < cuts % KEEP_ALIVES.len());
        cut_often(&subscriber, &device, keep_alive, share, &mut random);
    }
}

fn cut_often(subscriber: &Subscriber, device: &Device, keep_alive: u16, cuts: usize, random: &mut Random) {
    let from = subscriber.count();
    let gateway = Setup::one_detcon()
        .broker_at(&format!("{BROKER}:1883"))
        .mqtt_key(&format!("reconnect_max_s = 1\nkeep_alive_s = {keep_alive}"))
        .more("[node.engine1.alarm.\"sensor_fault_*\"]\non_delay_ms = 0\noff_delay_ms = 0")
        .start();
    subscriber.wait_for("bridge/state", from, |payload| payload["state"] == "online");
    let status = |bad: u16| {
        let [low, high] = bad.to_le_bytes();
        [0, 128, 0xFF, 0xFF, low, high, 153, 204]
    };
    let (done, rises) = (AtomicBool::new(false), AtomicU32::new(0));
    std::thread::scope(|scope| {
        scope.spawn(|| {
            while !done.load(SeqCst) {
                for bad in [1_u16.rotate_left(rises.load(SeqCst)), 0] {
                    device.send(0x381, &status(bad));
                    // So seldom that no alarm chatters, as it would be folded into a count.
                    give_it(Duration::from_secs(1));
                }
                rises.fetch_add(1, SeqCst);
            }
        });
        for cut in 0..cuts {
            give_it(Duration::from_millis(500 + random.below(3000)));
            Network::forward(false);
            // Most cuts are over before anybody has noticed. The first lasts until somebody must have; where there is one
            // only, and the keep alive is long, that is left to the long run.
            let noticed = u64::from(keep_alive) * 1500 + 1000;
            let until_noticed = cut == 0 && (cuts > 1 || noticed < 20_000);
            let lasts = if until_noticed { noticed } else { 100 + random.below(noticed.min(12_000)) };
            give_it(Duration::from_millis(lasts));
            Network::forward(true);
        }
        done.store(true, SeqCst);
    });
    let rises = rises.load(SeqCst);
    let events = || {
        let is_ours = |message: &Message| {
            message.payload["name"].as_str().unwrap_or_default().starts_with("sensor_fault_")
        };
        subscriber.of("event", from).into_iter().filter(is_ours).collect::<Vec<_>>()
    };
    // The link may not have been noticed as dead, and TCP waits longer from try to try.
    let patience = Duration::from_secs(60 + u64::from(keep_alive) * 2);
    let whole = within(patience, || {
        let distinct: BTreeSet<u64> = numbers(&events()).into_iter().collect();
        (distinct.len() as u32 >= 2 * rises).then_some(())
    });
    let all = numbers(&subscriber.of("event", from));
    let distinct: BTreeSet<u64> = all.iter().copied().collect();
    assert!(whole.is_some(), "{rises} rises, but only {} events of {all:?}", events().len());
    let (first, last) = (*distinct.first().unwrap(), *distinct.last().unwrap());
    let missing: Vec<u64> = (first..=last).filter(|number| !distinct.contains(number)).collect();
    assert!(missing.is_empty(), "events that never arrived: {missing:?}");
    let mut seen = 0;
    for number in &all {
        assert!(*number <= seen + 1 || seen == 0, "{number} came before {}: {all:?}", seen + 1);
        seen = seen.max(*number);
    }
    println!(
        "keep alive {keep_alive} s: {cuts} cuts, {} events, {} of them twice, none lost",
        distinct.len(),
        all.len() - distinct.len()
    );
    drop(gateway);
}
