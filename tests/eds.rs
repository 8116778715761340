//! EDS and DCF files: every oddity is read and told by line, and an import never moves what it gave away.
//!
//! `CANGATE_EDS_CASES=100000` sets how many mutated files are read; a few hundred without it.

use cangate::mapping::eds::{Eds, Imported, ObjectId, import, read};
use cangate::mapping::{Diagnostic, Severity, SourceText};
use proptest::prelude::*;
use proptest::test_runner::TestRunner;

const IO_MODULE: &[u8] = include_bytes!("fixtures/eds/io_module.eds");
const TRANSMITTER: &[u8] = include_bytes!("fixtures/eds/transmitter.dcf");
const ODD: &[u8] = include_bytes!("fixtures/eds/odd.eds");

fn eds(text: &str) -> Eds {
    read("device.eds", text.as_bytes()).unwrap().0
}

fn imported(eds: &Eds, previous: Option<&str>) -> Imported {
    let previous = previous.map(|text| SourceText::new("device.toml", text));
    import(eds, previous.as_ref()).unwrap()
}

fn shown(problems: &[Diagnostic]) -> String {
    problems.iter().map(|problem| format!("{problem}\n")).collect::<Vec<_>>().concat()
}

fn messages(imported: &Imported) -> Vec<&str> {
    imported.warnings.iter().map(|warning| warning.message.as_str()).collect()
}

/// A tag's entry in a mapping.
fn tag(text: &str, object: &str) -> toml::Table {
    let file: toml::Table = text.parse().unwrap();
    let tags = file.get("tag").and_then(toml::Value::as_array).cloned().unwrap_or_default();
    let mut found = tags.iter().filter(|tag| tag["object"].as_str() == Some(object));
    let tag = found.next().unwrap_or_else(|| panic!("no tag of {object} in\n{text}"));
    assert!(found.next().is_none(), "two tags of {object} in\n{text}");
    tag.as_table().unwrap().clone()
}

fn address(text: &str, object: &str) -> i64 {
    tag(text, object)["registers"][0]["address"].as_integer().unwrap()
}

/// An EDS of one TPDO that carries values of 0x6401, each `sub name type bits`.
fn device(values: &[(u8, &str, u8, u8)]) -> String {
    let text = "[DeviceInfo]\nVendorName=V\nProductName=P\n\
        [1800]\nObjectType=9\nParameterName=c\n[1800sub1]\nDataType=7\nAccessType=rw\nDefaultValue=$NODEID+0x180\n\
        [1A00]\nObjectType=9\nParameterName=m\n[6401]\nObjectType=8\nParameterName=Input\n"
        .to_owned();
    let mut parts =
        vec![text, format!("[1A00sub0]\nDataType=5\nAccessType=rw\nDefaultValue={}\n", values.len())];
    for (place, (sub, name, data_type, bits)) in (1..).zip(values) {
        let place: u8 = place;
        parts.push(format!(
            "[1A00sub{place:X}]\nDataType=7\nAccessType=rw\nDefaultValue=0x6401{sub:02X}{bits:02X}\n\
             [6401sub{sub:X}]\nParameterName={name}\nDataType={data_type}\nAccessType=ro\n"
        ));
    }
    parts.concat()
}

#[test]
fn r_esd_110_and_118_an_eds_in_latin_1_becomes_a_mapping() {
    let (eds, warnings) = read("io_module.eds", IO_MODULE).unwrap();
    assert_eq!(shown(&warnings), "");
    let imported = imported(&eds, None);
    assert_eq!(imported.text, include_str!("fixtures/eds/io_module.toml"));
    assert_eq!(messages(&imported), ["TPDO 3 of the device is off or empty by default"]);
    assert_eq!((imported.tpdos, imported.tags, imported.registers_used, imported.bits_used), (2, 14, 107, 8));
}

#[test]
fn r_esd_110_a_dcf_brings_its_settings() {
    let (eds, warnings) = read("transmitter.dcf", TRANSMITTER).unwrap();
    assert_eq!(shown(&warnings), "");
    assert_eq!((eds.node_id, eds.bit_rate), (Some(5), Some(250_000)));
    let imported = imported(&eds, None);
    assert_eq!(imported.text, include_str!("fixtures/eds/transmitter.toml"));
    assert_eq!(
        messages(&imported),
        [
            "0x1010:1 is a command, no setting; it is left out",
            "`operating_seconds` has u64 and stands in no register"
        ]
    );
}

#[test]
fn every_oddity_is_told_with_its_line_and_a_hint_and_the_rest_is_imported() {
    let (eds, warnings) = read("odd.eds", ODD).unwrap();
    let imported = imported(&eds, None);
    assert_eq!(imported.text, include_str!("fixtures/eds/odd.toml"));
    assert_eq!(shown(&warnings) + &shown(&imported.warnings), include_str!("fixtures/eds/odd.txt"));
    assert!(warnings.iter().chain(&imported.warnings).all(|warning| warning.severity == Severity::Warning));
}

#[test]
fn r_esd_120_and_121_addresses_names_and_what_was_changed_by_hand_stay() {
    let first = imported(&eds(&device(&[(1, "Pressure", 3, 16), (2, "Level", 4, 32)])), None);
    let by_hand = first
        .text
        .replace("name = \"input_pressure\"", "# the old one\nname = \"p1\"\nscale = { multiply = 0.1 }")
        .replacen("unit = \"\"", "unit = \"bar\" # as on the label", 1)
        .replace("mapping = \"verify\"", "mapping = \"adopt\"\ntimeout_ms = 5000");
    let own = "\n# mine\n[[alarm]]\nname = \"high\"\nwhen = \"p1 > 5\"\npriority = \"high\"\ntext = \"\"\naction = \"\"\n\
        [[derived]]\nname = \"sum\"\nmaximum = [\"p1\"]\nregisters = [{ address = 105, type = \"f32\" }]\n";
    let by_hand = format!("# above\n{by_hand}{own}");
    // A value more in front of the others; one that was there is gone.
    let changed = device(&[(9, "Flow", 4, 32), (1, "Pressure", 3, 16), (7, "Pressure", 3, 16)]);
    let second = imported(&eds(&changed), Some(&by_hand));
    assert!(second.text.starts_with("# above\n# >>> cangate import") && second.text.ends_with(own));
    let pressure = tag(&second.text, "0x6401:1");
    assert_eq!((pressure["name"].as_str(), pressure["unit"].as_str()), (Some("p1"), Some("bar")));
    assert!(second.text.contains("# the old one\nname = \"p1\"\nscale = { multiply = 0.1 }"));
    assert!(second.text.contains("unit = \"bar\" # as on the label"));
    assert!(second.text.contains("mapping = \"adopt\"\ntimeout_ms = 5000"));
    assert!(second.text.contains("maps = [\"0x6401:9/32\", \"0x6401:1/16\", \"0x6401:7/16\"]"));
    assert_eq!(address(&second.text, "0x6401:1"), 100);
    // 102 and 103 were given away once, and 105 and 106 are taken by hand.
    assert_eq!((address(&second.text, "0x6401:9"), address(&second.text, "0x6401:7")), (108, 104));
    assert_eq!(messages(&second), ["the device no longer has 0x6401:2: tag `input_level` is gone"]);
    assert_eq!(imported(&eds(&changed), Some(&second.text)).text, second.text, "nothing moves any more");
    // It comes back: with a new address, because others may have learned that 102 is nothing.
    let back = imported(&eds(&device(&[(1, "Pressure", 3, 16), (2, "Level", 4, 32)])), Some(&second.text));
    assert_eq!(address(&back.text, "0x6401:2"), 110);
}

#[test]
fn a_tpdo_that_waits_for_a_sync_is_told() {
    let text = device(&[(1, "A", 3, 16)]) + "[1800sub2]\nDataType=5\nAccessType=rw\nDefaultValue=";
    let told = |number: &str| messages(&imported(&eds(&(text.clone() + number)), None)).concat();
    assert_eq!(told("1"), "TPDO 1 is sent after a SYNC only");
    assert_eq!(told("240"), told("0"));
    assert_eq!((told("254"), told("255")), (String::new(), String::new()));
    let first = imported(&eds(&(text.clone() + "1")), None).text;
    let by_hand =
        first.replace("transmission_type = 1", "transmission_type = 255").replace("\"verify\"", "\"write\"");
    let second = imported(&eds(&(text.clone() + "1")), Some(&by_hand));
    assert_eq!((second.text.as_str(), messages(&second)), (by_hand.as_str(), Vec::new()));
}

#[test]
fn every_tag_that_is_gone_is_told() {
    let first = imported(&eds(&device(&[(1, "A 1", 3, 16), (2, "A 2", 3, 16), (3, "B", 3, 16)])), None);
    let second = imported(&eds(&device(&[(3, "B", 3, 16)])), Some(&first.text));
    assert_eq!(
        messages(&second),
        [
            "the device no longer has 0x6401:1: tag `input_a_1` is gone",
            "the device no longer has 0x6401:2: tag `input_a_2` is gone"
        ]
    );
}

#[test]
fn an_object_of_another_width_gets_a_new_address_and_of_another_kind_is_told() {
    let first = imported(&eds(&device(&[(1, "A", 3, 16), (2, "B", 6, 16), (3, "C", 3, 16)])), None);
    let changed = device(&[(1, "A", 4, 32), (2, "B", 3, 16), (3, "C", 1, 1)]);
    let second = imported(&eds(&changed), Some(&first.text));
    assert_eq!(
        messages(&second),
        [
            "0x6401:1 is now i32 instead of i16: tag `input_a` gets a new address",
            "tag `input_b` keeps its type u16, though the file says i16 for 0x6401:2",
            "0x6401:3 is now bool instead of i16: tag `input_c` gets a new address",
        ]
    );
    let tag_of = |object| tag(&second.text, object);
    assert_eq!((tag_of("0x6401:1")["type"].as_str(), address(&second.text, "0x6401:1")), (Some("i32"), 104));
    assert_eq!(tag_of("0x6401:1")["registers"][0]["type"].as_str(), Some("i32"));
    assert_eq!((tag_of("0x6401:2")["type"].as_str(), address(&second.text, "0x6401:2")), (Some("u16"), 101));
    assert_eq!(tag_of("0x6401:3")["bit_address"].as_integer(), Some(0));
    assert!(tag_of("0x6401:3").get("registers").is_none());
}

#[test]
fn an_object_that_no_tpdo_carries_any_more_is_polled_until_one_does() {
    let both = device(&[(1, "A", 3, 16), (2, "B", 3, 16)]);
    let one = both.replace(
        "[1A00sub0]\nDataType=5\nAccessType=rw\nDefaultValue=2",
        "[1A00sub0]\nDataType=5\nDefaultValue=1",
    );
    let first = imported(&eds(&both), None);
    let second = imported(&eds(&one), Some(&first.text));
    assert_eq!(
        messages(&second),
        ["no TPDO carries 0x6401:2 any more: tag `input_b` is asked for once a minute"]
    );
    assert_eq!(tag(&second.text, "0x6401:2")["poll_ms"].as_integer(), Some(60_000));
    assert_eq!(imported(&eds(&both), Some(&second.text)).text, first.text);
}

#[test]
fn a_tpdo_that_is_written_by_hand_counts_unless_a_dcf_says_otherwise() {
    let text =
        device(&[(1, "A", 3, 16)]) + "[6401sub2]\nParameterName=B\nDataType=3\nAccessType=ro\nPDOMapping=1\n";
    let first = imported(&eds(&text), None).text;
    assert_eq!(tag(&first, "0x6401:2")["poll_ms"].as_integer(), Some(60_000));
    let by_hand = first
        .replace("maps = [\"0x6401:1/16\"]", "maps = [\"0x6401:2/16\"]")
        .replace("mapping = \"verify\"", "mapping = \"write\"");
    let second = imported(&eds(&text), Some(&by_hand)).text;
    assert!(second.contains("maps = [\"0x6401:2/16\"]"));
    assert!(tag(&second, "0x6401:2").get("poll_ms").is_none());
    let dcf = text.replace("DefaultValue=0x64010110", "DefaultValue=0x64010110\nParameterValue=0x64010310");
    assert!(imported(&eds(&dcf), Some(&second)).text.contains("maps = [\"0x6401:3/16\"]"));
}

#[test]
fn what_stands_outside_the_lines_of_import_is_not_made_again() {
    let text = device(&[(1, "A", 3, 16), (2, "B", 3, 16)])
        + "[2000]\nParameterName=s\nDataType=5\nAccessType=rw\nDefaultValue=1\nParameterValue=2\n[1017]\nDataType=6\nAccessType=rw\n";
    let first = imported(&eds(&text), None).text;
    let (block, _) = first.split_once("[error_control]").unwrap();
    let own = "[error_control]\nkind = \"none\"\n[tpdo.1]\ncob_id = \"0x181\"\nmaps = [\"0x6401:1/16\"]\n\
        [[tag]]\nname = \"input_b\"\nobject = \"0x6401:1\"\ntype = \"i16\"\nregisters = [{ address = 100, type = \"i16\" }]\n\
        [[setup]]\nobject = \"0x2000:0\"\ntype = \"u8\"\nvalue = 9\n";
    let before = format!("{block}\n# <<< cangate import\n{own}");
    let second = imported(&eds(&text), Some(&before)).text;
    assert!(second.ends_with(own));
    assert_eq!(second.matches("[error_control]").count(), 1);
    assert_eq!(second.matches("[tpdo.1]").count(), 1);
    assert_eq!(second.matches("[[setup]]").count(), 1);
    assert_eq!(tag(&second, "0x6401:1")["name"].as_str(), Some("input_b"));
    assert_eq!(imported(&eds(&text), Some(&second)).text, second);
}

#[test]
fn tables_of_ones_own_between_the_lines_stay_too() {
    let text = device(&[(1, "A", 3, 16)]);
    let first = imported(&eds(&text), None).text;
    let own = "# mine\n[publish]\nmin_interval_ms = 100\n\n[[alarm]]\nname = \"x\"\nsuppressed_by = [\n  \"y\",\n]\n\n# <<<";
    let by_hand = first.replace("# <<<", own);
    assert_eq!(imported(&eds(&text), Some(&by_hand)).text, by_hand);
}

#[test]
fn a_setting_that_changes_is_told() {
    let dcf = |value: &str| {
        device(&[(1, "A", 3, 16)])
            + "[2000]\nParameterName=s\nDataType=5\nAccessType=rw\nDefaultValue=1\nParameterValue="
            + value
    };
    let first = imported(&eds(&dcf("2")), None);
    assert_eq!(first.settings, 1);
    let second = imported(&eds(&dcf("0x1F")), Some(&first.text));
    assert_eq!(messages(&second), ["0x2000:0 was set to 2, now to 31"]);
    assert_eq!(
        messages(&imported(&eds(&dcf("1")), Some(&first.text))),
        ["0x2000:0 was set to 2, now to nothing"]
    );
}

#[test]
fn a_mapping_that_import_did_not_write_or_that_would_break_is_left_alone() {
    let eds = eds(&device(&[(1, "A", 3, 16)]));
    let refused = |text: String| shown(&import(&eds, Some(&SourceText::new("m.toml", text))).unwrap_err());
    assert!(
        refused("format = 1\n".to_owned())
            .contains("m.toml:1:1: error: this mapping was not written by import")
    );
    let text = imported(&eds, None).text;
    assert!(refused(format!("{text}[device]\n")).starts_with("m.toml:"), "two [device]");
    assert!(refused(text.replace("[tpdo.1]", "[tpdo.1")).contains("error"));
    let (head, rest) = text.split_once("[device]").unwrap();
    let broken =
        format!("{head}[[tag]]\nname = \"x\"\nobject = \"0x6401:1\"\n# <<< cangate import\n[device]{rest}");
    assert!(refused(broken).contains("cannot be updated"));
}

#[test]
fn r_esd_122_bits_leave_room_for_the_alarms_and_wide_numbers_stand_in_no_register() {
    let of = |index: u32| format!("[{index:X}]\nParameterName=b\nDataType=1\nAccessType=ro\nPDOMapping=1\n");
    let text = (0x2000..0x203C_u32).map(of).collect::<Vec<_>>().concat();
    let before = imported(&eds(&text), None).text.replace("bits_used = 60", "bits_used = 100");
    let text = text.replace("[20", "[21") + &text;
    let second = imported(&eds(&text), Some(&before));
    let bits = |object: &str| tag(&second.text, object)["bit_address"].as_integer().unwrap();
    assert_eq!((bits("0x203B:0"), bits("0x2100:0")), (59, 100));
    assert_eq!(second.tags, 64, "no more are polled unasked");
    assert!(messages(&second)[0].contains("120 more objects"), "{:?}", messages(&second));
    let near =
        imported(&eds("[2000]\nParameterName=b\nDataType=3\nAccessType=ro\nPDOMapping=1\n"), None).text;
    let near = near.replace("bits_used = 0", "bits_used = 127");
    let two: String = text.split_inclusive("PDOMapping=1\n").skip(1).take(2).collect();
    let third = imported(&eds(&two), Some(&near));
    assert_eq!(tag(&third.text, "0x2101:0")["bit_address"].as_integer(), Some(127));
    assert_eq!(tag(&third.text, "0x2102:0")["bit_address"].as_integer(), Some(192));
    let wide = imported(&eds("[2000]\nParameterName=n\nDataType=0x1B\nAccessType=ro\nPDOMapping=1\n"), None);
    assert!(tag(&wide.text, "0x2000:0").get("registers").is_none());
    let double =
        imported(&eds("[2000]\nParameterName=n\nDataType=0x11\nAccessType=ro\nPDOMapping=1\n"), None);
    assert_eq!(tag(&double.text, "0x2000:0")["registers"][0]["type"].as_str(), Some("f32"));
    assert_eq!(messages(&double), ["`n` has 64 bits, in the registers it is rounded to 32"]);
}

#[test]
fn r_esd_128_the_heartbeat_is_what_the_device_can() {
    let control = |text: &str| {
        let table: toml::Table = imported(&eds(text), None).text.parse().unwrap();
        table["error_control"].to_string()
    };
    assert_eq!(
        control(
            "[1017]\nDataType=6\nAccessType=rw\nDefaultValue=0\n[100C]\nDataType=6\n[100D]\nDataType=5\n"
        ),
        "{ heartbeat_ms = 1000, heartbeat_timeout_ms = 2500, kind = \"heartbeat\" }"
    );
    assert_eq!(
        control("[1017]\nDataType=6\nAccessType=const\nDefaultValue=100\n"),
        "{ heartbeat_ms = 100, heartbeat_timeout_ms = 500, kind = \"heartbeat\" }"
    );
    assert_eq!(
        control(
            "[1017]\nDataType=6\nAccessType=ro\nDefaultValue=0\n[100C]\nDataType=6\nDefaultValue=100\n[100D]\nDataType=5\nDefaultValue=0\n"
        ),
        "{ guard_time_ms = 100, kind = \"guarding\" }"
    );
    assert_eq!(control("[1000]\nDataType=7\n"), "{ kind = \"none\" }");
}

#[test]
fn a_file_that_grows_without_end_is_refused() {
    let objects = (0..300_u32)
        .map(|number| format!("[{:X}]\nParameterName=x\nDataType=5\nCompactSubObj=254\n", 0x2000 + number))
        .collect::<Vec<_>>()
        .concat();
    let problems = read("big.eds", objects.as_bytes()).unwrap_err();
    assert!(shown(&problems).contains("more than 65536 objects"), "{}", shown(&problems));
    // Wrong in every line: told a limited number of times.
    let (_, warnings) =
        read("wrong.eds", ("[1000]\nDataType=7\n".repeat(100_000) + &"x\n".repeat(100_000)).as_bytes())
            .unwrap();
    assert_eq!(warnings.len(), 201);
    assert_eq!(warnings[200].message, "299798 more warnings");
}

/// One change of a file, at a place that is a fraction of its length.
#[derive(Clone, Debug)]
enum Change {
    Byte(u16, u8),
    Cut(u16, u8),
    Insert(u16, usize),
    Repeat(u16, u16, u8),
    End(u16),
}

/// What a maker, a tool or an editor might put anywhere.
const PIECES: &[&[u8]] = &[
    b"\r\n",
    b"\n[",
    b"]",
    b"=",
    b";",
    b"#",
    b"\0",
    b"\xFF",
    b"\xE2\x82",
    b"0x",
    b"$NODEID+",
    b"-1",
    b"08",
    b"18446744073709551615",
    b"\nDefaultValue=0xFFFFFFFF\n",
    b"\nDataType=1\n",
    b"\nObjectType=8\nCompactSubObj=254\n",
    b"\n[1A00sub0]\nDefaultValue=64\n",
    b"\n[1A00sub1]\nDefaultValue=0x60000801\n",
    b"\n[FFFFsubFF]\n",
    b"\n[0000]\n",
    b"\nParameterName=# >>> cangate import\n",
    b"\nParameterName=\"\"\"'''\\\n",
    b"\nPDOMapping=1\nAccessType=rw\n",
    b"\nParameterValue=0x80000000\n",
    b"\n[1018Value]\n1=2\n300=4\n",
    b"\n[DeviceComissioning]\nNodeID=127\n",
];

fn change() -> impl Strategy<Value = Change> {
    prop_oneof![
        4 => (any::<u16>(), any::<u8>()).prop_map(|(at, byte)| Change::Byte(at, byte)),
        2 => (any::<u16>(), any::<u8>()).prop_map(|(at, count)| Change::Cut(at, count)),
        6 => (any::<u16>(), 0..PIECES.len()).prop_map(|(at, piece)| Change::Insert(at, piece)),
        2 => (any::<u16>(), any::<u16>(), any::<u8>()).prop_map(|(at, from, count)| Change::Repeat(at, from, count)),
        1 => any::<u16>().prop_map(Change::End),
    ]
}

fn apply(bytes: &mut Vec<u8>, change: &Change) {
    let place = |fraction: u16| usize::from(fraction) * bytes.len() / 65_536;
    match change {
        Change::Byte(at, byte) => {
            let at = place(*at);
            bytes.splice(at..(at + 1).min(bytes.len()), [*byte]);
        }
        Change::Cut(at, count) => {
            let at = place(*at);
            bytes.drain(at..(at + usize::from(*count)).min(bytes.len()));
        }
        Change::Insert(at, piece) => {
            let at = place(*at);
            bytes.splice(at..at, PIECES[*piece].iter().copied());
        }
        Change::Repeat(at, from, count) => {
            let (at, from) = (place(*at), place(*from));
            let piece = bytes[from..(from + 4 * usize::from(*count)).min(bytes.len())].to_vec();
            bytes.splice(at..at, piece);
        }
        Change::End(at) => bytes.truncate(place(*at)),
    }
}

/// Whatever is read: what comes out is whole, and stays as it is when it is imported again.
fn holds(bytes: &[u8]) -> Result<(), TestCaseError> {
    let Ok((eds, warnings)) = read("x.eds", bytes) else { return Ok(()) };
    prop_assert!(warnings.iter().all(|warning| warning.severity == Severity::Warning && warning.line > 0));
    let first = import(&eds, None);
    prop_assert!(first.is_ok(), "{first:?}");
    let first = first.unwrap();
    let file = first.text.parse::<toml::Table>();
    prop_assert!(file.is_ok(), "{:?}\n{}", file, first.text);
    let file = file.unwrap();
    let mut names = std::collections::BTreeSet::new();
    let mut taken = std::collections::BTreeSet::new();
    for tag in file.get("tag").and_then(toml::Value::as_array).into_iter().flatten() {
        let name = tag["name"].as_str().unwrap();
        prop_assert!(cangate::mapping::build::is_snake_case(name), "{name}");
        prop_assert!(names.insert(name.to_owned()), "two tags {name}");
        if let Some(registers) = tag.get("registers") {
            let address = registers[0]["address"].as_integer().unwrap();
            let width = if registers[0]["type"].as_str().unwrap().ends_with("16") { 1 } else { 2 };
            prop_assert!(address >= 100 && (width == 1 || address % 2 == 0));
            prop_assert!((address..address + width).all(|register| taken.insert(register)));
        }
    }
    prop_assert_eq!(names.len(), first.tags);
    let again = import(&eds, Some(&SourceText::new("x.toml", first.text.clone())));
    prop_assert_eq!(again.map(|again| again.text), Ok(first.text));
    Ok(())
}

#[test]
fn mutated_files_neither_panic_nor_hang_and_what_is_imported_is_whole() {
    let cases = std::env::var("CANGATE_EDS_CASES").ok().and_then(|cases| cases.parse().ok()).unwrap_or(400);
    let config = ProptestConfig { cases, failure_persistence: None, ..ProptestConfig::default() };
    let files = [IO_MODULE, TRANSMITTER, ODD];
    let strategy = (0..files.len(), proptest::collection::vec(change(), 1..12));
    let outcome = TestRunner::new(config).run(&strategy, |(file, changes)| {
        let mut bytes = files[file].to_vec();
        for change in &changes {
            apply(&mut bytes, change);
        }
        holds(&bytes)
    });
    outcome.unwrap();
}

#[test]
fn any_bytes_at_all_are_read_or_refused() {
    let config = ProptestConfig { cases: 200, failure_persistence: None, ..ProptestConfig::default() };
    let strategy = proptest::collection::vec(any::<u8>(), 0..2000);
    TestRunner::new(config).run(&strategy, |bytes| holds(&bytes)).unwrap();
}

#[test]
fn objects_are_found_by_index_and_sub_index() {
    let (eds, _) = read("transmitter.dcf", TRANSMITTER).unwrap();
    let pressure = &eds.objects[&ObjectId::new(0x9130, 1)];
    assert_eq!(pressure.name, "pressure");
    assert_eq!(ObjectId::new(0x9130, 10).to_string(), "0x9130:10");
}

#[test]
fn every_import_is_a_mapping_that_checks() {
    // The odd one asks for a TPDO on an identifier of node guarding, which no import can make right.
    for file in [IO_MODULE, TRANSMITTER] {
        let (eds, _) = read("device.eds", file).unwrap();
        let text = imported(&eds, None).text;
        let checked = cangate::mapping::check_mapping(&SourceText::new("device.toml", text.as_str()));
        let errors = checked.err().unwrap_or_default();
        assert!(errors.is_empty(), "{}\n{text}", shown(&errors));
    }
}
