//! Addresses to listen on, and serial ports, that two parts of the gateway want to have.

// Addresses only; nothing here opens a socket.
use core::net::SocketAddr;

use super::environment::{self, Overlay};
use super::settings::Settings;
use crate::can::interface::Interface;
use crate::mapping::{Diagnostic, SourceText, locate, share_port};

/// Where the gateway listens.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Listener {
    /// The address.
    pub at: SocketAddr,
    /// Who listens there.
    pub owner: &'static str,
    /// The key of the configuration, with its tables.
    path: &'static [&'static str],
}

/// Where the gateway listens apart from serial lines of modules.
#[must_use]
pub fn of(settings: &Settings) -> Vec<Listener> {
    let listener =
        |owner, path: &'static [&'static str]| move |at: &SocketAddr| Listener { at: *at, owner, path };
    let modbus = &settings.modbus;
    let plain = modbus.listen.iter().map(listener("the Modbus server", &["modbus", "listen"]));
    let path = &["modbus", "security", "listen"];
    let secure = modbus.security.listen.iter().map(listener("Modbus/TCP Security", path));
    let http = [&settings.http.listen].into_iter().map(listener("the HTTP server", &["http", "listen"]));
    let cia309 = settings.cia309.listen.iter();
    let cia309 = cia309.map(listener("the CiA 309-3 gateway", &["cia309", "listen"]));
    plain.chain(secure).chain(http).chain(cia309).collect()
}

/// No two listen at one port, and no two use one serial port.
#[must_use]
pub fn check(
    source: &SourceText,
    settings: &Settings,
    overlay: &Overlay,
    interfaces: &[Interface],
) -> Vec<Diagnostic> {
    let places = Places { source, overlay };
    let mut problems = Vec::new();
    let listeners = of(settings);
    for (place, one) in listeners.iter().enumerate() {
        let before = listeners.iter().take(place);
        if let Some(other) = before.into_iter().find(|other| share_port(other.at, one.at)) {
            let message = format!("{} and {} listen at the same port", places.text(other), places.text(one));
            problems.push(places.problem(one.path, message, "give each of them a port of its own"));
        }
    }
    problems.extend(serial_ports(&places, settings, interfaces));
    problems
}

fn serial_ports(places: &Places<'_>, settings: &Settings, interfaces: &[Interface]) -> Vec<Diagnostic> {
    let path = &["modbus", "rtu"];
    let mut problems = Vec::new();
    let lines = &settings.modbus.rtu;
    for (place, line) in lines.iter().enumerate() {
        let (number, device) = (place + 1, line.device.display());
        let buses = settings.bus.iter().zip(interfaces);
        let bus = buses.into_iter().find(|(_, interface)| {
            matches!(interface, Interface::Slcan { device, .. } if line.device.as_os_str() == device.as_str())
        });
        if line.device.as_os_str().is_empty() {
            let message = format!("`device` of table {number} of [[modbus.rtu]] is empty");
            problems.push(places.problem(path, message, "name the serial port, for example \"/dev/ttyS0\""));
        } else if let Some(other) = lines.iter().take(place).position(|other| other.device == line.device) {
            let message =
                format!("tables {} and {number} of [[modbus.rtu]] use the same port, {device}", other + 1);
            problems.push(places.problem(path, message, "a line needs one table only"));
        } else if let Some(((name, entry), _)) = bus {
            let (at, _) = places.source.position(entry.interface.span.start);
            let message = format!(
                "table {number} of [[modbus.rtu]] and [bus.{}] (line {at}) use the same port, {device}",
                name.value
            );
            problems.push(places.problem(path, message, "give each of them a port of its own"));
        }
    }
    problems
}

/// Where keys stand.
struct Places<'a> {
    source: &'a SourceText,
    overlay: &'a Overlay,
}

impl Places<'_> {
    /// The variable that set a key, where one did.
    fn variable(&self, path: &[&str]) -> Option<&str> {
        let (table, key) = path.split_first()?;
        self.overlay.variable(table, &key.join("__"))
    }

    /// Who listens where, and which key says so.
    fn text(&self, listener: &Listener) -> String {
        let Listener { at, owner, path } = listener;
        let key = match (self.variable(path), path.split_last()) {
            (None, Some((key, tables))) => format!("`{key}` in [{}]", tables.join(".")),
            (variable, _) => variable.unwrap_or_default().to_owned(),
        };
        format!("{owner} ({at}, {key})")
    }

    fn problem(&self, path: &[&str], message: String, hint: &str) -> Diagnostic {
        match self.variable(path) {
            Some(variable) => environment::problem(variable, message, hint),
            None => self.source.error(&locate(self.source, path), message, hint),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn told(text: &str, variables: &[(&str, &str)]) -> Vec<String> {
        let source = SourceText::new("c.toml", format!("version = 1\n{text}"));
        let mut settings: Settings = toml::from_str(&source.text).unwrap();
        let variables = variables.iter().map(|(name, value)| (name.into(), value.into()));
        let overlay = environment::overlay(&mut settings, variables);
        let interfaces: Vec<Interface> =
            settings.bus.values().map(|bus| bus.interface.value.parse().unwrap()).collect();
        check(&source, &settings, &overlay, &interfaces).iter().map(ToString::to_string).collect()
    }

    #[test]
    fn two_that_listen_at_one_port_are_told_with_both_places() {
        let problems =
            told("[modbus]\nlisten = [\"127.0.0.1:5020\"]\n[http]\nlisten = \"0.0.0.0:5020\"\n", &[]);
        assert_eq!(problems.len(), 1, "{problems:?}");
        assert!(
            problems[0].starts_with(
                "c.toml:5:10: error: the Modbus server (127.0.0.1:5020, `listen` in [modbus]) and \
                 the HTTP server (0.0.0.0:5020, `listen` in [http]) listen at the same port"
            ),
            "{problems:?}"
        );
        // Nothing is said of HTTP, which listens all the same.
        let problems = told("[cia309]\nlisten = \"127.0.0.1:8080\"\n", &[]);
        assert!(
            problems[0].starts_with("c.toml:3:10: error: the HTTP server (127.0.0.1:8080"),
            "{problems:?}"
        );
        let security = "[modbus.security]\nlisten = [\"[::]:802\", \"10.0.0.1:802\"]\n";
        let problems = told(security, &[("CANGATE__MODBUS__LISTEN", "127.0.0.1:802")]);
        assert_eq!(problems.len(), 2, "{problems:?}");
        assert!(problems[0].contains("127.0.0.1:802, CANGATE__MODBUS__LISTEN)"), "{problems:?}");
        let problems = told("[modbus]\nlisten = [\"[::1]:1\", \"[::1]:1\"]\n", &[]);
        assert_eq!(problems.len(), 1, "{problems:?}");
    }

    #[test]
    fn other_ports_addresses_and_free_ports_are_no_matter() {
        for listen in [
            r#"["127.0.0.1:502", "127.0.0.2:502"]"#,
            r#"["0.0.0.0:502", "[::1]:502"]"#,
            r#"["127.0.0.1:0", "127.0.0.1:0", "0.0.0.0:0"]"#,
        ] {
            assert_eq!(told(&format!("[modbus]\nlisten = {listen}\n"), &[]), [""; 0], "{listen}");
        }
    }

    #[test]
    fn a_serial_port_is_named_and_used_once() {
        let line = |device: &str| format!("[[modbus.rtu]]\ndevice = \"{device}\"\n");
        assert_eq!(told(&(line("/dev/ttyS0") + &line("/dev/ttyS1")), &[]), [""; 0]);
        let bus = "[bus.can0]\ninterface = \"slcan:/dev/ttyACM0\"\n";
        let problems = told(
            &[bus, &line("/dev/ttyS0"), &line(""), &line("/dev/ttyS0"), &line("/dev/ttyACM0")].concat(),
            &[],
        );
        let says = [
            "`device` of table 2 of [[modbus.rtu]] is empty",
            "tables 1 and 3 of [[modbus.rtu]] use the same port, /dev/ttyS0",
            "table 4 of [[modbus.rtu]] and [bus.can0] (line 3) use the same port, /dev/ttyACM0",
        ];
        assert_eq!(problems.len(), 3, "{problems:?}");
        for (problem, says) in problems.iter().zip(says) {
            assert!(problem.starts_with("c.toml:") && problem.contains(says), "{problem}");
        }
    }
}
