//! How a CAN interface is written in configuration files and on the command line.
//!
//! | written | is |
//! |---|---|
//! | `can0` | a SocketCAN interface of this host |
//! | `virtual:demo` | a bus inside this process |
//! | `slcan:/dev/ttyACM0?bitrate=250000` | a LAWICEL adapter on a serial port |
//! | `slcan+tcp://192.168.1.7:3333` | the same, reached over TCP |

use std::fmt;
use std::str::FromStr;

use serde::{Deserialize, Serialize};

/// The bit rates of CANopen in bit/s (R-DET-089), which are those that a LAWICEL adapter knows, in the order of its
/// commands `S0` to `S8`.
pub const BIT_RATES: [u32; 9] =
    [10_000, 20_000, 50_000, 100_000, 125_000, 250_000, 500_000, 800_000, 1_000_000];

/// The bit rate, in bit/s, of a bus or of a serial adapter for which none is written (R-DET-089).
pub const DEFAULT_BIT_RATE: u32 = 125_000;

/// The speed, in baud, of a serial port for which none is written. Adapters on USB ignore it.
pub const DEFAULT_BAUD: u32 = 115_200;

/// The longest name of a network interface in Linux, in bytes (`IFNAMSIZ` less the final zero).
const LONGEST_NAME: usize = 15;

/// Where a bus is reached.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(try_from = "String", into = "String")]
pub enum Interface {
    /// A network interface of this host, by its name. Its bit rate is set by the host.
    SocketCan(String),
    /// A bus inside this process, by its name: all who open the same name hear each other.
    Virtual(String),
    /// A LAWICEL adapter on a serial port.
    Slcan {
        /// The device file.
        device: String,
        /// Bit rate of the CAN bus in bit/s, one of [`BIT_RATES`].
        bit_rate: u32,
        /// Speed of the serial port in baud.
        baud: u32,
    },
    /// A LAWICEL adapter behind a TCP port.
    SlcanTcp {
        /// Name or address, without the brackets of IPv6.
        host: String,
        /// TCP port, never 0.
        port: u16,
        /// Bit rate of the CAN bus in bit/s, one of [`BIT_RATES`]; `None` leaves what the adapter has.
        bit_rate: Option<u32>,
    },
}

impl fmt::Display for Interface {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::SocketCan(name) => f.write_str(name),
            Self::Virtual(name) => write!(f, "virtual:{name}"),
            Self::Slcan { device, bit_rate, baud } => {
                write!(f, "slcan:{device}?bitrate={bit_rate}")?;
                if *baud == DEFAULT_BAUD { Ok(()) } else { write!(f, "&baud={baud}") }
            }
            Self::SlcanTcp { host, port, bit_rate } => {
                if host.contains(':') {
                    write!(f, "slcan+tcp://[{host}]:{port}")?;
                } else {
                    write!(f, "slcan+tcp://{host}:{port}")?;
                }
                bit_rate.map_or(Ok(()), |rate| write!(f, "?bitrate={rate}"))
            }
        }
    }
}

/// Why a text names no interface.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error(
    "`{text}` is not a CAN interface: {reason}; write `can0`, `virtual:NAME`, `slcan:/dev/ttyACM0?bitrate=250000` \
     or `slcan+tcp://HOST:PORT`"
)]
pub struct ParseInterfaceError {
    text: String,
    reason: String,
}

impl FromStr for Interface {
    type Err = ParseInterfaceError;

    fn from_str(text: &str) -> Result<Self, Self::Err> {
        parse(text).map_err(|reason| ParseInterfaceError { text: text.to_owned(), reason })
    }
}

impl TryFrom<String> for Interface {
    type Error = ParseInterfaceError;

    fn try_from(text: String) -> Result<Self, Self::Error> {
        text.parse()
    }
}

impl From<Interface> for String {
    fn from(interface: Interface) -> Self {
        interface.to_string()
    }
}

impl schemars::JsonSchema for Interface {
    fn schema_name() -> std::borrow::Cow<'static, str> {
        "Interface".into()
    }

    fn json_schema(_: &mut schemars::SchemaGenerator) -> schemars::Schema {
        schemars::json_schema!({
            "type": "string",
            "description": "A CAN interface: the name of a SocketCAN interface, `virtual:NAME` for a bus inside \
                            the process, or a LAWICEL adapter on a serial port or behind TCP.",
            "minLength": 1,
            "examples": ["can0", "virtual:demo", "slcan:/dev/ttyACM0?bitrate=250000", "slcan+tcp://192.168.1.7:3333"]
        })
    }
}

fn parse(text: &str) -> Result<Interface, String> {
    if text.chars().any(|c| c.is_whitespace() || c.is_control()) {
        return Err("there is a blank in it".to_owned());
    }
    if let Some(address) = text.strip_prefix("slcan+tcp://") {
        return slcan_tcp(address);
    }
    match text.split_once(':') {
        None => Ok(Interface::SocketCan(checked_name(text)?)),
        Some(("virtual", name)) => Ok(Interface::Virtual(checked_name(name)?)),
        Some(("slcan", device)) => slcan(device),
        Some((scheme, _)) => Err(format!("`{scheme}:` is not a kind of interface known here")),
    }
}

/// The rules of the Linux kernel for the name of a network interface; virtual buses follow them too.
fn checked_name(name: &str) -> Result<String, String> {
    if name.is_empty() {
        return Err("the name is empty".to_owned());
    }
    if name.len() > LONGEST_NAME {
        return Err(format!("a name has at most {LONGEST_NAME} bytes and `{name}` has {}", name.len()));
    }
    if name.contains(['/', ':']) || name == "." || name == ".." {
        return Err("a name has no `/` or `:`, and is not `.` or `..`".to_owned());
    }
    Ok(name.to_owned())
}

fn slcan(text: &str) -> Result<Interface, String> {
    let (device, query) = split_query(text);
    if !device.starts_with('/') {
        return Err("after `slcan:` comes the path of a device such as `/dev/ttyACM0`".to_owned());
    }
    let options = options(query, &["bitrate", "baud"])?;
    Ok(Interface::Slcan {
        device: device.to_owned(),
        bit_rate: options.bit_rate.unwrap_or(DEFAULT_BIT_RATE),
        baud: options.baud.unwrap_or(DEFAULT_BAUD),
    })
}

fn slcan_tcp(text: &str) -> Result<Interface, String> {
    let (address, query) = split_query(text);
    let (host, port) =
        address.rsplit_once(':').ok_or("after `slcan+tcp://` comes HOST:PORT, and the port is missing")?;
    let host = match host.strip_prefix('[') {
        Some(inner) => inner.strip_suffix(']').ok_or("a `[` has no `]`")?,
        None if host.contains(':') => {
            return Err("an IPv6 address is written in brackets: `[::1]:3333`".to_owned());
        }
        None => host,
    };
    if host.is_empty() || host.contains(['/', '@', '[', ']']) {
        return Err("the host is a name or an address".to_owned());
    }
    let port = port.parse().ok().filter(|port| *port != 0).ok_or("a port is 1 to 65535")?;
    let options = options(query, &["bitrate"])?;
    Ok(Interface::SlcanTcp { host: host.to_owned(), port, bit_rate: options.bit_rate })
}

fn split_query(text: &str) -> (&str, Option<&str>) {
    text.split_once('?').map_or((text, None), |(path, query)| (path, Some(query)))
}

#[derive(Default)]
struct Options {
    bit_rate: Option<u32>,
    baud: Option<u32>,
}

fn options(query: Option<&str>, known: &[&str]) -> Result<Options, String> {
    let mut options = Options::default();
    for option in query.into_iter().flat_map(|query| query.split('&')) {
        let (key, value) = option.split_once('=').unwrap_or((option, ""));
        if !known.contains(&key) {
            return Err(format!("`{key}` is not an option here (known: {})", known.join(", ")));
        }
        let slot = if key == "bitrate" { &mut options.bit_rate } else { &mut options.baud };
        if slot.is_some() {
            return Err(format!("`{key}` is there twice"));
        }
        let number = value.parse().ok().filter(|number| *number > 0);
        let number = number.ok_or_else(|| format!("`{key}={value}` is not a positive number"))?;
        if key == "bitrate" && !BIT_RATES.contains(&number) {
            let known = BIT_RATES.map(|rate| rate.to_string()).join(", ");
            return Err(format!("no LAWICEL adapter has the bit rate {number} (it has {known})"));
        }
        *slot = Some(number);
    }
    Ok(options)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn read(text: &str) -> Interface {
        text.parse().unwrap()
    }

    #[test]
    fn each_kind_of_interface_is_read() {
        assert_eq!(read("can0"), Interface::SocketCan("can0".into()));
        assert_eq!(read("virtual:demo"), Interface::Virtual("demo".into()));
        assert_eq!(
            read("slcan:/dev/ttyACM0?bitrate=250000&baud=57600"),
            Interface::Slcan { device: "/dev/ttyACM0".into(), bit_rate: 250_000, baud: 57_600 }
        );
        assert_eq!(
            read("slcan+tcp://[fe80::1]:3333?bitrate=1000000"),
            Interface::SlcanTcp { host: "fe80::1".into(), port: 3333, bit_rate: Some(1_000_000) }
        );
    }

    #[test]
    fn r_det_089_r_dst_002_the_default_bit_rate_of_a_serial_adapter_is_125_kbit_per_second() {
        let Interface::Slcan { bit_rate, .. } = read("slcan:/dev/ttyACM0") else { panic!("not slcan") };
        assert_eq!(bit_rate, 125_000);
    }

    #[test]
    fn what_is_printed_reads_back_as_the_same() {
        for text in [
            "can0",
            "vcan0.100",
            "virtual:demo",
            "slcan:/dev/ttyACM0?bitrate=250000",
            "slcan:/dev/serial/by-id/usb-x:1?bitrate=10000&baud=57600",
            "slcan+tcp://adapter.plant:3333",
            "slcan+tcp://[::1]:1?bitrate=20000",
        ] {
            assert_eq!(read(text).to_string(), text);
        }
    }

    #[test]
    fn what_is_not_an_interface_is_refused_with_the_reason() {
        for (text, reason) in [
            ("", "empty"),
            ("virtual:", "empty"),
            ("sixteen-letters-", "at most 15"),
            ("förderbänder-öl", "has 18"),
            ("can/0", "no `/`"),
            ("..", "no `/`"),
            ("can 0", "blank"),
            ("can0\n", "blank"),
            ("socketcand:can0", "not a kind"),
            ("can0:1", "not a kind"),
            ("slcan:ttyACM0", "path of a device"),
            ("slcan:/dev/ttyACM0?bitrate=33333", "no LAWICEL adapter"),
            ("slcan:/dev/ttyACM0?bitrate=0", "positive number"),
            ("slcan:/dev/ttyACM0?bitrate=10000&bitrate=10000", "twice"),
            ("slcan:/dev/ttyACM0?speed=1", "not an option"),
            ("slcan+tcp://host", "port is missing"),
            ("slcan+tcp://host:0", "1 to 65535"),
            ("slcan+tcp://:3333", "host"),
            ("slcan+tcp://::1:3333", "brackets"),
            ("slcan+tcp://host:1?baud=9600", "not an option"),
        ] {
            let error = text.parse::<Interface>().unwrap_err().to_string();
            assert!(error.contains(reason), "{text}: {error}");
        }
    }

    #[test]
    fn files_hold_an_interface_as_a_string() {
        let interface: Interface = serde_json::from_str("\"virtual:demo\"").unwrap();
        assert_eq!(serde_json::to_string(&interface).unwrap(), "\"virtual:demo\"");
        let error = serde_json::from_str::<Interface>("\"a/b\"").unwrap_err().to_string();
        assert!(error.contains("not a CAN interface"), "{error}");
    }
}
