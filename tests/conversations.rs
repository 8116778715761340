//! The gateway core, with the shipped DetCon mapping, against scripted frames: the worked examples V-DET-01..19 and the
//! rules of the gateway for this device, as readers of the process image see them.
//!
//! The machines below have tests of their own; here it is proved that they are joined as they should be.

mod alarms;
mod commands;
mod guarding;
mod outages;
mod starting;
mod tpdos;

use std::ops::RangeInclusive;

use cangate::mapping::installation::{BusEntry, NodeEntry};
use cangate::mapping::{Encoding, Sketch, TagTable, codec};
use cangate::process_image::Value;

use crate::support::conversation::Conversation;

/// A table of DetCon nodes on one bus, with what the test changes.
pub fn table(nodes: &[(&str, u8)], change: impl Fn(&mut BusEntry, &mut NodeEntry)) -> TagTable {
    let mut bus = BusEntry::virtual_bus("can0");
    let mut sketch = Sketch::new();
    for (name, id) in nodes {
        sketch = sketch.node(name, *id, "motortech-detcon", |node| change(&mut bus, node));
    }
    sketch.bus(|entry| *entry = bus).build().unwrap().0
}

/// Node 1, with the changes of a test.
fn detcon_with(change: impl Fn(&mut BusEntry, &mut NodeEntry)) -> Conversation {
    Conversation::new(table(&[("engine1", 1)], change))
}

/// Node 1, everything as it is by default.
pub fn detcon() -> Conversation {
    detcon_with(|_, _| ())
}

const QUIET: [&str; 4] =
    ["181#0000000000000000", "281#0000000000000000", "381#0000FF0F000099CC", "481#000000000000"];

/// Lets node 1 be operational: it answers guarding and sends its TPDOs every 500 ms. Time: 1000 ms.
pub fn running(mut conversation: Conversation) -> Conversation {
    conversation.answer_guarding(1, 5);
    for frame in QUIET {
        conversation.send_cyclically(frame, 500);
    }
    conversation.run_to(1_000);
    conversation.forget_sent();
    conversation
}

/// Raw value and hundredths of a percent, as Modbus shows them (R-DET-048).
fn shown(conversation: &Conversation, tag: &str) -> (u64, u16) {
    let sample = conversation.tag(tag);
    let Value::Unsigned(raw) = sample.raw else { panic!("{tag}: {sample:?}") };
    let def = conversation.table.tag(conversation.tag_index(tag)).unwrap();
    let register = def.registers.iter().find(|register| register.encoding == Encoding::U16).unwrap();
    let usable = sample.quality.is_usable();
    let [x100, _] =
        codec::registers(register.encoding, register.resolution, sample.value, sample.raw, usable);
    (raw, x100)
}

/// Intensities of some channels, raw and in hundredths of a percent.
fn intensities(conversation: &Conversation, channels: RangeInclusive<u16>) -> Vec<(u64, u16)> {
    channels.map(|channel| shown(conversation, &format!("knock_intensity_{channel}"))).collect()
}

/// The channels of which a bool tag is true.
fn channels(conversation: &Conversation, tag: &str, among: RangeInclusive<u16>) -> Vec<u16> {
    among.filter(|channel| conversation.tag(&format!("{tag}_{channel}")).value.is_true()).collect()
}
