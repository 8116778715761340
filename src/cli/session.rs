//! A bus that a commissioning tool holds open, and the one driver for everything with the four verbs. \[IO\]

use std::time::Duration;

use tokio::sync::mpsc;
use tokio::task::JoinHandle;
use tokio::time::timeout_at;
use tokio_util::sync::CancellationToken;

use super::Exit;
use crate::can::interface::Interface;
use crate::can::task::Sending;
use crate::can::{self, BusEvent, BusIndex, CanFrame, Link};
use crate::time::{Clock, Instant, Now};

/// How long the link may take to come up.
const UP_WITHIN: Duration = Duration::from_secs(3);
/// How long the end waits for frames that are still to leave.
const LEAVE_WITHIN: Duration = Duration::from_secs(1);
/// Frames that wait for the bus; one more is refused, which the asker is told.
const TRANSMIT_QUEUE: usize = 256;
/// Events that wait to be looked at; when it is full, reading the bus pauses.
const EVENT_QUEUE: usize = 1024;

/// Why a tool cannot use its bus, or cannot go on.
#[derive(Debug, thiserror::Error)]
pub enum SessionError {
    /// A bus inside this process, where nobody else can be.
    #[error(
        "`{interface}` is a bus inside this process: no device could ever be on it; give an interface of the host, for \
         example `-i can0`"
    )]
    Alone {
        /// As the user wrote it.
        interface: String,
    },
    /// The link did not come up.
    #[error("`{interface}` {}", not_up(interface, *link))]
    NotUp {
        /// As the user wrote it.
        interface: String,
        /// What is known of it.
        link: Link,
    },
    /// The link was up and is no more.
    #[error("`{interface}` {}", lost(*link))]
    Lost {
        /// As the user wrote it.
        interface: String,
        /// What it is now.
        link: Link,
    },
    /// A frame was not sent.
    #[error("{frame} was not sent on `{interface}`: nobody on the bus acknowledges, or it is overloaded")]
    NotSent {
        /// As the user wrote it.
        interface: String,
        /// The frame.
        frame: CanFrame,
    },
    /// The session only listens.
    #[error("nothing is sent on `{interface}`: it is opened to listen only")]
    ListensOnly {
        /// As the user wrote it.
        interface: String,
    },
    /// A signal asked to stop.
    #[error("stopped")]
    Stopped,
}

impl SessionError {
    /// How the command ends.
    #[must_use]
    pub fn exit(&self) -> Exit {
        match self {
            Self::Alone { .. } => Exit::Usage,
            Self::NotUp { .. } | Self::Lost { .. } | Self::NotSent { .. } | Self::Stopped => Exit::Io,
            Self::ListensOnly { .. } => Exit::Bug,
        }
    }
}

/// What is wrong, and how it is mended.
fn not_up(interface: &str, link: Link) -> String {
    if interface.starts_with("slcan") {
        return "did not come up within 3 s: is the adapter plugged in, and does no other program use it?"
            .to_owned();
    }
    match link {
        Link::Absent => {
            "is not there: `ip -details link show type can` lists the CAN interfaces of this host; \
                         plug in the adapter, or load its driver"
                .to_owned()
        }
        Link::BusOff => format!(
            "is bus-off: wiring, terminators or the bit rate are wrong; then, as root, \
             `ip link set {interface} type can restart`"
        ),
        Link::Down | Link::ErrorActive | Link::ErrorPassive => format!(
            "is down; as root, with the bit rate of the bus: \
             `ip link set {interface} up type can bitrate 125000 restart-ms 100`"
        ),
    }
}

fn lost(link: Link) -> &'static str {
    match link {
        Link::Absent => "is gone: was the adapter unplugged?",
        Link::BusOff => "went bus-off: wiring, terminators or the bit rate are wrong",
        Link::Down | Link::ErrorActive | Link::ErrorPassive => "went down",
    }
}

/// No device can be on a bus inside this process.
pub fn check_company(interface: &Interface) -> Result<(), SessionError> {
    match interface {
        Interface::Virtual(_) => Err(SessionError::Alone { interface: interface.to_string() }),
        Interface::SocketCan(_) | Interface::Slcan { .. } | Interface::SlcanTcp { .. } => Ok(()),
    }
}

/// What a [`Machine`] wants done.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Step<T> {
    /// Send this frame.
    Transmit(CanFrame),
    /// It is over.
    Done(T),
}

/// Something that lives in time, talks over a bus and comes to an end.
pub trait Machine {
    /// What it ends with.
    type Output;

    /// Takes a frame of another node.
    fn handle_frame(&mut self, now: Now, frame: &CanFrame);

    /// A frame that it wanted sent did not leave.
    fn handle_not_sent(&mut self, now: Now, frame: &CanFrame);

    /// What became due.
    fn handle_timeout(&mut self, now: Now);

    /// What is to be done; called until `None` after each of the calls above.
    fn poll_output(&mut self) -> Option<Step<Self::Output>>;

    /// When `handle_timeout` is to be called; `None` leaves the machine to the frames that come.
    fn poll_timeout(&self) -> Option<Instant>;
}

/// An open bus.
#[derive(Debug)]
pub struct Session {
    interface: String,
    clock: Clock,
    stop: CancellationToken,
    /// Ends the bus task.
    close: CancellationToken,
    events: mpsc::Receiver<(BusIndex, BusEvent)>,
    /// `None` where the session only listens: then nothing can be sent, whatever the caller does.
    transmit: Option<mpsc::Sender<CanFrame>>,
    bus: JoinHandle<()>,
    bit_rate: Option<u32>,
    overruns: u64,
}

impl Session {
    /// Opens a bus and waits until it can be used, at most 3 s. Must be called inside a tokio runtime.
    ///
    /// `listen_only`: nothing is ever sent; as far as the controller can, not even acknowledges.
    pub async fn open(
        interface: &Interface,
        listen_only: bool,
        clock: Clock,
        stop: CancellationToken,
    ) -> Result<Self, SessionError> {
        let (events_to_us, events) = mpsc::channel(EVENT_QUEUE);
        let (transmit, to_send) = mpsc::channel(TRANSMIT_QUEUE);
        let close = CancellationToken::new();
        let (transmit, idle) = if listen_only { (None, Some(transmit)) } else { (Some(transmit), None) };
        let run = can::task::run(
            BusIndex(0),
            interface.clone(),
            if listen_only { Sending::Never } else { Sending::Untold },
            events_to_us,
            to_send,
            clock,
            close.clone(),
        );
        let bus = tokio::spawn(async move {
            run.await;
            // The bus task ends when nobody can give it frames any more; here nobody ever does.
            drop(idle);
        });
        let mut session = Self {
            interface: interface.to_string(),
            clock,
            stop,
            close,
            events,
            transmit,
            bus,
            bit_rate: None,
            overruns: 0,
        };
        session.wait_until_up().await?;
        Ok(session)
    }

    async fn wait_until_up(&mut self) -> Result<(), SessionError> {
        let deadline = self.clock.now().instant + UP_WITHIN;
        let mut link = Link::Absent;
        while !link.is_up() {
            match self.next(deadline).await? {
                Some(BusEvent::Link { link: now, .. }) => link = now,
                Some(_) => {}
                None => return Err(SessionError::NotUp { interface: self.interface.clone(), link }),
            }
        }
        Ok(())
    }

    /// As the user wrote the interface.
    #[must_use]
    pub fn interface(&self) -> &str {
        &self.interface
    }

    /// Bit rate in bit/s, where the interface tells it.
    #[must_use]
    pub fn bit_rate(&self) -> Option<u32> {
        self.bit_rate
    }

    /// Frames that were lost on the way to us.
    #[must_use]
    pub fn overruns(&self) -> u64 {
        self.overruns
    }

    /// What happens next; `None` at the deadline.
    ///
    /// # Errors
    /// [`SessionError::Stopped`], or the bus task has ended.
    pub async fn next(&mut self, deadline: Instant) -> Result<Option<BusEvent>, SessionError> {
        let until = self.clock.deadline(deadline);
        let event = tokio::select! {
            () = self.stop.cancelled() => return Err(SessionError::Stopped),
            event = timeout_at(until, self.events.recv()) => event,
        };
        match event {
            Ok(Some((_, event))) => {
                if let BusEvent::Counters { counters, .. } = &event {
                    self.bit_rate = counters.bit_rate.or(self.bit_rate);
                    self.overruns = counters.overruns;
                }
                Ok(Some(event))
            }
            Ok(None) => Err(SessionError::Lost { interface: self.interface.clone(), link: Link::Absent }),
            Err(_) => Ok(None),
        }
    }

    /// Sends a frame. What becomes of it is told by [`next`](Self::next) only where it fails.
    pub fn send(&self, frame: CanFrame) -> Result<(), SessionError> {
        let Some(transmit) = &self.transmit else {
            return Err(SessionError::ListensOnly { interface: self.interface.clone() });
        };
        let refused = |_| SessionError::NotSent { interface: self.interface.clone(), frame };
        transmit.try_send(frame).map_err(refused)
    }

    /// Runs a machine to its end.
    ///
    /// # Errors
    /// The link is lost, or a signal asks to stop.
    pub async fn run<M: Machine>(&mut self, machine: &mut M) -> Result<M::Output, SessionError> {
        loop {
            while let Some(step) = machine.poll_output() {
                match step {
                    Step::Transmit(frame) => {
                        if self.send(frame).is_err() {
                            machine.handle_not_sent(self.clock.now(), &frame);
                        }
                    }
                    Step::Done(output) => return Ok(output),
                }
            }
            let far = self.clock.now().instant + Duration::from_secs(3600);
            let deadline = machine.poll_timeout().unwrap_or(far);
            match self.next(deadline).await? {
                Some(BusEvent::Frame { frame, at }) => machine.handle_frame(at, &frame),
                Some(BusEvent::NotSent { frame, at }) => machine.handle_not_sent(at, &frame),
                Some(BusEvent::Link { link, .. }) if !link.is_up() => {
                    return Err(SessionError::Lost { interface: self.interface.clone(), link });
                }
                Some(BusEvent::Link { .. } | BusEvent::Sent { .. } | BusEvent::Counters { .. }) => {}
                None => machine.handle_timeout(self.clock.now()),
            }
        }
    }

    /// Waits until all frames have left, and closes the bus.
    ///
    /// # Errors
    /// One of them did not leave.
    pub async fn close(mut self) -> Result<(), SessionError> {
        // The bus task ends when it has sent what there is.
        let mut leaving = self.transmit.take().is_some();
        let deadline = self.clock.now().instant + LEAVE_WITHIN;
        let mut not_sent = None;
        while leaving {
            match self.next(deadline).await {
                Ok(Some(BusEvent::NotSent { frame, .. })) => not_sent = not_sent.or(Some(frame)),
                Ok(Some(_)) => {}
                Ok(None) | Err(_) => leaving = false,
            }
        }
        self.close.cancel();
        // A panic in the bus task was told by the panic hook.
        let _ = (&mut self.bus).await;
        match not_sent {
            Some(frame) => Err(SessionError::NotSent { interface: self.interface.clone(), frame }),
            None => Ok(()),
        }
    }
}

impl Drop for Session {
    fn drop(&mut self) {
        self.close.cancel();
    }
}

#[cfg(test)]
#[path = "session_tests.rs"]
mod tests;
