//! The task that owns the gateway and the image's writer. \[IO\]
//!
//! The law of the core, written once: take what came in, do what it wants done, publish, wait. It waits for its
//! inputs and for nothing else: a bus whose queue is full, or an asker who is gone, never holds it up.

use std::collections::BTreeMap;
use std::time::Duration;

use tokio::sync::{mpsc, oneshot, watch};
use tokio::time::{MissedTickBehavior, interval, sleep_until};
use tokio_util::sync::CancellationToken;

use super::{Command, Gateway, Health, Input, Outcome, Output};
use crate::can::{BusEvent, BusIndex, CanFrame};
use crate::process_image::ImageWriter;
use crate::time::{Clock, Instant, Now};

/// Events of buses that are taken in before the image is published once.
const BATCH: usize = 128;

/// The image is written at least this often, change or not: readers see by it that the core runs.
const SIGN_OF_LIFE: Duration = Duration::from_secs(1);

/// All that the task holds besides its inputs.
struct Driver {
    gateway: Gateway,
    writer: ImageWriter,
    transmit: Vec<mpsc::Sender<CanFrame>>,
    /// Askers that wait, by the number that their command bears inside. Never more than commands under way: each
    /// command is answered, and its number is the task's own, since askers choose theirs independently.
    waiting: BTreeMap<u64, oneshot::Sender<Outcome>>,
    commands_taken: u64,
    clock: Clock,
}

/// Runs the gateway until `stop`, or until nobody can send it anything any more. At the end nothing is sent: the
/// nodes stay as they are.
///
/// `transmit` is by [`BusIndex`]. A frame for which the queue of its bus is full is given up and counted.
#[expect(clippy::too_many_arguments, reason = "each is one end of a link of the picture in lib.rs")]
pub async fn run(
    gateway: Gateway,
    writer: ImageWriter,
    mut events: mpsc::Receiver<(BusIndex, BusEvent)>,
    transmit: Vec<mpsc::Sender<CanFrame>>,
    mut commands: mpsc::Receiver<(Command, oneshot::Sender<Outcome>)>,
    mut health: watch::Receiver<Health>,
    clock: Clock,
    stop: CancellationToken,
) {
    let mut driver = Driver { gateway, writer, transmit, waiting: BTreeMap::new(), commands_taken: 0, clock };
    let mut batch = Vec::with_capacity(BATCH);
    let (mut buses_gone, mut askers_gone, mut health_gone) = (false, false, false);
    let first_health = *health.borrow_and_update();
    driver.take(clock.now(), Input::Health(first_health));
    driver.finish(Some(clock.now()));
    let mut sign_of_life = interval(SIGN_OF_LIFE);
    sign_of_life.set_missed_tick_behavior(MissedTickBehavior::Skip);
    while !buses_gone || !askers_gone {
        let due = driver.gateway.poll_timeout().map(|(due, _)| clock.deadline(due));
        let mut time_has_come_to = None;
        tokio::select! {
            () = stop.cancelled() => break,
            count = events.recv_many(&mut batch, BATCH), if !buses_gone => {
                buses_gone = count == 0;
                time_has_come_to = driver.take_events(&mut batch);
            }
            command = commands.recv(), if !askers_gone => match command {
                Some((command, reply)) => driver.take_command(command, reply),
                None => askers_gone = true,
            },
            changed = health.changed(), if !health_gone => {
                health_gone = changed.is_err();
                let health = *health.borrow_and_update();
                driver.take(clock.now(), Input::Health(health));
            }
            () = sleep_until(due.unwrap_or_else(|| clock.deadline(Instant::START))), if due.is_some() => {}
            _ = sign_of_life.tick() => {}
        }
        // While events wait, time has come as far as the newest that was taken and no further: a deadline must not
        // fire before the frame that keeps it, however late that is read.
        if events.is_empty() {
            time_has_come_to = Some(clock.now());
        }
        driver.finish(time_has_come_to);
    }
}

impl Driver {
    /// One input, then drain.
    fn take(&mut self, now: Now, input: Input) {
        self.gateway.handle_input(now, input);
        self.drain(now);
    }

    /// The receive time of the newest event.
    fn take_events(&mut self, batch: &mut Vec<(BusIndex, BusEvent)>) -> Option<Now> {
        let mut newest: Option<Now> = None;
        for (bus, event) in batch.drain(..) {
            let at = match &event {
                BusEvent::Frame { at, .. }
                | BusEvent::Link { at, .. }
                | BusEvent::NotSent { at, .. }
                | BusEvent::Counters { at, .. } => *at,
            };
            if newest.is_none_or(|newest| newest.instant < at.instant) {
                newest = Some(at);
            }
            self.take(at, Input::Bus { bus, event });
        }
        newest
    }

    fn take_command(&mut self, command: Command, reply: oneshot::Sender<Outcome>) {
        self.commands_taken += 1;
        let id = self.commands_taken;
        self.waiting.insert(id, reply);
        self.take(self.clock.now(), Input::Command(Command { id, ..command }));
    }

    /// What became due, then publish.
    fn finish(&mut self, now: Option<Now>) {
        let due = self.gateway.poll_timeout().map(|(due, _)| due);
        if let Some(now) = now.filter(|now| due.is_some_and(|due| due <= now.instant)) {
            self.gateway.handle_timeout(now);
            self.drain(now);
        }
        let Self { gateway, writer, clock, .. } = self;
        let written_at = clock.now().instant;
        writer.apply(|image| {
            gateway.publish(image);
            image.written_at = written_at;
        });
    }

    fn drain(&mut self, now: Now) {
        while let Some(output) = self.gateway.poll_output() {
            match output {
                Output::Transmit { bus, frame } => {
                    let sent = self.transmit.get(bus.0).is_some_and(|queue| queue.try_send(frame).is_ok());
                    if !sent {
                        self.gateway.handle_refused(now, bus, &frame);
                    }
                }
                Output::Reply { id, outcome } => {
                    if let Some(reply) = self.waiting.remove(&id) {
                        // An asker who has gone does not want to know.
                        let _ = reply.send(outcome);
                    }
                }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use super::*;
    use crate::can::Link;
    use crate::gateway::{Action, CommandSource, fixture};
    use crate::process_image::{AlarmIndex, BusState, ImageReader, NodeIndex, Quality, Value, process_image};

    struct Ends {
        events: mpsc::Sender<(BusIndex, BusEvent)>,
        frames: mpsc::Receiver<CanFrame>,
        commands: mpsc::Sender<(Command, oneshot::Sender<Outcome>)>,
        health: watch::Sender<Health>,
        reader: ImageReader,
        clock: Clock,
        stop: CancellationToken,
        task: tokio::task::JoinHandle<()>,
    }

    fn start(transmit_bound: usize) -> Ends {
        start_with(fixture::table(), transmit_bound)
    }

    fn start_with(table: crate::mapping::TagTable, transmit_bound: usize) -> Ends {
        let clock = Clock::start();
        let gateway = Gateway::new(Arc::new(table), clock.now());
        let (writer, reader) = process_image(gateway.empty_image());
        let (events, events_in) = mpsc::channel(1024);
        let (transmit, frames) = mpsc::channel(transmit_bound);
        let (commands, commands_in) = mpsc::channel(32);
        let (health, health_in) = watch::channel(Health::default());
        let stop = CancellationToken::new();
        let task = tokio::spawn(run(
            gateway,
            writer,
            events_in,
            vec![transmit],
            commands_in,
            health_in,
            clock,
            stop.clone(),
        ));
        let up = BusEvent::Link { link: Link::ErrorActive, at: clock.now() };
        events.try_send((BusIndex(0), up)).unwrap();
        Ends { events, frames, commands, health, reader, clock, stop, task }
    }

    impl Ends {
        async fn frame(&self, frame: &str) {
            let event = BusEvent::Frame { frame: frame.parse().unwrap(), at: self.clock.now() };
            self.events.send((BusIndex(0), event)).await.unwrap();
        }

        /// Waits, in tokio's paused time, until the image is as it should be.
        async fn until(&mut self, what: impl Fn(&crate::process_image::ProcessImage) -> bool) {
            let reached = async {
                while !self.reader.read(&what) {
                    assert!(self.reader.changed().await, "the task has ended");
                }
            };
            tokio::time::timeout(Duration::from_secs(60), reached).await.expect("it never came to that");
        }
    }

    #[tokio::test(start_paused = true)]
    async fn frames_become_values_and_a_node_that_does_not_answer_is_lost() {
        let mut ends = start(64);
        ends.frame("181#3301").await;
        ends.until(|image| image.tags[0].value == Value::Float(20.0)).await;
        ends.until(|image| !image.tags[0].quality.is_usable()).await;
        let quality = ends.reader.read(|image| image.tags[0].quality);
        assert_ne!(quality, Quality::NEVER);
        assert!(ends.clock.now().instant >= Instant::from_millis(1_100), "three requests unanswered");
    }

    #[tokio::test(start_paused = true)]
    async fn guard_requests_reach_the_bus_and_a_full_queue_is_counted_not_waited_for() {
        let mut ends = start(1);
        assert_eq!(ends.frames.recv().await.unwrap().to_string(), "701#R1");
        ends.until(|image| image.buses[0].frames_not_sent >= 3).await;
    }

    #[tokio::test(start_paused = true)]
    async fn r_det_009_a_command_is_answered_and_its_frame_sent() {
        let mut ends = start(64);
        let action = Action::Nmt { node: NodeIndex(0), request: crate::canopen::NmtRequest::Stop };
        let command = Command { id: 7, source: CommandSource::Web("test".into()), action };
        ends.until(|image| image.buses[0].state == BusState::ErrorActive).await;
        let (reply, answer) = oneshot::channel();
        ends.commands.send((command, reply)).await.unwrap();
        assert_eq!(answer.await.unwrap(), Outcome::Done);
        let stop = async { while ends.frames.recv().await.unwrap().to_string() != "000#0201" {} };
        tokio::time::timeout(Duration::from_secs(60), stop).await.unwrap();
        let unknown = Command {
            id: 7,
            source: CommandSource::Web("test".into()),
            action: Action::Acknowledge { alarm: AlarmIndex(9_999) },
        };
        let (reply, answer) = oneshot::channel();
        ends.commands.send((unknown, reply)).await.unwrap();
        assert_eq!(answer.await.unwrap(), Outcome::Unknown);
    }

    #[tokio::test(start_paused = true)]
    async fn health_is_shown() {
        let mut ends = start(64);
        ends.health.send(Health { mqtt_connected: Some(true), clock_synchronised: true }).unwrap();
        ends.until(|image| image.mqtt_connected && image.clock_synchronised).await;
    }

    #[tokio::test(start_paused = true)]
    async fn the_image_is_written_every_second_though_nothing_happens() {
        let ends = start_with(crate::mapping::TagTable::default(), 64);
        tokio::time::sleep(Duration::from_secs(100)).await;
        let written_at = ends.reader.read(|image| image.written_at);
        assert!(ends.clock.now().instant.since(written_at) <= SIGN_OF_LIFE, "{written_at:?}");
        ends.stop.cancel();
        ends.task.await.unwrap();
        tokio::time::sleep(Duration::from_secs(100)).await;
        assert!(ends.reader.read(|image| image.written_at) <= written_at + SIGN_OF_LIFE);
    }

    #[tokio::test(start_paused = true)]
    async fn at_the_end_no_frame_is_sent() {
        let mut ends = start(64);
        ends.frame("701#05").await;
        ends.until(|image| image.nodes[0].online).await;
        while ends.frames.try_recv().is_ok() {}
        ends.stop.cancel();
        ends.task.await.unwrap();
        assert_eq!(ends.frames.recv().await, None);
    }
}
