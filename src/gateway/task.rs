//! The task that owns the gateway and the image's writer. \[IO\]
//!
//! The law of the core, written once: take what came in, do what it wants done, publish, wait. It waits for its
//! inputs and for nothing else: a bus whose queue is full, or an asker who is gone, never holds it up.

use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::Duration;

use tokio::sync::{mpsc, oneshot, watch};
use tokio::time::{MissedTickBehavior, interval, sleep, sleep_until};
use tokio_util::sync::CancellationToken;

use super::command::desk::{Request, Requests};
use super::order::{Exchange, Order};
use super::{Command, Gateway, Health, Input, Outcome, Output};
use crate::can::{BusEvent, BusIndex, CanFrame};
use crate::process_image::{ImageWriter, process_image};
use crate::time::{Clock, Instant, Now};

/// Events of buses that are taken in before the image is published once.
const BATCH: usize = 128;

/// Places of a bus's queue that bytes for serial lines leave free, so that a slow bus delays them and not guard requests.
const KEPT_FREE: usize = 48;

/// How long the last frames may wait for a place in the queue of their bus.
const LAST_FRAMES_WAIT: Duration = Duration::from_millis(50);

/// A deadline that is seen this late tells that the process was kept from running, and the tasks of the buses with it.
const LATE: Duration = Duration::from_millis(20);

/// How long these then have to hand over what the kernel keeps for them, before the deadline counts.
const CATCH_UP: Duration = Duration::from_millis(5);

/// The image is written at least this often, change or not: readers see by it that the core runs.
const SIGN_OF_LIFE: Duration = Duration::from_secs(1);

/// All that the task holds besides its inputs.
struct Driver {
    gateway: Gateway,
    writer: ImageWriter,
    transmit: Vec<mpsc::Sender<CanFrame>>,
    /// By [`BusIndex`]: the number under which its task tells events.
    ports: Vec<usize>,
    /// Askers that wait, by the number that their command bears inside. Never more than commands under way: each
    /// command is answered, and its number is the task's own, since askers choose theirs independently.
    waiting: BTreeMap<u64, oneshot::Sender<Outcome>>,
    commands_taken: u64,
    clock: Clock,
}

/// Runs the gateway until `stop`, or until nobody can send it anything any more. At the end CANopen nodes
/// are sent nothing and stay as they are; watchdogs of modules that the gateway set going are switched off. Gives back the
/// events that nobody took: as long as somebody holds their end, the buses send what is left.
///
/// `transmit` is by [`BusIndex`], and so are the numbers that events bear, until an [`Order`] brings others. A frame for which
/// the queue of its bus is full is given up and counted.
#[expect(clippy::too_many_arguments, reason = "each is one end of a link of the picture in lib.rs")]
pub async fn run(
    gateway: Gateway,
    writer: ImageWriter,
    mut events: mpsc::Receiver<(BusIndex, BusEvent)>,
    transmit: Vec<mpsc::Sender<CanFrame>>,
    mut requests: Requests,
    mut health: watch::Receiver<Health>,
    mut orders: mpsc::Receiver<Order>,
    clock: Clock,
    stop: CancellationToken,
) -> mpsc::Receiver<(BusIndex, BusEvent)> {
    let ports = (0..transmit.len()).collect();
    let mut driver =
        Driver { gateway, writer, transmit, ports, waiting: BTreeMap::new(), commands_taken: 0, clock };
    let mut batch = Vec::with_capacity(BATCH);
    let (mut buses_gone, mut askers_gone, mut health_gone, mut orders_gone) = (false, false, false, false);
    let first_health = *health.borrow_and_update();
    driver.take(clock.now(), Input::Health(first_health));
    driver.finish(driver.due(), Some(clock.now()));
    let mut sign_of_life = interval(SIGN_OF_LIFE);
    sign_of_life.set_missed_tick_behavior(MissedTickBehavior::Skip);
    let mut buses_had_a_turn = false;
    while !buses_gone || !askers_gone {
        let wake = driver.due().map(|due| clock.deadline(due));
        let mut time_has_come_to = None;
        tokio::select! {
            () = stop.cancelled() => break,
            count = events.recv_many(&mut batch, BATCH), if !buses_gone => {
                buses_gone = count == 0;
                time_has_come_to = driver.take_events(&mut batch);
            }
            request = requests.next(), if !askers_gone => match request {
                Some(Request::Command(command, reply)) => driver.take_command(command, reply),
                Some(Request::Refused(refused)) => driver.take(clock.now(), Input::Refused(refused)),
                None => askers_gone = true,
            },
            changed = health.changed(), if !health_gone => {
                health_gone = changed.is_err();
                let health = *health.borrow_and_update();
                driver.take(clock.now(), Input::Health(health));
            }
            order = orders.recv(), if !orders_gone => match order {
                Some(order) => {
                    driver.obey(order, &mut requests);
                    askers_gone = false;
                }
                None => orders_gone = true,
            },
            () = sleep_until(wake.unwrap_or_else(|| clock.deadline(Instant::START))), if wake.is_some() => {}
            _ = sign_of_life.tick() => {}
        }
        let due = driver.due();
        // While events wait, time has come as far as the newest that was taken and no further: a deadline must not
        // fire before the frame that keeps it, however late that is read.
        if events.is_empty() {
            let now = clock.now();
            if !buses_had_a_turn && due.is_some_and(|due| now.instant.since(due) > LATE) {
                buses_had_a_turn = true;
                sleep(CATCH_UP).await;
                continue;
            }
            buses_had_a_turn = false;
            time_has_come_to = Some(now);
        }
        driver.finish(due, time_has_come_to);
    }
    driver.gateway.handle_stop(clock.now());
    driver.send_the_last().await;
    events
}

impl Driver {
    /// One input, then drain.
    fn take(&mut self, now: Now, input: Input) {
        self.gateway.handle_input(now, input);
        self.drain(now);
    }

    /// When the gateway wants to be called next.
    fn due(&self) -> Option<Instant> {
        self.gateway.poll_timeout().map(|(due, _)| due)
    }

    /// The receive time of the newest event.
    fn take_events(&mut self, batch: &mut Vec<(BusIndex, BusEvent)>) -> Option<Now> {
        self.gateway.handle_clock(self.clock.now());
        let mut newest: Option<Now> = None;
        for (bus, event) in batch.drain(..) {
            let (at, time_comes) = match &event {
                // What was received before it may still wait in the kernel.
                BusEvent::Sent { at, .. } => (*at, false),
                BusEvent::Frame { at, .. }
                | BusEvent::Link { at, .. }
                | BusEvent::NotSent { at, .. }
                | BusEvent::Counters { at, .. } => (*at, true),
            };
            if time_comes && newest.is_none_or(|newest| newest.instant < at.instant) {
                newest = Some(at);
            }
            // Of a bus that has gone, nothing counts any more.
            let place = self.ports.iter().position(|port| *port == bus.0);
            if let Some(bus) = place.map(BusIndex) {
                self.take(at, Input::Bus { bus, event });
            }
        }
        newest
    }

    /// Does what a reload asks for. Where another table comes, requests come from another queue from then on.
    fn obey(&mut self, order: Order, requests: &mut Requests) {
        let now = self.clock.now();
        match order {
            Order::Exchange(exchange) => return self.exchange(now, *exchange, requests),
            Order::Loaded(text) => self.gateway.configuration_loaded(now, &text),
            Order::Rejected(why) => self.gateway.set_configuration_rejected(now, Some(&why)),
            Order::Good => self.gateway.set_configuration_rejected(now, None),
            Order::NumberAfter { told, newest, done } => {
                let gateway = &mut self.gateway;
                self.writer.apply(|image| gateway.number_events_after(told, newest, image));
                // Nobody waits for it when the program ends meanwhile.
                let _ = done.send(());
            }
        }
        self.drain(now);
    }

    /// Readers of the image before see it as it was in the end, and go on with that until they are given the new one. What was
    /// asked for by the places of the table before is not done by those of the new one.
    fn exchange(&mut self, now: Now, exchange: Exchange, requests: &mut Requests) {
        let Exchange { table, kept, transmit, ports, simulated, requests: next, done } = exchange;
        let refused = requests.give_way_to(&next);
        *requests = next;
        self.take(now, Input::Refused(refused));
        self.gateway.prepare_exchange(now, &table, &kept);
        self.drain(now);
        self.finish(None, None);
        let before = std::mem::replace(&mut self.gateway, Gateway::new(Arc::default(), now));
        let (gateway, image) = self.writer.apply(|old| before.exchange(table, &kept, now, old));
        let (writer, reader) = process_image(image);
        self.gateway = gateway;
        for bus in simulated {
            self.gateway.mark_simulated(bus);
        }
        (self.transmit, self.ports) = (transmit, ports);
        let before = std::mem::replace(&mut self.writer, writer);
        self.drain(now);
        // Time has not come further by that: frames that keep a deadline may still wait to be read.
        self.finish(None, None);
        // Nobody waits for it when the program ends meanwhile.
        let _ = done.send((reader, before));
    }

    fn take_command(&mut self, command: Command, reply: oneshot::Sender<Outcome>) {
        self.commands_taken += 1;
        let id = self.commands_taken;
        self.waiting.insert(id, reply);
        self.take(self.clock.now(), Input::Command(Command { id, ..command }));
    }

    /// What became due, then publish. `due` is what [`due`](Self::due) says since the last input.
    fn finish(&mut self, due: Option<Instant>, now: Option<Now>) {
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

    /// What is still to leave; a full queue has a moment to empty.
    async fn send_the_last(&mut self) {
        while let Some(output) = self.gateway.poll_output() {
            if let Output::Transmit { bus, frame } = output
                && let Some(queue) = self.transmit.get(bus.0)
            {
                // A bus that takes nothing is no reason to stay.
                let _ = queue.send_timeout(frame, LAST_FRAMES_WAIT).await;
            }
        }
    }

    fn drain(&mut self, now: Now) {
        while let Some(output) = self.gateway.poll_output() {
            match output {
                Output::Transmit { bus, frame } => {
                    let keep_free = if self.gateway.can_wait(bus, &frame) { KEPT_FREE } else { 0 };
                    let sent = self.transmit.get(bus.0).is_some_and(|queue| {
                        (keep_free == 0 || queue.capacity() > keep_free) && queue.try_send(frame).is_ok()
                    });
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
    use super::*;
    use crate::can::{CanId, Link};
    use crate::gateway::{Action, CommandSource, fixture};
    use crate::process_image::{AlarmIndex, BusState, ImageReader, NodeIndex, Quality, Value};

    struct Ends {
        events: mpsc::Sender<(BusIndex, BusEvent)>,
        frames: mpsc::Receiver<CanFrame>,
        commands: mpsc::Sender<(Command, oneshot::Sender<Outcome>)>,
        health: watch::Sender<Health>,
        reader: ImageReader,
        clock: Clock,
        stop: CancellationToken,
        task: tokio::task::JoinHandle<mpsc::Receiver<(BusIndex, BusEvent)>>,
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
            commands_in.into(),
            health_in,
            mpsc::channel(1).1,
            clock,
            stop.clone(),
        ));
        let up = BusEvent::Link { link: Link::ErrorActive, at: clock.now() };
        events.try_send((BusIndex(0), up)).unwrap();
        Ends { events, frames, commands, health, reader, clock, stop, task }
    }

    impl Ends {
        /// What waits in the queue leaves now, as the bus says. How many data bytes for the line of the module that is.
        fn take_frames(&mut self) -> usize {
            let mut bytes = 0;
            while let Ok(frame) = self.frames.try_recv() {
                bytes += if frame.id() == CanId::Standard(0x105) { frame.data().len() } else { 0 };
                let sent = BusEvent::Sent { frame, at: self.clock.now() };
                self.events.try_send((BusIndex(0), sent)).unwrap();
            }
            bytes
        }

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
    async fn a_reply_that_waited_while_the_process_could_not_run_keeps_its_deadline() {
        let mut ends = start(64);
        assert_eq!(ends.frames.recv().await.unwrap().to_string(), "701#R1");
        ends.frame("701#05").await;
        ends.until(|image| image.nodes[0].online).await;
        while ends.frames.recv().await.unwrap().to_string() != "701#R1" {}
        // The reply comes at once, then the process is stopped for three seconds: the deadline is over when it goes on, and
        // the task of the bus is the second that runs.
        let at = ends.clock.now();
        tokio::time::advance(Duration::from_secs(3)).await;
        tokio::time::sleep(Duration::from_millis(1)).await;
        let reply = BusEvent::Frame { frame: "701#85".parse().unwrap(), at };
        ends.events.send((BusIndex(0), reply)).await.unwrap();
        while ends.frames.recv().await.unwrap().to_string() != "701#R1" {}
        assert_eq!(ends.reader.read(|image| image.nodes[0].counters.guard_misses), 0);
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
        let command = Command { id: 7, source: CommandSource::web("test".into()), action };
        ends.until(|image| image.buses[0].state == BusState::ErrorActive).await;
        let (reply, answer) = oneshot::channel();
        ends.commands.send((command, reply)).await.unwrap();
        assert_eq!(answer.await.unwrap(), Outcome::Done);
        let stop = async { while ends.frames.recv().await.unwrap().to_string() != "000#0201" {} };
        tokio::time::timeout(Duration::from_secs(60), stop).await.unwrap();
        let unknown = Command {
            id: 7,
            source: CommandSource::web("test".into()),
            action: Action::Acknowledge { alarm: AlarmIndex(9_999), raise: None },
        };
        let (reply, answer) = oneshot::channel();
        ends.commands.send((unknown, reply)).await.unwrap();
        assert_eq!(answer.await.unwrap(), Outcome::Unknown);
    }

    #[tokio::test(start_paused = true)]
    async fn health_is_shown() {
        let mut ends = start(64);
        ends.health
            .send(Health { mqtt_connected: Some(true), clock_synchronised: true, ..Health::default() })
            .unwrap();
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

    /// An engine, and a module to whose line 4,096 bytes are being sent.
    async fn start_with_bytes_for_a_line(transmit_bound: usize) -> (Ends, oneshot::Receiver<Outcome>) {
        let sketch = crate::mapping::Sketch::new()
            .bus(|bus| bus.bit_rate = Some(crate::mapping::At::nowhere(1_000_000)));
        let sketch = sketch.node("engine", 1, "motortech-detcon", |_| ());
        let sketch = sketch.node("reader", 0x1A, "esd-can-cbm-sio1", |node| {
            node.channel.insert(
                crate::mapping::At::nowhere("1".into()),
                crate::mapping::installation::ChannelEntry::default(),
            );
        });
        let mut ends = start_with(sketch.build().unwrap().0, transmit_bound);
        ends.until(|image| image.lines[0].open).await;
        let line = crate::process_image::LineIndex(0);
        let action = Action::SerialSend { line, bytes: vec![b'x'; 4_096] };
        let (reply, answer) = oneshot::channel();
        let command = Command { id: 1, source: CommandSource::serial("test".into()), action };
        ends.commands.send((command, reply)).await.unwrap();
        (ends, answer)
    }

    #[tokio::test(start_paused = true)]
    async fn r_esd_037_a_gateway_that_is_late_does_not_overrun_a_line() {
        let (mut ends, _answer) = start_with_bytes_for_a_line(1_024).await;
        let mut taken = 0;
        for _ in 0..1_000 {
            tokio::time::sleep(Duration::from_millis(1)).await;
            taken += ends.take_frames();
        }
        assert!(taken > 900, "{taken} bytes in a second of 9600 bit/s");
        // The process stands still while the line says something every millisecond.
        let from = ends.clock.now();
        tokio::time::advance(Duration::from_millis(500)).await;
        for late in 0..500 {
            let at = from.later(Duration::from_millis(late));
            let event = BusEvent::Frame { frame: "104#41".parse().unwrap(), at };
            ends.events.try_send((BusIndex(0), event)).unwrap();
        }
        let mut burst = 0;
        for _ in 0..20 {
            tokio::time::sleep(CATCH_UP / 10).await;
            burst += ends.take_frames();
        }
        assert!(
            (64..=80).contains(&burst),
            "{burst} bytes in {:?}, of which a module keeps 256",
            2 * CATCH_UP
        );
    }

    #[tokio::test(start_paused = true)]
    async fn bytes_for_a_serial_line_leave_room_for_what_cannot_wait() {
        let (mut ends, mut answer) = start_with_bytes_for_a_line(64).await;
        // Nobody takes frames from the queue: no more bytes for the line are put there than the module has room for.
        tokio::time::sleep(Duration::from_millis(800)).await;
        let frames = ends.frames.len();
        let bytes = ends.take_frames();
        assert!(bytes == 64 && frames > 8, "{bytes} {frames}");
        assert!(answer.try_recv().is_err(), "most of it waits");
        assert_eq!(ends.reader.read(|image| image.buses[0].frames_not_sent), 0);
        // The bus takes frames again.
        let taking = async {
            loop {
                tokio::time::sleep(Duration::from_millis(1)).await;
                ends.take_frames();
            }
        };
        let answered = tokio::select! { answer = answer => answer.unwrap(), () = taking => unreachable!() };
        assert_eq!(answered, Outcome::Done);
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
