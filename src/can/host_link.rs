//! What the host says about one of its network interfaces, asked again and again. \[IO\]
//!
//! A CAN socket does not tell everything: after its interface was deleted it stays silent for ever, even when a new
//! one has the same name, and it does not say that an interface came up again.

use std::io;
use std::time::Duration;

use ::socketcan::nl::{CanState, InterfaceDetails};
use ::socketcan::{CanCtrlMode, CanInterface};
use nix::errno::Errno;
use tokio::task::JoinHandle;
use tokio::time::{Interval, MissedTickBehavior, interval};

use super::Link;
use super::controller::Observation;

/// How often the host is asked: a new interface of the same name is found in well under a second.
const EVERY: Duration = Duration::from_millis(250);

/// How soon it is asked when that is urgent. Not at once, so that a full bus cannot make it a storm of questions.
const SOON: Duration = Duration::from_millis(5);

/// An interface as the host describes it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct HostLink {
    /// The number of the interface; another one of the same name has another number.
    pub index: u32,
    /// Its state; `None` where the host tells nothing of it.
    pub observation: Option<Observation>,
    /// Bit rate in bit/s, where there is one.
    pub bit_rate: Option<u32>,
    /// The controller does not even acknowledge frames; `None` where there is no controller.
    pub listens_only: Option<bool>,
}

/// The number of a network interface.
///
/// # Errors
/// There is no interface of that name ([`is_absence`]), or it could not be asked for.
pub fn index_of(name: &str) -> io::Result<u32> {
    nix::net::if_::if_nametoindex(name).map_err(io::Error::from)
}

/// Whether an error says that there is no such interface. Others say that the question failed: without a free file
/// descriptor, for example, nothing is known.
#[must_use]
pub fn is_absence(error: &io::Error) -> bool {
    matches!(error.raw_os_error().map(Errno::from_raw), Some(Errno::ENODEV | Errno::ENXIO))
}

/// Asks the host. May block for as long as the kernel holds its lock on interfaces.
fn ask(name: &str) -> io::Result<Option<HostLink>> {
    answer(
        index_of(name),
        |index| CanInterface::open_iface(index).details(),
        || std::fs::read_to_string(format!("/sys/class/net/{name}/flags")).ok(),
    )
}

/// Puts an answer together: from netlink, and in a sandbox without it from the flags in `/sys`. `None` when the question
/// failed.
fn answer<E: std::fmt::Display>(
    index: io::Result<u32>,
    details: impl FnOnce(u32) -> Result<InterfaceDetails, E>,
    flags: impl FnOnce() -> Option<String>,
) -> io::Result<Option<HostLink>> {
    let index = match index {
        Ok(index) => index,
        Err(error) if is_absence(&error) => return Err(error),
        Err(error) => {
            tracing::debug!(%error, "the host does not say whether the interface is there");
            return Ok(None);
        }
    };
    Ok(Some(match details(index) {
        Ok(details) => describe(index, &details),
        Err(error) => {
            tracing::debug!(%error, "the host gives no details of the interface");
            let up = flags().as_deref().and_then(is_up);
            let observation = up.map(|up| Observation { up, controller: None });
            HostLink { index, observation, bit_rate: None, listens_only: None }
        }
    }))
}

/// Reads the flags of an interface as `/sys` shows them: `0x40081`, of which bit 0 is `IFF_UP`.
fn is_up(flags: &str) -> Option<bool> {
    let flags = u32::from_str_radix(flags.trim().strip_prefix("0x")?, 16).ok()?;
    Some(flags & 1 != 0)
}

fn describe(index: u32, details: &InterfaceDetails) -> HostLink {
    let controller = match details.can.state {
        Some(CanState::ErrorActive | CanState::ErrorWarning) => Some(Link::ErrorActive),
        Some(CanState::ErrorPassive) => Some(Link::ErrorPassive),
        Some(CanState::BusOff) => Some(Link::BusOff),
        Some(CanState::Stopped | CanState::Sleeping) | None => None,
    };
    let bit_rate = details.can.bit_timing.map(|timing| timing.bitrate).filter(|rate| *rate > 0);
    let listens_only = details.can.ctrl_mode.map(|modes| modes.has_mode(CanCtrlMode::ListenOnly));
    let observation = Some(Observation { up: details.is_up, controller });
    HostLink { index, observation, bit_rate, listens_only }
}

/// Asks the host about one interface from time to time.
#[derive(Debug)]
pub struct HostWatch {
    name: String,
    every: Interval,
    hurried: bool,
    question: Option<(u64, JoinHandle<io::Result<Option<HostLink>>>)>,
}

impl HostWatch {
    /// A watch over the interface of that name; the first answer comes at once.
    #[must_use]
    pub fn new(name: &str) -> Self {
        let mut every = interval(EVERY);
        every.set_missed_tick_behavior(MissedTickBehavior::Delay);
        Self { name: name.to_owned(), every, hurried: false, question: None }
    }

    /// Asks soon instead of at the next turn.
    pub fn hurry(&mut self) {
        if !self.hurried {
            self.hurried = true;
            self.every.reset_after(SOON);
        }
    }

    /// Waits for the next answer, and gives with it the `mark` that was handed in when the question was asked. `None` says
    /// that the host could not be asked, so that nothing is known. Cancel-safe.
    ///
    /// # Errors
    /// There is no such interface.
    pub async fn next(&mut self, mark: u64) -> (u64, io::Result<Option<HostLink>>) {
        loop {
            if let Some((mark, answer)) = &mut self.question {
                let mark = *mark;
                // It panicked, or the program ends.
                let answer = answer.await.unwrap_or(Ok(None));
                self.question = None;
                return (mark, answer);
            }
            self.every.tick().await;
            self.hurried = false;
            let name = self.name.clone();
            self.question = Some((mark, tokio::task::spawn_blocking(move || ask(&name))));
        }
    }
}

#[cfg(test)]
mod tests {
    use ::socketcan::nl::CanCtrlModes;

    use super::*;

    fn without_netlink(index: Result<u32, Errno>, flags: Option<&str>) -> io::Result<Option<HostLink>> {
        answer(index.map_err(io::Error::from), |_| Err("no netlink here"), || flags.map(str::to_owned))
    }

    #[test]
    fn without_netlink_the_flags_say_whether_the_interface_is_up() {
        let up = |flags| without_netlink(Ok(7), flags).unwrap().unwrap().observation.map(|seen| seen.up);
        assert_eq!(up(Some("0x40081\n")), Some(true));
        assert_eq!(up(Some("0x40080\n")), Some(false));
        assert_eq!(up(Some("nonsense")), None);
        assert_eq!(up(None), None);
        let host = without_netlink(Ok(7), Some("0x1")).unwrap().unwrap();
        assert_eq!((host.index, host.observation.unwrap().controller), (7, None));
    }

    #[test]
    fn only_an_interface_that_is_not_there_is_absent() {
        for error in [Errno::ENODEV, Errno::ENXIO] {
            assert!(without_netlink(Err(error), None).is_err(), "{error}");
        }
        for error in [Errno::EMFILE, Errno::ENFILE, Errno::ENOBUFS, Errno::EPERM] {
            assert_eq!(without_netlink(Err(error), Some("0x1")).unwrap(), None, "{error}");
        }
        assert!(is_absence(&index_of("no-such-if").unwrap_err()), "as this system says it");
    }

    #[test]
    fn netlink_knows_the_controller_and_the_bit_rate() {
        let mut details = InterfaceDetails { is_up: true, ..InterfaceDetails::default() };
        details.can.state = Some(CanState::BusOff);
        details.can.ctrl_mode = Some(CanCtrlModes::from_mode(CanCtrlMode::ListenOnly, true));
        let no_flags = || panic!("the flags are not needed");
        let host = answer(Ok(7), |_| Ok::<_, io::Error>(details), no_flags).unwrap().unwrap();
        let observation = Observation { up: true, controller: Some(Link::BusOff) };
        let expected =
            HostLink { index: 7, observation: Some(observation), bit_rate: None, listens_only: Some(true) };
        assert_eq!(host, expected);
    }

    #[tokio::test(start_paused = true)]
    async fn a_watch_that_is_hurried_again_and_again_asks_all_the_same() {
        let mut watch = HostWatch::new("no-such-if");
        watch.next(0).await.1.unwrap_err();
        let mut asked = 0;
        // A tenth of a second: no question would be due of itself.
        for _ in 0..100 {
            watch.hurry();
            tokio::select! {
                biased;
                _ = watch.next(1) => asked += 1,
                () = tokio::time::sleep(Duration::from_millis(1)) => {}
            }
        }
        assert!((10..=20).contains(&asked), "{asked} times");
    }
}
