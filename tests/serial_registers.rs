//! The last message of a serial line in the register map.

use cangate::mapping::{LineDef, LineMqtt, LineText, OnLoss, TagTable};
use cangate::modbus::{MapFormat, ModbusSettings, RegisterBank, RegisterMap, map_text};
use cangate::process_image::{NodeIndex, ProcessImage, SerialLine};
use cangate::time::{Now, Timestamp};

use crate::support::{lines, plant, registers};

/// `registers::table` with a text of five registers at 300 of nodes 1 to 3.
fn table() -> TagTable {
    let mut table = registers::table();
    let text = Some(LineText { address: 300, registers: 5 });
    table.lines = (0..3).map(|node| LineDef { node: NodeIndex(node), text, ..lines::line() }).collect();
    table
}

fn world() -> (RegisterBank, ProcessImage) {
    let table = table();
    let mut image = plant::image(&table);
    image.lines = vec![SerialLine::default(); 3];
    (registers::bank(table, &ModbusSettings::default()), image)
}

fn receive(image: &mut ProcessImage, bytes: &[u8]) {
    for line in &mut image.lines {
        line.append_message(Timestamp::from_millis(0), bytes.to_vec(), "idle");
    }
}

fn read(bank: &RegisterBank, image: &ProcessImage, unit: u8) -> Result<Vec<u16>, u8> {
    registers::registers(bank, image, Now::default(), unit, 300, 5)
}

#[test]
fn the_last_message_stands_with_its_length_two_bytes_in_a_register_filled_up_with_0() {
    let (bank, mut image) = world();
    receive(&mut image, b"first, and longer");
    receive(&mut image, b"ABCDE");
    assert_eq!(read(&bank, &image, 1).unwrap(), [5, 0x4142, 0x4344, 0x4500, 0]);
    receive(&mut image, b"");
    assert_eq!(read(&bank, &image, 1).unwrap(), [0, 0, 0, 0, 0]);
    receive(&mut image, b"0123456789");
    let cut = read(&bank, &image, 1).unwrap();
    assert_eq!(cut, [10, 0x3031, 0x3233, 0x3435, 0x3637], "the length tells that it is cut");
    assert_eq!(registers::registers(&bank, &image, Now::default(), 1, 302, 1).unwrap(), [0x3233]);
}

#[test]
fn without_a_message_the_length_is_65535_or_the_answer_an_exception() {
    let (bank, image) = world();
    let none = [0xFFFF, 0, 0, 0, 0];
    assert_eq!(read(&bank, &image, 1).unwrap(), none);
    assert_eq!(read(&bank, &image, 2).unwrap(), none, "there is nothing to hold");
    assert_eq!(read(&bank, &image, 3), Err(0x0B));
}

#[test]
fn while_the_module_is_lost_on_loss_says_what_is_shown() {
    let (bank, mut image) = world();
    receive(&mut image, b"AB");
    for node in &mut image.nodes {
        node.online = false;
    }
    assert_eq!(read(&bank, &image, 1).unwrap(), [0xFFFF, 0, 0, 0, 0]);
    assert_eq!(read(&bank, &image, 2).unwrap(), [2, 0x4142, 0, 0, 0]);
    assert_eq!(read(&bank, &image, 3), Err(0x0B));
    let mut table = table();
    table.nodes[1].zero_on_bad = true;
    assert_eq!(table.nodes[1].on_loss, OnLoss::Hold);
    let bank = registers::bank(table, &ModbusSettings::default());
    assert_eq!(read(&bank, &image, 2).unwrap(), [0, 0, 0, 0, 0]);
}

#[test]
fn the_map_has_length_and_text_with_offset_and_topic_and_its_hash_changes_with_them_only() {
    let build = |table: &TagTable| RegisterMap::build(table, &ModbusSettings::default(), "cangate").unwrap();
    let without = build(&registers::table());
    let mut with_lines = table();
    for line in &mut with_lines.lines {
        line.text = None;
    }
    assert_eq!(build(&with_lines).hash(), without.hash(), "a line without registers is not in the map");
    let mut table = table();
    table.lines[0].mqtt = LineMqtt { publish: true, ..LineMqtt::default() };
    table.lines[1] = LineDef { node: NodeIndex(3), ..table.lines[1].clone() };
    let map = build(&table);
    assert_ne!(map.hash(), without.hash());
    let find = |node: &str, tag: &str| {
        map.points().iter().find(|point| point.node == node && point.tag == tag).unwrap().clone()
    };
    let (length, text) = (find("engine1", "serial_1.length"), find("engine1", "serial_1.text"));
    assert_eq!((length.address, length.count, length.kind.as_str()), (300, 1, "u16"));
    assert_eq!((text.address, text.count, text.kind.as_str()), (301, 4, "text"));
    assert_eq!(
        (text.reference.as_str(), text.topic.as_str()),
        ("300302", "cangate/hall-1/engine1/serial/1/rx")
    );
    assert_eq!((find("engine4", "serial_1.length").address, text.unit_id), (1300, 1));
    for (format, part) in [
        (MapFormat::Table, "serial_1.text"),
        (MapFormat::Csv, "serial_1.text"),
        (MapFormat::Json, r#""type":"text""#),
        (MapFormat::Md, "serial_1.text"),
        (MapFormat::St, "ENGINE1_SERIAL_1_TEXT_TEXT : UINT := 301"),
    ] {
        let shown = map_text::render(&map, format);
        assert!(shown.contains(part), "{format:?}: {part}");
    }
}

#[test]
fn two_owners_of_one_register_are_told_with_their_names() {
    let mut table = table();
    table.lines[0].text = Some(LineText { address: 104, registers: 5 });
    let error = RegisterMap::build(&table, &ModbusSettings::default(), "cangate").unwrap_err().to_string();
    assert!(error.contains("serial line 1 of node `engine1`") && error.contains("address 104"), "{error}");
}
