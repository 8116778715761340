//! The documents against the program: alarms, keys of the configuration, commands, names of tests.

use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::path::Path;
use std::time::Duration;

use cangate::config;
use cangate::mapping::builtin::{OF_BUS, OF_GATEWAY, OF_NODE};
use cangate::mapping::{AlarmCondition, SourceText};
use cangate::process_image::Priority;
use clap::CommandFactory;

use crate::requirements::tests_of;

fn document(name: &str) -> String {
    fs::read_to_string(Path::new(env!("CARGO_MANIFEST_DIR")).join(name)).unwrap()
}

/// What a document says of an alarm: name, priority, delays, latch, text, action.
type Row = [String; 6];

fn row(name: &str, priority: Priority, delays: [Duration; 2], latch: bool, text: &str, action: &str) -> Row {
    // Alarms of an array and of the TPDOs have one row: `n` stands for the number.
    let general = |text: &str| {
        let words = text.replace("{}", "n");
        words
            .split(' ')
            .map(|word| if word.parse::<u32>().is_ok() { "n" } else { word })
            .collect::<Vec<_>>()
            .join(" ")
    };
    let name = name.replace("{}", "n");
    let stem = name.trim_end_matches(|letter: char| letter.is_ascii_digit());
    let name = if stem.ends_with('_') && stem != name { format!("{stem}n") } else { name };
    let [on, off] = delays.map(|delay| match delay.as_secs_f64() {
        0.0 => "0".to_owned(),
        seconds => format!("{seconds} s"),
    });
    let latch = if latch { "yes" } else { "" };
    // `bus_load_high` has a number that is no element's.
    let text = if text.contains('%') { text.to_owned() } else { general(text) };
    [
        format!("`{name}`"),
        priority.word().to_owned(),
        format!("{on} / {off}"),
        latch.to_owned(),
        text,
        general(action),
    ]
}

#[test]
fn every_alarm_has_its_row_and_every_row_its_alarm() {
    let mut expected = BTreeMap::new();
    for alarm in [OF_GATEWAY, OF_BUS, OF_NODE].concat() {
        let delays = [alarm.on_delay(), alarm.off_delay()];
        let row = row(alarm.name, alarm.priority, delays, alarm.latch, alarm.text, alarm.action);
        expected.insert(row[0].clone(), row);
    }
    let source = SourceText::new(
        "cangate.toml",
        "version = 1\n[bus.b]\ninterface = 'can0'\n[node.a]\nbus = 'b'\nid = 1\nmapping = 'motortech-detcon'\n",
    );
    let loaded = config::load(&source, [], &mut |_| Err(std::io::ErrorKind::NotFound.into())).unwrap();
    for alarm in &loaded.table.alarms {
        if matches!(alarm.condition, AlarmCondition::Tags(_)) {
            let delays = [alarm.on_delay, alarm.off_delay];
            let row = row(&alarm.name, alarm.priority, delays, alarm.latch, &alarm.text, &alarm.action);
            expected.insert(row[0].clone(), row);
        }
    }
    let written: BTreeMap<String, Row> = document("docs/alarms.md")
        .lines()
        .filter_map(|line| {
            let cells: Vec<String> = line
                .strip_prefix("| ")?
                .strip_suffix(" |")?
                .split(" | ")
                .map(|cell| cell.trim().to_owned())
                .collect();
            let row = Row::try_from(cells).ok()?;
            row[0].starts_with('`').then(|| (row[0].clone(), row))
        })
        .collect();
    assert_eq!(written.keys().collect::<Vec<_>>(), expected.keys().collect::<Vec<_>>());
    for (name, row) in &expected {
        assert_eq!(&written[name], row, "{name}");
    }
}

/// Names of the properties of a schema, those of its parts too.
fn properties(schema: &serde_json::Value, into: &mut BTreeSet<String>) {
    let parts = ["properties", "$defs"].into_iter().filter_map(|key| schema[key].as_object());
    for (name, part) in parts.flatten() {
        if schema["$defs"].get(name).is_none() {
            into.insert(name.clone());
        }
        properties(part, into);
    }
}

#[test]
fn every_key_of_the_configuration_is_in_its_page() {
    let mut keys = BTreeSet::new();
    properties(&config::schema(), &mut keys);
    assert!(keys.contains("guard_time_ms") && keys.contains("keep_alive_s"), "{keys:?}");
    let page = document("docs/configuration.md");
    let words: BTreeSet<&str> =
        page.split(|letter: char| !letter.is_alphanumeric() && letter != '_').collect();
    let missing: Vec<&String> = keys.iter().filter(|key| !words.contains(key.as_str())).collect();
    assert!(missing.is_empty(), "not in docs/configuration.md: {missing:?}");
}

#[test]
fn every_command_is_in_the_readme() {
    let readme = document("README.md");
    let list = readme.split("| command | does |").nth(1).unwrap().split("\n\n").next().unwrap();
    let missing: Vec<String> = cangate::cli::CommandLine::command()
        .get_subcommands()
        .map(|command| format!("`{}`", command.get_name()))
        .filter(|name| !list.contains(name.as_str()))
        .collect();
    assert!(missing.is_empty(), "not in the README's table of commands: {missing:?}");
}

/// Tests under a folder or file as `module::name`, as Cargo filters them.
fn test_paths(path: &Path, into: &mut Vec<String>) {
    if path.is_dir() {
        for entry in fs::read_dir(path).unwrap() {
            test_paths(&entry.unwrap().path(), into);
        }
    } else if path.extension().is_some_and(|extension| extension == "rs") {
        let root = Path::new(env!("CARGO_MANIFEST_DIR"));
        let module =
            path.strip_prefix(root).unwrap().with_extension("").display().to_string().replace('/', "::");
        into.extend(
            tests_of(&fs::read_to_string(path).unwrap()).iter().map(|name| format!("{module}::{name}")),
        );
    }
}

#[test]
fn every_test_that_the_testing_page_names_is_there() {
    let root = Path::new(env!("CARGO_MANIFEST_DIR"));
    let (mut vcan, mut all) = (Vec::new(), Vec::new());
    test_paths(&root.join("tests/vcan"), &mut vcan);
    for folder in ["src", "tests"] {
        test_paths(&root.join(folder), &mut all);
    }
    let page = document("docs/testing.md");
    let mut wrong = Vec::new();
    let mut checked = 0;
    for row in page.lines().filter(|line| line.starts_with("| ")) {
        for (mark, tests) in [("vcan `", &vcan), ("`cargo test ", &all)] {
            for rest in row.split(mark).skip(1) {
                let name = rest.split('`').next().unwrap();
                checked += 1;
                if !tests.iter().any(|test| test.contains(name)) {
                    wrong.push(format!("{mark}{name}`"));
                }
            }
        }
    }
    assert!(checked > 10, "the table of promises is gone");
    assert!(wrong.is_empty(), "no test has these names: {wrong:?}");
}
