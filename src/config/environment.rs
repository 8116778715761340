//! Environment variables over the configuration file: `CANGATE__MQTT__URL` sets `url` in `[mqtt]`.
//!
//! Only the settings of the process can be set like this, not buses and nodes: their names are the user's, and a
//! variable's name cannot tell `pump-a` from `pump_a`. A list is written with commas between its items.

use serde::{Deserialize, Serialize};

use super::settings::{GatewaySettings, Settings};
use crate::mapping::suggest::closest;
use crate::mapping::{Diagnostic, SourceText};
use crate::modbus::settings::ModbusSettings;
use crate::mqtt::settings::MqttSettings;
use crate::web::settings::WebSettings;

/// With this begins the name of every variable that is meant for this program's settings.
pub const PREFIX: &str = "CANGATE__";

const SECTIONS: [&str; 4] = ["gateway", "modbus", "mqtt", "http"];

/// The part of the settings that variables can change.
#[derive(Clone, Debug, Serialize, Deserialize)]
struct Process {
    gateway: GatewaySettings,
    modbus: ModbusSettings,
    #[serde(skip_serializing_if = "Option::is_none")]
    mqtt: Option<MqttSettings>,
    http: WebSettings,
}

/// Lays the variables over the settings. Variables of other programs are left alone; one that begins with [`PREFIX`] and
/// means nothing is a problem.
pub fn overlay(
    settings: &mut Settings,
    variables: impl IntoIterator<Item = (String, String)>,
) -> Vec<Diagnostic> {
    let mut problems = Vec::new();
    for (name, value) in variables {
        let Some(path) = name.strip_prefix(PREFIX) else { continue };
        if let Err((message, hint)) = set(settings, path, &value) {
            let place = SourceText::new(format!("environment variable {name}"), "");
            problems.push(place.error(&(0..0), message, hint));
        }
    }
    problems
}

fn set(settings: &mut Settings, path: &str, value: &str) -> Result<(), (String, String)> {
    let path = path.to_ascii_lowercase();
    let Some((section, key)) = path.split_once("__").filter(|(_, key)| !key.is_empty()) else {
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
    let before = Process {
        gateway: settings.gateway.clone(),
        modbus: settings.modbus.clone(),
        mqtt: settings.mqtt.clone(),
        http: settings.http.clone(),
    };
    let place = format!("{section}.{key}");
    let text = config::Value::from(value);
    let list: Vec<&str> = value.split(',').map(str::trim).filter(|item| !item.is_empty()).collect();
    // A text for a list's key is refused as such; then it is meant as a list. The first message is the one to tell.
    let after = layered(&before, &place, text)
        .or_else(|error| layered(&before, &place, config::Value::from(list)).map_err(|_| error))
        .map_err(|error| {
            (error.to_string(), format!("it sets `{key}` in [{section}] of the configuration"))
        })?;
    settings.gateway = after.gateway;
    settings.modbus = after.modbus;
    settings.mqtt = after.mqtt;
    settings.http = after.http;
    Ok(())
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
        let owned = variables.iter().map(|(name, value)| ((*name).to_owned(), (*value).to_owned()));
        let problems = overlay(&mut settings, owned);
        (settings, problems.iter().map(ToString::to_string).collect())
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
            ("CANGATE__MODBUS__MAX_CONNECTIONS", "6.7", "6.7"),
            ("CANGATE__MODBUS__MAX_CONNECTIONS", "many", "many"),
            ("CANGATE__MQTT__URL", "http://broker", "is not a broker's address"),
        ] {
            let (_, problems) = with("[mqtt]\n", &[(name, value)]);
            assert_eq!(problems.len(), 1, "{name}={value}");
            assert!(
                problems[0].starts_with(&format!("environment variable {name}:1:1: error: ")),
                "{problems:?}"
            );
            assert!(problems[0].contains(says), "{problems:?}");
        }
    }
}
