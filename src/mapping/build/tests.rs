//! The DetCon as the tag table has it.

use crate::mapping::testing::detcon;
use crate::mapping::{AlarmCondition, AlarmOwner, Encoding, Source, Space, TagTable};
use crate::process_image::{NodeIndex, TagIndex};

fn places(table: &TagTable, node: usize) -> Vec<(Space, u16, &str, Encoding)> {
    let range = table.nodes[node].tags.clone();
    let mut places: Vec<_> = table.tags[range]
        .iter()
        .flat_map(|tag| {
            tag.registers
                .iter()
                .map(|register| (register.space, register.address, tag.name.as_str(), register.encoding))
        })
        .collect();
    places.sort();
    places
}

#[test]
fn the_detcon_stands_in_the_register_map_as_promised() {
    let table = detcon(&["engine1"]);
    let places = places(&table, 0);
    let find = |space, address| {
        places.iter().find(|place| place.0 == space && place.1 == address).map(|place| (place.2, place.3))
    };
    let register = |address| find(Space::Register, address);
    let bit = |address| find(Space::Bit, address).map(|found| found.0.to_owned());
    let status = [
        "engine_knocking",
        "trip",
        "load_reduction",
        "low_rpm",
        "no_isu_pulses",
        "spurious_pulse",
        "eeprom_fault",
    ];
    for channel in 1..=20u16 {
        let name = format!("knock_intensity_{channel}");
        assert_eq!(register(99 + channel), Some((name.as_str(), Encoding::U16)));
        assert_eq!(register(139 + channel), Some((name.as_str(), Encoding::Raw16)));
        assert_eq!(register(198 + 2 * channel), Some((name.as_str(), Encoding::F32)));
        assert_eq!(bit(31 + channel), Some(format!("sensor_used_{channel}")));
        assert_eq!(bit(63 + channel), Some(format!("input_bad_{channel}")));
        assert_eq!(bit(95 + channel), Some(format!("channel_valid_{channel}")));
    }
    for (index, name) in (0u16..).zip(["analog_output", "ignition_reduction_limit", "immediate_stop_limit"]) {
        assert_eq!(register(120 + index), Some((name, Encoding::U16)));
        assert_eq!(register(160 + index), Some((name, Encoding::Raw16)));
        assert_eq!(register(240 + 2 * index), Some((name, Encoding::F32)));
    }
    for (address, name, encoding) in [
        (123, "status_bits", Encoding::U16),
        (124, "used_sensors_1_16", Encoding::U16),
        (125, "used_sensors_17_20", Encoding::U16),
        (126, "bad_inputs_1_16", Encoding::U16),
        (127, "bad_inputs_17_20", Encoding::U16),
        (128, "knock_intensity_max", Encoding::U16),
        (129, "knock_intensity_max_channel", Encoding::U16),
        (130, "reduction_margin_min", Encoding::I16),
    ] {
        assert_eq!(register(address), Some((name, encoding)));
    }
    for (index, name) in (0u16..).zip(status) {
        assert_eq!(register(170 + index), Some((format!("{name}_count").as_str(), Encoding::U16)));
        assert_eq!(register(180 + index), Some((format!("{name}_age").as_str(), Encoding::U16)));
        assert_eq!(bit(index), Some(name.to_owned()));
        assert_eq!(bit(16 + index), Some(format!("{name}_latched")));
    }
    let (registers, bits) = (20 * 3 + 3 * 3 + 8 + 14, 7 * 2 + 60);
    assert_eq!(places.len(), registers + bits);
}

#[test]
fn inputs_of_a_computed_tag_stand_before_it_and_belong_to_its_node() {
    let table = detcon(&["engine1", "engine2"]);
    for (index, tag) in table.tags.iter().enumerate() {
        let own = table.nodes[tag.node.0].tags.clone();
        assert!(own.contains(&index));
        if let Source::Derived(derived) = &tag.source {
            derived.for_each_input(&mut |input| {
                assert!(input.0 < index && own.contains(&input.0), "{}: {input:?}", tag.name);
            });
        }
        assert!(tag.valid.is_none_or(|valid| own.contains(&valid.0)));
    }
    for alarm in &table.alarms {
        if let (AlarmOwner::Node(node), AlarmCondition::Tags(when)) = (alarm.owner, &alarm.condition) {
            let own = table.nodes[node.0].tags.clone();
            when.for_each_tag(&mut |tag| assert!(own.contains(&tag.0), "{}", alarm.name));
            assert!(alarm.value.is_none_or(|TagIndex(value)| own.contains(&value)));
        }
    }
}

#[test]
fn a_cause_stands_before_the_alarms_that_it_suppresses() {
    let table = detcon(&["engine1", "engine2"]);
    for (index, alarm) in table.alarms.iter().enumerate() {
        for cause in &alarm.suppressed_by {
            assert!(*cause < index, "{} before {}", table.alarms[*cause].name, alarm.name);
        }
    }
    let second = table.nodes[1].alarms.clone();
    let find = |name: &str| second.clone().find(|index| table.alarms[*index].name == name).unwrap();
    let lost = &table.alarms[find("node_lost")];
    let causes: Vec<&str> =
        lost.suppressed_by.iter().map(|cause| table.alarms[*cause].name.as_str()).collect();
    assert_eq!(causes, ["bus_off", "interface_down", "bus_silent"]);
    assert!(table.alarms[find("pdo_timeout_3")].suppressed_by.contains(&find("node_lost")));
    assert!(table.alarms[find("engine_knocking")].suppressed_by.contains(&find("trip")));
}

#[test]
fn alarms_of_an_array_share_a_bit_and_others_do_not() {
    let table = detcon(&["engine1"]);
    let bit = |name: &str| table.alarms.iter().find(|alarm| alarm.name == name).unwrap().bit;
    assert_eq!(bit("node_lost"), Some(0));
    assert_eq!((bit("pdo_timeout_1"), bit("pdo_timeout_4")), (Some(3), Some(3)));
    assert_eq!(bit("foreign_guard_master"), Some(8));
    assert_eq!(bit("trip"), Some(16));
    assert_eq!((bit("stop_limit_1"), bit("stop_limit_20")), (Some(19), Some(19)));
    assert_eq!(bit("used_sensors_changed"), Some(26));
}

#[test]
fn each_value_knows_the_tag_that_tells_whether_it_means_anything() {
    let table = detcon(&["engine1"]);
    let node = NodeIndex(0);
    let tag = table.tag(table.find_tag(node, "knock_intensity_12").unwrap()).unwrap();
    assert_eq!(tag.valid, table.find_tag(node, "channel_valid_12"));
    assert_eq!(table.nodes[0].publish.fast_while, table.find_tag(node, "engine_knocking"));
}
