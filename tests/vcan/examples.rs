//! The worked examples of the DetCon: frames sent by cansend, values read by mbpoll, pymodbus and mosquitto_sub.
//!
//! V-DET-02, 03, 14 and 15 are conversations and stand in `guarding`; 18 and 19 are about the device's timing, here with
//! `cangate sim` for the device's side and the same frames by cansend for the gateway's.

use std::time::Duration;

use serde_json::{Value, json};

use crate::harness::broker::{Broker, Subscriber};
use crate::harness::bus::{Capture, cansend, take_the_bus};
use crate::harness::device::Device;
use crate::harness::gateway::{Gateway, Setup, TOPICS, simulator};
use crate::harness::modbus::{Table, mbpoll, pymodbus};
use crate::harness::process::Process;
use crate::harness::wait::{GENEROUS, give_it, wait_until, within};

/// Where the values of a DetCon start.
const INTENSITY: u16 = 100;
const INTENSITY_RAW: u16 = 140;
const INTENSITY_FLOAT: u16 = 200;
const ANALOG_OUTPUT: u16 = 120;
const ANALOG_RAW: u16 = 160;
const ANALOG_FLOAT: u16 = 240;
const STATUS_BITS: u16 = 123;
const USED: u16 = 124;
const BAD: u16 = 126;
const LENGTH_ERRORS: u16 = 15;
const USED_BITS: u16 = 32;
const BAD_BITS: u16 = 64;

/// A hall with one DetCon that the test plays: it answers guarding, so that the node is fine, and the test sends TPDOs.
struct Bench {
    subscriber: Subscriber,
    _broker: Broker,
    _device: Device,
    gateway: Gateway,
    node: u8,
}

impl Bench {
    fn new(node: u8) -> Self {
        let broker = Broker::start();
        let subscriber = Subscriber::start(&broker, TOPICS);
        let device = Device::start(node, 5);
        // The test sends one frame at a time and reads it in peace.
        let gateway = Setup::detcons(&[node])
            .broker(&broker)
            .node_key("pdo_timeout_ms = 60000")
            .more(&format!("[node.engine{node}.alarm.\"sensor_fault_*\"]\non_delay_ms = 0\noff_delay_ms = 0"))
            .start();
        gateway.node(node).wait_for_status("a guarded device", |status| status.supervision_ok());
        Self { subscriber, _broker: broker, _device: device, gateway, node }
    }

    /// Reads with pymodbus until the values are as expected, then the same with mbpoll, from both register tables.
    fn expect_registers(&self, example: &str, address: u16, expected: &[u16]) {
        let count = u16::try_from(expected.len()).unwrap();
        let read = || pymodbus(self.gateway.modbus, self.node, Table::Input, address, count);
        let found = within(GENEROUS, || (read().as_deref() == Ok(expected)).then_some(()));
        assert!(found.is_some(), "{example}: registers from {address} are {:?}, not {expected:?}", read());
        for table in [Table::Input, Table::Holding] {
            let by_mbpoll = mbpoll(self.gateway.modbus, self.node, table, address, count);
            assert_eq!(by_mbpoll.as_deref(), Ok(expected), "{example}: {table:?} from {address} by mbpoll");
        }
    }

    fn expect_bits(&self, example: &str, address: u16, count: u16, set: &[u16]) {
        let expected: Vec<u16> = (0..count).map(|bit| u16::from(set.contains(&bit))).collect();
        for table in [Table::Discrete, Table::Coil] {
            let by_mbpoll = mbpoll(self.gateway.modbus, self.node, table, address, count);
            assert_eq!(by_mbpoll.as_ref(), Ok(&expected), "{example}: {table:?} from {address} by mbpoll");
        }
    }

    /// Waits for a state message, from number `from` on, that has all these tags.
    fn expect_tags(&self, example: &str, from: usize, expected: &[(String, Value)]) {
        let topic = format!("engine{}/state", self.node);
        let has_all =
            |payload: &Value| expected.iter().all(|(name, value)| same(&payload["tags"][name], value));
        let found = within(GENEROUS, || {
            self.subscriber.of(&topic, from).into_iter().find(|message| has_all(&message.payload))
        });
        assert!(
            found.is_some(),
            "{example}: no {topic} with {expected:?}; the last was {:?}",
            self.subscriber.of(&topic, 0).last()
        );
    }
}

/// Equal as numbers or as what they are.
fn same(left: &Value, right: &Value) -> bool {
    left == right || left.as_f64().is_some_and(|number| Some(number) == right.as_f64())
}

/// A raw byte, the same in 0.01 %, and in % as MQTT has it.
type Percent = (u16, u16, f64);

/// An intensity frame.
struct Intensities {
    example: &'static str,
    frame: &'static str,
    /// Channel of byte 0.
    first: u16,
    values: &'static [Percent],
}

const INTENSITIES: &[Intensities] = &[
    Intensities {
        example: "V-DET-04",
        frame: "181#00FF80017FFE3340",
        first: 1,
        values: &[
            (0, 0, 0.0),
            (255, 10000, 100.0),
            (128, 5020, 50.2),
            (1, 39, 0.39),
            (127, 4980, 49.8),
            (254, 9961, 99.61),
            (51, 2000, 20.0),
            (64, 2510, 25.1),
        ],
    },
    Intensities {
        example: "V-DET-05",
        frame: "281#00000000000A64C8",
        first: 9,
        values: &[
            (0, 0, 0.0),
            (0, 0, 0.0),
            (0, 0, 0.0),
            (0, 0, 0.0),
            (0, 0, 0.0),
            (10, 392, 3.92),
            (100, 3922, 39.22),
            (200, 7843, 78.43),
        ],
    },
    Intensities {
        example: "V-DET-11",
        frame: "481#0019FF800301",
        first: 17,
        values: &[(0, 0, 0.0), (25, 980, 9.8), (255, 10000, 100.0), (128, 5020, 50.2)],
    },
    Intensities {
        example: "V-DET-16",
        frame: "4FF#FF0000010F00",
        first: 17,
        values: &[(255, 10000, 100.0), (0, 0, 0.0), (0, 0, 0.0), (1, 39, 0.39)],
    },
];

fn check_intensities(bench: &Bench, example: &str) {
    let case = INTENSITIES.iter().find(|case| case.example == example).unwrap();
    let messages = bench.subscriber.count();
    cansend(case.frame);
    let place = case.first - 1;
    let x100: Vec<u16> = case.values.iter().map(|value| value.1).collect();
    let raw: Vec<u16> = case.values.iter().map(|value| value.0).collect();
    let float: Vec<u16> = case.values.iter().flat_map(|value| float_words(value.0)).collect();
    bench.expect_registers(example, INTENSITY + place, &x100);
    bench.expect_registers(example, INTENSITY_RAW + place, &raw);
    bench.expect_registers(example, INTENSITY_FLOAT + 2 * place, &float);
    let tags: Vec<(String, Value)> = (case.first..)
        .zip(case.values)
        .map(|(channel, value)| (format!("knock_intensity_{channel}"), json!(value.2)))
        .collect();
    bench.expect_tags(example, messages, &tags);
}

/// A raw byte as a percentage in float32, high word first.
fn float_words(raw: u16) -> [u16; 2] {
    let bits = (f32::from(raw) * 100.0 / 255.0).to_bits();
    [(bits >> 16) as u16, bits as u16]
}

#[test]
fn v_det_04_05_r_det_047_048_053_to_056_knock_intensities_of_channels_1_to_16() {
    let _bus = take_the_bus();
    let bench = Bench::new(1);
    check_intensities(&bench, "V-DET-04");
    check_intensities(&bench, "V-DET-05");
}

/// A TPDO3.
struct Status {
    example: &'static str,
    frame: &'static str,
    /// Bits 0..6 of byte 0.
    bits: &'static [u16],
    /// Analogue output, ignition reduction limit, immediate stop limit.
    values: [Percent; 3],
    used: u16,
    bad: u16,
    /// Channels with `sensor_fault`.
    faults: &'static [u16],
}

const STATUSES: &[Status] = &[
    Status {
        example: "V-DET-06",
        frame: "381#0080FF0F000099CC",
        bits: &[],
        values: [(128, 5020, 50.2), (153, 6000, 60.0), (204, 8000, 80.0)],
        used: 0x0FFF,
        bad: 0,
        faults: &[],
    },
    Status {
        example: "V-DET-07",
        frame: "381#05C0FFFF00009ACD",
        bits: &[0, 2],
        values: [(192, 7529, 75.29), (154, 6039, 60.39), (205, 8039, 80.39)],
        used: 0xFFFF,
        bad: 0,
        faults: &[],
    },
    Status {
        example: "V-DET-08",
        frame: "381#FFFFFFFFFFFFFFFF",
        bits: &[0, 1, 2, 3, 4, 5, 6],
        values: [(255, 10000, 100.0), (255, 10000, 100.0), (255, 10000, 100.0)],
        used: 0xFFFF,
        bad: 0xFFFF,
        faults: &[1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15, 16],
    },
    Status {
        example: "V-DET-09",
        frame: "381#0000018000010000",
        bits: &[],
        values: [(0, 0, 0.0), (0, 0, 0.0), (0, 0, 0.0)],
        used: 0x8001,
        bad: 0x0100,
        faults: &[],
    },
    Status {
        example: "V-DET-10",
        frame: "381#0000FF0F01800000",
        bits: &[],
        values: [(0, 0, 0.0), (0, 0, 0.0), (0, 0, 0.0)],
        used: 0x0FFF,
        bad: 0x8001,
        faults: &[1],
    },
];

const STATUS_NAMES: [&str; 7] = [
    "engine_knocking",
    "trip",
    "load_reduction",
    "low_rpm",
    "no_isu_pulses",
    "spurious_pulse",
    "eeprom_fault",
];

fn bits_of(field: u16) -> Vec<u16> {
    (0..16).filter(|bit| field >> bit & 1 != 0).collect()
}

#[test]
fn v_det_06_to_10_r_det_050_052_057_to_063_085_088_status_limits_and_sensors() {
    let _bus = take_the_bus();
    let bench = Bench::new(1);
    for case in STATUSES {
        let (example, messages) = (case.example, bench.subscriber.count());
        cansend(case.frame);
        let status: u16 = case.bits.iter().map(|bit| 1 << bit).sum();
        let x100 = case.values.map(|value| value.1);
        bench.expect_registers(example, ANALOG_OUTPUT, &[x100[0], x100[1], x100[2], status, case.used]);
        bench.expect_registers(example, BAD, &[case.bad]);
        bench.expect_registers(example, ANALOG_RAW, &case.values.map(|value| value.0));
        let float: Vec<u16> = case.values.iter().flat_map(|value| float_words(value.0)).collect();
        bench.expect_registers(example, ANALOG_FLOAT, &float);
        bench.expect_bits(example, 0, 7, case.bits);
        bench.expect_bits(example, USED_BITS, 16, &bits_of(case.used));
        bench.expect_bits(example, BAD_BITS, 16, &bits_of(case.bad));

        let mut tags = vec![
            ("analog_output".to_owned(), json!(case.values[0].2)),
            ("ignition_reduction_limit".to_owned(), json!(case.values[1].2)),
            ("immediate_stop_limit".to_owned(), json!(case.values[2].2)),
            ("used_sensors_1_16".to_owned(), json!(case.used)),
            ("bad_inputs_1_16".to_owned(), json!(case.bad)),
        ];
        let is_set = |bit: u16| case.bits.contains(&bit);
        tags.extend((0..).zip(STATUS_NAMES).map(|(bit, name)| (name.to_owned(), json!(is_set(bit)))));
        bench.expect_tags(example, messages, &tags);
        check_sensor_faults(&bench, example, case.faults);
        // All back to nothing, so that the next example has to bring its own.
        cansend("381#0000000000000000");
        bench.expect_registers(example, STATUS_BITS, &[0, 0]);
    }
}

/// Which channels' `sensor_fault` is active, on the alarm topics.
fn check_sensor_faults(bench: &Bench, example: &str, expected: &[u16]) {
    let active = |channel: u16| {
        let topic = format!("engine{}/alarm/sensor_fault_{channel}", bench.node);
        let last = bench.subscriber.of(&topic, 0).pop();
        last.is_some_and(|message| message.payload["active"] == true)
    };
    let as_expected = || (1..=20).all(|channel| active(channel) == expected.contains(&channel));
    assert!(
        within(GENEROUS, || as_expected().then_some(())).is_some(),
        "{example}: sensor faults of {:?}, not of {expected:?}",
        (1..=20).filter(|channel| active(*channel)).collect::<Vec<u16>>()
    );
}

#[test]
fn v_det_11_12_r_det_052_064_to_067_channels_17_to_20_and_reserved_bits() {
    let _bus = take_the_bus();
    let bench = Bench::new(1);
    check_intensities(&bench, "V-DET-11");
    for (example, frame) in [("V-DET-11", "481#0019FF800301"), ("V-DET-12", "481#0019FF80F3F1")] {
        cansend("481#000000000000");
        bench.expect_registers(example, USED + 1, &[0]);
        bench.expect_registers(example, BAD + 1, &[0]);
        cansend(frame);
        bench.expect_registers(example, INTENSITY + 16, &[0, 980, 10000, 5020]);
        bench.expect_registers(example, USED + 1, &[3]);
        bench.expect_registers(example, BAD + 1, &[1]);
        bench.expect_bits(example, USED_BITS + 16, 4, &[0, 1]);
        bench.expect_bits(example, BAD_BITS + 16, 4, &[0]);
        check_sensor_faults(&bench, example, &[17]);
    }
}

#[test]
fn v_det_13_r_det_080_081_a_wrong_length_is_counted_and_only_a_longer_frame_is_decoded() {
    let _bus = take_the_bus();
    let bench = Bench::new(1);
    let registers = bench.gateway.node(1);
    cansend("181#1020304050607080");
    cansend("381#0180FF0F000099CC");
    cansend("481#000000000000");
    bench.expect_registers("V-DET-13", INTENSITY, &[627, 1255, 1882, 2510, 3137, 3765, 4392, 5020]);
    bench.expect_registers("V-DET-13", INTENSITY + 16, &[0; 4]);

    for frame in ["181#00FF80", "381#01", "481#0019FF8003", "181#"] {
        let errors = registers.register(LENGTH_ERRORS);
        cansend(frame);
        wait_until(format!("{frame} to be counted"), || registers.register(LENGTH_ERRORS) == errors + 1);
    }
    bench.expect_registers("V-DET-13", INTENSITY, &[627, 1255, 1882, 2510, 3137, 3765, 4392, 5020]);
    bench.expect_registers("V-DET-13", INTENSITY + 16, &[0; 4]);
    bench.expect_bits("V-DET-13", 0, 7, &[0]);

    cansend("481#0019FF8003010000");
    bench.expect_registers("V-DET-13", INTENSITY + 16, &[0, 980, 10000, 5020]);
}

#[test]
fn v_det_16_r_det_005_the_highest_node_id() {
    let _bus = take_the_bus();
    let capture = Capture::start();
    let bench = Bench::new(127);
    check_intensities(&bench, "V-DET-16");
    bench.expect_registers("V-DET-16", USED + 1, &[15]);
    bench.expect_registers("V-DET-16", BAD + 1, &[0]);
    for (frame, address) in
        [("1FF#0A00000000000000", 100), ("2FF#0A00000000000000", 108), ("3FF#000A000000000000", 120)]
    {
        cansend(frame);
        bench.expect_registers("V-DET-16", address, &[392]);
    }
    // A device that starts: boot-up, request, start.
    drop(bench);
    let device = Device::start(127, 127);
    let frames = capture.count();
    let gateway = Setup::detcons(&[127]).start();
    device.restart();
    capture.wait_for_sequence(&["77F#00", "77F#R1", "77F#7F", "000#017F"], frames);
    gateway.node(127).wait_for_status("start of node 127", |status| status.operational());
}

#[test]
fn v_det_17_r_det_006_042_frames_that_must_not_be_decoded() {
    let _bus = take_the_bus();
    let bench = Bench::new(1);
    let registers = bench.gateway.node(1);
    cansend("181#1020304050607080");
    let intensities = [627, 1255, 1882, 2510, 3137, 3765, 4392, 5020];
    bench.expect_registers("V-DET-17", INTENSITY, &intensities);
    let state = registers.register(2);

    for frame in
        ["00000181#0102030405060708", "181#R8", "581#0102030405060708", "182#0102030405060708", "701#"]
    {
        cansend(frame);
    }
    // A frame that is decoded, behind them all: once it is there, they have been dealt with.
    cansend("281#0A00000000000000");
    bench.expect_registers("V-DET-17", INTENSITY + 8, &[392]);
    bench.expect_registers("V-DET-17", INTENSITY, &intensities);
    assert_eq!(registers.register(LENGTH_ERRORS), 0);
    assert_eq!(registers.register(2), state, "NMT state");
}

/// What the device sent on TPDO1 since `from`.
fn tpdos(capture: &Capture, from: usize) -> usize {
    capture.frames().iter().skip(from).filter(|frame| frame.starts_with("181#")).count()
}

fn expect_sending(capture: &Capture, simulator: &mut Process, command: &str, sends: bool) {
    assert!(simulator.runs());
    cansend(command);
    let from = capture.wait_for(command, 0);
    if sends {
        wait_until(format!("TPDOs after {command}"), || tpdos(capture, from) > 1);
    } else {
        // Two periods of silence, counted from the command.
        assert!(
            within(Duration::from_millis(1500), || (tpdos(capture, from) > 0).then_some(())).is_none(),
            "TPDOs after {command}"
        );
    }
}

#[test]
fn v_det_01_r_det_007_to_010_and_015_start_and_stop_addressed_and_broadcast() {
    let _bus = take_the_bus();
    let mut simulator = simulator(1, &[]);
    // A passive gateway sees what others command.
    let gateway = Setup::one_detcon().passive().start();
    let registers = gateway.node(1);
    for (command, sends) in [
        ("000#01", false),
        ("000#017F", false),
        ("000#0101", true),
        ("000#0201", false),
        ("000#0100", true),
        ("000#0200", false),
    ] {
        let capture = Capture::start();
        expect_sending(&capture, &mut simulator, command, sends);
        if sends {
            registers.wait_for_status(command, |status| status.operational() && status.all_good());
        }
    }
    cansend("701#R1");
    wait_until("the stopped state", || registers.register(2) == 4);
    assert!(!registers.status().operational());
}

#[test]
fn v_det_18_r_det_070_to_075_078_status_frames_out_of_step_are_all_taken() {
    let _bus = take_the_bus();
    let bench = Bench::new(1);
    for (frame, knocking, analog) in [
        ("381#0010FF0F00009ACD", 0, 627),
        ("381#0120FF0F00009ACD", 1, 1255),
        ("381#0020FF0F00009ACD", 0, 1255),
        ("381#0020FFFF00009ACD", 0, 1255),
    ] {
        cansend(frame);
        bench.expect_registers("V-DET-18", ANALOG_OUTPUT, &[analog]);
        bench.expect_registers("V-DET-18", STATUS_BITS, &[knocking]);
    }
    bench.expect_registers("V-DET-18", USED, &[0xFFFF]);
}

#[test]
fn v_det_19_r_det_069_070_076_079_knocking_on_channel_18_speeds_up_three_tpdos() {
    let _bus = take_the_bus();
    let folder = tempfile::TempDir::new().unwrap();
    let scenario = folder.path().join("twenty.toml");
    std::fs::write(&scenario, "description = \"20 cylinders\"\n[device]\ncylinders = 20\n").unwrap();
    let mut simulator = simulator(1, &["--scenario", scenario.to_str().unwrap()]);
    let gateway = Setup::one_detcon().start();
    let registers = gateway.node(1);
    registers.wait_for_status("a good DetCon", |status| status.all_good());
    // Only the knock flag may cause events of TPDO3.
    for order in ["set analog_output 16", "set load_reduction 0"] {
        simulator.say(order);
    }
    let capture = Capture::start();
    simulator.say("knock 18 on");
    wait_until("channel 18 to be the loudest", || registers.register(129) == 18);
    give_it(Duration::from_secs(2));
    let knocking = registers.bit(0);
    simulator.say("knock 18 off");
    wait_until("the end of the knocking", || knocking && !registers.bit(0));

    let status_bit = |frame: &str| frame.strip_prefix("381#").map(|data| &data[1..2] == "1");
    let frames = capture.frames();
    let begin = frames.iter().position(|frame| status_bit(frame) == Some(true)).unwrap();
    let end = begin + frames[begin..].iter().position(|frame| status_bit(frame) == Some(false)).unwrap();
    let count = |id: &str| frames[begin..end].iter().filter(|frame| frame.starts_with(id)).count();
    let fast = [count("181#"), count("281#"), count("481#")];
    println!("V-DET-19: while knocking TPDO1, 2, 4 {fast:?}, TPDO3 {}", count("381#"));
    assert!(fast.iter().all(|fast| *fast > 2 * count("381#")), "{fast:?} and {}", count("381#"));
    assert_eq!(registers.register(170), 1, "one rise of engine_knocking");
}
