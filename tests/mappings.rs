//! Mapping and configuration files: every shipped one checks, and every message about a wrong one says what, where and how
//! to mend it.

use std::collections::BTreeSet;
use std::io;

use cangate::config;
use cangate::mapping::{self, Diagnostic, SourceText, check_mapping, shipped};

const README: &str = include_str!("../mappings/README.md");

/// The complete example of the manual.
fn example() -> &'static str {
    README.split("```toml\n").nth(1).unwrap().split("```").next().unwrap()
}

fn told(source: &SourceText) -> Vec<String> {
    let problems = check_mapping(source).unwrap_or_else(|problems| problems);
    problems.iter().map(ToString::to_string).collect()
}

fn load(text: &str) -> Result<config::Loaded, Vec<Diagnostic>> {
    config::load(&SourceText::new("cangate.toml", text), [], &mut |_| Err(io::ErrorKind::NotFound.into()))
}

#[test]
fn every_shipped_mapping_checks_without_a_word() {
    assert!(!mapping::shipped::SHIPPED.is_empty());
    for (name, text) in mapping::shipped::SHIPPED {
        assert_eq!(told(&SourceText::new(*name, *text)), Vec::<String>::new(), "{name}");
    }
}

#[test]
fn every_file_in_the_folder_is_shipped() {
    let folder = concat!(env!("CARGO_MANIFEST_DIR"), "/mappings");
    for entry in std::fs::read_dir(folder).unwrap() {
        let path = entry.unwrap().path();
        if path.extension().is_some_and(|ending| ending == "toml") {
            let name = path.file_stem().unwrap().to_str().unwrap();
            assert!(shipped(name).is_some(), "{name} is not built in");
            assert!(README.contains(&format!("{name}.toml")), "{name} is not in the manual");
        }
    }
}

#[test]
fn the_example_of_the_manual_is_a_mapping() {
    assert_eq!(told(&SourceText::new("t4.toml", example())), Vec::<String>::new());
    let text = "version = 1\n[bus.can0]\ninterface = 'virtual:x'\n[node.oven]\nbus = 'can0'\nid = 9\nmapping = './t4.toml'\n[node.oven.parameters]\nhighest = 180\n";
    let source = SourceText::new("cangate.toml", text);
    let loaded = config::load(&source, [], &mut |_| Ok(example().to_owned())).unwrap();
    let oven = loaded.table.find_node("oven").unwrap();
    let places: Vec<(u16, &str)> = loaded
        .table
        .tags
        .iter()
        .flat_map(|tag| tag.registers.iter().map(|register| (register.address, tag.name.as_str())))
        .collect();
    assert!(places.contains(&(103, "temperature_4")) && places.contains(&(116, "temperature_4")));
    let highest = loaded.table.tag(loaded.table.find_tag(oven, "highest").unwrap()).unwrap();
    assert_eq!(highest.source, mapping::Source::Derived(mapping::Derived::Constant { value: 180.0 }));
}

#[test]
fn the_manual_names_every_key_and_every_built_in_alarm() {
    let mut keys = BTreeSet::new();
    collect_keys(&mapping::schema(), &mut keys);
    for builtin in mapping::builtin::OF_NODE.iter().chain(mapping::builtin::OF_BUS) {
        keys.insert(builtin.name.replace("{}", "1"));
    }
    assert!(keys.len() > 60, "{keys:?}");
    for key in keys {
        let words = README.split(|letter: char| !letter.is_alphanumeric() && letter != '_');
        assert!(words.into_iter().any(|word| word == key), "the manual does not name `{key}`");
    }
}

fn collect_keys(schema: &serde_json::Value, keys: &mut BTreeSet<String>) {
    match schema {
        serde_json::Value::Object(map) => {
            for (name, value) in map {
                if let (true, Some(properties)) = (name == "properties", value.as_object()) {
                    keys.extend(properties.keys().cloned());
                }
                collect_keys(value, keys);
            }
        }
        serde_json::Value::Array(items) => items.iter().for_each(|item| collect_keys(item, keys)),
        _ => {}
    }
}

#[test]
fn the_schemas_accept_what_the_program_accepts() {
    let as_json = |text: &str| serde_json::to_value(toml::from_str::<toml::Value>(text).unwrap()).unwrap();
    let mapping = jsonschema::validator_for(&mapping::schema()).unwrap();
    let texts = mapping::shipped::SHIPPED.iter().map(|(_, text)| *text).chain([example()]);
    for text in texts {
        let problems: Vec<String> = mapping
            .iter_errors(&as_json(text))
            .map(|error| format!("{error} at {}", error.instance_path))
            .collect();
        assert_eq!(problems, Vec::<String>::new());
    }
    let config = jsonschema::validator_for(&config::schema()).unwrap();
    assert!(load(EVERYTHING).is_ok(), "{:#?}", load(EVERYTHING).err());
    let problems: Vec<String> = config
        .iter_errors(&as_json(EVERYTHING))
        .map(|error| format!("{error} at {}", error.instance_path))
        .collect();
    assert_eq!(problems, Vec::<String>::new());
    assert!(!mapping.is_valid(&as_json(&example().replace("format = 1", "format = 1\nformt = 1"))));
    assert!(!mapping.is_valid(&as_json(&example().replace("\"i16\"", "\"i99\""))));
    assert!(!config.is_valid(&as_json("version = 1\nbuses = 1")));
}

/// A configuration that uses every key.
const EVERYTHING: &str = r#"
version = 1

[gateway]
name = "hall-1"

[bus.can0]
interface = "can0"
role = "master"
bit_rate = 125000
start_broadcast = false
own_node_id = 127

[bus.can1]
interface = "slcan:/dev/ttyACM0?bitrate=250000"
role = "passive"
bit_rate = 250000

[node.engine1]
bus = "can0"
id = 1
mapping = "motortech-detcon"
unit_id = 11
offset = 1000
on_loss = "hold"
zero_on_bad = true
error_control = "guarding"
guard_time_ms = 250
life_time_factor = 4
guard_reply_ms = 50
toggle_check = "warn"
auto_start = false
start_delay_ms = 100
start_confirm_ms = 500
start_retry_ms = 2000
reset_on_recovery = true
pdo_timeout_ms = 900
strict_dlc = true
required = false
configure = true
check_identity = false
self_starting = false
save_after_config = false
store_timeout_ms = 5000
sdo_timeout_ms = 200

[node.engine1.parameters]
expected_used_sensors_1_16 = 0x0FFF

[node.engine1.tag.trip]
invert = true
description = "Trip output, fail-safe"

[node.engine1.tag.used_sensors_1_16]
byte_order = "big"

[node.engine1.tag."knock_intensity_*"]
deadband = 0.5

[node.engine1.alarm.low_rpm]
enabled = false

[node.engine1.alarm."pdo_timeout_*"]
priority = "high"
on_delay_ms = 100
off_delay_ms = 200
latch = true

[node.engine2]
bus = "can1"
id = 1
mapping = "motortech-detcon"
unit_id = 12
error_control = "heartbeat"
heartbeat_ms = 1000
heartbeat_timeout_ms = 3000

[modbus]
listen = ["127.0.0.1:5020"]
gateway_unit_id = 247

[mqtt]
url = "mqtt://127.0.0.1:1883"
base_topic = "cangate"

[http]
listen = "127.0.0.1:8080"
"#;

#[test]
fn an_installation_changes_what_it_may() {
    use cangate::canopen::{ErrorControl, TogglePolicy};
    use cangate::mapping::{AlarmOwner, OnLoss, Source};
    use cangate::process_image::{NodeIndex, Priority};
    let loaded = load(EVERYTHING).unwrap();
    let table = &loaded.table;
    let node = &table.nodes[0];
    assert_eq!((node.unit_id, node.offset, node.on_loss, node.zero_on_bad), (11, 1000, OnLoss::Hold, true));
    let ErrorControl::Guarding(guarding) = &node.canopen().unwrap().error_control else { panic!("{node:?}") };
    assert_eq!((guarding.guard_time.as_millis(), guarding.life_time_factor), (250, 4));
    assert_eq!((guarding.reply_timeout.as_millis(), guarding.toggle), (50, TogglePolicy::Warn));
    assert!(!node.canopen().unwrap().start.auto_start && node.canopen().unwrap().start.reset_on_recovery);
    assert!(node.pdos().iter().all(|pdo| pdo.strict_length && pdo.timeout.unwrap().as_millis() == 900));
    let tag = |name: &str| table.tag(table.find_tag(NodeIndex(0), name).unwrap()).unwrap();
    let field = |name: &str| match tag(name).source {
        Source::Pdo { field, .. } => field,
        Source::Derived(_)
        | Source::Polled { .. }
        | Source::Adopted { .. }
        | Source::Rpdo { .. }
        | Source::Emergency { .. }
        | Source::Module { .. } => {
            panic!("{name}")
        }
    };
    assert!(field("trip").invert && !field("load_reduction").invert);
    assert!(field("used_sensors_1_16").big_endian && !field("bad_inputs_1_16").big_endian);
    assert!((tag("knock_intensity_20").deadband - 0.5).abs() < 1e-12);
    assert_eq!(tag("trip").description, "Trip output, fail-safe");
    let alarms: Vec<_> =
        table.alarms.iter().filter(|alarm| alarm.owner == AlarmOwner::Node(NodeIndex(0))).collect();
    assert!(!alarms.iter().any(|alarm| alarm.name == "low_rpm"));
    let late = alarms.iter().find(|alarm| alarm.name == "pdo_timeout_3").unwrap();
    assert_eq!((late.priority, late.latch, late.on_delay.as_millis()), (Priority::High, true, 100));
}

/// What is to be replaced in the example of the manual, by what, and the messages that must come of it.
const WRONG_MAPPINGS: &[(&str, &str, &[&str])] = &[
    (
        "format = 1",
        "format = 2",
        &["t4.toml:1:10: error: format 2 is not known to this program\n  hint: it reads format 1"],
    ),
    (
        "[publish]",
        "[publish",
        &[
            "t4.toml:14:9: error: unclosed table, expected `]`\n  hint: the file is not valid TOML here: https://toml.io",
        ],
    ),
    (
        "heartbeat_timeout_ms = 2500",
        "heartbeat_timeout = 2500",
        &[
            "t4.toml:12:1: error: unknown key `heartbeat_timeout`\n  hint: did you mean `heartbeat_timeout_ms`? Known here: kind, guard_time_ms, life_time_factor, guard_reply_ms, toggle_check, toggle_resync, rtr_dlc, settle_ms, heartbeat_ms, heartbeat_timeout_ms",
        ],
    ),
    (
        "kind = \"heartbeat\"",
        "kind = \"hartbeat\"",
        &[
            "t4.toml:11:8: error: unknown word `hartbeat`\n  hint: did you mean `heartbeat`? Known here: guarding, heartbeat, none",
        ],
    ),
    (
        "period_ms = 200",
        "period_ms = \"200\"",
        &[
            "t4.toml:20:13: error: this is of the wrong type: string \"200\"\n  hint: write a whole number, not negative",
        ],
    ),
    (
        "cob_id = \"$NODEID+0x180\"",
        "cob_id = \"NODE+0x180\"",
        &[
            "t4.toml:18:10: error: this value is not possible: string \"NODE+0x180\"\n  hint: write an identifier: \"$NODEID+0x180\", or a number such as 0x181",
        ],
    ),
    (
        "cob_id = \"$NODEID+0x280\"",
        "cob_id = \"$NODEID+0x700\"",
        &[
            "TPDO 2 of node `check` has identifier 701, which is kept for node guarding and heartbeat\n  hint: check `cob_id` in the mapping",
        ],
    ),
    ("length = 8", "length = 9", &["t4.toml:19:10: error: length 9 is out of range\n  hint: use 1 to 8"]),
    (
        "length = 8",
        "length = 7",
        &[
            "t4.toml:43:7: error: `temperature_4` takes bits 48 to 63, but TPDO 1 has only 56 bits\n  hint: byte b bit i is bit 8 b + i; check `bit`, `type` and the `length` of the TPDO",
        ],
    ),
    (
        "[tpdo.2]",
        "[tpdo.second]",
        &["t4.toml:22:7: error: `second` is not the number of a TPDO\n  hint: write [tpdo.1] to [tpdo.512]"],
    ),
    (
        "reserved_bits = [[5, 3]]",
        "reserved_bits = [[4, 4], [23, 2]]",
        &[
            "t4.toml:27:26: error: bits 23 to 24 do not lie in 3 bytes\n  hint: write [first bit, how many]; byte b bit i is bit 8 b + i",
            "warning: `heater_on` uses a bit that reserved_bits names\n  hint: take the bit out of one of them",
        ],
    ),
    (
        "tpdo = 1\nbit = 0",
        "tpdo = 3\nbit = 0",
        &["t4.toml:42:8: error: there is no [tpdo.3]\n  hint: declared are: 1, 2"],
    ),
    (
        "type = \"i16\"",
        "type = \"int16\"",
        &[
            "t4.toml:44:8: error: there is no type `int16`\n  hint: use bool, u1 to u64, i2 to i64, f32 or f64",
        ],
    ),
    (
        "scale = { multiply = 0.1 }",
        "scale = { divide = 0 }",
        &[
            "t4.toml:45:9: error: this scale gives no usable value\n  hint: multiply and divide must not be 0, and all three must be finite numbers",
        ],
    ),
    (
        "name = \"heater_on\"",
        "name = \"wire_broken_2\"",
        &[
            "t4.toml:65:8: error: there are two tags `wire_broken_2`\n  hint: the other is in line 56; rename one of them",
        ],
    ),
    (
        "name = \"heater_on\"",
        "name = \"Heater on\"",
        &[
            "t4.toml:65:8: error: `Heater on` cannot be the name of a tag\n  hint: use 1 to 64 of a-z, 0-9 and _, a letter first",
        ],
    ),
    (
        "name = \"wire_broken_{}\"\ndescription",
        "name = \"wire_broken\"\ndescription",
        &[
            "t4.toml:56:8: error: all elements of `wire_broken` would have the same name\n  hint: put {} into the name, where the number is to stand: `level_{}`",
        ],
    ),
    (
        "array = { first = 1, count = 4 }\ntpdo = 2",
        "tpdo = 2",
        &[
            "t4.toml:56:8: error: `wire_broken_{}` holds {} but is no array\n  hint: add `array = { first = 1, count = 8 }`, or take the {} out of the name",
        ],
    ),
    (
        "bit = 4\n",
        "bit = 3\n",
        &[
            "t4.toml:65:8: warning: `wire_broken_4` and `heater_on` share bit 3\n  hint: check `bit` and `type` of both",
        ],
    ),
    (
        "bit = 8\ntype = \"u16\"",
        "bit = 7\ntype = \"u16\"",
        &[
            "t4.toml:74:7: error: `supply_voltage` does not consist of whole bytes, so byte_order = \"big\" means nothing\n  hint: give it whole bytes, or leave the byte order out",
        ],
    ),
    (
        "address = 104",
        "address = 12",
        &["t4.toml:80:26: error: register 12 belongs to the node itself\n  hint: use addresses from 100 on"],
    ),
    (
        "address = 104",
        "address = 103",
        &[
            "t4.toml:72:8: error: `temperature_4` and `supply_voltage` share register 103\n  hint: give each tag addresses of its own",
        ],
    ),
    (
        "address = 110, type = \"f32\"",
        "address = 65532, type = \"f32\"",
        &[
            "t4.toml:52:15: error: address 65537 of `temperature_3` is above 65535\n  hint: use a lower address",
        ],
    ),
    (
        "type = \"f32\" },\n]",
        "type = \"raw16\", resolution = 0.1 },\n]",
        &["t4.toml:52:49: error: a resolution means nothing for raw16\n  hint: leave it out"],
    ),
    (
        "bit_address = 4",
        "bit_address = 130",
        &[
            "t4.toml:69:15: error: bit address 130 is taken\n  hint: bits 128 to 191 show the node's alarms; use another address",
        ],
    ),
    (
        "unit = \"V\"",
        "unit = \"V\"\nbit_address = 70",
        &[
            "error: `supply_voltage` is a number and cannot stand among the discrete inputs\n  hint: give it `registers`, or make a derived tag with `when`",
        ],
    ),
    (
        "when = \"not wire_broken_{}\"",
        "when = \"not wire_brocken_{}\"",
        &["t4.toml:86:13: error: there is no tag `wire_brocken_1`\n  hint: did you mean `wire_broken_1`?"],
    ),
    (
        "when = \"not wire_broken_{}\"",
        "when = \"wire_broken_{} = 0\"",
        &["t4.toml:86:24: error: `=` cannot stand in a condition\n  hint: equality is written `==`"],
    ),
    (
        "when = \"not wire_broken_{}\"",
        "when = \"not input_ok_{}\"",
        &[
            "error: `input_ok_1` is computed from itself: input_ok_1\n  hint: break the circle: use a tag of a TPDO instead",
        ],
    ),
    (
        "maximum = \"temperature_*\"",
        "maximum = \"wire_broken_*\"",
        &[
            "error: `wire_broken_1` is a bool tag, but a number is needed here\n  hint: name tags that are numbers; `count` and `pack` take bool tags",
        ],
    ),
    (
        "where = \"input_ok_*\"",
        "where = \"inputs_ok_*\"",
        &[
            "error: no tag matches `inputs_ok_*`\n  hint: a * stands for a number: `level_*` means level_1, level_2 and so on",
        ],
    ),
    (
        "where = \"input_ok_*\"",
        "where = [\"input_ok_1\", \"input_ok_2\"]",
        &[
            "error: 4 values, but 2 tags in `where`\n  hint: give one bool tag for each value, in the same order",
        ],
    ),
    (
        "maximum = \"temperature_*\"",
        "maximum = \"temperature_*\"\ncount = \"input_ok_*\"",
        &[
            "error: `temperature_max` says in 2 ways how it is computed\n  hint: give it exactly one of bit, pack, when, maximum, arg_maximum, margin, count, rising_edges, seconds_since_rise, latch or edges_within",
        ],
    ),
    (
        "valid = \"input_ok_{}\"",
        "valid = \"highest\"",
        &[
            "t4.toml:49:9: error: `highest` is a number, but `valid` must be a bool tag\n  hint: make a derived tag of it: when = \"tag > 5\"",
        ],
    ),
    (
        "bit = 17",
        "bit = 16",
        &[
            "error: alarms `too_hot_{}` and `wire_broken_{}` have the same bit 16\n  hint: give each its own bit of 16 to 31",
        ],
    ),
    ("bit = 17", "bit = 3", &["error: bit 3 is out of range\n  hint: use 16 to 31"]),
    (
        "bit = 17",
        "suppressed_by = [\"nod_lost\"]",
        &["error: there is no alarm `nod_lost`\n  hint: did you mean `node_lost`?"],
    ),
    (
        "bit = 17",
        "suppressed_by = [\"wire_broken_{}\"]",
        &[
            "error: alarms suppress each other in a circle: wire_broken_1\n  hint: take one of them out of a `suppressed_by`",
        ],
    ),
    (
        "[builtin_alarm.node_lost]",
        "[builtin_alarm.node_last]",
        &["error: there is no built-in alarm `node_last`\n  hint: did you mean `node_lost`?"],
    ),
    (
        "value = \"temperature_{}\"\npriority = \"high\"",
        "value = \"temperature_{}\"",
        &["error: key `priority` is missing\n  hint: add `priority = ...` here"],
    ),
];

/// Replaces a text by a wrong one and compares what is told: the expected messages, and not many others.
fn compare(
    name: &str,
    right: &str,
    wrong: &[(&str, &str, &[&str])],
    told: impl Fn(&SourceText) -> Vec<String>,
) {
    let mut failures = Vec::new();
    for (from, to, expected) in wrong {
        assert!(right.contains(from), "{name} does not hold {from:?}");
        let found = told(&SourceText::new(name, right.replacen(from, to, 1)));
        for message in *expected {
            if !found.iter().any(|found| found.ends_with(message)) {
                let found = found.join("\n  ");
                failures.push(format!("{to:?} should be told as\n  {message}\nbut was told as\n  {found}\n"));
            }
        }
        if found.len() > expected.len() + 2 {
            failures.push(format!("{to:?} floods the reader:\n  {}\n", found.join("\n  ")));
        }
    }
    assert!(failures.is_empty(), "{} messages are wrong:\n{}", failures.len(), failures.join("\n"));
}

#[test]
fn each_mistake_in_a_mapping_is_told_with_its_place_and_a_hint() {
    compare("t4.toml", example(), WRONG_MAPPINGS, told);
}

const CONFIG: &str = "\
version = 1
[gateway]
name = \"hall-1\"
[bus.can0]
interface = \"vcan0\"
[node.engine1]
bus = \"can0\"
id = 1
mapping = \"motortech-detcon\"
[node.engine2]
bus = \"can0\"
id = 2
mapping = \"motortech-detcon\"
";

const WRONG_CONFIGS: &[(&str, &str, &[&str])] = &[
    (
        "version = 1",
        "version = 3",
        &["cangate.toml:1:11: error: version 3 is not known to this program\n  hint: it reads version 1"],
    ),
    (
        "\"vcan0\"",
        "\"vcan0\"\nbit_rate = 126000",
        &[
            "cangate.toml:6:12: error: 126000 bit/s is no bit rate of CANopen\n  hint: use one of [10000, 20000, 50000, 100000, 125000, 250000, 500000, 800000, 1000000]",
        ],
    ),
    (
        "bus = \"can0\"\nid = 2",
        "bus = \"cam0\"\nid = 2",
        &["cangate.toml:11:7: error: there is no bus `cam0`\n  hint: did you mean `can0`?"],
    ),
    (
        "id = 2",
        "id = 1",
        &[
            "cangate.toml:12:6: error: nodes `engine1` and `engine2` have the same id 1 on bus `can0`\n  hint: every node of a bus needs its own id, set in the device",
        ],
    ),
    ("id = 2\n", "", &["cangate.toml:10:1: error: key `id` is missing\n  hint: add `id = ...` here"]),
    ("id = 2", "id = 128", &["cangate.toml:12:6: error: node id 128 is out of range\n  hint: use 1 to 127"]),
    ("id = 2", "id = 0", &["cangate.toml:12:6: error: node id 0 is out of range\n  hint: use 1 to 127"]),
    (
        "id = 2",
        "id = 2\nunit_id = 1",
        &[
            "cangate.toml:10:7: error: nodes `engine1` and `engine2` share unit id 1 and addresses: register 100 is `knock_intensity_1` of `engine1` and `knock_intensity_1` of `engine2`\n  hint: give one of them another unit_id, or an offset behind the last address of the other",
        ],
    ),
    (
        "id = 2",
        "id = 2\nunit_id = 247",
        &[
            "cangate.toml:13:11: error: unit id 247 is that of the gateway itself\n  hint: give the node another unit_id, or the gateway another gateway_unit_id under [modbus]",
        ],
    ),
    (
        "id = 2",
        "id = 2\nunit_id = 0",
        &["cangate.toml:13:11: error: unit_id 0 is out of range\n  hint: use 1 to 247"],
    ),
    (
        "id = 2",
        "id = 2\noffset = 65300",
        &[
            "cangate.toml:13:10: error: with this offset register 245 is above 65535\n  hint: use 65290 at most",
        ],
    ),
    (
        "id = 2",
        "id = 2\nguard_time_ms = 50",
        &[
            "error: guard_reply_ms 100 is longer than guard_time_ms 50\n  hint: a reply must come before the next request: use the guard time at most",
        ],
    ),
    (
        "id = 2",
        "id = 2\nlife_time_factor = 0",
        &["cangate.toml:13:20: error: life_time_factor 0 is out of range\n  hint: use 1 to 255"],
    ),
    (
        "id = 2",
        "id = 2\nguard_time_ms = 10",
        &["cangate.toml:13:17: error: guard_time_ms 10 is out of range\n  hint: use 20 to 65535"],
    ),
    (
        "\"motortech-detcon\"",
        "\"motortech-detcom\"",
        &[
            "cangate.toml:9:11: error: there is no mapping `motortech-detcom`\n  hint: did you mean `motortech-detcon`?",
        ],
    ),
    (
        "[node.engine2]",
        "[node.Engine2]",
        &[
            "cangate.toml:10:7: error: `Engine2` cannot be the name of a node\n  hint: use 1 to 64 of a-z, 0-9, _ and -",
        ],
    ),
    (
        "[node.engine2]",
        "[node.event]",
        &[
            "cangate.toml:10:7: error: `event` cannot be the name of a node\n  hint: MQTT topics of the gateway itself have this name",
        ],
    ),
    (
        "\"vcan0\"",
        "\"vcan0\"\nown_node_id = 2",
        &[
            "cangate.toml:13:6: error: node id 2 is the gateway's own on bus `can0`\n  hint: every node of a bus needs its own id, set in the device",
        ],
    ),
    (
        "id = 2",
        "id = 2\nparameters = { expected = 3 }",
        &[
            "error: there is no parameter `expected`\n  hint: known here: alarm_on_unused_bad, expected_used_sensors_17_20, expected_used_sensors_1_16",
        ],
    ),
    (
        "id = 2",
        "id = 2\ntag.tripp.invert = true",
        &["cangate.toml:13:5: error: there is no tag `tripp`\n  hint: did you mean `trip`?"],
    ),
    (
        "id = 2",
        "id = 2\ntag.status_bits.invert = true",
        &[
            "cangate.toml:13:26: error: `status_bits` is computed, it has no bits to change\n  hint: change the tags that it is computed from",
        ],
    ),
    (
        "id = 2",
        "id = 2\nalarm.tripp.enabled = false",
        &["cangate.toml:13:7: error: there is no alarm `tripp`\n  hint: did you mean `trip`?"],
    ),
];

#[test]
fn r_det_004_r_det_005_each_mistake_in_a_configuration_is_told_with_its_place_and_a_hint() {
    assert!(load(CONFIG).is_ok());
    compare("cangate.toml", CONFIG, WRONG_CONFIGS, |source| {
        load(&source.text).err().unwrap_or_default().iter().map(ToString::to_string).collect()
    });
}

#[test]
fn all_problems_of_a_file_come_at_once_and_in_its_order() {
    let mut text = example().to_owned();
    for (from, to) in [
        ("kind = \"heartbeat\"", "knd = \"heartbeat\""),
        ("length = 8", "length = 99"),
        ("type = \"i16\"", "type = \"i1\""),
        ("bit_address = 4", "bit_address = \"4\""),
        ("type = \"u16\"\nbyte_order", "byte_order"),
        ("when = \"not wire_broken_{}\"", "when = \"not\""),
        ("maximum = \"temperature_*\"", "maximum = \"supply_voltage\""),
        ("value = \"temperature_{}\"", "value = \"temprature_{}\""),
        ("bit = 17", "bit = 40"),
    ] {
        assert!(text.contains(from), "{from}");
        text = text.replacen(from, to, 1);
    }
    let problems = check_mapping(&SourceText::new("t4.toml", text)).unwrap_err();
    let mut places: Vec<(usize, &str)> =
        problems.iter().map(|problem| (problem.line, problem.message.as_str())).collect();
    assert!(places.is_sorted_by_key(|(line, _)| *line));
    places.dedup_by_key(|(line, _)| *line);
    let messages: Vec<&str> = places.iter().map(|(_, message)| *message).collect();
    assert_eq!(
        messages,
        [
            "unknown key `knd`",
            "length 99 is out of range",
            "there is no type `i1`",
            "this is of the wrong type: string \"4\"",
            "key `type` is missing",
            "the condition is not complete",
            "there is no tag `temprature_1`",
            "bit 40 is out of range",
        ],
        "{problems:#?}"
    );
}

/// One random change of a text.
fn mutated(text: &str, random: &mut fastrand::Rng) -> String {
    const WORDS: [&str; 24] = [
        "\"",
        "[",
        "]",
        "{",
        "}",
        "=",
        "\n",
        "-1",
        "0",
        "99999999999999999999",
        "1e999",
        "nan",
        "true",
        "\"\"",
        "\"{}\"",
        "\"*\"",
        "[[tag]]",
        "[tpdo.1]",
        "[[alarm]]",
        "é",
        "\u{0}",
        "'",
        "#",
        ".",
    ];
    let mut lines: Vec<&str> = text.lines().collect();
    if lines.is_empty() {
        lines.push("");
    }
    let at = random.usize(..lines.len());
    let replaced;
    match random.u8(..8) {
        0 => {
            lines.remove(at);
        }
        1 => lines.insert(at, lines[random.usize(..lines.len())]),
        2 => {
            let other = random.usize(..lines.len());
            lines.swap(at, other);
        }
        3 => lines.truncate(at),
        _ => {
            let line = lines[at];
            let places: Vec<usize> =
                line.char_indices().map(|(place, _)| place).chain([line.len()]).collect();
            let start = places[random.usize(..places.len())];
            let end = places[random.usize(..places.len())].max(start);
            let end = if random.bool() { start } else { end };
            let word = if random.bool() {
                WORDS[random.usize(..WORDS.len())]
            } else {
                lines[random.usize(..lines.len())]
            };
            replaced = format!("{}{word}{}", &line[..start], &line[end..]);
            lines[at] = &replaced;
        }
    }
    lines.join("\n")
}

fn assert_placed(problems: &[Diagnostic], text: &str) {
    let lines = text.split('\n').count().max(1);
    for problem in problems {
        assert!(problem.line >= 1 && problem.column >= 1, "{problem}");
        assert!(problem.line <= lines || problem.file != "cangate.toml", "{problem}");
        assert!(!problem.message.is_empty() && !problem.file.is_empty(), "{problem:?}");
    }
}

/// Every kind of entry once, short, so that many mutations are checked in little time.
const SMALL: &str = r#"format = 1
[device]
vendor = "V"
model = "M"
[error_control]
guard_time_ms = 300
[publish]
fast_while = "on"
[tpdo.1]
cob_id = "$NODEID+0x180"
length = 4
period_ms = 100
reserved_bits = [[20, 2]]
[[parameter]]
name = "most"
default = 5
[[tag]]
name = "level_{}"
array = { first = 1, count = 2 }
tpdo = 1
bit = 0
type = "u8"
scale = { multiply = 100, divide = 255 }
valid = "on"
registers = [{ address = 100, type = "u16", resolution = 0.01 }, { address = 110, type = "f32" }]
[[tag]]
name = "on"
tpdo = 1
bit = 16
type = "bool"
bit_address = 3
[[derived]]
name = "top"
maximum = "level_*"
where = ["on", "on"]
[[derived]]
name = "{}_count"
array = { words = ["on"] }
rising_edges = "{}"
[[alarm]]
name = "high_{}"
array = { first = 1, count = 2 }
when = "level_{} > most and not (on or top == 0x10)"
priority = "low"
suppressed_by = ["node_lost"]
text = "High."
action = "Lower {}."
bit = 16
[builtin_alarm."pdo_timeout_*"]
enabled = false
"#;

fn check_mutations(count: usize, right: &str, seed: u64) {
    let mut random = fastrand::Rng::with_seed(seed);
    let mut wrong = 0;
    for _ in 0..count {
        let mut text = mutated(right, &mut random);
        if random.bool() {
            text = mutated(&text, &mut random);
        }
        if let Err(problems) = check_mapping(&SourceText::new("m.toml", text.clone())) {
            assert!(!problems.is_empty());
            let own: Vec<Diagnostic> =
                problems.into_iter().filter(|problem| problem.file == "m.toml").collect();
            assert_placed(&own, &text);
            wrong += 1;
        }
    }
    assert!(wrong > count / 4, "only {wrong} of {count} mutations were mistakes");
}

#[test]
fn no_mutated_mapping_makes_the_program_panic_and_every_problem_has_its_place() {
    assert_eq!(told(&SourceText::new("m.toml", SMALL)), Vec::<String>::new());
    check_mutations(17_000, SMALL, 1);
    check_mutations(500, example(), 2);
    check_mutations(100, shipped("motortech-detcon").unwrap(), 3);
}

#[test]
fn no_mutated_configuration_makes_the_program_panic_and_every_problem_has_its_place() {
    let mut random = fastrand::Rng::with_seed(4);
    let right = CONFIG.replace("motortech-detcon", "./m.toml");
    for _ in 0..2_500 {
        let text = mutated(&right, &mut random);
        let source = SourceText::new("cangate.toml", text.clone());
        if let Err(problems) = config::load(&source, [], &mut |_| Ok(SMALL.to_owned())) {
            assert_placed(&problems, &text);
        }
    }
}

/// A mapping with two TPDOs, and what stands under their heads and after them.
fn two_tpdos(first: &str, second: &str, rest: &str) -> SourceText {
    let text = format!(
        "format = 1\ndevice = {{ vendor = 'x', model = 'y' }}\n{rest}\n[tpdo.1]\ncob_id = '$NODEID+0x180'\n\
         length = 8\n{first}\n[tpdo.2]\ncob_id = '$NODEID+0x280'\nlength = 8\n{second}\n"
    );
    SourceText::new("own.toml", text)
}

#[test]
fn a_tpdo_of_which_nobody_would_notice_the_end_is_told_unless_that_is_said_to_be_meant() {
    assert_eq!(told(&two_tpdos("period_ms = 100", "timeout_ms = 500", "")), [""; 0]);
    assert_eq!(told(&two_tpdos("period_ms = 100", "timeout_ms = 0", "")), [""; 0]);
    assert_eq!(
        told(&two_tpdos("period_ms = 100", "", "")),
        [
            "own.toml:8:7: warning: TPDO 2 is not supervised: when it no longer comes, its last values stay good\n  hint: give it `period_ms` or `timeout_ms`; `timeout_ms = 0` says that it is meant so"
        ]
    );
    let unwatched = "[error_control]\nkind = 'none'";
    let never = "nobody would notice that the device is gone";
    let told = told(&two_tpdos("period_ms = 100", "timeout_ms = 0", unwatched));
    assert!(
        matches!(told.as_slice(), [one] if one.contains("warning: TPDO 2") && one.contains(never)),
        "{told:?}"
    );
    let config = CONFIG.replace("id = 2\n", "id = 2\nguard_time_ms = 0\npdo_timeout_ms = 0\n");
    let warnings = load(&config).unwrap().warnings;
    assert_eq!(warnings.len(), 1, "{warnings:?}");
    assert!(warnings[0].message.contains(never) && warnings[0].line == 14, "{warnings:?}");
}

#[test]
fn values_and_their_validity_are_paired_by_their_numbers() {
    let tags = |first: u8| {
        format!(
            "[[tag]]\nname = 'level_{{}}'\narray = {{ first = 1, count = 3 }}\ntpdo = 1\nbit = 0\ntype = 'u8'\n\
             [[tag]]\nname = 'ok_{{}}'\narray = {{ first = {first}, count = 3 }}\ntpdo = 2\nbit = 0\ntype = 'bool'\n\
             [[derived]]\nname = 'highest'\nmaximum = 'level_*'\nwhere = 'ok_*'\n"
        )
    };
    let told = |first| {
        let source = two_tpdos("period_ms = 100", "period_ms = 100", "");
        told(&SourceText::new("own.toml", source.text + &tags(first)))
    };
    assert_eq!(told(1), [""; 0]);
    let wrong = told(2);
    assert!(
        matches!(wrong.as_slice(), [one] if one.ends_with(
            "error: `level_1` has no tag in `where`: those there are numbered 2, 3, 4\n  hint: give both the same numbers, or list the tags one by one in the same order"
        )),
        "{wrong:#?}"
    );
}

#[test]
fn a_key_that_would_change_nothing_is_told() {
    let config = CONFIG.replace("id = 2\n", "id = 2\ntag.alarm_on_unused_bad.deadband = 3\n");
    let problems = load(&config).err().unwrap_or_default();
    assert!(
        matches!(problems.as_slice(), [one] if one.to_string() ==
            "cangate.toml:13:5: error: `alarm_on_unused_bad` is a parameter, not a tag of the device\n  hint: set it under [node.NAME.parameters]"),
        "{problems:?}"
    );
    let stride = "array = { first = 1, count = 4, bit_stride = 2 }";
    for (from, entry) in
        [("when = \"not wire_broken_{}\"", "input_ok"), ("when = \"wire_broken_{}\"", "wire_broken")]
    {
        let at = example().find(from).unwrap();
        let (before, after) = example().split_at(at);
        let array = before.rfind("array = { first = 1, count = 4 }").unwrap();
        let text = format!(
            "{}{}{after}",
            &before[..array],
            before[array..].replacen("array = { first = 1, count = 4 }", stride, 1)
        );
        let told = told(&SourceText::new("t4.toml", text));
        assert!(
            matches!(told.as_slice(), [one] if one.ends_with("error: `bit_stride` means nothing here\n  hint: it is for tags of a TPDO; leave it out")),
            "{entry}: {told:#?}"
        );
    }
}
