//! One table of a mapping's text with its comments: what it is, what it says, and how one key of it is changed.

use toml::{Table, Value};

use super::model::ObjectId;
use super::number;
use super::pdo::Mapped;

/// Pieces that one table can fall into, because lines inside its values begin with `[`.
const MOST_PIECES: usize = 64;

/// One table with its comments.
#[derive(Clone, Debug)]
pub struct Chunk {
    /// As it is written, without empty lines around it.
    pub text: String,
    /// Which table it is.
    pub part: Part,
    /// What it says.
    pub table: Table,
}

/// Which table a chunk is.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Part {
    /// What stands before the first table.
    Head,
    /// `[device]`
    Device,
    /// `[identity]`
    Identity,
    /// `[error_control]`
    ErrorControl,
    /// `[tpdo.N]`
    Tpdo(u16),
    /// `[[tag]]` of an object.
    Tag(ObjectId),
    /// `[[setup]]` of an object.
    Setup(ObjectId),
    /// Any other, written by hand.
    Own,
}

impl Chunk {
    /// Reads one table; `None` where it is not whole.
    pub fn from_text(text: &str) -> Option<Self> {
        let text = text.trim_matches('\n').trim_end();
        let table: Table = text.parse().ok()?;
        let mut chunk = Self { text: text.to_owned(), part: Part::Own, table };
        chunk.part = chunk.find_part();
        Some(chunk)
    }

    fn find_part(&self) -> Part {
        let Some((key, value)) = self.table.iter().next() else { return Part::Head };
        match key.as_str() {
            "format" => Part::Head,
            "device" => Part::Device,
            "identity" => Part::Identity,
            "error_control" => Part::ErrorControl,
            "tpdo" => {
                let number = value.as_table().and_then(|table| table.keys().next());
                number.and_then(|number| number.parse().ok()).map_or(Part::Own, Part::Tpdo)
            }
            "tag" => object(self.entry()).map_or(Part::Own, Part::Tag),
            "setup" => object(self.entry()).map_or(Part::Own, Part::Setup),
            _ => Part::Own,
        }
    }

    /// What the table itself says: of `[[tag]]` and `[tpdo.1]` the inner one.
    pub fn entry(&self) -> &Table {
        let Some((key, value)) = self.table.iter().next() else { return &self.table };
        let inner = match value {
            Value::Array(items) => items.first().and_then(Value::as_table),
            Value::Table(table) if key == "tpdo" => table.values().next().and_then(Value::as_table),
            Value::Table(table) => Some(table),
            Value::String(_)
            | Value::Integer(_)
            | Value::Float(_)
            | Value::Boolean(_)
            | Value::Datetime(_) => None,
        };
        inner.unwrap_or(&self.table)
    }

    /// The objects that a `[tpdo.N]` carries; `None` where one cannot be read.
    pub fn maps(&self) -> Option<Vec<Mapped>> {
        maps(self.entry())
    }

    /// The text with a key set to a value, or without the key. Comments stay where the key has a line of its own.
    pub fn with(&self, key: &str, value: Option<&str>) -> String {
        let is_key = |line: &str| {
            line.trim_start().strip_prefix(key).is_some_and(|rest| rest.trim_start().starts_with('='))
        };
        let header = |line: &&str| line.trim_start().starts_with('[');
        let mut lines: Vec<String> = self.text.lines().map(str::to_owned).collect();
        let at = lines.iter().position(|line| is_key(line));
        match (at, value) {
            (Some(at), Some(value)) => lines.splice(at..=at, [format!("{key} = {value}")]).for_each(drop),
            (Some(at), None) => lines.splice(at..=at, []).for_each(drop),
            (None, Some(value)) => {
                let first = self.text.lines().position(|line| header(&line)).map_or(0, |header| header + 1);
                lines.splice(first..first, [format!("{key} = {value}")]).for_each(drop);
            }
            (None, None) => {}
        }
        let text = lines.join("\n");
        let right = Self::from_text(&text).is_some_and(|chunk| {
            let found = chunk.entry().get(key).map(ToString::to_string);
            let wanted = value.and_then(|value| format!("v = {value}").parse::<Table>().ok());
            found == wanted.and_then(|table| table.get("v").map(ToString::to_string))
                && chunk.part == self.part
        });
        if right { text } else { self.rebuilt(key, value) }
    }

    /// The same from the values alone, for a table that is written in an unusual way.
    fn rebuilt(&self, key: &str, value: Option<&str>) -> String {
        let header = self.text.lines().find(|line| line.trim_start().starts_with('[')).unwrap_or_default();
        let kept = self.entry().iter().filter(|(name, _)| *name != key);
        let mut lines = vec![header.to_owned()];
        lines.extend(kept.map(|(name, value)| format!("{name} = {value}")));
        lines.extend(value.map(|value| format!("{key} = {value}")));
        lines.join("\n")
    }
}

/// The tables of a text. `None` where they cannot be told apart.
pub fn chunks(block: &str) -> Option<Vec<Chunk>> {
    let mut chunks = Vec::new();
    let mut open = String::new();
    let mut pieces = 0;
    for piece in pieces_of(block) {
        if !open.is_empty() && !continues(&piece) && Chunk::from_text(&open).is_some() {
            chunks.extend(Chunk::from_text(&open));
            open.clear();
            pieces = 0;
        }
        pieces += 1;
        if pieces > MOST_PIECES {
            return None;
        }
        open.push_str(&piece);
    }
    if !open.trim().is_empty() {
        chunks.push(Chunk::from_text(&open)?);
    }
    Some(chunks)
}

/// A text, cut before every line that looks like a header, and before the comments above it.
fn pieces_of(block: &str) -> Vec<String> {
    let mut pieces = Vec::new();
    let mut piece = String::new();
    let mut comments = String::new();
    for line in block.lines() {
        let trimmed = line.trim_start();
        if trimmed.starts_with('#') {
            comments.push_str(line);
            comments.push('\n');
            continue;
        }
        if trimmed.starts_with('[') && !piece.is_empty() {
            pieces.push(std::mem::take(&mut piece));
        }
        piece.push_str(&comments);
        comments.clear();
        piece.push_str(line);
        piece.push('\n');
    }
    piece.push_str(&comments);
    pieces.push(piece);
    pieces
}

/// Whether a piece belongs to the table before it: `[tag.scale]` to `[[tag]]`.
fn continues(piece: &str) -> bool {
    let header = piece.lines().find(|line| line.trim_start().starts_with('[')).unwrap_or_default();
    let path = header.trim_start_matches(|c: char| c == '[' || c.is_whitespace());
    ["tag.", "derived.", "alarm.", "parameter.", "setup."].iter().any(|table| path.starts_with(table))
}

/// A key that is a text.
pub fn text<'a>(table: &'a Table, key: &str) -> Option<&'a str> {
    table.get(key)?.as_str()
}

/// The `object` that an entry names.
pub fn object(table: &Table) -> Option<ObjectId> {
    object_id(text(table, "object")?)
}

/// `0x6401:1`, both numbers decimal or hexadecimal.
fn object_id(text: &str) -> Option<ObjectId> {
    let (index, sub) = text.split_once(':').unwrap_or((text, "0"));
    let whole = |text| number::whole(text).map(|(whole, _)| whole.base);
    Some(ObjectId::new(u16::try_from(whole(index)?).ok()?, u8::try_from(whole(sub)?).ok()?))
}

/// The objects of a `[tpdo.N]`.
pub fn maps(table: &Table) -> Option<Vec<Mapped>> {
    table.get("maps")?.as_array()?.iter().map(|entry| mapped(entry.as_str()?)).collect()
}

fn mapped(text: &str) -> Option<Mapped> {
    let (object, bits) = text.split_once('/')?;
    Some(Mapped { object: object_id(object.trim())?, bits: bits.trim().parse().ok()? })
}
