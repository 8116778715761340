//! Keys of mappings and configurations that contradict each other, or that nobody would look at: each is told with its place
//! and a hint.

use std::io;

use cangate::config;
use cangate::mapping::{Sketch, Source, SourceText, check_mapping};

/// A mapping of everything that the mistakes are made in.
const RIGHT: &str = r#"format = 1
device = { vendor = "V", model = "M" }
[error_control]
kind = "heartbeat"
heartbeat_ms = 500
heartbeat_timeout_ms = 1500
[tpdo.1]
cob_id = "$NODEID+0x180"
maps = ["0x6130:1/32"]
timeout_ms = 1000
[rpdo.1]
cob_id = "$NODEID+0x200"
maps = ["0x6200:1/8", "0x6411:1/16"]
[[tag]]
name = "level"
object = "0x6130:1"
type = "u32"
[[tag]]
name = "polled"
object = "0x9149:1"
poll_ms = 1000
type = "u32"
[[tag]]
name = "relay"
rpdo = 1
bit = 0
type = "bool"
default = false
[[tag]]
name = "setpoint"
rpdo = 1
object = "0x6411:1"
type = "i16"
default = 0
[[tag]]
name = "code"
emergency = "code"
type = "u16"
"#;

/// Two nodes: one of the mapping above (`m.toml`), one that is guarded.
const CONFIG: &str = r#"version = 1
[gateway]
name = "hall"
[bus.can0]
interface = "can0"
[bus.can0.sync]
producer = "other"
period_ms = 100
[node.a]
bus = "can0"
id = 1
mapping = "m.toml"
[node.b]
bus = "can0"
id = 2
mapping = "motortech-detcon"
"#;

fn of_mapping(text: &str) -> Vec<String> {
    let problems = check_mapping(&SourceText::new("m.toml", text)).unwrap_or_else(|problems| problems);
    problems.iter().map(ToString::to_string).collect()
}

fn of_config(text: &str) -> Vec<String> {
    let mut read = |path: &str| match path.rsplit('/').next() {
        Some("m.toml") => Ok(RIGHT.to_owned()),
        _ => Err(io::ErrorKind::NotFound.into()),
    };
    let loaded = config::load(&SourceText::new("cangate.toml", text), [], &mut read);
    let problems = loaded.map_or_else(|problems| problems, |loaded| loaded.warnings);
    problems.iter().map(ToString::to_string).collect()
}

/// What is replaced by what, and the message that must come of it, with one more at most.
type Mistake = (&'static str, &'static str, &'static str);

fn compare(right: &str, mistakes: &[Mistake], told: impl Fn(&str) -> Vec<String>) {
    assert_eq!(told(right), Vec::<String>::new());
    for (from, to, expected) in mistakes {
        assert!(right.contains(from), "there is no {from:?}");
        let told = told(&right.replacen(from, to, 1));
        let found = told.iter().any(|message| message == expected);
        assert!(found && told.len() <= 2, "{to:?} should be told as {expected:?}, but: {told:#?}");
    }
}

#[test]
fn a_heartbeat_that_is_guarded_or_missed_at_once_is_refused() {
    compare(
        RIGHT,
        &[
            (
                "heartbeat_timeout_ms = 1500",
                "heartbeat_timeout_ms = 500",
                "m.toml:6:24: error: heartbeat_timeout_ms 500 is not longer than heartbeat_ms 500\n  hint: give the time-out about three times the heartbeat, or leave it out",
            ),
            (
                "kind = \"heartbeat\"",
                "kind = \"guarding\"",
                "m.toml:5:16: error: the device is told to send heartbeats and cannot be guarded as well\n  hint: use `heartbeat`, or take `heartbeat_ms` out of the mapping",
            ),
        ],
        of_mapping,
    );
    compare(
        CONFIG,
        &[
            (
                "id = 2",
                "id = 2\nheartbeat_ms = 1000",
                "cangate.toml:16:16: error: the device is told to send heartbeats and cannot be guarded as well\n  hint: write `error_control = \"heartbeat\"`, or leave `heartbeat_ms` out",
            ),
            (
                "id = 1",
                "id = 1\nerror_control = \"guarding\"",
                "cangate.toml:12:17: error: the device is told to send heartbeats and cannot be guarded as well\n  hint: use `heartbeat`, or take `heartbeat_ms` out of the mapping",
            ),
            (
                "id = 1",
                "id = 1\nheartbeat_timeout_ms = 400",
                "cangate.toml:12:24: error: heartbeat_timeout_ms 400 is not longer than heartbeat_ms 500\n  hint: give the time-out about three times the heartbeat, or leave it out",
            ),
            (
                "id = 1",
                "id = 1\nheartbeat_ms = 3000\nheartbeat_timeout_ms = 3000",
                "cangate.toml:13:24: error: heartbeat_timeout_ms 3000 is not longer than heartbeat_ms 3000\n  hint: give the time-out about three times the heartbeat, or leave it out",
            ),
        ],
        of_config,
    );
    // The time-out of the mapping is for the heartbeat of the mapping.
    let slower = CONFIG.replace("id = 1", "id = 1\nheartbeat_ms = 3000");
    assert_eq!(of_config(&slower), Vec::<String>::new());
}

#[test]
fn keys_of_pdos_that_contradict_each_other_or_are_never_written_are_refused() {
    compare(RIGHT, PDOS, of_mapping);
}

/// Under the head of the TPDO, and of the RPDO.
const TPDO: &str = "cob_id = \"$NODEID+0x180\"\n";
const RPDO: &str = "cob_id = \"$NODEID+0x200\"\n";

const PDOS: &[Mistake] = &[
    (
        TPDO,
        "cob_id = 0x181\nmapping = \"fixed\"\ntransmission_type = 300\n",
        "m.toml:10:21: error: transmission_type 300 is out of range\n  hint: use 0 to 255",
    ),
    (
        TPDO,
        "cob_id = 0x181\nmapping = \"fixed\"\nevent_timer_ms = 70000\n",
        "m.toml:10:18: error: event_timer_ms 70000 is out of range\n  hint: use 0 to 65535",
    ),
    (
        "maps = [\"0x6130:1/32\"]\n",
        "length = 4\ninhibit_time_us = 50\n",
        "m.toml:10:19: error: inhibit_time_us 50 cannot be set\n  hint: devices count in steps of 100 us",
    ),
    (
        TPDO,
        "cob_id = 0x181\nlength = 8\n",
        "m.toml:9:10: error: `maps` of TPDO 1 takes 4 bytes, not 8\n  hint: leave `length` out: it follows from `maps`",
    ),
    (
        TPDO,
        "cob_id = 0x181\nmapping = \"fixed\"\nset_pdo_invalid = true\n",
        "m.toml:10:19: error: the mapping of this PDO is not written, so `set_pdo_invalid` means nothing\n  hint: leave it out, or write `maps` and mapping = \"write\"",
    ),
    (
        TPDO,
        "cob_id = 0x181\nmapping = \"adopt\"\nreserved_bits = [[31, 1]]\n",
        "m.toml:10:18: error: what stands where in a TPDO that is adopted is for the device to say, so `reserved_bits` means nothing\n  hint: leave it out, or write mapping = \"write\"",
    ),
    (
        RPDO,
        "cob_id = 0x201\nmapping = \"adopt\"\n",
        "m.toml:13:11: error: RPDO 1 cannot be adopted: the gateway must know what it sends\n  hint: use `write`, `verify` or `fixed`",
    ),
    (
        RPDO,
        "cob_id = 0x201\nmapping = \"verify\"\nset_pdo_invalid = true\n",
        "m.toml:14:19: error: the mapping of this PDO is not written, so `set_pdo_invalid` means nothing\n  hint: leave it out, or write `maps` and mapping = \"write\"",
    ),
    (
        RPDO,
        "cob_id = 0x201\ntransmission_type = 1\ninhibit_ms = 5\n",
        "m.toml:14:14: error: inhibit_ms means nothing for an RPDO that follows SYNC\n  hint: leave it out, or use transmission type 255",
    ),
    (
        RPDO,
        "cob_id = 0x201\nlength = 4\n",
        "m.toml:13:10: error: `maps` of RPDO 1 takes 3 bytes, not 4\n  hint: leave `length` out: it follows from `maps`",
    ),
    (
        "name = \"setpoint\"\n",
        "name = \"setpoint_{}\"\narray = { first = 1, count = 2 }\n",
        "m.toml:31:9: error: an array cannot be one object\n  hint: write an entry for each object",
    ),
    (
        "type = \"i16\"",
        "type = \"i24\"",
        "m.toml:32:10: error: 0x6411:1 is mapped with 16 bits, but `i24` has 24\n  hint: let `type` and `maps` agree",
    ),
];

#[test]
fn keys_of_tags_that_would_have_no_effect_are_refused() {
    compare(RIGHT, TAGS, of_mapping);
}

const TAGS: &[Mistake] = &[
    (
        "type = \"u16\"",
        "type = \"u8\"",
        "m.toml:38:8: error: `u8` is no type for this part of emergency messages\n  hint: use u16",
    ),
    (
        "type = \"u16\"",
        "type = \"u16\"\nunit = \"device\"",
        "m.toml:36:8: error: `code` comes from emergency messages, so it is not in the device's unit\n  hint: write the unit that it has, or leave `unit` out",
    ),
    (
        "type = \"i16\"",
        "type = \"i16\"\nunit = \"device\"",
        "m.toml:30:8: error: `setpoint` is sent in an RPDO, so it is not in the device's unit\n  hint: write the unit that it has, or leave `unit` out",
    ),
    (
        "type = \"bool\"",
        "type = \"bool\"\nminimum = 0",
        "m.toml:28:11: error: `relay` is a bit, so `minimum` means nothing\n  hint: leave it out",
    ),
    (
        "type = \"bool\"",
        "type = \"bool\"\nmaximum = 1",
        "m.toml:28:11: error: `relay` is a bit, so `maximum` means nothing\n  hint: leave it out",
    ),
    (
        "object = \"0x6130:1\"",
        "tpdo = 1\nbit = 0\npoll_ms = 500",
        "m.toml:18:11: error: `level` stands in a TPDO, so `poll_ms` means nothing\n  hint: leave it out; it is for tags with `object`",
    ),
    (
        "poll_ms = 1000\ntype = \"u32\"",
        "poll_ms = 1000\ntype = \"u12\"\nbyte_order = \"big\"",
        "m.toml:20:10: error: `polled` does not consist of whole bytes, so byte_order = \"big\" means nothing\n  hint: give it whole bytes, or leave the byte order out",
    ),
];

#[test]
fn objects_that_are_read_or_looked_for_in_the_device_have_the_byte_order_that_is_written() {
    let big = RIGHT.replace("type = \"u32\"", "type = \"u32\"\nbyte_order = \"big\"");
    let adopted = big.replace("maps = [\"0x6130:1/32\"]", "mapping = \"adopt\"");
    for (text, name) in [(&big, "polled"), (&adopted, "level"), (&adopted, "polled")] {
        let sketch = Sketch::new().mapping(SourceText::new("own", text.as_str()));
        let (table, _) = sketch.node("node1", 1, "own", |_| ()).build().unwrap();
        let tag = table.tags.iter().find(|tag| tag.name == name).unwrap();
        let (Source::Polled { field, .. } | Source::Adopted { field, .. }) = tag.source else {
            panic!("{:?}", tag.source)
        };
        assert!(field.big_endian, "{name}");
        assert_eq!(
            cangate::mapping::codec::decode(&field, &[1, 2, 3, 4]),
            Some(cangate::process_image::Value::Unsigned(0x0102_0304))
        );
    }
}

#[test]
fn keys_of_a_configuration_that_would_have_no_effect_are_told_where_they_stand() {
    compare(
        CONFIG,
        &[
            (
                "period_ms = 100",
                "period_ms = 100\ncounter = 10",
                "cangate.toml:9:11: error: the gateway does not send SYNC here, so `counter` means nothing\n  hint: leave it out, or write `producer = \"gateway\"`",
            ),
            (
                "id = 2",
                "id = 2\noutputs = true",
                "cangate.toml:16:11: warning: `outputs = true` means nothing here: its mapping has no [rpdo.N]\n  hint: leave `outputs` out",
            ),
        ],
        of_config,
    );
}
