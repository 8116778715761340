//! Tables, right and wrong, against a small installation.

use super::*;
use crate::access::Deed;
use crate::mapping::{Sketch, reader};

const PUMP: &str = r#"
format = 1
device = { vendor = "test", model = "pump" }

[tpdo.1]
cob_id = "$NODEID+0x180"
length = 1
timeout_ms = 1500

[rpdo.1]
cob_id = "$NODEID+0x200"
length = 2

[[tag]]
name = "level"
tpdo = 1
bit = 0
type = "u8"

[[tag]]
name = "speed"
rpdo = 1
bit = 0
type = "u8"

[[tag]]
name = "run"
rpdo = 1
bit = 8
type = "bool"
"#;

/// A pump with two outputs, one that is sent none, and an engine that takes none.
fn table() -> TagTable {
    let sketch = Sketch::new().mapping(SourceText::new("pump", PUMP));
    let sketch = sketch.node("pump", 2, "pump", |node| node.outputs = At::nowhere(true));
    let sketch = sketch.node("silent", 3, "pump", |_| ());
    sketch.node("engine", 1, "motortech-detcon", |_| ()).build().unwrap().0
}

#[derive(Debug, serde::Deserialize)]
struct File {
    access: BTreeMap<At<String>, AccessEntry>,
}

fn build(text: &str) -> (Access, Vec<String>) {
    let source = SourceText::new("c.toml", text);
    let read = reader::read::<File>(&source);
    let mut problems: Vec<String> = read.problems.iter().map(ToString::to_string).collect();
    let entries = read.content.map(|file| file.access).unwrap_or_default();
    let (access, more) = Access::build(&source, &entries, &table());
    problems.extend(more.iter().map(ToString::to_string));
    (access, problems)
}

#[track_caller]
fn good(text: &str) -> Access {
    let (access, problems) = build(text);
    assert_eq!(problems, [""; 0]);
    access
}

fn name(grant: Option<&Arc<Grant>>) -> Option<&str> {
    grant.map(|grant| &**grant.name())
}

#[test]
fn a_client_is_who_its_address_its_role_or_its_broker_says() {
    let access = good(
        "[access.hmi]\nrole = 'operator'\nmodbus = ['10.0.0.5', '10.1.0.0/24']\nmodbus_role = 'panel'\n\
         [access.scada]\nrole = 'engineer'\nmqtt = true\ntoken_file = '/run/t'\n",
    );
    let of = |address: &str| name(access.of_address(address.parse().unwrap())).map(str::to_owned);
    assert_eq!(of("10.0.0.5").as_deref(), Some("hmi"));
    assert_eq!(of("::ffff:10.1.0.77").as_deref(), Some("hmi"));
    assert_eq!(of("10.0.0.6"), None);
    assert_eq!((name(access.of_role("panel")), name(access.of_role("Panel"))), (Some("hmi"), None));
    assert_eq!(name(access.of_broker()), Some("scada"));
    assert_eq!(
        access.tokens().map(|(grant, file)| (&**grant.name(), file)).collect::<Vec<_>>(),
        [("scada", "/run/t")]
    );
}

#[test]
fn s10_without_a_table_and_with_empty_lists_nobody_is_anybody() {
    let (access, problems) =
        build("[access.hmi]\nrole = 'operator'\nmodbus = []\nmqtt = false\nwrite = []\n");
    assert_eq!(problems.len(), 1, "{problems:?}");
    assert!(problems[0].starts_with("c.toml:1:9: warning: nobody is known as `hmi`"), "{problems:?}");
    for access in [Access::default(), access] {
        assert_eq!(access.of_address("10.0.0.5".parse().unwrap()), None);
        assert_eq!((access.of_broker(), access.of_role(""), access.tokens().count()), (None, None, 0));
    }
}

#[test]
fn tags_are_listed_one_by_one_or_all_that_can_be_written_of_a_node() {
    let access = good(
        "[access.one]\nrole = 'operator'\nmqtt = true\nwrite = ['pump/run']\n\
         [access.all]\nrole = 'engineer'\nmodbus_role = 'x'\nwrite = ['pump/*']\n",
    );
    let names = |place: usize| {
        let grant = access.grants().nth(place).unwrap();
        let table = table();
        grant.tags().map(|tag| table.tag(tag).unwrap().name.clone()).collect::<Vec<_>>()
    };
    assert_eq!((names(0), names(1)), (vec!["speed".to_owned(), "run".to_owned()], vec!["run".to_owned()]));
    let grant = access.of_broker().unwrap();
    assert!(grant.allows(Deed::Write(grant.tags().next().unwrap())).is_ok());
}

#[test]
fn what_two_tables_claim_is_told_with_both_places() {
    let (_, problems) = build(
        "[access.a]\nrole = 'viewer'\nmodbus = ['10.0.0.0/24']\nmodbus_role = 'x'\nmqtt = true\n\
         [access.b]\nrole = 'viewer'\nmodbus = ['10.0.0.5']\nmodbus_role = 'x'\nmqtt = true\n",
    );
    let begins = [
        "c.toml:8:11: error: a client of 10.0.0.5/32 is also in [access.a], at 3:11",
        "c.toml:9:15: error: the role `x` is also in [access.a], at 4:15",
        "c.toml:10:8: error: who comes through the broker is also in [access.a], at 5:8",
    ];
    assert_eq!(problems.len(), 3, "{problems:#?}");
    for (problem, begin) in problems.iter().zip(begins) {
        assert!(problem.starts_with(begin), "{problem}");
    }
}

#[test]
fn each_mistake_is_told_where_it_stands_with_a_hint() {
    for (text, place, message) in [
        ("[access.'a b']\nrole = 'viewer'\nmqtt = true", "1:9", "`a b` cannot be the name"),
        ("[access.'#']\nrole = 'viewer'\nmqtt = true", "1:9", "`#` cannot be the name"),
        ("[access.a]\nrole = 'admin'\nmqtt = true", "2:8", "unknown word `admin`"),
        ("[access.a]\nmqtt = true", "1:1", "`role`"),
        ("[access.a]\nrole = 'viewer'\nmqtt = true\nwrite = ['pump/run']", "4:10", "`a` is a viewer"),
        ("[access.a]\nrole = 'operator'\nmqtt = true\nwrite = ['run']", "4:10", "`run` names no tag"),
        ("[access.a]\nrole = 'operator'\nmqtt = true\nwrite = ['pmp/run']", "4:10", "there is no node `pmp`"),
        ("[access.a]\nrole = 'operator'\nmqtt = true\nwrite = ['pump/rum']", "4:10", "there is no tag `rum`"),
        ("[access.a]\nrole = 'operator'\nmqtt = true\nwrite = ['pump/level']", "4:10", "`pump/level` cannot"),
        ("[access.a]\nrole = 'operator'\npassword = 'plain text'", "3:12", "this is no Argon2id hash"),
        (
            "[access.a]\nrole = 'operator'\nmqtt = true\npassword = 17",
            "4:12",
            "this is no text in quotation marks",
        ),
        ("[access.a]\nrole = 'operator'\npassword_file = ''", "3:17", "this is empty"),
        (
            "[access.a]\nrole = 'operator'\nmqtt = true\nwrite = ['silent/run']",
            "4:10",
            "outputs are not enabled",
        ),
        ("[access.a]\nrole = 'operator'\nmqtt = true\nwrite = ['engine/*']", "4:10", "no tag of `engine`"),
        ("[access.a]\nrole = 'operator'\nmodbus = ['plant']\nmqtt = true", "3:10", "`plant` is no address"),
        ("[access.a]\nrole = 'operator'\ntoken_file = ''", "3:14", "this is empty"),
    ] {
        let (_, problems) = build(text);
        assert_eq!(problems.len(), 1, "{text}: {problems:?}");
        assert!(problems[0].starts_with(&format!("c.toml:{place}: error: ")), "{text}: {problems:?}");
        assert!(problems[0].contains(message), "{text}: {problems:?}");
    }
}

#[test]
fn a_password_stands_in_the_table_or_in_a_file_and_in_no_message() {
    let hash = "$argon2id$v=19$m=19456,t=2,p=1$c2FsdHNhbHRzYWx0$i1ZbHXvRKg4oGAMRmRf2WRWM3kLHSDBTbq4/jXrsxgI";
    let access = good(&format!(
        "[access.jo]\nrole = 'viewer'\npassword = '{hash}'\n\
         [access.maria]\nrole = 'operator'\npassword_file = '/run/maria'\n[access.scada]\nrole = 'viewer'\nmqtt = true\n"
    ));
    let passwords: Vec<_> =
        access.passwords().map(|(grant, place)| (&**grant.name(), place.clone())).collect();
    let here = PasswordPlace::Here(PasswordHash::parse(hash).unwrap());
    assert_eq!(passwords, [("jo", here), ("maria", PasswordPlace::File("/run/maria".into()))]);
    assert!(!format!("{access:?}").contains("argon2id"));
    let (_, problems) =
        build(&format!("[access.jo]\nrole = 'viewer'\npassword = '{hash}'\npassword_file = '/run/jo'\n"));
    assert_eq!(problems.len(), 1, "{problems:?}");
    assert!(problems[0].starts_with("c.toml:4:17: error: `password` is there too"), "{problems:?}");
    let (_, problems) = build("[access.jo]\nrole = 'viewer'\npassword = 'canary-canary'\n");
    assert!(!problems[0].contains("canary") && problems[0].contains("`cangate password`"), "{problems:?}");
}
