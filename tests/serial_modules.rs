//! esd modules in the configuration: what becomes of their keys, which are refused, and which identifiers clash.

use std::io;
use std::time::Duration;

use cangate::can::BIT_RATES;
use cangate::config;
use cangate::esd::{
    CanBitRate, CanTxMode, FlowControl, ManagementSettings, ModuleSettings, SerialMode, WatchdogMode,
};
use cangate::mapping::{
    AlarmOwner, Diagnostic, LineEncoding, LineText, NodeDef, Protocol, SourceText, TagTable, check_mapping,
};

/// Lines before those that a test adds.
const HEAD: &str = "version = 1\n[gateway]\nname = \"hall\"\n[bus.can0]\ninterface = \"can0\"\n";
/// Makes modules managed.
const REPLY_ID: &str = "[bus.can0.esd]\nreply_id = 0x7A0\n";

fn told(problems: &[Diagnostic]) -> Vec<String> {
    problems.iter().map(ToString::to_string).collect()
}

/// The table and the warnings of a configuration with one bus, or everything that is wrong.
fn load(more: &str) -> Result<(TagTable, Vec<String>), Vec<String>> {
    let source = SourceText::new("cangate.toml", format!("{HEAD}{more}"));
    match config::load(&source, [], &mut |_| Err(io::ErrorKind::NotFound.into())) {
        Ok(loaded) => Ok((loaded.table, told(&loaded.warnings))),
        Err(problems) => Err(told(&problems)),
    }
}

/// The table of a configuration that is to be without a warning.
fn table(more: &str) -> TagTable {
    let (table, warnings) = load(more).unwrap();
    assert_eq!(warnings, Vec::<String>::new());
    table
}

/// A module `name` of a kind with this number, and more of its keys.
fn module(name: &str, kind: &str, number: u8, more: &str) -> String {
    format!("[node.{name}]\nbus = \"can0\"\nid = 0x{number:02X}\nmapping = \"esd-can-cbm-{kind}\"\n{more}")
}

/// A SIO4 `scales`.
fn sio4(switch: u8, more: &str) -> String {
    module("scales", "sio4", switch, more)
}

/// A managed SIO4 `scales` with these keys of a line, whose packing carries it unless they say otherwise.
fn line(channel: u8, keys: &str) -> String {
    let packing = if keys.contains("inhibit_ms") {
        ""
    } else if keys.contains("end_mark") {
        "inhibit_ms = 1\n"
    } else {
        "min_char = 8\ninhibit_ms = 1\n"
    };
    let table = format!("[node.scales.channel.{channel}]\n{packing}{keys}");
    format!("{REPLY_ID}{}", sio4(0x1A, &table))
}

/// A CANopen device with this node id.
fn detcon(id: u8) -> String {
    format!("[node.engine-{id}]\nbus = \"can0\"\nid = {id}\nmapping = \"motortech-detcon\"\n")
}

fn node<'a>(table: &'a TagTable, name: &str) -> &'a NodeDef {
    &table.nodes[table.find_node(name).unwrap().0]
}

fn settings<'a>(table: &'a TagTable, name: &str) -> &'a ModuleSettings {
    node(table, name).protocol.module().unwrap()
}

fn ids(module: &ModuleSettings) -> Vec<[u32; 2]> {
    module.channels.iter().map(|channel| [channel.tx_id.raw(), channel.rx_id.raw()]).collect()
}

/// How `scales` is managed with these keys, where its bus has a reply identifier.
fn management(more: &str) -> ManagementSettings {
    let (table, _) = load(&format!("{REPLY_ID}{}", sio4(0x1A, more))).unwrap();
    settings(&table, "scales").management.clone().unwrap()
}

/// The parameters of channel 1 of `scales` with these keys, as values: CAN Tx mode and serial mode.
fn parameters(keys: &str) -> [Option<u16>; 2] {
    let (table, _) = load(&sio4(0x1A, &format!("[node.scales.channel.1]\n{keys}"))).unwrap();
    let channel = &settings(&table, "scales").channels[0];
    [channel.can_tx_mode.map(CanTxMode::value), channel.serial_mode.map(SerialMode::value)]
}

/// Exactly one thing is wrong with a configuration, warnings apart, and it is this.
fn refused(more: &str, message: &str) {
    let mut problems = load(more).expect_err(message);
    problems.retain(|problem| problem.contains(": error: "));
    let fit: Vec<&String> = problems.iter().filter(|problem| problem.contains(message)).collect();
    assert_eq!((fit.len(), problems.len()), (1, 1), "`{message}`: {problems:#?}");
}

/// A configuration is accepted with exactly one warning, which is this.
fn warned(more: &str, message: &str) {
    let (_, warnings) = load(more).unwrap_or_else(|problems| panic!("{problems:#?}"));
    assert!(warnings.len() == 1 && warnings[0].contains(message), "`{message}`: {warnings:#?}");
}

#[test]
fn r_esd_006_013_014_016_018_a_module_has_the_identifiers_and_the_number_of_its_coding_switch() {
    let table = table(&sio4(0x23, "manage = false\n[node.scales.channel.2]\n"));
    let module = settings(&table, "scales");
    assert_eq!(module.number.get(), 0x23);
    assert_eq!(ids(module), [[0x15E, 0x163], [0x15F, 0x164], [0x160, 0x165], [0x161, 0x166], [0x162, 0x167]]);
    assert_eq!(module.management, None, "`manage = false`");
    // Lines are those that are used; identifiers belong to all.
    let lines: Vec<(usize, u8)> = table.lines.iter().map(|line| (line.channel, line.number)).collect();
    assert_eq!(lines, [(1, 2)]);
    assert_eq!(node(&table, "scales").unit_id, 0x23);
}

#[test]
fn r_esd_013_015_v_esd_01_a_sio1_has_two_identifiers() {
    let table = table(&module("reader", "sio1", 0x23, ""));
    assert_eq!(ids(settings(&table, "reader")), [[0x15E, 0x15F]]);
}

#[test]
fn r_esd_019_identifiers_can_be_others_than_those_of_the_coding_switch() {
    let channel = "[node.scales.channel.5]\ntx_id = 0x1AA\nrx_id = 0x155\n";
    let table = table(&sio4(0x1A, &format!("coding_switch = 0x1B\nmanage = false\n{channel}")));
    let module = settings(&table, "scales");
    assert_eq!((module.number.get(), ids(module)[0], ids(module)[4]), (0x1A, [0x10E, 0x113], [0x1AA, 0x155]));
}

#[test]
fn r_esd_021_switches_without_identifiers_of_11_bits_are_refused() {
    refused(&sio4(0xCC, ""), "id 204 cannot be the value of the coding switch as well");
    refused(&sio4(0x1A, "coding_switch = 0xCC\n"), "coding_switch 0xCC gives no usable identifiers");
    refused(&sio4(0x1A, "coding_switch = 0\n"), "coding_switch 0x00 gives no usable identifiers");
    refused(&module("reader", "sio1", 0x1A, "coding_switch = 0xCD\n"), "0x01 to 0xCC");
    table(&module("reader", "sio1", 0x1A, "coding_switch = 0xCC\n"));
    table(&sio4(0x1A, "coding_switch = 0xCB\n"));
}

#[test]
fn r_esd_022_a_module_that_meets_another_identifier_is_refused_and_both_owners_are_named() {
    for (more, message) in [
        (
            sio4(0xB3, ""),
            "serial channel 3 (TxId) of node `scales` and the INIT-Id of bus `can0` (line 4) have the same identifier 700",
        ),
        (
            sio4(0x0C, ""),
            "serial channel 4 (RxId) of node `scales` and SYNC of bus `can0` (line 4) have the same identifier 080",
        ),
        (
            sio4(0x19, ""),
            "serial channel 2 (RxId) of node `scales` and TIME of bus `can0` (line 4) have the same identifier 100",
        ),
        (
            sio4(0xCA, ""),
            "serial channel 1 (TxId) of node `scales` and LSS of bus `can0` have the same identifier 7E4; so it is with 1 \
             more of its identifiers",
        ),
        (
            format!("{}{}", detcon(42), module("reader", "sio1", 0x11, "")),
            "serial channel 1 (TxId) of node `reader` and emergency of node `engine-42` (line 6) have the same identifier \
             0AA",
        ),
        (
            // Its last identifiers are those of error control.
            format!("{}{}", detcon(5), sio4(0xB3, "")),
            "so it is with 1 more of its identifiers",
        ),
        (
            format!("[bus.can0.sync]\ncob_id = 0x6A0\nperiod_ms = 100\n{}", sio4(0xA9, "")),
            "serial channel 2 (RxId) of node `scales` and SYNC of bus `can0` (line 6) have the same identifier 6A0",
        ),
        (
            format!(
                "{}{}",
                module("first", "sio1", 0x1A, ""),
                sio4(0x1B, "[node.scales.channel.1]\ntx_id = 0x105\n")
            ),
            "serial channel 1 (TxId) of node `scales` and serial channel 1 (RxId) of node `first` (line 6) have the same",
        ),
    ] {
        refused(&more, message);
    }
}

#[test]
fn r_esd_022_the_gateways_own_heartbeat_counts_as_well() {
    // Of the two identifiers of the module one is 0x708, and nobody but the heartbeat of node 8 has it.
    let reader = module("reader", "sio1", 0xB4, "");
    let text = format!("{HEAD}own_node_id = 8\nown_heartbeat_ms = 1000\n{reader}");
    let source = SourceText::new("cangate.toml", text);
    let problems = config::load(&source, [], &mut |_| Err(io::ErrorKind::NotFound.into())).unwrap_err();
    let both = "serial channel 1 (TxId) of node `reader` and the gateway's heartbeat on bus `can0` have the same \
                identifier 708\n";
    let problems = told(&problems);
    assert!(problems.len() == 1 && problems[0].contains(both), "{problems:#?}");
}

#[test]
fn r_esd_022_switches_that_are_free_on_this_bus_are_proposed() {
    let clash = sio4(0xB3, "");
    refused(&clash, "coding switch values that are free here are 0x1A, 0x1B, 0x1C");
    let beside = format!("{}{clash}", module("first", "sio4", 0x1A, ""));
    refused(&beside, "coding switch values that are free here are 0x1B, 0x1C, 0x1D");
    // A module of another kind would take a part of it only.
    let beside = format!("{}{clash}", module("first", "sio1", 0x1B, ""));
    refused(&beside, "coding switch values that are free here are 0x1A, 0x1C, 0x1D");
    // Another module has the number that goes with the switch.
    let beside = format!("{}{clash}", module("first", "sio1", 0x1A, "coding_switch = 0x25\n"));
    refused(&beside, "coding switch values that are free here are 0x1B, 0x1C, 0x1D");
}

#[test]
fn r_esd_022_switches_1a_to_25_of_a_sio4_are_free_beside_all_canopen_devices() {
    let mut text = REPLY_ID.to_owned();
    for id in 1..=127 {
        text.push_str(&detcon(id));
    }
    for switch in 0x1A..=0x25 {
        text.push_str(&module(
            &format!("m{switch}"),
            "sio4",
            switch,
            &format!("unit_id = {}\n", 102 + u32::from(switch)),
        ));
    }
    let table = table(&text);
    assert_eq!(table.nodes.len(), 127 + 12);
}

#[test]
fn r_esd_022_identifiers_by_which_masters_find_each_other_are_warned_of() {
    warned(&sio4(0x0B, ""), "has identifier 071, by which CANopen masters agree on one of them");
}

#[test]
fn r_esd_022_an_identifier_of_its_own_that_is_taken_is_told_where_it_is_written() {
    let more = sio4(0x1A, "[node.scales.channel.1]\ntx_id = 0x7E5\n");
    refused(
        &more,
        "cangate.toml:11:9: error: serial channel 1 (TxId) of node `scales` and LSS of bus `can0`",
    );
    refused(
        &sio4(0x1A, "[node.scales.channel.2]\nrx_id = 0x104\n"),
        "and serial channel 1 (TxId) of node `scales`",
    );
    let text = format!("{REPLY_ID}{}", sio4(0x1A, "watchdog_id = 0x7A0\n"));
    refused(
        &text,
        "the reply identifier of bus `can0` and the watchdog of node `scales` have the same identifier 7A0",
    );
}

#[test]
fn r_esd_022_identifiers_that_a_module_has_until_its_own_are_written_are_warned_of() {
    let own = "[node.reader.channel.1]\ntx_id = 0x7A1\nrx_id = 0x7A2\nmax_char = 8\ninhibit_ms = 2\n";
    let reader = |more: &str| module("reader", "sio1", 0x11, &format!("{more}{own}"));
    let managed = |more: &str| format!("{REPLY_ID}{}{}", detcon(42), reader(more));
    // 0x0AA is the TxId of switch 0x11, and the emergency of node 42.
    warned(
        &managed(""),
        "until it is configured, and after a reset unless stored, serial channel 1 (TxId) of node `reader` and emergency of \
         node `engine-42` have the same identifier 0AA",
    );
    warned(&managed(""), "set its coding switch to a value that is free here: 0x1A, 0x1B, 0x1C");
    warned(&managed("save_after_config = true\n"), "until it is configured, serial channel 1 (TxId)");
    table(&format!("{REPLY_ID}{}{}", detcon(41), reader("")));
    // Two modules with the same switch meet each other, though both have identifiers of their own.
    let second =
        "unit_id = 99\n[node.second.channel.1]\ntx_id = 0x7A3\nrx_id = 0x7A4\nmax_char = 8\ninhibit_ms = 2\n";
    let second = module("second", "sio1", 0x12, &format!("coding_switch = 0x11\n{second}"));
    let (_, warnings) = load(&format!("{REPLY_ID}{}{second}", reader(""))).unwrap();
    let both = "serial channel 1 (TxId) of node `reader` and serial channel 1 (TxId) of node `second` have the same \
                identifier 0AA; so it is with 1 more";
    assert!(warnings.iter().any(|warning| warning.contains(both)), "{warnings:#?}");
    refused(
        &format!("{}{}", detcon(42), module("reader", "sio1", 0x11, "")),
        "and let it store them (`save_after_config`)",
    );
}

#[test]
fn r_esd_023_nothing_else_has_the_init_id() {
    let sync = "[bus.can0.sync]\ncob_id = 0x700\nperiod_ms = 100\n";
    refused(
        &format!("{sync}{}", sio4(0x1A, "")),
        "the INIT-Id of bus `can0` and SYNC of bus `can0` (line 6) have the same identifier 700",
    );
    // Where there is no module, it is an identifier like any other.
    assert!(load(&format!("{sync}{}", detcon(1))).is_ok());
}

#[test]
fn r_esd_033_a_module_may_be_silent_for_its_first_tx_delay() {
    assert_eq!(management("").never_seen_after, Duration::from_secs(15));
    assert_eq!(management("first_tx_delay_ms = 0\n").never_seen_after, Duration::from_secs(5));
    assert_eq!(management("first_tx_delay_ms = 65535\n").never_seen_after, Duration::from_millis(70_535));
}

#[test]
fn r_esd_049_modules_have_numbers_from_1_to_254_each_its_own() {
    let with = |id: u64, more: &str| {
        format!(
            "[node.scales]\nbus = \"can0\"\nid = {id}\nmapping = \"esd-can-cbm-sio4\"\ncoding_switch = 0x1A\n{more}"
        )
    };
    refused(&with(255, "unit_id = 1\n"), "module number 255 is out of range");
    refused(&with(0, "unit_id = 1\n"), "module number 0 is out of range");
    refused(&with(250, ""), "module number 250 cannot be the Modbus unit id as well");
    let far = table(&with(254, "unit_id = 2\n"));
    assert_eq!((settings(&far, "scales").number.get(), node(&far, "scales").unit_id), (254, 2));
    let twice =
        format!("{}{}", with(9, ""), module("other", "sio1", 9, "coding_switch = 0x1C\nunit_id = 10\n"));
    refused(&twice, "modules `other` and `scales` have the same number 9 on bus `can0`");
}

#[test]
fn a_module_may_have_the_number_of_a_node_but_not_its_unit_id() {
    let both = |unit_id: &str| format!("{}{}", detcon(0x1A), sio4(0x1A, unit_id));
    refused(&both(""), "nodes `engine-26` and `scales` share unit id 26");
    table(&both("unit_id = 126\n"));
}

#[test]
fn r_esd_053_055_073_modules_are_managed_where_they_can_answer() {
    let bus = "[bus.can0.esd]\nreply_id = 0x7A0\nreply_timeout_ms = 50\nrepetitions = 3\n";
    let table = table(&format!("{bus}{}", sio4(0x1A, "")));
    let esd = &table.buses[0].esd;
    assert_eq!(esd.reply_id.map(cangate::can::CanId::raw), Some(0x7A0));
    assert_eq!((esd.reply_timeout, esd.repetitions), (Duration::from_millis(50), 3));
    let managed = settings(&table, "scales").management.clone().unwrap();
    assert_eq!(managed.switch, Some(0x1A));
    assert!(managed.configure && !managed.store && managed.watchdog.is_none());
    assert_eq!((managed.first_tx_delay, managed.status_period), (None, Duration::from_secs(2)));
    let only_compared = management("configure = false\nsave_after_config = true\nstatus_period_ms = 500\n");
    assert!(!only_compared.configure && only_compared.store);
    assert_eq!(only_compared.status_period, Duration::from_millis(500));
    refused(&sio4(0x1A, "manage = true\n"), "bus `can0` has no identifier on which modules could answer");
    let unmanaged = format!("{REPLY_ID}{}", sio4(0x1A, "manage = false\n"));
    assert_eq!(settings(&load(&unmanaged).unwrap().0, "scales").management, None);
    for (key, value) in [("status_period_ms", "500"), ("watchdog_id", "0x7A1"), ("save_after_config", "true")]
    {
        let message = format!("`{key}` means nothing: the module is not managed");
        warned(&sio4(0x1A, &format!("{key} = {value}\n")), &message);
    }
}

#[test]
fn a_passive_gateway_manages_nothing() {
    let text = |more: &str| format!("{HEAD}role = \"passive\"\n{REPLY_ID}{}", sio4(0x1A, more));
    let load = |more: &str| {
        let source = SourceText::new("cangate.toml", text(more));
        config::load(&source, [], &mut |_| Err(io::ErrorKind::NotFound.into()))
    };
    let loaded = load("status_period_ms = 500\n").unwrap();
    assert_eq!(
        (settings(&loaded.table, "scales").management.as_ref(), told(&loaded.warnings)),
        (None, vec![])
    );
    let problems = told(&load("manage = true\n").unwrap_err());
    assert!(problems[0].contains("cannot be managed on a bus where the gateway is passive"), "{problems:?}");
}

#[test]
fn r_esd_055_the_reply_identifier_is_nobody_elses() {
    let with = |id: &str| format!("[bus.can0.esd]\nreply_id = {id}\n{}{}", detcon(3), sio4(0x1A, ""));
    refused(
        &with("0x104"),
        "the reply identifier of bus `can0` and serial channel 1 (TxId) of node `scales` have the same",
    );
    refused(
        &with("0x083"),
        "the reply identifier of bus `can0` and emergency of node `engine-3` (line 8) have the same",
    );
    refused(&with("0x700"), "the reply identifier of bus `can0` and the INIT-Id of bus `can0`");
    refused(&with("0x700"), "0x780 is free here");
    refused(&with("0"), "reply_id 0x0 is no identifier of the esd protocol");
    refused(&with("0x800"), "reply_id 0x800 is no identifier of the esd protocol");
}

#[test]
fn r_esd_081_087_089_the_watchdog_is_off_unless_it_has_an_identifier_and_then_it_is_warned_of() {
    let keys = "watchdog_id = 0x7A1\nwatchdog_ms = 500\nwatchdog_factor = 4\nwatchdog_by = \"command\"\n";
    let watchdog = management(keys).watchdog.unwrap();
    assert_eq!((watchdog.id.raw(), watchdog.time, watchdog.factor), (0x7A1, Duration::from_millis(500), 4));
    assert_eq!(watchdog.mode, WatchdogMode::Command);
    let usual = management("watchdog_id = 0x7A1\n").watchdog.unwrap();
    assert_eq!((usual.time, usual.factor, usual.mode), (Duration::from_secs(1), 3, WatchdogMode::Remote));
    let text = format!("{REPLY_ID}{}", sio4(0x1A, keys));
    warned(&text, "the module resets itself when the gateway stops without a word, after 2000 ms");
    for key in ["watchdog_ms = 500\n", "watchdog_factor = 3\n", "watchdog_by = \"remote\"\n"] {
        refused(&format!("{REPLY_ID}{}", sio4(0x1A, key)), "means nothing without `watchdog_id`");
    }
}

#[test]
fn r_esd_009_rates_that_no_rs_232_line_has_are_warned_of() {
    warned(&line(1, "baud = 57600\n"), "57600 bit/s is more than a RS-232 line can have");
    table(&line(1, "baud = 38400\n"));
}

#[test]
fn r_esd_007_four_fast_channels_at_once_are_warned_of() {
    let channels = [1, 2, 3, 4]
        .map(|number| format!("[node.scales.channel.{number}]\nbaud = 9600\nmin_char = 8\ninhibit_ms = 8\n"));
    let channels = channels.concat();
    let sio4 = |channels: &str| format!("{REPLY_ID}{}", sio4(0x1A, channels));
    table(&sio4(&channels));
    let fast = channels.replacen("baud = 9600", "transmit_baud = 115200", 1);
    warned(&sio4(&fast), "channels 1 to 4 can have more than 38400 bit/s only while not all are used");
}

#[test]
fn r_esd_012_the_terminal_interface_has_fewer_formats() {
    let fifth = |keys: &str| line(5, keys);
    refused(&fifth("data_bits = 6\n"), "cannot have 6 data bits");
    refused(&fifth("data_bits = 7\n"), "cannot have 7 data bits without parity");
    refused(&fifth("stop_bits = 2\n"), "always has one stop bit");
    refused(&fifth("cts = true\n"), "ignores CTS");
    refused(
        &module("reader", "sio1", 0x1A, "[node.reader.channel.1]\ndata_bits = 5\n"),
        "cannot have 5 data bits",
    );
    for keys in ["data_bits = 7\nparity = \"odd\"\n", "data_bits = 8\nparity = \"even\"\n", "stop_bits = 1\n"]
    {
        table(&fifth(keys));
    }
    table(&line(1, "data_bits = 5\nstop_bits = 2\ncts = true\n"));
}

#[test]
fn r_esd_091_092_093_094_packing_of_a_channel_as_a_value() {
    assert_eq!(parameters(""), [None, None], "as the module has it");
    for (keys, value) in [
        ("inhibit_ms = 20\n", 0x1411),
        ("min_char = 4\n", 0x1484),
        ("min_char = 1\nmax_char = 8\ninhibit_ms = 0\n", 0x0081),
        ("end_mark = \"cr_dropped\"\n", 0x148B),
        ("end_mark = \"cr\"\nmax_char = 4\ninhibit_ms = 255\n", 0xFF49),
        ("end_mark = \"lf_drops_both\"\n", 0x148E),
    ] {
        assert_eq!(parameters(keys)[0], Some(value), "{keys}");
    }
    let first = |keys: &str| sio4(0x1A, &format!("[node.scales.channel.1]\n{keys}"));
    refused(&first("min_char = 4\nmax_char = 2\n"), "min_char 4 is more than max_char 2");
    refused(&first("min_char = 4\nmax_char = 2\n"), "lower `min_char` or raise `max_char`");
    refused(
        &first("min_char = 4\nend_mark = \"cr\"\n"),
        "after a number of characters, or after an end mark",
    );
    warned(
        &line(1, "baud = 150\nmax_char = 8\ninhibit_ms = 200\n"),
        "messages end after 100 ms without data, but the module leaves 200 ms",
    );
}

#[test]
fn r_esd_027_028_a_packing_that_cannot_carry_its_line_is_warned_of_with_one_that_can() {
    let managed =
        |keys: &str| format!("{REPLY_ID}{}", sio4(0x1A, &format!("[node.scales.channel.1]\n{keys}")));
    let shipped = "channel 1 as shipped passes on at most 50 bytes/s (1 every 20 ms) of the 960 that its line can bring";
    warned(&managed(""), shipped);
    warned(&managed(""), "give it `max_char = 8` and `inhibit_ms = 8`");
    warned(&managed("baud = 38400\n"), "of the 3840 that its line can bring");
    warned(&managed("end_mark = \"cr\"\n"), "passes on at most 400 bytes/s (8 every 20 ms) of the 960");
    table(&managed("max_char = 8\ninhibit_ms = 8\n"));
    table(&managed("inhibit_ms = 0\n"));
    table(&managed("baud = 300\n"));
    // Whoever has no reply identifier may not know of the packing; whoever says `manage = false` does.
    let beginner = sio4(0x1A, "[node.scales.channel.1]\n");
    warned(&beginner, shipped);
    warned(
        &beginner,
        "give the channel `max_char = 8` and `inhibit_ms = 8`, and [bus.can0.esd] a `reply_id`",
    );
    table(&sio4(0x1A, "manage = false\n[node.scales.channel.1]\n"));
}

#[test]
fn keys_that_nobody_writes_are_warned_of_once_for_each_channel() {
    let first = |manage: &str, keys: &str| sio4(0x1A, &format!("{manage}[node.scales.channel.1]\n{keys}"));
    for (key, value) in [
        ("cts", "true"),
        ("rts", "true"),
        ("parity", "\"even\""),
        ("data_bits", "7"),
        ("stop_bits", "1"),
        ("end_mark", "\"cr\""),
        ("min_char", "2"),
        ("max_char", "8"),
        ("inhibit_ms", "2"),
    ] {
        let keys = format!("{key} = {value}\n");
        let message = format!("`{key}` is not written: the module is not managed; only the pace follows it");
        warned(&first("", &keys), &message);
        warned(&first("manage = false\n", &keys), &message);
        let managed = load(&format!("{REPLY_ID}{}", first("", &keys))).unwrap().1;
        assert!(managed.iter().all(|warning| !warning.contains("not written")), "{managed:#?}");
    }
    warned(
        &first("", "baud = 9600\ncts = false\n"),
        "cangate.toml:11:8: warning: `baud`, `cts` are not written",
    );
    // The pace follows the bit rate, which nothing else could tell.
    table(&first("manage = false\n", "baud = 9600\n"));
    let source = format!("{HEAD}role = \"passive\"\n{}", first("", "baud = 9600\nmax_char = 8\n"));
    let source = SourceText::new("cangate.toml", source);
    let loaded = config::load(&source, [], &mut |_| Err(io::ErrorKind::NotFound.into())).unwrap();
    let warnings = told(&loaded.warnings);
    let passive = "`baud`, `max_char` are not written: the gateway is passive on bus `can0`";
    assert!(warnings.len() == 1 && warnings[0].contains(passive), "{warnings:#?}");
}

#[test]
fn the_examples_of_the_manual_carry_their_lines() {
    let page = include_str!("../docs/configuration.md");
    let section = page.split("## esd modules\n").nth(1).unwrap().split("`[bus.NAME.esd]`").next().unwrap();
    let example: Vec<&str> = section.lines().filter_map(|line| line.strip_prefix("    ")).collect();
    assert_eq!(table(&(example.join("\n") + "\n")).lines.len(), 1);
    let page = include_str!("../docs/serial.md");
    let example = page.split("```toml\n").nth(1).unwrap().split("```").next().unwrap();
    assert_eq!(table(&format!("{REPLY_ID}{}", sio4(0x1A, example))).lines.len(), 1);
}

#[test]
fn r_esd_095_to_103_the_line_of_a_channel_as_a_value() {
    for (keys, value) in [
        ("baud = 9600\n", 0x2273),
        ("baud = 19200\n", 0x1173),
        ("receive_baud = 300\ntransmit_baud = 230400\n", 0x7E73),
        ("cts = false\n", 0x2233),
        ("rts = true\nstop_bits = 1\n", 0x22D3),
        ("parity = \"even\"\ndata_bits = 7\n", 0x2262),
        ("parity = \"odd\"\ndata_bits = 5\n", 0x2264),
    ] {
        assert_eq!(parameters(keys)[1], Some(value), "{keys}");
    }
    // Only what is written there is compared and written into the module.
    for (keys, bits, of_terminal) in [
        ("", 0, 0),
        ("baud = 9600\n", 0xFF00, 0xFF00),
        ("receive_baud = 300\n", 0xF000, 0xF000),
        ("cts = false\n", 0x0040, 0),
        ("rts = true\nstop_bits = 1\n", 0x00A0, 0x0080),
        ("parity = \"even\"\ndata_bits = 7\n", 0x001F, 0x001F),
        ("parity = \"none\"\n", 0x0018, 0x0018),
    ] {
        for (channel, bits) in [(1, bits), (5, of_terminal)] {
            let table = table(&line(channel, keys));
            let channel = &settings(&table, "scales").channels[usize::from(channel) - 1];
            assert_eq!(channel.serial_bits.0, bits, "{keys}");
        }
    }
    let first = |keys: &str| sio4(0x1A, &format!("[node.scales.channel.1]\n{keys}"));
    refused(&first("baud = 500000\n"), "500000 bit/s is no bit rate of a serial line of these modules");
    refused(&first("baud = 9600\nreceive_baud = 9600\n"), "`baud` is the bit rate of both directions");
}

#[test]
fn r_esd_054_090_values_out_of_range_are_refused_before_they_are_sent() {
    for (keys, message) in [
        ("first_tx_delay_ms = 65536\n", "first_tx_delay_ms 65536 is out of range"),
        ("status_period_ms = 99\n", "status_period_ms 99 is out of range"),
        ("watchdog_id = 0x7A1\nwatchdog_ms = 19\n", "watchdog_ms 19 is out of range"),
        ("watchdog_id = 0x7A1\nwatchdog_factor = 256\n", "watchdog_factor 256 is out of range"),
        ("[node.scales.channel.1]\ntx_id = 0x800\n", "tx_id 0x800 is no identifier of the esd protocol"),
        ("[node.scales.channel.1]\nrx_id = 0\n", "rx_id 0x0 is no identifier of the esd protocol"),
        ("[node.scales.channel.1]\ninhibit_ms = 256\n", "inhibit_ms 256 is out of range"),
        ("[node.scales.channel.1]\nmin_char = 9\n", "min_char 9 is out of range"),
        ("[node.scales.channel.1]\nmax_char = 0\n", "max_char 0 is out of range"),
        ("[node.scales.channel.1]\ndata_bits = 9\n", "data_bits 9 is out of range"),
        ("[node.scales.channel.1]\nstop_bits = 3\n", "stop_bits 3 is out of range"),
        ("[node.scales.channel.1]\nmax_message = 1025\n", "max_message 1025 is out of range"),
        ("[node.scales.channel.1]\ntx_gap_ms = 60001\n", "tx_gap_ms 60001 is out of range"),
        ("[node.scales.channel.6]\n", "there is no channel `6`: a CAN-CBM-SIO4 has channels 1 to 5"),
        ("[node.scales.channel.01]\n", "there is no channel `01`"),
    ] {
        let problems = load(&format!("{REPLY_ID}{}", sio4(0x1A, keys))).expect_err(keys);
        assert!(problems.iter().any(|problem| problem.contains(message)), "{keys}: {problems:#?}");
    }
}

#[test]
fn r_esd_034_037_what_makes_a_message_and_how_fast_a_line_is() {
    let channel = |keys: &str| {
        let table = table(&line(5, keys));
        settings(&table, "scales").channels[4].clone()
    };
    let usual = channel("");
    assert_eq!((usual.framing.delimiter.as_slice(), usual.framing.longest), (b"\r\n".as_slice(), 256));
    assert_eq!((usual.framing.idle, usual.gap), (Some(Duration::from_millis(100)), None));
    assert_eq!(usual.byte_time, Duration::from_secs(10) / 9_600, "one stop bit, whatever its bit says");
    assert_eq!(usual.flow_control, FlowControl::None);
    let own = channel(
        "delimiter = \"\\u0003\"\nmax_message = 16\nidle_ms = 0\ntx_gap_ms = 5\nflow_control = \"xon_xoff\"\nbaud = 1200\n",
    );
    assert_eq!((own.framing.delimiter.as_slice(), own.framing.longest), (b"\x03".as_slice(), 16));
    assert_eq!((own.framing.idle, own.gap), (None, Some(Duration::from_millis(5))));
    assert_eq!((own.byte_time, own.flow_control), (Duration::from_secs(10) / 1_200, FlowControl::XonXoff));
    // An end mark that the module keeps cannot end a message.
    assert_eq!(channel("end_mark = \"cr_dropped\"\n").framing.delimiter, Vec::<u8>::new());
    let first = |keys: &str| sio4(0x1A, &format!("[node.scales.channel.1]\n{keys}"));
    warned(&line(1, "end_mark = \"cr_dropped\"\ndelimiter = \"\\r\"\n"), "so `delimiter` never comes in");
    refused(&first("delimiter = \"ä\"\n"), "cannot be the end of a message");
    refused(&first("delimiter = \"123456789\"\n"), "cannot be the end of a message");
}

#[test]
fn r_esd_099_what_a_set_stop_bit_field_means_is_told_by_the_configuration_of_the_bus() {
    for (key, stop_bits) in [("", 2), ("stop_bit_set = 2\n", 2), ("stop_bit_set = 1\n", 1)] {
        let table = load(&format!("{REPLY_ID}{key}{}", sio4(0x1A, ""))).unwrap().0;
        assert!(settings(&table, "scales").channels.iter().all(|channel| channel.stop_bit_set == stop_bits));
    }
    refused(&format!("{REPLY_ID}stop_bit_set = 0\n{}", sio4(0x1A, "")), "stop_bit_set 0 is out of range");
}

#[test]
fn r_esd_092_which_half_is_which_is_told_by_the_configuration_of_the_bus() {
    for (key, high) in
        [("", false), ("high_half = \"max_char\"\n", false), ("high_half = \"min_char\"\n", true)]
    {
        let table = load(&format!("{REPLY_ID}{key}{}", sio4(0x1A, ""))).unwrap().0;
        assert_eq!(settings(&table, "scales").management.as_ref().unwrap().min_char_high, high, "{key}");
    }
}

#[test]
fn r_esd_055_modules_do_not_answer_where_a_canopen_device_may_obey_though_nobody_has_configured_it() {
    for id in ["0x081", "0x181", "0x201", "0x567", "0x601"] {
        refused(
            &format!("[bus.can0.esd]\nreply_id = {id}\n{}", sio4(0x1A, "")),
            "could be taken for a command or a message of a CANopen device",
        );
    }
}

#[test]
fn r_esd_078_each_bit_rate_of_canopen_is_one_of_the_modules() {
    for rate in BIT_RATES {
        let of_modules = CanBitRate::from_bits_per_second(rate).map(CanBitRate::bits_per_second);
        assert_eq!(of_modules, Some(rate));
    }
}

#[test]
fn lines_are_offered_as_the_configuration_says() {
    let keys = "manage = false\n[node.scales.channel.2]\ndescription = \"Truck scales\"\nlisten = \"0.0.0.0:4001\"\n\
                allow = [\"10.0.0.0/8\"]\nmax_connections = 2\nwrite = false\nmqtt = false\nencoding = \"base64\"\n\
                mqtt_write = true\ntext_register = 330\ntext_length = 16\n[node.scales.channel.4]\n\
                [mqtt]\nurl = \"mqtt://127.0.0.1\"\n";
    let table = table(&sio4(0x1A, keys));
    let [own, usual] = table.lines.as_slice() else { panic!("{:?}", table.lines) };
    let tcp = own.tcp.as_ref().unwrap();
    assert_eq!((tcp.listen.to_string().as_str(), tcp.max_connections, tcp.write), ("0.0.0.0:4001", 2, false));
    let admits = |address: &str| tcp.allow.admits(address.parse().unwrap());
    assert!(admits("10.1.2.3") && !admits("11.1.2.3"));
    assert_eq!((own.mqtt.publish, own.mqtt.encoding, own.mqtt.write), (false, LineEncoding::Base64, true));
    assert_eq!(own.text, Some(LineText { address: 330, registers: 17 }));
    assert_eq!((own.description.as_str(), own.number, own.channel), ("Truck scales", 2, 1));
    assert_eq!((&usual.tcp, usual.text, usual.number), (&None, None, 4));
    assert_eq!(
        (usual.mqtt.publish, usual.mqtt.encoding, usual.mqtt.write),
        (true, LineEncoding::Text, false)
    );
}

#[test]
fn ports_and_registers_of_lines_have_one_owner() {
    let two = |first: &str, second: &str| {
        sio4(
            0x1A,
            &format!(
                "manage = false\n[node.scales.channel.1]\nlisten = \"{first}\"\n[node.scales.channel.2]\nlisten = \"{second}\"\n"
            ),
        )
    };
    refused(
        &two("127.0.0.1:4001", "127.0.0.1:4001"),
        "channel 1 of node `scales` and channel 2 of node `scales` listen at the same port, 127.0.0.1:4001",
    );
    table(&two("127.0.0.1:4001", "127.0.0.2:4001"));
    table(&two("127.0.0.1:0", "127.0.0.1:0"));
    let first = |keys: &str| sio4(0x1A, &format!("manage = false\n[node.scales.channel.1]\n{keys}"));
    refused(&first("listen = \"4001\"\n"), "`4001` is not an address with a port");
    refused(&first("listen = \"127.0.0.1:1\"\nallow = [\"10.0.0.0/33\"]\n"), "is no address and no range");
    refused(&first("listen = \"127.0.0.1:1\"\nallow = []\n"), "nobody could connect");
    refused(&first("write = true\n"), "`write` means nothing without `listen`");
    warned(&first("listen = \"0.0.0.0:4001\"\n"), "whoever reaches 0.0.0.0:4001 over the network");
    refused(
        &first("text_register = 210\n"),
        "`channel_1_bytes_not_sent` and the last message of channel 1 share register 210",
    );
    refused(&first("text_register = 230\ntext_length = 65\n"), "text_length 65 is out of range");
    refused(&first("text_length = 16\n"), "`text_length` means nothing without `text_register`");
    let nodes = format!(
        "{}{}",
        first("text_register = 230\n"),
        module("reader", "sio1", 0x1B, "unit_id = 0x1A\noffset = 160\n")
    );
    let problems = load(&nodes).unwrap_err();
    assert!(problems[0].contains("share unit id 26 and addresses"), "{problems:#?}");
}

#[test]
fn lines_do_not_listen_where_the_gateway_itself_does() {
    let at = |listen: &str| {
        sio4(0x1A, &format!("manage = false\n[node.scales.channel.1]\nlisten = \"{listen}\"\n"))
    };
    let both = |owner: &str, port: u16| {
        format!("{owner} and channel 1 of node `scales` listen at the same port, 127.0.0.1:{port}")
    };
    refused(&at("127.0.0.1:5020"), &both("the Modbus server", 5_020));
    refused(&at("127.0.0.1:8080"), &both("the HTTP server", 8_080));
    let cia309 = format!("{}[cia309]\nlisten = \"127.0.0.1:60000\"\n", at("127.0.0.1:60000"));
    refused(&cia309, &both("the CiA 309-3 gateway", 60_000));
    table(&format!("{}[modbus]\nlisten = []\n", at("127.0.0.1:5020")));
}

#[test]
fn writing_to_lines_that_nothing_can_go_out_on_is_warned_of() {
    let line = "[node.scales.channel.1]\nlisten = \"127.0.0.1:4001\"\n";
    let without = sio4(0x1A, &format!("manage = false\n{line}mqtt_write = true\n"));
    warned(&without, "`mqtt_write` means nothing without [mqtt]\n  hint: add [mqtt]");
    let mqtt = "[mqtt]\nurl = \"mqtt://127.0.0.1\"\n";
    table(&format!("{without}{mqtt}"));
    for key in ["write", "mqtt_write"] {
        let more = sio4(0x1A, &format!("{line}{key} = true\n{mqtt}"));
        let source = SourceText::new("cangate.toml", format!("{HEAD}role = \"passive\"\n{more}"));
        let loaded = config::load(&source, [], &mut |_| Err(io::ErrorKind::NotFound.into())).unwrap();
        let warnings = told(&loaded.warnings);
        let passive = format!("`{key}` means nothing: the gateway is passive on bus `can0`");
        assert!(warnings.len() == 1 && warnings[0].contains(&passive), "{warnings:#?}");
    }
}

#[test]
fn lines_that_fill_their_bus_while_all_are_busy_are_warned_of() {
    let lines = |count: u16, baud: u32| {
        let line = |number| {
            format!(
                "[node.scales.channel.{number}]\nlisten = \"127.0.0.1:{}\"\nbaud = {baud}\nmin_char = 8\n\
                 inhibit_ms = 2\n",
                4_000 + number
            )
        };
        format!("{REPLY_ID}{}", sio4(0x1A, &(1..=count).map(line).collect::<String>()))
    };
    // 5 times 480 frames of 114 bits come in, and 60 % of the bus goes out at most.
    warned(&lines(5, 38_400), "bus `can0` is loaded to about 279 % of its 125000 bit/s");
    warned(&lines(5, 9_600), "while all its serial lines are busy both ways");
    table(&lines(2, 9_600));
    let fast = format!("{HEAD}bit_rate = 1000000\n{}", lines(5, 38_400));
    let source = SourceText::new("cangate.toml", fast);
    let loaded = config::load(&source, [], &mut |_| Err(io::ErrorKind::NotFound.into())).unwrap();
    assert_eq!(told(&loaded.warnings), Vec::<String>::new());
    // Each character in a frame of its own: 960 frames of 56 bits.
    let alone = "[node.scales.channel.1]\nbaud = 19200\nmin_char = 1\nmax_char = 1\ninhibit_ms = 0\n";
    warned(&format!("{REPLY_ID}{}", sio4(0x1A, alone)), "is loaded to about");
}

#[test]
fn keys_of_management_are_told_where_they_are_written() {
    let text = |key: &str| sio4(0x1A, &format!("{key} = true\n"));
    for key in ["configure", "save_after_config"] {
        let (_, warnings) = load(&text(key)).unwrap();
        let column = key.len() + 4;
        let place = format!("cangate.toml:10:{column}: warning: `{key}` means nothing");
        assert!(warnings.len() == 1 && warnings[0].starts_with(&place), "{warnings:#?}");
    }
    refused(
        &sio4(0x1A, "[node.scales.channel.6]\n"),
        "write [node.scales.channel.1] to [node.scales.channel.5]",
    );
    for key in ["watchdog_ms = 500\n", "watchdog_factor = 3\n", "watchdog_by = \"remote\"\n"] {
        refused(&sio4(0x1A, key), "means nothing without `watchdog_id`");
    }
}

#[test]
fn r_esd_019_keys_of_the_other_kind_of_devices_are_refused() {
    for key in [
        "guard_time_ms = 500",
        "error_control = \"guarding\"",
        "auto_start = true",
        "outputs = true",
        "sdo_timeout_ms = 500",
        "tpdo.1.event_timer_ms = 5",
    ] {
        refused(
            &sio4(0x1A, &format!("{key}\n")),
            "is for CANopen devices, and the mapping is that of an esd module",
        );
    }
    for key in ["coding_switch = 5", "manage = true", "watchdog_id = 0x7A1", "channel.1.baud = 9600"] {
        refused(
            &format!("{}{key}\n", detcon(1)),
            "is for esd modules, and the mapping is that of a CANopen device",
        );
    }
}

#[test]
fn a_module_has_the_alarms_that_mean_something_for_it() {
    let table = table(&sio4(0x1A, ""));
    let names: Vec<&str> = table
        .alarms
        .iter()
        .filter(|alarm| matches!(alarm.owner, AlarmOwner::Node(_)))
        .map(|alarm| alarm.name.as_str())
        .collect();
    assert_eq!(
        names,
        [
            "identity_mismatch",
            "node_lost",
            "node_never_seen",
            "node_restarted",
            "module_not_configured",
            "module_can_error",
            "module_suspended",
            "module_stopped"
        ]
    );
    let canopen = load(&detcon(1)).unwrap().0;
    assert!(canopen.alarms.iter().all(|alarm| alarm.name != "module_not_configured"));
}

#[test]
fn r_esd_038_074_the_values_of_a_module_stand_in_registers_with_the_same_distance_for_each_channel() {
    let table = table(&sio4(0x1A, ""));
    let place = |name: &str| {
        let tag = table.tag(table.find_tag(cangate::process_image::NodeIndex(0), name).unwrap()).unwrap();
        tag.registers[0].address
    };
    assert_eq!((place("can_status"), place("run"), place("new_on_bus")), (100, 0, 7));
    for (name, address) in [("bytes_received", 200), ("bytes_waiting", 212), ("seconds_since_sent", 215)] {
        for channel in 1..=5 {
            assert_eq!(place(&format!("channel_{channel}_{name}")), address + 100 * (channel - 1), "{name}");
        }
    }
    let single = load(&module("reader", "sio1", 0x1A, "")).unwrap().0;
    for tag in table.tags.iter().chain(&single.tags) {
        // What goes on though nothing happens would make a message every second.
        assert_eq!(tag.published, !tag.name.contains("_seconds_since_"), "{}", tag.name);
    }
    assert!(matches!(single.nodes[0].protocol, Protocol::Esd(_)));
    let tag = single.find_tag(cangate::process_image::NodeIndex(0), "channel_1_bytes_waiting").unwrap();
    assert_eq!(single.tag(tag).unwrap().registers[0].address, 212);
}

/// A mapping of a module with this behind it.
fn mapping(more: &str) -> Vec<String> {
    let text =
        format!("format = 1\n[device]\nvendor = \"V\"\nmodel = \"M\"\n[esd]\nmodule = \"sio4\"\n{more}");
    told(&check_mapping(&SourceText::new("own.toml", text)).unwrap_or_else(|problems| problems))
}

#[test]
fn a_mapping_of_a_module_says_nothing_of_canopen() {
    for (section, name) in [
        ("[identity]\nvendor_id = 1\n", "identity"),
        ("[error_control]\nkind = \"heartbeat\"\n", "error_control"),
        ("[start]\nauto_start = false\n", "start"),
        ("[emergency]\nread_at_boot = true\n", "emergency"),
        ("[tpdo.1]\ncob_id = 0x181\nlength = 1\n", "tpdo"),
        ("[rpdo.1]\ncob_id = 0x201\nlength = 1\n", "rpdo"),
        ("[[setup]]\nobject = \"0x2000:0\"\ntype = \"u8\"\nvalue = 1\n", "setup"),
    ] {
        let problems = mapping(section);
        assert!(
            problems.len() == 1 && problems[0].contains(&format!("[{name}] means nothing")),
            "{problems:#?}"
        );
    }
    let tag = |keys: &str| mapping(&format!("[[tag]]\nname = \"a\"\ntype = \"u8\"\n{keys}"));
    for (keys, message) in [
        ("", "nothing says what of the module `a` shows"),
        ("module = \"bytes_sent\"\n", "nothing says of which serial line `a` is"),
        ("module = \"bytes_sent\"\nchannel = 6\n", "channel 6 is out of range"),
        ("module = \"status\"\nchannel = 1\n", "`a` is of the module, not of one of its lines"),
        ("module = \"status\"\nbit = 1\n", "`a` takes bits 1 to 8 of a number of 8 bits"),
        ("module = \"status\"\ntpdo = 1\n", "`tpdo` means nothing here"),
    ] {
        let problems = tag(keys);
        assert!(problems.len() == 1 && problems[0].contains(message), "{keys}: {problems:#?}");
    }
    let plain = "format = 1\n[device]\nvendor = \"V\"\nmodel = \"M\"\n[tpdo.1]\ncob_id = 0x181\nlength = 8\nperiod_ms = 9\n\
                 [[tag]]\nname = \"a\"\ntype = \"u8\"\ntpdo = 1\nbit = 0\nmodule = \"status\"\n";
    let problems = told(&check_mapping(&SourceText::new("own.toml", plain)).unwrap_err());
    assert!(problems[0].contains("`a` is of no esd module"), "{problems:#?}");
    let broken = plain.replace("[tpdo.1]", "[esd]\nmodule = \"sio9\"\n[tpdo.1]");
    let problems = told(&check_mapping(&SourceText::new("own.toml", broken)).unwrap_err());
    assert_eq!(problems.len(), 1, "what follows from a wrong [esd] is not told: {problems:#?}");
}
