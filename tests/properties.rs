//! Random input to the gateway core: nothing panics, nothing old is called good, nothing that is not allowed is sent.

use cangate::can::{BusCounters, BusEvent, Link};
use cangate::canopen::NmtRequest;
use cangate::gateway::{Action, Health, Input};
use cangate::mapping::{Derived, Source};
use cangate::process_image::{AlarmIndex, BusState, NodeIndex, Quality, TagIndex};
use cangate::time::Now;
use proptest::prelude::*;

use crate::conversations::table;
use crate::support::conversation::Conversation;

/// One random step of a bus, an operator, or time.
#[derive(Clone, Debug)]
enum Step {
    Frame(String),
    Link(Link),
    NotSent(String),
    Counters(BusCounters),
    Command(Action),
    Health(Health),
    Pass(u64),
}

fn frame() -> impl Strategy<Value = String> {
    let near = prop_oneof![
        Just(0x000_u32),
        0x080_u32..0x084,
        0x180_u32..0x184,
        0x280_u32..0x284,
        0x380_u32..0x384,
        0x480_u32..0x484,
        0x700_u32..0x704,
        0_u32..0x800,
    ];
    let data = prop_oneof![
        proptest::collection::vec(any::<u8>(), 0..=8),
        prop_oneof![Just(0x00), Just(0x05), Just(0x85), Just(0x7F), Just(0x04)].prop_map(|byte| vec![byte]),
    ];
    let data =
        data.prop_map(|bytes| bytes.iter().map(|byte| format!("{byte:02X}")).collect::<Vec<_>>().concat());
    prop_oneof![
        8 => (near.clone(), data.clone()).prop_map(|(id, data)| format!("{id:03X}#{data}")),
        1 => (near.clone(), 0_u8..=8).prop_map(|(id, dlc)| format!("{id:03X}#R{dlc}")),
        1 => (near, data).prop_map(|(id, data)| format!("{id:08X}#{data}")),
    ]
}

fn action() -> impl Strategy<Value = Action> {
    let request = prop_oneof![
        Just(NmtRequest::Start),
        Just(NmtRequest::Stop),
        Just(NmtRequest::EnterPreOperational),
        Just(NmtRequest::ResetNode),
        Just(NmtRequest::ResetCommunication),
    ];
    prop_oneof![
        (0_usize..4, request).prop_map(|(node, request)| Action::Nmt { node: NodeIndex(node), request }),
        (0_usize..200).prop_map(|alarm| Action::Acknowledge { alarm: AlarmIndex(alarm), raise: None }),
        (0_usize..200).prop_map(|alarm| Action::Reset { alarm: AlarmIndex(alarm) }),
        proptest::option::of(0_usize..4)
            .prop_map(|node| Action::AcknowledgeAll { node: node.map(NodeIndex) }),
    ]
}

fn step() -> impl Strategy<Value = Step> {
    let link = prop_oneof![
        Just(Link::Absent),
        Just(Link::Down),
        Just(Link::ErrorActive),
        Just(Link::ErrorPassive),
        Just(Link::BusOff),
    ];
    let counters = (any::<u64>(), any::<u64>(), any::<u64>(), proptest::option::of(any::<u32>())).prop_map(
        |(frames_received, overruns, wire_bits, bit_rate)| BusCounters {
            frames_received,
            overruns,
            wire_bits,
            bit_rate,
            ..BusCounters::default()
        },
    );
    let health = (proptest::option::of(any::<bool>()), any::<bool>()).prop_map(
        |(mqtt_connected, clock_synchronised)| Health {
            mqtt_connected,
            clock_synchronised,
            ..Health::default()
        },
    );
    prop_oneof![
        40 => frame().prop_map(Step::Frame),
        2 => link.prop_map(Step::Link),
        2 => frame().prop_map(Step::NotSent),
        2 => counters.prop_map(Step::Counters),
        2 => action().prop_map(Step::Command),
        1 => health.prop_map(Step::Health),
        20 => (0_u64..400).prop_map(Step::Pass),
        2 => (0_u64..20_000).prop_map(Step::Pass),
    ]
}

fn take(conversation: &mut Conversation, step: &Step) {
    let at = Now::from_millis(conversation.now_millis());
    match step {
        Step::Frame(frame) => conversation.frame(frame),
        Step::Link(link) => conversation.link(*link),
        Step::NotSent(frame) => {
            conversation.bus_event(BusEvent::NotSent { frame: frame.parse().unwrap(), at });
        }
        Step::Counters(counters) => conversation.bus_event(BusEvent::Counters { counters: *counters, at }),
        Step::Command(action) => drop(conversation.command(action.clone())),
        Step::Health(health) => conversation.input(Input::Health(*health)),
        Step::Pass(millis) => conversation.run_to(conversation.now_millis() + millis),
    }
}

/// P26: a tag of a TPDO is usable only while its TPDO is younger than its timeout, and good only while its bus is not
/// known to be down; a computed tag is no better than what it must be computed from.
fn nothing_old_is_good(conversation: &Conversation) {
    let now = Now::from_millis(conversation.now_millis()).instant;
    let (table, image) = (&conversation.table, &conversation.image);
    for (def, sample) in table.tags.iter().zip(&image.tags) {
        let node = table.node(def.node).unwrap();
        let bus = image.buses[node.bus.0].state;
        match &def.source {
            Source::Polled { .. }
            | Source::Adopted { .. }
            | Source::Rpdo { .. }
            | Source::Emergency { .. }
            | Source::Module { .. } => {
                unreachable!("a DetCon knows no SDO, no RPDO and no emergency messages")
            }
            Source::Pdo { pdo, .. } => {
                let down = matches!(bus, BusState::Absent | BusState::Down | BusState::BusOff);
                assert!(!sample.quality.is_good() || !down, "{} is good though its bus is {bus:?}", def.name);
                let timeout = node.pdos()[*pdo].timeout.unwrap();
                if sample.quality.is_usable() {
                    let age = now.since(sample.received_at.expect("a usable value was received"));
                    assert!(age <= timeout, "{} is {} after {age:?}", def.name, sample.quality);
                }
            }
            Source::Derived(derived) => {
                let best = |tags: &[TagIndex]| {
                    tags.iter().map(|tag| image.tag(*tag).quality).min().unwrap_or(Quality::Good)
                };
                let worst = |tags: &[TagIndex]| image.worst_quality(tags.iter().copied());
                let limit = match derived {
                    // Of the candidates some may be left out.
                    Derived::Maximum { among, .. } | Derived::ArgMaximum { among, .. } => best(among),
                    Derived::Margin { among, limit, .. } => best(among).worst(worst(&[*limit])),
                    _ => {
                        let mut inputs = Vec::new();
                        derived.for_each_input(&mut |tag| inputs.push(tag));
                        worst(&inputs)
                    }
                };
                assert!(sample.quality >= limit, "{} is {}, not {limit}", def.name, sample.quality);
            }
        }
    }
}

/// Only NMT commands to configured nodes that a start or an operator asked for, and guard requests, ever leave.
fn nothing_but_what_is_allowed_was_sent(conversation: &Conversation, steps: &[Step]) {
    let operator = |code: &str| {
        steps.iter().any(|step| {
            matches!(step, Step::Command(Action::Nmt { request, .. })
                if format!("{:02X}", request.code()) == code)
        })
    };
    for frame in &conversation.all_sent {
        let text = frame.to_string();
        let (id, data) = text.split_once('#').unwrap();
        let allowed = match id {
            "701" | "702" => data == "R1",
            "000" => {
                let (code, node) = data.split_at(2);
                (node == "01" || node == "02") && (code == "01" || operator(code))
            }
            _ => false,
        };
        assert!(allowed, "{text} was sent");
    }
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 48, failure_persistence: None, ..ProptestConfig::default() })]

    #[test]
    fn p26_whatever_comes_nothing_panics_and_no_old_value_is_usable(
        steps in proptest::collection::vec(step(), 1..200)
    ) {
        let mut conversation = Conversation::new(table(&[("engine1", 1), ("engine2", 2)], |_, _| ()));
        for step in &steps {
            take(&mut conversation, step);
            nothing_old_is_good(&conversation);
        }
        nothing_but_what_is_allowed_was_sent(&conversation, &steps);
        let (events, missed) = conversation.image.journal.after(0);
        let seqs: Vec<u64> = events.iter().map(|event| event.seq).collect();
        prop_assert_eq!(seqs, (missed + 1..=conversation.image.journal.newest()).collect::<Vec<_>>());
    }
}

/// Every length, format and kind of frame on the identifiers of all four TPDOs: only the right ones change a value.
#[test]
fn p23_r_det_006_080_081_malformed_tpdos_change_no_value() {
    let mut conversation = Conversation::new(table(&[("engine1", 1)], |_, _| ()));
    for (id, length) in [(0x181, 8), (0x281, 8), (0x381, 8), (0x481, 6)] {
        for dlc in 0..=8_usize {
            let data = "A5".repeat(dlc);
            let frames = [
                (format!("{id:03X}#{data}"), dlc >= length),
                (format!("{id:08X}#{data}"), false),
                (format!("{id:03X}#R{dlc}"), false),
                (format!("{id:08X}#R{dlc}"), false),
            ];
            for (frame, counts) in frames {
                for rest in [
                    "181#0000000000000000",
                    "281#0000000000000000",
                    "381#0000000000000000",
                    "481#000000000000",
                ] {
                    conversation.frame(rest);
                }
                let before: Vec<_> = conversation
                    .image
                    .tags
                    .iter()
                    .map(|tag| (tag.raw, tag.quality, tag.received_at))
                    .collect();
                conversation.run_to(conversation.now_millis() + 1);
                conversation.frame(&frame);
                let after: Vec<_> = conversation
                    .image
                    .tags
                    .iter()
                    .map(|tag| (tag.raw, tag.quality, tag.received_at))
                    .collect();
                assert_eq!(before != after, counts, "{frame}");
            }
        }
    }
}
