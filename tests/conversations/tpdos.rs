//! TPDOs and what becomes of them: V-DET-04..13, 16..19, and qualities.

use cangate::can::{BusEvent, Link};
use cangate::gateway::Action;
use cangate::process_image::{Quality, Reason, Value};
use cangate::time::Now;

use super::{channels, detcon, detcon_with, intensities, running, shown, table};
use crate::support::conversation::Conversation;

const STATUS_BITS: [&str; 7] = [
    "engine_knocking",
    "trip",
    "load_reduction",
    "low_rpm",
    "no_isu_pulses",
    "spurious_pulse",
    "eeprom_fault",
];

fn after(frame: &str) -> Conversation {
    let mut conversation = detcon();
    conversation.frame(frame);
    conversation
}

fn status_bits(conversation: &Conversation) -> Vec<&str> {
    STATUS_BITS.into_iter().filter(|name| conversation.tag(name).value.is_true()).collect()
}

fn field(conversation: &Conversation, tag: &str) -> u64 {
    match conversation.tag(tag).raw {
        Value::Unsigned(raw) => raw,
        other => panic!("{tag}: {other:?}"),
    }
}

#[test]
fn v_det_04_r_det_047_048_053_054_tpdo1_carries_intensities_1_to_8() {
    let conversation = after("181#00FF80017FFE3340");
    let wanted =
        [(0, 0), (255, 10_000), (128, 5_020), (1, 39), (127, 4_980), (254, 9_961), (51, 2_000), (64, 2_510)];
    assert_eq!(intensities(&conversation, 1..=8), wanted);
    assert_eq!(conversation.tag_text("knock_intensity_9"), "0.00 bad (never_received)");
}

#[test]
fn r_det_048_every_raw_value_in_hundredths_of_a_percent() {
    let mut conversation = detcon();
    for raw in 0..=255_u16 {
        conversation.frame(&format!("181#{raw:02X}00000000000000"));
        let exact = (u32::from(raw) * 10_000 + 127) / 255;
        let x100 = u16::try_from(exact).unwrap();
        assert_eq!(shown(&conversation, "knock_intensity_1"), (raw.into(), x100));
    }
}

#[test]
fn v_det_05_r_det_055_056_tpdo2_carries_intensities_9_to_16() {
    let conversation = after("281#00000000000A64C8");
    let wanted = [(0, 0), (0, 0), (0, 0), (0, 0), (0, 0), (10, 392), (100, 3_922), (200, 7_843)];
    assert_eq!(intensities(&conversation, 9..=16), wanted);
}

#[test]
fn v_det_06_r_det_057_to_063_tpdo3_of_an_engine_without_fault() {
    let conversation = after("381#0080FF0F000099CC");
    assert_eq!(status_bits(&conversation), [""; 0]);
    assert_eq!(shown(&conversation, "analog_output"), (128, 5_020));
    assert_eq!(field(&conversation, "used_sensors_1_16"), 0x0FFF);
    assert_eq!(channels(&conversation, "sensor_used", 1..=16), (1..=12).collect::<Vec<_>>());
    assert_eq!(field(&conversation, "bad_inputs_1_16"), 0);
    assert_eq!(channels(&conversation, "sensor_fault", 1..=16), [0; 0]);
    assert_eq!(shown(&conversation, "ignition_reduction_limit"), (153, 6_000));
    assert_eq!(shown(&conversation, "immediate_stop_limit"), (204, 8_000));
}

#[test]
fn v_det_07_r_det_058_059_tpdo3_with_load_reduction() {
    let conversation = after("381#05C0FFFF00009ACD");
    assert_eq!(status_bits(&conversation), ["engine_knocking", "load_reduction"]);
    assert_eq!(shown(&conversation, "analog_output"), (192, 7_529));
    assert_eq!(channels(&conversation, "sensor_used", 1..=16), (1..=16).collect::<Vec<_>>());
    assert_eq!(shown(&conversation, "ignition_reduction_limit"), (154, 6_039));
    assert_eq!(shown(&conversation, "immediate_stop_limit"), (205, 8_039));
}

#[test]
fn v_det_08_r_det_052_all_bits_of_tpdo3_set_the_reserved_one_is_only_counted() {
    let conversation = after("381#FFFFFFFFFFFFFFFF");
    assert_eq!(status_bits(&conversation), STATUS_BITS);
    assert_eq!(conversation.tag("status_bits").value, Value::Unsigned(0x7F));
    assert_eq!(channels(&conversation, "sensor_fault", 1..=16), (1..=16).collect::<Vec<_>>());
    assert_eq!(shown(&conversation, "immediate_stop_limit"), (255, 10_000));
    assert_eq!(conversation.node().counters.reserved_bits, 1);
}

#[test]
fn v_det_09_r_det_050_060_061_byte_order_little_by_default() {
    let conversation = after("381#0000018000010000");
    assert_eq!(field(&conversation, "used_sensors_1_16"), 0x8001);
    assert_eq!(channels(&conversation, "sensor_used", 1..=16), [1, 16]);
    assert_eq!(channels(&conversation, "input_bad", 1..=16), [9]);
    assert_eq!(channels(&conversation, "sensor_fault", 1..=16), [0; 0]);
}

#[test]
fn v_det_10_r_det_085_086_bad_but_unused_is_shown_and_is_no_fault() {
    let mut conversation = after("381#0000FF0F01800000");
    assert_eq!(channels(&conversation, "input_bad", 1..=16), [1, 16]);
    assert_eq!(channels(&conversation, "sensor_fault", 1..=16), [1]);
    assert_eq!(channels(&conversation, "channel_valid", 1..=16), (2..=12).collect::<Vec<_>>());
    conversation.frame("181#FF00000000000000");
    assert_eq!(conversation.tag_text("knock_intensity_1"), "100.00 good", "published all the same");
}

#[test]
fn v_det_11_r_det_064_to_067_tpdo4() {
    let conversation = after("481#0019FF800301");
    assert_eq!(intensities(&conversation, 17..=20), [(0, 0), (25, 980), (255, 10_000), (128, 5_020)]);
    assert_eq!(channels(&conversation, "sensor_used", 17..=20), [17, 18]);
    assert_eq!(channels(&conversation, "input_bad", 17..=20), [17]);
    assert_eq!(channels(&conversation, "sensor_fault", 17..=20), [17]);
}

#[test]
fn v_det_12_r_det_052_reserved_bits_of_tpdo4_change_nothing() {
    let (plain, reserved) = (after("481#0019FF800301"), after("481#0019FF80F3F1"));
    for (tag, (left, right)) in plain.table.tags.iter().zip(plain.image.tags.iter().zip(&reserved.image.tags))
    {
        assert_eq!((left.value, left.quality), (right.value, right.quality), "{}", tag.name);
    }
    assert_eq!((plain.node().counters.reserved_bits, reserved.node().counters.reserved_bits), (0, 1));
}

#[test]
fn v_det_13_r_det_080_a_tpdo_that_is_too_short_changes_nothing_but_a_counter() {
    let mut conversation = running(detcon());
    let errors = conversation.node().counters.pdo_length_errors;
    for (number, frame) in ["181#00FF80", "381#01", "481#0019FF8003", "181#"].iter().enumerate() {
        let before = conversation.image.tags.clone();
        conversation.frame(frame);
        assert_eq!(conversation.image.tags, before, "{frame}");
        assert_eq!(conversation.node().counters.pdo_length_errors, errors + number as u64 + 1);
    }
    conversation.stop_sending("181");
    conversation.run_to(2_400);
    conversation.frame("181#00FF80");
    conversation.play(
        "2499 tag knock_intensity_1 = 0.00 good
         2500 tag knock_intensity_1 = 0.00 stale (pdo_timeout)",
    );
}

#[test]
fn v_det_13_r_det_081_a_tpdo_that_is_too_long_is_decoded_and_told_once() {
    let mut conversation = running(detcon());
    conversation.stop_sending("481");
    for _ in 0..3 {
        conversation.frame("481#0019FF8003010000");
    }
    assert_eq!(intensities(&conversation, 17..=20), [(0, 0), (25, 980), (255, 10_000), (128, 5_020)]);
    assert_eq!(conversation.node().counters.pdo_length_errors, 3);
    assert_eq!(conversation.events_named("pdo_length_exceeded").len(), 1);

    let mut strict = running(detcon_with(|_, node| node.strict_dlc = Some(true)));
    strict.stop_sending("481");
    strict.frame("481#0019FF8003010000");
    assert_eq!(strict.tag_text("knock_intensity_19"), "0.00 good");
    assert_eq!(strict.node().counters.pdo_length_errors, 1);
}

#[test]
fn v_det_16_highest_node_id() {
    let mut conversation = Conversation::new(table(&[("engine1", 127)], |_, _| ()));
    conversation.play(
        "50 <- 77F#00
         60 reply 77F#7F",
    );
    assert_eq!(conversation.all_sent.last().unwrap().to_string(), "000#017F");
    conversation.forget_sent();
    conversation.frame("4FF#FF0000010F00");
    assert_eq!(intensities(&conversation, 17..=20), [(255, 10_000), (0, 0), (0, 0), (1, 39)]);
    assert_eq!(channels(&conversation, "sensor_used", 17..=20), [17, 18, 19, 20]);
}

#[test]
fn v_det_17_r_det_006_frames_that_must_not_be_decoded() {
    let mut conversation = running(detcon());
    let foreign = conversation.bus().foreign_frames;
    let before = conversation.image.tags.clone();
    for frame in
        ["00000181#0102030405060708", "181#R8", "581#0102030405060708", "182#0102030405060708", "701#"]
    {
        conversation.frame(frame);
        assert_eq!(conversation.image.tags, before, "{frame}");
    }
    assert_eq!(conversation.bus().foreign_frames, foreign + 4, "all but the empty guard reply of node 1");
    assert_eq!(conversation.node().counters.malformed, 3);
}

#[test]
fn v_det_18_r_det_071_to_075_tpdo3_whenever_it_comes_is_taken() {
    let mut conversation = running(detcon());
    conversation.stop_sending("381");
    conversation.play(
        "1100 <- 381#0110FF0F000099CC
         1100 tag engine_knocking = true good
         1100 <- 381#0120FF0F000099CC
         1250 <- 381#0020FF0F000099CC
         1250 tag engine_knocking = false good
         2000 <- 381#0020FF07000099CC
         2000 tag used_sensors_1_16 = 2047 good
         2500 <- 381#0020FF07000099CC
         2500 tag engine_knocking_count = 1 good",
    );
}

#[test]
fn v_det_19_r_det_078_079_faster_tpdos_while_knocking() {
    let mut conversation = running(detcon());
    for frame in ["181#0000000000000000", "281#0000000000000000", "481#00FF00000F00"] {
        conversation.stop_sending(&frame[..3]);
        conversation.send_cyclically(frame, 100);
    }
    let before = conversation.node().counters.frames_received;
    conversation.play("2000 tag knock_intensity_18 = 100.00 good");
    let received = conversation.node().counters.frames_received - before;
    assert!((34..=38).contains(&received), "3 TPDOs ten times, TPDO3 and guard replies twice: {received}");
    assert_eq!(conversation.tag_text("knock_intensity_max"), "100.00 good");
    assert_eq!(conversation.tag_text("knock_intensity_max_channel"), "18 good");
    assert_eq!(conversation.tag_text("reduction_margin_min"), "-40.00 good");
    assert!(!conversation.events().iter().any(|event| event.name == "duplicate_node"));
}

#[test]
fn r_det_079_forty_tpdos_a_second_and_more_are_all_counted() {
    let mut conversation = running(detcon());
    let before: u64 = conversation.node().pdos.iter().map(|pdo| pdo.received).sum();
    for _ in 0..1_000 {
        for frame in super::QUIET {
            conversation.frame(frame);
        }
    }
    let received: u64 = conversation.node().pdos.iter().map(|pdo| pdo.received).sum();
    assert_eq!(received - before, 4_000);
}

#[test]
fn r_det_082_pdo_timeout_makes_the_tags_of_that_tpdo_stale_and_no_others() {
    let mut conversation = running(detcon());
    conversation.stop_sending("281");
    conversation.play(
        "2499 tag knock_intensity_9 = 0.00 good
         2500 tag knock_intensity_9 = 0.00 stale (pdo_timeout)
         2500 tag knock_intensity_1 = 0.00 good
         2500 tag knock_intensity_17 = 0.00 good
         2500 event pdo_timeout
         2600 <- 281#FF00000000000000
         2600 tag knock_intensity_9 = 100.00 good
         2600 event pdo_recovered",
    );
    assert_eq!(conversation.node().pdos.iter().filter(|pdo| pdo.stale).count(), 0);
}

#[test]
fn r_det_083_a_tpdo_in_an_unexpected_state_is_decoded_and_the_node_asked() {
    let mut conversation = detcon_with(|_, node| node.auto_start = Some(false));
    conversation.play("50 reply 701#7F");
    let unexpected = conversation.node().counters.unexpected_states;
    conversation.play(
        "700 <- 181#FF00000000000000
         700 tag knock_intensity_1 = 100.00 good
         700 event pdo_in_unexpected_state
         700 -> 701#R1",
    );
    assert!(conversation.node().counters.unexpected_states > unexpected);
    assert_eq!(conversation.node().nmt, Some(cangate::canopen::NmtState::Operational));
}

#[test]
fn r_det_087_until_both_tpdos_have_come_the_other_group_is_unknown_not_0() {
    let mut conversation = after("381#0080FF0F000099CC");
    conversation.play(
        "10 tag sensor_used_1 = true good
         10 tag sensor_used_17 = false bad (never_received)
         10 tag input_bad_20 = false bad (never_received)
         10 tag used_sensors_17_20 = 0 bad (never_received)
         10 tag sensor_faults = 0 bad (never_received)
         10 <- 481#000000000100
         10 tag sensor_used_17 = true good
         10 tag sensor_faults = 0 good",
    );
}

#[test]
fn r_det_084_the_last_value_is_kept_with_its_quality() {
    let mut conversation = running(detcon());
    conversation.frame("181#3300000000000000");
    conversation.link(Link::Down);
    assert_eq!(conversation.tag_text("knock_intensity_1"), "20.00 bad (bus_unavailable)");

    let mut zero = running(detcon_with(|_, node| node.zero_on_bad = true));
    zero.frame("181#3300000000000000");
    zero.link(Link::Down);
    assert_eq!(zero.tag_text("knock_intensity_1"), "0.00 bad (bus_unavailable)");
}

#[test]
fn r_det_092_percent_values_have_no_meaning_beyond_their_number() {
    let conversation = after("381#00FF00000000FFFF");
    for tag in ["analog_output", "ignition_reduction_limit", "immediate_stop_limit"] {
        assert_eq!(conversation.tag(tag).quality, Quality::Good);
    }
    assert_eq!(status_bits(&conversation), [""; 0], "status bits are those of the frame, live");
}

#[test]
fn a_pulse_of_100_ms_leaves_a_latch_a_count_an_age_and_an_event() {
    let mut conversation = running(detcon());
    conversation.stop_sending("381");
    conversation.play(
        "1200 <- 381#0200FF0F000099CC
         1300 <- 381#0000FF0F000099CC",
    );
    conversation.send_cyclically("381#0000FF0F000099CC", 500);
    conversation.play(
        "6000 tag trip = false good
         6000 tag trip_latched = true good
         6000 tag trip_count = 1 good
         6000 tag trip_age = 4 good
         6000 event trip",
    );
}

#[test]
fn a_clock_that_steps_fires_no_timeout() {
    let mut conversation = running(detcon());
    let mut at = Now::from_millis(1_000);
    at.utc = cangate::time::Timestamp::from_millis(-1_000_000_000);
    let frame = "181#3300000000000000".parse().unwrap();
    conversation.bus_event(BusEvent::Frame { frame, at });
    assert_eq!(conversation.tag("knock_intensity_1").received, at.utc);
    assert_eq!(conversation.tag_text("knock_intensity_1"), "20.00 good");
    conversation.run_to(1_600);
    assert_eq!(conversation.tag("knock_intensity_1").quality.reason(), None::<Reason>);
}

#[test]
fn r_det_087_a_maximum_over_channels_of_which_nothing_is_known_is_not_good() {
    let mut conversation = after("381#0080FF0F000099CC");
    conversation.frame("181#3300000000000000");
    conversation.frame("281#0000000000000000");
    assert_eq!(conversation.tag_text("knock_intensity_max"), "20.00 bad (never_received)");
    conversation.frame("481#000000000000");
    assert_eq!(conversation.tag_text("knock_intensity_max"), "20.00 good");
}

#[test]
fn r_det_084_a_maximum_without_a_valid_channel_keeps_its_last_value() {
    let mut conversation = running(detcon());
    conversation.frame("181#0033000000000000");
    assert_eq!(conversation.tag_text("knock_intensity_max"), "20.00 good");
    conversation.frame("381#0000000000009900");
    assert_eq!(conversation.tag_text("knock_intensity_max"), "20.00 bad (no_input)");
    assert_eq!(conversation.tag_text("knock_intensity_max_channel"), "2 bad (no_input)");
    assert_eq!(conversation.tag_text("reduction_margin_min"), "40.00 bad (no_input)");
}

#[test]
fn r_det_081_a_tpdo_that_is_always_too_long_is_warned_of_once() {
    let mut conversation = running(detcon());
    conversation.stop_sending("481");
    conversation.send_cyclically("481#0000000000000000", 500);
    conversation.run_to(30_000);
    assert_eq!(conversation.active(), ["pdo_length"]);
    conversation.run_to(600_000);
    assert_eq!(conversation.active(), [""; 0]);
    assert_eq!(conversation.raised(), ["pdo_length"]);
    assert_eq!(conversation.tag_text("knock_intensity_17"), "0.00 good");
}

#[test]
fn the_generation_counts_changes_that_come_with_mere_time_and_with_an_acknowledgement() {
    let mut conversation = running(detcon());
    conversation.frame("381#0200FF0F000099CC");
    conversation.frame("381#0000FF0F000099CC");
    conversation.run_to(5_100);
    let before = conversation.node().generation;
    conversation.run_to(6_100);
    assert_eq!(conversation.tag_text("trip_age"), "5 good");
    assert!(conversation.node().generation > before, "its age is another");
    let before = conversation.node().generation;
    conversation.command(Action::AcknowledgeAll { node: None });
    assert_eq!(conversation.tag_text("trip_latched"), "false good");
    assert_eq!(conversation.node().generation, before + 1);
}
