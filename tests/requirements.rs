//! Every requirement in `docs/requirements/` has a test whose name cites it, on each side that it binds, or a reason why
//! not; and the files that a row names hold such a test.

use std::collections::{BTreeMap, BTreeSet};
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

/// The tests of every source file, by its path from the root of the project.
fn tests_by_file(root: &Path, folder: &Path, into: &mut BTreeMap<String, BTreeSet<String>>) {
    for entry in fs::read_dir(folder).unwrap() {
        let path = entry.unwrap().path();
        if path.is_dir() {
            tests_by_file(root, &path, into);
        } else if path.extension().is_some_and(|extension| extension == "rs") {
            let file = path.strip_prefix(root).unwrap().to_str().unwrap().to_owned();
            into.insert(file, tests_of(&fs::read_to_string(&path).unwrap()));
        }
    }
}

/// The requirement numbers of a document that a test's name cites: `r_det_007`, `r_det_007_008`, `r_det_007_to_010`.
fn cited(document: &str, name: &str) -> BTreeSet<u32> {
    let mut numbers = BTreeSet::new();
    for part in name.split(&format!("r_{document}_")).skip(1) {
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

/// Who has to do what a requirement asks.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
enum Side {
    /// The simulated device.
    Device,
    Gateway,
}

impl Side {
    const ALL: [(Self, &str); 2] = [(Self::Device, "dev"), (Self::Gateway, "gw")];

    /// Tests of the simulator prove the device, all others the gateway.
    fn of(file: &str) -> Self {
        if file.starts_with("src/simulator/") { Self::Device } else { Self::Gateway }
    }
}

/// How a remark begins that says why there is no test.
const EXCUSE: &str = "no test: ";
/// How one begins that says which part of the requirement is missing, whatever tests there are.
const PARTLY: &str = "partly: ";

/// A line of a table.
#[derive(Debug)]
struct Row {
    number: u32,
    sides: Vec<Side>,
    /// What it asks, in a few words.
    title: String,
    /// Files whose tests show it; not all of them.
    shown_in: Vec<String>,
    /// Anything else; with [`EXCUSE`] at its begin the row needs no test.
    remark: String,
}

impl Row {
    /// `| R-DET-001 | dev, gw | title | files | remark |`.
    fn parse(document: &str, line: &str) -> Self {
        let cells: Vec<&str> = line.trim_matches('|').split('|').map(str::trim).collect();
        let [id, sides, title, shown_in, remark] = *cells.as_slice() else {
            panic!("not five columns: {line}")
        };
        let number = id.strip_prefix(&format!("R-{}-", document.to_uppercase())).unwrap();
        let side =
            |word: &str| Side::ALL.iter().find(|(_, own)| *own == word).unwrap_or_else(|| panic!("{line}"));
        Self {
            number: number.parse().unwrap(),
            sides: sides.split(", ").map(|word| side(word).0).collect(),
            title: title.to_owned(),
            shown_in: shown_in.split(", ").filter(|file| !file.is_empty()).map(file_of).collect(),
            remark: remark.to_owned(),
        }
    }
}

/// `` `canopen/nmt.rs` `` is below `src/`, `` `tests/eds.rs` `` is what it says.
fn file_of(cell: &str) -> String {
    let name = cell.trim_matches('`');
    if name.starts_with("tests/") { name.to_owned() } else { format!("src/{name}") }
}

/// What is wrong with a table, given the tests of every file.
fn faults(document: &str, table: &str, tests: &BTreeMap<String, BTreeSet<String>>) -> Vec<String> {
    let cites = |file: &String, number: u32| {
        tests.get(file).is_some_and(|names| names.iter().any(|name| cited(document, name).contains(&number)))
    };
    let id = format!("| R-{}-", document.to_uppercase());
    let mut faults = Vec::new();
    for (place, line) in table.lines().filter(|line| line.starts_with(&id)).enumerate() {
        let row = Row::parse(document, line);
        let Row { number, title, .. } = &row;
        if usize::try_from(*number).unwrap() != place + 1 {
            faults.push(format!("{number:03} does not follow the one before it"));
        }
        for (side, word) in Side::ALL.into_iter().filter(|(side, _)| row.sides.contains(side)) {
            let proved = tests.keys().any(|file| Side::of(file) == side && cites(file, *number));
            if !proved && !row.remark.starts_with(EXCUSE) {
                faults.push(format!("{number:03} ({word}) has no test, and no reason why not: {title}"));
            }
        }
        for file in row.shown_in.iter().filter(|file| !cites(file, *number)) {
            faults.push(format!("{number:03} is not cited by a test in {file}: {title}"));
        }
    }
    faults
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
    assert_eq!(cited("det", "r_det_036_node_lost"), BTreeSet::from([36]));
    assert_eq!(cited("det", "v_det_01_r_det_007_to_010_start"), BTreeSet::from([7, 8, 9, 10]));
    assert_eq!(cited("det", "r_det_034_035_and_036_x_r_det_050"), BTreeSet::from([34, 35, 36, 50]));
    assert_eq!(cited("det", "no_requirement"), BTreeSet::new());
}

#[test]
fn a_requirement_without_proof_on_each_of_its_sides_is_found() {
    let file =
        |name: &str, tests: &[&str]| (name.to_owned(), tests.iter().map(|test| (*test).to_owned()).collect());
    let tests = BTreeMap::from([
        file("src/simulator/slave.rs", &["r_sio_001_to_003_x", "r_det_004_x"]),
        file("src/canopen/nmt.rs", &["r_sio_002_x"]),
        file("tests/eds.rs", &["r_sio_004_x"]),
    ]);
    let table = "
        | R-DET-001 | gw | another document | | |
        | R-SIO-001 | dev, gw | gateway missing | `simulator/slave.rs` | |
        | R-SIO-002 | dev, gw | both | `simulator/slave.rs`, `canopen/nmt.rs` | |
        | R-SIO-003 | gw | a reason | | no test: left to the operator |
        | R-SIO-004 | dev | only of another document | `tests/eds.rs`, `canopen/nmt.rs` | |
        | R-SIO-006 | gw | a gap, and a remark that is no reason | | nice to have |
    ";
    let table = table.lines().map(str::trim).collect::<Vec<_>>().join("\n");
    assert_eq!(
        faults("sio", &table, &tests),
        [
            "001 (gw) has no test, and no reason why not: gateway missing",
            "004 (dev) has no test, and no reason why not: only of another document",
            "004 is not cited by a test in src/canopen/nmt.rs: only of another document",
            "006 does not follow the one before it",
            "006 (gw) has no test, and no reason why not: a gap, and a remark that is no reason",
        ]
    );
}

#[test]
fn every_requirement_is_proved_or_says_why_not() {
    let root = Path::new(env!("CARGO_MANIFEST_DIR"));
    let mut tests = BTreeMap::new();
    for folder in ["src", "tests"] {
        tests_by_file(root, &root.join(folder), &mut tests);
    }
    for (document, file, rows, partly) in
        [("det", "detcon.md", 92, 0), ("dst", "dst-p92c.md", 124, 0), ("esd", "esd-cbm.md", 134, 3)]
    {
        let table = fs::read_to_string(root.join("docs/requirements").join(file)).unwrap();
        let id = format!("| R-{}-", document.to_uppercase());
        let there = table.lines().filter(|line| line.starts_with(&id)).count();
        assert_eq!(there, rows, "{file}: a row is gone, or new");
        let rows = table.lines().filter(|line| line.starts_with(&id)).map(|line| Row::parse(document, line));
        let in_part = rows.filter(|row| row.remark.starts_with(PARTLY)).count();
        assert_eq!(in_part, partly, "{file}: what is shown in part is told in docs/requirements/README.md");
        let faults = faults(document, &table, &tests);
        assert!(faults.is_empty(), "{file}:\n{}", faults.join("\n"));
    }
}
