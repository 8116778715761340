//! Holds the table in `src/lib.rs` against the code: which room imports which, and how large files are.

use std::collections::BTreeMap;
use std::fs;
use std::path::{Path, PathBuf};

/// What each room may import with `crate::`. A room always may import itself.
const MAY_IMPORT: &[(&str, &[&str])] = &[
    ("time", &[]),
    ("can", &["time"]),
    ("canopen", &["can::frame", "can::CanFrame", "can::CanId", "time"]),
    ("process_image", &["time", "canopen::NmtState"]),
    (
        "mapping",
        &[
            "process_image",
            "canopen::NodeId",
            "canopen::cob_id",
            "canopen::settings",
            "canopen::Role",
            "canopen",
            "can::BusIndex",
            "can::CanId",
        ],
    ),
    ("alarms", &["process_image", "time"]),
    ("gateway", &["can", "canopen", "process_image", "mapping", "alarms", "time"]),
    ("modbus", &["process_image", "mapping", "gateway::command", "time"]),
    ("mqtt", &["process_image", "mapping", "gateway::command", "time"]),
    ("web", &["process_image", "mapping", "gateway::command", "time"]),
    ("simulator", &["can", "canopen", "time"]),
    (
        "config",
        &[
            "can::interface",
            "mapping",
            "modbus::settings",
            "mqtt::settings",
            "web::settings",
            "process_image::Priority",
        ],
    ),
];

/// Lines of a source file, its tests apart, above which it must be split.
const LONGEST_FILE: usize = 600;

fn sources() -> Vec<PathBuf> {
    fn collect(folder: &Path, into: &mut Vec<PathBuf>) {
        for entry in fs::read_dir(folder).unwrap() {
            let path = entry.unwrap().path();
            if path.is_dir() {
                collect(&path, into);
            } else if path.extension().is_some_and(|extension| extension == "rs") {
                into.push(path);
            }
        }
    }
    let mut files = Vec::new();
    collect(&Path::new(env!("CARGO_MANIFEST_DIR")).join("src"), &mut files);
    files.sort();
    files
}

fn relative(path: &Path) -> String {
    path.strip_prefix(Path::new(env!("CARGO_MANIFEST_DIR")).join("src")).unwrap().display().to_string()
}

fn room(path: &Path) -> String {
    relative(path).split(['/', '.']).next().unwrap().to_owned()
}

/// The code of a file without its `mod tests`.
fn without_tests(text: &str) -> &str {
    text.find("#[cfg(test)]").map_or(text, |at| &text[..at])
}

/// `crate::a::b` paths of a text; `use crate::a::{b, c}` gives `a::b` and `a::c`.
fn crate_paths(text: &str) -> Vec<String> {
    let mut paths = Vec::new();
    for line in text.lines().filter(|line| !line.trim_start().starts_with("//")) {
        let mut rest = line;
        while let Some(at) = rest.find("crate::") {
            rest = &rest[at + "crate::".len()..];
            let path: String =
                rest.chars().take_while(|c| c.is_alphanumeric() || *c == '_' || *c == ':').collect();
            if let (Some(prefix), true) = (path.strip_suffix("::"), rest[path.len()..].starts_with('{')) {
                let group: String = rest[path.len() + 1..].chars().take_while(|c| *c != '}').collect();
                paths.extend(group.split(',').map(|item| format!("{prefix}::{}", item.trim())));
            } else {
                paths.push(path);
            }
        }
    }
    paths
}

#[test]
fn no_room_imports_what_it_may_not() {
    let allowed: BTreeMap<_, _> = MAY_IMPORT.iter().copied().collect();
    let mut wrong = Vec::new();
    for file in sources() {
        let room = room(&file);
        let Some(may) = allowed.get(room.as_str()) else { continue };
        for path in crate_paths(without_tests(&fs::read_to_string(&file).unwrap())) {
            let own = path == room || path.starts_with(&format!("{room}::"));
            let permitted =
                may.iter().any(|allowed| path == *allowed || path.starts_with(&format!("{allowed}::")));
            if !own && !permitted {
                wrong.push(format!("{}: crate::{path}", relative(&file)));
            }
        }
    }
    assert!(wrong.is_empty(), "imports that the table in src/lib.rs does not allow:\n{}", wrong.join("\n"));
}

#[test]
fn only_files_marked_io_touch_the_outside() {
    let exempt = ["time.rs", "process_image/handles.rs", "main.rs"];
    let outside = [
        "tokio::",
        "std::fs",
        "std::net",
        "std::thread",
        "socketcan::",
        "nix::",
        "rumqttc::",
        "axum::",
        "std::process",
    ];
    let mut wrong = Vec::new();
    for file in sources() {
        let name = relative(&file);
        let text = fs::read_to_string(&file).unwrap();
        let marked = text.lines().next().unwrap_or_default().contains("[IO]")
            || text.lines().next().unwrap_or_default().contains("\\[IO\\]");
        if marked
            || exempt.contains(&name.as_str())
            || name.starts_with("cli/")
            || name.starts_with("supervisor/")
        {
            continue;
        }
        let code = without_tests(&text);
        let found = code
            .lines()
            .filter(|line| !line.trim_start().starts_with("//"))
            .filter(|line| outside.iter().any(|word| line.contains(word)));
        wrong.extend(found.map(|line| format!("{name}: {}", line.trim())));
    }
    assert!(wrong.is_empty(), "files whose first line lacks [IO] touch the outside:\n{}", wrong.join("\n"));
}

#[test]
fn no_file_is_too_long_to_read() {
    let long: Vec<String> = sources()
        .iter()
        .filter_map(|file| {
            let lines = without_tests(&fs::read_to_string(file).unwrap()).lines().count();
            (lines > LONGEST_FILE).then(|| format!("{}: {lines} lines", relative(file)))
        })
        .collect();
    assert!(long.is_empty(), "split these (over {LONGEST_FILE} lines):\n{}", long.join("\n"));
}

#[test]
fn every_room_says_what_it_is() {
    for file in sources() {
        let text = fs::read_to_string(&file).unwrap();
        assert!(text.starts_with("//! "), "{} does not open with what it is", relative(&file));
    }
}
