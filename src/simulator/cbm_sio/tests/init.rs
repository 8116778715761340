//! The INIT protocol: who is meant, lengths, layout, replies (R-ESD-044 to R-ESD-066).

use super::super::parameters::Model;
use super::super::settings::SioSettings;
use super::bench::{Bench, prompt};

/// Asks module 12 for its number.
const NUMBER: &str = "700#010100120567";

#[test]
fn r_esd_044_049_a_module_reacts_to_its_number_on_the_init_identifier() {
    let mut bench = Bench::sio4(0x12);
    assert_eq!(bench.ask(NUMBER), "567#010112");
    for frame in ["700#010100130567", "700#010100000567", "700#010100FF0567", "701#010100120567", "700#R6"] {
        assert_eq!(bench.ask(frame), "-", "{frame}");
    }
}

#[test]
fn r_esd_002_frames_with_long_identifiers_are_not_for_it() {
    let mut bench = Bench::sio1(0x12);
    assert_eq!(bench.ask("00000700#010100120567"), "-");
    bench.frame("000000B5#41");
    bench.run_for(5);
    assert!(bench.line(1).is_empty());
}

#[test]
fn r_esd_045_only_six_bytes_are_a_command() {
    let mut bench = Bench::sio4(0x12);
    for frame in ["700#", "700#01", "700#0101001205", "700#01010012056700", "700#0101001205670000"] {
        assert_eq!(bench.ask(frame), "-", "{frame}");
    }
}

#[test]
fn r_esd_046_047_sixteen_bits_come_high_byte_first_behind_the_module_number() {
    let mut bench = Bench::sio4(0x12);
    bench.talk(&[
        ("700#820200120123", "-"),
        ("700#020200120567", "567#02020123"),
        ("700#840300122710", "-"),
        ("700#040300120567", "567#04032710"),
    ]);
}

#[test]
fn r_esd_048_from_public_copies_bit_7_sets_and_the_same_command_without_it_asks() {
    let mut bench = Bench::sio4(0x12);
    for (set, request) in [("82", "02"), ("83", "03"), ("84", "04"), ("86", "06")] {
        assert_eq!(bench.ask(&format!("700#{set}0300120321")), "-");
        let answer = bench.ask(&format!("700#{request}0300120567"));
        assert!(answer.starts_with(&format!("567#{request}030321")), "{answer}");
    }
}

#[test]
fn r_esd_050_the_identifier_of_a_reply_is_used_once_and_has_eleven_bits() {
    let mut bench = Bench::sio4(0x12);
    bench.talk(&[
        ("700#010100120567", "567#010112"),
        ("700#010100120001", "001#010112"),
        ("700#0101001207FF", "7FF#010112"),
        ("700#010100120800", "-"),
        ("700#01010012FFFF", "-"),
    ]);
}

#[test]
fn r_esd_051_a_reply_repeats_command_and_sub_command_but_where_data_takes_its_place() {
    let mut bench = Bench::sio4(0x12);
    for request in ["0000", "0001", "0005", "0100", "0102", "0105", "0204", "0304", "0404", "0622"] {
        let answer = bench.ask(&format!("700#{request}00120567"));
        assert!(answer.starts_with(&format!("567#{request}")), "{request}: {answer}");
    }
    for request in ["0002", "0003"] {
        assert!(bench.ask(&format!("700#{request}00120567")).starts_with("567#00"));
    }
}

#[test]
fn r_esd_052_what_is_not_known_is_answered_by_one_byte() {
    let mut four = Bench::sio4(0x12);
    for request in ["0004", "0006", "0106", "0205", "0305", "0405", "0500", "0680", "0700", "0900", "7E00"] {
        assert_eq!(four.ask(&format!("700#{request}00120567")), "567#FF", "{request}");
    }
    for set in ["8000", "8106", "8205", "8305", "8405", "8500", "8680", "8700", "FE00", "FF01", "FF06"] {
        assert_eq!(four.ask(&format!("700#{set}00120567")), "-", "{set}: its last bytes are no identifier");
    }
}

#[test]
fn r_esd_053_from_public_copies_a_reply_takes_a_fifth_of_a_millisecond_and_never_ten() {
    for (delay, millis) in [(200, 0), (10_000, 10)] {
        let reply_delay = std::time::Duration::from_micros(delay);
        let mut bench = Bench::of(&SioSettings { reply_delay, ..prompt(Model::Sio1) }, 0x12);
        bench.run_to(100);
        bench.frame(NUMBER);
        bench.run_for(20);
        assert_eq!(bench.take(), [(100 + millis, "567#010112".to_owned())]);
    }
}

#[test]
fn r_esd_057_every_request_of_a_new_sio4_is_answered_as_the_tables_say() {
    let mut bench = Bench::sio4(0x1A);
    bench.talk(&[
        ("700#0000001A0567", "567#00003105"),
        ("700#0001001A0567", "567#00011A"),
        ("700#0002001A0567", "567#0053494F34313141"),
        ("700#0003001A0567", "567#0056312E30614530"),
        ("700#0005001A0567", "567#0005414130303132"),
        ("700#0100001A0567", "567#010000"),
        ("700#0101001A0567", "567#01011A"),
        ("700#0102001A0567", "567#0102C1"),
        ("700#0103001A0567", "567#0103031C"),
        ("700#0104001A0567", "567#01040000"),
        ("700#0105001A0567", "567#0105000000"),
        ("700#0200001A0567", "567#02000104"),
        ("700#0204001A0567", "567#02040108"),
        ("700#0300001A0567", "567#030001090109"),
        ("700#0304001A0567", "567#0304010D010D"),
        ("700#0400001A0567", "567#04000000"),
        ("700#0601001A0567", "567#06011411"),
        ("700#0602001A0567", "567#06022273"),
        ("700#0621001A0567", "567#06211411"),
        ("700#7F1A1A000567", "567#"),
    ]);
}

#[test]
fn r_esd_058_the_module_type_tells_the_two_modules_apart() {
    for (mut bench, answer) in [(Bench::sio1(0x12), "567#00003005"), (Bench::sio4(0x12), "567#00003105")] {
        assert_eq!(bench.ask("700#000000120567"), answer);
    }
}

#[test]
fn r_esd_059_the_switches_are_told_as_they_stand_and_not_as_they_counted() {
    let mut bench = Bench::sio4(0x12);
    bench.order("switch 34");
    bench.talk(&[("700#000100120567", "567#000134"), ("700#010100120567", "567#010112")]);
}

#[test]
fn r_esd_060_062_texts_are_those_of_the_settings_with_the_module_number_in_digits() {
    let settings = SioSettings { ascii_id: *b"ABCDE", serial_number: *b"ZZ9999", ..prompt(Model::Sio1) };
    let mut bench = Bench::of(&settings, 0xBC);
    bench.talk(&[("700#000200BC0567", "567#0041424344454243"), ("700#000500BC0567", "567#00055A5A39393939")]);
}

#[test]
fn r_esd_004_005_061_from_public_copies_the_software_revision_names_the_esd_protocol() {
    let mut bench = Bench::sio4(0x12);
    let answer = bench.ask("700#000300120567");
    assert_eq!(&answer[4..], "0056312E30614530", "V1.0aE0, whose sixth character is the protocol");
    let software = *b"V2.1bC1";
    let mut other = Bench::of(&SioSettings { software, ..prompt(Model::Sio4) }, 0x12);
    assert_eq!(other.ask("700#000300120567"), "567#0056322E31624331");
}

#[test]
fn r_esd_063_a_tx_identifier_acts_at_once_and_has_eleven_bits() {
    let mut bench = Bench::sio4(0x12);
    bench.talk(&[
        ("700#820100120345", "-"),
        ("700#020100120567", "567#02010345"),
        ("700#820100120800", "-"),
        ("700#020100120567", "567#02010345"),
    ]);
    bench.say(2, b"z");
    bench.run_for(5);
    assert_eq!(bench.frames(), ["345#7A"]);
}

#[test]
fn r_esd_064_an_rx_identifier_acts_at_once_and_is_told_twice() {
    let mut bench = Bench::sio4(0x12);
    bench.talk(&[
        ("700#830100120346", "-"),
        ("700#030100120567", "567#030103460346"),
        ("700#83010012FFFF", "-"),
    ]);
    bench.frame("346#41");
    bench.frame("0BA#42");
    bench.run_for(5);
    assert_eq!(bench.line(2), b"A", "the old identifier is no longer its own");
}

#[test]
fn r_esd_065_a_tx_activate_time_is_kept_and_sends_nothing_by_itself() {
    let mut bench = Bench::sio4(0x12);
    bench.talk(&[("700#840000120064", "-"), ("700#040000120567", "567#04000064")]);
    bench.say(1, b"z");
    bench.run_for(10_000);
    assert_eq!(bench.frames(), ["0B4#7A"]);
}

#[test]
fn r_esd_066_there_are_128_user_parameters_of_16_bits() {
    let mut bench = Bench::sio4(0x12);
    for number in [0x00, 0x03, 0x23, 0x7F] {
        assert_eq!(bench.ask(&format!("700#86{number:02X}00121234")), "-");
    }
    for number in [0x00, 0x03, 0x23, 0x7F] {
        assert_eq!(bench.ask(&format!("700#06{number:02X}00120567")), format!("567#06{number:02X}1234"));
    }
    assert_eq!(bench.ask("700#068000120567"), "567#FF");
}
