//! Writes JSON into a reused string: payloads are made under the lock of the process image, many times a second.

use std::fmt::Write as _;

use crate::process_image::Value;
use crate::process_image::value::write_rounded;

/// Writes members of nested objects and arrays, with the commas where they belong.
#[derive(Debug)]
pub struct JsonWriter<'a> {
    out: &'a mut String,
    /// Whether the next member is the first of its object or array.
    first: bool,
}

impl<'a> JsonWriter<'a> {
    /// Starts an object in an emptied `out`.
    pub fn object(out: &'a mut String) -> Self {
        out.clear();
        out.push('{');
        Self { out, first: true }
    }

    /// Ends the outermost object.
    pub fn finish(self) {
        self.out.push('}');
    }

    /// A member that is text.
    pub fn text(&mut self, name: &str, text: &str) {
        self.name(name);
        quote(self.out, text);
    }

    /// A member that is text, or `null`.
    pub fn optional_text(&mut self, name: &str, text: Option<&str>) {
        match text {
            Some(text) => self.text(name, text),
            None => self.null(name),
        }
    }

    /// A member that is true or false.
    pub fn bool(&mut self, name: &str, bit: bool) {
        self.name(name);
        self.out.push_str(if bit { "true" } else { "false" });
    }

    /// A member that is a whole number.
    pub fn integer(&mut self, name: &str, number: impl Into<i128>) {
        self.name(name);
        let _ = write!(self.out, "{}", number.into());
    }

    /// A member that is a whole number, or `null`.
    pub fn optional_integer(&mut self, name: &str, number: Option<impl Into<i128>>) {
        match number {
            Some(number) => self.integer(name, number),
            None => self.null(name),
        }
    }

    /// A member that is a value rounded to `decimals` digits; `null` for one that JSON cannot hold.
    pub fn value(&mut self, name: &str, value: Option<Value>, decimals: u8) {
        self.name(name);
        match value {
            Some(value) => number(self.out, value, decimals),
            None => self.out.push_str("null"),
        }
    }

    /// A member that is `null`.
    pub fn null(&mut self, name: &str) {
        self.name(name);
        self.out.push_str("null");
    }

    /// A member that is an object.
    pub fn nested(&mut self, name: &str, members: impl FnOnce(&mut JsonWriter<'_>)) {
        self.name(name);
        self.inner('{', '}', members);
    }

    /// A member that is an array; `elements` calls [`element`](Self::element) for each.
    pub fn array(&mut self, name: &str, elements: impl FnOnce(&mut JsonWriter<'_>)) {
        self.name(name);
        self.inner('[', ']', elements);
    }

    /// An object in an array.
    pub fn element(&mut self, members: impl FnOnce(&mut JsonWriter<'_>)) {
        self.comma();
        self.inner('{', '}', members);
    }

    fn inner(&mut self, open: char, close: char, members: impl FnOnce(&mut JsonWriter<'_>)) {
        self.out.push(open);
        members(&mut JsonWriter { out: self.out, first: true });
        self.out.push(close);
    }

    fn comma(&mut self) {
        if !std::mem::take(&mut self.first) {
            self.out.push(',');
        }
    }

    fn name(&mut self, name: &str) {
        self.comma();
        quote(self.out, name);
        self.out.push(':');
    }
}

/// Whether JSON has a number for it.
#[must_use]
pub fn is_representable(value: Value) -> bool {
    match value {
        Value::Float(number) => number.is_finite(),
        Value::Bool(_) | Value::Unsigned(_) | Value::Signed(_) => true,
    }
}

/// A value as JSON: a bit as `true` or `false`, a number with at most `decimals` digits and no trailing zeros.
fn number(out: &mut String, value: Value, decimals: u8) {
    let _ = match value {
        Value::Bool(bit) => write!(out, "{bit}"),
        Value::Unsigned(whole) => write!(out, "{whole}"),
        Value::Signed(whole) => write!(out, "{whole}"),
        Value::Float(number) if !number.is_finite() => out.write_str("null"),
        Value::Float(number) => {
            write_rounded(out, number, decimals);
            Ok(())
        }
    };
}

/// Text with quotes, escaped as RFC 8259 asks.
fn quote(out: &mut String, text: &str) {
    out.push('"');
    for c in text.chars() {
        match c {
            '"' => out.push_str("\\\""),
            '\\' => out.push_str("\\\\"),
            '\n' => out.push_str("\\n"),
            '\r' => out.push_str("\\r"),
            '\t' => out.push_str("\\t"),
            control if control < ' ' => {
                let _ = write!(out, "\\u{:04x}", u32::from(control));
            }
            other => out.push(other),
        }
    }
    out.push('"');
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn shown(value: Value, decimals: u8) -> String {
        let mut out = String::new();
        number(&mut out, value, decimals);
        out
    }

    #[test]
    fn numbers_are_rounded_and_have_no_trailing_zeros() {
        assert_eq!(shown(Value::Float(12.549_019_607), 2), "12.55");
        assert_eq!(shown(Value::Float(100.0), 2), "100");
        assert_eq!(shown(Value::Float(100.0), 0), "100");
        assert_eq!(shown(Value::Float(-0.001), 2), "0");
        assert_eq!(shown(Value::Float(1e300), 2), "1e300");
        assert_eq!(shown(Value::Float(f64::NAN), 2), "null");
        assert_eq!(shown(Value::Unsigned(u64::MAX), 2), "18446744073709551615");
        assert_eq!(shown(Value::Bool(true), 2), "true");
    }

    proptest! {
        #[test]
        fn any_number_is_json_and_within_half_a_digit(number: f64, decimals in 0u8..=9) {
            let text = shown(Value::Float(number), decimals);
            let read: serde_json::Value = serde_json::from_str(&text).unwrap();
            if number.is_finite() {
                let tolerance = (0.5 * 10f64.powi(-i32::from(decimals))).max(number.abs() * 1e-12) * 1.001;
                prop_assert!((read.as_f64().unwrap() - number).abs() <= tolerance, "{number} {text}");
            } else {
                prop_assert!(read.is_null());
            }
        }

        #[test]
        fn any_text_survives(text: String, name: String) {
            let mut out = String::new();
            let mut writer = JsonWriter::object(&mut out);
            writer.text(&name, &text);
            writer.array("list", |list| {
                list.element(|one| one.integer("n", 1));
                list.element(|two| two.null("n"));
            });
            writer.finish();
            let read: serde_json::Value = serde_json::from_str(&out).unwrap();
            prop_assert_eq!(&read["list"], &serde_json::json!([{"n": 1}, {"n": null}]));
            if name != "list" {
                prop_assert_eq!(read[&name].as_str().unwrap(), text);
            }
        }
    }
}
