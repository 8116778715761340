//! The page on replacing a CAN-CBM-PLC/331: every command on it is run as it stands, in its order, on the EDS files of
//! `fixtures/plc331/eds`, and must say what the page says.

use std::path::Path;
use std::process::{Command, Stdio};

const PAGE: &str = include_str!("../docs/plc331.md");

/// A command of the page and what it says.
struct Step<'a> {
    command: &'a str,
    says: Vec<&'a str>,
}

fn steps(page: &str) -> Vec<Step<'_>> {
    let mut steps: Vec<Step<'_>> = Vec::new();
    let mut is_open = false;
    for line in page.lines() {
        let code = line.strip_prefix("    ");
        if let Some(command) = code.and_then(|code| code.strip_prefix("$ ")) {
            steps.push(Step { command, says: Vec::new() });
        } else if let (Some(code), true, Some(step)) = (code, is_open, steps.last_mut()) {
            step.says.push(code);
        }
        is_open = code.is_some_and(|code| is_open || code.starts_with("$ "));
    }
    steps
}

/// The configurations that the page tells of: the first, one with a device more, and that with a pinned device.
fn configurations(page: &str) -> [(&'static str, String); 3] {
    let blocks: Vec<&str> =
        page.split("```toml\n").skip(1).map(|rest| rest.split("```").next().unwrap()).collect();
    let [_, first, gates] = blocks.as_slice() else { panic!("{} blocks", blocks.len()) };
    let (before, tanks) = first.split_at(first.find("[node.tanks]").unwrap());
    let inserted = format!("{before}{gates}\n{tanks}");
    let pinned = format!("{before}{gates}\n{}", tanks.replace("offset = \"auto\"", "offset = 192"));
    assert_ne!(inserted, pinned);
    [("cangate.toml", (*first).to_owned()), ("inserted.toml", inserted), ("pinned.toml", pinned)]
}

#[test]
fn r_esd_110_118_119_121_124_125_the_commands_of_the_page_say_what_it_says() {
    let folder = tempfile::tempdir().unwrap();
    let eds = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/fixtures/plc331/eds");
    std::fs::create_dir(folder.path().join("eds")).unwrap();
    for entry in std::fs::read_dir(eds).unwrap() {
        let entry = entry.unwrap();
        std::fs::copy(entry.path(), folder.path().join("eds").join(entry.file_name())).unwrap();
    }
    for (name, text) in configurations(PAGE) {
        std::fs::write(folder.path().join(name), text).unwrap();
    }
    let program = Path::new(env!("CARGO_BIN_EXE_cangate")).parent().unwrap();
    let path = format!("{}:{}", program.display(), std::env::var("PATH").unwrap());
    let steps = steps(PAGE);
    assert!(steps.len() > 14, "{}", steps.len());
    for Step { command, says } in steps {
        let mut shell = Command::new("sh");
        shell.args(["-c", &format!("{{ {command}\n}} 2>&1")]).current_dir(folder.path()).stdin(Stdio::null());
        shell.env("PATH", &path).env("LC_ALL", "C").env_remove("CANGATE_LOG");
        let said = String::from_utf8(shell.output().unwrap().stdout).unwrap();
        assert_eq!(said.lines().collect::<Vec<_>>(), says, "{command}");
    }
}
