//! Identifiers that two participants of a bus would send: every kind against every other, with both owners, line and hint.

use std::io;

use cangate::config;
use cangate::mapping::SourceText;

/// A device with two TPDOs of these identifiers.
fn mapping(first: &str, second: &str) -> String {
    format!(
        "format = 1\n[device]\nvendor = \"V\"\nmodel = \"M\"\ndescription = \"Two TPDOs\"\n[error_control]\nkind = \"heartbeat\"\n\
         [tpdo.1]\ncob_id = \"{first}\"\nlength = 2\nperiod_ms = 100\n[tpdo.2]\ncob_id = \"{second}\"\nlength = 2\nperiod_ms = 100\n\
         [[tag]]\nname = \"a\"\ndescription = \"A\"\ntpdo = 1\nbit = 0\ntype = \"u16\"\nregisters = [{{ address = 100, type = \"u16\" }}]\n\
         [[tag]]\nname = \"b\"\ndescription = \"B\"\ntpdo = 2\nbit = 0\ntype = \"u16\"\nregisters = [{{ address = 101, type = \"u16\" }}]\n"
    )
}

/// Nodes `a` (id 1, line 7) and `b` (id 2, line 11) of one bus, or of two; with more about the bus.
fn configuration(second_bus: &str, more: &str) -> String {
    format!(
        "version = 1\n[gateway]\nname = \"hall\"\n[bus.can0]\ninterface = \"can0\"\n\
         \n[node.a]\nbus = \"can0\"\nid = 1\nmapping = \"first.toml\"\n[node.b]\nbus = \"{second_bus}\"\nid = 2\nmapping = \
         \"second.toml\"\n[bus.can1]\ninterface = \"can1\"\n{more}"
    )
}

/// What is wrong with two devices of two TPDOs each.
fn problems(devices: [[&str; 2]; 2], second_bus: &str, more: &str) -> Vec<String> {
    let source = SourceText::new("cangate.toml", configuration(second_bus, more));
    let texts = devices.map(|[first, second]| mapping(first, second));
    let mut read = |path: &str| match path.rsplit('/').next() {
        Some("first.toml") => Ok(texts[0].clone()),
        Some("second.toml") => Ok(texts[1].clone()),
        _ => Err(io::ErrorKind::NotFound.into()),
    };
    match config::load(&source, [], &mut read) {
        Ok(_) => Vec::new(),
        Err(problems) => problems.iter().map(ToString::to_string).collect(),
    }
}

const FREE: [&str; 2] = ["$NODEID+0x180", "$NODEID+0x280"];

#[test]
fn devices_with_identifiers_of_their_own_clash_with_nobody() {
    for (devices, bus, more) in [
        ([FREE, FREE], "can0", ""),
        ([["0x191", "0x192"], ["0x191", "0x192"]], "can1", ""),
        ([["0x191", "0x18FF0001"], ["0x192", "0x18FF0002"]], "can0", ""),
        (
            [["0x080", "0x281"], FREE],
            "can0",
            "[bus.can0.sync]\nproducer = \"other\"\ncob_id = 0x181F0001\nperiod_ms = 100\n",
        ),
        // The default RPDO1 of node 2: who links a TPDO to it means it.
        ([["0x202", "0x281"], FREE], "can0", ""),
    ] {
        assert_eq!(problems(devices, bus, more), Vec::<String>::new(), "{devices:?} {bus} {more}");
    }
}

#[test]
fn r_det_004_each_clash_of_identifiers_names_both_owners_its_line_and_a_way_out() {
    const TAKEN: &str = "every identifier has one sender on its bus";
    const KEPT: &str = "check `cob_id` in the mapping";
    const SYNC: &str = "[bus.can0.sync]\nproducer = \"other\"\nperiod_ms = 100\ncob_id = ";
    const TIME: &str = "[bus.can0.time]\nperiod_s = 60\ncob_id = ";
    let two_broadcasts = format!("{SYNC}0x17F0001\n{TIME}0x17F0001\n");
    let sync_on_a_tpdo = format!("{SYNC}0x181\n");
    let time_on_an_emergency = format!("{TIME}0x82\n");
    let sync_on_an_answer = format!("{SYNC}0x582\n");
    for (devices, more, message, hint) in [
        // TPDO against TPDO, of two nodes and of one.
        (
            [["0x191", "0x281"], ["0x191", "0x282"]],
            "",
            "cangate.toml:11:7: error: TPDO 1 of node `a` (line 7) and TPDO 1 of node `b` have the same identifier 191",
            TAKEN,
        ),
        (
            [["0x18FF0001", "0x281"], ["0x18FF0001", "0x282"]],
            "",
            "TPDO 1 of node `a` (line 7) and TPDO 1 of node `b` have the same identifier 18FF0001",
            TAKEN,
        ),
        (
            [["0x182", "0x281"], FREE],
            "",
            "TPDO 1 of node `a` (line 7) and TPDO 1 of node `b` have the same identifier 182",
            TAKEN,
        ),
        (
            [["0x191", "0x191"], FREE],
            "",
            "cangate.toml:7:7: error: TPDO 1 of node `a` and TPDO 2 of node `a` have the same identifier 191",
            TAKEN,
        ),
        // TPDO against emergency, of the other node and of its own.
        (
            [["0x082", "0x281"], FREE],
            "",
            "TPDO 1 of node `a` (line 7) and emergency of node `b` have the same identifier 082",
            TAKEN,
        ),
        (
            [["$NODEID+0x80", "0x281"], FREE],
            "",
            "emergency of node `a` and TPDO 1 of node `a` have the same identifier 081",
            TAKEN,
        ),
        // TPDO against SDO and error control.
        (
            [["0x582", "0x281"], FREE],
            "",
            "TPDO 1 of node `a` has identifier 582, which is kept for SDO answers, here of node `b`",
            KEPT,
        ),
        (
            [["0x602", "0x281"], FREE],
            "",
            "TPDO 1 of node `a` has identifier 602, which is kept for SDO requests, here of node `b`",
            KEPT,
        ),
        (
            [["0x702", "0x281"], FREE],
            "",
            "TPDO 1 of node `a` has identifier 702, which is kept for node guarding and heartbeat, here of node `b`",
            KEPT,
        ),
        (
            [["0x703", "0x281"], FREE],
            "",
            "TPDO 1 of node `a` has identifier 703, which is kept for node guarding and heartbeat\n",
            KEPT,
        ),
        // TPDO against what belongs to all.
        (
            [["0x000", "0x281"], FREE],
            "",
            "TPDO 1 of node `a` has identifier 000, which is kept for NMT and its neighbours",
            KEPT,
        ),
        (
            [["0x080", "0x281"], FREE],
            "",
            "SYNC of bus `can0` (line 4) and TPDO 1 of node `a` have the same identifier 080",
            TAKEN,
        ),
        (
            [["0x100", "0x281"], FREE],
            "",
            "TIME of bus `can0` (line 4) and TPDO 1 of node `a` have the same identifier 100",
            TAKEN,
        ),
        (
            [["0x7E5", "0x281"], FREE],
            "",
            "TPDO 1 of node `a` has identifier 7E5, which is kept for layer setting services",
            KEPT,
        ),
        // SYNC and TIME against everything.
        ([FREE, FREE], sync_on_a_tpdo.as_str(), "and TPDO 1 of node `a` have the same identifier 181", TAKEN),
        (
            [FREE, FREE],
            time_on_an_emergency.as_str(),
            "and emergency of node `b` have the same identifier 082",
            TAKEN,
        ),
        (
            [FREE, FREE],
            sync_on_an_answer.as_str(),
            "identifier 582 is kept for SDO answers",
            "use another one",
        ),
        (
            [FREE, FREE],
            two_broadcasts.as_str(),
            "SYNC of bus `can0` (line 17) and TIME of bus `can0` have the same identifier 017F0001",
            TAKEN,
        ),
    ] {
        let told = problems(devices, "can0", more);
        let right = told.iter().any(|line| line.contains(message) && line.contains(&format!("hint: {hint}")));
        assert!(right, "`{message}` in {told:#?}");
    }
}
