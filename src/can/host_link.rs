//! What the host says about one of its network interfaces, asked again and again. \[IO\]
//!
//! A CAN socket does not tell everything: after its interface was deleted it stays silent for ever, even when a new
//! one has the same name, and it does not say that an interface came up again.

use std::io;
use std::time::Duration;

use ::socketcan::CanInterface;
use ::socketcan::nl::{CanState, InterfaceDetails};
use tokio::task::JoinHandle;
use tokio::time::{Interval, MissedTickBehavior, interval};

use super::Link;
use super::controller::Observation;

/// How often the host is asked: a new interface of the same name is found in well under a second.
const EVERY: Duration = Duration::from_millis(250);

/// An interface as the host describes it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct HostLink {
    /// The number of the interface; another one of the same name has another number.
    pub index: u32,
    /// Its state; `None` where the host gives no details (a sandbox without netlink).
    pub observation: Option<Observation>,
    /// Bit rate in bit/s, where there is one.
    pub bit_rate: Option<u32>,
}

/// The number of a network interface.
///
/// # Errors
/// There is no interface of that name.
pub fn index_of(name: &str) -> io::Result<u32> {
    nix::net::if_::if_nametoindex(name).map_err(io::Error::from)
}

/// Asks the host. May block for as long as the kernel holds its lock on interfaces.
fn ask(name: &str) -> io::Result<HostLink> {
    let index = index_of(name)?;
    match CanInterface::open_iface(index).details() {
        Ok(details) => Ok(describe(index, &details)),
        Err(error) => {
            tracing::debug!(interface = name, %error, "the host gives no details of the interface");
            Ok(HostLink { index, observation: None, bit_rate: None })
        }
    }
}

fn describe(index: u32, details: &InterfaceDetails) -> HostLink {
    let controller = match details.can.state {
        Some(CanState::ErrorActive | CanState::ErrorWarning) => Some(Link::ErrorActive),
        Some(CanState::ErrorPassive) => Some(Link::ErrorPassive),
        Some(CanState::BusOff) => Some(Link::BusOff),
        Some(CanState::Stopped | CanState::Sleeping) | None => None,
    };
    let bit_rate = details.can.bit_timing.map(|timing| timing.bitrate).filter(|rate| *rate > 0);
    HostLink { index, observation: Some(Observation { up: details.is_up, controller }), bit_rate }
}

/// Asks the host about one interface from time to time.
#[derive(Debug)]
pub struct HostWatch {
    name: String,
    every: Interval,
    question: Option<(u64, JoinHandle<io::Result<HostLink>>)>,
}

impl HostWatch {
    /// A watch over the interface of that name; the first answer comes at once.
    #[must_use]
    pub fn new(name: &str) -> Self {
        let mut every = interval(EVERY);
        every.set_missed_tick_behavior(MissedTickBehavior::Delay);
        Self { name: name.to_owned(), every, question: None }
    }

    /// Asks now instead of at the next turn.
    pub fn hurry(&mut self) {
        self.every.reset_immediately();
    }

    /// Waits for the next answer, and gives with it the `mark` that was handed in when the question was asked.
    /// Cancel-safe.
    ///
    /// # Errors
    /// There is no such interface.
    pub async fn next(&mut self, mark: u64) -> (u64, io::Result<HostLink>) {
        loop {
            if let Some((mark, answer)) = &mut self.question {
                let mark = *mark;
                let answer = answer.await.unwrap_or_else(|gone| Err(io::Error::other(gone)));
                self.question = None;
                return (mark, answer);
            }
            self.every.tick().await;
            let name = self.name.clone();
            self.question = Some((mark, tokio::task::spawn_blocking(move || ask(&name))));
        }
    }
}
