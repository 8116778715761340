//! Where a tag's value comes from, in words for the register map.

use crate::mapping::{Derived, EmergencyPart, Field, FieldKind, ModuleCarrier, NodeDef, Source, TagTable};
use crate::process_image::TagIndex;

/// `TPDO3 byte 0 bit 1`, `maximum of knock_intensity_1 .. knock_intensity_20`.
#[must_use]
pub fn source_text(table: &TagTable, node: &NodeDef, source: &Source) -> String {
    match source {
        Source::Pdo { pdo, field, .. } => {
            let number = node.pdos().get(*pdo).map_or(0, |pdo| pdo.number);
            format!("TPDO{number} {}", field_text(*field))
        }
        Source::Rpdo { rpdo, field, .. } => {
            let number = node.rpdos.get(*rpdo).map_or(0, |rpdo| rpdo.number);
            format!("RPDO{number} {}", field_text(*field))
        }
        Source::Polled { poll, .. } => {
            let object = node.protocol.polls().get(*poll).map(|poll| poll.object);
            object.map_or_else(String::new, |object| format!("SDO {object}"))
        }
        Source::Adopted { object, .. } => format!("{object}, where the device maps it"),
        Source::Emergency { part, .. } => match part {
            EmergencyPart::Code => "EMCY error code".to_owned(),
            EmergencyPart::Register => "EMCY error register".to_owned(),
            EmergencyPart::Vendor => "EMCY manufacturer bytes".to_owned(),
            EmergencyPart::ActiveCount => "number of errors".to_owned(),
        },
        Source::Module { carrier, field, .. } => module_text(node, *carrier, *field),
        Source::Derived(derived) => derived_text(table, derived),
    }
}

/// The identifier of the PDO in which it stands, node id added; of an RPDO where the gateway may send it.
#[must_use]
pub fn cob_id(node: &NodeDef, source: &Source) -> Option<String> {
    let id = match source {
        Source::Pdo { pdo, .. } => node.pdos().get(*pdo)?.cob_id,
        Source::Rpdo { rpdo, .. } => node.canopen()?.rpdos.get(*rpdo)?.cob_id,
        Source::Polled { .. }
        | Source::Adopted { .. }
        | Source::Emergency { .. }
        | Source::Module { .. }
        | Source::Derived(_) => {
            return None;
        }
    };
    Some(format!("0x{id}"))
}

/// `CAN status byte bit 0`, `channel 1 bytes received`.
fn module_text(node: &NodeDef, carrier: usize, field: Field) -> String {
    let Some(module) = node.protocol.module() else { return String::new() };
    let Some(value) = ModuleCarrier::at(carrier, module.channels.len()) else { return String::new() };
    match field.kind {
        FieldKind::Bool => format!("{} bit {}", value.text(module), field.bit),
        FieldKind::Unsigned | FieldKind::Signed | FieldKind::Float => value.text(module),
    }
}

fn field_text(field: Field) -> String {
    let (byte, bit) = (field.bit / 8, field.bit % 8);
    let last = u16::from(field.bit) + u16::from(field.width.max(1)) - 1;
    match (bit, field.width) {
        (0, 8) => format!("byte {byte}"),
        (0, width) if width % 8 == 0 => format!("bytes {byte}-{}", last / 8),
        (_, 0 | 1) => format!("byte {byte} bit {bit}"),
        _ if u16::from(byte) == last / 8 => format!("byte {byte} bits {bit}-{}", last % 8),
        _ => format!("bits {}-{last}", field.bit),
    }
}

fn derived_text(table: &TagTable, derived: &Derived) -> String {
    let name = |tag: &TagIndex| table.tag(*tag).map_or("?", |def| def.name.as_str());
    let names = |tags: &[TagIndex]| match tags {
        [] => "nothing".to_owned(),
        [one] => name(one).to_owned(),
        [first, .., last] => format!("{} .. {}", name(first), name(last)),
    };
    match derived {
        Derived::Bit { of, bit } => format!("bit {bit} of {}", name(of)),
        Derived::Pack { of } => format!("bits {}", names(of)),
        Derived::Logic { when } => {
            let mut tags: Vec<&str> = Vec::new();
            when.for_each_tag(&mut |tag| tags.push(name(&tag)));
            format!("condition on {}", tags.join(", "))
        }
        Derived::Maximum { among, .. } => format!("maximum of {}", names(among)),
        Derived::ArgMaximum { among, .. } => format!("number of the maximum of {}", names(among)),
        Derived::Margin { among, limit, .. } => format!("{} minus {}", name(limit), names(among)),
        Derived::Count { of } => format!("number of {}", names(of)),
        Derived::RisingEdges { of } => format!("rising edges of {}", name(of)),
        Derived::SecondsSinceRise { of } => format!("seconds since the last rise of {}", name(of)),
        Derived::Latch { of } => format!("{}, latched", name(of)),
        Derived::EdgesWithin { of, window } => {
            format!("rising edges of {} in the last {} s", name(of), window.as_secs())
        }
        Derived::Constant { value } => format!("constant {value}"),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn text(bit: u8, width: u8) -> String {
        field_text(Field { bit, width, kind: FieldKind::Unsigned, big_endian: false, invert: false })
    }

    #[test]
    fn fields_are_told_by_byte_and_bit() {
        assert_eq!(text(0, 8), "byte 0");
        assert_eq!(text(16, 16), "bytes 2-3");
        assert_eq!(text(3, 1), "byte 0 bit 3");
        assert_eq!(text(34, 4), "byte 4 bits 2-5");
        assert_eq!(text(6, 4), "bits 6-9");
        assert_eq!(text(0, 64), "bytes 0-7");
    }
}
