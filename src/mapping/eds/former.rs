//! A mapping that a former import wrote: what of it must stay.
//!
//! Import owns the lines between two marker comments. What stands above and below is never touched. Inside, tags are found
//! again by their `object`, so that their names, addresses, units and whatever else was changed by hand stay.

use std::collections::{BTreeMap, BTreeSet};
use std::ops::Range;

use toml::{Table, Value};

use super::addresses::Addresses;
use super::chunk::{Chunk, Part, chunks, maps, object, text};
use super::model::ObjectId;
use super::naming::Names;
use super::pdo::Mapped;
use crate::mapping::{Diagnostic, SourceText};

/// First line of what import owns.
pub const BEGIN: &str =
    "# >>> cangate import: written anew by every import. Your own tables belong below its last line.";
/// Last line of what import owns.
pub const END: &str = "# <<< cangate import";
/// By what the first line is known.
const BEGIN_MARK: &str = "# >>> cangate import";
/// Most elements of an array of tags.
const LONGEST_ARRAY: u64 = 1024;

/// What stays of the former text.
#[derive(Debug, Default)]
pub struct Former {
    /// Text above the first marker.
    pub above: String,
    /// Text below the last marker.
    pub below: String,
    /// The tables between the markers, in order.
    pub chunks: Vec<Chunk>,
    /// Addresses that are taken; new ones begin above those that import ever gave away.
    pub addresses: Addresses,
    /// Registers below this one were given away.
    pub registers_used: u64,
    /// Bits below this one were given away.
    pub bits_used: u64,
    /// Names that are taken.
    pub names: Names,
    /// Objects of the tags outside the markers.
    pub own_tags: BTreeSet<ObjectId>,
    /// Objects of the `[[setup]]` entries outside the markers.
    pub own_setup: BTreeSet<ObjectId>,
    /// TPDOs outside the markers, by their numbers, and what they carry.
    pub own_tpdos: BTreeMap<u16, Vec<Mapped>>,
    /// Names of the tables outside the markers.
    pub own_tables: BTreeSet<String>,
}

impl Former {
    /// Reads a mapping's former text. Or why it cannot be taken up.
    pub fn read(source: &SourceText) -> Result<Self, Vec<Diagnostic>> {
        let whole: Table = source.text.parse().map_err(|error: toml::de::Error| {
            let hint = "mend it, or write the import to another file";
            vec![source.error(&error.span().unwrap_or(0..0), error.message().trim(), hint)]
        })?;
        let (above, block, below) = split(&source.text).ok_or_else(|| {
            let hint =
                "import writes to a file of its own: give another name with -o, and take over from there";
            vec![source.error(&(0..0), "this mapping was not written by import", hint)]
        })?;
        let chunks = chunks(block).ok_or_else(|| {
            let span = above.len()..above.len();
            vec![source.error(&span, "the tables from here on cannot be told apart", "write one key a line")]
        })?;
        let mut former = Self { above: above.to_owned(), below: below.to_owned(), ..Self::default() };
        for key in ["tag", "derived"] {
            for table in tables(&whole, key) {
                former.claim(table);
            }
        }
        for table in tables(&whole, "parameter") {
            former.names_of(table);
        }
        former.take_outside(&format!("{above}\n{below}").parse().unwrap_or_default());
        former.count_used(&chunks);
        former.chunks = chunks;
        Ok(former)
    }

    /// Names and addresses of a tag, an array's unrolled.
    fn claim(&mut self, table: &Table) {
        let count = self.names_of(table);
        for (address, width) in registers(table) {
            self.addresses.claim_registers(address..address.saturating_add(width.saturating_mul(count)));
        }
        if let Some(bit) = natural(table, "bit_address") {
            self.addresses.claim_bits(bit..bit.saturating_add(count));
        }
    }

    /// Takes the names of an entry; gives how many they are.
    fn names_of(&mut self, table: &Table) -> u64 {
        let name = text(table, "name").unwrap_or_default();
        let Some(array) = table.get("array").and_then(Value::as_table) else {
            self.names.0.insert(name.to_owned());
            return 1;
        };
        let words: Vec<String> = if let Some(words) = array.get("words").and_then(Value::as_array) {
            words.iter().filter_map(|word| word.as_str().map(str::to_owned)).collect()
        } else {
            let first = natural(array, "first").unwrap_or(1);
            let count = natural(array, "count").unwrap_or(1).min(LONGEST_ARRAY);
            (first..first.saturating_add(count)).map(|number| number.to_string()).collect()
        };
        self.names.0.extend(words.iter().map(|word| name.replace("{}", word)));
        u64::try_from(words.len()).unwrap_or(1)
    }

    /// What stands outside the markers.
    fn take_outside(&mut self, outside: &Table) {
        self.own_tags = tables(outside, "tag").filter_map(object).collect();
        self.own_setup = tables(outside, "setup").filter_map(object).collect();
        self.own_tables = outside.keys().cloned().collect();
        for (key, entry) in outside.get("tpdo").and_then(Value::as_table).into_iter().flatten() {
            if let Ok(number) = key.parse() {
                let maps = entry.as_table().and_then(maps);
                self.own_tpdos.insert(number, maps.unwrap_or_default());
            }
        }
    }

    /// Where new addresses begin.
    fn count_used(&mut self, chunks: &[Chunk]) {
        let mut used = (0, 0);
        for chunk in chunks {
            match &chunk.part {
                Part::Device => {
                    let device = chunk.table.get("device").and_then(Value::as_table);
                    let said = |key| device.and_then(|device| natural(device, key)).unwrap_or(0);
                    used = (said("registers_used").max(used.0), said("bits_used").max(used.1));
                }
                Part::Tag(_) => {
                    let ends = registers(chunk.entry()).map(|(address, width)| address.saturating_add(width));
                    used.0 = ends.max().unwrap_or(0).max(used.0);
                    used.1 = natural(chunk.entry(), "bit_address")
                        .map_or(0, |bit| bit.saturating_add(1))
                        .max(used.1);
                }
                Part::Head
                | Part::Identity
                | Part::ErrorControl
                | Part::Tpdo(_)
                | Part::Setup(_)
                | Part::Own => {}
            }
        }
        (self.registers_used, self.bits_used) = used;
        self.addresses.begin_at(used.0, used.1);
    }

    /// The first chunk of a part.
    pub fn chunk(&self, part: &Part) -> Option<&Chunk> {
        self.chunks.iter().find(|chunk| chunk.part == *part)
    }
}

/// Above, between and below the marker lines.
fn split(text: &str) -> Option<(&str, &str, &str)> {
    let line_at = |mark: &str, from: usize| -> Option<Range<usize>> {
        let mut start = from;
        for line in text.get(from..)?.split_inclusive('\n') {
            if line.starts_with(mark) {
                return Some(start..start + line.len());
            }
            start += line.len();
        }
        None
    };
    let begin = line_at(BEGIN_MARK, 0)?;
    let end = line_at(END, begin.end)?;
    Some((text.get(..begin.start)?, text.get(begin.end..end.start)?, text.get(end.end..)?))
}

fn tables<'a>(table: &'a Table, key: &str) -> impl Iterator<Item = &'a Table> {
    table.get(key).and_then(Value::as_array).into_iter().flatten().filter_map(Value::as_table)
}

/// Addresses of a tag and how many registers each takes.
fn registers(table: &Table) -> impl Iterator<Item = (u64, u64)> {
    tables(table, "registers").filter_map(|register| {
        let width = match text(register, "type")? {
            "u16" | "i16" | "raw16" => 1,
            _ => 2,
        };
        Some((natural(register, "address")?, width))
    })
}

fn natural(table: &Table, key: &str) -> Option<u64> {
    table.get(key)?.as_integer().and_then(|number| u64::try_from(number).ok())
}

#[cfg(test)]
mod tests {
    use super::*;

    const TEXT: &str = r#"# mine
# >>> cangate import: x
# head
format = 1
[device]
vendor = "v" # short
registers_used = 110
bits_used = 3

# about the first TPDO
[tpdo.1]
cob_id = "$NODEID+0x180"
maps = ["0x6401:1/16", "0x0005:0/8"]
reserved_bits = [
  [16, 8],
]

[[tag]]
name = "level"
object = "0x6401:1" # here
registers = [{ address = 120, type = "u32" }]
[tag.scale]
multiply = 0.1

[[derived]]
name = "x_{}"
array = { first = 3, count = 2 }
registers = [{ address = 130, type = "f32" }]

# <<< cangate import

[[tag]]
name = "own"
object = "0x6401:0x0A"
bit_address = 9
[[setup]]
object = "0x2000:0"
[tpdo.7]
maps = ["0x7000:1/8"]
"#;

    fn former(text: &str) -> Result<Former, Vec<Diagnostic>> {
        Former::read(&SourceText::new("m.toml", text))
    }

    #[test]
    fn the_block_is_taken_apart_table_by_table_with_its_comments() {
        let former = former(TEXT).unwrap();
        assert_eq!(former.above, "# mine\n");
        assert!(former.below.starts_with("\n[[tag]]\nname = \"own\""));
        let parts: Vec<&Part> = former.chunks.iter().map(|chunk| &chunk.part).collect();
        let level = Part::Tag(ObjectId::new(0x6401, 1));
        assert_eq!(parts, [&Part::Head, &Part::Device, &Part::Tpdo(1), &level, &Part::Own]);
        assert!(former.chunks[2].text.starts_with("# about the first TPDO\n[tpdo.1]"));
        assert!(former.chunks[3].text.ends_with("[tag.scale]\nmultiply = 0.1"));
        assert_eq!(former.chunks[2].maps().unwrap()[0].to_string(), "0x6401:1/16");
    }

    #[test]
    fn names_addresses_and_objects_of_the_whole_file_are_taken() {
        let mut former = former(TEXT).unwrap();
        assert_eq!((former.registers_used, former.bits_used), (122, 3));
        assert_eq!(former.own_tags, BTreeSet::from([ObjectId::new(0x6401, 10)]));
        assert_eq!(former.own_setup, BTreeSet::from([ObjectId::new(0x2000, 0)]));
        assert_eq!(former.own_tpdos[&7][0].to_string(), "0x7000:1/8");
        assert!(former.own_tables.contains("setup") && !former.own_tables.contains("device"));
        let names: Vec<&str> = former.names.0.iter().map(String::as_str).collect();
        assert_eq!(names, ["level", "own", "x_3", "x_4"]);
        let given: Vec<u16> = (0..9).filter_map(|_| former.addresses.registers(1)).collect();
        assert_eq!(given, [122, 123, 124, 125, 126, 127, 128, 129, 134]);
        let bits: Vec<u16> = (0..7).filter_map(|_| former.addresses.bit()).collect();
        assert_eq!(bits, [3, 4, 5, 6, 7, 8, 10]);
    }

    #[test]
    fn one_key_can_be_changed_and_the_rest_stays_as_it_is_written() {
        let former = former(TEXT).unwrap();
        let tag = &former.chunks[3];
        let changed = tag.with("poll_ms", Some("60000"));
        assert_eq!(changed, tag.text.replace("[[tag]]", "[[tag]]\npoll_ms = 60000"));
        assert!(tag.with("name", Some("\"other\"")).starts_with("[[tag]]\nname = \"other\"\nobject"));
        assert!(!tag.with("registers", None).contains("registers"));
        assert_eq!(tag.with("nothing", None), tag.text);
        // A value over several lines: written anew from what it says.
        let tpdo = &former.chunks[2];
        assert_eq!(
            tpdo.with("reserved_bits", None),
            "[tpdo.1]\ncob_id = \"$NODEID+0x180\"\nmaps = [\"0x6401:1/16\", \"0x0005:0/8\"]"
        );
    }

    #[test]
    fn a_file_that_import_did_not_write_is_refused() {
        let message = |text| former(text).unwrap_err()[0].to_string();
        assert!(message("format = 1\n").contains("was not written by import"));
        assert!(message("# >>> cangate import\nformat = 1\n").contains("was not written by import"));
        assert!(message("# >>> cangate import\nformat = \n").starts_with("m.toml:2:10: error"));
    }
}
