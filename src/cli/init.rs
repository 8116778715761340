//! `cangate init`: a first configuration from what a scan found. \[IO\]

use std::fmt::Write as _;
use std::fs::OpenOptions;
use std::io::{self, Write as _};
use std::path::Path;

use super::Exit;
use super::output::{block_on, print_diagnostics, print_error, print_line, read_file};
use super::scan::survey;
use super::scan_report::{FoundNode, ScanReport, VERSION};
use super::tool_args::InitArguments;
use crate::can::BIT_RATES;
use crate::config;
use crate::mapping::{Diagnostic, SourceText, is_name};

/// Scans or reads findings, and writes the configuration.
pub(super) fn run(arguments: &InitArguments) -> Exit {
    // Better said before a scan than after it.
    if !arguments.force && arguments.output.exists() {
        print_error(&exists(&arguments.output));
        return Exit::Io;
    }
    if !is_name(&arguments.name) {
        print_error(&format!(
            "`{}` cannot be the name of a gateway: use 1 to 64 of a-z, 0-9, _ and -",
            arguments.name
        ));
        return Exit::Usage;
    }
    let report = match (&arguments.scan_file, &arguments.interface) {
        (Some(file), _) => read_file(file).and_then(|text| read_report(&text, file)),
        (None, Some(interface)) => {
            let mut found = Err(Exit::Io);
            let exit = block_on(async {
                found = survey(interface, arguments.options).await;
                found.as_ref().err().copied().unwrap_or(Exit::Ok)
            });
            if exit == Exit::Ok { found } else { Err(exit) }
        }
        (None, None) => Err(Exit::Usage),
    };
    match report {
        Ok(report) => write_configuration(&report, arguments),
        Err(exit) => exit,
    }
}

fn read_report(text: &str, file: &Path) -> Result<ScanReport, Exit> {
    let wrong = |reason: String| {
        let file = file.display();
        print_error(&format!("{file} is not what `cangate scan --format json` writes: {reason}"));
        Exit::Configuration
    };
    let report: ScanReport = serde_json::from_str(text).map_err(|error| wrong(error.to_string()))?;
    if report.version == VERSION {
        Ok(report)
    } else {
        Err(wrong(format!("it has version {}, this program reads {VERSION}", report.version)))
    }
}

fn write_configuration(report: &ScanReport, arguments: &InitArguments) -> Exit {
    let text = configuration(report, &arguments.name);
    match check(&text, &arguments.output.display().to_string()) {
        Ok(warnings) => print_diagnostics(&warnings),
        Err(problems) => {
            print_diagnostics(&problems);
            print_error("nothing was written: the findings make no good configuration");
            return Exit::Configuration;
        }
    }
    if let Err(error) = write(&arguments.output, &text, arguments.force) {
        print_error(&if error.kind() == io::ErrorKind::AlreadyExists {
            exists(&arguments.output)
        } else {
            format!("cannot write {}: {error}", arguments.output.display())
        });
        return Exit::Io;
    }
    let file = arguments.output.display();
    let nodes = report.nodes.iter().filter(|node| chosen(node).is_some()).count();
    print_line(&format!(
        "{file} is written, with {nodes} of {} nodes; read it, then `cangate run -c {file}`",
        report.nodes.iter().filter(|node| node.heard).count()
    ));
    Exit::Ok
}

fn exists(file: &Path) -> String {
    format!("{} is there already; give another file with -o, or overwrite it with --force", file.display())
}

/// The warnings of a configuration, or what is wrong with it. As at its place: mappings beside it go before those that come
/// with the program.
fn check(text: &str, file: &str) -> Result<Vec<Diagnostic>, Vec<Diagnostic>> {
    let source = SourceText::new(file, text);
    config::load(&source, [], &mut |path| std::fs::read_to_string(path)).map(|loaded| loaded.warnings)
}

fn write(file: &Path, text: &str, force: bool) -> io::Result<()> {
    let mut options = OpenOptions::new();
    options.write(true);
    // Somebody may have made the file while we scanned.
    let mut file =
        if force { options.create(true).truncate(true) } else { options.create_new(true) }.open(file)?;
    file.write_all(text.as_bytes())?;
    file.sync_all()
}

/// The mapping that a node gets without a person's look: the one that it names itself, else the only one that is probable, of
/// a node that nobody shares.
fn chosen(node: &FoundNode) -> Option<&str> {
    let alone = node.suspicions.is_empty() && node.heard;
    if let Some(certain) = node.mappings.iter().find(|found| found.certain && alone) {
        return Some(&certain.mapping);
    }
    let mut probable = node.mappings.iter().filter(|found| found.probable);
    match (probable.next(), probable.next()) {
        (Some(one), None) if alone => Some(&one.mapping),
        _ => None,
    }
}

/// The configuration for what was found.
pub(super) fn configuration(report: &ScanReport, name: &str) -> String {
    let bus = if is_name(&report.interface) { &report.interface } else { "bus1" };
    let mut text = format!(
        "# Written by `cangate init` from what was seen on {}. Read it through: what was only overheard is a proposal.\n\
         # Every key: docs/configuration.md. Check it with `cangate check`, look at its registers with `cangate map`.\n\n\
         version = 1\n\n[gateway]\nname = {}\n\n[bus.{bus}]\ninterface = {}\n",
        comment(&report.interface),
        quoted(name),
        quoted(&report.interface)
    );
    // Writing to a String cannot fail.
    if let Some(rate) = report.bit_rate.filter(|rate| BIT_RATES.contains(rate)) {
        let _ = writeln!(text, "bit_rate = {rate}");
    }
    if report.other_master {
        text.push_str(
            "# Another master commands or guards the nodes of this bus: this gateway only listens. Two masters would start\n\
             # and guard against each other; make it \"master\" when the other one is gone.\nrole = \"passive\"\n",
        );
    }
    for node in report.nodes.iter().filter(|node| node.heard) {
        text.push('\n');
        text.push_str(&section(node, bus));
    }
    text.push_str(
        "\n[modbus]\nlisten = [\"127.0.0.1:5020\"] # for others than this host: [\"0.0.0.0:502\"]\n\n\
         # [mqtt]\n# url = \"mqtt://127.0.0.1:1883\"\n",
    );
    text
}

/// A `[node.*]` table, in comments where a person has to decide.
fn section(node: &FoundNode, bus: &str) -> String {
    let mut text = String::new();
    let id = node.id;
    for suspicion in &node.suspicions {
        let _ = writeln!(
            text,
            "# Two devices may share node id {id}: {}. Give one another id first.",
            comment(suspicion)
        );
    }
    let identity = [
        node.name.as_ref().map(|name| format!("\"{}\"", comment(name))),
        node.device_type.map(|device_type| format!("device type 0x{device_type:08X}")),
        node.vendor.map(|vendor| format!("vendor 0x{vendor:X}")),
        node.product.map(|product| format!("product 0x{product:X}")),
        node.serial.map(|serial| format!("serial {serial}")),
    ];
    let identity: Vec<String> = identity.into_iter().flatten().collect();
    if !identity.is_empty() {
        let _ = writeln!(text, "# Node {id} says: {}.", identity.join(", "));
    }
    if let Some(mapping) = chosen(node) {
        let name = node_name(mapping, id);
        if let Some(kind) = node.tpdo1_type.filter(|kind| *kind <= 240) {
            let _ = writeln!(
                text,
                "# Its TPDO1 follows SYNC (transmission type {kind}), as shipped; the gateway sets it as the mapping says."
            );
        }
        let _ =
            writeln!(text, "[node.{name}]\nbus = {}\nid = {id}\nmapping = {}", quoted(bus), quoted(mapping));
        return text;
    }
    let fitting: Vec<&str> = node.mappings.iter().map(|found| found.mapping.as_str()).collect();
    let (mapping, why) = match fitting.as_slice() {
        [] => ("?".to_owned(), "no mapping fits: write one, mappings/README.md".to_owned()),
        [first, ..] => (comment(first), format!("not sure; it could be {}", comment(&fitting.join(", ")))),
    };
    let _ = writeln!(
        text,
        "# Node {id}: {why}.\n# [node.node-{id}]\n# bus = {}\n# id = {id}\n# mapping = {}",
        quoted(bus),
        quoted(&mapping)
    );
    text
}

/// `motortech-detcon` and 3 make `detcon-3`.
fn node_name(mapping: &str, id: u8) -> String {
    let device = mapping.split_once('-').map_or(mapping, |(_, device)| device);
    let name = format!("{device}-{id}");
    if is_name(&name) { name } else { format!("node-{id}") }
}

/// A TOML string on one line. TOML escapes as JSON does, and DEL as well.
fn quoted(text: &str) -> String {
    serde_json::Value::from(text).to_string().replace('\u{7F}', "\\u007F")
}

/// A text that stays within one comment.
fn comment(text: &str) -> String {
    text.chars().map(|character| if character.is_control() { ' ' } else { character }).collect()
}

#[cfg(test)]
mod tests {
    use super::super::scan_report::FoundMapping;
    use super::*;

    fn node(id: u8, mappings: &[(&str, bool)]) -> FoundNode {
        let text = format!(
            r#"{{"id": {id}, "heard": true, "state": "operational", "boot_ups": 0, "error_control": null, "heartbeat_ms": null,
            "guarded_ms": null, "guard_requests": 0, "tpdos": [], "rpdos": [], "emergencies": [], "sdo_requests": 0,
            "sdo_answers": 0, "device_type": null, "vendor": null, "product": null, "revision": null, "serial": null,
            "name": null, "mappings": [], "suspicions": []}}"#
        );
        let mut node: FoundNode = serde_json::from_str(&text).unwrap();
        node.mappings = mappings
            .iter()
            .map(|(mapping, probable)| FoundMapping {
                mapping: (*mapping).to_owned(),
                vendor: "Example".to_owned(),
                model: "P5".to_owned(),
                probable: *probable,
                certain: false,
            })
            .collect();
        node
    }

    fn report(nodes: Vec<FoundNode>) -> ScanReport {
        ScanReport {
            version: VERSION,
            interface: "can0".to_owned(),
            bit_rate: Some(125_000),
            active: false,
            frames: 100,
            lost_frames: 0,
            other_master: false,
            nodes,
            nmt: vec![],
            sync: None,
            time: None,
            lss_frames: 0,
            unknown: vec![],
            unknown_more: 0,
        }
    }

    fn load(text: &str) -> config::Loaded {
        let source = SourceText::new("nowhere/cangate.toml", text);
        config::load(&source, [], &mut |_| Err(io::ErrorKind::NotFound.into())).unwrap()
    }

    const DETCON: &[(&str, bool)] = &[("motortech-detcon", true)];

    #[test]
    fn nodes_that_are_known_get_their_mapping_and_the_file_loads() {
        let text = configuration(&report(vec![node(1, DETCON), node(3, DETCON)]), "hall-1");
        let loaded = load(&text);
        let names: Vec<&str> = loaded.table.nodes.iter().map(|node| node.name.as_str()).collect();
        assert_eq!(names, ["detcon-1", "detcon-3"]);
        assert_eq!(loaded.table.gateway, "hall-1");
        assert_eq!(loaded.table.buses[0].bit_rate, 125_000);
        assert_eq!(loaded.table.buses[0].role, crate::canopen::Role::Master);
        assert_eq!(loaded.warnings, []);
    }

    #[test]
    fn what_is_not_sure_is_written_as_a_comment() {
        let mut shared = node(4, DETCON);
        shared.suspicions = vec!["frames of different lengths on one TPDO identifier".to_owned()];
        let two = node(5, &[("motortech-detcon", true), ("other", true)]);
        let perhaps = node(6, &[("motortech-detcon", false)]);
        let mut silent = node(7, DETCON);
        silent.heard = false;
        let text = configuration(&report(vec![node(2, &[]), shared, two, perhaps, silent]), "hall-1");
        assert_eq!(load(&text).table.nodes.len(), 0, "{text}");
        assert!(text.contains("# Node 2: no mapping fits"), "{text}");
        assert!(text.contains("# Two devices may share node id 4"), "{text}");
        assert!(text.contains("# Node 5: not sure; it could be motortech-detcon, other."), "{text}");
        assert!(text.contains("# mapping = \"motortech-detcon\""), "{text}");
        assert!(!text.contains("id = 7"), "{text}");
    }

    #[test]
    fn beside_another_master_the_gateway_only_listens() {
        let text =
            configuration(&ScanReport { other_master: true, ..report(vec![node(1, DETCON)]) }, "hall-1");
        assert_eq!(load(&text).table.buses[0].role, crate::canopen::Role::Passive);
    }

    #[test]
    fn nothing_that_a_device_says_gets_out_of_its_comment() {
        let mut evil = node(1, DETCON);
        evil.name = Some("x\"\n[mqtt]\nurl = \"mqtt://evil\"".to_owned());
        evil.mappings[0].mapping = "a\"\n[http]".to_owned();
        let report =
            ScanReport { interface: "slcan:/dev/ttyACM0?bitrate=125000".to_owned(), ..report(vec![evil]) };
        let text = configuration(&report, "hall-1");
        assert!(
            text.lines().all(|line| !line.starts_with("[mqtt]") && !line.starts_with("[http]")),
            "{text}"
        );
        assert!(text.contains("[bus.bus1]"), "{text}");
    }

    #[test]
    fn a_file_that_is_there_is_overwritten_only_by_force() {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("cangate.toml");
        write(&file, "first, and longer", false).unwrap();
        assert_eq!(write(&file, "second", false).unwrap_err().kind(), io::ErrorKind::AlreadyExists);
        write(&file, "second", true).unwrap();
        assert_eq!(std::fs::read_to_string(&file).unwrap(), "second");
    }

    #[test]
    fn findings_that_make_no_good_configuration_are_told() {
        let text = configuration(&report(vec![node(1, &[("no-such-mapping", true)])]), "hall-1");
        let problems = check(&text, "nowhere/cangate.toml").unwrap_err();
        assert!(problems[0].to_string().contains("no-such-mapping"), "{problems:?}");
    }

    #[test]
    fn a_file_that_is_no_report_is_refused() {
        assert_eq!(read_report("{}", Path::new("scan.json")), Err(Exit::Configuration));
        let newer = serde_json::to_string(&ScanReport { version: 2, ..report(vec![]) }).unwrap();
        assert_eq!(read_report(&newer, Path::new("scan.json")), Err(Exit::Configuration));
        let good = serde_json::to_string(&report(vec![])).unwrap();
        assert_eq!(read_report(&good, Path::new("scan.json")), Ok(report(vec![])));
    }
}
