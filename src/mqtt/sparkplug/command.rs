//! What a DCMD asks for: values for tags of one device (Sparkplug 3.0, 6.4.22). Pure.

use prost::Message as _;

use super::catalogue::{Catalogue, MetricDef};
use super::payload::{DataType, Metric, MetricValue, Payload};
use crate::process_image::{TagIndex, Value};

/// Tags that one command may write.
const MOST_WRITES: usize = 64;

/// What a message of a subscribed topic asks for, beyond what the edge node does by itself.
#[derive(Clone, Debug, PartialEq)]
pub enum Asked {
    /// Nothing.
    Nothing,
    /// These values for tags: all of them or none.
    Write(Vec<(TagIndex, Value)>),
    /// What is not done; why.
    Refused(String),
}

/// Reads a DCMD for an origin: its metrics by alias as in the birth, or by name.
///
/// # Errors
/// Why nothing of it is done: it is no payload, or one of its metrics is none of the device's, is no tag, or has no such value.
pub fn writes(
    catalogue: &Catalogue,
    origin: usize,
    payload: &[u8],
) -> Result<Vec<(TagIndex, Value)>, String> {
    let payload = Payload::decode(payload).map_err(|error| format!("it is no payload: {error}"))?;
    if payload.metrics.is_empty() {
        return Err("it has no metrics".to_owned());
    }
    if payload.metrics.len() > MOST_WRITES {
        return Err(format!("at most {MOST_WRITES} metrics are written at once"));
    }
    payload.metrics.iter().map(|metric| write(catalogue, origin, metric)).collect()
}

fn write(catalogue: &Catalogue, origin: usize, metric: &Metric) -> Result<(TagIndex, Value), String> {
    let is_it = |def: &&MetricDef| match (&metric.name, metric.alias) {
        (Some(name), _) if !name.is_empty() => def.name == *name,
        (_, alias) => alias == Some(def.alias),
    };
    let def = catalogue.of(origin).filter_map(|place| catalogue.metric(place)).find(is_it);
    let def = def.ok_or_else(|| format!("the device has no metric {}", shown(metric)))?;
    let tag = def.tag().ok_or_else(|| format!("`{}` is no tag: only tags are written", def.name))?;
    let value = value(def.data_type, metric);
    let value =
        value.ok_or_else(|| format!("`{}` is not written by that: it is {:?}", def.name, def.data_type))?;
    Ok((tag, value))
}

/// What a stranger named, in bounded length.
fn shown(metric: &Metric) -> String {
    let name = metric.name.as_deref().filter(|name| !name.is_empty());
    match (name, metric.alias) {
        (Some(name), _) => format!("`{}`", name.chars().take(40).collect::<String>()),
        (None, Some(alias)) => format!("of the alias {alias}"),
        (None, None) => "without a name and an alias".to_owned(),
    }
}

/// The value as one of the metric's type. Whole numbers have their sign by the type that the command names, else by the metric's.
fn value(known: DataType, metric: &Metric) -> Option<Value> {
    let code = metric.datatype.unwrap_or(known.code());
    // Int8 to Int64 are 1 to 4.
    let is_signed = (1..=4).contains(&code);
    let is_bit = known == DataType::Boolean;
    match *metric.value.as_ref()? {
        MetricValue::Boolean(bit) if is_bit => Some(Value::Bool(bit)),
        MetricValue::Int(whole) if !is_bit && is_signed => {
            // Narrow ones come with or without the bits of their sign.
            let bytes = whole.to_le_bytes();
            let narrow = match code {
                1 => i64::from(i8::from_le_bytes([bytes[0]])),
                2 => i64::from(i16::from_le_bytes([bytes[0], bytes[1]])),
                _ => i64::from(whole.cast_signed()),
            };
            Some(Value::Signed(narrow))
        }
        MetricValue::Int(whole) if !is_bit => Some(Value::Unsigned(whole.into())),
        MetricValue::Long(whole) if !is_bit && is_signed => Some(Value::Signed(whole.cast_signed())),
        MetricValue::Long(whole) if !is_bit => Some(Value::Unsigned(whole)),
        MetricValue::Float(number) if !is_bit => Some(Value::Float(number.into())),
        MetricValue::Double(number) if !is_bit => Some(Value::Float(number)),
        MetricValue::Boolean(_)
        | MetricValue::Int(_)
        | MetricValue::Long(_)
        | MetricValue::Float(_)
        | MetricValue::Double(_)
        | MetricValue::String(_) => None,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::mapping::{Sketch, SourceText, TagTable};
    use crate::mqtt::Identity;

    /// `level` is the device's; the others can be written.
    const PUMP: &str = r#"
format = 1
device = { vendor = "test", model = "pump" }

[tpdo.1]
cob_id = "$NODEID+0x180"
length = 1

[rpdo.1]
cob_id = "$NODEID+0x200"
length = 5

[[tag]]
name = "level"
tpdo = 1
bit = 0
type = "u8"

[[tag]]
name = "speed"
rpdo = 1
bit = 0
type = "u16"
scale = { multiply = 0.1 }

[[tag]]
name = "steps"
rpdo = 1
bit = 16
type = "i16"

[[tag]]
name = "run"
rpdo = 1
bit = 32
type = "bool"
"#;

    fn catalogue() -> (TagTable, Catalogue) {
        let table = Sketch::new().mapping(SourceText::new("pump", PUMP));
        let table = table.node("pump1", 1, "pump", |_| ()).build().unwrap().0;
        let catalogue = Catalogue::new(&table, &Identity::default());
        (table, catalogue)
    }

    fn metric(name: &str, datatype: Option<u32>, value: MetricValue) -> Metric {
        Metric { name: Some(name.to_owned()), datatype, value: Some(value), ..Metric::default() }
    }

    fn asked(metrics: Vec<Metric>) -> Result<Vec<(String, Value)>, String> {
        let (table, catalogue) = catalogue();
        let payload = Payload { metrics, ..Payload::default() }.encode_to_vec();
        let writes = writes(&catalogue, 1, &payload)?;
        Ok(writes.into_iter().map(|(tag, value)| (table.tag(tag).unwrap().name.clone(), value)).collect())
    }

    #[test]
    fn tck_id_topics_dcmd_payload_tags_are_written_by_name_or_alias_with_the_sign_of_their_type() {
        for (datatype, value, expected) in [
            (Some(10), MetricValue::Double(12.5), Value::Float(12.5)),
            (Some(9), MetricValue::Float(12.5), Value::Float(12.5)),
            (Some(7), MetricValue::Int(12), Value::Unsigned(12)),
            (Some(1), MetricValue::Int(0xFE), Value::Signed(-2)),
            (Some(2), MetricValue::Int(0xFFFE), Value::Signed(-2)),
            (Some(2), MetricValue::Int(0xFFFF_FFFE), Value::Signed(-2)),
            (Some(3), MetricValue::Int(0xFFFF_FFFE), Value::Signed(-2)),
            (Some(4), MetricValue::Long(u64::MAX), Value::Signed(-1)),
            (Some(8), MetricValue::Long(3), Value::Unsigned(3)),
            (None, MetricValue::Int(0xFFFF_FFFE), Value::Signed(-2)),
        ] {
            let asked = asked(vec![metric("steps", datatype, value)]).unwrap();
            assert_eq!(asked, [("steps".to_owned(), expected)], "{datatype:?}");
        }
        let (_, catalogue) = catalogue();
        let alias = catalogue.of(1).filter_map(|place| catalogue.metric(place)).find(|def| def.name == "run");
        let run = Metric {
            alias: Some(alias.unwrap().alias),
            value: Some(MetricValue::Boolean(true)),
            ..Metric::default()
        };
        let speed = metric("speed", None, MetricValue::Double(50.0));
        assert_eq!(
            asked(vec![run, speed]),
            Ok(vec![("run".to_owned(), Value::Bool(true)), ("speed".to_owned(), Value::Float(50.0))])
        );
    }

    #[test]
    fn one_metric_that_cannot_be_written_refuses_the_whole_command() {
        let good = metric("speed", None, MetricValue::Double(50.0));
        let text = || MetricValue::String("fast".to_owned());
        for (bad, why) in [
            (metric("no_such", None, MetricValue::Int(1)), "has no metric `no_such`"),
            (metric("NMT State", None, text()), "`NMT State` is no tag"),
            (metric("Alarm/node_lost", None, MetricValue::Boolean(false)), "is no tag"),
            (metric("speed", None, text()), "not written by that: it is Double"),
            (metric("run", None, MetricValue::Int(1)), "not written by that: it is Boolean"),
            (metric("steps", None, MetricValue::Boolean(true)), "it is Int32"),
            (
                Metric { name: Some("speed".to_owned()), is_null: Some(true), ..Metric::default() },
                "not written",
            ),
            (Metric { alias: Some(0), ..Metric::default() }, "of the alias 0"),
            (Metric::default(), "without a name"),
        ] {
            let said = asked(vec![good.clone(), bad]).unwrap_err();
            assert!(said.contains(why), "{said}");
        }
        assert!(asked(vec![]).unwrap_err().contains("no metrics"));
        assert!(asked(vec![good; MOST_WRITES + 1]).unwrap_err().contains("at most 64"));
        assert!(writes(&catalogue().1, 1, b"\xFF\xFF").unwrap_err().contains("no payload"));
        assert!(writes(&catalogue().1, 9, b"\x12\x02\x10\x07").unwrap_err().contains("has no metric"));
    }
}
