//! Every requirement in `docs/requirements.md` has a test whose name cites it, on the side that it binds, or a reason
//! why not.

use std::collections::BTreeSet;
use std::fs;
use std::path::Path;

/// Names of the test functions of a source text: those with a test attribute, and without one that leaves them out.
pub fn tests_of(text: &str) -> BTreeSet<String> {
    let (mut is_test, mut is_left_out) = (false, false);
    let mut names = BTreeSet::new();
    for line in text.lines().map(str::trim_start).filter(|line| !line.starts_with("//")) {
        is_test |= line.starts_with("#[test]") || line.starts_with("#[tokio::test");
        is_left_out |= line.starts_with("#[ignore");
        let function = ["fn ", "async fn "].iter().find_map(|word| line.strip_prefix(word));
        if let Some(rest) = function {
            let name: String = rest.chars().take_while(|c| c.is_alphanumeric() || *c == '_').collect();
            if std::mem::take(&mut is_test) && !std::mem::take(&mut is_left_out) {
                names.insert(name);
            }
        }
    }
    names
}

/// Names of all tests under a folder.
fn test_names(folder: &Path, into: &mut BTreeSet<String>) {
    for entry in fs::read_dir(folder).unwrap() {
        let path = entry.unwrap().path();
        if path.is_dir() {
            test_names(&path, into);
        } else if path.extension().is_some_and(|extension| extension == "rs") {
            let text = fs::read_to_string(&path).unwrap();
            into.extend(tests_of(&text));
        }
    }
}

/// The requirement numbers that a test's name cites: `r_det_007`, `r_det_007_008`, `r_det_007_to_010`.
fn cited(name: &str) -> BTreeSet<u32> {
    let mut numbers = BTreeSet::new();
    for part in name.split("r_det_").skip(1) {
        let mut words = part.split('_').peekable();
        let mut last = None;
        while let Some(word) = words.next() {
            if word == "to" {
                let end = words.next().and_then(|end| end.parse::<u32>().ok());
                numbers.extend(last.zip(end).into_iter().flat_map(|(first, end)| first..=end));
                last = None;
            } else if word.len() == 3 && word.bytes().all(|byte| byte.is_ascii_digit()) {
                last = word.parse().ok();
                numbers.extend(last);
            } else if word != "and" {
                break;
            }
        }
    }
    numbers
}

#[test]
fn only_tests_that_run_are_a_proof() {
    let text = "
        /// Says how fn one_is_done.
        fn two_helper() {}
        #[test]
        #[should_panic]
        fn three_proof() { let text = \"fn four_text\"; }
        #[tokio::test(start_paused = true)]
        async fn five_proof() {}
        #[test]
        #[ignore = \"slow\"]
        fn six_left_out() {}
        fn seven_helper() {}
    ";
    assert_eq!(tests_of(text), ["three_proof", "five_proof"].map(str::to_owned).into());
}

#[test]
fn citations_are_read_from_names() {
    assert_eq!(cited("r_det_036_node_lost"), BTreeSet::from([36]));
    assert_eq!(cited("v_det_01_r_det_007_to_010_start"), BTreeSet::from([7, 8, 9, 10]));
    assert_eq!(cited("r_det_034_035_and_036_x_r_det_050"), BTreeSet::from([34, 35, 36, 50]));
    assert_eq!(cited("no_requirement"), BTreeSet::new());
}

#[test]
fn every_requirement_is_proved_or_says_why_not() {
    let root = Path::new(env!("CARGO_MANIFEST_DIR"));
    let collect = |folders: &[&str]| {
        let mut names = BTreeSet::new();
        for folder in folders {
            test_names(&root.join(folder), &mut names);
        }
        names.iter().flat_map(|name| cited(name)).collect::<BTreeSet<u32>>()
    };
    let device = collect(&["src/simulator"]);
    let gateway = {
        let rooms = [
            "src/can",
            "src/canopen",
            "src/mapping",
            "src/alarms",
            "src/gateway",
            "src/process_image",
            "src/config",
        ];
        let mut all = collect(&rooms);
        all.extend(collect(&["src/modbus", "src/mqtt", "src/web", "src/supervisor", "src/cli", "tests"]));
        all
    };
    let table = fs::read_to_string(root.join("docs/requirements.md")).unwrap();
    let mut unproved = Vec::new();
    let mut rows = 0;
    for row in table.lines().filter(|line| line.starts_with("| R-DET-")) {
        rows += 1;
        let cells: Vec<&str> = row.trim_matches('|').split('|').map(str::trim).collect();
        let number: u32 = cells[0].trim_start_matches("R-DET-").parse().unwrap();
        for (side, proved) in [("dev", &device), ("gw", &gateway)] {
            if cells[1].contains(side) && !proved.contains(&number) && cells[3].is_empty() {
                unproved.push(format!("{} ({side}): {}", cells[0], cells[2]));
            }
        }
    }
    assert_eq!(rows, 92, "a row of the table is gone");
    assert!(unproved.is_empty(), "no test cites these, and no reason is given:\n{}", unproved.join("\n"));
}
