//! Bytes of an EDS or DCF to what they say.

use super::charset::decode;
use super::ini::Ini;
use super::model::{DeviceInfo, Eds};
use super::objects::{objects, whole};
use super::report::{Place, Report};
use crate::mapping::Diagnostic;

/// Bit rates of CANopen, in kbit/s.
const BIT_RATES: [u32; 9] = [10, 20, 50, 100, 125, 250, 500, 800, 1000];

/// Reads an EDS or DCF (CiA 306); with it come the warnings. Or why it cannot be used, warnings included.
///
/// `file` is the name for messages. The work is bounded by the size of the file; files above 16 MiB, a million lines or
/// 65536 objects are refused.
pub fn read(file: &str, bytes: &[u8]) -> Result<(Eds, Vec<Diagnostic>), Vec<Diagnostic>> {
    let mut report = Report::new(file);
    match read_text(&mut report, file, bytes) {
        Some(eds) => Ok((eds, report.finish())),
        None => Err(report.finish()),
    }
}

fn read_text(report: &mut Report, file: &str, bytes: &[u8]) -> Option<Eds> {
    let text = match decode(bytes) {
        Ok(text) => text,
        Err(wrong) => {
            report.error(wrong.place, wrong.message, wrong.hint);
            return None;
        }
    };
    let ini = Ini::read(report, &text)?;
    let (objects, groups) = objects(report, &ini)?;
    if objects.is_empty() {
        report.error(
            Place::START,
            "no object is described in this file",
            "is it an EDS or DCF? It has sections such as [1000] and [1018sub1]",
        );
        return None;
    }
    let (node_id, bit_rate) = commissioning(report, &ini);
    Some(Eds { file: file.to_owned(), device: device(report, &ini), objects, groups, node_id, bit_rate })
}

fn device(report: &mut Report, ini: &Ini) -> DeviceInfo {
    let text = |section: &str, key: &str| {
        ini.section(section).map(|section| section.text(key).to_owned()).unwrap_or_default()
    };
    let mut number = |key: &str| {
        let entry = ini.section("deviceinfo")?.get(key)?;
        let number = whole(report, entry).and_then(|number| u32::try_from(number).ok());
        if number.is_none() {
            report.warn(entry.place, format!("`{key}` is not a number of 32 bits"), "it is left out");
        }
        number
    };
    let (version, revision) = (text("fileinfo", "fileversion"), text("fileinfo", "filerevision"));
    let modified = text("fileinfo", "modificationdate");
    DeviceInfo {
        vendor_number: number("vendornumber"),
        product_number: number("productnumber"),
        revision_number: number("revisionnumber"),
        vendor_name: text("deviceinfo", "vendorname"),
        product_name: text("deviceinfo", "productname"),
        description: text("fileinfo", "description"),
        file_version: match (version.as_str(), revision.as_str()) {
            ("", _) => String::new(),
            (version, "") => version.to_owned(),
            (version, revision) => format!("{version}.{revision}"),
        },
        file_date: if modified.is_empty() { text("fileinfo", "creationdate") } else { modified },
    }
}

/// Node id and bit rate (in bit/s) of a DCF.
fn commissioning(report: &mut Report, ini: &Ini) -> (Option<u8>, Option<u32>) {
    let Some(section) = ini.section("devicecomissioning").or_else(|| ini.section("devicecommissioning"))
    else {
        return (None, None);
    };
    let node_id = section.get("nodeid").and_then(|entry| {
        let id = whole(report, entry).and_then(|id| u8::try_from(id).ok());
        let valid = id.filter(|id| (1..=127).contains(id));
        // 0 and 255 say that the device has none yet.
        if valid.is_none() && !matches!(id, Some(0 | 255)) {
            report.warn(entry.place, format!("`{}` is not a node id", entry.value), "write 1 to 127");
        }
        valid
    });
    let bit_rate = section.get("baudrate").and_then(|entry| {
        let rate = whole(report, entry).and_then(|rate| u32::try_from(rate).ok());
        let valid = rate.filter(|rate| BIT_RATES.contains(rate));
        if valid.is_none() && rate != Some(0) {
            let message = format!("`{}` kbit/s is no bit rate of CANopen", entry.value);
            report.warn(entry.place, message, format!("write one of {BIT_RATES:?}"));
        }
        valid.map(|rate| rate * 1000)
    });
    (node_id, bit_rate)
}

#[cfg(test)]
mod tests {
    use super::super::model::{Access, DataType, ObjectId};
    use super::*;

    fn eds(text: &str) -> (Eds, Vec<String>) {
        let (eds, problems) = read("a.eds", text.as_bytes()).unwrap();
        (eds, problems.iter().map(|problem| format!("{}: {}", problem.line, problem.message)).collect())
    }

    #[test]
    fn an_object_has_name_type_access_limits_and_values() {
        let (eds, problems) = eds("[6401]\nParameterName=Temperature\nObjectType=0x7\nDataType=0x0003\n\
             AccessType=RW\nDefaultValue=20\nLowLimit=-40\nHighLimit=0x7F\nPDOMapping=1\nParameterValue=25\nUnit=°C\n");
        assert_eq!(problems, Vec::<String>::new());
        let object = &eds.objects[&ObjectId::new(0x6401, 0)];
        assert_eq!(object.name, "Temperature");
        assert_eq!((object.data_type, object.access), (DataType::Integer(16), Access::ReadWrite));
        assert_eq!(object.number().unwrap().base, 25);
        assert_eq!(object.default.as_ref().unwrap().text, "20");
        assert_eq!(object.default.as_ref().unwrap().place, Place { line: 6, column: 14 });
        assert_eq!(object.low_limit.as_ref().unwrap().whole().unwrap().base, -40);
        assert_eq!(object.high_limit.as_ref().unwrap().whole().unwrap().base, 127);
        assert!(object.pdo_mapping);
        assert_eq!(object.unit, "°C");
    }

    #[test]
    fn arrays_records_and_compact_objects_are_taken_apart() {
        let (eds, problems) = eds("[1018]\nParameterName=Identity\nObjectType=9\nSubNumber=2\n\
             [1018sub0]\nParameterName=n\nDataType=5\nAccessType=ro\nDefaultValue=10\n\
             [1018SubA]\nParameterName=Ten\nDataType=7\nAccessType=ro\n\
             [2000]\nParameterName=Level\nObjectType=8\nDataType=6\nAccessType=rw\nDefaultValue=5\nCompactSubObj=3\n\
             [2000Value]\nNrOfEntries=1\n2=7\n[2000Name]\nNrOfEntries=1\n3=Tank\n");
        assert_eq!(problems, Vec::<String>::new());
        assert_eq!(eds.groups[&0x1018], "Identity");
        assert_eq!(eds.objects[&ObjectId::new(0x1018, 10)].name, "Ten");
        let level = |sub| &eds.objects[&ObjectId::new(0x2000, sub)];
        assert_eq!(level(0).number().unwrap().base, 3);
        assert_eq!((level(1).name.as_str(), level(1).number().unwrap().base), ("Level 1", 5));
        assert_eq!(level(2).number().unwrap().base, 7);
        assert_eq!(level(3).name, "Tank");
        assert!(!eds.objects.contains_key(&ObjectId::new(0x2000, 4)));
    }

    #[test]
    fn both_spellings_of_commissioning_are_read() {
        for section in ["DeviceComissioning", "devicecommissioning"] {
            let (eds, problems) =
                eds(&format!("[{section}]\nNodeId=0x0A\nBaudRate=250\n[1000]\nDataType=7\n"));
            assert_eq!((eds.node_id, eds.bit_rate), (Some(10), Some(250_000)), "{problems:?}");
        }
        let (eds, problems) = eds("[DeviceComissioning]\nNodeID=200\nBaudrate=300\n[1000]\nDataType=7\n");
        assert_eq!((eds.node_id, eds.bit_rate), (None, None));
        assert_eq!(problems, ["2: `200` is not a node id", "3: `300` kbit/s is no bit rate of CANopen"]);
    }

    #[test]
    fn makers_mistakes_are_told_by_line_and_the_rest_is_read() {
        let text = "[MandatoryObjects]\nSupportedObjects=3\n1=0x1000\n2=0x1001\n\
             [1000]\nObjectType=0x77\nDataType=seven\nAccessType=UNKNOWN\n\
             [2001]\nObjectType=7\nDataType=5 ; byte\nDefaultValue=x\n[2001sub1]\nDataType=5\nDefaultValue=010\n\
             [2002sub1]\nDataType=5\nDefaultValue=09\n[M1FixedObjects]\n[Whatever]\n[2002sub01]\nDataType=6\n";
        let (eds, problems) = eds(text);
        assert_eq!(
            problems,
            [
                "2: SupportedObjects says 3, but 2 are listed",
                "4: object 1001h is listed, but there is no [1001]",
                "6: there is no object type `0x77`",
                "7: there is no data type `seven`",
                "8: there is no access type `UNKNOWN`",
                "10: 2001h is called a variable, but has sub-indices",
                "15: `010` is octal, that is 8",
                "19: modules are not supported; their objects are left out",
                "20: section [Whatever] is not of the standard",
                "21: [2002sub01] means the same as [2002sub1]",
                "21: [2002sub01] has no [2002] that it belongs to",
            ]
        );
        assert_eq!(eds.objects[&ObjectId::new(0x2001, 1)].number().unwrap().base, 8);
        assert_eq!(eds.objects[&ObjectId::new(0x2002, 1)].data_type, DataType::Unsigned(16));
    }

    #[test]
    fn a_file_without_objects_or_text_is_refused() {
        for bytes in [&b""[..], b"<html>", b"\0\0", b"\xFF\xFE[\0", b"[DeviceInfo]\nVendorName=x\n"] {
            let problems = read("a.eds", bytes).unwrap_err();
            assert!(problems.iter().any(|problem| problem.severity == crate::mapping::Severity::Error));
        }
    }
}
