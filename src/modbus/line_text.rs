//! The last message of a serial line in registers: how many bytes it has, then the bytes, two in each register, the first
//! in the high byte, filled up with 0. All of it is of one message when it is read by one request.

use super::encoding::Cell;
use super::pdu::ExceptionCode;
use super::points::{Point, Table};
use crate::mapping::{Encoding, LineDef, NodeDef, OnLoss, TagTable};
use crate::process_image::{LineIndex, NodeIndex, ProcessImage};

/// The length where there is no message to show. No message is so long.
const NO_MESSAGE: u16 = 0xFFFF;

/// One of these registers.
#[derive(Clone, Copy, Debug)]
pub struct LineRegister {
    /// The line.
    line: LineIndex,
    /// The node of its module.
    node: NodeIndex,
    /// `None`: the length. Else the place among the registers of the text.
    place: Option<u16>,
    /// What is shown while the module is lost.
    on_loss: OnLoss,
    /// Where the last message would be shown, show none of its bytes.
    zero_on_bad: bool,
}

/// The lines of a node that are in the register map: address without offset, registers, and what each of them shows.
#[must_use]
pub fn of_node(table: &TagTable, index: NodeIndex, node: &NodeDef) -> Vec<(u16, Vec<LineRegister>, String)> {
    let lines = table.lines.iter().enumerate().filter(|(_, line)| line.node == index);
    let shown = lines.filter_map(|(place, line)| Some((LineIndex(place), line, line.text?)));
    let register = |line, place| LineRegister {
        line,
        node: index,
        place,
        on_loss: node.on_loss,
        zero_on_bad: node.zero_on_bad,
    };
    shown
        .map(|(line, def, text)| {
            let bytes = (1..text.registers).map(|at| register(line, Some(at - 1)));
            let owner = format!("serial line {} of node `{}`", def.number, node.name);
            (text.address, std::iter::once(register(line, None)).chain(bytes).collect(), owner)
        })
        .collect()
}

/// What a register shows now.
///
/// # Errors
/// 0B where there is no message to show and the node's `on_loss` is `exception`.
pub fn cell(image: &ProcessImage, register: &LineRegister) -> Result<Cell, ExceptionCode> {
    let online = image.node(register.node).is_some_and(|node| node.online);
    let newest = image.lines.get(register.line.0).and_then(|line| line.last_message());
    let bytes = newest.map(|message| message.bytes.as_slice());
    let bytes = match register.on_loss {
        OnLoss::Exception if !online || bytes.is_none() => return Err(ExceptionCode::GatewayTargetDevice),
        OnLoss::Hold if !online && register.zero_on_bad => bytes.map(|_| [].as_slice()),
        OnLoss::Invalid if !online => None,
        OnLoss::Exception | OnLoss::Hold | OnLoss::Invalid => bytes,
    };
    Ok(Cell::Word(match (register.place, bytes) {
        (None, None) => NO_MESSAGE,
        (None, Some(bytes)) => u16::try_from(bytes.len()).unwrap_or(NO_MESSAGE),
        (Some(place), bytes) => word(bytes.unwrap_or_default(), usize::from(place)),
    }))
}

/// Two bytes of a text.
fn word(bytes: &[u8], place: usize) -> u16 {
    let byte = |at: usize| bytes.get(at).copied().unwrap_or_default();
    u16::from_be_bytes([byte(place * 2), byte(place * 2 + 1)])
}

/// The points of a line: its length, and its text. `topic` is that of its node.
pub(super) fn points(blank: &Point, node: &NodeDef, line: &LineDef, topic: &str) -> Vec<Point> {
    let Some(text) = line.text else { return Vec::new() };
    let number = line.number;
    let channel = node.protocol.module().and_then(|module| module.channels.get(line.channel));
    let blank = Point {
        source: format!("serial line {number}"),
        cob_id: channel.map_or_else(String::new, |channel| format!("0x{}", channel.tx_id)),
        topic: if line.mqtt.publish { format!("{topic}/serial/{number}/rx") } else { String::new() },
        ..blank.clone()
    };
    let first = u32::from(node.offset) + u32::from(text.address);
    let length = Point {
        tag: format!("serial_{number}.length"),
        description: format!("Bytes of the last message of serial line {number}; 65535 = none"),
        ..blank.at(Table::InputRegister, first, Encoding::U16)
    };
    let text = Point {
        tag: format!("serial_{number}.text"),
        count: text.registers.saturating_sub(1),
        kind: "text".into(),
        description: format!(
            "The last message of serial line {number}, two bytes in each register, the first in the high byte"
        ),
        ..blank.at(Table::InputRegister, first + 1, Encoding::U16)
    };
    vec![length, text]
}
