//! Whatever comes in, a network does not fall, keeps little, sends nothing it must not, and calls nothing configured that is
//! not.

use std::collections::BTreeMap;
use std::time::Duration;

use proptest::prelude::*;

use super::bench::{Pretended, id, managed, module, network, watchdog};
use crate::can::{CanFrame, CanId};
use crate::esd::{
    CanTxMode, FlowControl, InitCommand, ManagementSettings, MinChar, ModuleEvent, ModuleIndex, ModuleKind,
    ModuleNumber, ModuleSettings, Network, NetworkOutput, NetworkSettings, Order, SendOutcome, Setting,
    WatchdogMode,
};
use crate::time::{Instant, Now, Timestamp};

fn moment(micros: u64) -> Now {
    Now { instant: Instant::from_micros(micros), utc: Timestamp::default() }
}

/// Numbers that look random, the same in each run.
struct Dice(u64);

impl Dice {
    fn place(&mut self, sides: usize) -> usize {
        usize::try_from(self.roll(u64::try_from(sides).unwrap())).unwrap()
    }

    fn pick<T: Copy, const N: usize>(&mut self, of: [T; N]) -> T {
        of[self.place(N)]
    }

    fn roll(&mut self, sides: u64) -> u64 {
        self.0 = self.0.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        (self.0 >> 33) % sides
    }

    fn byte(&mut self) -> u8 {
        let near = [0, 1, 2, 3, 6, 0x0A, 0x0D, 0x11, 0x12, 0x13, 0x30, 0x31, 0x7D, 0xC1, 0xFD, 0xFF];
        if self.roll(2) == 0 { self.pick(near) } else { u8::try_from(self.roll(256)).unwrap() }
    }
}

fn busy_network(passive: bool) -> NetworkSettings {
    let mut first = managed(|management| {
        management.watchdog = Some(watchdog(WatchdogMode::Remote));
        management.store = true;
        management.switch = Some(0x12);
    });
    first.channels[0].flow_control = FlowControl::XonXoff;
    first.channels[0].framing.idle = Some(Duration::from_millis(5));
    let mut third = module(ModuleKind::Sio1, 0x26);
    third.management = None;
    NetworkSettings { passive, ..network(vec![first, module(ModuleKind::Sio4, 0x11), third]) }
}

fn random_frame(dice: &mut Dice) -> CanFrame {
    let near = [0x0B4, 0x0B5, 0x0AA, 0x0AB, 0x0AE, 0x0AF, 0x17C, 0x17D, 0x512, 0x567, 0x567, 0x567, 0x700];
    let number = dice.pick(near);
    let length = if dice.roll(3) == 0 { dice.place(9) } else { 3 };
    let mut data: Vec<u8> = (0..length).map(|_| dice.byte()).collect();
    if dice.roll(2) == 0 && data.len() > 2 {
        // The head of an answer.
        data[0] = dice.pick([0, 0, 1, 1, 2, 3, 6, 1]);
        data[1] = dice.pick([0, 3, 1, 2, 0, 0, 0, 2]);
    }
    match dice.roll(20) {
        0 => CanFrame::remote_frame(id(number), u8::try_from(length).unwrap()).unwrap(),
        1 => CanFrame::data_frame(CanId::extended(number.into()).unwrap(), &data).unwrap(),
        _ => CanFrame::data_frame(id(number), &data).unwrap(),
    }
}

#[test]
fn a_hundred_thousand_random_frames_do_no_harm() {
    for passive in [false, true] {
        let mut network = Network::new(busy_network(passive), moment(0));
        let mut dice = Dice(1);
        let mut now = 0;
        let (mut taken, mut done) = (0_u64, 0_u64);
        let mut ours = std::collections::VecDeque::new();
        for step in 0..100_000_u64 {
            now += dice.roll(3000);
            if dice.roll(500) == 0 {
                now += 1_000_000 * dice.roll(70);
            }
            let place = ModuleIndex(dice.place(4));
            match dice.roll(100) {
                0 => network.handle_link(moment(now), dice.roll(4) > 0),
                1..=3 => {
                    let bytes = vec![0x55; dice.place(5000)];
                    taken += u64::from(network.send(moment(now), place, dice.place(6), step, bytes).is_ok());
                }
                4..=5 => {
                    if let Some(frame) = ours.pop_front() {
                        network.handle_not_sent(moment(now), &frame);
                    }
                }
                6 => {
                    let order =
                        dice.pick([Order::Suspend, Order::Continue, Order::Reset, Order::DefaultReset]);
                    let module = ModuleNumber::new(dice.pick([0x11, 0x12, 0x26, 0]));
                    network.handle_frame(moment(now), &InitCommand::Supervisor { module, order }.frame());
                }
                7..=10 => network
                    .handle_frame(moment(now.saturating_sub(dice.roll(100_000))), &random_frame(&mut dice)),
                _ => network.handle_frame(moment(now), &random_frame(&mut dice)),
            }
            for round in 0.. {
                assert!(round < 10_000, "does not come to rest");
                let mut outputs = 0;
                while let Some(output) = network.poll_output() {
                    outputs += 1;
                    assert!(outputs < 1000, "too much at once");
                    match output {
                        NetworkOutput::Transmit(frame) => {
                            assert!(!passive, "{frame}");
                            assert_allowed(&frame);
                            if dice.roll(2) == 0 {
                                network.handle_sent(moment(now), &frame);
                            }
                            ours.push_back(frame);
                            ours.truncate(16);
                        }
                        NetworkOutput::Module(_, ModuleEvent::SendDone { .. }) => done += 1,
                        NetworkOutput::Module(_, ModuleEvent::Message { bytes, .. }) => {
                            assert!(bytes.len() <= 64);
                        }
                        NetworkOutput::Module(..) | NetworkOutput::ForeignCommand(_) => {}
                    }
                }
                if network.poll_timeout().is_none_or(|(at, _)| at > moment(now).instant) {
                    break;
                }
                network.handle_timeout(moment(now));
            }
        }
        network.handle_link(moment(now), false);
        network.handle_timeout(moment(now));
        while let Some(output) = network.poll_output() {
            done += u64::from(matches!(output, NetworkOutput::Module(_, ModuleEvent::SendDone { .. })));
        }
        assert_eq!(taken, done, "each job that was taken was told of once");
        assert!(passive || taken > 100, "{taken}");
    }
}

/// Frames that a network may send: its own questions, settings and orders, and data for lines.
fn assert_allowed(frame: &CanFrame) {
    let lines = [0x0B5, 0x0AF, 0x0B0, 0x0B1, 0x0B2, 0x0B3, 0x17D];
    if frame.id() == id(0x700) {
        match InitCommand::parse(frame).unwrap() {
            InitCommand::Request { reply_id, .. } => assert_eq!(reply_id, 0x567),
            InitCommand::Set { setting, .. } => {
                assert!(!matches!(setting, Setting::Number(_) | Setting::BitRate(_)), "{frame}");
            }
            InitCommand::Supervisor { .. } | InitCommand::Service { .. } => panic!("{frame}"),
        }
    } else if frame.is_remote() {
        assert_eq!(frame.id(), id(0x512));
    } else {
        assert!(lines.iter().any(|line| frame.id() == id(*line)) && !frame.data().is_empty(), "{frame}");
    }
}

fn wishes(switch: u8, min_char: u8) -> ModuleSettings {
    let mut settings = module(ModuleKind::Sio1, switch);
    settings.management =
        Some(ManagementSettings { first_tx_delay: Some(Duration::ZERO), ..settings.management.unwrap() });
    let mode = CanTxMode { inhibit: 20, max_char: 8, min_char: MinChar::Bytes(min_char) };
    settings.channels[0].can_tx_mode = Some(mode);
    settings
}

/// What a module is to have, by its place.
fn is_as_wanted(place: usize, module: &Pretended) -> bool {
    module.parameters[&1] == [0x1484, 0x1482][place] && module.parameters[&0] == 0
}

/// Two modules behind a bus that loses, delays and doubles their answers. As on a real one, the answers of one module stay in
/// their order, and a doubled frame follows soon.
struct LossyBus {
    dice: Dice,
    coming: BTreeMap<(u64, u64), CanFrame>,
    last: [u64; 2],
    count: u64,
    lost: u64,
}

impl LossyBus {
    fn carry(&mut self, now: u64, place: usize, answer: CanFrame) {
        if self.dice.roll(100) < self.lost {
            return;
        }
        let delay = if self.dice.roll(4) == 0 { self.dice.roll(190_000) } else { 200 + self.dice.roll(5000) };
        let at = self.last[place].max(now + delay);
        let times = if self.dice.roll(5) == 0 { vec![at, at + self.dice.roll(8000)] } else { vec![at] };
        for at in times {
            self.count += 1;
            self.last[place] = self.last[place].max(at);
            self.coming.insert((at, self.count), answer);
        }
    }
}

#[test]
fn r_esd_054_055_lost_late_and_doubled_answers_cause_no_wrong_write_and_no_false_word_of_being_configured() {
    let (mut configured, mut writes) = (0, 0);
    for seed in 0..150 {
        let settings = network(vec![wishes(0x12, 4), wishes(0x13, 2)]);
        let mut network = Network::new(settings, moment(0));
        let mut modules = [0x12, 0x13].map(|switch| Pretended::new(ModuleKind::Sio1, switch));
        let mut bus = LossyBus {
            dice: Dice(seed),
            coming: BTreeMap::new(),
            last: [0; 2],
            count: 0,
            lost: 5 * (seed % 8),
        };
        let mut now = 0;
        let mut restarted = [0_u64; 2];
        network.handle_link(moment(0), true);
        while now < 60_000_000 {
            while let Some(output) = network.poll_output() {
                match output {
                    NetworkOutput::Transmit(frame) => {
                        for (place, module) in modules.iter_mut().enumerate() {
                            let was_wanted = is_as_wanted(place, module);
                            let before = module.parameters.clone();
                            if let Some(answer) = module.react(&frame) {
                                bus.carry(now, place, answer);
                            }
                            if let Some(InitCommand::Set { module: number, setting: Setting::Parameter(..) }) =
                                InitCommand::parse(&frame)
                                && number.get() == module.number
                            {
                                writes += 1;
                                assert!(!was_wanted, "{frame} to a module that is as wanted, seed {seed}");
                                assert_ne!(before, module.parameters, "{frame}, seed {seed}");
                            }
                        }
                    }
                    NetworkOutput::Module(ModuleIndex(place), ModuleEvent::Configured { .. }) => {
                        configured += 1;
                        let lately = now - restarted[place] < 200_000;
                        assert!(lately || is_as_wanted(place, &modules[place]), "seed {seed}, at {now}");
                    }
                    NetworkOutput::Module(_, event) => {
                        assert!(
                            !matches!(event, ModuleEvent::NotConfigured(_) | ModuleEvent::OtherModule(_)),
                            "{event:?}"
                        );
                    }
                    NetworkOutput::ForeignCommand(_) => panic!("nobody else is there"),
                }
            }
            if bus.dice.roll(3000) == 0 {
                let place = bus.dice.place(2);
                modules[place].restart();
                restarted[place] = now;
            }
            let due = network.poll_timeout().map(|(at, _)| at.as_micros());
            let frame = bus.coming.first_key_value().map(|((at, _), _)| *at);
            now = now.max(due.into_iter().chain(frame).min().unwrap());
            if frame.is_some_and(|at| at <= now) {
                let (_, frame) = bus.coming.pop_first().unwrap();
                network.handle_frame(moment(now), &frame);
            } else {
                network.handle_timeout(moment(now));
            }
        }
    }
    assert!(configured > 200 && writes > 300, "{configured} {writes}");
}

/// One thing that happens to a line.
#[derive(Clone, Debug)]
enum Step {
    Send(usize, Vec<u8>),
    Receive(usize, Vec<u8>),
    Wait(u64),
    Refuse(u8),
}

fn any_step() -> impl Strategy<Value = Step> {
    let bytes = prop::collection::vec(any::<u8>(), 0..60);
    prop_oneof![
        3 => (0_usize..5, bytes).prop_map(|(line, bytes)| Step::Send(line, bytes)),
        3 => (0_usize..5, prop::collection::vec(any::<u8>(), 0..=8)).prop_map(|(line, data)| Step::Receive(line, data)),
        4 => (0_u64..30_000).prop_map(Step::Wait),
        1 => (0_u8..10).prop_map(Step::Refuse),
    ]
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(200))]

    #[test]
    fn r_esd_032_039_bytes_in_are_bytes_out_in_order_on_every_line(steps in prop::collection::vec(any_step(), 1..150)) {
        let mut settings = module(ModuleKind::Sio4, 0x11);
        settings.management = None;
        let lines = settings.channels.iter().map(|line| line.rx_id).collect::<Vec<_>>();
        let mut network = Network::new(network(vec![settings]), moment(0));
        network.handle_link(moment(0), true);
        let mut now = 0;
        let mut sent = vec![Vec::<u8>::new(); 5];
        let mut out = vec![Vec::<u8>::new(); 5];
        let mut came = vec![Vec::<u8>::new(); 5];
        let mut told = vec![Vec::<u8>::new(); 5];
        let (mut jobs, mut done, mut refuse) = (0_u64, 0_u64, 0_u8);
        for step in steps.into_iter().chain([Step::Wait(60_000_000)]) {
            let mut end = now;
            match step {
                Step::Send(line, bytes) => {
                    if network.send(moment(now), ModuleIndex(0), line, jobs, bytes.clone()).is_ok() {
                        jobs += 1;
                        sent[line].extend(bytes);
                    }
                }
                Step::Receive(line, data) => {
                    let frame = CanFrame::data_frame(id(0x0AA + u16::try_from(line).unwrap()), &data).unwrap();
                    network.handle_frame(moment(now), &frame);
                    came[line].extend(data);
                }
                Step::Wait(micros) => end += micros,
                Step::Refuse(times) => refuse = times,
            }
            loop {
                while let Some(output) = network.poll_output() {
                    match output {
                        NetworkOutput::Transmit(frame) if refuse > 0 => {
                            refuse -= 1;
                            network.handle_not_sent(moment(now), &frame);
                        }
                        NetworkOutput::Transmit(frame) => {
                            let line = lines.iter().position(|id| *id == frame.id()).unwrap();
                            out[line].extend(frame.data());
                            network.handle_sent(moment(now), &frame);
                        }
                        NetworkOutput::Module(_, ModuleEvent::Received { channel, chunk }) => {
                            told[channel].extend(chunk.bytes());
                        }
                        NetworkOutput::Module(_, ModuleEvent::SendDone { outcome, .. }) => {
                            prop_assert_eq!(outcome, SendOutcome::Done);
                            done += 1;
                        }
                        NetworkOutput::Module(..) | NetworkOutput::ForeignCommand(_) => {}
                    }
                }
                let Some((at, _)) = network.poll_timeout().filter(|(at, _)| at.as_micros() <= end) else { break };
                now = now.max(at.as_micros());
                network.handle_timeout(moment(now));
            }
            now = end;
        }
        prop_assert_eq!(sent, out);
        prop_assert_eq!(came, told);
        prop_assert_eq!(jobs, done);
    }
}
