//! A node that is configured before it is started, against a device in the form of a table of objects.

use super::boot_plant::*;
use crate::can::CanId;
use crate::canopen::boot::{BootEvent, BootFailure, BootStep, MappingMode, PdoSetup};
use crate::canopen::object::MappedObject;
use crate::canopen::sdo::{SdoRequest, TransferId};
use crate::canopen::{NetworkOutput, NmtRequest, NmtState, NodeEvent, NodeId, PdoIndex, RpdoIndex};
use crate::time::Now;

#[test]
fn r_dst_024_a_node_is_identified_configured_in_the_right_order_and_then_started() {
    let mut plant = Plant::new(steps());
    plant.link_up();
    let expected =
        ["0x1017:0", "0x1800:2", "0x1800:5", "0x1A00:0", "0x1A00:1", "0x1A00:2", "0x1A00:0", "0x1010:1"];
    assert_eq!(plant.written(), expected);
    assert_eq!(plant.device.objects[&object(0x1A00, 1)], 0x6130_0120_u32.to_le_bytes());
    assert_eq!(plant.device.objects[&object(0x1A00, 0)], [2]);
    assert_eq!(plant.nmt, ["000#8001", "000#0101"], "it might have run; started once, when all is done");
    assert!(plant.told.contains(&BootEvent::Object {
        object: object(0x6131, 1),
        data: Some(0x0022_0000_u32.to_le_bytes().to_vec())
    }));
    assert_eq!(plant.told.last(), Some(&BootEvent::Done { written: 7 }));
}

#[test]
fn r_dst_090_a_gateway_that_starts_again_writes_nothing_and_does_not_stop_the_node() {
    let mut plant = Plant::new(steps());
    plant.link_up();
    let mut again = Plant::new(steps());
    again.device = plant.device;
    again.device.writes.clear();
    again.frame("701#05");
    again.link_up();
    assert_eq!(again.written(), Vec::<String>::new());
    assert_eq!(again.nmt, Vec::<String>::new());
    assert_eq!(again.told.last(), Some(&BootEvent::Done { written: 0 }));
}

#[test]
fn r_dst_023_an_operational_node_is_made_pre_operational_before_its_mapping_is_changed() {
    let mut plant = Plant::new(vec![BootStep::Pdo(setup(MappingMode::Write, true))]);
    plant.device.state = NmtState::Operational;
    plant.frame("701#05");
    plant.link_up();
    assert_eq!(plant.nmt, ["000#8001", "000#0101"]);
    assert!(plant.device.writes.iter().all(|(_, state)| *state == NmtState::PreOperational));
    let expected =
        ["0x1800:2", "0x1800:5", "0x1800:1", "0x1A00:0", "0x1A00:1", "0x1A00:2", "0x1A00:0", "0x1800:1"];
    assert_eq!(plant.written(), expected);
    assert_eq!(
        plant.device.objects[&object(0x1800, 1)],
        0x181_u32.to_le_bytes(),
        "valid again, else as it was"
    );
}

#[test]
fn r_dst_023_a_node_whose_state_is_not_known_is_made_pre_operational_before_its_mapping_is_changed() {
    let mut plant = Plant::new(vec![BootStep::Pdo(setup(MappingMode::Write, false))]);
    plant.device.state = NmtState::Operational;
    plant.link_up();
    assert_eq!(plant.nmt, ["000#8001", "000#0101"]);
    assert!(plant.device.writes.iter().all(|(_, state)| *state == NmtState::PreOperational));
    // One that is as it should be is not disturbed.
    let mut again = Plant::new(vec![BootStep::Pdo(setup(MappingMode::Write, false))]);
    again.device = plant.device;
    again.link_up();
    assert!(!again.nmt.contains(&"000#8001".to_owned()), "{:?}", again.nmt);
}

#[test]
fn r_dst_001_another_device_is_not_started_and_the_letter_says_why() {
    let mut plant = Plant::new(steps());
    plant.device.objects.insert(object(0x1018, 1), 0x1_u32.to_le_bytes().to_vec());
    plant.link_up().run(60_000);
    assert_eq!(plant.nmt, Vec::<String>::new());
    assert_eq!(plant.written(), Vec::<String>::new());
    let expected =
        BootFailure::Identity { object: object(0x1018, 1), expected: 0x23D, found: 1, letter: 'D' };
    assert_eq!(plant.told, [BootEvent::Failed(expected)], "told once, though it is tried again");
    plant.frame("701#7F");
    assert_eq!(plant.nmt, Vec::<String>::new());
}

#[test]
fn r_dst_053_a_silent_node_is_asked_ever_more_seldom_and_at_once_when_it_shows_itself() {
    let mut plant = Plant::new(steps());
    plant.device.mute = true;
    plant.link_up().run(120_000);
    assert_eq!(plant.told, [BootEvent::Failed(BootFailure::NoAnswer)]);
    plant.device.mute = false;
    plant.frame("081#11F0210000000000");
    plant.run(1000);
    let done = plant.told.iter().any(|event| matches!(event, BootEvent::Done { .. }));
    assert!(done, "R-DST-052: an EMCY is a sign of life");
    assert_eq!(plant.nmt, ["000#8001", "000#0101"]);
}

#[test]
fn r_dst_080_081_a_node_is_asked_what_is_wrong_with_it_and_a_refusal_is_no_error() {
    let told = |register: Option<u8>, newest: Option<u32>| {
        let mut plant = Plant::new(vec![BootStep::Errors]);
        // K-DST-09: a count of 1 says nothing.
        plant.device.objects.insert(object(0x1003, 0), vec![1]);
        plant.device.objects.extend(register.map(|register| (object(0x1001, 0), vec![register])));
        plant.device.objects.extend(newest.map(|newest| (object(0x1003, 1), newest.to_le_bytes().to_vec())));
        plant.link_up();
        assert_eq!(plant.told.last(), Some(&BootEvent::Done { written: 0 }));
        plant.told.remove(0)
    };
    assert_eq!(told(Some(0x21), Some(0x0021_F011)), BootEvent::Errors { register: Some(0x21), code: 0xF011 });
    assert_eq!(told(Some(0), Some(0)), BootEvent::Errors { register: Some(0), code: 0 });
    assert_eq!(told(Some(1), None), BootEvent::Errors { register: Some(1), code: 0 });
    assert_eq!(told(None, None), BootEvent::Errors { register: None, code: 0 });
}

#[test]
fn r_dst_052_a_lost_node_that_sends_an_emergency_message_instead_of_a_boot_up_is_booted() {
    let mut plant = Plant::new(steps());
    plant.link_up().run(3000);
    plant.device.mute = true;
    plant.run(3000);
    plant.told.clear();
    plant.device = Device::new();
    for _ in 0..3 {
        plant.frame("081#0063810000000000");
    }
    assert_eq!(plant.begun, 2, "once, however many there are");
    plant.run(3000);
    assert!(plant.told.iter().any(|event| matches!(event, BootEvent::Done { .. })), "{:?}", plant.told);
    assert_eq!(plant.device.state, NmtState::Operational);
}

#[test]
fn r_dst_052_so_is_one_that_sent_it_before_it_was_missed() {
    let mut plant = Plant::new(steps());
    plant.link_up().run(3000);
    plant.told.clear();
    plant.device = Device::new();
    plant.frame("081#0063810000000000");
    plant.run(10_000);
    assert!(plant.told.iter().any(|event| matches!(event, BootEvent::Done { .. })), "{:?}", plant.told);
    assert_eq!(plant.device.state, NmtState::Operational);
}

#[test]
fn r_dst_064_a_boot_up_message_begins_everything_anew() {
    let mut plant = Plant::new(steps());
    plant.link_up();
    plant.told.clear();
    plant.device.objects = Device::new().objects;
    plant.device.state = NmtState::PreOperational;
    plant.frame("701#00");
    plant.run(1000);
    assert_eq!(plant.told.last(), Some(&BootEvent::Done { written: 7 }));
    assert_eq!(plant.nmt, ["000#8001", "000#0101", "000#0101"], "one that booted is pre-operational");
}

#[test]
fn r_dst_024_verify_tells_and_adopt_takes_what_the_node_has() {
    for (mode, tells) in [(MappingMode::Verify, true), (MappingMode::Adopt { timed: true }, false)] {
        let mut plant = Plant::new(vec![BootStep::Pdo(setup(mode, false))]);
        plant.link_up();
        assert_eq!(plant.written(), Vec::<String>::new(), "{mode:?}");
        let deviation = plant.told.contains(&BootEvent::Deviation { pdo: PdoIndex(0) });
        assert_eq!(deviation, tells, "{mode:?}");
        let mapped = plant
            .told
            .iter()
            .find_map(|event| if let BootEvent::Mapped(mapped) = event { Some(mapped) } else { None });
        let mapped = mapped.unwrap();
        assert_eq!(mapped.length(), 5);
        assert_eq!(
            mapped.maps.iter().map(|each| each.entry()).collect::<Vec<_>>(),
            [0x9130_0120, 0x6150_0108]
        );
        plant.frame("181#A086010000");
    }
}

#[test]
fn r_dst_119_a_tpdo_on_another_identifier_is_taken_from_there() {
    let mut plant = Plant::new(vec![BootStep::Pdo(setup(MappingMode::Adopt { timed: true }, false))]);
    plant.device.objects.insert(object(0x1800, 1), 0x1A5_u32.to_le_bytes().to_vec());
    plant.link_up();
    let node = NodeId::new(1).unwrap();
    let received = |plant: &mut Plant, frame: &str| {
        plant.network.handle_frame(Now::from_millis(plant.now), &frame.parse().unwrap());
        std::iter::from_fn(|| plant.network.poll_output())
            .any(|output| matches!(output, NetworkOutput::Node(id, NodeEvent::Pdo { .. }) if id == node))
    };
    assert!(received(&mut plant, "1A5#A086010000"));
    // Bit 29: it has 29 bits.
    plant.device.objects.insert(object(0x1800, 1), 0x2001_2345_u32.to_le_bytes().to_vec());
    plant.frame("701#00");
    plant.run(1000);
    assert!(received(&mut plant, "00012345#A086010000"));
    assert!(!received(&mut plant, "1A5#A086010000"));
    plant.device.objects.insert(object(0x1800, 1), 0x1A5_u32.to_le_bytes().to_vec());
    plant.frame("701#00");
    plant.run(1000);
    assert!(!received(&mut plant, "181#A086010000"));
}

#[test]
fn k_dst_15_a_setting_that_may_be_refused_does_not_keep_the_node_from_starting() {
    let write = |optional| BootStep::Write { object: object(0x6131, 1), data: vec![0, 0, 0x4E, 0], optional };
    for optional in [true, false] {
        let mut plant = Plant::new(vec![write(optional)]);
        plant.device.refuse = Some((object(0x6131, 1), 0x0609_0030));
        plant.link_up();
        assert_eq!(plant.nmt.len(), usize::from(optional));
    }
}

#[test]
fn r_dst_071_a_stopped_node_is_made_pre_operational_before_it_is_asked() {
    let mut plant = Plant::new(steps());
    plant.network.handle_link(Now::from_millis(0), true);
    plant.frame("701#04");
    plant.device.state = NmtState::Stopped;
    plant.run(3000);
    assert_eq!(plant.nmt.first().map(String::as_str), Some("000#8001"));
    assert_eq!(plant.nmt.last().map(String::as_str), Some("000#0101"));
}

#[test]
fn r_dst_034_what_was_known_is_forgotten_at_every_boot_up_and_when_the_bus_was_away() {
    let mut plant = Plant::new(steps());
    plant.link_up();
    assert_eq!(plant.begun, 1);
    plant.network.handle_link(Now::from_millis(plant.now), false);
    plant.link_up();
    assert_eq!(plant.begun, 2);
    plant.frame("701#00");
    assert_eq!(plant.begun, 3, "at once, not when it is asked");
}

#[test]
fn r_dst_071_088_a_stopped_node_is_not_read_and_its_polled_values_are_not_kept_alive() {
    let mut plant = Plant::new(steps());
    plant.link_up().run(2000);
    assert!(plant.polled.len() >= 3 && plant.polled.iter().all(|good| *good), "{:?}", plant.polled);
    plant.network.request_nmt(Now::from_millis(plant.now), NodeId::new(1), NmtRequest::Stop);
    plant.drain();
    plant.polled.clear();
    plant.run(3000);
    assert!(plant.polled.len() >= 2 && plant.polled.iter().all(|good| !*good), "{:?}", plant.polled);
}

#[test]
fn r_dst_088_a_reading_that_others_leave_no_room_for_waits_and_has_not_failed() {
    let mut plant = Plant::new(steps());
    plant.link_up();
    let seen = plant.polled.len();
    while plant.polled.len() == seen {
        plant.run(1);
    }
    plant.run(900);
    plant.polled.clear();
    let mut asked = 0;
    let node = NodeId::new(1).unwrap();
    while plant
        .network
        .request_sdo(
            Now::from_millis(plant.now),
            node,
            TransferId(asked),
            SdoRequest::read(object(0x1018, 1)),
        )
        .is_ok()
    {
        asked += 1;
    }
    // The frames of these leave late, so that the reading is due before the first is answered.
    plant.now += 200;
    plant.network.handle_timeout(Now::from_millis(plant.now));
    plant.run(1500);
    assert!(asked > 2 && !plant.polled.is_empty(), "{asked}");
    assert!(plant.polled.iter().all(|good| *good), "{:?}", plant.polled);
}

#[test]
fn r_dst_059_a_running_node_that_nobody_starts_is_given_back_also_where_its_state_was_not_known() {
    for known in [true, false] {
        let steps = vec![BootStep::Pdo(setup(MappingMode::Write, false))];
        let mut plant = Plant::with(steps, |node| node.start.auto_start = false);
        plant.device.state = NmtState::Operational;
        if known {
            plant.frame("701#05");
        }
        plant.link_up();
        assert_eq!(plant.nmt, ["000#8001", "000#0101"], "known: {known}");
    }
}

#[test]
fn r_dst_023_that_a_node_is_taken_out_of_operation_is_told_and_what_it_sent_before_is_no_surprise() {
    for on_its_way in ["181#0000000000000000", "701#05"] {
        let mut plant = Plant::new(vec![BootStep::Pdo(setup(MappingMode::Write, false))]);
        plant.device.state = NmtState::Operational;
        plant.frame("701#05");
        plant.in_flight = Some(on_its_way);
        plant.link_up();
        let (running, taken_out) = ((NmtState::Operational, true), (NmtState::PreOperational, true));
        assert_eq!(plant.states, [running, taken_out, running], "{on_its_way}");
        assert_eq!(plant.surprises, 0, "{on_its_way}");
    }
}

#[test]
fn r_dst_023_a_node_that_could_not_be_told_to_leave_operation_is_still_in_it() {
    let mut plant = Plant::new(vec![BootStep::Pdo(setup(MappingMode::Write, false))]);
    plant.device.state = NmtState::Operational;
    plant.frame("701#05");
    plant.states.clear();
    plant.network.handle_link(Now::from_millis(0), true);
    let mut refused = false;
    for _ in 0..200 {
        plant.now += 1;
        plant.network.handle_timeout(Now::from_millis(plant.now));
        while let Some(output) = plant.network.poll_output() {
            let now = Now::from_millis(plant.now);
            match output {
                NetworkOutput::Transmit(frame) if frame.id() == CanId::Standard(0) && !refused => {
                    refused = true;
                    plant.network.handle_not_sent(now, &frame);
                }
                NetworkOutput::Transmit(frame) if !refused => {
                    let answer = plant.device.answer(&frame);
                    if let Some(answer) = answer {
                        plant.network.handle_frame(now, &answer);
                    }
                }
                NetworkOutput::Transmit(frame) => panic!("{frame}: not before it is tried again"),
                NetworkOutput::Node(_, NodeEvent::State { to, ordered, .. }) => {
                    plant.states.push((to, ordered));
                }
                NetworkOutput::Node(..) | NetworkOutput::Foreign(_) => {}
            }
        }
    }
    assert!(refused);
    assert_eq!(plant.states, [(NmtState::PreOperational, true), (NmtState::Operational, true)]);
    plant.run(3000);
    assert_eq!(plant.nmt, ["000#8001", "000#0101"], "it is tried again");
}

/// The device with an RPDO that carries 0x6411:1 at 0x201, looked at before it is started.
fn with_rpdo(mode: MappingMode, cob_id: u32) -> Plant {
    let setup = PdoSetup {
        maps: vec![MappedObject::from_entry(0x6411_0110)],
        transmission_type: None,
        event_timer: None,
        ..setup(mode, false)
    };
    let mut plant = Plant::new(vec![
        BootStep::Write { object: object(0x1017, 0), data: 500_u16.to_le_bytes().to_vec(), optional: false },
        BootStep::Rpdo(setup),
    ]);
    plant.device.objects.extend([
        (object(0x1400, 1), cob_id.to_le_bytes().to_vec()),
        (object(0x1400, 2), vec![255]),
        (object(0x1600, 0), vec![1]),
        (object(0x1600, 1), 0x6200_0108_u32.to_le_bytes().to_vec()),
    ]);
    let node = NodeId::new(1).unwrap();
    plant.network.set_rpdo(Now::from_millis(0), node, RpdoIndex(0), Some([0; 8]));
    plant.link_up().run(3_000);
    plant
}

#[test]
fn an_rpdo_is_mapped_as_the_file_says_before_the_first_is_sent() {
    let plant = with_rpdo(MappingMode::Write, 0x201);
    assert_eq!(plant.written(), ["0x1017:0", "0x1600:0", "0x1600:1", "0x1600:0"]);
    assert_eq!(plant.device.objects[&object(0x1600, 1)], 0x6411_0110_u32.to_le_bytes());
    let done = plant.told.iter().position(|event| matches!(event, BootEvent::Done { .. }));
    assert!(done.is_some(), "{:?}", plant.told);
    assert!(!plant.rpdos.is_empty() && plant.rpdos[0] > 20, "{:?}", plant.rpdos);
}

#[test]
fn an_rpdo_that_the_device_takes_otherwise_is_not_sent() {
    for (mode, cob_id) in
        [(MappingMode::Verify, 0x201), (MappingMode::Write, 0x202), (MappingMode::Write, 0x8000_0201)]
    {
        let plant = with_rpdo(mode, cob_id);
        assert!(plant.nmt.contains(&"000#0101".to_owned()), "the node runs all the same");
        assert_eq!(plant.rpdos, Vec::<u64>::new(), "{mode:?} {cob_id:X}");
    }
}

/// The manual leaves open whether a mapping that is too long is refused at its last entry or with their number.
#[test]
fn r_dst_018_019_a_mapping_that_is_refused_is_told_with_the_code_and_the_node_not_started() {
    for (refused, code) in [(1, 0x0604_0041), (2, 0x0604_0042), (0, 0x0604_0042)] {
        let mut plant = Plant::new(vec![BootStep::Pdo(setup(MappingMode::Write, false))]);
        plant.device.refuse = Some((object(0x1A00, refused), code));
        if refused == 0 {
            // Switching the PDO off is no matter of length.
            plant.device.objects.insert(object(0x1A00, 0), vec![0]);
        }
        plant.link_up();
        assert_eq!(plant.nmt, ["000#8001"], "not started");
        let failure = plant.told.iter().find_map(|event| {
            if let BootEvent::Failed(failure) = event { Some(failure.to_string()) } else { None }
        });
        let text = failure.unwrap();
        assert!(
            text.contains(&format!("0x1A00:{refused}")) && text.contains(&format!("0x{code:08X}")),
            "{text}"
        );
    }
}
