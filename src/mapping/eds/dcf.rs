//! A DCF (CiA 306): an EDS with the values that a node is set to, its node id and its bit rate.

use std::collections::BTreeMap;
use std::fmt::Write as _;

use super::charset::decode;
use super::model::{DataType, Eds, ObjectId};
use super::report::{Place, Report};
use super::sections::{Kind, kind};
use crate::canopen::NodeSettings;
use crate::canopen::boot::{BootStep, MappingMode, PdoSetup};
use crate::mapping::Diagnostic;

/// The node that a DCF is written for.
#[derive(Clone, Copy, Debug)]
pub struct Commissioning<'a> {
    /// Its name in the configuration.
    pub name: &'a str,
    /// Name of its bus.
    pub network: &'a str,
    /// Bit rate of its bus in bit/s.
    pub bit_rate: u32,
    /// What it is set to, and its id.
    pub settings: &'a NodeSettings,
}

/// The objects that a gateway sets in a node before it starts it, with their bytes, little-endian: those that it would write
/// if the node had other values.
#[must_use]
pub fn configured(settings: &NodeSettings) -> BTreeMap<ObjectId, Vec<u8>> {
    let mut values = BTreeMap::new();
    for step in &settings.boot.steps {
        match step {
            BootStep::Write { object, data, .. } => {
                values.insert(*object, data.clone());
            }
            BootStep::Pdo(setup) => pdo(&mut values, 0x1800, setup),
            BootStep::Rpdo(setup) => pdo(&mut values, 0x1400, setup),
            BootStep::Identity { .. } | BootStep::Read { .. } | BootStep::Errors | BootStep::Save => {}
        }
    }
    values
}

/// The parameters of a PDO whose first communication object is `first`; its mapping stands 0x200 above.
fn pdo(values: &mut BTreeMap<ObjectId, Vec<u8>>, first: u16, setup: &PdoSetup) {
    if setup.mode != MappingMode::Write {
        return;
    }
    let communication = first.saturating_add(setup.number.saturating_sub(1));
    let parameters = [
        (2, setup.transmission_type.map(|number| vec![number])),
        (3, setup.inhibit_time.map(|number| number.to_le_bytes().to_vec())),
        (5, setup.event_timer.map(|number| number.to_le_bytes().to_vec())),
    ];
    for (sub, data) in parameters {
        values.extend(data.map(|data| (ObjectId::new(communication, sub), data)));
    }
    let mapping = communication.saturating_add(0x200);
    let count = u8::try_from(setup.maps.len()).unwrap_or(u8::MAX);
    values.insert(ObjectId::new(mapping, 0), vec![count]);
    for (sub, mapped) in (1..=count).zip(&setup.maps) {
        values.insert(ObjectId::new(mapping, sub), mapped.entry().to_le_bytes().to_vec());
    }
}

/// Writes the DCF of a node (R-ESD-125): the EDS as it is, line by line and in its own character set, with a `ParameterValue`
/// for everything that is [`configured`], and `[DeviceComissioning]`, spelled as the standard has it. `bytes` are those that
/// `eds` was read from, `file` is the name of the DCF. What the EDS does not describe is told and left out.
///
/// # Errors
/// The bytes are no text.
pub fn dcf(
    eds: &Eds,
    bytes: &[u8],
    file: &str,
    node: Commissioning<'_>,
) -> Result<(Vec<u8>, Vec<Diagnostic>), Vec<Diagnostic>> {
    let mut report = Report::new(eds.file.clone());
    let text = decode(bytes).map_err(|wrong| {
        report.error(wrong.place, wrong.message, wrong.hint);
        std::mem::take(&mut report).finish()
    })?;
    let mut document = Document::read(&text);
    let mut compact: BTreeMap<u16, BTreeMap<u8, String>> = BTreeMap::new();
    for (id, data) in configured(node.settings) {
        let Some(object) = eds.objects.get(&id) else {
            let message = format!("this EDS does not describe {id}, which the gateway sets; it is left out");
            report.warn(Place::START, message, "is it the EDS of this device?");
            continue;
        };
        let value = value_text(object.data_type, &data);
        // The section of an array or record itself is not that of its sub-index 0.
        let is_group = eds.groups.contains_key(&id.index);
        let wanted = if is_group { Kind::Sub(id.index, id.sub) } else { Kind::Object(id.index) };
        if !document.set(wanted, "ParameterValue", &value) {
            compact.entry(id.index).or_default().insert(id.sub, value);
        }
    }
    for (index, values) in compact {
        document.set_compact(eds, index, values);
    }
    let source = eds.file.rsplit(['/', '\\']).next().unwrap_or_default();
    document.set_in("fileinfo", "FileName", file);
    document.set_in("fileinfo", "LastEDS", source);
    document.remove(|block| matches!(block, "devicecomissioning" | "devicecommissioning"));
    document.push(vec![
        "[DeviceComissioning]".to_owned(),
        format!("NodeID={}", node.settings.id.get()),
        format!("NodeName={}", node.name),
        format!("Baudrate={}", node.bit_rate / 1000),
        "NetNumber=1".to_owned(),
        format!("NetworkName={}", node.network),
        "CANopenManager=0".to_owned(),
        "LSS_SerialNumber=0".to_owned(),
    ]);
    let written = document.write(if text.contains("\r\n") { "\r\n" } else { "\n" });
    // As the EDS has it: other tools of the plant read it too.
    let bytes = if std::str::from_utf8(bytes).is_ok() {
        written.into_bytes()
    } else {
        written.chars().map(|letter| u8::try_from(letter).unwrap_or(b'?')).collect()
    };
    Ok((bytes, report.finish()))
}

/// A value as an EDS has it.
fn value_text(data_type: DataType, data: &[u8]) -> String {
    let mut wide = [0; 8];
    for (slot, byte) in wide.iter_mut().zip(data) {
        *slot = *byte;
    }
    let number = u64::from_le_bytes(wide);
    match (data_type, data.len()) {
        (DataType::Integer(_), length @ 1..=8) => {
            let unused = 64 - 8 * u32::try_from(length).unwrap_or(8);
            ((number << unused).cast_signed() >> unused).to_string()
        }
        (DataType::Real(_), 4) => f32::from_bits(u32::try_from(number).unwrap_or_default()).to_string(),
        (DataType::Real(_), 8) => f64::from_bits(number).to_string(),
        _ => format!("0x{number:0width$X}", width = 2 * data.len()),
    }
}

/// A section with all its lines, header, blank lines and comments included.
#[derive(Debug, Default)]
struct Block {
    /// In lower case, without blanks; empty for what stands before the first header.
    name: String,
    lines: Vec<String>,
}

impl Block {
    /// Puts a line behind the last entry: comments after that belong to the section that follows.
    fn add(&mut self, line: String) {
        let last = self.lines.iter().rposition(|line| {
            let line = line.trim();
            !line.is_empty() && !line.starts_with([';', '#'])
        });
        self.lines.insert(last.map_or(0, |last| last + 1), line);
    }
}

/// An EDS as lines, so that nothing is lost that is not understood.
#[derive(Debug)]
struct Document {
    blocks: Vec<Block>,
}

impl Document {
    fn read(text: &str) -> Self {
        let mut blocks = vec![Block::default()];
        for line in text.split('\n').flat_map(|line| line.strip_suffix('\r').unwrap_or(line).split('\r')) {
            if let Some(header) = line.trim().strip_prefix('[') {
                let title = header.split(']').next().unwrap_or_default();
                let name: String = title.chars().filter(|c| !c.is_whitespace()).collect();
                blocks.push(Block { name: name.to_ascii_lowercase(), lines: Vec::new() });
            }
            if let Some(block) = blocks.last_mut() {
                block.lines.push(line.to_owned());
            }
        }
        Self { blocks }
    }

    /// Sets a key of the section of a kind; `false` where there is none.
    fn set(&mut self, wanted: Kind, key: &str, value: &str) -> bool {
        self.set_where(|block| kind(block) == wanted, key, value)
    }

    fn set_in(&mut self, name: &str, key: &str, value: &str) {
        self.set_where(|block| block == name, key, value);
    }

    fn set_where(&mut self, is_wanted: impl Fn(&str) -> bool, key: &str, value: &str) -> bool {
        let mut found = self.blocks.iter_mut().filter(|block| is_wanted(&block.name)).peekable();
        let is_there = found.peek().is_some();
        let mut line = Some(format!("{key}={value}"));
        for block in found {
            block.lines.retain(|line| {
                line.split_once('=').is_none_or(|(found, _)| !found.trim().eq_ignore_ascii_case(key))
            });
            if let Some(line) = line.take() {
                block.add(line);
            }
        }
        is_there
    }

    /// Sets sub-indices that have no sections of their own: those that have a value keep it.
    fn set_compact(&mut self, eds: &Eds, index: u16, values: BTreeMap<u8, String>) {
        let own = eds.objects.range(ObjectId::new(index, 0)..=ObjectId::new(index, u8::MAX));
        let mut all: BTreeMap<u8, String> = own
            .filter_map(|(id, object)| Some((id.sub, object.parameter_value.as_ref()?.text.clone())))
            .collect();
        all.extend(values);
        self.remove(|block| kind(block) == Kind::Values(index));
        let mut lines = vec![format!("[{index:04X}Value]"), format!("NrOfEntries={}", all.len())];
        lines.extend(all.iter().map(|(sub, value)| format!("{sub}={value}")));
        self.push(lines);
    }

    fn remove(&mut self, is_wanted: impl Fn(&str) -> bool) {
        self.blocks.retain(|block| block.name.is_empty() || !is_wanted(&block.name));
    }

    /// Adds a section at the end, a blank line before it.
    fn push(&mut self, lines: Vec<String>) {
        if let Some(last) = self.blocks.last_mut() {
            while last.lines.last().is_some_and(|line| line.trim().is_empty()) {
                last.lines.pop();
            }
            last.lines.push(String::new());
        }
        self.blocks.push(Block { name: String::new(), lines });
    }

    fn write(&self, end: &str) -> String {
        let mut text = String::new();
        for line in self.blocks.iter().flat_map(|block| &block.lines) {
            // Writing to a String cannot fail.
            let _ = write!(text, "{line}{end}");
        }
        text
    }
}
