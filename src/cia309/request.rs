//! What a line asks for.

use std::fmt;
use std::time::Duration;

use super::code::{Code, Refusal};
use super::format::Format;
use super::words::{Word, words};
use crate::gateway::command::{NmtRequest, ObjectId};

/// A line that asks for something.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Line {
    /// Chosen by the client; the answer carries it too. 0 where the line has none.
    pub sequence: u32,
    /// What is asked for, or why it is not understood.
    pub request: Result<Request, Refusal>,
}

/// What is asked for.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Request {
    /// `read`: an object of a node.
    Read {
        /// Of whom.
        target: Target,
        /// Which.
        object: ObjectId,
        /// How it is shown.
        format: Format,
    },
    /// `write`: an object of a node.
    Write {
        /// Of whom.
        target: Target,
        /// Which.
        object: ObjectId,
        /// Its bytes.
        data: Vec<u8>,
    },
    /// `start`, `stop`, `preoperational`, `reset node`, `reset communication`.
    Nmt {
        /// Who.
        target: Target,
        /// The command.
        request: NmtRequest,
    },
    /// `set network`: the network of later lines that name none.
    SetNetwork(u16),
    /// `set node`: the node of later lines that name none.
    SetNode {
        /// Its network, where the line says so; that becomes the default too.
        network: Option<u16>,
        /// It.
        node: u8,
    },
    /// `set sdo_timeout`: how long a node may take for an answer.
    SetSdoTimeout {
        /// Of which network; one time-out is kept for all.
        network: Option<u16>,
        /// So long.
        timeout: Duration,
    },
    /// `info version`.
    Version,
}

impl Request {
    /// Where it is to change something: its word in the journal, and what it asks for.
    #[must_use]
    pub fn command(&self) -> Option<(&'static str, String)> {
        match self {
            Self::Write { target, object, .. } => Some(("sdo_write", format!("{object}{target}"))),
            Self::Nmt { target, request } => Some(("nmt", format!("{request:?}{target}"))),
            Self::Read { .. }
            | Self::SetNetwork(_)
            | Self::SetNode { .. }
            | Self::SetSdoTimeout { .. }
            | Self::Version => None,
        }
    }
}

/// Whom a request is for, as far as the line says so.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Target {
    /// The number of the network.
    pub network: Option<u16>,
    /// The node id.
    pub node: Option<u8>,
}

impl fmt::Display for Target {
    /// ` of node 2 in network 1`, as far as it is said.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.node.map_or(Ok(()), |node| write!(f, " of node {node}"))?;
        self.network.map_or(Ok(()), |network| write!(f, " in network {network}"))
    }
}

/// SDO time-outs that are taken, in ms. A longer one would hold up everybody else who asks the same node.
const SDO_TIMEOUTS: std::ops::RangeInclusive<u64> = 10..=10_000;

/// Requests of the standard, or of other gateways, that this one does not serve.
const OTHERS: [&str; 17] = [
    "boot_up_indication",
    "disable",
    "enable",
    "init",
    "lss_switch_glob",
    "lss_switch_sel",
    "lss_set_node",
    "lss_conf_bitrate",
    "lss_activate_bitrate",
    "lss_store",
    "lss_inquire_addr",
    "lss_get_node",
    "lss_identity",
    "lss_ident_nonconf",
    "lss_allnodes",
    "_lss_fastscan",
    "_lss_slowscan",
];
/// The same of `set`.
const OTHER_SETTINGS: [&str; 8] =
    ["command_size", "command_timeout", "heartbeat", "id", "rpdo", "tpdo", "tpdox", "sdo_block"];

/// What a line asks for; `None` where it is empty or only a comment.
#[must_use]
pub fn parse(line: &[u8]) -> Option<Line> {
    let Ok(text) = std::str::from_utf8(line) else {
        return Some(Line { sequence: 0, request: Err(Code::Syntax.because("not UTF-8")) });
    };
    let text = text.trim_matches([' ', '\t', '\r']);
    if text.is_empty() || text.starts_with('#') {
        return None;
    }
    let (sequence, rest) = match sequence(text) {
        Ok(parts) => parts,
        Err(refusal) => return Some(Line { sequence: 0, request: Err(refusal) }),
    };
    let request = match words(rest) {
        Some(words) => command(&words),
        None => Err(Code::Syntax.because("a quote is not closed, or stands within a word")),
    };
    Some(Line { sequence, request })
}

/// The number in brackets at the beginning, and what follows it.
fn sequence(text: &str) -> Result<(u32, &str), Refusal> {
    let Some(inside) = text.strip_prefix('[') else { return Ok((0, text)) };
    let parts = inside.split_once(']').and_then(|(number, rest)| {
        let number = unsigned(number.trim_matches([' ', '\t']))?;
        Some((u32::try_from(number).ok()?, rest))
    });
    parts.ok_or_else(|| Code::Syntax.because("a line begins with a number in brackets, as [1]"))
}

/// A whole number: decimal, or hexadecimal after `0x`. One that begins with another zero is none: it is octal to some.
fn unsigned(text: &str) -> Option<u64> {
    let hexadecimal = text.strip_prefix("0x").or_else(|| text.strip_prefix("0X"));
    let (digits, radix) = hexadecimal.map_or((text, 10), |digits| (digits, 16));
    let plain = digits.bytes().all(|byte| byte.is_ascii_hexdigit());
    let octal = radix == 10 && digits.len() > 1 && digits.starts_with('0');
    if plain && !octal { u64::from_str_radix(digits, radix).ok() } else { None }
}

fn number<T: TryFrom<u64>>(word: &Word) -> Option<T> {
    match word {
        Word::Plain(text) => T::try_from(unsigned(text)?).ok(),
        Word::Quoted(_) => None,
    }
}

/// The numbers before the command, at most two, then the command.
fn command(words: &[Word]) -> Result<Request, Refusal> {
    let begins_with_digit = |word: &&Word| match word {
        Word::Plain(text) => text.starts_with(|letter: char| letter.is_ascii_digit()),
        Word::Quoted(_) => false,
    };
    let numbers = words.iter().take_while(begins_with_digit).count();
    let (numbers, rest) = words.split_at_checked(numbers).unwrap_or((words, &[]));
    let [verb, operands @ ..] = rest else {
        return Err(Code::Syntax
            .because("there is no command; known are read, write, start, stop, preop, reset, set and info"));
    };
    let prefix = Prefix::new(numbers)?;
    let nmt = |request| prefix.target().map(|target| Request::Nmt { target, request });
    match (verb.lower().as_str(), operands) {
        ("r" | "read", [what, ..]) if is_pdo(what) => Err(unserved("PDOs")),
        ("w" | "write", [what, ..]) if is_pdo(what) => Err(unserved("PDOs")),
        ("r" | "read", operands) => read(prefix.target()?, operands),
        ("w" | "write", operands) => write(prefix.target()?, operands),
        ("start", []) => nmt(NmtRequest::Start),
        ("stop", []) => nmt(NmtRequest::Stop),
        ("preop" | "preoperational", []) => nmt(NmtRequest::EnterPreOperational),
        ("reset", [what]) => match what.lower().as_str() {
            "node" => nmt(NmtRequest::ResetNode),
            "comm" | "communication" => nmt(NmtRequest::ResetCommunication),
            _ => Err(Code::Syntax.because("write `reset node` or `reset communication`")),
        },
        ("set", [what, operands @ ..]) => set(&prefix, &what.lower(), operands),
        ("info", [what]) if what.lower() == "version" => Ok(Request::Version),
        (other, _) if OTHERS.contains(&other) => Err(unserved(other)),
        ("start" | "stop" | "preop" | "preoperational", _) => Err(Code::Syntax.because("nothing may follow this command")),
        ("reset" | "set" | "info", _) => Err(Code::Syntax.because(
            "write `reset node`, `reset communication`, `set network`, `set node`, `set sdo_timeout` or `info version`",
        )),
        _ => Err(Code::Syntax.because("no such command; known are read, write, start, stop, preop, reset, set and info")),
    }
}

fn is_pdo(word: &Word) -> bool {
    matches!(word.lower().as_str(), "p" | "pdo")
}

fn unserved(what: &str) -> Refusal {
    Code::NotSupported.because(format!("this gateway does not serve {what}"))
}

/// The numbers before a command.
struct Prefix {
    numbers: [Option<u64>; 2],
}

impl Prefix {
    fn new(words: &[Word]) -> Result<Self, Refusal> {
        let number_of = |word: &Word| {
            number::<u64>(word)
                .ok_or_else(|| Code::Syntax.because(format!("`{}` is no number", printable(word.text()))))
        };
        let numbers = match words {
            [] => [None, None],
            [node] => [None, Some(number_of(node)?)],
            [network, node] => [Some(number_of(network)?), Some(number_of(node)?)],
            _ => return Err(Code::Syntax.because("before a command stand a network and a node at most")),
        };
        Ok(Self { numbers })
    }

    /// A single number is the node.
    fn target(&self) -> Result<Target, Refusal> {
        let [network, node] = self.numbers;
        let network = network.map(network_number).transpose()?;
        let node = node
            .map(|node| u8::try_from(node).map_err(|_| Code::UnknownNode.because("node ids are 1 to 127")));
        Ok(Target { network, node: node.transpose()? })
    }

    /// Before `set` a single number is the network.
    fn network(&self) -> Result<Option<u16>, Refusal> {
        match self.numbers {
            [Some(_), Some(_)] => Err(Code::Syntax.because("before `set` stands a network at most")),
            [None, number] | [number, None] => number.map(network_number).transpose(),
        }
    }
}

fn network_number(number: u64) -> Result<u16, Refusal> {
    u16::try_from(number).map_err(|_| Code::UnknownNetwork.because("there is no such network"))
}

/// What a client sent may go back to it, but no further than a few letters.
fn printable(text: &str) -> String {
    text.chars().filter(|letter| !letter.is_control()).take(32).collect()
}

fn object(index: &Word, sub: &Word) -> Result<ObjectId, Refusal> {
    let parts = number(index).zip(number(sub));
    let (index, sub) =
        parts.ok_or_else(|| Code::Syntax.because("an object is an index and a sub-index, as 0x1018 1"))?;
    Ok(ObjectId::new(index, sub))
}

fn format(word: &Word) -> Result<Format, Refusal> {
    Format::from_word(&word.lower()).ok_or_else(|| {
        let text = printable(word.text());
        Code::Syntax.because(format!(
            "`{text}` is no data type: b, i8 to i64, u8 to u64, x8 to x64, r32, r64, vs, os, us, d, t, td, hex"
        ))
    })
}

fn read(target: Target, operands: &[Word]) -> Result<Request, Refusal> {
    match operands {
        [index, sub] => Ok(Request::Read { target, object: object(index, sub)?, format: Format::Bytes }),
        [index, sub, word] => {
            Ok(Request::Read { target, object: object(index, sub)?, format: format(word)? })
        }
        _ => Err(Code::Syntax.because("write `read index sub-index [type]`, as read 0x1018 1 u32")),
    }
}

fn write(target: Target, operands: &[Word]) -> Result<Request, Refusal> {
    let [index, sub, word, value @ ..] = operands else {
        return Err(
            Code::Syntax.because("write `write index sub-index type value`, as write 0x1017 0 u16 500")
        );
    };
    let (object, format) = (object(index, sub)?, format(word)?);
    let data = format.read(value).ok_or_else(|| {
        Code::Syntax.because(format!("this is no value of the type {}", printable(word.text())))
    })?;
    Ok(Request::Write { target, object, data })
}

fn set(prefix: &Prefix, what: &str, operands: &[Word]) -> Result<Request, Refusal> {
    if OTHER_SETTINGS.contains(&what) {
        return Err(unserved(&format!("`set {what}`")));
    }
    let [value] = operands else {
        return Err(
            Code::Syntax.because("write `set network`, `set node` or `set sdo_timeout`, and one number")
        );
    };
    let value: u64 = number(value).ok_or_else(|| Code::Syntax.because("a number is missing"))?;
    let network = prefix.network()?;
    match what {
        "network" if network.is_some() => Err(Code::Syntax.because("nothing may stand before `set network`")),
        "network" => network_number(value).map(Request::SetNetwork),
        "node" => {
            let node = u8::try_from(value).map_err(|_| Code::UnknownNode.because("node ids are 1 to 127"))?;
            Ok(Request::SetNode { network, node })
        }
        "sdo_timeout" if SDO_TIMEOUTS.contains(&value) => {
            Ok(Request::SetSdoTimeout { network, timeout: Duration::from_millis(value) })
        }
        "sdo_timeout" => Err(Code::Syntax.because("the SDO time-out is 10 to 10000 ms")),
        _ => Err(Code::Syntax.because("only network, node and sdo_timeout can be set")),
    }
}
