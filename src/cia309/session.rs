//! What is remembered between the lines of one client; from a request to what is asked of the gateway, and back.

use std::sync::Arc;
use std::time::Duration;

use super::code::{Code, Refusal};
use super::format::{Format, WrongLength};
use super::request::{Line, Request, Target, parse};
use crate::canopen::object::DataType;
use crate::gateway::command::{Action, Outcome};
use crate::mapping::TagTable;
use crate::process_image::NodeIndex;

/// One client.
#[derive(Debug)]
pub struct Session {
    table: Arc<TagTable>,
    writes: bool,
    network: Option<u16>,
    node: Option<u8>,
    timeout: Option<Duration>,
}

/// What is to be done with a line.
#[derive(Clone, Debug, PartialEq)]
pub enum Step {
    /// Nothing: it was empty.
    Nothing,
    /// This is the answer, without the end of the line.
    Answer(String),
    /// This is the answer to a line that is not understood.
    NotUnderstood(String),
    /// This is the answer, and then the connection is to be closed: the line is no text. It could be the beginning of a hello
    /// of TLS, and what follows it lines of the choice of a web page.
    Last(String),
    /// The connection is to be closed: a browser is at the other end. A web page from anywhere can make the browser of somebody
    /// in the plant send lines of its choice here, in a request that begins with lines of HTTP.
    End,
    /// The gateway is to be asked; [`Asked::answer`] makes the answer of what comes of it.
    Ask(Action, Asked),
    /// This is the answer to a command that cannot be asked for, and what is to be told of it.
    Refused(String, Told),
}

/// A command that was refused.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Told {
    /// Its word in the journal.
    pub verb: &'static str,
    /// What was asked for, and why it was refused.
    pub text: String,
}

/// A line whose answer the gateway has to give.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Asked {
    sequence: u32,
    /// How what is read is to be shown.
    format: Format,
}

impl Session {
    /// A client that has said nothing yet. `writes`: it may write objects and send NMT commands.
    ///
    /// Where there is one bus, that is the network of lines that name none.
    #[must_use]
    pub fn new(table: Arc<TagTable>, writes: bool) -> Self {
        let network = (table.buses.len() == 1).then_some(1);
        Self { table, writes, network, node: None, timeout: None }
    }

    /// Takes a line, without its end.
    pub fn handle_line(&mut self, line: &[u8]) -> Step {
        if is_http(line) {
            return Step::End;
        }
        if !is_text(line) {
            let refusal = Code::Syntax
                .because("no text: a byte is not UTF-8, or a control character; the connection ends");
            return Step::Last(answer(0, &refusal.to_string()));
        }
        let Some(Line { sequence, request }) = parse(line) else { return Step::Nothing };
        let command = request.as_ref().ok().and_then(Request::command);
        let done = request.and_then(|request| self.request(request));
        match done {
            Ok(Ask::Done) => Step::Answer(answer(sequence, "OK")),
            Ok(Ask::Tell(text)) => Step::Answer(answer(sequence, &text)),
            Ok(Ask::Gateway(action, format)) => Step::Ask(action, Asked { sequence, format }),
            Err(refusal) => {
                let text = answer(sequence, &refusal.to_string());
                match command {
                    Some((verb, what)) => {
                        Step::Refused(text, Told { verb, text: format!("{what}: {}", refusal.text) })
                    }
                    None if refusal.code == Code::Syntax => Step::NotUnderstood(text),
                    None => Step::Answer(text),
                }
            }
        }
    }

    /// A line was too long to be taken.
    #[must_use]
    pub fn too_long(limit: usize) -> String {
        answer(0, &Code::TooLong.because(format!("a line has at most {limit} bytes")).to_string())
    }

    fn request(&mut self, request: Request) -> Result<Ask, Refusal> {
        match request {
            Request::Read { target, object, format } => {
                let (node, len) = (self.find(target)?, format.size());
                let action = Action::SdoRead { node, object, len, timeout: self.timeout };
                Ok(Ask::Gateway(action, format))
            }
            Request::Write { target, object, data } => {
                self.check_writes()?;
                let action =
                    Action::SdoWrite { node: self.find(target)?, object, data, timeout: self.timeout };
                Ok(Ask::Gateway(action, Format::Bytes))
            }
            Request::Nmt { target, request } => {
                self.check_writes()?;
                let action = Action::Nmt { node: self.find(target)?, request };
                Ok(Ask::Gateway(action, Format::Bytes))
            }
            Request::SetNetwork(network) => {
                self.network = Some(self.check_network(network)?);
                Ok(Ask::Done)
            }
            Request::SetNode { network, node } => {
                let network = network.map(|network| self.check_network(network)).transpose()?;
                if !(1..=127).contains(&node) {
                    return Err(Code::UnknownNode.because("node ids are 1 to 127"));
                }
                self.network = network.or(self.network);
                self.node = Some(node);
                Ok(Ask::Done)
            }
            Request::SetSdoTimeout { network, timeout } => {
                network.map(|network| self.check_network(network)).transpose()?;
                self.timeout = Some(timeout);
                Ok(Ask::Done)
            }
            Request::Version => Ok(Ask::Tell(version())),
        }
    }

    fn check_writes(&self) -> Result<(), Refusal> {
        let why = "writes and NMT commands are not enabled: `writes` in [cia309]";
        if self.writes { Ok(()) } else { Err(Code::NotSupported.because(why)) }
    }

    fn check_network(&self, network: u16) -> Result<u16, Refusal> {
        let known = (1..=self.table.buses.len()).contains(&usize::from(network));
        if known {
            return Ok(network);
        }
        let names = self.table.buses.iter().zip(1..).map(|(bus, number)| format!("{number} = {}", bus.name));
        Err(Code::UnknownNetwork.because(format!("networks: {}", names.collect::<Vec<_>>().join(", "))))
    }

    /// The node of a request.
    fn find(&self, target: Target) -> Result<NodeIndex, Refusal> {
        let id = target
            .node
            .or(self.node)
            .ok_or_else(|| Code::NoNode.because("name a node, or `set node` one"))?;
        let network = target
            .network
            .or(self.network)
            .ok_or_else(|| Code::NoNetwork.because("name a network, or `set network` one"))?;
        let bus = usize::from(self.check_network(network)?) - 1;
        let found = self.table.nodes.iter().position(|node| {
            node.bus.0 == bus && node.canopen().is_some_and(|settings| settings.id.get() == id)
        });
        found.map(NodeIndex).ok_or_else(|| {
            Code::UnknownNode.because(if id == 0 {
                "all nodes at once is not offered".to_owned()
            } else {
                format!("no node {id} is configured in network {network}")
            })
        })
    }
}

/// UTF-8, and no control character but those between words and at the end.
fn is_text(line: &[u8]) -> bool {
    let letter = |letter: char| !letter.is_control() || matches!(letter, '\t' | '\r');
    std::str::from_utf8(line).is_ok_and(|text| text.chars().all(letter))
}

/// The first line of an HTTP request: `POST / HTTP/1.1`.
fn is_http(line: &[u8]) -> bool {
    const VERSION: &[u8] = b" HTTP/";
    !line.starts_with(b"[") && line.windows(VERSION.len()).any(|part| part == VERSION)
}

enum Ask {
    Done,
    Tell(String),
    Gateway(Action, Format),
}

impl Asked {
    /// The answer that belongs to what came of it, without the end of the line.
    #[must_use]
    pub fn answer(self, outcome: &Outcome) -> String {
        let text = match outcome {
            Outcome::Done => "OK".to_owned(),
            Outcome::Read(bytes) => self.format.show(bytes).unwrap_or_else(|WrongLength| {
                let bytes =
                    DataType::OctetString.decode(bytes.get(..16).unwrap_or(bytes)).unwrap_or_default();
                Code::LENGTH
                    .because(format!("the object is of another type; it begins with {bytes}"))
                    .to_string()
            }),
            Outcome::Unknown
            | Outcome::Rejected(_)
            | Outcome::Forbidden(_)
            | Outcome::Busy
            | Outcome::NodeUnavailable
            | Outcome::Aborted(_)
            | Outcome::Timeout
            | Outcome::Failed(_) => refusal(outcome).to_string(),
        };
        answer(self.sequence, &text)
    }
}

fn refusal(outcome: &Outcome) -> Refusal {
    match outcome {
        Outcome::Aborted(code) => Code::Abort(code.0).because(code.name().unwrap_or_default()),
        Outcome::Timeout => Code::SDO_TIMEOUT.because("the node did not answer in time"),
        Outcome::Busy => {
            Code::State.because("too many requests wait already, or the node is being configured; try again")
        }
        Outcome::NodeUnavailable => {
            Code::State.because("the node cannot take it now: its bus is down, or it is stopped")
        }
        Outcome::Rejected(why) | Outcome::Forbidden(why) | Outcome::Failed(why) => {
            Code::State.because(why.replace(char::is_control, " "))
        }
        Outcome::Unknown => Code::UnknownNode.because(""),
        // Not refused at all; answered before.
        Outcome::Done | Outcome::Read(_) => Code::State.because(""),
    }
}

/// One line.
fn answer(sequence: u32, text: &str) -> String {
    format!("[{sequence}] {text}")
}

/// Vendor id, product code, revision, serial number, gateway class, version of the protocol, version of this program. The
/// gateway is no CANopen device and has no identity: those are 0. Class 1: objects of nodes can be read and written.
fn version() -> String {
    let program = [env!("CARGO_PKG_VERSION_MAJOR"), env!("CARGO_PKG_VERSION_MINOR")].join(".");
    format!("0 0 0.0 0 1 3.0 {program}")
}
