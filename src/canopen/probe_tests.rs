//! Tests of [`super`].

use super::*;

/// Answers of nodes on a bus, by request.
type Answers = BTreeMap<String, &'static str>;

fn ids(range: std::ops::RangeInclusive<u8>) -> Vec<NodeId> {
    range.filter_map(NodeId::new).collect()
}

/// Runs a probe; gives the frames with their times in ms, and what it told.
fn run(mut probe: Probe, answers: &Answers) -> (Vec<(u64, String)>, Vec<ProbeOutput>) {
    let (mut frames, mut told) = (Vec::new(), Vec::new());
    let mut now = Instant::START;
    probe.handle_timeout(now);
    loop {
        let mut arrived: Vec<CanFrame> = Vec::new();
        while let Some(output) = probe.poll_output() {
            match output {
                ProbeOutput::Transmit(frame) => {
                    frames.push((now.as_millis(), frame.to_string()));
                    arrived.extend(
                        answers.get(&frame.to_string()).map(|text| text.parse::<CanFrame>().unwrap()),
                    );
                }
                output @ (ProbeOutput::Found(..) | ProbeOutput::Done { .. }) => told.push(output),
            }
        }
        for frame in &arrived {
            now = now + Duration::from_millis(1);
            probe.handle_frame(now, frame);
        }
        if arrived.is_empty() {
            let Some(due) = probe.poll_timeout() else { return (frames, told) };
            now = now.max(due);
            probe.handle_timeout(now);
        }
        assert!(now < Instant::from_millis(600_000), "it does not end");
    }
}

fn dst() -> Answers {
    [
        ("601#4000100000000000", "581#4300100094010200"),
        ("601#4018100100000000", "581#431810013D020000"),
        ("601#4018100200000000", "581#4318100244332211"),
        ("601#4018100300000000", "581#8018100311000906"),
        ("601#4018100400000000", "581#4318100478563412"),
        ("601#4008100000000000", "581#410810000C000000"),
        ("601#6000000000000000", "581#0044535420503932"),
        ("601#7000000000000000", "581#1543006F70000000"),
        ("601#4000180200000000", "581#4F00180201000000"),
        ("601#4017100000000000", "581#4B171000F4010000"),
    ]
    .into_iter()
    .map(|(request, answer)| (request.to_owned(), answer))
    .collect()
}

#[test]
fn r_dst_001_a_node_that_answers_says_what_it_is() {
    let probe = Probe::new(Instant::START, ids(1..=1), BTreeSet::new(), ProbeSettings::default());
    let (_, told) = run(probe, &dst());
    let identity = Identity {
        device_type: Some(0x0002_0194),
        identity: [Some(0x23D), Some(0x1122_3344), None, Some(0x1234_5678)],
        name: Some("DST P92C\0op".to_owned()),
        tpdo1_type: Some(1),
        heartbeat: Some(500),
    };
    assert_eq!(told.len(), 2, "{told:?}");
    let ProbeOutput::Found(node, found) = &told[0] else { panic!("{told:?}") };
    assert_eq!(node.get(), 1);
    assert_eq!((found.device_type, found.identity), (identity.device_type, identity.identity));
    assert_eq!((found.tpdo1_type, found.heartbeat), (identity.tpdo1_type, identity.heartbeat));
    assert!(found.name.as_ref().is_some_and(|name| name.starts_with("DST P92C")), "{found:?}");
    assert_eq!(told[1], ProbeOutput::Done { not_sent: 0, nobody_acknowledges: false });
}

#[test]
fn silent_nodes_get_one_sdo_request_and_one_guard_request_and_nothing_else() {
    let probe = Probe::new(Instant::START, ids(1..=3), BTreeSet::new(), ProbeSettings::default());
    let (frames, told) = run(probe, &Answers::new());
    let frames: Vec<&str> = frames.iter().map(|(_, frame)| frame.as_str()).collect();
    assert_eq!(
        frames,
        [
            "601#4000100000000000",
            "602#4000100000000000",
            "603#4000100000000000",
            "701#R1",
            "702#R1",
            "703#R1"
        ]
    );
    assert_eq!(told, [ProbeOutput::Done { not_sent: 0, nobody_acknowledges: false }]);
}

#[test]
fn a_node_whose_state_is_known_gets_no_guard_request() {
    let known = BTreeSet::from([NodeId::new(2).unwrap()]);
    let mut probe = Probe::new(Instant::START, ids(1..=3), known, ProbeSettings::default());
    probe.handle_frame(Instant::START, &"703#05".parse().unwrap());
    let (frames, _) = run(probe, &Answers::new());
    let guarded: Vec<&str> =
        frames.iter().filter(|(_, frame)| frame.ends_with("R1")).map(|(_, frame)| frame.as_str()).collect();
    assert_eq!(guarded, ["701#R1"]);
}

#[test]
fn a_whole_bus_is_never_asked_faster_than_20_frames_a_second_and_node_0_never() {
    let probe = Probe::new(Instant::START, ids(1..=127), BTreeSet::new(), ProbeSettings::default());
    let (frames, _) = run(probe, &dst());
    for pair in frames.windows(2) {
        assert!(pair[1].0 >= pair[0].0 + 50, "{pair:?}");
    }
    assert!(frames.iter().all(|(_, frame)| !frame.starts_with("600#") && !frame.starts_with("700#")));
    assert!(frames.last().unwrap().0 < 20_000, "a scan takes {} ms", frames.last().unwrap().0);
}

#[test]
fn where_nobody_acknowledges_the_probe_ends_soon() {
    let mut probe = Probe::new(Instant::START, ids(1..=127), BTreeSet::new(), ProbeSettings::default());
    let mut now = Instant::START;
    probe.handle_timeout(now);
    let mut sent = 0;
    loop {
        match probe.poll_output() {
            Some(ProbeOutput::Transmit(frame)) => {
                sent += 1;
                probe.handle_not_sent(now, &frame);
            }
            Some(ProbeOutput::Done { not_sent, nobody_acknowledges }) => {
                assert_eq!((not_sent, nobody_acknowledges), (10, true));
                break;
            }
            Some(ProbeOutput::Found(..)) => panic!("nobody is there"),
            None => {
                now = probe.poll_timeout().unwrap();
                probe.handle_timeout(now);
            }
        }
    }
    assert_eq!(sent, 10);
    assert_eq!(probe.poll_timeout(), None);
}
