//! Identifiers and module number from the coding switches (R-ESD-013 to R-ESD-018).

use super::super::parameters::Model;
use super::bench::{Bench, prompt};
use crate::simulator::DeviceNumber;

#[test]
fn r_esd_013_014_016_identifiers_of_an_sio4_follow_the_switches_channel_by_channel() {
    for (switch, base) in [(0x11_u8, 0x0AA_u16), (0x1A, 0x104), (0xCB, 0x7EE)] {
        let mut bench = Bench::sio4(switch);
        for channel in 0..5_u8 {
            let (tx, rx) = (base + u16::from(channel), base + 5 + u16::from(channel));
            let [tx_high, tx_low] = tx.to_be_bytes();
            let answer = bench.ask(&format!("700#02{channel:02X}00{switch:02X}07E8"));
            assert_eq!(answer, format!("7E8#02{channel:02X}{tx_high:02X}{tx_low:02X}"));
            bench.frame(&format!("{rx:03X}#4{channel}"));
            bench.run_for(5);
            assert_eq!(bench.line(channel + 1), [0x40 + channel]);
            bench.say(channel + 1, b"z");
            bench.run_for(5);
            assert_eq!(bench.frames(), [format!("{tx:03X}#7A")]);
        }
    }
}

#[test]
fn r_esd_015_016_an_sio1_has_two_identifiers() {
    let mut bench = Bench::sio1(0x12);
    bench.say(1, b"z");
    bench.frame("0B5#41");
    bench.run_for(5);
    assert_eq!((bench.frames(), bench.line(1)), (vec!["0B4#7A".to_owned()], b"A".to_vec()));
    bench.frame("0B6#41");
    bench.run_for(5);
    assert!(bench.line(1).is_empty());
    assert_eq!(bench.ask("700#020100120567"), "567#FF", "there is no second channel");
}

#[test]
fn r_esd_017_the_high_switch_counts_sixteen() {
    assert_eq!(Model::Sio1.identifiers(0x21, 0), (330, 331));
    let mut bench = Bench::sio1(0x21);
    assert_eq!(bench.ask("700#000100210567"), "567#000121");
}

#[test]
fn r_esd_018_the_module_number_is_that_of_the_switches() {
    let mut bench = Bench::sio4(0xB1);
    assert_eq!(bench.ask("700#010100B10567"), "567#0101B1");
    assert_eq!(bench.ask("700#010100120567"), "-", "another module is meant");
    let number = |text: &str| text.parse::<DeviceNumber>();
    assert_eq!(number("0xB1").map(DeviceNumber::get), Ok(177));
    assert_eq!(number("177").map(DeviceNumber::get), Ok(177));
    assert!(number("0").is_err() && number("0xFF").is_err() && number("B1").is_err());
}

#[test]
fn r_esd_021_no_module_has_identifiers_of_more_than_eleven_bits() {
    assert_eq!(Model::Sio4.identifiers(Model::Sio4.highest_switch(), 4), (0x7F2, 0x7F7));
    assert_eq!(Model::Sio1.identifiers(Model::Sio1.highest_switch(), 0), (0x7F8, 0x7F9));
    let settings = prompt(Model::Sio4);
    let bench = Bench::of(&settings, 0x1A);
    assert_eq!(bench.device.module().channels().len(), 5);
}
