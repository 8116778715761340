//! `cangate sdo` with the name of a tag: which object that is, and its value in engineering units. \[IO\]

use std::path::Path;

use super::Exit;
use super::load;
use super::output::{print_diagnostics, print_error, read_file};
use super::tool_args::{SdoArguments, SdoCommand};
use crate::canopen::object::{DataType, ObjectId};
use crate::canopen::sdo::SdoRequest;
use crate::mapping::suggest::closest;
use crate::mapping::table::Told;
use crate::mapping::{Field, FieldKind, Scale, Sketch, Source, SourceText, TagDef, TagTable, codec};
use crate::process_image::{NodeIndex, Quality, Value};

/// A tag that is an object of the device.
pub(super) struct TagObject {
    name: String,
    object: ObjectId,
    /// Of the object's own bytes, whatever TPDO carries them too.
    field: Field,
    scale: Scale,
    unit: String,
    decimals: usize,
}

/// The tag of this name. What is wrong is printed.
pub(super) fn find(arguments: &SdoArguments, name: &str) -> Result<TagObject, Exit> {
    let (table, node) = table(arguments, name)?;
    of(&table, node, name).map_err(|text| {
        print_error(&text);
        Exit::Usage
    })
}

/// The tag table that the command line names, and the node in it.
fn table(arguments: &SdoArguments, name: &str) -> Result<(TagTable, NodeIndex), Exit> {
    if let Some(mapping) = &arguments.mapping {
        return Ok((of_mapping(mapping, arguments.node.get())?, NodeIndex(0)));
    }
    let Some(file) = &arguments.config else {
        print_error(&format!(
            "`{name}` is the name of a tag: say of which device, for example --mapping danfoss-dst-p92c, or \
             -c /etc/cangate/cangate.toml; or name the object by index and sub-index, as 0x1018:1"
        ));
        return Err(Exit::Usage);
    };
    let loaded = load::configuration(file)?;
    let has_id = |place: &usize| {
        loaded
            .table
            .nodes
            .get(*place)
            .is_some_and(|node| node.canopen().is_some_and(|settings| settings.id == arguments.node))
    };
    let is_here = |place: &usize| {
        let bus = loaded.table.nodes.get(*place).map(|node| node.bus);
        bus.and_then(|bus| loaded.interfaces.get(bus.0)) == Some(&arguments.interface)
    };
    let nodes: Vec<usize> = (0..loaded.table.nodes.len()).filter(has_id).collect();
    // The interface may have another name while a device is on the bench; then its id alone must be enough.
    let found =
        nodes.iter().copied().find(is_here).or(if let [only] = nodes[..] { Some(only) } else { None });
    let Some(found) = found else {
        let file = file.display();
        print_error(&format!(
            "{file} does not say which node {} is on `{}`",
            arguments.node, arguments.interface
        ));
        return Err(Exit::Usage);
    };
    Ok((loaded.table, NodeIndex(found)))
}

/// A table of one node with this mapping.
fn of_mapping(mapping: &str, id: u8) -> Result<TagTable, Exit> {
    let is_path = mapping.contains('/') || Path::new(mapping).extension().is_some_and(|end| end == "toml");
    let mut sketch = Sketch::new();
    if is_path {
        sketch = sketch.mapping(SourceText::new(mapping, read_file(mapping.as_ref())?));
    }
    sketch.node("node", id, mapping, |_| ()).build().map(|(table, _)| table).map_err(|problems| {
        print_diagnostics(&problems);
        Exit::Configuration
    })
}

fn of(table: &TagTable, node: NodeIndex, name: &str) -> Result<TagObject, String> {
    let tags = table.node(node).and_then(|node| table.tags.get(node.tags.clone())).unwrap_or_default();
    let objects = || tags.iter().filter(|tag| tag.object.is_some()).map(|tag| tag.name.as_str());
    let Some(tag) = tags.iter().find(|tag| tag.name == name) else {
        let hint = match closest(name, objects()) {
            Some(close) => format!("did you mean `{close}`?"),
            None => format!("tags that are objects: {}", objects().collect::<Vec<_>>().join(", ")),
        };
        return Err(format!("there is no tag `{name}`; {hint}"));
    };
    let (
        Some(object),
        Source::Pdo { field, scale, .. }
        | Source::Polled { field, scale, .. }
        | Source::Adopted { field, scale, .. }
        | Source::Rpdo { field, scale, .. },
    ) = (tag.object, &tag.source)
    else {
        return Err(format!(
            "the mapping does not say that `{name}` is an object; those that are: {}",
            objects().collect::<Vec<_>>().join(", ")
        ));
    };
    let (scale, unit) = scale_and_unit(tag, *scale)?;
    Ok(TagObject {
        name: tag.name.clone(),
        object,
        field: Field { bit: 0, ..*field },
        scale,
        unit,
        decimals: tag.decimals.into(),
    })
}

/// Where the device tells its unit, what the mapping sees to that it is.
fn scale_and_unit(tag: &TagDef, scale: Scale) -> Result<(Scale, String), String> {
    let Some(device) = &tag.device_unit else { return Ok((scale, tag.unit.clone())) };
    let assumed = |told: &Option<Told>| told.as_ref().and_then(|told| told.assumed);
    let reading = device.reading(scale, assumed(&device.unit), assumed(&device.digits));
    if reading.quality != Quality::Good {
        let objects = device.unit.iter().chain(&device.digits).map(|told| told.object.to_string());
        return Err(format!(
            "only the device knows the unit and the decimal digits of `{}`: read {}, then the object itself",
            tag.name,
            objects.collect::<Vec<_>>().join(" and ")
        ));
    }
    let unit = if device.target.is_some() || device.unit.is_none() { tag.unit.clone() } else { reading.unit };
    Ok((reading.scale, unit))
}

impl TagObject {
    pub(super) fn object(&self) -> ObjectId {
        self.object
    }

    /// What is asked of the client.
    pub(super) fn request(&self, action: &SdoCommand) -> Result<SdoRequest, String> {
        match action {
            SdoCommand::Read { data_type: None, .. } => Ok(SdoRequest::read(self.object).of_len(self.size())),
            SdoCommand::Write { data_type: None, value, .. } => {
                Ok(SdoRequest::write(self.object, self.bytes(value)?))
            }
            SdoCommand::Read { .. } | SdoCommand::Write { .. } => {
                Err(format!("leave --type out: the mapping tells the type of `{}`", self.name))
            }
        }
    }

    /// What is printed after a success.
    pub(super) fn told(&self, action: &SdoCommand, bytes: &[u8]) -> Option<String> {
        let (name, object) = (&self.name, self.object);
        match action {
            SdoCommand::Read { raw: true, .. } => DataType::OctetString.decode(bytes).ok(),
            SdoCommand::Read { .. } => Some(format!("{name} = {}  ({object})", self.shown(bytes))),
            SdoCommand::Write { value, .. } => {
                Some(format!("{name} ({object}) is written: {value}{}", self.unit()))
            }
        }
    }

    /// A value with its unit, or the bytes where they are not as many as the type has.
    fn shown(&self, bytes: &[u8]) -> String {
        let raw = codec::decode(&self.field, bytes).filter(|_| bytes.len() == self.size());
        let Some(raw) = raw else {
            let hex = DataType::OctetString.decode(bytes).unwrap_or_default();
            return format!("{hex}, which are {} bytes and not {}", bytes.len(), self.size());
        };
        let value = match codec::scale(&self.scale, raw) {
            Value::Float(number) => format!("{number:.*}", self.decimals),
            value @ (Value::Bool(_) | Value::Unsigned(_) | Value::Signed(_)) => value.to_string(),
        };
        format!("{value}{}", self.unit())
    }

    /// A value in engineering units as the bytes of the object.
    fn bytes(&self, text: &str) -> Result<Vec<u8>, String> {
        let data_type = self.data_type().ok_or_else(|| {
            format!(
                "`{}` is not a whole number of bytes: write {} by its index and sub-index",
                self.name, self.object
            )
        })?;
        let raw = if self.scale == Scale::IDENTITY {
            text.to_owned()
        } else {
            let value: f64 = text.parse().map_err(|_| format!("`{text}` is no number"))?;
            let raw = (value - self.scale.add) * self.scale.divide / self.scale.multiply;
            if self.field.kind == FieldKind::Float { raw.to_string() } else { format!("{raw:.0}") }
        };
        let mut bytes = data_type.encode(&raw).map_err(|error| format!("{}: {error}", self.name))?;
        if self.field.invert {
            let mask = if self.field.kind == FieldKind::Bool { 1 } else { 0xFF };
            for byte in &mut bytes {
                *byte ^= mask;
            }
        }
        if self.field.big_endian {
            bytes.reverse();
        }
        Ok(bytes)
    }

    fn data_type(&self) -> Option<DataType> {
        let width = self.field.width;
        let word = match self.field.kind {
            FieldKind::Bool => "bool".to_owned(),
            FieldKind::Unsigned => format!("u{width}"),
            FieldKind::Signed => format!("i{width}"),
            FieldKind::Float => format!("f{width}"),
        };
        word.parse().ok()
    }

    /// In bytes.
    fn size(&self) -> usize {
        usize::from(self.field.width.div_ceil(8))
    }

    fn unit(&self) -> String {
        if self.unit.is_empty() { String::new() } else { format!(" {}", self.unit) }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn tag(name: &str) -> Result<TagObject, String> {
        of(&of_mapping("danfoss-dst-p92c", 1).unwrap(), NodeIndex(0), name)
    }

    fn read() -> SdoCommand {
        SdoCommand::Read { object: "x".parse().unwrap(), data_type: None, raw: false }
    }

    #[test]
    fn a_tag_is_read_by_name_in_its_unit() {
        let pressure = tag("pressure").unwrap();
        let request = pressure.request(&read()).unwrap();
        assert_eq!((request.object, request.len), ("0x6130:1".parse().unwrap(), Some(4)));
        let told = pressure.told(&read(), &12.3456_f32.to_le_bytes()).unwrap();
        assert_eq!(told, "pressure = 12.346 bar  (0x6130:1)");
        let temperature = tag("temperature").unwrap();
        assert_eq!(
            temperature.told(&read(), &215_i32.to_le_bytes()).unwrap(),
            "temperature = 21.5 °C  (0x9130:2)",
            "it stands in bits 32 to 63 of its TPDO, but in bits 0 to 31 of its object"
        );
        assert_eq!(
            tag("pressure_status").unwrap().told(&read(), &[5]).unwrap(),
            "pressure_status = 5  (0x6150:1)"
        );
        assert!(pressure.told(&read(), &[1, 2]).unwrap().contains("2 bytes and not 4"));
    }

    #[test]
    fn a_value_in_engineering_units_becomes_the_bytes_of_the_object() {
        let temperature = tag("temperature").unwrap();
        assert_eq!(temperature.bytes("-21.5"), Ok((-215_i32).to_le_bytes().to_vec()));
        assert_eq!(tag("pressure").unwrap().bytes("1.5"), Ok(1.5_f32.to_le_bytes().to_vec()));
        assert_eq!(tag("pressure_status").unwrap().bytes("0x1F"), Ok(vec![0x1F]));
        assert!(tag("pressure_status").unwrap().bytes("256").unwrap_err().contains("0 to 255"));
        assert!(temperature.bytes("warm").is_err() && temperature.bytes("1e30").is_err());
    }

    #[test]
    fn a_name_that_is_no_object_is_refused_with_those_that_are() {
        let text = |name: &str| tag(name).err().unwrap();
        assert!(text("presure").contains("did you mean `pressure`?"));
        assert!(text("pressure_invalid").contains("pressure_status"), "{}", text("pressure_invalid"));
        assert_eq!(of_mapping("no-such-mapping", 1).err(), Some(Exit::Configuration));
    }

    #[test]
    fn what_has_a_colon_is_an_object_and_a_snake_case_word_a_tag() {
        use super::super::tool_args::ObjectOrTag;
        assert_eq!("0x1018:1".parse(), Ok(ObjectOrTag::Object(ObjectId::new(0x1018, 1))));
        assert_eq!("pressure".parse(), Ok(ObjectOrTag::Tag("pressure".into())));
        for wrong in ["1018:1", "0x1018", "Pressure", ""] {
            assert!(wrong.parse::<ObjectOrTag>().is_err(), "{wrong}");
        }
    }
}
