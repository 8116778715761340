//! Properties of a whole network: whatever comes in, it does not fall, and sends nothing that it must not.

use std::collections::BTreeSet;
use std::time::Duration;

use proptest::prelude::*;

use super::bench::{detcon, master, usable};
use crate::can::{CanFrame, CanId};
use crate::canopen::{
    ErrorControl, GuardingSettings, Network, NetworkOutput, NetworkSettings, NmtRequest, NmtState, NodeEvent,
    NodeId, NodeSettings, OwnHeartbeatSettings, Role, RpdoIndex, RpdoSettings, RpdoTrigger, StartSettings,
    SyncSettings, TimeSettings, cob_id,
};
use crate::time::Now;

/// What node 1 is sent.
const RPDO: CanId = CanId::Standard(0x201);

/// One thing that can happen to a network.
#[derive(Clone, Debug)]
enum Step {
    Frame(CanFrame),
    NotSent(CanFrame),
    Link(bool),
    Wait(u64),
    /// Time as a frame's receive stamp tells it, which may lie before the last timeout.
    Late(CanFrame, u64),
}

fn any_frame() -> impl Strategy<Value = CanFrame> {
    let near = prop::sample::select(vec![
        0x000, 0x001, 0x002, 0x080, 0x081, 0x082, 0x181, 0x281, 0x381, 0x481, 0x182, 0x701, 0x702, 0x703,
    ]);
    let id = prop_oneof![
        8 => near.clone().prop_map(CanId::Standard),
        1 => near.prop_map(|id: u16| CanId::Extended(id.into())),
        1 => (0_u16..=0x7FF).prop_map(CanId::Standard),
        1 => (0_u32..=0x1FFF_FFFF).prop_map(CanId::Extended),
    ];
    let byte = prop_oneof![
        prop::sample::select(vec![0_u8, 1, 2, 4, 5, 0x7F, 0x80, 0x81, 0x82, 0x84, 0x85, 0xFF]),
        any::<u8>()
    ];
    let data = prop_oneof![
        3 => prop::collection::vec(byte.clone(), 1),
        3 => prop::collection::vec(byte.clone(), 8),
        2 => prop::collection::vec(byte, 0..=8),
    ];
    (id, data, prop::bool::weighted(0.1)).prop_map(|(id, data, remote)| {
        if remote {
            CanFrame::remote_frame(id, u8::try_from(data.len()).unwrap()).unwrap()
        } else {
            CanFrame::data_frame(id, &data).unwrap()
        }
    })
}

fn any_step() -> impl Strategy<Value = Step> {
    prop_oneof![
        10 => any_frame().prop_map(Step::Frame),
        1 => any_frame().prop_map(Step::NotSent),
        1 => any::<bool>().prop_map(Step::Link),
        5 => (0_u64..400).prop_map(Step::Wait),
        1 => (0_u64..100_000).prop_map(Step::Wait),
        1 => (any_frame(), 0_u64..2000).prop_map(|(frame, ago)| Step::Late(frame, ago)),
    ]
}

fn any_network() -> impl Strategy<Value = NetworkSettings> {
    let control = prop_oneof![
        3 => (any::<bool>(), 0_u8..5, 0_u64..200).prop_map(|(toggle_resync, life_time_factor, reply)| {
            ErrorControl::Guarding(GuardingSettings {
                toggle_resync,
                life_time_factor,
                reply_timeout: Duration::from_millis(reply),
                guard_time: Duration::from_millis(100),
                ..GuardingSettings::default()
            })
        }),
        1 => Just(ErrorControl::Heartbeat { timeout: Duration::from_millis(300) }),
        1 => Just(ErrorControl::None),
    ];
    let sync = SyncSettings {
        cob_id: cob_id::SYNC,
        produced: true,
        period: Some(Duration::from_millis(70)),
        overflow: Some(9),
        window: None,
    };
    let time = TimeSettings { cob_id: cob_id::TIME, period: Duration::from_millis(90), unsynchronised: true };
    let own_heartbeat =
        OwnHeartbeatSettings { node: NodeId::new(126).unwrap(), period: Duration::from_millis(80) };
    let rpdo = RpdoSettings {
        number: 1,
        cob_id: RPDO,
        length: 3,
        trigger: RpdoTrigger::Event,
        refresh: Some(Duration::from_millis(50)),
        inhibit: Duration::ZERO,
    };
    (any::<bool>(), any::<bool>(), control.clone(), control, any::<bool>(), any::<bool>()).prop_map(
        move |(passive, start_broadcast, first, second, auto_start, sends)| NetworkSettings {
            role: if passive { Role::Passive } else { Role::Master },
            start_broadcast,
            sync: sends.then_some(sync),
            time: sends.then_some(time),
            own_heartbeat: sends.then_some(own_heartbeat),
            nodes: vec![
                NodeSettings {
                    error_control: first,
                    rpdos: if sends { vec![rpdo.clone()] } else { Vec::new() },
                    ..detcon(1)
                },
                NodeSettings {
                    error_control: second,
                    start: StartSettings { auto_start, ..StartSettings::default() },
                    ..detcon(2)
                },
            ],
        },
    )
}

/// Does a step; gives what the network wanted done.
fn take(network: &mut Network, clock: &mut u64, step: &Step) -> Vec<NetworkOutput> {
    let now = Now::from_millis(*clock);
    match step {
        Step::Frame(frame) => network.handle_frame(now, frame),
        Step::NotSent(frame) => network.handle_not_sent(now, frame),
        Step::Link(up) => network.handle_link(now, *up),
        Step::Wait(millis) => {
            *clock += millis;
            network.handle_timeout(Now::from_millis(*clock));
        }
        Step::Late(frame, ago) => network.handle_frame(Now::from_millis(clock.saturating_sub(*ago)), frame),
    }
    std::iter::from_fn(|| network.poll_output()).collect()
}

fn is_allowed(frame: &CanFrame, settings: &NetworkSettings) -> bool {
    let broadcast = settings.start_broadcast;
    let sent = !frame.is_remote() && [cob_id::SYNC, cob_id::TIME, RPDO].contains(&frame.id());
    let ids = [1, 2].map(|id| NodeId::new(id).unwrap());
    let start = ids.iter().any(|id| *frame == NmtRequest::Start.frame(Some(*id)))
        || broadcast && *frame == NmtRequest::Start.frame(None);
    let guard = frame.is_remote() && ids.iter().any(|id| frame.id() == cob_id::error_control(*id));
    let heartbeat = settings.own_heartbeat.is_some_and(|own| {
        Some(*frame) == CanFrame::data_frame(cob_id::error_control(own.node), &[NmtState::Operational.code()])
    });
    start || guard || heartbeat || sent && settings.sync.is_some()
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(500))]

    #[test]
    fn r_det_002_016_and_090_only_starts_and_guard_requests_leave_and_nothing_in_the_passive_role(
        settings in any_network(),
        steps in prop::collection::vec(any_step(), 1..200),
    ) {
        let mut network = usable(settings.clone());
        network.set_rpdo(Now::from_millis(0), NodeId::new(1).unwrap(), RpdoIndex(0), Some([7; 8]));
        let mut clock = 0;
        for step in &steps {
            for output in take(&mut network, &mut clock, step) {
                if let NetworkOutput::Transmit(frame) = output {
                    prop_assert!(settings.role == Role::Master, "{frame} in the passive role");
                    prop_assert!(is_allowed(&frame, &settings), "{frame}");
                }
            }
        }
    }

    #[test]
    fn a_network_comes_to_rest_after_each_timeout(
        settings in any_network(),
        steps in prop::collection::vec(any_step(), 1..200),
    ) {
        let mut network = usable(settings);
        let mut clock = 0;
        for step in &steps {
            take(&mut network, &mut clock, step);
            // What becomes due at one instant is done in a few calls, and then the next deadline lies ahead.
            for call in 0.. {
                let due = network.poll_timeout().is_some_and(|(at, _)| at.as_millis() <= clock);
                if !due {
                    break;
                }
                prop_assert!(call < 8, "busy at {clock}: {:?}", network.poll_timeout());
                take(&mut network, &mut clock, &Step::Wait(0));
            }
        }
    }

    #[test]
    fn r_det_036_and_037_losses_and_recoveries_alternate(
        settings in any_network(),
        steps in prop::collection::vec(any_step(), 1..200),
    ) {
        let mut network = usable(settings);
        let mut clock = 0;
        let mut lost = BTreeSet::new();
        for step in &steps {
            for output in take(&mut network, &mut clock, step) {
                match output {
                    NetworkOutput::Node(node, NodeEvent::Lost { .. }) => prop_assert!(lost.insert(node)),
                    NetworkOutput::Node(node, NodeEvent::Recovered) => prop_assert!(lost.remove(&node)),
                    NetworkOutput::Node(..) | NetworkOutput::Foreign(_) | NetworkOutput::Transmit(_) => {}
                }
            }
        }
    }

    #[test]
    fn states_follow_one_another_without_a_gap(
        settings in any_network(),
        steps in prop::collection::vec(any_step(), 1..200),
    ) {
        let mut network = usable(settings);
        let mut clock = 0;
        let mut state = [None::<NmtState>; 3];
        for step in &steps {
            for output in take(&mut network, &mut clock, step) {
                if let NetworkOutput::Node(node, NodeEvent::State { from, to, .. }) = output {
                    let known = &mut state[usize::from(node.get())];
                    prop_assert_eq!(*known, from);
                    prop_assert_ne!(from, Some(to));
                    *known = Some(to);
                }
            }
        }
    }
}

/// A DetCon that does as it should: toggles, obeys start, sends its TPDOs.
struct Device {
    toggle: bool,
    operational: bool,
}

impl Device {
    fn answer(&mut self, request: &CanFrame) -> Option<CanFrame> {
        if request.is_remote() {
            let state = if self.operational { 0x05 } else { 0x7F };
            let byte = state | if self.toggle { 0x80 } else { 0 };
            self.toggle = !self.toggle;
            return CanFrame::data_frame(request.id(), &[byte]);
        }
        self.operational |= *request == NmtRequest::Start.frame(NodeId::new(1));
        None
    }
}

#[test]
fn a_day_of_quiet_guarding_passes_without_a_word() {
    const DAY: u64 = 24 * 3600 * 1000;
    let mut network = usable(master(vec![detcon(1)]));
    let mut device = Device { toggle: true, operational: false };
    let pdos: Vec<CanFrame> =
        ["181#0000000000000000", "281#0000000000000000", "381#0080FF0F000099CC", "481#0019FF800301"]
            .iter()
            .map(|text| text.parse().unwrap())
            .collect();
    let (mut told, mut received, mut next_pdo) = (Vec::new(), 0_u64, 7);
    loop {
        let (deadline, _) = network.poll_timeout().unwrap();
        let at = deadline.as_millis().min(next_pdo);
        if at >= DAY {
            break;
        }
        let now = Now::from_millis(at);
        network.handle_timeout(now);
        if at == next_pdo {
            next_pdo += 500;
            pdos.iter().filter(|_| device.operational).for_each(|pdo| network.handle_frame(now, pdo));
        }
        while let Some(output) = network.poll_output() {
            match output {
                NetworkOutput::Transmit(frame) => {
                    if let Some(reply) = device.answer(&frame) {
                        network.handle_frame(Now::from_millis(at + 1), &reply);
                    }
                }
                NetworkOutput::Node(_, NodeEvent::FrameSeen) => {}
                NetworkOutput::Node(_, NodeEvent::Pdo { .. }) => received += 1,
                NetworkOutput::Node(_, event) => told.push(format!("{at} {event:?}")),
                NetworkOutput::Foreign(event) => told.push(format!("{at} {event:?}")),
            }
        }
    }
    assert_eq!(
        told,
        [
            "0 Seen",
            "0 Supervised",
            "0 State { from: None, to: PreOperational, ordered: true }",
            "0 NmtSent { request: Start }",
            "7 State { from: Some(PreOperational), to: Operational, ordered: true }",
        ]
    );
    assert_eq!(received, DAY / 500 * 4);
}
