//! From the text of the configuration to checked settings and the tag table, or to everything that is wrong.

use std::collections::BTreeMap;
use std::ffi::OsString;
use std::io;
use std::path::Path;

use super::environment::{self, Overlay};
use super::listeners;
use super::settings::Settings;
use crate::access::Access;
use crate::can::interface::Interface;
use crate::mapping::{
    At, Diagnostic, Installation, Severity, SourceText, TagTable, build, is_name, locate, reader, shipped,
    sort_problems,
};
use crate::mqtt::settings::{MqttSettings, RESERVED_NODE_NAMES};
use crate::web::settings::KnownBy;

/// Version of the configuration that this program reads.
const VERSION: u64 = 1;

/// A configuration in which nothing is wrong.
#[derive(Clone, Debug)]
pub struct Loaded {
    /// The settings.
    pub settings: Settings,
    /// How each bus is reached, by [`BusIndex`](crate::can::BusIndex).
    pub interfaces: Vec<Interface>,
    /// Buses, nodes, tags and alarms.
    pub table: TagTable,
    /// Who may ask for what.
    pub access: Access,
    /// What works but is probably not meant.
    pub warnings: Vec<Diagnostic>,
}

/// Loads a configuration. `variables` are those of the environment; `read_file` is asked for mapping files.
///
/// A mapping is called by a path (with a `/`, or ending in `.toml`) relative to the configuration file, or by a name: then it
/// is `mappings/NAME.toml` beside the configuration file, or else the one that comes with the program.
pub fn load(
    source: &SourceText,
    variables: impl IntoIterator<Item = (OsString, OsString)>,
    read_file: &mut dyn FnMut(&str) -> io::Result<String>,
) -> Result<Loaded, Vec<Diagnostic>> {
    let read = reader::read::<Settings>(source);
    let mut problems = read.problems;
    let Some(mut settings) = read.content else { return Err(problems) };
    if settings.version.value != VERSION {
        let message = format!("version {} is not known to this program", settings.version.value);
        problems.push(source.error(&settings.version.span, message, format!("it reads version {VERSION}")));
    }
    let mut overlay = environment::overlay(&mut settings, variables);
    problems.append(&mut overlay.problems);
    problems.extend(check(source, &settings, &overlay));
    let (interfaces, wrong) = interfaces(source, &settings);
    problems.extend(wrong);
    problems.extend(listeners::check(source, &settings, &overlay, &interfaces));
    let mut lost = read.lost;
    let (mappings, wrong) = mappings(source, &settings, read_file, &mut lost);
    problems.extend(wrong);
    let listeners: Vec<_> =
        listeners::of(&settings).into_iter().map(|each| (each.at, each.owner.to_owned())).collect();
    let installation = Installation {
        gateway: &settings.gateway.name,
        gateway_unit_id: settings.modbus.gateway_unit_id,
        config: source,
        buses: &settings.bus,
        nodes: &settings.node,
        mappings: &mappings,
        listeners: &listeners,
        lost: &lost,
    };
    match build(&installation) {
        Ok((table, mut warnings)) if problems.is_empty() => {
            let (access, told) = Access::build(source, &settings.access, &table);
            let (wrong, told): (Vec<_>, _) =
                told.into_iter().partition(|each| each.severity == Severity::Error);
            if !wrong.is_empty() {
                return Err(sort_problems(wrong));
            }
            warnings.extend(told);
            if settings.node.is_empty() {
                let hint = "add a [node.NAME] with `bus`, `id` and `mapping`";
                warnings.push(source.warning(&(0..0), "there is no node, so there is nothing to show", hint));
            }
            warnings.extend(within_reach(source, &settings));
            warnings.extend(of_the_page(source, &settings));
            warnings.extend(without_broker(source, &settings));
            Ok(Loaded { settings, interfaces, table, access, warnings })
        }
        Ok((_, more)) | Err(more) => {
            problems.extend(more);
            Err(sort_problems(problems))
        }
    }
}

/// Lines that are to be written to by MQTT, which there is none of.
fn without_broker(source: &SourceText, settings: &Settings) -> Vec<Diagnostic> {
    let channels = settings.node.values().flat_map(|node| node.channel.values());
    let written = channels.map(|channel| &channel.mqtt_write);
    let written = written.filter(|write| write.value && settings.mqtt.is_none());
    let told = written.map(|at| {
        let message = "`mqtt_write` means nothing without [mqtt]";
        source.warning(&at.span, message, "add [mqtt] with the `url` of a broker, or leave it out")
    });
    told.collect()
}

/// What others than this host can do without a login.
fn within_reach(source: &SourceText, settings: &Settings) -> Vec<Diagnostic> {
    let objects = (["cia309", "listen"], settings.cia309.warning());
    let reference = (["modbus", "canopen_objects"], settings.modbus.warning());
    let password = (["mqtt", "password_file"], settings.mqtt.as_ref().and_then(MqttSettings::warning));
    let roles = (["modbus", "security"], settings.modbus.security.warning());
    let told = [reference, objects, password, roles].into_iter();
    told.filter_map(|(place, warning)| {
        let (message, hint) = warning?;
        Some(source.warning(&locate(source, &place), message, hint))
    })
    .collect()
}

/// Logins that others hear, and logins that get nowhere.
fn of_the_page(source: &SourceText, settings: &Settings) -> Vec<Diagnostic> {
    let entries = || settings.access.values();
    let known = KnownBy {
        token: entries().any(|entry| entry.token_file.is_some()),
        password: entries().any(|entry| entry.password.is_some() || entry.password_file.is_some()),
    };
    let told = settings.http.warnings(known).into_iter();
    told.map(|(key, message, hint)| source.warning(&locate(source, &["http", key]), message, hint)).collect()
}

/// What the rooms' settings say of themselves, and what only holds for several of them together.
fn check(source: &SourceText, settings: &Settings, overlay: &Overlay) -> Vec<Diagnostic> {
    let mut problems = Vec::new();
    // A value that a variable set is nowhere in the file.
    let mut tell = |table: &str, key: &str, message: String, hint: String| {
        problems.push(match overlay.variable(table, key) {
            Some(variable) => environment::problem(variable, message, hint),
            None => source.error(&locate(source, &[table, key]), message, hint),
        });
    };
    if !is_name(&settings.gateway.name) {
        let message = format!("`{}` cannot be the name of a gateway", settings.gateway.name);
        tell("gateway", "name", message, "use 1 to 64 of a-z, 0-9, _ and -".to_owned());
    }
    for problem in settings.modbus.problems() {
        let hint = format!("use {} to {}", problem.lowest, problem.highest);
        tell("modbus", problem.key, problem.to_string(), hint);
    }
    for (key, message, hint) in settings.mqtt.iter().flat_map(MqttSettings::problems) {
        tell("mqtt", key, message.to_string(), hint.to_string());
    }
    for (key, message, hint) in settings.cia309.problems() {
        tell("cia309", key, message, hint);
    }
    for (key, message, hint) in settings.modbus.security.problems() {
        problems.push(match overlay.variable("modbus", &format!("security__{key}")) {
            Some(variable) => environment::problem(variable, message, hint),
            None => source.error(&locate(source, &["modbus", "security", key]), message, hint),
        });
    }
    if let Some((key, message, hint)) = settings.http.tls.problem() {
        problems.push(match overlay.variable("http", &format!("tls__{key}")) {
            Some(variable) => environment::problem(variable, message, hint),
            None => source.error(&locate(source, &["http", "tls", key]), message, hint),
        });
    }
    for name in settings.node.keys().filter(|name| RESERVED_NODE_NAMES.contains(&name.value.as_str())) {
        let message = format!("`{}` cannot be the name of a node", name.value);
        problems.push(source.error(&name.span, message, "MQTT topics of the gateway itself have this name"));
    }
    problems
}

fn interfaces(source: &SourceText, settings: &Settings) -> (Vec<Interface>, Vec<Diagnostic>) {
    let mut interfaces: Vec<Interface> = Vec::new();
    let mut problems = Vec::new();
    for bus in settings.bus.values() {
        let At { value, span } = &bus.interface;
        match value.parse::<Interface>() {
            Ok(interface) => {
                if interfaces.contains(&interface) {
                    let message = format!("two buses use the interface `{value}`");
                    problems.push(source.error(span, message, "put the nodes of both under one [bus.NAME]"));
                }
                interfaces.push(interface);
            }
            Err(error) => {
                let hint = "for example can0, virtual:demo, slcan:/dev/ttyACM0 or slcan+tcp://host:3333";
                problems.push(source.error(span, error.to_string(), hint));
            }
        }
    }
    (interfaces, problems)
}

/// Where a mapping is looked for, beside the shipped ones.
#[must_use]
pub fn mapping_path(config: &str, mapping: &str) -> String {
    let folder = config.rsplit_once('/').map_or("", |(folder, _)| folder);
    let file = if is_path(mapping) { mapping.to_owned() } else { format!("mappings/{mapping}.toml") };
    if file.starts_with('/') || !config.contains('/') { file } else { format!("{folder}/{file}") }
}

fn is_path(mapping: &str) -> bool {
    mapping.contains('/') || Path::new(mapping).extension().is_some_and(|ending| ending == "toml")
}

fn mappings(
    source: &SourceText,
    settings: &Settings,
    read_file: &mut dyn FnMut(&str) -> io::Result<String>,
    lost: &mut Vec<String>,
) -> (BTreeMap<String, SourceText>, Vec<Diagnostic>) {
    let mut mappings = BTreeMap::new();
    let mut problems = Vec::new();
    for mapping in settings.node.values().map(|node| &node.mapping) {
        if mappings.contains_key(&mapping.value) || lost.contains(&mapping.value) {
            continue;
        }
        let path = mapping_path(&source.name, &mapping.value);
        match read_file(&path) {
            Ok(text) => {
                mappings.insert(mapping.value.clone(), SourceText::new(path, text));
            }
            // Then it is one of those that come with the program, or `build` tells that there is none.
            Err(error) if error.kind() == io::ErrorKind::NotFound && !is_path(&mapping.value) => {}
            Err(error) => {
                let message = format!("cannot read the mapping {path}: {error}");
                problems.push(source.error(&mapping.span, message, shipped_hint()));
                // What its nodes say of tags and alarms cannot be checked; that is nobody's mistake.
                lost.push(mapping.value.clone());
            }
        }
    }
    (mappings, problems)
}

fn shipped_hint() -> String {
    let names: Vec<&str> = shipped::SHIPPED.iter().map(|(name, _)| *name).collect();
    format!(
        "a path is relative to this file; without `/` and `.toml` these come with the program: {}",
        names.join(", ")
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    const TWO_ENGINES: &str = r#"
version = 1
[gateway]
name = "hall-1"
[bus.can0]
interface = "virtual:demo"
[node.engine1]
bus = "can0"
id = 1
mapping = "motortech-detcon"
[node.engine2]
bus = "can0"
id = 2
mapping = "motortech-detcon"
"#;

    fn read(text: &str, files: &[(&str, &str)]) -> Result<Loaded, Vec<String>> {
        let source = SourceText::new("etc/cangate.toml", text);
        let mut asked = |path: &str| {
            let found = files.iter().find(|(name, _)| *name == path);
            found.map(|(_, text)| (*text).to_owned()).ok_or_else(|| io::ErrorKind::NotFound.into())
        };
        load(&source, [], &mut asked).map_err(|problems| problems.iter().map(ToString::to_string).collect())
    }

    #[test]
    fn two_engines_on_one_bus() {
        let loaded = read(TWO_ENGINES, &[]).unwrap();
        assert_eq!(loaded.table.gateway, "hall-1");
        assert_eq!(loaded.table.nodes.len(), 2);
        assert_eq!(loaded.interfaces, [Interface::Virtual("demo".to_owned())]);
        assert!(loaded.settings.mqtt.is_none());
        assert_eq!(loaded.warnings, []);
    }

    #[test]
    fn what_other_hosts_can_do_is_warned_of_where_it_is_written() {
        let text = format!(
            "{TWO_ENGINES}[modbus]\nlisten = [\"0.0.0.0:5020\"]\ncanopen_objects = \"read\"\n\
             [cia309]\nlisten = \"0.0.0.0:60000\"\n"
        );
        let warnings = read(&text, &[]).unwrap().warnings;
        let warnings: Vec<String> = warnings.iter().map(ToString::to_string).collect();
        assert_eq!(warnings.len(), 2, "{warnings:#?}");
        let expected = [
            "etc/cangate.toml:17:19: warning: whoever reaches 0.0.0.0:5020 can read every object by",
            "etc/cangate.toml:19:10: warning: whoever reaches 0.0.0.0:60000 can read every object without",
        ];
        for (warning, begin) in warnings.iter().zip(expected) {
            assert!(warning.starts_with(begin), "{warning}");
        }
    }

    #[test]
    fn a_mapping_beside_the_configuration_goes_before_the_shipped_one() {
        let own = crate::mapping::shipped("motortech-detcon").unwrap().replace("\"DetCon\"", "\"DetCon+\"");
        let loaded = read(TWO_ENGINES, &[("etc/mappings/motortech-detcon.toml", &own)]).unwrap();
        assert_eq!(loaded.table.nodes[0].device.model, "DetCon+");
    }

    #[test]
    fn paths_of_mappings_are_relative_to_the_configuration() {
        assert_eq!(mapping_path("/etc/cangate/cangate.toml", "x"), "/etc/cangate/mappings/x.toml");
        assert_eq!(mapping_path("/etc/cangate/cangate.toml", "../x.toml"), "/etc/cangate/../x.toml");
        assert_eq!(mapping_path("/etc/cangate/cangate.toml", "/srv/x"), "/srv/x");
        assert_eq!(mapping_path("cangate.toml", "my.toml"), "my.toml");
        assert_eq!(mapping_path("/cangate.toml", "x"), "/mappings/x.toml");
    }

    #[test]
    fn a_mapping_that_cannot_be_read_is_told_once() {
        let text = TWO_ENGINES.replacen("\"motortech-detcon\"", "\"./own.toml\"", 1);
        let problems = read(&text, &[]).unwrap_err();
        assert_eq!(problems.len(), 1, "{problems:#?}");
        assert!(
            problems[0]
                .starts_with("etc/cangate.toml:10:11: error: cannot read the mapping etc/./own.toml: ")
        );
    }

    #[test]
    fn what_a_node_changes_of_a_mapping_that_cannot_be_read_is_no_mistake() {
        let text = TWO_ENGINES
            .replace("mapping = \"motortech-detcon\"", "mapping = \"./own.toml\"\nunit_id = 248")
            + "[node.engine2.tag.pressure]\ninvert = true\n[node.engine2.parameters]\nfull_scale = 10\n";
        let problems = read(&text, &[]).unwrap_err();
        let told = |part: &str| problems.iter().filter(|problem| problem.contains(part)).count();
        assert_eq!(told("cannot read the mapping"), 1, "{problems:#?}");
        assert_eq!(told("unit_id 248 is out of range"), 2, "the nodes themselves are checked: {problems:#?}");
        assert_eq!(problems.len(), 3, "{problems:#?}");
    }

    #[test]
    fn what_a_variable_says_is_not_blamed_on_the_file() {
        let text = format!("{TWO_ENGINES}[modbus]\nmax_connections = 8\n");
        let variables = [("CANGATE__GATEWAY__NAME", "Hall 1"), ("CANGATE__MODBUS__MAX_CONNECTIONS", "0")];
        let source = SourceText::new("etc/cangate.toml", text);
        let variables = variables.map(|(name, value)| (name.into(), value.into()));
        let problems = load(&source, variables, &mut |_| Err(io::ErrorKind::NotFound.into())).unwrap_err();
        let problems: Vec<String> = problems.iter().map(ToString::to_string).collect();
        assert_eq!(problems.len(), 2, "{problems:#?}");
        assert!(
            problems[0].starts_with("environment variable CANGATE__GATEWAY__NAME: error: `Hall 1` cannot")
        );
        assert!(problems[1].starts_with(
            "environment variable CANGATE__MODBUS__MAX_CONNECTIONS: error: `max_connections` is 0"
        ));
    }

    #[test]
    fn a_password_without_a_user_name_is_refused() {
        let text =
            |extra: &str| format!("{TWO_ENGINES}[mqtt]\npassword_file = \"/run/secrets/mqtt\"\n{extra}");
        let problems = read(&text(""), &[]).unwrap_err();
        assert_eq!(problems.len(), 1, "{problems:#?}");
        assert!(
            problems[0].starts_with("etc/cangate.toml:16:17: error: a password without a `username`"),
            "{problems:#?}"
        );
        assert!(problems[0].contains("add `username`"), "{problems:#?}");
        assert!(read(&text("username = \"gateway\"\n"), &[]).is_ok());
    }

    #[test]
    fn problems_of_all_parts_come_at_once_in_the_order_of_the_file() {
        let text = r#"
version = 2
colour = "red"
[gateway]
name = "Hall 1"
[bus.can0]
interface = "serial:1"
bit_rate = 300000
[node.bridge]
bus = "can1"
id = 200
mapping = "motortech-detcom"
[modbus]
max_connections = 0
"#;
        let problems = read(text, &[]).unwrap_err();
        let places: Vec<&str> = problems.iter().map(|text| text.split(": error: ").next().unwrap()).collect();
        assert_eq!(
            places,
            [
                "etc/cangate.toml:2:11",
                "etc/cangate.toml:3:1",
                "etc/cangate.toml:5:8",
                "etc/cangate.toml:7:13",
                "etc/cangate.toml:8:12",
                "etc/cangate.toml:9:7",
                "etc/cangate.toml:10:7",
                "etc/cangate.toml:11:6",
                "etc/cangate.toml:12:11",
                "etc/cangate.toml:14:19",
            ],
            "{problems:#?}"
        );
    }
}
