//! A CAN interface of this host, by SocketCAN. \[IO\]
//!
//! One raw socket, read in batches with the kernel's receive times and its count of dropped frames. Needs no
//! capability; with `CAP_NET_ADMIN` its receive buffer may be larger than `net.core.rmem_max`.
//!
//! - The interface goes down: [`Link::Down`]; the socket works again when it comes up.
//! - The interface is deleted, even if a new one took its name: an error, and the bus is to be opened again.
//! - The transmit queue is full: a few tries a millisecond apart, then [`BusError::Busy`]. The send buffer is
//!   small on purpose, so that only a handful of frames can go out late after a cable was mended.

use std::collections::VecDeque;
use std::io::{self, IoSliceMut};
use std::os::fd::{AsRawFd, RawFd};
use std::sync::Arc;
use std::time::Duration;

use ::socketcan::{CanFdSocket, Socket as _, SocketOptions as _};
use nix::errno::Errno;
use nix::sys::socket::{ControlMessageOwned, MsgFlags, MultiHeaders, recvmmsg, send, setsockopt, sockopt};
use nix::sys::time::TimeSpec;
use tokio::io::unix::AsyncFd;
use tokio::sync::Notify;

use super::controller::LinkTracker;
use super::host_link::{HostLink, HostWatch, index_of, is_absence};
use super::raw_frame::{self, FD_SIZE, Received};
use super::stamp::Stamper;
use super::{BusError, BusEvent, BusReader, BusWriter, CanFrame, Link, Tally};
use crate::time::{Clock, Now, Timestamp};

/// Frames that one system call takes at most.
const BATCH: usize = 64;

/// Wanted size of the receive buffer in bytes: some 20,000 frames, two seconds of a full 1 Mbit/s bus.
const RECEIVE_BUFFER: usize = 16 << 20;

/// Wanted size of the send buffer in bytes; the kernel raises it to its minimum, which is about six frames.
const SEND_BUFFER: usize = 1;

/// How often, a millisecond apart, a frame is offered to a full transmit queue. The longest frame takes 1.3 ms at
/// 100 kbit/s, so that a queue that moves at all takes it.
const TRIES: u32 = 20;

/// The same after a frame that was given up. More than one, so that a caller who insists still leaves others room.
const TRIES_WHEN_STUCK: u32 = 2;

#[derive(Debug)]
struct Shared {
    name: String,
    socket: AsyncFd<CanFdSocket>,
    /// The writer found that something is wrong with the interface.
    look: Notify,
}

/// Opens the interface of that name.
///
/// # Errors
/// There is no such interface, it is no CAN interface, or the kernel has no CAN.
pub fn open(name: &str, clock: Clock) -> Result<(SocketReader, SocketWriter), BusError> {
    let index = index_of(name).map_err(|source| {
        let interface = name.to_owned();
        if is_absence(&source) {
            BusError::Absent { interface, source }
        } else {
            BusError::Io { interface, source }
        }
    })?;
    let socket = open_socket(index).map_err(|source| io_error(name, source))?;
    let shared = Arc::new(Shared { name: name.to_owned(), socket, look: Notify::new() });
    let reader = SocketReader {
        shared: Arc::clone(&shared),
        index,
        clock,
        watch: HostWatch::new(name),
        buffers: Box::new([[0; FD_SIZE]; BATCH]),
        intake: Intake::new(clock.now()),
    };
    Ok((reader, SocketWriter { shared, stuck: false }))
}

fn open_socket(index: u32) -> io::Result<AsyncFd<CanFdSocket>> {
    let socket =
        CanFdSocket::open_iface(index).map_err(|error| match error.raw_os_error().map(Errno::from_raw) {
            Some(Errno::ENODEV) => io::Error::new(error.kind(), "it is no CAN interface"),
            Some(Errno::EAFNOSUPPORT | Errno::EPROTONOSUPPORT) => {
                io::Error::new(error.kind(), "this kernel has no CAN (try `modprobe can-raw`)")
            }
            Some(_) | None => error,
        })?;
    socket.set_nonblocking(true)?;
    socket.set_error_filter_accept_all()?;
    setsockopt(&socket, sockopt::ReceiveTimestampns, &true)?;
    setsockopt(&socket, sockopt::RxqOvfl, &1)?;
    if setsockopt(&socket, sockopt::RcvBufForce, &RECEIVE_BUFFER).is_err() {
        setsockopt(&socket, sockopt::RcvBuf, &RECEIVE_BUFFER)?;
    }
    setsockopt(&socket, sockopt::SndBuf, &SEND_BUFFER)?;
    register(socket)
}

#[expect(
    deprecated,
    reason = "sound here, as the socket owns its file descriptor; the replacement is an unsafe fn"
)]
fn register(socket: CanFdSocket) -> io::Result<AsyncFd<CanFdSocket>> {
    AsyncFd::new(socket)
}

/// The receiving half of a SocketCAN interface.
#[derive(Debug)]
pub struct SocketReader {
    shared: Arc<Shared>,
    /// The number of the interface that the socket is bound to.
    index: u32,
    clock: Clock,
    watch: HostWatch,
    buffers: Box<[[u8; FD_SIZE]; BATCH]>,
    intake: Intake,
}

/// Turns what the socket gives into events.
#[derive(Debug)]
struct Intake {
    ready: VecDeque<BusEvent>,
    stamper: Stamper,
    tracker: LinkTracker,
    tally: Tally,
    /// A frame came although the interface is said to be down. It may have waited, or the interface is up again and the
    /// host was not asked since.
    is_down_in_doubt: bool,
    /// The kernel's count of dropped frames when it was last told; it wraps.
    dropped: u32,
}

impl BusReader for SocketReader {
    async fn recv(&mut self) -> Result<BusEvent, BusError> {
        loop {
            if let Some(event) = self.intake.ready.pop_front() {
                return Ok(event);
            }
            tokio::select! {
                readable = self.shared.socket.readable() => {
                    let mut readable = readable.map_err(|error| io_error(&self.shared.name, error))?;
                    // What is read now came before the clock is read again, and the socket was not empty before it was looked at.
                    let now = self.clock.now();
                    let fd = self.shared.socket.get_ref().as_raw_fd();
                    let received = receive(fd, &mut self.buffers, self.clock, &mut self.intake);
                    if emptied(received) {
                        // What came since has set readiness anew.
                        readable.clear_ready();
                    }
                    drop(readable);
                    self.handle_received(received, now)?;
                }
                (asked, answer) = self.watch.next(self.intake.tracker.asked()) => {
                    self.handle_host(asked, answer)?;
                }
                () = self.shared.look.notified() => self.watch.hurry(),
            }
        }
    }

    fn tally(&self) -> Tally {
        self.intake.tally
    }
}

impl SocketReader {
    fn handle_received(&mut self, received: nix::Result<usize>, now: Now) -> Result<(), BusError> {
        if emptied(received) {
            self.intake.stamper.handle_empty(now);
        }
        if std::mem::take(&mut self.intake.is_down_in_doubt) {
            self.watch.hurry();
        }
        match received {
            Ok(_) | Err(Errno::EAGAIN | Errno::EINTR) => Ok(()),
            Err(Errno::ENETDOWN) => {
                let change = self.intake.tracker.handle_down();
                self.intake.push_link(change, now);
                Ok(())
            }
            Err(Errno::ENODEV) => Err(self.absent(io::Error::from(Errno::ENODEV))),
            Err(error) => Err(io_error(&self.shared.name, io::Error::from(error))),
        }
    }

    fn handle_host(&mut self, asked: u64, answer: io::Result<Option<HostLink>>) -> Result<(), BusError> {
        let Some(host) = answer.map_err(|source| self.absent(source))? else {
            let change = self.intake.tracker.handle_no_answer();
            self.intake.push_link(change, self.clock.now());
            return Ok(());
        };
        if host.index != self.index {
            return Err(self.absent(io::Error::other("it was deleted, and another took its name")));
        }
        let tally = &mut self.intake.tally;
        tally.bit_rate = host.bit_rate.or(tally.bit_rate);
        tally.listens_only = host.listens_only.or(tally.listens_only);
        let tracker = &mut self.intake.tracker;
        let change = match host.observation {
            Some(observation) => tracker.handle_observation(asked, observation),
            None => tracker.handle_no_answer(),
        };
        self.intake.push_link(change, self.clock.now());
        Ok(())
    }

    fn absent(&self, source: io::Error) -> BusError {
        BusError::Absent { interface: self.shared.name.clone(), source }
    }
}

impl Intake {
    fn new(now: Now) -> Self {
        Self {
            ready: VecDeque::with_capacity(2 * BATCH),
            stamper: Stamper::new(now),
            tracker: LinkTracker::default(),
            tally: Tally::default(),
            is_down_in_doubt: false,
            dropped: 0,
        }
    }

    fn handle_message(&mut self, now: Now, bytes: &[u8], received: Option<Timestamp>) {
        match raw_frame::decode(bytes) {
            Received::Frame(frame) => {
                let at = self.stamper.stamp(now, received);
                self.is_down_in_doubt |= self.tracker.link() == Link::Down;
                let change = self.tracker.handle_frame();
                self.push_link(change, at);
                self.ready.push_back(BusEvent::Frame { frame, at });
            }
            Received::Error(report) => {
                let at = self.stamper.stamp(now, received);
                self.tally.error_frames = self.tally.error_frames.saturating_add(u64::from(report.is_error));
                let change = self.tracker.handle_error(report);
                self.push_link(change, at);
            }
            Received::Fd => self.tally.fd_frames = self.tally.fd_frames.saturating_add(1),
            Received::Malformed => tracing::debug!(?bytes, "the socket gave what is no frame"),
        }
    }

    fn handle_dropped(&mut self, dropped: u32) {
        let new = dropped.wrapping_sub(self.dropped);
        self.dropped = dropped;
        self.tally.overruns = self.tally.overruns.saturating_add(u64::from(new));
    }

    fn push_link(&mut self, change: Option<Link>, at: Now) {
        if let Some(link) = change {
            self.ready.push_back(BusEvent::Link { link, at });
        }
    }
}

/// Reads what the socket has, at most [`BATCH`] messages, and says how many there were.
fn receive(
    fd: RawFd,
    buffers: &mut [[u8; FD_SIZE]; BATCH],
    clock: Clock,
    intake: &mut Intake,
) -> nix::Result<usize> {
    // Made anew for each batch: the call shortens the room for control messages to what it used.
    let mut headers = MultiHeaders::<()>::preallocate(BATCH, Some(nix::cmsg_space!(TimeSpec, u32)));
    let mut slices = buffers.each_mut().map(|buffer| [IoSliceMut::new(buffer)]);
    let messages = recvmmsg(fd, &mut headers, slices.iter_mut(), MsgFlags::MSG_DONTWAIT, None)?;
    // Not before: this thread may have been kept waiting for long in between, and the frames came meanwhile.
    let now = clock.now();
    let mut count = 0;
    for message in messages {
        count += 1;
        let mut received = None;
        for control in message.cmsgs().into_iter().flatten() {
            // The other kinds are of protocols that this is not.
            if let ControlMessageOwned::ScmTimestampns(time) = control {
                received = Some(timestamp(time));
            } else if let ControlMessageOwned::RxqOvfl(dropped) = control {
                intake.handle_dropped(dropped);
            }
        }
        intake.handle_message(now, message.iovs().next().unwrap_or_default(), received);
    }
    Ok(count)
}

/// Whether a reading left nothing in the socket. An error of the interface says nothing about the frames that wait behind it.
fn emptied(received: nix::Result<usize>) -> bool {
    match received {
        Ok(count) => count < BATCH,
        Err(error) => error == Errno::EAGAIN,
    }
}

fn timestamp(time: TimeSpec) -> Timestamp {
    Timestamp::from_micros(time.tv_sec().saturating_mul(1_000_000).saturating_add(time.tv_nsec() / 1_000))
}

fn io_error(name: &str, source: io::Error) -> BusError {
    BusError::Io { interface: name.to_owned(), source }
}

/// The sending half of a SocketCAN interface.
#[derive(Debug)]
pub struct SocketWriter {
    shared: Arc<Shared>,
    /// The queue was full to the end last time: it need not be waited for again until it moves.
    stuck: bool,
}

impl BusWriter for SocketWriter {
    async fn send(&mut self, frame: &CanFrame) -> Result<(), BusError> {
        let message = raw_frame::encode(frame);
        let mut tries = if self.stuck { TRIES_WHEN_STUCK } else { TRIES };
        loop {
            match send(self.shared.socket.get_ref().as_raw_fd(), &message, MsgFlags::MSG_DONTWAIT) {
                Ok(_) => {
                    self.stuck = false;
                    return Ok(());
                }
                Err(Errno::EINTR) => {}
                // The queue of the interface, or the send buffer of the socket, is full. The former is not
                // something that one can wait for; the latter is treated alike.
                Err(Errno::ENOBUFS | Errno::EAGAIN) if tries > 1 => {
                    tries -= 1;
                    tokio::time::sleep(Duration::from_millis(1)).await;
                }
                Err(error) => return Err(self.failed(error)),
            }
        }
    }
}

impl SocketWriter {
    fn failed(&mut self, error: Errno) -> BusError {
        let interface = self.shared.name.clone();
        if matches!(error, Errno::ENOBUFS | Errno::EAGAIN) {
            self.stuck = true;
            return BusError::Busy { interface };
        }
        // The error may have been meant for the reader, who will not get it again.
        self.shared.look.notify_one();
        let source = io::Error::from(error);
        if error == Errno::ENETDOWN {
            BusError::Down { interface }
        } else if matches!(error, Errno::ENODEV | Errno::ENXIO) {
            BusError::Absent { interface, source }
        } else {
            BusError::Io { interface, source }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn frames_that_wait_behind_an_error_are_read_without_waiting_for_another() {
        assert!(emptied(Ok(0)) && emptied(Ok(BATCH - 1)) && emptied(Err(Errno::EAGAIN)));
        assert!(!emptied(Ok(BATCH)) && !emptied(Err(Errno::ENETDOWN)) && !emptied(Err(Errno::EINTR)));
    }

    #[test]
    fn a_frame_on_an_interface_that_is_said_to_be_down_casts_doubt_on_it() {
        let now = Now::from_millis(0);
        let mut intake = Intake::new(now);
        let message = raw_frame::encode(&"181#01".parse().unwrap());
        intake.handle_message(now, &message, None);
        assert!(!intake.is_down_in_doubt);
        intake.tracker.handle_down();
        intake.handle_message(now, &message, None);
        assert!(intake.is_down_in_doubt);
        assert_eq!(intake.tracker.link(), Link::Down, "it may have waited since before");
    }
}
