//! What the sections of an EDS are, by their names.

/// A section, by its name.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Kind {
    /// `[1018]`
    Object(u16),
    /// `[1018sub1]`
    Sub(u16, u8),
    /// `[1018Value]`: values of the sub-indices of a compact object.
    Values(u16),
    /// `[1018Name]`: their names.
    Names(u16),
    /// `[MandatoryObjects]`, `[OptionalObjects]`, `[ManufacturerObjects]`
    List,
    /// Of a modular device.
    Module,
    /// Has its own reader, or nothing that matters here.
    Other,
    /// Not of the standard.
    Unknown,
}

/// Sections of the standard that describe no object.
const OTHERS: [&str; 11] = [
    "fileinfo",
    "deviceinfo",
    "dummyusage",
    "comments",
    "devicecomissioning",
    "devicecommissioning",
    "dynamicchannels",
    "tools",
    "standarddatatypes",
    "predefines",
    "filehistory",
];

/// The kind of a section; the name is in lower case and has no blanks.
pub fn kind(name: &str) -> Kind {
    if matches!(name, "mandatoryobjects" | "optionalobjects" | "manufacturerobjects") {
        return Kind::List;
    }
    if OTHERS.contains(&name) || numbered(name, "tool", "") {
        return Kind::Other;
    }
    if matches!(name, "supportedmodules" | "connectedmodules") || is_module(name) {
        return Kind::Module;
    }
    object(name).unwrap_or(Kind::Unknown)
}

/// `prefix`, digits, and what follows them.
fn numbered(name: &str, prefix: &str, rest: &str) -> bool {
    let after = name.strip_prefix(prefix).unwrap_or_default();
    let digits = after.bytes().take_while(u8::is_ascii_digit).count();
    digits > 0 && after.get(digits..) == Some(rest)
}

/// `m1fixedobjects`, `m1moduleinfo`, `m1subext6000`, `m1comments` and their like.
fn is_module(name: &str) -> bool {
    let after = name.strip_prefix('m').unwrap_or_default();
    let digits = after.bytes().take_while(u8::is_ascii_digit).count();
    let rest = after.get(digits..).unwrap_or_default();
    digits > 0 && ["fixed", "module", "sub", "comments"].iter().any(|word| rest.starts_with(word))
}

fn object(name: &str) -> Option<Kind> {
    let name = name.strip_prefix("0x").unwrap_or(name);
    let (index, rest) = name.split_at_checked(4)?;
    let index = hexadecimal(index, 4)?;
    Some(match rest {
        "" => Kind::Object(index),
        "value" => Kind::Values(index),
        "name" => Kind::Names(index),
        "denotation" | "objectlinks" => Kind::Other,
        _ => {
            let sub = rest.strip_prefix("sub")?;
            let sub = hexadecimal(sub.strip_prefix("0x").unwrap_or(sub), 2)?;
            Kind::Sub(index, u8::try_from(sub).ok()?)
        }
    })
}

fn hexadecimal(text: &str, most: usize) -> Option<u16> {
    let valid = (1..=most).contains(&text.len()) && text.bytes().all(|byte| byte.is_ascii_hexdigit());
    u16::from_str_radix(text, 16).ok().filter(|_| valid)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn objects_and_sub_indices_are_hexadecimal() {
        for (name, expected) in [
            ("1000", Kind::Object(0x1000)),
            ("0x6401", Kind::Object(0x6401)),
            ("1018sub1", Kind::Sub(0x1018, 1)),
            ("1018suba", Kind::Sub(0x1018, 10)),
            ("6000sub10", Kind::Sub(0x6000, 16)),
            ("1018sub01", Kind::Sub(0x1018, 1)),
            ("1003value", Kind::Values(0x1003)),
            ("1003name", Kind::Names(0x1003)),
            ("1003objectlinks", Kind::Other),
            ("mandatoryobjects", Kind::List),
            ("m1fixedobjects", Kind::Module),
            ("m12subext6000", Kind::Module),
            ("supportedmodules", Kind::Module),
            ("tool3", Kind::Other),
            ("deviceinfo", Kind::Other),
        ] {
            assert_eq!(kind(name), expected, "{name}");
        }
        for name in ["", "100", "10000", "1000subg", "1000sub", "1000sub100", "modes", "m1", "äöü", "+100"]
        {
            assert_eq!(kind(name), Kind::Unknown, "{name}");
        }
    }
}
