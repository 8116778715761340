//! The form of an EDS: sections of `key = value` lines, each with its place. Nothing in here knows CANopen.

use std::collections::BTreeMap;

use super::report::{Place, Report};

/// Most lines that are read.
pub const MOST_LINES: usize = 1_000_000;

/// A file's sections, in its order.
#[derive(Clone, Debug, Default)]
pub struct Ini {
    /// They.
    pub sections: Vec<Section>,
    by_name: BTreeMap<String, usize>,
}

/// One section.
#[derive(Clone, Debug)]
pub struct Section {
    /// As it is written.
    pub title: String,
    /// In lower case, without blanks.
    pub name: String,
    /// Where its first header stands.
    pub place: Place,
    /// Its entries by key, in lower case.
    pub entries: BTreeMap<String, Entry>,
}

/// The value of a key.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Entry {
    /// Without blanks around it; may be empty.
    pub value: String,
    /// Where the value begins.
    pub place: Place,
}

impl Ini {
    /// A section by its name in lower case.
    #[must_use]
    pub fn section(&self, name: &str) -> Option<&Section> {
        self.by_name.get(name).and_then(|index| self.sections.get(*index))
    }

    /// Reads a text. Lines that are neither a header, an entry nor a comment are told and left out; of two entries of the
    /// same name the last counts. `None` where there are too many lines.
    pub fn read(report: &mut Report, text: &str) -> Option<Self> {
        let mut ini = Self::default();
        let mut current = None;
        // Lines end with LF, CR LF or CR, even within one file.
        let lines =
            text.split('\n').flat_map(|line| line.strip_suffix('\r').unwrap_or(line).split('\r')).enumerate();
        for (index, line) in lines {
            if index >= MOST_LINES {
                let place = Place { line: index + 1, column: 1 };
                report.error(place, format!("more than {MOST_LINES} lines"), "is this an EDS?");
                return None;
            }
            let start = line.len() - line.trim_start().len();
            let at = |offset: usize| Place { line: index + 1, column: column(line, offset) };
            let trimmed = line.trim();
            if trimmed.is_empty() || trimmed.starts_with([';', '#']) {
                continue;
            }
            if let Some(header) = trimmed.strip_prefix('[') {
                current = Some(ini.open(report, header, at(start)));
            } else if let Some((key, value)) = trimmed.split_once('=') {
                let offset = start + key.len() + 1 + (value.len() - value.trim_start().len());
                let entry = Entry { value: value.trim().to_owned(), place: at(offset) };
                match current.and_then(|index| ini.sections.get_mut(index)) {
                    Some(section) => section.add(report, key.trim_end(), entry, at(start)),
                    None => report.warn(
                        at(start),
                        format!("`{}` stands before the first section", key.trim_end()),
                        "it is left out",
                    ),
                }
            } else {
                let shown: String = trimmed.chars().take(40).collect();
                let hint = "write [section], key=value or ;comment; it is left out";
                report.warn(at(start), format!("this line has no `=`: {shown}"), hint);
            }
        }
        Some(ini)
    }

    /// The section of a header, which may have been there before.
    fn open(&mut self, report: &mut Report, header: &str, place: Place) -> usize {
        let (title, rest) = header.split_once(']').unwrap_or_else(|| {
            report.warn(place, "this section header has no `]`", "write [name]");
            (header, "")
        });
        let rest = rest.trim_start();
        if !rest.is_empty() && !rest.starts_with([';', '#']) {
            let shown: String = rest.chars().take(40).collect();
            report.warn(place, format!("this stands behind a section header: {shown}"), "it is left out");
        }
        let title = title.trim().to_owned();
        let name: String = title.chars().filter(|c| !c.is_whitespace()).collect();
        let name = name.to_ascii_lowercase();
        if let Some(index) = self.by_name.get(&name) {
            let first = self.sections.get(*index).map_or(0, |section| section.place.line);
            let message = format!("section [{title}] was there before, in line {first}");
            report.warn(place, message, "both count; of two equal keys the last counts");
            return *index;
        }
        let index = self.sections.len();
        self.by_name.insert(name.clone(), index);
        self.sections.push(Section { title, name, place, entries: BTreeMap::new() });
        index
    }
}

impl Section {
    fn add(&mut self, report: &mut Report, key: &str, entry: Entry, place: Place) {
        if let Some(before) = self.entries.insert(key.to_ascii_lowercase(), entry) {
            let line = before.place.line;
            let message = format!("`{key}` of [{}] was there before, in line {line}", self.title);
            report.warn(place, message, "the last one counts; take one of them out");
        }
    }

    /// The entry of a key in lower case, if it is not empty.
    #[must_use]
    pub fn get(&self, key: &str) -> Option<&Entry> {
        self.entries.get(key).filter(|entry| !entry.value.is_empty())
    }

    /// The value of a key as text, without quotation marks around it; empty where there is none.
    #[must_use]
    pub fn text(&self, key: &str) -> &str {
        let text = self.entries.get(key).map_or("", |entry| entry.value.as_str());
        text.strip_prefix('"').and_then(|text| text.strip_suffix('"')).map_or(text, str::trim)
    }
}

/// The 1-based column, in characters, of a byte of a line.
fn column(line: &str, offset: usize) -> usize {
    1 + line.char_indices().take_while(|(at, _)| *at < offset).count()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn read(text: &str) -> (Ini, Vec<String>) {
        let mut report = Report::new("a.eds");
        let ini = Ini::read(&mut report, text).unwrap();
        (ini, report.finish().iter().map(ToString::to_string).collect())
    }

    #[test]
    fn sections_and_keys_are_found_in_any_case_with_blanks_comments_and_any_line_end() {
        let text = "; comment\r\n# too\r[ DeviceInfo ] ; of the maker\n\r\n  VENDORNAME = A; B \r\nEmpty=\nq=\"\"\n[1018 SUBa]\rx=1";
        let (ini, problems) = read(text);
        assert_eq!(problems, Vec::<String>::new());
        let device = ini.section("deviceinfo").unwrap();
        assert_eq!(device.text("vendorname"), "A; B");
        assert_eq!(device.entries["vendorname"].place, Place { line: 5, column: 16 });
        assert_eq!(device.text("q"), "");
        assert!(device.get("empty").is_none() && device.entries.contains_key("empty"));
        assert_eq!(ini.section("1018suba").unwrap().place, Place { line: 8, column: 1 });
    }

    #[test]
    fn what_is_no_entry_is_told_with_its_line_and_left_out() {
        let (ini, problems) = read("a=1\n[X\nwhat\n[Y] z\nk=1\nK=2\n[y]\nk=3\n");
        assert_eq!(
            problems.iter().map(|text| text.split('\n').next().unwrap()).collect::<Vec<_>>(),
            [
                "a.eds:1:1: warning: `a` stands before the first section",
                "a.eds:2:1: warning: this section header has no `]`",
                "a.eds:3:1: warning: this line has no `=`: what",
                "a.eds:4:1: warning: this stands behind a section header: z",
                "a.eds:6:1: warning: `K` of [Y] was there before, in line 5",
                "a.eds:7:1: warning: section [y] was there before, in line 4",
                "a.eds:8:1: warning: `k` of [Y] was there before, in line 6",
            ]
        );
        assert_eq!(ini.section("y").unwrap().text("k"), "3");
    }

    #[test]
    fn a_file_of_too_many_lines_is_refused() {
        let mut report = Report::new("a.eds");
        assert!(Ini::read(&mut report, &"\n".repeat(MOST_LINES)).is_none());
        assert!(report.finish()[0].message.contains("lines"));
    }
}
