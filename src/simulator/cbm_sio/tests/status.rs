//! Status byte, service request, bit rate (R-ESD-003, R-ESD-069, R-ESD-074 to R-ESD-079).

use super::super::parameters::{BIT_RATES, Model, bits_per_second};
use super::super::settings::SioSettings;
use super::bench::{Bench, prompt};

const STATUS: &str = "700#010200120567";
const CLEAR: &str = "700#810200120000";

#[test]
fn r_esd_069_modules_with_news_answer_a_service_request_in_their_range() {
    let mut bench = Bench::sio4(0x12);
    for (request, answer) in [
        ("700#7F1212000567", "567#"),
        ("700#7F01FE000567", "567#"),
        ("700#7F0111000567", "-"),
        ("700#7F13FE000567", "-"),
        ("700#7F1311000567", "-"),
    ] {
        assert_eq!(bench.ask(request), answer, "{request}");
    }
    bench.talk(&[(CLEAR, "-"), ("700#7F01FE000567", "-")]);
    bench.order("error");
    bench.talk(&[("700#7F01FE000567", "567#"), ("700#FF0500120000", "-"), ("700#7F01FE000567", "-")]);
}

#[test]
fn r_esd_074_each_bit_of_the_status_tells_its_own() {
    let mut bench = Bench::sio4(0x12);
    bench.talk(&[(STATUS, "567#0102C1"), (CLEAR, "-"), (STATUS, "567#010241")]);
    bench.order("error");
    bench.talk(&[(STATUS, "567#010245"), ("700#FF0400125A5A", "-"), (STATUS, "567#010247")]);
    bench.talk(&[("700#810000121200", "-"), ("700#FF000012AAAA", "-"), (STATUS, "567#010281")]);
}

#[test]
fn r_esd_074_from_public_copies_the_controllers_status_may_follow() {
    let settings = SioSettings { controller_status: true, ..prompt(Model::Sio4) };
    assert_eq!(Bench::of(&settings, 0x12).ask(STATUS), "567#0102C10C");
}

#[test]
fn r_esd_075_clearing_leaves_the_other_bits_and_a_supervisor_clears_the_error_alone() {
    let mut bench = Bench::sio4(0x12);
    bench.order("error");
    bench.talk(&[
        ("700#FF0400125A5A", "-"),
        (STATUS, "567#0102C7"),
        ("700#FF0500120000", "-"),
        (STATUS, "567#0102C3"),
    ]);
    bench.order("error");
    bench.talk(&[(CLEAR, "-"), (STATUS, "567#010243")]);
}

#[test]
fn r_esd_075_from_public_copies_a_reset_clears_the_error() {
    let mut bench = Bench::sio4(0x12);
    bench.order("error");
    bench.talk(&[("700#FF000012AAAA", "-"), (STATUS, "567#0102C1")]);
}

#[test]
fn r_esd_075_an_error_that_stands_cannot_be_cleared() {
    let mut bench = Bench::sio4(0x12);
    bench.order("error on");
    bench.talk(&[(CLEAR, "-"), (STATUS, "567#010245"), ("700#FF0500120000", "-"), (STATUS, "567#010245")]);
    bench.order("error off");
    bench.talk(&[(STATUS, "567#010241")]);
}

#[test]
fn r_esd_076_a_module_is_new_on_the_bus_from_each_start_until_it_is_told_otherwise() {
    let mut bench = Bench::sio4(0x12);
    for start in ["power cycle", "reset"] {
        bench.talk(&[(STATUS, "567#0102C1"), (CLEAR, "-"), (STATUS, "567#010241")]);
        bench.run_for(60_000);
        assert_eq!(bench.ask(STATUS), "567#010241");
        bench.order(start);
    }
    assert!(bench.says("new on bus"));
}

#[test]
fn r_esd_078_the_bit_rate_table_agrees_with_the_registers() {
    let kbit: Vec<_> = BIT_RATES.iter().map(|registers| bits_per_second(*registers) / 100).collect();
    let table = [10000, 8000, 6666, 5000, 3333, 2500, 1666, 1250, 1000, 666, 500, 333, 200, 125, 100];
    assert_eq!(kbit, table);
}

#[test]
fn r_esd_003_079_from_public_copies_a_bit_rate_acts_after_store_and_reset() {
    let mut bench = Bench::sio4(0x12);
    bench.talk(&[
        ("700#010300120567", "567#0103031C"),
        ("700#81030012011C", "-"),
        ("700#FF000012AAAA", "-"),
        ("700#010300120567", "567#0103031C"),
        ("700#81030012011C", "-"),
        ("700#810000121200", "-"),
        ("700#010300120567", "567#0103011C"),
        ("700#FF000012AAAA", "-"),
        ("700#010300120567", "-"),
    ]);
    assert!(bench.says("not at the bit rate of the bus"));
    bench.order("bus 250");
    bench.talk(&[("700#010300120567", "567#0103011C"), ("700#FF030012AAAA", "-"), (STATUS, "-")]);
    bench.order("bus 125");
    assert_eq!(bench.ask("700#010300120567"), "567#0103031C");
}

#[test]
fn r_esd_079_the_bit_rate_may_be_an_index_instead() {
    let settings = SioSettings { bit_rate_by_index: true, ..prompt(Model::Sio4) };
    let mut bench = Bench::of(&settings, 0x12);
    bench.talk(&[
        ("700#010300120567", "567#01030007"),
        ("700#81030012000F", "-"),
        ("700#810300120005", "-"),
        ("700#810000121200", "-"),
        ("700#FF000012AAAA", "-"),
    ]);
    bench.order("bus 250");
    assert_eq!(bench.ask("700#010300120567"), "567#01030005");
}
