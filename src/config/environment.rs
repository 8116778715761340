//! Environment variables over the configuration file: `CANGATE__MQTT__URL` sets `url` in `[mqtt]`.
//!
//! Only the settings of the process can be set like this, not buses and nodes: their names are the user's, and a
//! variable's name cannot tell `pump-a` from `pump_a`. A list is written with commas between its items.

use std::collections::BTreeMap;
use std::ffi::OsString;

use serde::{Deserialize, Serialize};

use super::settings::{GatewaySettings, Settings};
use crate::cia309::settings::Cia309Settings;
use crate::mapping::Diagnostic;
use crate::mapping::suggest::closest;
use crate::modbus::settings::ModbusSettings;
use crate::mqtt::settings::MqttSettings;
use crate::web::settings::WebSettings;

/// With this begins the name of every variable that is meant for this program's settings.
pub const PREFIX: &str = "CANGATE__";

const SECTIONS: [&str; 5] = ["gateway", "modbus", "mqtt", "http", "cia309"];

/// The part of the settings that variables can change.
#[derive(Clone, Debug, Serialize, Deserialize)]
struct Process {
    gateway: GatewaySettings,
    modbus: ModbusSettings,
    #[serde(skip_serializing_if = "Option::is_none")]
    mqtt: Option<MqttSettings>,
    http: WebSettings,
    cia309: Cia309Settings,
}

/// What the environment did to the settings.
#[derive(Clone, Debug, Default)]
pub struct Overlay {
    /// Variables that mean nothing or say nothing that can be.
    pub problems: Vec<Diagnostic>,
    /// Table and key that a variable set, and its name: what is wrong with the value is to be told of the variable.
    set: BTreeMap<(String, String), String>,
}

impl Overlay {
    /// The variable that set a key, where one did.
    #[must_use]
    pub fn variable(&self, table: &str, key: &str) -> Option<&str> {
        self.set.get(&(table.to_owned(), key.to_owned())).map(String::as_str)
    }
}

/// What is wrong with a variable.
#[must_use]
pub fn problem(variable: &str, message: impl Into<String>, hint: impl Into<String>) -> Diagnostic {
    Diagnostic::without_place(format!("environment variable {variable}"), message, hint)
}

/// Lays the variables over the settings. Variables of other programs are left alone, whatever bytes they hold; one that
/// begins with [`PREFIX`] and means nothing is a problem.
pub fn overlay(
    settings: &mut Settings,
    variables: impl IntoIterator<Item = (OsString, OsString)>,
) -> Overlay {
    // In the order of their names: what comes out does not depend on who set the environment.
    let ours: BTreeMap<String, OsString> = variables
        .into_iter()
        .map(|(name, value)| (name.to_string_lossy().into_owned(), value))
        .filter(|(name, _)| name.starts_with(PREFIX))
        .collect();
    let path = |name: &str| name.strip_prefix(PREFIX).unwrap_or_default().to_ascii_lowercase();
    // Only an address makes a session: a stray keep-alive must not begin to publish to a broker that nobody named.
    let mqtt = settings.mqtt.is_some() || ours.keys().any(|name| path(name) == "mqtt__url");
    let mut overlay = Overlay::default();
    for (name, value) in ours {
        match set(settings, &path(&name), value, mqtt) {
            Ok(key) => {
                overlay.set.insert(key, name);
            }
            Err((message, hint)) => overlay.problems.push(problem(&name, message, hint)),
        }
    }
    overlay
}

/// Sets what a path names; gives the table and the key, or what is wrong and how to mend it.
fn set(
    settings: &mut Settings,
    path: &str,
    value: OsString,
    mqtt: bool,
) -> Result<(String, String), (String, String)> {
    let Some((section, key)) = path.split_once("__").filter(|(_, key)| is_key(key)) else {
        return Err((
            "this name does not name a setting".to_owned(),
            format!("write {PREFIX}SECTION__KEY, for example {PREFIX}MQTT__URL"),
        ));
    };
    if !SECTIONS.contains(&section) {
        let hint = match closest(section, SECTIONS) {
            Some(close) => format!("did you mean {PREFIX}{}__...?", close.to_ascii_uppercase()),
            None => format!("variables can set keys of {}; the rest stands in the file", SECTIONS.join(", ")),
        };
        return Err((format!("there is no [{section}] that a variable can set"), hint));
    }
    if section == "mqtt" && !mqtt {
        return Err((
            "there is no [mqtt] that it could change".to_owned(),
            format!("set {PREFIX}MQTT__URL too, or write an [mqtt] into the file"),
        ));
    }
    let value = value.into_string().map_err(|_secret| {
        // The value itself may be a secret in the wrong place.
        ("its value is not UTF-8".to_owned(), format!("it sets `{key}` in [{section}]"))
    })?;
    let before = Process {
        gateway: settings.gateway.clone(),
        modbus: settings.modbus.clone(),
        mqtt: settings.mqtt.clone(),
        http: settings.http.clone(),
        cia309: settings.cia309.clone(),
    };
    // A table within it is written as its part of the name: CANGATE__MQTT__TLS__CA_FILE.
    let place = format!("{section}.{}", key.replace("__", "."));
    let list: Vec<&str> = value.split(',').map(str::trim).filter(|item| !item.is_empty()).collect();
    // A text for a list's key is refused as such; then it is meant as a list. The first message is the one to tell.
    let after = layered(&before, &place, config::Value::from(value.as_str()))
        .or_else(|error| layered(&before, &place, config::Value::from(list)).map_err(|_| error))
        .map_err(|error| {
            (error.to_string(), format!("it sets `{key}` in [{section}] of the configuration"))
        })?;
    settings.gateway = after.gateway;
    settings.modbus = after.modbus;
    settings.mqtt = after.mqtt;
    settings.http = after.http;
    settings.cia309 = after.cia309;
    Ok((section.to_owned(), key.to_owned()))
}

fn is_key(text: &str) -> bool {
    !text.is_empty() && text.bytes().all(|byte| byte.is_ascii_alphanumeric() || byte == b'_')
}

fn layered(before: &Process, place: &str, value: config::Value) -> Result<Process, config::ConfigError> {
    config::Config::builder()
        .add_source(config::Config::try_from(before)?)
        .set_override(place, value)?
        .build()?
        .try_deserialize()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn settings(text: &str) -> Settings {
        toml::from_str(&format!("version = 1\n{text}")).unwrap()
    }

    fn with(text: &str, variables: &[(&str, &str)]) -> (Settings, Vec<String>) {
        let mut settings = settings(text);
        let problems =
            overlay(&mut settings, variables.iter().map(|(name, value)| (name.into(), value.into())));
        (settings, problems.problems.iter().map(ToString::to_string).collect())
    }

    #[test]
    fn a_variable_wins_over_the_file() {
        let (settings, problems) = with(
            "[mqtt]\nurl = 'mqtt://file'\nbase_topic = 'plant'\n",
            &[
                ("CANGATE__MQTT__URL", "mqtt://broker:1884"),
                ("CANGATE__MODBUS__LISTEN", "0.0.0.0:502, [::1]:5020"),
                ("CANGATE__MODBUS__MAX_CONNECTIONS", "8"),
                ("CANGATE__GATEWAY__NAME", "007"),
                ("CANGATE__HTTP__LISTEN", "0.0.0.0:80"),
                ("PATH", "/bin"),
                ("CANGATE_LOG", "debug"),
            ],
        );
        assert_eq!(problems, Vec::<String>::new());
        let mqtt = settings.mqtt.unwrap();
        assert_eq!(
            (mqtt.url.to_string().as_str(), mqtt.base_topic.as_str()),
            ("mqtt://broker:1884", "plant")
        );
        let listen: Vec<String> = settings.modbus.listen.iter().map(ToString::to_string).collect();
        assert_eq!(listen, ["0.0.0.0:502", "[::1]:5020"]);
        assert_eq!(settings.modbus.max_connections, 8);
        assert_eq!(settings.gateway.name, "007");
        assert_eq!(settings.http.listen.port(), 80);
    }

    #[test]
    fn a_variable_switches_mqtt_on() {
        let (settings, problems) = with("", &[("CANGATE__MQTT__URL", "mqtt://broker")]);
        assert_eq!(problems, Vec::<String>::new());
        assert_eq!(settings.mqtt.unwrap().url.to_string(), "mqtt://broker:1883");
    }

    #[test]
    fn a_key_of_a_table_within_is_set_by_its_parts() {
        let (settings, problems) = with(
            "",
            &[("CANGATE__MQTT__URL", "mqtts://broker"), ("CANGATE__MQTT__TLS__CA_FILE", "/run/Ca.pem")],
        );
        assert_eq!(problems, Vec::<String>::new());
        assert_eq!(settings.mqtt.unwrap().tls.ca_file.unwrap().to_str(), Some("/run/Ca.pem"));
    }

    #[test]
    fn a_key_of_a_table_in_a_table_has_one_more_step() {
        let (settings, problems) = with("[mqtt]\n", &[("CANGATE__MQTT__HOME_ASSISTANT__ENABLED", "true")]);
        assert_eq!(problems, [""; 0]);
        assert!(settings.mqtt.unwrap().home_assistant.enabled);
        let (_, problems) = with("[mqtt]\n", &[("CANGATE__MQTT__HOME_ASSISTANT__ENABLE", "true")]);
        assert!(problems[0].contains("unknown field `enable`"), "{problems:?}");
    }

    #[test]
    fn no_other_variable_switches_mqtt_on() {
        let (settings, problems) = with("", &[("CANGATE__MQTT__KEEP_ALIVE_S", "30")]);
        assert_eq!(settings.mqtt, None);
        assert_eq!(problems.len(), 1, "{problems:?}");
        assert!(
            problems[0].contains("KEEP_ALIVE_S") && problems[0].contains("CANGATE__MQTT__URL"),
            "{problems:?}"
        );

        let (settings, problems) =
            with("", &[("CANGATE__MQTT__KEEP_ALIVE_S", "30"), ("CANGATE__MQTT__URL", "mqtt://broker")]);
        assert_eq!(problems, Vec::<String>::new());
        assert_eq!(settings.mqtt.unwrap().keep_alive_s, 30);
        // Where the address is wrong, that is all there is to tell.
        let (_, problems) =
            with("", &[("CANGATE__MQTT__KEEP_ALIVE_S", "30"), ("CANGATE__MQTT__URL", "http://broker")]);
        assert_eq!(problems.len(), 1, "{problems:?}");
    }

    #[test]
    fn bytes_that_are_no_text_are_a_problem_in_our_variables_only() {
        use std::os::unix::ffi::OsStringExt;
        let bytes = |text: &[u8]| OsString::from_vec(text.to_vec());
        let variables = [
            (bytes(b"LESSOPEN"), bytes(b"\xFF")),
            (bytes(b"\xFF"), bytes(b"x")),
            (bytes(b"CANGATE__GATEWAY__NAME"), bytes(b"hall-\xE4")),
            (bytes(b"CANGATE__GATEWAY__\xFF"), bytes(b"x")),
        ];
        let mut settings = settings("");
        let overlay = overlay(&mut settings, variables);
        let texts: Vec<String> = overlay.problems.iter().map(ToString::to_string).collect();
        assert_eq!(texts.len(), 2, "{texts:?}");
        assert!(
            texts[0]
                .starts_with("environment variable CANGATE__GATEWAY__NAME: error: its value is not UTF-8"),
            "{texts:?}"
        );
        assert!(texts[1].contains("does not name a setting"), "{texts:?}");
        assert_eq!(settings.gateway.name, "cangate");
    }

    #[test]
    fn an_empty_list_is_a_list() {
        let (settings, problems) = with("", &[("CANGATE__MODBUS__LISTEN", "")]);
        assert_eq!(problems, Vec::<String>::new());
        assert!(settings.modbus.listen.is_empty());
    }

    #[test]
    fn a_variable_that_means_nothing_is_named() {
        for (name, value, says) in [
            ("CANGATE__MQTT__URI", "mqtt://broker", "unknown field `uri`"),
            ("CANGATE__MQQT__URL", "mqtt://broker", "did you mean CANGATE__MQTT__"),
            ("CANGATE__NODE__ENGINE1__ID", "3", "there is no [node] that a variable can set"),
            ("CANGATE__MQTT", "x", "does not name a setting"),
            ("CANGATE__MQTT__TLS.CA", "x", "does not name a setting"),
            ("CANGATE__MODBUS__MAX_CONNECTIONS", "6.7", "6.7"),
            ("CANGATE__MODBUS__MAX_CONNECTIONS", "many", "many"),
            ("CANGATE__MQTT__URL", "http://broker", "is not a broker's address"),
            ("CANGATE__MQTT__TLS__CA", "x", "unknown field `ca`"),
        ] {
            let (_, problems) = with("[mqtt]\n", &[(name, value)]);
            assert_eq!(problems.len(), 1, "{name}={value}");
            assert!(
                problems[0].starts_with(&format!("environment variable {name}: error: ")),
                "{problems:?}"
            );
            assert!(problems[0].contains(says), "{problems:?}");
        }
    }
}
