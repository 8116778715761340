//! Holds the table in `src/lib.rs` against the code: which room imports which, and how large files are.

use std::collections::BTreeMap;
use std::fs;
use std::path::{Path, PathBuf};

/// What each room may import with `crate::`. A room always may import itself.
const MAY_IMPORT: &[(&str, &[&str])] = &[
    ("time", &[]),
    ("can", &["time"]),
    ("canopen", &["can::frame", "can::CanFrame", "can::CanId", "time"]),
    ("esd", &["can::frame", "can::CanFrame", "can::CanId", "time"]),
    ("process_image", &["time", "canopen::NmtState", "canopen::emcy"]),
    (
        "mapping",
        &[
            "process_image",
            "canopen::NodeId",
            "canopen::cob_id",
            "canopen::settings",
            "canopen::Role",
            "canopen",
            "esd",
            "can::BusIndex",
            "can::CanFrame",
            "can::CanId",
            "can::BIT_RATES",
            "can::DEFAULT_BIT_RATE",
            "slots::AllowList",
            "slots::Network",
        ],
    ),
    ("alarms", &["process_image", "time"]),
    ("access", &["process_image", "mapping", "slots::Network"]),
    ("gateway", &["can", "canopen", "esd", "process_image", "mapping", "alarms", "access", "time"]),
    ("base64", &[]),
    ("store", &["time"]),
    ("slots", &["time"]),
    ("tls", &["time"]),
    ("modbus", &["process_image", "mapping", "gateway::command", "slots", "tls", "time"]),
    ("mqtt", &["process_image", "mapping", "gateway::command", "base64", "store", "tls", "time"]),
    ("web", &["process_image", "mapping", "gateway::command", "slots", "tls", "time"]),
    (
        "cia309",
        &["process_image", "mapping", "gateway::command", "canopen::object", "base64", "slots", "time"],
    ),
    ("serial", &["process_image", "mapping", "gateway::command", "slots", "time"]),
    ("simulator", &["can", "canopen", "time"]),
    (
        "config",
        &[
            "access",
            "can::interface",
            "cia309::settings",
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

/// A file without its tests; nothing of a file that holds nothing else.
fn without_tests(file: &Path) -> String {
    if file.file_name().is_some_and(|name| name.to_string_lossy().ends_with("_tests.rs")) {
        return String::new();
    }
    cut_tests(&fs::read_to_string(file).unwrap())
}

/// A text without what stands under `#[cfg(test)]`: an item of one line, which ends in `;`, is left out; anything longer
/// stands last in its file, so the text ends there.
fn cut_tests(text: &str) -> String {
    let mut rest = String::new();
    let mut lines = text.lines();
    while let Some(line) = lines.next() {
        if line.trim() != "#[cfg(test)]" {
            rest.push_str(line);
            rest.push('\n');
        } else if !lines.find(|line| !line.trim().starts_with("#[")).is_some_and(|item| item.ends_with(';')) {
            break;
        }
    }
    rest
}

/// A text without its lines of comment.
fn without_comments(text: &str) -> String {
    text.lines()
        .filter(|line| !line.trim_start().starts_with("//"))
        .fold(String::new(), |code, line| code + line + "\n")
}

/// `crate::a::b` paths of a text; `use crate::a::{b, c::{d, e}}` gives `a::b`, `a::c::d` and `a::c::e`.
fn crate_paths(text: &str) -> Vec<String> {
    let mut paths = Vec::new();
    for rest in text.split("crate::").skip(1) {
        expand("", rest, &mut paths);
    }
    paths
}

/// Reads one path, or one group of paths, and gives what follows it.
fn expand<'a>(prefix: &str, text: &'a str, into: &mut Vec<String>) -> &'a str {
    let end = text.find(|c: char| !(c.is_alphanumeric() || c == '_' || c == ':')).unwrap_or(text.len());
    let path = format!("{prefix}{}", &text[..end]);
    let Some(mut rest) = text[end..].strip_prefix('{').filter(|_| path.ends_with("::")) else {
        let path = path.strip_suffix("::self").unwrap_or(&path);
        into.push(path.to_owned());
        return &text[end..];
    };
    loop {
        rest = rest.trim_start_matches(|c: char| c.is_whitespace() || c == ',');
        if let Some(after) = rest.strip_prefix('}') {
            return after;
        }
        let before = rest.len();
        rest = expand(&path, rest, into);
        if let Some(renamed) = rest.strip_prefix(" as ") {
            rest = renamed.trim_start_matches(|c: char| c.is_alphanumeric() || c == '_');
        }
        assert!(rest.len() < before, "not a group of paths: {rest}");
    }
}

#[test]
fn one_line_for_tests_hides_nothing_and_a_group_may_have_many_lines() {
    let text = "mod a;\n#[cfg(test)]\n#[path = \"b_tests.rs\"]\nmod b;\nuse crate::x::{\n    self, y,\n    z::{u, v as w},\n};\n\
                // crate::comment\nfn f() { crate::m::n(); }\n#[cfg(test)]\nmod tests {\n    use crate::hidden;\n}\n";
    assert_eq!(crate_paths(&without_comments(&cut_tests(text))), ["x", "x::y", "x::z::u", "x::z::v", "m::n"]);
}

#[test]
fn no_room_imports_what_it_may_not() {
    let allowed: BTreeMap<_, _> = MAY_IMPORT.iter().copied().collect();
    let mut wrong = Vec::new();
    for file in sources() {
        let room = room(&file);
        let Some(may) = allowed.get(room.as_str()) else { continue };
        for path in crate_paths(&without_comments(&without_tests(&file))) {
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
        "rumqttc5::",
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
        let code = without_comments(&without_tests(&file));
        let found = code.lines().filter(|line| outside.iter().any(|word| line.contains(word)));
        wrong.extend(found.map(|line| format!("{name}: {}", line.trim())));
    }
    assert!(wrong.is_empty(), "files whose first line lacks [IO] touch the outside:\n{}", wrong.join("\n"));
}

/// Limits, evictions and socket options of a TCP server are in one place. The page has its own listener, as axum wants it, and a
/// simulated serial line has one end.
#[test]
fn servers_listen_and_accept_through_slots() {
    let exempt =
        |name: &str| ["slots/", "web/", "simulator/serial_end.rs"].iter().any(|room| name.starts_with(room));
    let wrong: Vec<String> = sources()
        .iter()
        .filter(|file| !exempt(&relative(file)))
        .filter(|file| {
            let code = without_comments(&without_tests(file));
            ["TcpListener::bind", ".accept()"].iter().any(|word| code.contains(word))
        })
        .map(|file| relative(file))
        .collect();
    assert!(wrong.is_empty(), "servers beside `slots`: {wrong:?}");
}

/// Each frame is held against the list of those that are allowed: there is one place from which they go on.
#[test]
fn frames_leave_the_gateway_in_one_place() {
    let ways: Vec<String> = sources()
        .iter()
        .filter(|file| room(file) == "gateway")
        .flat_map(|file| {
            let code = without_comments(&without_tests(file));
            let found = code.matches("push_back(Output::Transmit").count();
            vec![relative(file); found]
        })
        .collect();
    assert_eq!(ways, ["gateway/bus.rs"]);
}

#[test]
fn no_file_is_too_long_to_read() {
    let long: Vec<String> = sources()
        .iter()
        .filter_map(|file| {
            let lines = without_tests(file).lines().count();
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
