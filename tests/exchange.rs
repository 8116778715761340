//! The gateway core goes on with another configuration while it runs: what stays notices nothing, what changed begins anew.

use std::time::Duration;

use cangate::can::{BusEvent, BusIndex};
use cangate::canopen::NmtRequest;
use cangate::gateway::kept::Kept;
use cangate::gateway::{Action, Health, Input};
use cangate::mapping::installation::{BusEntry, NodeEntry};
use cangate::mapping::{AlarmOwner, Sketch, SourceText, TagTable};
use cangate::process_image::{
    AlarmState, AlarmStatus, EventKind, NodeIndex, NodeStatus, Quality, Revision, Sample, TagIndex, Value,
};
use cangate::time::Now;
use proptest::prelude::*;

use crate::allowed_frames::{EVERYTHING, Step, step, table_of};
use crate::conversations::table;
use crate::support::conversation::Conversation;

const ENGINES: [(&str, u8); 2] = [("engine1", 1), ("engine2", 2)];

/// Two engines of which the second answers.
fn running() -> Conversation {
    let mut conversation = Conversation::new(table(&ENGINES, |_, _| ()));
    for id in [1, 2] {
        conversation.answer_guarding(id, 5);
        for (base, data) in [
            (0x180, "0000000000000000"),
            (0x280, "0000000000000000"),
            (0x380, "0000FF0F000099CC"),
            (0x480, "000000000000"),
        ] {
            conversation.send_cyclically(&format!("{:03X}#{data}", base + u16::from(id)), 500);
        }
    }
    conversation.run_to(5_000);
    conversation
}

/// The times of the guard requests to a node, in ms.
fn guard_requests(conversation: &Conversation, id: u8) -> Vec<u64> {
    conversation.guard_requests_of(&format!("{:03X}#R1", 0x700 + u16::from(id)))
}

fn engine(conversation: &Conversation, name: &str) -> NodeIndex {
    conversation.table.find_node(name).unwrap()
}

fn alarm(conversation: &Conversation, node: &str, name: &str) -> AlarmStatus {
    conversation.alarm_of(engine(conversation, node).0, name)
}

#[test]
fn p29_a_node_that_stays_misses_no_guard_request_however_often_the_rest_changes() {
    let mut conversation = running();
    let before = guard_requests(&conversation, 2).len();
    let mut millis = 5_000;
    for round in 0_u64..500 {
        // Now an engine comes before it, now the first goes.
        let nodes: &[(&str, u8)] = match round % 3 {
            0 => &[("aaa", 7), ("engine2", 2)],
            1 => &[("engine1", 1), ("engine2", 2), ("zzz", 9)],
            _ => &[("engine2", 2)],
        };
        conversation.exchange(table(nodes, |_, _| ()));
        millis += 37;
        conversation.run_to(millis);
    }
    let times = guard_requests(&conversation, 2);
    let gaps: Vec<u64> = times.windows(2).map(|pair| pair[1] - pair[0]).collect();
    assert!(gaps[before..].iter().all(|gap| *gap == 500), "{gaps:?}");
    assert_eq!(u64::try_from(times.len() - before).unwrap(), (millis - 5_000) / 500);
    let node = &conversation.image.nodes[engine(&conversation, "engine2").0];
    assert!(node.online && node.supervised && node.data_good, "{node:?}");
    assert_eq!(node.counters.guard_misses, 0);
    assert_eq!(conversation.events_named("configuration_loaded").len(), 500);
    assert_eq!(conversation.events_named("gateway_started").len(), 1);
}

#[test]
fn p29_values_counters_latches_and_alarms_of_a_node_that_stays_stay() {
    let mut conversation = running();
    // Engine 2 stops for good; its alarm is seen by nobody. Engine 1 restarts.
    conversation.stop_answering(2);
    conversation.frame("701#00");
    conversation.run_to(9_000);
    assert_eq!(alarm(&conversation, "engine2", "node_lost").state, AlarmState::Unacknowledged);
    let lost = alarm(&conversation, "engine2", "node_lost");
    let tags: Vec<Sample> = samples(&conversation, "engine1");
    let status = status(&conversation, "engine1");
    conversation.exchange(table(&[("aaa", 7), ("engine1", 1), ("engine2", 2)], |_, _| ()));
    assert_eq!(samples(&conversation, "engine1"), tags);
    assert_eq!(self::status(&conversation, "engine1"), status);
    assert_eq!(status.counters.restarts, 1);
    let now = alarm(&conversation, "engine2", "node_lost");
    assert_eq!((now.state, now.since, now.count), (lost.state, lost.since, lost.count));
    assert_eq!(
        conversation.image.nodes[engine(&conversation, "aaa").0].reason,
        "waiting for its first frame"
    );
    // The lost one comes back and the alarm ends as it would have.
    conversation.answer_guarding(2, 5);
    conversation.run_to(15_000);
    assert_eq!(alarm(&conversation, "engine2", "node_lost").state, AlarmState::ReturnedUnacknowledged);
    let told: Vec<_> = conversation.events_named("node_lost");
    assert!(told.iter().all(|event| event.node.as_deref() == Some("engine2")), "{told:#?}");
}

#[test]
fn a_node_whose_definition_changed_begins_anew_and_its_neighbour_does_not() {
    let mut conversation = running();
    let change = |_: &mut BusEntry, node: &mut NodeEntry| {
        if node.id.value == 1 {
            node.guard_time_ms = Some(cangate::mapping::At::nowhere(300));
        }
    };
    conversation.exchange(table(&ENGINES, change));
    let level = |conversation: &Conversation, node| {
        let tag = conversation.table.find_tag(engine(conversation, node), "knock_intensity_1").unwrap();
        conversation.image.tag(tag).quality
    };
    assert_eq!(level(&conversation, "engine1"), Quality::NEVER);
    assert_eq!(level(&conversation, "engine2"), Quality::Good);
    conversation.run_to(9_000);
    assert_eq!(level(&conversation, "engine1"), Quality::Good);
    assert!(conversation.image.nodes[0].online);
    let times = guard_requests(&conversation, 1);
    assert_eq!(times[times.len() - 1] - times[times.len() - 2], 300);
}

#[test]
fn what_is_only_shown_otherwise_changes_nothing_for_the_node() {
    let change = |_: &mut BusEntry, node: &mut NodeEntry| {
        node.unit_id = Some(cangate::mapping::At::nowhere(40 + node.id.value));
    };
    let (old, new) = (table(&ENGINES, |_, _| ()), table(&ENGINES, change));
    assert_ne!(old, new);
    let kept = Kept::new(&old, &new, |_, _| true);
    assert_eq!(kept.nodes, [Some(NodeIndex(0)), Some(NodeIndex(1))]);
    assert!(kept.tags.iter().all(Option::is_some) && kept.alarms.iter().all(Option::is_some));
    let other = Kept::new(&old, &new, |_, _| false);
    assert!(other.nodes.iter().all(Option::is_none), "another interface");
    assert!(other.alarms[0].is_some(), "the gateway's own stay");
}

#[test]
fn who_waits_for_an_object_of_a_node_that_goes_is_told_so_at_once() {
    let text = "format = 1\ndevice = { vendor = \"x\", model = \"y\" }\n[[tag]]\nname = \"t\"\nobject = \"0x2000:1\"\n\
                type = \"u8\"\npoll_ms = 60000\n";
    let sketch = || Sketch::new().mapping(SourceText::new("polled", text)).node("stays", 3, "polled", |_| ());
    let with = sketch().node("goes", 2, "polled", |_| ()).build().unwrap().0;
    let mut conversation = Conversation::new(with);
    for id in [2, 3] {
        conversation.answer_guarding(id, 5);
    }
    // They have none of the objects that they are asked for before they are started, nor that of the tag.
    let mut answered = 0;
    for step in 1..=500 {
        conversation.run_to(step * 10);
        let asked: Vec<String> = conversation.all_sent[answered..].iter().map(ToString::to_string).collect();
        answered = conversation.all_sent.len();
        for frame in asked.iter().filter(|frame| frame[3..].starts_with("#40")) {
            conversation.frame(&format!("58{}#80{}00000206", &frame[2..3], &frame[6..12]));
        }
    }
    for node in ["goes", "stays"] {
        let (node, object) = (engine(&conversation, node), "0x2000:1".parse().unwrap());
        conversation.ask(Action::SdoRead { node, object, len: None, timeout: Some(Duration::from_secs(10)) });
    }
    conversation.run_to(6_000);
    assert_eq!(conversation.outcome_words(), [""; 0], "both are under way");
    conversation.exchange(sketch().build().unwrap().0);
    let words = conversation.outcome_words();
    assert_eq!(words.len(), 1, "{words:?}");
    assert!(words[0].contains("the configuration of the node was changed meanwhile"), "{words:?}");
    // The other one is answered by its own node.
    conversation.frame("583#4F00200107000000");
    assert_eq!(conversation.outcome_words()[1..], ["Read([7])"]);
}

#[test]
fn a_command_reaches_a_node_that_stays_at_its_new_place() {
    let mut conversation = running();
    conversation.exchange(table(&[("engine2", 2)], |_, _| ()));
    assert_eq!(conversation.image.nodes.len(), 1);
    assert_eq!(conversation.nmt(NmtRequest::Stop), cangate::gateway::Outcome::Done);
    assert_eq!(conversation.all_sent.last().unwrap().to_string(), "000#0202");
}

#[test]
fn s10_g05_a_refused_configuration_is_an_event_and_an_alarm_until_a_good_one_comes() {
    let mut conversation = running();
    let now = Now::from_millis(5_000);
    conversation.gateway.set_configuration_rejected(now, Some("cangate.toml:3:1: error: no such key"));
    conversation.run_to(5_001);
    assert_eq!(conversation.alarm("configuration_rejected").state, AlarmState::Unacknowledged);
    let told = conversation.events_named("configuration_rejected");
    assert!(told.iter().any(|event| event.text.contains("cangate.toml:3:1")), "{told:#?}");
    // It goes over an exchange too.
    conversation.exchange(table(&ENGINES, |_, _| ()));
    assert_eq!(conversation.alarm("configuration_rejected").state, AlarmState::Unacknowledged);
    conversation.gateway.set_configuration_rejected(Now::from_millis(6_000), None);
    conversation.run_to(6_001);
    assert_eq!(conversation.alarm("configuration_rejected").state, AlarmState::ReturnedUnacknowledged);
}

fn samples(conversation: &Conversation, node: &str) -> Vec<Sample> {
    let tags = conversation.table.nodes[engine(conversation, node).0].tags.clone();
    let of_node = conversation.image.tags[tags].iter();
    of_node.map(|sample| Sample { revision: Revision::default(), ..*sample }).collect()
}

fn status(conversation: &Conversation, node: &str) -> NodeStatus {
    let status = conversation.image.nodes[engine(conversation, node).0].clone();
    NodeStatus { revision: Revision::default(), ..status }
}

/// Alarms of a node and of its bus, by name.
fn alarms(conversation: &Conversation, node: &str) -> Vec<(String, AlarmStatus)> {
    let node = engine(conversation, node);
    let bus = conversation.table.nodes[node.0].bus;
    let owners = [AlarmOwner::Node(node), AlarmOwner::Bus(bus)];
    let all = conversation.table.alarms.iter().zip(&conversation.image.alarms);
    all.filter(|(def, _)| owners.contains(&def.owner))
        .map(|(def, status)| (def.name.clone(), AlarmStatus { revision: Revision::default(), ..*status }))
        .collect()
}

/// A node that comes first, with a bus of its own: every other place of node, tag and alarm is another than before.
const ANOTHER: &str = "[bus.can2]\ninterface = \"can2\"\n[node.a_first]\nbus = \"can2\"\nid = 9\nunit_id = 99\nmapping = \"motortech-detcon\"\n";

fn by_name(action: &Action, base: &TagTable, to: &TagTable) -> Action {
    let node = |node: NodeIndex| {
        base.node(node).and_then(|def| to.find_node(&def.name)).unwrap_or(NodeIndex(usize::MAX))
    };
    match action.clone() {
        Action::Nmt { node: of, request } => Action::Nmt { node: node(of), request },
        Action::WriteTags { writes } => {
            let moved = writes.iter().map(|(tag, value)| {
                let def = base.tag(*tag).unwrap();
                let tag = to.find_tag(node(def.node), &def.name).unwrap_or(TagIndex(usize::MAX));
                (tag, *value)
            });
            Action::WriteTags { writes: moved.collect() }
        }
        Action::SdoRead { node: of, object, len, timeout } => {
            Action::SdoRead { node: node(of), object, len, timeout }
        }
        Action::SdoWrite { node: of, object, data, timeout } => {
            Action::SdoWrite { node: node(of), object, data, timeout }
        }
        other => other,
    }
}

fn take(conversation: &mut Conversation, step: &Step, base: &TagTable) {
    let at = Now::from_millis(conversation.now_millis());
    let input = |bus: usize, event| Input::Bus { bus: BusIndex(bus), event };
    match step {
        Step::Frame(bus, frame) => conversation.input(input(*bus, BusEvent::Frame { frame: *frame, at })),
        Step::Link(bus, link) => conversation.input(input(*bus, BusEvent::Link { link: *link, at })),
        Step::NotSent(frame) => conversation.input(input(0, BusEvent::NotSent { frame: *frame, at })),
        Step::Command(action) => {
            let action = by_name(action, base, &conversation.table);
            conversation.ask(action);
        }
        Step::Clock(clock_synchronised) => {
            conversation.input(Input::Health(Health {
                clock_synchronised: *clock_synchronised,
                ..Health::default()
            }));
        }
        Step::Pass(millis) => conversation.run_to(conversation.now_millis() + millis),
    }
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 16, failure_persistence: None, ..ProptestConfig::default() })]

    /// Two gateways get the same; one of them goes on with another table every now and then.
    #[test]
    fn p29_whatever_happens_an_exchange_shows_nowhere_in_what_stays(
        steps in prop::collection::vec((step(), any::<u8>()), 1..120)
    ) {
        let base = table_of(EVERYTHING);
        let other = table_of(&format!("{EVERYTHING}{ANOTHER}"));
        let mut steady = Conversation::new((*base).clone());
        let mut changing = Conversation::new((*base).clone());
        for (step, dice) in &steps {
            if dice % 4 == 0 {
                let wider = changing.table.nodes.len() == base.nodes.len();
                changing.exchange(if wider { (*other).clone() } else { (*base).clone() });
            }
            take(&mut steady, step, &base);
            take(&mut changing, step, &base);
            prop_assert_eq!(&steady.all_sent, &changing.all_sent);
            for node in ["drive", "press", "quiet", "scales"] {
                prop_assert_eq!(samples(&steady, node), samples(&changing, node));
                prop_assert_eq!(status(&steady, node), status(&changing, node));
                prop_assert_eq!(alarms(&steady, node), alarms(&changing, node));
            }
            prop_assert_eq!(steady.outcome_words(), changing.outcome_words());
        }
        let transitions = |conversation: &Conversation| -> Vec<(String, String, Option<Value>)> {
            let events = conversation.events().into_iter();
            let alarms = events.filter(|event| event.kind == EventKind::Alarm && event.node.as_deref() != Some("a_first"));
            alarms.map(|event| (event.name, event.to, event.value)).collect()
        };
        prop_assert_eq!(transitions(&steady), transitions(&changing));
    }
}
