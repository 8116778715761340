//! Tests of [`super`], with a simulated module on a bus inside the process.

use clap::Parser;

use super::super::sim::{self, SimOptions};
use super::super::{CommandLine, Subcommand};
use super::*;
use crate::can::virtual_bus;
use crate::can::{BusReader, BusWriter};
use crate::simulator::{DeviceNumber, Kind};

fn arguments(words: &str) -> Result<EsdArguments, clap::Error> {
    let line = ["cangate", "esd"].into_iter().chain(words.split(' '));
    let Subcommand::Esd(arguments) = CommandLine::try_parse_from(line)?.command else { panic!("{words}") };
    Ok(arguments)
}

fn job(words: &str) -> Result<Job, String> {
    arguments(words).unwrap().command.job().map(|(_, job)| job)
}

/// A bus with the module of the demo, 0x1A, after its silence.
struct World {
    bus: &'static str,
    clock: Clock,
    stop: CancellationToken,
    reader: virtual_bus::VirtualReader,
}

impl World {
    async fn with_module(bus: &'static str) -> Self {
        let world = Self::empty(bus);
        let options = SimOptions {
            kind: Kind::CbmSio4,
            interface: world.interface(),
            node: DeviceNumber::new(0x1A).unwrap(),
            count: 1,
            serial: Vec::new(),
            scenario: Some("demo".to_owned()),
            seed: 1,
        };
        tokio::spawn(sim::run(
            options,
            std::io::Cursor::new(""),
            std::io::sink(),
            world.clock,
            world.stop.clone(),
        ));
        tokio::time::sleep(Duration::from_secs(3)).await;
        world
    }

    fn empty(bus: &'static str) -> Self {
        let clock = Clock::start();
        let (reader, _) = virtual_bus::join(bus, clock);
        Self { bus, clock, stop: CancellationToken::new(), reader }
    }

    fn interface(&self) -> Interface {
        format!("virtual:{}", self.bus).parse().unwrap()
    }

    /// What a command line comes to. `-i` is not looked at.
    async fn run(&self, words: &str) -> Result<Vec<String>, EsdError> {
        let job = job(words).unwrap();
        perform(&self.interface(), job, self.clock, CancellationToken::new()).await
    }

    /// What was sent on the INIT-Id since this was asked last.
    async fn commands(&mut self) -> Vec<String> {
        let mut commands = Vec::new();
        // Longer than nothing is to be heard, and shorter than the scanner pauses.
        while let Ok(event) = tokio::time::timeout(Duration::from_millis(1), self.reader.recv()).await {
            if let BusEvent::Frame { frame, .. } = event.unwrap() {
                commands.push(frame.to_string());
            }
        }
        commands.retain(|frame| frame.starts_with("700#"));
        commands
    }
}

impl Drop for World {
    fn drop(&mut self) {
        self.stop.cancel();
    }
}

const ON_BUS: &str = "-i can0 --reply-id 0x6E0";
const MODULE: &str = "-i can0 --reply-id 0x6E0 --module 0x1A";

#[tokio::test(start_paused = true)]
async fn r_esd_069_070_a_scan_finds_a_module_with_news_and_tells_what_it_is() {
    let mut world = World::with_module("esd-scan").await;
    let lines = world.run(&format!("scan {ON_BUS}")).await.unwrap();
    assert_eq!(lines[0], report::HEAD);
    let words: Vec<&str> = lines[1].split_whitespace().collect();
    assert_eq!(
        words[..8],
        ["0x1A", "CAN-CBM-SIO4", "0x1A", "V1.0aE0", "AA0012", "0x104..108", "0x109..10D", "0xC1:"],
        "{lines:?}"
    );
    assert_eq!(lines.len(), 2);
    let commands = world.commands().await;
    assert_eq!(commands[..2], ["700#7F01FE0006E0", "700#7F017F0006E0"], "the range is halved");
    assert!(commands.iter().all(|frame| frame[4..].starts_with('7') || frame[4..].starts_with('0')));
}

#[tokio::test(start_paused = true)]
async fn r_esd_070_a_module_without_news_is_found_by_asking_each_number() {
    let world = World::with_module("esd-scan-all").await;
    let mut writer = virtual_bus::join(world.bus, world.clock).1;
    writer.send(&"700#8102001A0000".parse().unwrap()).await.unwrap();
    let lines = world.run(&format!("scan {ON_BUS}")).await.unwrap();
    assert!(lines.len() == 1 && lines[0].contains("--all"), "{lines:?}");
    let lines = world.run(&format!("scan {ON_BUS} --all")).await.unwrap();
    assert!(lines.len() == 2 && lines[1].starts_with("0x1A "), "{lines:?}");
}

#[tokio::test(start_paused = true)]
async fn a_module_is_shown_with_all_that_it_tells_and_nothing_is_changed_in_it() {
    let mut world = World::with_module("esd-show").await;
    let lines = world.run(&format!("show {MODULE}")).await.unwrap();
    for line in [
        "module 0x1A",
        "  type              CAN-CBM-SIO4 (0x31)",
        "  name              SIO411A",
        "  number            0x1A; none is stored: default parameters",
        "  status            0xC1: runs, default parameters, new on the bus",
        "  CAN bit rate      125 kbit/s (BTR 0x03 0x1C)",
        "  first Tx delay    0x07D0: 2000 ms",
        "channel 5",
        "  from the line     0x108",
        "  to the line       0x10D",
        "  packing           0x1411: a frame as soon as a character is there, of up to 1; 20 ms between frames",
        "  line              0x2273: 9600 bit/s, 8 bits, no parity, stop bit field set, CTS heeded, RTS bit clear",
    ] {
        assert!(lines.iter().any(|told| told == line), "`{line}` is missing in {lines:#?}");
    }
    assert!(lines.iter().any(|line| line.starts_with("  watchdog          off;")), "{lines:#?}");
    let commands = world.commands().await;
    assert!(commands.len() == 12 + 5 * 5 && commands.iter().all(|frame| frame[4..].starts_with('0')));
}

#[tokio::test(start_paused = true)]
async fn r_esd_041_042_054_073_an_order_is_sent_once_and_read_back() {
    let mut world = World::with_module("esd-suspend").await;
    let lines = world.run(&format!("suspend {MODULE}")).await.unwrap();
    assert!(lines[0].contains("done") && lines[0].contains("suspended"), "{lines:?}");
    assert_eq!(world.commands().await, ["700#FF04001A5A5A", "700#0102001A06E0"]);
    let lines = world.run(&format!("continue {MODULE}")).await.unwrap();
    assert!(lines[0].contains("done") && !lines[0].contains("suspended"), "{lines:?}");
    let lines = world.run(&format!("clear-error {MODULE}")).await.unwrap();
    assert!(lines[0].contains("done"), "{lines:?}");
}

#[tokio::test(start_paused = true)]
async fn r_esd_054_077_an_error_that_stands_is_cleared_three_times_and_told() {
    let mut world = World::empty("esd-stands");
    let (mut heard, mut say) = virtual_bus::join(world.bus, world.clock);
    let module = tokio::spawn(async move {
        while let Ok(event) = heard.recv().await {
            if let BusEvent::Frame { frame, .. } = event
                && frame.to_string() == "700#0102001A06E0"
            {
                say.send(&"6E0#010205".parse().unwrap()).await.unwrap();
            }
        }
    });
    let error = world.run(&format!("clear-error {MODULE}")).await.unwrap_err();
    assert_eq!(error.exit(), Exit::Refused);
    assert!(error.to_string().contains("0x05: runs, had a CAN error"), "{error}");
    module.abort();
    assert_eq!(world.commands().await, ["700#FF05001A0000", "700#0102001A06E0"].repeat(3));
}

#[tokio::test(start_paused = true)]
async fn r_esd_073_079_a_bit_rate_is_set_and_what_is_stored_is_read_back() {
    let mut world = World::with_module("esd-rate").await;
    let lines = world.run(&format!("set-bit-rate {MODULE} 250 --yes")).await.unwrap();
    assert!(lines[0].contains("250 kbit/s") && lines[0].contains("now: 125 kbit/s"), "{lines:?}");
    assert!(lines[1].contains("esd store") && lines[1].contains("esd reset"), "{lines:?}");
    assert!(world.commands().await.contains(&"700#8103001A011C".to_owned()));
    let lines = world.run(&format!("store {MODULE} --yes")).await.unwrap();
    assert!(lines[0].contains("now: bit rate 250 kbit/s"), "{lines:?}");
    assert!(world.commands().await.contains(&"700#8100001A1A00".to_owned()));
}

#[tokio::test(start_paused = true)]
async fn r_esd_072_073_108_109_resets_are_one_frame_each() {
    for (bus, words, frame) in [
        ("esd-reset", "reset -i can0 --module 26", "700#FF00001AAAAA"),
        ("esd-default", "default-reset -i can0 --module 0x1A --yes", "700#FF03001AAAAA"),
        ("esd-all", "reset -i can0 --all --yes", "700#FF000000AAAA"),
        ("esd-hold", "suspend -i can0 --all --yes", "700#FF0400005A5A"),
    ] {
        let mut world = World::empty(bus);
        let lines = world.run(words).await.unwrap();
        assert!(lines.len() == 1 && lines[0].contains(frame), "{lines:?}");
        assert_eq!(world.commands().await, [frame]);
    }
}

#[test]
fn r_esd_072_073_what_is_hard_to_undo_and_what_acts_on_all_must_be_confirmed() {
    for words in ["reset", "default-reset", "suspend", "continue", "clear-error"] {
        let error = job(&format!("{words} -i can0 --all")).unwrap_err();
        assert!(error.contains("--yes"), "{error}");
        assert!(job(&format!("{words} -i can0 --all --yes")).is_ok());
        assert!(arguments(&format!("{words} -i can0 --module 0 --yes")).is_err(), "0 is no module");
        assert!(arguments(&format!("{words} -i can0 --yes")).is_err(), "nobody is meant by saying nothing");
    }
    let store = format!("store {MODULE}");
    let rate = format!("set-bit-rate {MODULE} 125");
    let by_index = job(&format!("{rate} --by-index --yes")).unwrap();
    assert!(format!("{by_index:?}").contains("BitRate([0, 7])"), "{by_index:?}");
    assert_eq!(report::rate_text([0, 7]), "125 kbit/s (index 0x7)");
    for words in [store.as_str(), rate.as_str(), "default-reset -i can0 --module 26"] {
        assert!(job(words).unwrap_err().contains("--yes"));
        assert!(job(&format!("{words} --yes")).is_ok());
    }
}

#[test]
fn r_esd_054_values_out_of_range_are_refused_before_anything_is_sent() {
    for words in [
        "scan -i can0 --reply-id 0x700",
        "scan -i can0 --reply-id 0",
        "scan -i can0 --reply-id 0x800",
        "scan -i can0 --reply-id 0x080",
        "scan -i can0 --reply-id 0x081",
        "scan -i can0 --reply-id 0x100",
        "scan -i can0 --reply-id 0x181",
        "scan -i can0 --reply-id 0x201",
        "suspend -i can0 --module 1 --reply-id 0x601",
        "show -i can0 --module 1 --reply-id 0x67F",
        "scan -i can0 --reply-id 0x77F",
        "scan -i can0 --reply-id 0x7E4",
        "scan -i can0 --reply-id 0x7E5",
        "show -i can0 --reply-id 0x6E0 --module 255",
        "set-bit-rate -i can0 --reply-id 0x6E0 --module 1 300 --yes",
    ] {
        assert!(arguments(words).is_err(), "{words}");
    }
    let error = arguments("scan -i can0 --reply-id 0x601").unwrap_err().to_string();
    assert!(error.contains("0x6E0 to 0x6FF"), "{error}");
    for id in ["0x6E0", "0x6FF", "0x680", "0x101", "0x180", "0x7FF", "1"] {
        assert!(arguments(&format!("scan -i can0 --reply-id {id}")).is_ok(), "{id}");
    }
    for rate in ["1000", "666.6", "166.6", "66.6", "12.5", "10"] {
        assert!(arguments(&format!("set-bit-rate {MODULE} {rate}")).is_ok(), "{rate}");
    }
}

#[tokio::test(start_paused = true)]
async fn r_esd_055_a_reply_identifier_that_somebody_uses_is_refused_before_anything_is_sent() {
    for (bus, frame) in [
        ("esd-taken", "6E0#0102C1"),
        ("esd-taken-rtr", "6E0#R0"),
        ("esd-taken-ask", "700#0102001B06E0"),
        ("esd-taken-scan", "700#7F01FE0006E0"),
    ] {
        let mut world = World::with_module(bus).await;
        world.commands().await;
        let mut writer = virtual_bus::join(world.bus, world.clock).1;
        let other = tokio::spawn(async move {
            tokio::time::sleep(Duration::from_millis(100)).await;
            writer.send(&frame.parse().unwrap()).await.unwrap();
        });
        let error = world.run(&format!("suspend {MODULE}")).await.unwrap_err();
        assert_eq!(error.exit(), Exit::Io);
        assert!(error.to_string().contains("0x6E0"), "{error}");
        other.await.unwrap();
        let others: Vec<String> =
            world.commands().await.into_iter().filter(|command| command != frame).collect();
        assert_eq!(others, Vec::<String>::new());
    }
}

#[tokio::test(start_paused = true)]
async fn r_esd_053_a_module_that_is_not_there_is_asked_three_times() {
    let mut world = World::empty("esd-nobody");
    let error = world.run(&format!("show {MODULE}")).await.unwrap_err();
    assert_eq!(error.exit(), Exit::Refused);
    assert!(error.to_string().contains("0x1A does not answer"), "{error}");
    assert_eq!(world.commands().await, ["700#0000001A06E0"; 3]);
    let lines = world.run(&format!("scan {ON_BUS}")).await.unwrap();
    assert!(lines[0].contains("no module answers"), "{lines:?}");
}

/// A module that answers these questions, and no others.
fn answering(world: &World, answers: &'static [(&'static str, &'static str)]) -> tokio::task::JoinHandle<()> {
    let (mut heard, mut say) = virtual_bus::join(world.bus, world.clock);
    tokio::spawn(async move {
        while let Ok(event) = heard.recv().await {
            let BusEvent::Frame { frame, .. } = event else { continue };
            let asked = frame.to_string();
            if let Some((_, answer)) = answers.iter().find(|(question, _)| *question == asked) {
                say.send(&answer.parse().unwrap()).await.unwrap();
            }
        }
    })
}

#[tokio::test(start_paused = true)]
async fn r_esd_069_a_module_that_stops_answering_is_a_row_and_hides_no_other() {
    let world = World::with_module("esd-scan-gone").await;
    // A second one, 0x05: found when each number is asked, and silent from then on.
    let (mut heard, mut say) = virtual_bus::join(world.bus, world.clock);
    let module = tokio::spawn(async move {
        let mut answered = false;
        while let Ok(event) = heard.recv().await {
            if let BusEvent::Frame { frame, .. } = event
                && frame.to_string().starts_with("700#0")
                && frame.to_string().ends_with("000506E0")
                && !std::mem::replace(&mut answered, true)
            {
                let question = &frame.to_string()[4..8];
                say.send(&format!("6E0#{question}05").parse().unwrap()).await.unwrap();
            }
        }
    });
    let lines = world.run(&format!("scan {ON_BUS} --all")).await.unwrap();
    assert_eq!(lines.len(), 3, "{lines:?}");
    assert!(lines[1].starts_with("0x05 ") && lines[1].contains("no answer"), "{lines:?}");
    assert!(lines[2].starts_with("0x1A ") && lines[2].contains("CAN-CBM-SIO4"), "{lines:?}");
    module.abort();
}

#[tokio::test(start_paused = true)]
async fn a_module_that_does_not_tell_of_its_first_channel_is_shown_all_the_same() {
    let world = World::empty("esd-show-part");
    // Its type is a CAN-CBM-SIO4; of its channels it tells one identifier.
    let module =
        answering(&world, &[("700#0000001A06E0", "6E0#000031"), ("700#0201001A06E0", "6E0#02010105")]);
    let lines = world.run(&format!("show {MODULE}")).await.unwrap();
    assert!(lines.iter().any(|line| line.contains("CAN-CBM-SIO4")), "{lines:#?}");
    assert!(lines.iter().any(|line| line == "channel 5"), "{lines:#?}");
    assert!(lines.iter().any(|line| line == "  from the line     no answer"), "{lines:#?}");
    module.abort();
}
