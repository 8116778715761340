//! Objects of the communication profile area that CiA 301 (and CiA 302 for NMT start-up) defines: their names and types, so
//! that nobody has to type them.

use super::object::{DataType, ObjectId};

/// The name of an object, for people; `None` where CiA 301 defines none.
#[must_use]
pub fn name(object: ObjectId) -> Option<&'static str> {
    lookup(object).map(|(name, _)| name)
}

/// The type of an object; `None` where CiA 301 defines none.
#[must_use]
pub fn data_type(object: ObjectId) -> Option<DataType> {
    lookup(object).map(|(_, data_type)| data_type)
}

fn lookup(object: ObjectId) -> Option<(&'static str, DataType)> {
    let ObjectId { index, sub } = object;
    Some(match (index, sub) {
        (0x1003 | 0x1010 | 0x1011 | 0x1016 | 0x1018 | 0x1020 | 0x1200..=0x1BFF, 0) => {
            ("number of entries", DataType::U8)
        }
        (0x1400..=0x15FF | 0x1800..=0x19FF, _) => return pdo_parameter(sub),
        (0x1600..=0x17FF | 0x1A00..=0x1BFF, 1..=64) => ("mapped object", DataType::U32),
        (0x1200..=0x12FF, 1) => ("COB-ID client to server", DataType::U32),
        (0x1200..=0x12FF, 2) => ("COB-ID server to client", DataType::U32),
        (0x1200..=0x12FF, 3) => ("node id of the other side", DataType::U8),
        (0x1000, 0) => ("device type", DataType::U32),
        (0x1001, 0) => ("error register", DataType::U8),
        (0x1002, 0) => ("manufacturer status register", DataType::U32),
        (0x1003, _) => ("error field", DataType::U32),
        (0x1005, 0) => ("COB-ID SYNC", DataType::U32),
        (0x1006, 0) => ("communication cycle period", DataType::U32),
        (0x1007, 0) => ("synchronous window length", DataType::U32),
        (0x1008, 0) => ("manufacturer device name", DataType::VisibleString),
        (0x1009, 0) => ("manufacturer hardware version", DataType::VisibleString),
        (0x100A, 0) => ("manufacturer software version", DataType::VisibleString),
        (0x100C, 0) => ("guard time", DataType::U16),
        (0x100D, 0) => ("life time factor", DataType::U8),
        (0x1010, _) => ("store parameters", DataType::U32),
        (0x1011, _) => ("restore default parameters", DataType::U32),
        (0x1012, 0) => ("COB-ID TIME", DataType::U32),
        (0x1014, 0) => ("COB-ID EMCY", DataType::U32),
        (0x1015, 0) => ("inhibit time EMCY", DataType::U16),
        (0x1016, 1..=127) => ("consumer heartbeat time", DataType::U32),
        (0x1017, 0) => ("producer heartbeat time", DataType::U16),
        (0x1018, 1) => ("vendor id", DataType::U32),
        (0x1018, 2) => ("product code", DataType::U32),
        (0x1018, 3) => ("revision number", DataType::U32),
        (0x1018, 4) => ("serial number", DataType::U32),
        (0x1019, 0) => ("synchronous counter overflow value", DataType::U8),
        (0x1020, 1) => ("configuration date", DataType::U32),
        (0x1020, 2) => ("configuration time", DataType::U32),
        (0x1F80, 0) => ("NMT start-up", DataType::U32),
        _ => return None,
    })
}

/// Sub-indices of 0x1400.. and 0x1800...
fn pdo_parameter(sub: u8) -> Option<(&'static str, DataType)> {
    Some(match sub {
        1 => ("COB-ID used by PDO", DataType::U32),
        2 => ("transmission type", DataType::U8),
        3 => ("inhibit time", DataType::U16),
        4 => ("compatibility entry", DataType::U8),
        5 => ("event timer", DataType::U16),
        6 => ("SYNC start value", DataType::U8),
        _ => return None,
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn r_dst_008_the_types_of_communication_objects_are_those_of_the_manual() {
        for (object, data_type) in [
            ("0x1000:0", "u32"),
            ("0x1001:0", "u8"),
            ("0x1003:0", "u8"),
            ("0x1003:1", "u32"),
            ("0x1005:0", "u32"),
            ("0x1008:0", "string"),
            ("0x1009:0", "string"),
            ("0x100A:0", "string"),
            ("0x1010:0", "u8"),
            ("0x1010:1", "u32"),
            ("0x1011:1", "u32"),
            ("0x1014:0", "u32"),
            ("0x1016:1", "u32"),
            ("0x1017:0", "u16"),
            ("0x1018:0", "u8"),
            ("0x1018:4", "u32"),
            ("0x1800:0", "u8"),
            ("0x1800:1", "u32"),
            ("0x1800:2", "u8"),
            ("0x1800:3", "u16"),
            ("0x1800:4", "u8"),
            ("0x1800:5", "u16"),
            ("0x1A00:0", "u8"),
            ("0x1A00:4", "u32"),
            ("0x1F80:0", "u32"),
        ] {
            let object: ObjectId = object.parse().unwrap();
            assert_eq!(super::data_type(object).map(DataType::word), Some(data_type), "{object}");
            assert!(name(object).is_some());
        }
        for object in ["0x1018:5", "0x1000:1", "0x1800:7", "0x1A00:65", "0x6130:1", "0x2000:0"] {
            assert_eq!(super::data_type(object.parse().unwrap()), None, "{object}");
        }
    }
}
