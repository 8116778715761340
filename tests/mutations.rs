//! Random damage to configuration and mapping files: no panic, every error has its place, and what is taken in is taken in whole.

use std::collections::BTreeMap;

use cangate::config::{self, Loaded};
use cangate::mapping::{Diagnostic, Severity, SourceText, shipped};
use cangate::modbus::RegisterMap;
use cangate::modbus::writing::Writable;

use crate::allowed_frames::{DRIVE, EVERYTHING};
use crate::support::conversation::Conversation;

const NORTHBOUND: &str = "
[mqtt]
url = 'mqtts://broker:8883'
buffer_bytes = 2000000
[mqtt.tls]
ca_file = 'ca.pem'
[mqtt.home_assistant]
enabled = true
[mqtt.sparkplug]
enabled = true
group_id = 'works'
[modbus]
listen = ['127.0.0.1:5020']
allow = ['10.0.0.0/8']
reserved = ['10.0.0.5']
[[modbus.rtu]]
device = '/dev/ttyS0'
[modbus.security]
listen = ['127.0.0.1:8020']
cert_file = 'gateway.pem'
key_file = 'gateway.key'
client_ca_file = 'ca.pem'
roles = [{ name = 'Operator', rights = ['read'] }]
[cia309]
listen = '127.0.0.1:0'
[access.hmi]
role = 'operator'
modbus = ['10.0.0.7']
mqtt = true
write = ['drive/*']
";

/// Made by numbers that follow from one another, so that a failure can be repeated.
struct Random(u64);

impl Random {
    fn below(&mut self, limit: usize) -> usize {
        // SplitMix64.
        self.0 = self.0.wrapping_add(0x9E37_79B9_7F4A_7C15);
        let mut mixed = self.0;
        mixed = (mixed ^ (mixed >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
        mixed = (mixed ^ (mixed >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
        usize::try_from((mixed ^ (mixed >> 31)) % u64::try_from(limit.max(1)).unwrap()).unwrap()
    }

    fn pick<'a>(&mut self, of: &[&'a str]) -> &'a str {
        of[self.below(of.len())]
    }
}

/// What a hand or a broken disk does to a text.
fn damage(random: &mut Random, text: &str) -> String {
    let mut characters: Vec<char> = text.chars().collect();
    let mut lines: Vec<String> = text.lines().map(str::to_owned).collect();
    let (place, line) = (random.below(characters.len()), random.below(lines.len()));
    match random.below(12) {
        0 => characters.truncate(place),
        1 => drop(characters.remove(place)),
        2 => characters.insert(
            place,
            random
                .pick(&["=", "\"", "[", "]", "\n", "#", "'", "\0", "é", "{", ",", "."])
                .chars()
                .next()
                .unwrap(),
        ),
        3 => characters[place] = char::from(u8::try_from(random.below(128)).unwrap()),
        choice => {
            match choice {
                4 => drop(lines.remove(line)),
                5 => lines.insert(line, lines[random.below(lines.len())].clone()),
                6 => {
                    let other = random.below(lines.len());
                    lines.swap(line, other);
                }
                7 | 8 => {
                    let value = random.pick(&[
                        "0",
                        "-1",
                        "65535",
                        "65536",
                        "4294967296",
                        "9223372036854775807",
                        "1e400",
                        "nan",
                        "true",
                        "\"\"",
                        "\"x\"",
                        "[]",
                        "{}",
                        "[[]]",
                        "'\u{1F600}'",
                        "0x7FF",
                        "1979-05-27",
                        "\"${HOME}\"",
                        "\"../../etc/passwd\"",
                    ]);
                    if let Some((key, _)) = lines[line].split_once('=') {
                        lines[line] = format!("{key}= {value}");
                    }
                }
                9 => {
                    if let Some((key, value)) = lines[line].split_once('=') {
                        lines[line] = format!("{}x ={value}", key.trim_end());
                    }
                }
                10 => lines[line] = lines[line].to_uppercase(),
                _ => lines.truncate(line),
            }
            return lines.join("\n") + "\n";
        }
    }
    characters.into_iter().collect()
}

/// The files of an installation: its configuration and mappings, by their paths.
fn files() -> BTreeMap<String, String> {
    let mut files: BTreeMap<String, String> = ["danfoss-dst-p92c", "esd-can-cbm-sio1", "motortech-detcon"]
        .into_iter()
        .map(|name| (format!("etc/mappings/{name}.toml"), shipped(name).unwrap().to_owned()))
        .collect();
    files.insert("etc/cangate.toml".into(), format!("{EVERYTHING}{NORTHBOUND}"));
    files.insert("etc/./drive.toml".into(), DRIVE.into());
    files
}

fn load(files: &BTreeMap<String, String>) -> Result<Loaded, Vec<Diagnostic>> {
    let source = SourceText::new("etc/cangate.toml", &files["etc/cangate.toml"]);
    config::load(&source, [], &mut |path| {
        files.get(path).cloned().ok_or_else(|| std::io::ErrorKind::NotFound.into())
    })
}

/// So many as the full proof takes where somebody asks for them.
fn count() -> u64 {
    std::env::var("CANGATE_MUTATIONS").ok().and_then(|text| text.parse().ok()).unwrap_or(600)
}

#[test]
fn p28_damaged_files_panic_nowhere_every_error_has_its_place_and_nothing_is_taken_in_by_half() {
    let whole = files();
    let base = load(&whole).unwrap();
    let mut conversation = Conversation::new(base.table.clone());
    let names: Vec<&String> = whole.keys().collect();
    let (mut good, mut bad, mut taken) = (0_u64, 0_u64, 0_u64);
    for seed in 0..count() {
        let mut random = Random(seed);
        let name = if random.below(2) == 0 { "etc/cangate.toml" } else { names[random.below(names.len())] };
        let mut text = whole[name].clone();
        for _ in 0..=random.below(3) {
            if !text.is_empty() {
                text = damage(&mut random, &text);
            }
        }
        let mut damaged = whole.clone();
        damaged.insert(name.to_owned(), text);
        match load(&damaged) {
            Err(problems) => {
                bad += 1;
                assert!(problems.iter().any(|problem| problem.severity == Severity::Error), "seed {seed}");
                for problem in problems {
                    assert!(problem.line > 0 && problem.column > 0, "seed {seed}: {problem}");
                    assert!(
                        !problem.message.is_empty() && problem.file.starts_with("etc/"),
                        "seed {seed}: {problem}"
                    );
                }
            }
            Ok(loaded) => {
                good += 1;
                let topic = loaded.settings.mqtt.clone().unwrap_or_default().base_topic;
                let (modbus, writable) = (&loaded.settings.modbus, Writable::of(&loaded.access));
                let map = RegisterMap::build_for(&loaded.table, modbus, topic.as_str(), writable);
                assert!(map.is_ok(), "seed {seed}: {map:?}");
                if loaded.table != *conversation.table {
                    taken += 1;
                    conversation.exchange(loaded.table.clone());
                    conversation.run_to(conversation.now_millis() + 50);
                    assert_eq!(*conversation.table, loaded.table, "seed {seed}: all of it, or nothing");
                    let (table, image) = (&conversation.table, &conversation.image);
                    assert_eq!((image.tags.len(), image.nodes.len()), (table.tags.len(), table.nodes.len()));
                    assert_eq!(
                        (image.alarms.len(), image.buses.len()),
                        (table.alarms.len(), table.buses.len())
                    );
                    assert_eq!(image.lines.len(), table.lines.len());
                }
            }
        }
    }
    println!(
        "{} damaged files: {bad} refused, {good} still good, {taken} taken in by a running core",
        count()
    );
    assert!(bad > count() / 3 && good > 0 && taken > 0);
}
