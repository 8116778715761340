//! The `[[setup]]` of a mapping: what a DCF wants a device to be set to.

use super::former::Former;
use super::model::{Access, DataType, Eds, Object, ObjectId, Value};
use super::number;
use super::report::Report;

/// One object to be written.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Entry {
    /// The object.
    pub object: ObjectId,
    /// Its type, as a mapping has it. A BOOLEAN is one byte on the wire.
    pub kind: String,
    /// Its value, as TOML has it.
    pub value: String,
}

/// Values of a DCF that differ from the device's defaults, by index and sub-index.
pub fn entries(report: &mut Report, eds: &Eds, former: &Former) -> Vec<Entry> {
    let mut list = Vec::new();
    let mut rpdos = None;
    for (id, object) in &eds.objects {
        let Some(value) = &object.parameter_value else { continue };
        if is_default(eds, object, value) || former.own_setup.contains(id) {
            continue;
        }
        match id.index {
            // Those of TPDOs are in [tpdo.N], the heartbeat's is in [error_control].
            0x1800..=0x1BFF | 0x1017 => {}
            0x1400..=0x17FF => {
                rpdos.get_or_insert(value.place);
            }
            // Commands, not settings: they would be given at every start.
            0x1010 | 0x1011 | 0x1F50..=0x1F5F => {
                let message = format!("{id} is a command, no setting; it is left out");
                report.warn(value.place, message, "give it by hand when it is needed");
            }
            _ if object.access == Access::Unknown => {
                let message = format!("{id} is not set: it is not known whether it can be written");
                report.warn(value.place, message, "correct its AccessType");
            }
            // Tools write down what they read from a device, too.
            _ if !object.access.is_writable() => {}
            _ => list.extend(entry(report, eds, *id, object, value)),
        }
    }
    if let Some(place) = rpdos {
        let hint = "a mapping has no RPDOs; configure them in the device";
        report.warn(place, "the settings of RPDOs are left out", hint);
    }
    list
}

fn is_default(eds: &Eds, object: &Object, value: &Value) -> bool {
    let Some(default) = &object.default else { return false };
    let whole = |value: &Value| value.whole().and_then(|whole| whole.of(eds.node_id));
    match (whole(value), whole(default)) {
        (Some(asked), Some(usual)) => asked == usual,
        _ => value.text == default.text,
    }
}

fn entry(report: &mut Report, eds: &Eds, id: ObjectId, object: &Object, value: &Value) -> Option<Entry> {
    let mut refuse = |why: &str, hint: &str| {
        report.warn(value.place, format!("{id} is not set: {why}"), hint);
        None
    };
    let (bits, is_signed) = match object.data_type {
        DataType::Boolean => (8, false),
        DataType::Unsigned(bits) => (bits, false),
        DataType::Integer(bits) => (bits, true),
        DataType::Real(bits) => return real(bits, id, value).or_else(|| refuse("no number of its type", "")),
        DataType::Time | DataType::Text | DataType::Domain | DataType::Other(_) | DataType::Unknown => {
            return refuse("it is not a number", "set it with another tool");
        }
    };
    let Some(whole) = value.whole() else { return refuse("its value is not a whole number", "") };
    if whole.plus_node_id {
        return refuse(
            "its value depends on the node id",
            "add a [[setup]] by hand, in a mapping for one node",
        );
    }
    let number = in_range(whole.base, bits, is_signed).and_then(|number| i64::try_from(number).ok());
    let Some(number) = number else {
        return refuse(
            &format!("{} does not fit {bits} bits", value.text),
            "check DataType and ParameterValue",
        );
    };
    let limit =
        |limit: &Option<Value>| limit.as_ref().and_then(Value::whole).and_then(|limit| limit.of(eds.node_id));
    let low = limit(&object.low_limit).and_then(|low| in_range(low, bits, is_signed));
    let high = limit(&object.high_limit).and_then(|high| in_range(high, bits, is_signed));
    let number_wide = i128::from(number);
    if let (Some(low), Some(high)) = (low, high)
        && low < high
        && !(low..=high).contains(&number_wide)
    {
        let message = format!("{id} is set to {}, beyond its limits {low} to {high}", value.text);
        report.warn(value.place, message, "the device will probably refuse it");
    }
    let value = if is_signed { number.to_string() } else { format!("0x{number:X}") };
    let kind = format!("{}{bits}", if is_signed { 'i' } else { 'u' });
    Some(Entry { object: id, kind, value })
}

/// A number of so many bits. Makers also write negative ones as they stand in memory: 0xFFFF for -1.
fn in_range(number: i128, bits: u8, is_signed: bool) -> Option<i128> {
    let span = 1_i128 << bits.min(64);
    let number = if is_signed && (span / 2..span).contains(&number) { number - span } else { number };
    let (low, high) = if is_signed { (-span / 2, span / 2) } else { (0, span) };
    (low..high).contains(&number).then_some(number)
}

/// A fraction; a hexadecimal number stands for the bits of one.
fn real(bits: u8, id: ObjectId, value: &Value) -> Option<Entry> {
    let is_hexadecimal = value.text.trim_start().to_ascii_lowercase().starts_with("0x");
    let number = if is_hexadecimal {
        let bits_of = value.whole()?.base;
        if bits == 32 {
            f64::from(f32::from_bits(u32::try_from(bits_of).ok()?))
        } else {
            f64::from_bits(u64::try_from(bits_of).ok()?)
        }
    } else {
        number::real(&value.text)?
    };
    let value = toml::Value::Float(number).to_string();
    number.is_finite().then(|| Entry { object: id, kind: format!("f{bits}"), value })
}

#[cfg(test)]
mod tests {
    use super::super::read::read;
    use super::*;

    fn found(objects: &[(&str, &str, &str, &str)]) -> (Vec<String>, Vec<String>) {
        let sections = objects.iter().map(|(index, data_type, access, values)| {
            format!("[{index}]\nParameterName=p\nDataType={data_type}\nAccessType={access}\n{values}\n")
        });
        let text = sections.collect::<Vec<_>>().concat();
        let (eds, _) = read("a.dcf", text.as_bytes()).unwrap();
        let mut report = Report::new("a.dcf");
        let entries = entries(&mut report, &eds, &Former::default());
        (
            entries.iter().map(|entry| format!("{} {} {}", entry.object, entry.kind, entry.value)).collect(),
            report.finish().into_iter().map(|problem| problem.message).collect(),
        )
    }

    #[test]
    fn what_a_dcf_changes_is_written_in_order() {
        let (entries, problems) = found(&[
            ("6131", "7", "rw", "DefaultValue=1\nParameterValue=0x4E0000"),
            ("2000", "3", "rw", "DefaultValue=0\nParameterValue=0xFFFE"),
            ("2001", "1", "rw", "ParameterValue=1"),
            ("2002", "8", "rww", "ParameterValue=1.5"),
            ("2003", "8", "rw", "ParameterValue=0x3FC00000"),
            ("2004", "5", "wo", "ParameterValue=7"),
            ("2005", "5", "rw", "DefaultValue=0x10\nParameterValue=16"),
            ("2006", "5", "rw", "DefaultValue=3\nParameterValue="),
        ]);
        assert_eq!(problems, Vec::<String>::new());
        assert_eq!(
            entries,
            [
                "0x2000:0 i16 -2",
                "0x2001:0 u8 0x1",
                "0x2002:0 f32 1.5",
                "0x2003:0 f32 1.5",
                "0x2004:0 u8 0x7",
                "0x6131:0 u32 0x4E0000",
            ]
        );
    }

    #[test]
    fn what_cannot_or_must_not_be_written_is_told() {
        let (entries, problems) = found(&[
            ("1010", "7", "rw", "ParameterValue=0x65766173"),
            ("1014", "7", "rw", "DefaultValue=0\nParameterValue=$NODEID+0x80"),
            ("1017", "6", "rw", "DefaultValue=0\nParameterValue=500"),
            ("1400", "7", "rw", "ParameterValue=1"),
            ("1800", "7", "rw", "ParameterValue=1"),
            ("2000", "5", "RWX", "ParameterValue=1"),
            ("2005", "5", "ro", "ParameterValue=1"),
            ("2001", "5", "rw", "ParameterValue=256"),
            ("2002", "9", "rw", "ParameterValue=text"),
            ("2003", "5", "rw", "LowLimit=1\nHighLimit=5\nParameterValue=9"),
            ("2004", "0x1B", "rw", "ParameterValue=0xFFFFFFFFFFFFFFFF"),
        ]);
        assert_eq!(entries, ["0x2003:0 u8 0x9"]);
        let expected = [
            "0x1010:0 is a command",
            "0x1014:0 is not set: its value depends on the node id",
            "the settings of RPDOs",
            "0x2000:0 is not set: it is not known whether",
            "0x2001:0 is not set: 256 does not fit 8 bits",
            "0x2002:0 is not set: it is not a number",
            "0x2003:0 is set to 9, beyond its limits 1 to 5",
            "0x2004:0 is not set: 0xFFFFFFFFFFFFFFFF does not fit 64 bits",
        ];
        assert_eq!(problems.len(), expected.len(), "{problems:#?}");
        for (problem, expected) in problems.iter().zip(expected) {
            assert!(problem.starts_with(expected), "{problem}");
        }
    }
}
