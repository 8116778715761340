//! What the registers and bits show.

use cangate::mapping::{OnLoss, Protocol, TagTable};
use cangate::modbus::map_text::{MapFormat, render};
use cangate::modbus::{ModbusSettings, RegisterBank, RegisterMap, WordOrder};
use cangate::process_image::{
    AlarmIndex, AlarmState, BusState, Event, EventKind, NmtState, NodeCounters, Priority, ProcessImage,
    Quality, Reason, Value,
};
use cangate::time::{Instant, Now};

use crate::support::plant::{self, at, event, good, happen, lose};
use crate::support::registers::{ask, bank, bits, pdu, registers, table, well};

fn read(bank: &RegisterBank, image: &ProcessImage, unit: u8, address: u16, quantity: u16) -> Vec<u16> {
    registers(bank, image, at(40), unit, address, quantity).unwrap()
}

#[test]
fn a_value_stands_in_every_encoding_where_the_mapping_puts_it() {
    let (bank, image) = well();
    let expected_float = 12.549_02_f32.to_bits();
    let [float_high, float_low] = [expected_float >> 16, expected_float & 0xFFFF];
    let values = read(&bank, &image, 1, 100, 8);
    assert_eq!(values[..6], [1255, 1255, 0, 1255, 0, 1255]);
    assert_eq!([u32::from(values[6]), u32::from(values[7])], [float_high, float_low]);
    assert_eq!(read(&bank, &image, 1, 112, 8), [0; 8], "reserved registers of a block read 0");
}

#[test]
fn input_and_holding_registers_show_the_same_and_bits_likewise() {
    let (bank, image) = well();
    for (one, other, quantity) in [(3, 4, 100), (1, 2, 192)] {
        let first = ask(&bank, &image, at(0), 1, &pdu(one, 0, quantity));
        let second = ask(&bank, &image, at(0), 1, &pdu(other, 0, quantity));
        assert_eq!(first[1..], second[1..]);
    }
}

#[test]
fn several_nodes_share_a_unit_by_their_offset() {
    let (bank, mut image) = well();
    let tags = table().nodes[3].tags.start;
    image.tags[tags] = good(Value::Float(77.77));
    assert_eq!(read(&bank, &image, 1, 1100, 1), [7777]);
    assert_eq!(read(&bank, &image, 1, 100, 1), [1255]);
    assert_eq!(read(&bank, &image, 1, 1002, 1), [5], "the node block moves too");
    image.tags[tags + 2] = good(Value::Bool(true));
    assert_eq!(bits(&bank, &image, 1, 1000, 2).unwrap(), [false, true]);
    assert_eq!(bits(&bank, &image, 1, 0, 2).unwrap(), [false, false]);
}

fn lost() -> (RegisterBank, ProcessImage) {
    let (bank, mut image) = well();
    let table = table();
    for node in 0..4 {
        lose(&mut image, &table, node, at(100));
    }
    (bank, image)
}

#[test]
fn r_det_084_invalid_values_cannot_be_mistaken() {
    let (bank, image) = lost();
    assert_eq!(
        read(&bank, &image, 1, 100, 12),
        [0xFFFF, 0x8000, 0xFFFF, 0xFFFF, 0x8000, 0, 0x7FC0, 0, 0xFFFF, 0, 0xFFFF, 0xFFFF]
    );
}

#[test]
fn r_det_084_hold_keeps_the_last_value_and_the_status_word_tells() {
    let (bank, image) = lost();
    assert_eq!(read(&bank, &image, 2, 100, 2), [1255, 1255]);
    assert_eq!(read(&bank, &image, 2, 1, 1)[0] & 0b1001, 0, "neither online nor good");
}

#[test]
fn what_was_never_received_cannot_be_held() {
    let table = table();
    let mut image = plant::image(&table);
    image.tags[table.nodes[1].tags.start].quality = Quality::NEVER;
    let bank = bank(table, &ModbusSettings::default());
    assert_eq!(read(&bank, &image, 2, 100, 2), [0xFFFF, 0x8000]);
}

#[test]
fn f48_exception_answers_0b_only_where_invalid_data_is_touched() {
    let (bank, image) = lost();
    assert_eq!(registers(&bank, &image, at(0), 3, 100, 1), Err(0x0B));
    assert_eq!(registers(&bank, &image, at(0), 3, 99, 2), Err(0x0B));
    assert_eq!(
        registers(&bank, &image, at(0), 3, 111, 2),
        Err(0x0B),
        "the second half of a value is touched too"
    );
    assert!(registers(&bank, &image, at(0), 3, 112, 8).is_ok());
    assert!(registers(&bank, &image, at(0), 3, 0, 100).is_ok(), "the status block always answers");
    assert_eq!(bits(&bank, &image, 3, 0, 1), Err(0x0B));
    assert!(bits(&bank, &image, 3, 128, 64).is_ok(), "so do the alarms");
    assert!(bits(&bank, &image, 3, 96, 1).is_ok(), "and a validity bit, which is what tells");
}

#[test]
fn r_det_084_zero_on_bad_shows_zero_where_the_last_value_would_stand() {
    let mut table = table();
    table.nodes[1].zero_on_bad = true;
    let mut image = plant::image(&table);
    image.tags[table.nodes[1].tags.start + 2] = good(Value::Bool(true));
    let bank = bank(table.clone(), &ModbusSettings::default());
    assert_eq!((read(&bank, &image, 2, 100, 1)[0], bits(&bank, &image, 2, 1, 1).unwrap()[0]), (1255, true));
    lose(&mut image, &table, 1, at(0));
    assert_eq!((read(&bank, &image, 2, 100, 1)[0], bits(&bank, &image, 2, 1, 1).unwrap()[0]), (0, false));
}

#[test]
fn uncertain_values_are_shown_stale_ones_are_not() {
    let table = table();
    let mut image = plant::image(&table);
    let tag = table.nodes[0].tags.start;
    let bank = bank(table, &ModbusSettings::default());
    for (quality, expected) in [
        (Quality::Uncertain(Reason::NodeLost), 1255),
        (Quality::Stale(Reason::PdoTimeout), 0xFFFF),
        (Quality::Bad(Reason::NodeLost), 0xFFFF),
    ] {
        image.tags[tag].quality = quality;
        assert_eq!(read(&bank, &image, 1, 100, 1), [expected], "{quality}");
    }
}

#[test]
fn r_det_086_a_bit_keeps_its_last_value_and_its_validity_bit_drops() {
    let table = table();
    let mut image = plant::image(&table);
    let first = table.nodes[0].tags.start;
    image.tags[first + 2] = good(Value::Bool(true));
    let bank = bank(table, &ModbusSettings::default());
    let trip_and_valid = |image: &ProcessImage| {
        (bits(&bank, image, 1, 1, 1).unwrap()[0], bits(&bank, image, 1, 96, 1).unwrap()[0])
    };
    assert_eq!(trip_and_valid(&image), (true, true));
    image.tags[first + 2].quality = Quality::Bad(Reason::NodeLost);
    assert_eq!(trip_and_valid(&image), (true, true));
    image.tags[first].quality = Quality::Stale(Reason::PdoTimeout);
    assert_eq!(trip_and_valid(&image), (true, false), "the data that it vouches for is not good");
    image.tags[first].quality = Quality::Good;
    image.tags[first + 1].quality = Quality::Uncertain(Reason::NodeLost);
    assert_eq!(trip_and_valid(&image), (true, false), "nor is itself");
}

#[test]
fn word_order_turns_every_32_bit_value_and_nothing_else() {
    let little = ModbusSettings { word_order: WordOrder::Little, ..ModbusSettings::default() };
    let table = table();
    let image = plant::image(&table);
    let (big, little) = (bank(table.clone(), &ModbusSettings::default()), bank(table, &little));
    assert_eq!(
        read(&big, &image, 247, 90, 10),
        [0x1234, 0x1234, 0x5678, 0x449A, 0x5000, 0xFFFE, 0xFFFF, 0xFFFE, 0, 0]
    );
    assert_eq!(
        read(&little, &image, 247, 90, 10),
        [0x1234, 0x5678, 0x1234, 0x5000, 0x449A, 0xFFFE, 0xFFFE, 0xFFFF, 0, 0]
    );
    let (a, b) = (read(&big, &image, 1, 100, 8), read(&little, &image, 1, 100, 8));
    assert_eq!(a[..2], b[..2]);
    assert_eq!([a[2], a[3], a[6], a[7]], [b[3], b[2], b[7], b[6]]);
    assert_ne!(big.map().hash(), little.map().hash(), "a client has to know");
}

#[test]
fn half_of_a_32_bit_value_can_be_read() {
    let (bank, image) = well();
    assert_eq!(read(&bank, &image, 247, 92, 2), [0x5678, 0x449A]);
}

#[test]
fn the_status_word_has_a_bit_for_each_fact() {
    let table = table();
    let word = |change: &dyn Fn(&mut ProcessImage)| {
        let mut image = plant::image(&table);
        change(&mut image);
        read(&bank(table.clone(), &ModbusSettings::default()), &image, 1, 1, 1)[0]
    };
    let (well, alarm) = (0b1111, table.nodes[0].alarms.start);
    assert_eq!(word(&|_| ()), well);
    assert_eq!(word(&|image| image.nodes[0].online = false), 0b1110);
    assert_eq!(word(&|image| image.nodes[0].nmt = Some(NmtState::Stopped)), 0b1101);
    assert_eq!(word(&|image| image.nodes[0].supervised = false), 0b1011);
    assert_eq!(word(&|image| image.tags[0].quality = Quality::Uncertain(Reason::NodeLost)), 0b0111);
    assert_eq!(word(&|image| image.alarms[alarm].state = AlarmState::Acknowledged), well | 1 << 4);
    assert_eq!(word(&|image| image.alarms[alarm].state = AlarmState::ReturnedUnacknowledged), well | 1 << 5);
    assert_eq!(word(&|image| image.alarms[alarm].state = AlarmState::Unacknowledged), well | 3 << 4);
    assert_eq!(word(&|image| image.nodes[0].simulated = true), well | 1 << 6);
    assert_eq!(word(&|image| image.nodes[0].identity_mismatch = true), well | 1 << 7);
    assert_eq!(word(&|image| image.nodes[0].pdos[0].stale = true), well | 1 << 8);
    assert_eq!(word(&|image| image.nodes[0].pdos[0].last_received = None), well | 1 << 8);
    assert_eq!(word(&|image| image.tags[0].quality = Quality::Stale(Reason::NodeRestarted)), 0b0111 | 1 << 8);
    assert_eq!(word(&|image| image.nodes[0].passive = true), well | 1 << 12);
    assert_eq!(word(&|image| image.nodes[1].online = false), well, "another node is none of its business");
}

#[test]
fn the_node_block_shows_state_ages_alarms_and_counters() {
    let table = table();
    let mut image = plant::image(&table);
    let alarms = table.nodes[0].alarms.start;
    image.alarms[alarms].state = AlarmState::Acknowledged;
    image.alarms[alarms + 2].state = AlarmState::Unacknowledged;
    image.nodes[0].generation = 0x1_0007;
    image.nodes[0].counters = NodeCounters {
        restarts: 1,
        guard_misses: 2,
        toggle_errors: 3,
        pdo_length_errors: 4,
        nmt_commands_sent: 5,
        emcys: 6,
        sdo_errors: 7,
        unexpected_states: 0x1_0008,
        frames_received: 0x1_0002_0003,
        ..NodeCounters::default()
    };
    let bank = bank(table, &ModbusSettings::default());
    let block = read(&bank, &image, 1, 0, 100);
    assert_eq!(block[2..12], [5, 40, 40, 65_535, 65_535, 65_535, 2, 1, 4, 7]);
    assert_eq!(block[12..22], [1, 2, 3, 4, 5, 6, 7, 8, 2, 3]);
    let seconds = u32::try_from(plant::MORNING_MS / 1000).unwrap();
    assert_eq!(u32::from(block[30]) << 16 | u32::from(block[31]), seconds);
    assert_eq!(block[32..34], [123, 1]);
    assert!(block[22..30].iter().chain(&block[34..]).all(|register| *register == 0), "the rest is reserved");
}

#[test]
fn ages_end_at_65535_and_mean_more_or_never() {
    let table = table();
    let mut image = plant::image(&table);
    let bank = bank(table, &ModbusSettings::default());
    let ages = |image: &ProcessImage, millis| registers(&bank, image, at(millis), 1, 3, 2).unwrap();
    assert_eq!(ages(&image, 1500), [1500, 1500]);
    assert_eq!(ages(&image, 70_000), [65_535, 65_535]);
    image.nodes[0].pdos[0].last_received = None;
    assert_eq!(ages(&image, 0), [65_535, 65_535]);
    image.nodes[0].nmt = None;
    assert_eq!(read(&bank, &image, 1, 2, 1), [65_535]);
}

#[test]
fn a_node_heartbeat_counts_while_its_data_is_fresh_even_if_the_gateway_itself_has_stopped() {
    let table = table();
    let mut image = plant::image(&table);
    let bank = bank(table, &ModbusSettings::default());
    let heartbeat = |image: &ProcessImage| (read(&bank, image, 1, 0, 1)[0], read(&bank, image, 255, 0, 1)[0]);
    assert_eq!(heartbeat(&image), (0, 0));
    bank.tick(&image, at(1000));
    bank.tick(&image, at(1500));
    assert_eq!(heartbeat(&image), (2, 2));
    // Nobody has written the image since: the data grows old, whatever the image says of it.
    bank.tick(&image, at(1501));
    bank.tick(&image, at(2000));
    assert_eq!(heartbeat(&image), (2, 4));
    image.nodes[0].pdos[0].last_received = Some(Instant::from_millis(2500));
    bank.tick(&image, at(3000));
    assert_eq!(heartbeat(&image), (3, 5));
    image.nodes[0].online = false;
    image.written_at = Instant::from_millis(3050);
    bank.tick(&image, at(3100));
    assert_eq!(heartbeat(&image), (3, 6));
}

#[test]
fn the_gateway_heartbeat_stops_when_its_core_has_not_written_for_three_seconds() {
    let table = table();
    let mut image = plant::image(&table);
    let bank = bank(table, &ModbusSettings::default());
    let heartbeat_at = |image: &ProcessImage, millis| {
        bank.tick(image, at(millis));
        read(&bank, image, 247, 0, 1)[0]
    };
    image.written_at = Instant::from_millis(10_000);
    assert_eq!(heartbeat_at(&image, 10_500), 1);
    assert_eq!(heartbeat_at(&image, 13_000), 2);
    assert_eq!(heartbeat_at(&image, 13_001), 2, "modbus itself still runs");
    assert_eq!(heartbeat_at(&image, 60_000), 2);
    image.written_at = Instant::from_millis(60_500);
    assert_eq!(heartbeat_at(&image, 61_000), 3);
}

#[test]
fn alarm_bits_tell_active_and_unacknowledged() {
    let table = table();
    let mut image = plant::image(&table);
    let alarms = table.nodes[0].alarms.start;
    let bank = bank(table, &ModbusSettings::default());
    let set = |image: &ProcessImage| {
        let bits = bits(&bank, image, 1, 128, 64).unwrap();
        bits.iter().enumerate().filter(|(_, bit)| **bit).map(|(at, _)| 128 + at).collect::<Vec<_>>()
    };
    assert_eq!(set(&image), [0; 0]);
    image.alarms[alarms].state = AlarmState::Unacknowledged;
    image.alarms[alarms + 1].state = AlarmState::Acknowledged;
    image.alarms[alarms + 2].state = AlarmState::ReturnedUnacknowledged;
    assert_eq!(set(&image), [128, 131, 160, 176]);
}

#[test]
fn the_alarms_of_an_array_share_a_bit() {
    let mut table = table();
    let alarms = table.nodes[0].alarms.start;
    table.alarms[alarms + 1].bit = Some(16);
    let mut image = plant::image(&table);
    let bank = bank(table, &ModbusSettings::default());
    for alarm in [alarms + 1, alarms + 2] {
        image.alarms[alarm].state = AlarmState::Acknowledged;
        assert!(bits(&bank, &image, 1, 144, 1).unwrap()[0]);
        image.alarms[alarm].state = AlarmState::Normal;
    }
    assert!(!bits(&bank, &image, 1, 144, 1).unwrap()[0]);
}

#[test]
fn the_gateway_answers_under_three_unit_ids() {
    let (bank, image) = well();
    let blocks = [0, 255, 247].map(|unit| read(&bank, &image, unit, 0, 100));
    assert_eq!(blocks[0], blocks[1]);
    assert_eq!(blocks[0], blocks[2]);
    assert_eq!(read(&bank, &image, 1, 2, 1), [5], "unit 1 is a node");
}

#[test]
fn the_gateway_block_shows_what_is_well() {
    let table = table();
    let mut image = plant::image(&table);
    image.mqtt_connected = true;
    let bank = bank(table, &ModbusSettings::default());
    let now = Now { instant: Instant::from_millis(70_000_999), ..at(0) };
    let block = registers(&bank, &image, now, 247, 0, 100).unwrap();
    assert_eq!(block[1], 0b01_1001, "all healthy, MQTT connected, clock synchronised");
    assert_eq!(block[2..4], [1, 4464], "70,000 s");
    assert_eq!(block[4..20], [0b11110, 0, 0, 0, 0, 0, 0, 0, 0b11110, 0, 0, 0, 0, 0, 0, 0]);
    let hash = bank.map().hash();
    assert_eq!(block[20], 1);
    assert_eq!(format!("{:04x}{:04x}", block[21], block[22]), bank.map().hash_text()[..8]);
    assert_eq!(u64::from(block[21]), hash >> 48);
    assert_eq!(block[30..36], [4, 123, 40, 0, 0, 0]);
    assert!(block[23..30].iter().chain(&block[36..90]).all(|register| *register == 0));
}

#[test]
fn the_gateway_status_word_has_a_bit_for_each_fact() {
    let table = table();
    let word = |change: &dyn Fn(&mut ProcessImage)| {
        let mut image = plant::image(&table);
        change(&mut image);
        read(&bank(table.clone(), &ModbusSettings::default()), &image, 247, 1, 1)[0]
    };
    assert_eq!(word(&|_| ()), 0b01_0001);
    assert_eq!(word(&|image| image.nodes[2].nmt = None), 0b01_0000);
    assert_eq!(word(&|image| image.tags[9].quality = Quality::Stale(Reason::PdoTimeout)), 0b01_0000);
    assert_eq!(word(&|image| image.alarms[0].state = AlarmState::Acknowledged), 0b01_0011);
    assert_eq!(word(&|image| image.alarms[0].state = AlarmState::Unacknowledged), 0b01_0111);
    assert_eq!(word(&|image| image.clock_synchronised = false), 0b00_0001);
    assert_eq!(word(&|image| image.buses[0].state = BusState::BusOff), 0b11_0001);
}

#[test]
fn a_node_that_is_not_online_drops_out_of_its_bitmap() {
    let (bank, mut image) = well();
    image.nodes[1].online = false;
    assert_eq!(read(&bank, &image, 247, 4, 1), [0b11010]);
    assert_eq!(read(&bank, &image, 247, 12, 1), [0b11110]);
}

#[test]
fn node_ids_stand_in_the_bitmaps_from_1_to_127_and_two_of_one_id_need_both() {
    let mut table = table();
    for (node, id) in [(0, 127), (1, 16), (2, 1), (3, 1)] {
        let Protocol::Canopen(settings) = &mut table.nodes[node].protocol else { panic!("a CANopen node") };
        settings.id = cangate::canopen::NodeId::new(id).unwrap();
    }
    let mut image = plant::image(&table);
    let bank = bank(table, &ModbusSettings::default());
    assert_eq!(read(&bank, &image, 247, 4, 8), [2, 1, 0, 0, 0, 0, 0, 1 << 15]);
    image.nodes[3].online = false;
    assert_eq!(read(&bank, &image, 247, 4, 1), [0]);
    assert_eq!(read(&bank, &image, 247, 12, 1), [2]);
}

fn record(bank: &RegisterBank, image: &ProcessImage, seq: u16) -> Vec<u16> {
    read(bank, image, 247, 202 + seq % 32 * 12, 12)
}

#[test]
fn the_event_ring_shows_the_last_32_events_each_in_its_place() {
    let (bank, mut image) = well();
    assert_eq!(read(&bank, &image, 247, 200, 2), [0, 0]);
    assert_eq!(record(&bank, &image, 0)[..2], [0, 0], "an empty record has number 0");
    happen(&mut image, 40);
    assert_eq!(read(&bank, &image, 247, 200, 2), [0, 40]);
    for seq in 9..=40 {
        assert_eq!(record(&bank, &image, seq)[..2], [0, seq]);
    }
    let seconds = u32::try_from(plant::MORNING_MS / 1000).unwrap();
    let [high, low] = [seconds >> 16, seconds & 0xFFFF].map(|word| u16::try_from(word).unwrap());
    // Number, seconds, milliseconds, kind (node), node id, bus, no alarm, no array, NMT state 5, no priority.
    assert_eq!(record(&bank, &image, 40), [0, 40, high, low, 163, 2, 1, 1, 65_535, 0, 5, 0]);
    assert_eq!(read(&bank, &image, 247, 586, 4), [0; 4]);
}

#[test]
fn an_alarm_event_carries_its_number_state_and_priority() {
    let mut table = table();
    let alarms = table.nodes[1].alarms.start;
    table.alarms[alarms + 1].bit = Some(16);
    let mut image = plant::image(&table);
    let bank = bank(table, &ModbusSettings::default());
    let mut append = |alarm: usize, node: Option<&str>, bus: Option<&str>| {
        let seq = image.journal.newest() + 1;
        image.journal.append(Event {
            kind: EventKind::Alarm,
            node: node.map(Into::into),
            bus: bus.map(Into::into),
            from: "normal".into(),
            to: "latched_unacknowledged".into(),
            alarm: Some(AlarmIndex(alarm)),
            priority: Some(Priority::Critical),
            ..event(seq)
        });
        record(&bank, &image, u16::try_from(seq).unwrap())[5..].to_vec()
    };
    assert_eq!(append(alarms, Some("engine2"), None), [1, 2, 1, 0, 0, 4, 4]);
    assert_eq!(append(alarms + 2, Some("engine2"), None), [1, 2, 1, 16, 2, 4, 4], "second of its array");
    assert_eq!(append(1, None, Some("can0")), [1, 0, 1, 101, 0, 4, 4], "bus off");
    assert_eq!(append(0, None, None), [1, 0, 0, 201, 0, 4, 4], "no MQTT session");
}

fn map_error(change: impl Fn(&mut TagTable)) -> String {
    let mut table = table();
    change(&mut table);
    RegisterMap::build(&table, &ModbusSettings::default(), "cangate").unwrap_err().to_string()
}

#[test]
fn a_map_in_which_two_want_one_address_is_refused_and_both_are_named() {
    let error = map_error(|table| table.nodes[3].offset = 111);
    assert!(error.contains("tag `knock_intensity_1` of node `engine1`"), "{error}");
    assert!(error.contains("the node block of `engine4`"), "{error}");
    let error = map_error(|table| table.nodes[3].offset = 65_436);
    assert!(error.contains("65535 is the last"), "{error}");
    let error = map_error(|table| table.nodes[2].unit_id = 247);
    assert!(error.contains("`engine3`") && error.contains("gateway_unit_id"), "{error}");
}

#[test]
fn the_hash_changes_with_what_a_client_depends_on_and_with_nothing_else() {
    let hash = |change: &dyn Fn(&mut TagTable)| {
        let mut table = table();
        change(&mut table);
        RegisterMap::build(&table, &ModbusSettings::default(), "cangate").unwrap().hash()
    };
    let same = hash(&|_| ());
    assert_eq!(same, hash(&|table| table.tags[0].description = "other words".into()));
    assert_eq!(same, hash(&|table| table.nodes[0].on_loss = OnLoss::Hold));
    assert_ne!(same, hash(&|table| table.tags[0].registers[0].address = 113));
    assert_ne!(same, hash(&|table| table.tags[0].registers[0].resolution = 0.1));
    assert_ne!(same, hash(&|table| table.tags[0].unit = "V".into()));
    assert_ne!(same, hash(&|table| table.nodes[0].offset = 5000));
    assert_ne!(same, hash(&|table| table.gateway = "hall-2".into()));
}

#[test]
fn every_point_of_the_map_can_be_read_and_every_entry_has_its_point() {
    let table = table();
    let image = plant::image(&table);
    let bank = bank(table, &ModbusSettings::default());
    let map = bank.map();
    for point in map.points() {
        let address = u16::try_from(point.address).unwrap();
        let readable = if point.table.word() == "input_register" {
            registers(&bank, &image, at(0), point.unit_id, address, point.count).is_ok()
        } else {
            bits(&bank, &image, point.unit_id, address, point.count).is_ok()
        };
        assert!(readable, "{point:?}");
    }
    for unit_id in map.unit_ids() {
        let unit = map.unit(unit_id).unwrap();
        let places = unit.registers.entries().iter().map(|entry| ("input_register", entry.address));
        let bit_places = unit.bits.entries().iter().map(|entry| ("discrete_input", entry.address));
        for (table, address) in places.chain(bit_places) {
            let covers = |point: &&cangate::modbus::Point| {
                point.unit_id == unit_id
                    && point.table.word() == table
                    && (point.address..point.address + u32::from(point.count)).contains(&address)
            };
            assert_eq!(map.points().iter().filter(covers).count(), 1, "unit {unit_id} {table} {address}");
        }
    }
}

#[test]
fn the_structured_text_has_a_constant_for_every_point() {
    let mut table = table();
    table.nodes[0].name = "1-pump".into();
    table.tags[0].description = "ends here *) or\nthere".into();
    let map = RegisterMap::build(&table, &ModbusSettings::default(), "cangate").unwrap();
    let text = render(&map, MapFormat::St);
    let declared: Vec<(&str, &str)> = text
        .lines()
        .filter_map(|line| line.trim().split_once(" : "))
        .filter(|(_, rest)| rest.contains(":="))
        .collect();
    let names: std::collections::BTreeSet<&str> = declared.iter().map(|(name, _)| *name).collect();
    assert_eq!(names.len(), declared.len(), "each name once");
    let addresses = declared.iter().filter_map(|(_, rest)| rest.strip_prefix("UINT := ")?.split(';').next());
    let expected: Vec<String> = map.points().iter().map(|point| point.address.to_string()).collect();
    assert_eq!(addresses.collect::<Vec<_>>(), expected);
    let pattern =
        "    CANGATE_TEST_U32_U32 : UINT := 91; (* input register: Always 0x12345678 = 305419896 *)";
    assert!(text.lines().any(|line| line == pattern), "{text}");
    assert!(text.contains("    N_1_PUMP_UNIT_ID : BYTE := 1;"));
    let hash = format!("16#{}", map.hash_text()[..8].to_uppercase());
    assert!(text.contains(&hash));
    assert_eq!(
        text.matches("(*").count(),
        text.matches("*)").count(),
        "no description ends its comment early"
    );
    assert_eq!(text.lines().filter(|line| line.contains("(*") && !line.ends_with("*)")).count(), 0);
}
