//! What the configuration of an esd CAN-CBM-PLC/331 offers, done as a user does it: EDS files to mappings, devices one after the
//! other in one unit id, names, maps and DCFs. `plc331_master` has what it does on the bus.

use std::path::Path;
use std::process::{Command, Output, Stdio};

use cangate::cli::check::check;
use cangate::config;
use cangate::mapping::eds::{Commissioning, Eds, ObjectId, configured, dcf, import, read};
use cangate::mapping::installation::{NodeEntry, Offset};
use cangate::mapping::{At, Sketch, SourceText, check_mapping};
use cangate::modbus::{MapFormat, ModbusSettings, RegisterMap, map_text};

use super::support::conversation::Conversation;

/// A folder with EDS files, mappings and a configuration.
struct Plant {
    folder: tempfile::TempDir,
}

/// The nodes of the configuration, as `name id mapping offset`.
type Nodes<'a> = &'a [(&'a str, u8, &'a str, &'a str)];

impl Plant {
    /// Three devices: `a` has inputs of 4 x 8 bits, `b` of 2 x 16, `c` of 8 x 8.
    fn new() -> Self {
        let plant = Self { folder: tempfile::tempdir().unwrap() };
        std::fs::create_dir(plant.path("eds")).unwrap();
        for (name, product, count, bits) in [("a", 1, 4, 8), ("b", 2, 2, 16), ("c", 3, 8, 8)] {
            std::fs::write(plant.path(&format!("eds/{name}.eds")), eds(name, product, count, bits)).unwrap();
            plant.run(&["import", &format!("eds/{name}.eds"), "-o", &format!("{name}.toml")]);
        }
        plant
    }

    fn path(&self, name: &str) -> std::path::PathBuf {
        self.folder.path().join(name)
    }

    fn start(&self, arguments: &[&str]) -> Output {
        let mut command = Command::new(env!("CARGO_BIN_EXE_cangate"));
        command.env_remove("CANGATE_LOG").stdin(Stdio::null()).current_dir(self.folder.path());
        command.args(arguments).output().unwrap()
    }

    /// Runs the program, which must be content, and gives its standard output.
    #[track_caller]
    fn run(&self, arguments: &[&str]) -> String {
        let output = self.start(arguments);
        let said = String::from_utf8_lossy(&output.stderr);
        assert_eq!(output.status.code(), Some(0), "{arguments:?}: {said}");
        String::from_utf8(output.stdout).unwrap()
    }

    /// Writes a configuration in which all nodes have unit id 1, with their `offset` as it is written.
    fn configure(&self, nodes: Nodes<'_>) {
        let node = |(name, id, mapping, offset): &(&str, u8, &str, &str)| {
            format!(
                "[node.{name}]\nbus = \"can0\"\nid = {id}\nmapping = \"{mapping}.toml\"\nunit_id = 1\n{offset}\n"
            )
        };
        let nodes: Vec<String> = nodes.iter().map(node).collect();
        let text = format!("version = 1\n[bus.can0]\ninterface = \"can0\"\n{}", nodes.concat());
        std::fs::write(self.path("cangate.toml"), text).unwrap();
    }

    /// The map of the configuration, kept as `name`.
    fn map(&self, name: &str) -> serde_json::Value {
        self.run(&["map", "-c", "cangate.toml", "--format", "json", "-o", name]);
        serde_json::from_str(&std::fs::read_to_string(self.path(name)).unwrap()).unwrap()
    }
}

/// The addresses of all values that a node's TPDOs carry, in the order of the map.
fn inputs(map: &serde_json::Value, node: &str) -> Vec<u64> {
    let points = map["points"].as_array().unwrap().iter();
    points
        .filter(|point| point["node"] == node && point["source"].as_str().unwrap().starts_with("TPDO"))
        .map(|point| point["address"].as_u64().unwrap())
        .collect()
}

/// An EDS of one TPDO with `count` inputs of so many bits, as an older tool writes it: CR LF, ISO 8859-1.
fn eds(name: &str, product: u32, count: u8, bits: u8) -> Vec<u8> {
    let data_type = if bits == 8 { 5 } else { 3 };
    let section = |title: &str, name: &str, keys: &str| {
        format!("[{title}]\r\nParameterName={name}\r\n{}\r\n\r\n", keys.replace(' ', "\r\n"))
    };
    let variable = |title: &str, name: &str, data_type: u8, access: &str, default: &str| {
        let keys = format!(
            "ObjectType=7 DataType=0x{data_type:04X} AccessType={access} DefaultValue={default} PDOMapping=0"
        );
        section(title, name, &keys)
    };
    let mut parts = vec![
        format!(
            "[FileInfo]\r\nFileName={name}.eds\r\nFileVersion=1\r\n\r\n[DeviceInfo]\r\nVendorName=Schr\u{F6}der\r\nVendorNumber=0x17\r\n\
             ProductName=Input {name}\r\nProductNumber={product}\r\n\r\n; objects\r\n"
        ),
        variable("1000", "Device Type", 7, "ro", "0x00030191"),
        section("1018", "Identity", "ObjectType=9 SubNumber=3"),
        variable("1018sub0", "Number", 5, "ro", "2"),
        variable("1018sub1", "Vendor", 7, "ro", "0x17"),
        variable("1018sub2", "Product", 7, "ro", &product.to_string()),
        variable("1017", "Heartbeat", 6, "rw", "0"),
        section("1800", "TPDO", "ObjectType=9 SubNumber=5"),
        variable("1800sub0", "Number", 5, "ro", "5"),
        variable("1800sub1", "COB-ID", 7, "rw", "$NODEID+0x180"),
        variable("1800sub2", "Type", 5, "rw", "255"),
        variable("1800sub3", "Inhibit", 6, "rw", "0"),
        variable("1800sub5", "Timer", 6, "rw", "100"),
        // Compact: its sub-indices have no sections of their own.
        "[1A00]\r\nParameterName=Mapping\r\nObjectType=9\r\nDataType=7\r\nAccessType=rw\r\nDefaultValue=0\r\nCompactSubObj=8\r\n\r\n[1A00Value]\r\n"
            .to_owned(),
        format!("NrOfEntries={}\r\n0={count}\r\n", u16::from(count) + 1),
    ];
    parts.extend((1..=count).map(|sub| format!("{sub}=0x6401{sub:02X}{bits:02X}\r\n")));
    parts.push("\r\n".to_owned());
    parts.push(section("6401", "Input", "ObjectType=8 SubNumber=9"));
    parts.push(variable("6401sub0", "Number", 5, "ro", &count.to_string()));
    for sub in 1..=count {
        parts.push(variable(&format!("6401sub{sub}"), &format!("{name} {sub}"), data_type, "ro", "0"));
    }
    parts.push(variable("6423", "Offset", 3, "rw", "0"));
    parts.push(variable("6424", "Factor", 8, "rw", "1"));
    parts.concat().chars().map(|letter| u8::try_from(u32::from(letter)).unwrap()).collect()
}

const AUTO: &str = "offset = \"auto\"";

#[test]
fn r_esd_110_the_devices_of_a_folder_of_eds_files_are_listed_with_vendor_product_and_file() {
    let plant = Plant::new();
    let list = plant.run(&["import", "--list", "eds"]);
    let lines: Vec<&str> = list.lines().collect();
    assert_eq!(
        lines,
        [
            "File   Vendor    Product  Vendor id  Product code  Node",
            "a.eds  Schröder  Input a  0x17       0x1           -",
            "b.eds  Schröder  Input b  0x17       0x2           -",
            "c.eds  Schröder  Input c  0x17       0x3           -",
        ]
    );
    // What is no EDS is told, and the others are listed all the same.
    std::fs::write(plant.path("eds/broken.EDS"), "nothing").unwrap();
    let output = plant.start(&["import", "--list", "eds"]);
    assert_eq!(output.status.code(), Some(78));
    assert!(String::from_utf8(output.stderr).unwrap().contains("eds/broken.EDS"));
    assert_eq!(String::from_utf8(output.stdout).unwrap(), list);
    assert_eq!(plant.start(&["import", "--list", "nowhere"]).status.code(), Some(74));
}

#[test]
fn r_esd_111_a_device_without_an_eds_is_described_by_number_and_size_of_its_pdos() {
    let mapping = r#"
        format = 1
        device = { vendor = "unknown", model = "two TPDOs of 8 bytes" }
        error_control = { kind = "none" }
        tpdo.1 = { cob_id = "$NODEID+0x180", length = 8, timeout_ms = 0 }
        tpdo.2 = { cob_id = "$NODEID+0x280", length = 8, timeout_ms = 0 }
        [[tag]]
        name = "tpdo1_byte_{}"
        array = { first = 0, count = 8 }
        tpdo = 1
        bit = 0
        type = "u8"
        registers = [{ address = 100, type = "u16" }]
        [[tag]]
        name = "tpdo2_byte_{}"
        array = { first = 0, count = 8 }
        tpdo = 2
        bit = 0
        type = "u8"
        registers = [{ address = 108, type = "u16" }]
    "#;
    let source = SourceText::new("generic", mapping);
    assert!(check_mapping(&source).is_ok());
    let sketch = Sketch::new().mapping(source).node("box", 9, "generic", |_| ());
    let mut conversation = Conversation::new(sketch.build().unwrap().0);
    conversation.frame("709#00");
    conversation.run_to(1000);
    conversation.frame("289#0102030405060708");
    assert_eq!(conversation.tag_text("tpdo2_byte_7"), "8 good");
}

#[test]
fn v_esd_12_r_esd_118_119_devices_stand_one_after_the_other_and_an_inserted_one_moves_those_behind_it() {
    let plant = Plant::new();
    // Names that do not sort as the configuration has them.
    plant.configure(&[("z_a", 1, "a", AUTO), ("b", 2, "b", AUTO)]);
    let old = plant.map("old.json");
    assert_eq!(inputs(&old, "z_a"), [100, 101, 102, 103], "four values of 8 bits, one register each");
    // The block of a node is as long as its bits: 192.
    assert_eq!(inputs(&old, "b"), [292, 293]);
    plant.configure(&[("z_a", 1, "a", AUTO), ("c", 3, "c", AUTO), ("b", 2, "b", AUTO)]);
    let new = plant.map("new.json");
    assert_eq!(inputs(&new, "z_a"), inputs(&old, "z_a"));
    assert_eq!(inputs(&new, "c"), [292, 293, 294, 295, 296, 297, 298, 299]);
    assert_eq!(inputs(&new, "b"), [292 + 192, 293 + 192]);
    // Every address that moved is told before the map is used; what did not, is not.
    let diff = plant.start(&["map", "diff", "old.json", "new.json"]);
    let told = String::from_utf8(diff.stdout).unwrap();
    assert_eq!(diff.status.code(), Some(1));
    for tag in ["input_b_1", "input_b_2", "node.status"] {
        assert!(told.contains(&format!("b/{tag}")), "{tag}: {told}");
    }
    assert!(!told.contains("z_a/"), "{told}");
}

#[test]
fn v_esd_12_r_esd_121_a_pinned_device_stays_and_others_go_round_it() {
    let plant = Plant::new();
    plant.configure(&[("a", 1, "a", AUTO), ("b", 2, "b", "offset = 192")]);
    let old = plant.map("old.json");
    plant.configure(&[("a", 1, "a", AUTO), ("c", 3, "c", AUTO), ("b", 2, "b", "offset = 192")]);
    let new = plant.map("new.json");
    assert_eq!((inputs(&new, "a"), inputs(&new, "b")), (inputs(&old, "a"), inputs(&old, "b")));
    assert_eq!(inputs(&new, "c")[0], 484);
    let diff = plant.run(&["map", "diff", "old.json", "new.json"]);
    assert!(diff.lines().all(|line| line.starts_with("added: c/")), "{diff}");
    // Two that are pinned to one place are refused, both named.
    plant.configure(&[("a", 1, "a", "offset = 100"), ("b", 2, "b", "offset = 101")]);
    let output = plant.start(&["check", "cangate.toml"]);
    assert_eq!(output.status.code(), Some(78));
    let said = String::from_utf8(output.stderr).unwrap();
    assert!(said.contains("nodes `a` and `b` share unit id 1 and addresses"), "{said}");
    // A value can be pinned too: import keeps its address.
    let mapping =
        std::fs::read_to_string(plant.path("b.toml")).unwrap().replace("address = 101", "address = 155");
    std::fs::write(plant.path("b.toml"), mapping).unwrap();
    plant.run(&["import", "eds/b.eds", "-o", "b.toml"]);
    plant.configure(&[("b", 2, "b", AUTO)]);
    assert_eq!(inputs(&plant.map("pinned.json"), "b"), [100, 155]);
}

#[test]
fn r_esd_118_what_cannot_be_placed_or_read_is_told() {
    let plant = Plant::new();
    plant.configure(&[("a", 1, "a", "offset = \"behind\"")]);
    let said = String::from_utf8(plant.start(&["check", "cangate.toml"]).stderr).unwrap();
    assert!(said.contains("cangate.toml:9:10: error") && said.contains("\"auto\""), "{said}");
    plant.configure(&[("a", 1, "a", "offset = -1")]);
    assert_eq!(plant.start(&["check", "cangate.toml"]).status.code(), Some(78));
    // Two pinned ones leave no room.
    plant.configure(&[
        ("a", 1, "a", "offset = 100"),
        ("b", 2, "b", "offset = 65300"),
        ("c", 3, "c", "offset = \"auto\""),
    ]);
    assert_eq!(inputs(&plant.map("map.json"), "c")[0], 100 + 292, "there is room between them");
    let long =
        std::fs::read_to_string(plant.path("a.toml")).unwrap().replace("address = 103", "address = 60000");
    std::fs::write(plant.path("a.toml"), long).unwrap();
    plant.configure(&[
        ("a", 1, "a", ""),
        ("c", 3, "c", "offset = \"auto\""),
        ("d", 4, "a", "offset = \"auto\""),
    ]);
    let said = String::from_utf8(plant.start(&["check", "cangate.toml"]).stderr).unwrap();
    assert!(said.contains("there is no room for node `d` in unit id 1"), "{said}");
    assert!(!said.contains("share unit id"), "{said}");
}

#[test]
fn r_esd_120_users_of_names_see_nothing_of_an_address_that_moved() {
    let plant = Plant::new();
    plant.configure(&[("a", 1, "a", AUTO), ("b", 2, "b", AUTO)]);
    let old = plant.map("old.json");
    plant.configure(&[("c", 3, "c", AUTO), ("a", 1, "a", AUTO), ("b", 2, "b", AUTO)]);
    let new = plant.map("new.json");
    let names = |map: &serde_json::Value, node: &str| -> Vec<String> {
        let points = map["points"].as_array().unwrap().iter().filter(|point| point["node"] == node);
        points.map(|point| format!("{} {} {}", point["tag"], point["topic"], point["type"])).collect()
    };
    for node in ["a", "b"] {
        assert_eq!(names(&old, node), names(&new, node));
        assert_ne!(inputs(&old, node), inputs(&new, node));
    }
    assert!(names(&new, "b").contains(&"\"input_b_1\" \"cangate/cangate/b/state\" \"i16\"".to_owned()));
    // And the map is there with names and addresses, for people and for a PLC's project.
    let csv = plant.run(&["map", "-c", "cangate.toml", "--format", "csv"]);
    assert!(
        csv.lines()
            .any(|line| line.starts_with("1,input_register,484,485,") && line.contains(",b,input_b_1,")),
        "{csv}"
    );
    assert!(plant.run(&["map", "-c", "cangate.toml", "--format", "st"]).contains("484"));
}

#[test]
fn r_esd_122_values_follow_each_other_without_gaps_and_the_same_input_gives_the_same_map() {
    let plant = Plant::new();
    plant.configure(&[("a", 1, "a", AUTO), ("b", 2, "b", AUTO), ("c", 3, "c", AUTO)]);
    let map = plant.map("map.json");
    let all: Vec<u64> = ["a", "b", "c"].iter().flat_map(|node| inputs(&map, node)).collect();
    assert_eq!(all, [100, 101, 102, 103, 292, 293, 484, 485, 486, 487, 488, 489, 490, 491]);
    assert_eq!(map, plant.map("again.json"));
    // Where nodes have more registers than bits, the next one begins right behind the last.
    let wide =
        std::fs::read_to_string(plant.path("a.toml")).unwrap().replace("address = 103", "address = 299");
    std::fs::write(plant.path("a.toml"), wide).unwrap();
    assert_eq!(inputs(&plant.map("wide.json"), "b")[0], 300 + 100);
}

#[test]
fn r_esd_123_124_addresses_and_names_are_enough_and_the_identifier_is_shown_to_who_asks() {
    let plant = Plant::new();
    plant.configure(&[("a", 6, "a", "")]);
    let csv = plant.run(&["map", "-c", "cangate.toml", "--format", "csv"]);
    let column = csv.lines().next().unwrap().split(',').position(|name| name == "cob_id").unwrap();
    let row = csv.lines().find(|line| line.contains(",input_a_1,")).unwrap();
    assert_eq!(row.split(',').nth(column), Some("0x186"));
    let status = csv.lines().find(|line| line.contains(",node.nmt_state,")).unwrap();
    assert!(status.ends_with(','), "what no PDO carries has none: {status}");
    for point in plant.map("map.json")["points"].as_array().unwrap() {
        let place = [&point["node"], &point["tag"], &point["topic"], &point["table"]];
        assert!(place.iter().all(|text| !text.as_str().unwrap().contains("186")), "{point}");
    }
}

/// An EDS or DCF as import reads it; nothing about it may be odd.
#[track_caller]
fn dictionary(bytes: &[u8]) -> Eds {
    let (eds, warnings) = read("written.dcf", bytes).unwrap();
    assert!(warnings.is_empty(), "{warnings:?}");
    eds
}

fn value(eds: &Eds, index: u16, sub: u8) -> Option<String> {
    eds.objects[&ObjectId::new(index, sub)].parameter_value.as_ref().map(|value| value.text.clone())
}

#[test]
fn r_esd_125_the_dcf_of_a_node_is_its_eds_with_what_it_is_set_to() {
    let plant = Plant::new();
    // By hand: other content of the TPDO, a heartbeat and two settings.
    let text = std::fs::read_to_string(plant.path("b.toml")).unwrap();
    let text = text.replace("mapping = \"verify\"", "mapping = \"write\"")
        + "\n[[setup]]\nobject = \"0x6423:0\"\ntype = \"i16\"\nvalue = -7\n[[setup]]\nobject = \"0x6424:0\"\ntype = \"f32\"\nvalue = 2.5\n";
    std::fs::write(plant.path("b.toml"), text).unwrap();
    plant.configure(&[
        ("tank", 2, "b", "offset = \"auto\"\nheartbeat_ms = 400\ntpdo.1.transmission_type = 254\ntpdo.1.event_timer_ms = 250"),
        ("other", 1, "a", AUTO),
    ]);
    plant.run(&["dcf", "-c", "cangate.toml", "--eds", "eds", "-o", "."]);
    let bytes = std::fs::read(plant.path("tank.dcf")).unwrap();
    let dcf = dictionary(&bytes);
    assert_eq!((dcf.node_id, dcf.bit_rate), (Some(2), Some(125_000)));
    for (index, sub, expected) in [
        (0x1017, 0, "0x0190"),
        (0x1800, 2, "0xFE"),
        (0x1800, 5, "0x00FA"),
        (0x1A00, 0, "0x02"),
        (0x1A00, 1, "0x64010110"),
        (0x1A00, 2, "0x64010210"),
        (0x6423, 0, "-7"),
        (0x6424, 0, "2.5"),
    ] {
        assert_eq!(value(&dcf, index, sub).as_deref(), Some(expected), "{index:04X}:{sub}");
    }
    assert_eq!(
        (value(&dcf, 0x1000, 0), value(&dcf, 0x1018, 1)),
        (None, None),
        "what is not set stays without"
    );
    assert_eq!(dcf.device.vendor_name, "Schröder");
    // All that stood in the EDS stands there still, in its own character set and line ends.
    let lines =
        |bytes: &[u8]| -> Vec<Vec<u8>> { bytes.split(|byte| *byte == b'\n').map(<[u8]>::to_vec).collect() };
    let written = lines(&bytes);
    assert!(written.iter().all(|line| line.is_empty() || line.ends_with(b"\r")));
    assert!(written.contains(&b"VendorName=Schr\xF6der\r".to_vec()));
    let old = eds("b", 2, 2, 16);
    let lost: Vec<String> = lines(&old)
        .iter()
        .filter(|line| !written.contains(line))
        .map(|line| String::from_utf8_lossy(line).trim().to_owned())
        .collect();
    assert_eq!(lost, ["FileName=b.eds", "0=2"]);
    // Spelled as the standard has it, which other readers insist on.
    let text: String = bytes.iter().map(|byte| char::from(*byte)).collect();
    for part in [
        "[DeviceComissioning]\r\nNodeID=2\r\nNodeName=tank\r\nBaudrate=125\r\n",
        "\r\nLastEDS=b.eds\r\n",
        "\r\nFileName=tank.dcf\r\n",
    ] {
        assert!(text.contains(part), "{part}");
    }
    // A DCF that lies beside the EDS files is listed with its node, and none is made from that of another node.
    let files = plant.run(&["import", "--list", "."]);
    assert!(files.lines().any(|line| line.starts_with("tank.dcf") && line.ends_with(" 2")), "{files}");
    std::fs::copy(plant.path("tank.dcf"), plant.path("eds/0.dcf")).unwrap();
    let said = plant.start(&["dcf", "-c", "cangate.toml", "--eds", "eds", "-o", ".", "tank"]).stderr;
    assert!(String::from_utf8(said).unwrap().contains("from eds/b.eds"));
    // Imported again, it is the same device with the same settings, and its own DCF is the same file.
    plant.run(&["import", "tank.dcf", "-o", "again.toml"]);
    let again = std::fs::read_to_string(plant.path("again.toml")).unwrap();
    for part in
        ["event_timer_ms = 250", "transmission_type = 254", "value = -7", "value = 2.5", "heartbeat_ms = 400"]
    {
        assert!(again.contains(part), "{part}: {again}");
    }
    std::fs::create_dir(plant.path("second")).unwrap();
    plant.run(&["dcf", "-c", "cangate.toml", "--eds", "tank.dcf", "-o", "second", "tank"]);
    let second = std::fs::read(plant.path("second/tank.dcf")).unwrap();
    let second: String = second.iter().map(|byte| char::from(*byte)).collect();
    assert_eq!(second.replace("LastEDS=tank.dcf", "LastEDS=b.eds"), text);
}

#[test]
fn r_esd_125_a_dcf_of_any_eds_reads_back_as_what_was_written() {
    for (name, bytes) in [
        ("io_module.eds", &include_bytes!("fixtures/eds/io_module.eds")[..]),
        ("transmitter.dcf", include_bytes!("fixtures/eds/transmitter.dcf")),
        ("odd.eds", include_bytes!("fixtures/eds/odd.eds")),
    ] {
        let one_kind_of_line_end = |end: &[u8]| -> Vec<u8> {
            let lines: Vec<&[u8]> = bytes.split(|byte| *byte == b'\n').collect();
            lines.iter().map(|line| line.strip_suffix(b"\r").unwrap_or(line)).collect::<Vec<_>>().join(end)
        };
        for bytes in [bytes.to_vec(), one_kind_of_line_end(b"\r\n"), one_kind_of_line_end(b"\r")] {
            let (eds, _) = read(name, &bytes).unwrap();
            let mapping = import(&eds, None).unwrap().text.replace("\"verify\"", "\"write\"");
            // Its identifier is kept for others.
            let mapping = mapping.replace("0x711", "0x391");
            let settle = |node: &mut NodeEntry| node.pdo_timeout_ms = Some(At::nowhere(0));
            let sketch = Sketch::new().mapping(SourceText::new("own", mapping)).node("a", 9, "own", settle);
            let (table, _) = sketch.build().unwrap_or_else(|problems| panic!("{name}: {problems:#?}"));
            let settings = table.nodes[0].canopen().unwrap();
            let node = Commissioning { name: "a", network: "can0", bit_rate: 500_000, settings };
            let (written, _) = dcf(&eds, &bytes, "a.dcf", node).unwrap();
            let (again, _) = read("a.dcf", &written).unwrap();
            assert_eq!((again.node_id, again.bit_rate), (Some(9), Some(500_000)), "{name}");
            assert_eq!(again.objects.len(), eds.objects.len(), "{name}");
            let mut compared = 0;
            for (id, data) in configured(settings).iter().filter(|(id, _)| eds.objects.contains_key(id)) {
                let value =
                    again.objects[id].parameter_value.as_ref().unwrap_or_else(|| panic!("{name} {id}"));
                let Some(whole) = value.whole() else { continue };
                let bytes = whole.base.to_le_bytes();
                assert_eq!(&bytes[..data.len()], data.as_slice(), "{name} {id}");
                compared += 1;
            }
            assert!(compared > 2, "{name}: {compared}");
            for (id, object) in &eds.objects {
                let is_own = configured(settings).contains_key(id);
                assert!(
                    is_own
                        || again.objects[id].parameter_value.as_ref().map(|value| &value.text)
                            == object.parameter_value.as_ref().map(|value| &value.text),
                    "{name} {id}"
                );
            }
        }
    }
}

#[test]
fn r_esd_125_what_no_dcf_can_be_written_of_is_told() {
    let plant = Plant::new();
    plant.configure(&[("tank", 2, "b", "offset = 500\nheartbeat_ms = 400"), ("other", 1, "a", "")]);
    let code = |arguments: &[&str]| {
        let output = plant.start(&[&["dcf", "-c", "cangate.toml"], arguments].concat());
        (output.status.code(), String::from_utf8_lossy(&output.stderr).into_owned())
    };
    let (exit, said) = code(&["--eds", "eds"]);
    assert!(exit == Some(64) && said.contains("several nodes"), "{said}");
    let (exit, said) = code(&["--eds", "eds", "nobody"]);
    assert!(exit == Some(64) && said.contains("there is no node `nobody`"), "{said}");
    let (exit, said) = code(&["--eds", "eds/a.eds", "-o", "."]);
    assert!(
        exit == Some(78) && said.contains("no EDS is of the device of `tank` (Schröder Input b)"),
        "{said}"
    );
    assert!(plant.path("other.dcf").exists(), "the others are written");
    // A node and a file that are both named belong together; what the file does not have is told.
    let bare = "[1000]\nParameterName=Type\nDataType=7\nAccessType=ro\n";
    std::fs::write(plant.path("bare.eds"), bare).unwrap();
    let (exit, said) = code(&["--eds", "bare.eds", "tank", "-o", "."]);
    assert!(exit == Some(0) && said.contains("does not describe 0x1017:0"), "{said}");
    assert_eq!(dictionary(&std::fs::read(plant.path("tank.dcf")).unwrap()).node_id, Some(2));
    // What it is made from is never overwritten.
    let before = std::fs::read(plant.path("tank.dcf")).unwrap();
    let (exit, said) = code(&["--eds", "tank.dcf", "tank", "-o", "."]);
    assert!(exit == Some(74) && said.contains("is what it would be made from"), "{said}");
    assert_eq!(std::fs::read(plant.path("tank.dcf")).unwrap(), before);
}

#[test]
fn r_esd_126_gateway_and_devices_have_a_block_of_their_state_where_the_configuration_puts_it() {
    let sketch = Sketch::new().node("a", 6, "motortech-detcon", |node| {
        node.unit_id = Some(At::nowhere(9));
        node.offset = Some(At::nowhere(Offset::Fixed(1000)));
    });
    let settings = ModbusSettings { gateway_unit_id: 200, ..ModbusSettings::default() };
    let map = RegisterMap::build(&sketch.build().unwrap().0, &settings, "cangate").unwrap();
    let address = |unit_id: u8, tag: &str| {
        let found = map.points().iter().find(|point| point.unit_id == unit_id && point.tag == tag);
        found.unwrap_or_else(|| panic!("{tag}")).address
    };
    for (tag, place) in [
        ("node.status", 1),
        ("node.nmt_state", 2),
        ("node.active_alarms", 8),
        ("node.restarts", 12),
        ("node.guard_misses", 13),
        ("node.pdo_length_errors", 15),
        ("node.emcys", 17),
    ] {
        assert_eq!(address(9, tag), 1000 + place, "{tag}");
    }
    assert_eq!(address(9, "alarm.node_lost.active"), 1128);
    assert!(map.points().iter().any(|point| point.unit_id == 200 && point.tag == "bus.can0.bus_off_count"));
}

#[test]
fn r_esd_134_the_example_of_an_output_module_can_be_reproduced() {
    // CAN-CBM-AO4, node id 6: its first output stood at QB55 with COB-ID 0x306, an INT with a name.
    let outputs = r#"
        format = 1
        device = { vendor = "esd", model = "CAN-CBM-AO4" }
        rpdo.2 = { cob_id = "$NODEID+0x300", length = 8 }
        [[tag]]
        name = "valve_{}"
        array = { first = 1, count = 4 }
        rpdo = 2
        bit = 0
        type = "i16"
        default = 0
        registers = [{ address = 155, type = "i16" }]
    "#;
    let sketch = Sketch::new()
        .mapping(SourceText::new("ao4", outputs))
        .node("ao4", 6, "ao4", |node| node.outputs = At::nowhere(true));
    let table = sketch.build().unwrap().0;
    let map = RegisterMap::build(&table, &ModbusSettings::default(), "cangate").unwrap();
    let csv = map_text::render(&map, MapFormat::Csv);
    let row = csv.lines().find(|line| line.contains(",valve_1,")).unwrap();
    assert!(row.starts_with("6,input_register,155,156,300156,400156,i16,1,"), "{row}");
    assert!(row.contains(",RPDO2 bytes 0-1,") && row.ends_with(",0x306"), "{row}");
    let mut conversation = Conversation::new(table);
    conversation.answer_guarding(6, 5);
    conversation.run_to(2000);
    let sent: Vec<String> = conversation.all_sent.iter().map(ToString::to_string).collect();
    assert!(sent.contains(&"306#0000000000000000".to_owned()), "{sent:?}");
}

/// The warnings and errors of a configuration with one node, by `cangate check`.
fn problems(folder: &Path, bus: &str, mapping: &str) -> String {
    std::fs::write(folder.join("device.toml"), mapping).unwrap();
    let file = folder.join("cangate.toml");
    let node = "[node.a]\nbus = \"can0\"\nid = 1\nmapping = \"device.toml\"\n";
    std::fs::write(&file, format!("version = 1\n[bus.can0]\ninterface = \"can0\"\n{bus}\n{node}")).unwrap();
    check(&[file], &[]).to_string()
}

/// One TPDO of 8 bytes after every `every`th SYNC: 114 bits.
fn synchronous(every: u8) -> String {
    format!(
        "format = 1\ndevice = {{ vendor = 'x', model = 'y' }}\nerror_control = {{ kind = 'none' }}\n[tpdo.1]\ncob_id = \"$NODEID+0x180\"\n\
         length = 8\ntransmission_type = {every}\n[[tag]]\nname = \"level\"\ntpdo = 1\nbit = 0\ntype = \"u8\"\n"
    )
}

#[test]
fn r_esd_112_the_own_node_id_is_1_to_127_and_nobody_elses() {
    let folder = tempfile::tempdir().unwrap();
    let told = |id: u32| problems(folder.path(), &format!("own_node_id = {id}"), &synchronous(255));
    assert!(!told(127).contains("own"), "{}", told(127));
    assert!(told(0).contains("own_node_id 0 is out of range") && told(128).contains("out of range"));
    assert!(told(1).contains("node id 1 is the gateway's own on bus `can0`"), "{}", told(1));
}

#[test]
fn r_esd_116_a_period_that_is_not_longer_than_the_window_is_refused() {
    let folder = tempfile::tempdir().unwrap();
    let told = |period: u32, window: u32| {
        let bus = format!("[bus.can0.sync]\nperiod_us = {period}\nwindow_us = {window}");
        problems(folder.path(), &bus, &synchronous(1))
    };
    for (period, window) in [(10_000, 10_000), (10_000, 20_000)] {
        let text = told(period, window);
        let wrong = format!("error: the window of {window} us is not shorter than the period of SYNC");
        assert!(text.contains(&wrong) && text.contains("cangate.toml:6:13"), "{text}");
    }
    for (period, window) in [(10_000, 9_999), (10_000, 0), (0, 10_000), (0, 0)] {
        assert!(!told(period, window).contains(": error: "), "{period} {window}: {}", told(period, window));
    }
}

#[test]
fn r_esd_117_a_sync_period_that_would_load_the_bus_above_70_percent_is_told() {
    let folder = tempfile::tempdir().unwrap();
    let told = |period: u32, every: u8, more: &str| {
        let bus = format!("bit_rate = 125000\n{more}\n[bus.can0.sync]\nperiod_us = {period}");
        let text = problems(folder.path(), &bus, &synchronous(every));
        text.lines().find(|line| line.contains("is loaded")).map(str::to_owned)
    };
    // SYNC has 48 bits, the TPDO 114: of 2000 us, that is 250 bits, 64 %.
    assert_eq!(told(2000, 1, ""), None);
    let warning = told(1800, 1, "").unwrap();
    assert!(
        warning.contains(
            "warning: with a SYNC every 1800 us bus `can0` is loaded to about 72 % of its 125000 bit/s"
        ),
        "{warning}"
    );
    assert_eq!(told(1800, 2, ""), None, "every second SYNC");
    assert!(told(1800, 0, "").is_some(), "at worst after each");
    assert_eq!(told(1900, 1, ""), None);
    let heartbeat = "own_node_id = 5\nown_heartbeat_ms = 10";
    assert!(told(1900, 1, heartbeat).is_some(), "other frames count too");
}

#[test]
fn r_esd_114_a_period_of_0_is_no_sync() {
    for period in ["period_us = 0", "period_ms = 0"] {
        let text = format!(
            "version = 1\n[bus.can0]\ninterface = \"can0\"\n[bus.can0.sync]\n{period}\n[node.a]\nbus = \"can0\"\nid = 1\nmapping = \"a\"\n"
        );
        let mut read = |_: &str| Ok(synchronous(1));
        let loaded = config::load(&SourceText::new("cangate.toml", text), [], &mut read).unwrap();
        let told: Vec<String> = loaded.warnings.iter().map(|warning| warning.message.clone()).collect();
        assert!(told.iter().any(|line| line.contains("nobody is known to send it")), "{told:?}");
        let mut conversation = Conversation::new(loaded.table);
        conversation.run_to(10_000);
        assert!(conversation.all_sent.iter().all(|frame| !frame.to_string().starts_with("080#")));
    }
}
