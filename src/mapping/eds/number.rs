//! Numbers as makers write them: `10`, `0xA`, `012`, `$NODEID+0x180`, `0x180 + $NodeId`, `3.4E+38`.

/// A whole number, to which the node id may have to be added.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Whole {
    /// The number, node id not added; -2^63..2^64.
    pub base: i128,
    /// Whether the node id is added.
    pub plus_node_id: bool,
}

impl Whole {
    /// The number for a node; `None` where it needs a node id and there is none.
    #[must_use]
    pub fn of(self, node_id: Option<u8>) -> Option<i128> {
        if self.plus_node_id { node_id.map(|id| self.base + i128::from(id)) } else { Some(self.base) }
    }
}

/// What is odd about a number.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Oddity {
    /// It has a leading zero and was read as octal, as the standard asks.
    Octal,
    /// It has a leading zero but a digit that is not octal; read as decimal.
    NotOctal,
    /// A comment stands behind it in the same line.
    Comment,
    /// It ends with U or L, as in the C language.
    Suffix,
}

/// Lowest and highest number of 64 bits, with or without sign.
const LIMITS: std::ops::RangeInclusive<i128> = -(1 << 63)..=(1 << 64) - 1;

/// Reads a whole number.
#[must_use]
pub fn whole(text: &str) -> Option<(Whole, Option<Oddity>)> {
    let text = unquoted(text);
    formula(text).or_else(|| {
        let (before, _) = text.split_once(';')?;
        formula(before.trim_end()).map(|(number, oddity)| (number, oddity.or(Some(Oddity::Comment))))
    })
}

/// Reads a number that may have a fraction; a hexadecimal one is no such number.
#[must_use]
pub fn real(text: &str) -> Option<f64> {
    let text = unquoted(text);
    let text = text.split_once(';').map_or(text, |(before, _)| before.trim_end());
    // The parser also takes words such as "inf".
    let plain = text.bytes().all(|byte| byte.is_ascii_digit() || b"+-.eE".contains(&byte));
    text.parse().ok().filter(|number: &f64| plain && number.is_finite())
}

fn unquoted(text: &str) -> &str {
    let text = text.trim();
    text.strip_prefix('"').and_then(|text| text.strip_suffix('"')).map_or(text, str::trim)
}

fn formula(text: &str) -> Option<(Whole, Option<Oddity>)> {
    let lower = text.to_ascii_lowercase();
    let Some((before, after)) = lower.split_once("$nodeid") else {
        let (base, oddity) = plain(&lower)?;
        return Some((Whole { base, plus_node_id: false }, oddity));
    };
    let (before, after) = (before.trim(), after.trim());
    let rest = match (before, after) {
        ("", "") => return Some((Whole { base: 0, plus_node_id: true }, None)),
        ("", after) => after.strip_prefix('+')?,
        (before, "") => before.strip_suffix('+')?,
        _ => return None,
    };
    let (base, oddity) = plain(rest.trim())?;
    Some((Whole { base, plus_node_id: true }, oddity))
}

/// A number without the node id, in lower case.
fn plain(text: &str) -> Option<(i128, Option<Oddity>)> {
    let (negative, digits) = match text.strip_prefix('-') {
        Some(digits) => (true, digits.trim_start()),
        None => (false, text.strip_prefix('+').unwrap_or(text)),
    };
    let bare = digits.trim_end_matches(['u', 'l']);
    let suffix = (bare != digits).then_some(Oddity::Suffix);
    let digits = bare;
    let (digits, radix, oddity) = if let Some(hexadecimal) = digits.strip_prefix("0x") {
        (hexadecimal, 16, None)
    } else if digits.len() > 1 && digits.starts_with('0') {
        if digits.bytes().any(|byte| matches!(byte, b'8' | b'9')) {
            (digits, 10, Some(Oddity::NotOctal))
        } else {
            (digits, 8, Some(Oddity::Octal))
        }
    } else {
        (digits, 10, None)
    };
    let valid = !digits.is_empty() && digits.chars().all(|digit| digit.is_digit(radix));
    let number = i128::from_str_radix(digits, radix).ok().filter(|_| valid)?;
    // 001 is 1 either way.
    let oddity = oddity.filter(|oddity| *oddity == Oddity::NotOctal || number > 7).or(suffix);
    let number = if negative { -number } else { number };
    LIMITS.contains(&number).then_some((number, oddity))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn number(text: &str) -> Option<(i128, bool, Option<Oddity>)> {
        whole(text).map(|(whole, oddity)| (whole.base, whole.plus_node_id, oddity))
    }

    #[test]
    fn decimal_hexadecimal_and_octal_numbers_are_read_as_the_standard_has_it() {
        for (text, expected) in [
            ("0", 0),
            ("10", 10),
            ("0xA", 10),
            ("0X0a", 10),
            (" 7 ", 7),
            ("-128", -128),
            ("- 5", -5),
            ("+5", 5),
            ("\"0x10\"", 16),
            ("0xFFFFFFFFFFFFFFFF", i128::from(u64::MAX)),
        ] {
            assert_eq!(number(text), Some((expected, false, None)), "{text}");
        }
        for text in ["001", "007", "00", "0000"] {
            assert_eq!(number(text).unwrap().2, None, "{text}");
        }
        assert_eq!(number("010"), Some((8, false, Some(Oddity::Octal))));
        assert_eq!(number("08"), Some((8, false, Some(Oddity::NotOctal))));
        assert_eq!(number("0192"), Some((192, false, Some(Oddity::NotOctal))));
        assert_eq!(number("0x10UL"), Some((16, false, Some(Oddity::Suffix))));
        assert_eq!(number("0x0007   ; UNSIGNED32"), Some((7, false, Some(Oddity::Comment))));
    }

    #[test]
    fn the_node_id_is_added_before_or_after_in_any_spelling() {
        for text in ["$NODEID+0x180", "$NodeID + 0x180", "0x180+$NODEID", "384 + $nodeid", "$NODEID+ 0X180"] {
            assert_eq!(number(text), Some((0x180, true, None)), "{text}");
        }
        assert_eq!(number("$NODEID"), Some((0, true, None)));
        assert_eq!(whole("$NODEID+0x180").unwrap().0.of(Some(5)), Some(0x185));
        assert_eq!(whole("$NODEID+0x180").unwrap().0.of(None), None);
        assert_eq!(whole("7").unwrap().0.of(None), Some(7));
    }

    #[test]
    fn what_is_no_number_is_none() {
        for text in [
            "",
            "-",
            "0x",
            "1.5",
            "NODEID+1",
            "$NODEID-1",
            "$NODEID 1",
            "1+$NODEID+1",
            "0x1G",
            "ten",
            ";",
            "18446744073709551616",
            "99999999999999999999999999999999999999999999999",
            "0x-5",
            "--5",
            "٣",
        ] {
            assert_eq!(number(text), None, "{text}");
        }
    }

    #[test]
    fn fractions_are_read_and_words_are_not() {
        assert_eq!(real("5.25"), Some(5.25));
        assert_eq!(real("-3.402823E+38"), Some(-3.402_823e38));
        for text in ["", "inf", "NaN", "0x10", "5,2", "1e999"] {
            assert_eq!(real(text), None, "{text}");
        }
    }
}
