//! Scenarios: those that come with the program, and the `[device]` table.

use super::super::line::LineKind;
use super::super::parameters::Model;
use super::bench::Bench;
use crate::simulator::{Kind, Scenario, Settings};

fn bench(kind: Kind, name: &str) -> Bench {
    let scenario = Scenario::shipped(kind, name).unwrap();
    let Settings::CbmSio(settings) = scenario.settings.clone() else { panic!("{name}") };
    Bench::told(&settings, 0x1A, scenario)
}

#[test]
fn every_shipped_scenario_runs_for_two_minutes() {
    for kind in [Kind::CbmSio1, Kind::CbmSio4] {
        for (name, text) in kind.shipped() {
            let read = Scenario::parse(kind, name, text);
            assert!(read.is_ok(), "{name}: {}", read.unwrap_err());
            let mut bench = bench(kind, name);
            bench.run_to(120_000);
            let sends = ["scanner", "unplug", "demo"].contains(name);
            assert_eq!(!bench.frames().is_empty(), sends, "{name}");
        }
    }
}

#[test]
fn the_demo_has_a_scanner_a_balance_and_echoes() {
    let mut bench = bench(Kind::CbmSio4, "demo");
    bench.run_to(8000);
    let code: String =
        bench.frames().iter().filter_map(|frame| frame.strip_prefix("104#").map(str::to_owned)).collect();
    assert!(code.starts_with("34303036333831333333393331"), "{code}");
    bench.frame("10A#530D0A");
    bench.frame("10D#5A");
    bench.run_for(1500);
    let sent = bench.frames();
    assert!(sent.contains(&"105#6B".to_owned()) && sent.contains(&"108#5A".to_owned()), "{sent:?}");
}

#[test]
fn a_reset_scenario_makes_the_module_new_on_the_bus() {
    let mut bench = bench(Kind::CbmSio4, "reset");
    bench.run_to(3000);
    bench.frame("700#8102001A0000");
    bench.run_to(19_999);
    assert!(!bench.says("new on bus"));
    bench.run_to(20_000);
    assert!(bench.says("new on bus"));
}

#[test]
fn the_unplug_scenario_loses_bytes_and_tells_how_many() {
    let mut bench = bench(Kind::CbmSio1, "unplug");
    bench.run_to(14_000);
    bench.run_to(22_000);
    assert!(
        bench.device_remarks().contains("overflow") && bench.says("can error"),
        "{}",
        bench.device_remarks()
    );
}

/// What a `[device]` table becomes.
fn settings(kind: Kind, device: &str) -> Result<Box<super::super::SioSettings>, String> {
    let text = format!("description = \"x\"\n[device]\n{device}\n");
    match Scenario::parse(kind, "s.toml", &text).map_err(|error| error.to_string())?.settings {
        Settings::CbmSio(settings) => Ok(settings),
        Settings::Detcon(_) | Settings::DstP92c(_) => panic!("{kind:?}"),
    }
}

#[test]
fn the_last_word_of_a_list_holds_for_the_channels_that_follow() {
    let read = settings(
        Kind::CbmSio4,
        "lines = [\"scanner\", \"echo\"]\ncan_tx_mode = [0x1484, 0x0088]\nserial_mode = [0x0073]\nsoftware = \"V1.1bE0\"",
    );
    let read = read.unwrap();
    assert_eq!(read.model, Model::Sio4);
    assert_eq!(read.lines[..3], [LineKind::Scanner, LineKind::Echo, LineKind::Echo]);
    assert_eq!(read.can_tx_mode, [0x1484, 0x88, 0x88, 0x88, 0x88]);
    assert_eq!(read.serial_mode, [0x73; 5]);
    assert_eq!(&read.software, b"V1.1bE0");
}

#[test]
fn what_a_module_cannot_be_is_refused_with_its_place() {
    for (kind, device, reason) in [
        (
            Kind::CbmSio4,
            "lines = [\"modem\"]",
            "s.toml:3:10: error: `modem` is nothing that can be at a line",
        ),
        (Kind::CbmSio1, "lines = [\"echo\", \"echo\", \"echo\"]", "no such channel"),
        (Kind::CbmSio4, "can_tx_mode = [0x148F]", "is not a CAN Tx mode of channel 1"),
        (Kind::CbmSio1, "serial_mode = [0x2270]", "is not a serial mode of channel 1"),
        (Kind::CbmSio4, "serial_mode = [70000]", "is not a serial mode of channel 1"),
        (Kind::CbmSio4, "first_tx_delay_ms = 70000", "give a number from 0 to 65535"),
        (Kind::CbmSio4, "software = \"V1\"", "7 printable characters"),
        (Kind::CbmSio4, "watchdog_state = 8", "from 0 to 7"),
        (Kind::CbmSio4, "cylinders = 12", "unknown field"),
        (Kind::CbmSio4, "[[step]]\nat_ms = 1\ndo = \"weight 2 1.5\"", "channel 2 has no balance"),
    ] {
        let error = settings(kind, device).unwrap_err();
        assert!(error.contains(reason), "{device}: {error}");
    }
}
