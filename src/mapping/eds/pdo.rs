//! What the TPDOs of a device carry: the objects 0x1800.. and 0x1A00.. of its EDS (CiA 301, 7.5.2.37).

use std::fmt;

use super::model::{Eds, Object, ObjectId, Value};
use super::report::{Place, Report};

/// TPDOs that a device can have.
pub const MOST_TPDOS: u16 = 512;
/// Bits of a frame.
const FRAME_BITS: u32 = 64;
/// Highest index of a data type; mapped, it is a gap of so many bits.
const HIGHEST_DUMMY: u16 = 0x1F;
/// TPDOs whose identifier CiA 301 gives: 0x180, 0x280, 0x380, 0x480 plus the node id.
const PREDEFINED: u16 = 4;

/// A TPDO as it is sent when the device was configured as the file says.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Tpdo {
    /// 1..=512.
    pub number: u16,
    /// Its identifier.
    pub cob_id: CobId,
    /// Its content in order.
    pub maps: Vec<Mapped>,
    /// Transmission type, where the file says it.
    pub transmission_type: Option<u8>,
    /// Event timer in ms, where the file says it; 0 = off.
    pub event_timer_ms: Option<u16>,
    /// Inhibit time in us, where the file says it; 0 = off.
    pub inhibit_time_us: Option<u32>,
    /// Whether a DCF makes it other than the device's default.
    pub is_configured: bool,
}

/// An identifier without its flags.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct CobId {
    /// The number, node id not added; above 0x7FF it has 29 bits.
    pub base: u32,
    /// Whether the node id is added.
    pub plus_node_id: bool,
}

/// As a mapping file has it.
impl fmt::Display for CobId {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        if self.plus_node_id {
            write!(f, "$NODEID+0x{:X}", self.base)
        } else {
            write!(f, "0x{:X}", self.base)
        }
    }
}

/// One object in a TPDO.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Mapped {
    /// The object.
    pub object: ObjectId,
    /// Its bits in the frame, 1..=64.
    pub bits: u8,
}

impl Mapped {
    /// Whether it is a gap, not a value.
    #[must_use]
    pub fn is_gap(&self) -> bool {
        self.object.index <= HIGHEST_DUMMY
    }
}

/// As a mapping file has it: `0x6401:1/16`.
impl fmt::Display for Mapped {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}/{}", self.object, self.bits)
    }
}

/// The TPDOs that are sent, and those that the device has but does not send by default.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Tpdos {
    /// Sent.
    pub sent: Vec<Tpdo>,
    /// Numbers of those that are off or empty.
    pub off: Vec<u16>,
}

/// All TPDOs of a device. What cannot be used is told and left out.
pub fn tpdos(report: &mut Report, eds: &Eds) -> Tpdos {
    let mut all = Tpdos::default();
    for number in 1..=MOST_TPDOS {
        let reader = Reader { eds, number };
        if !eds.groups.contains_key(&reader.communication())
            && reader.object(reader.communication(), 1).is_none()
        {
            continue;
        }
        match reader.tpdo(report) {
            Ok(tpdo) => all.sent.push(tpdo),
            Err(Skipped::Off) => all.off.push(number),
            Err(Skipped::Told) => {}
        }
    }
    all
}

/// Why a TPDO is left out.
enum Skipped {
    /// The device does not send it by default.
    Off,
    /// It cannot be used, which was told.
    Told,
}

struct Reader<'a> {
    eds: &'a Eds,
    number: u16,
}

impl Reader<'_> {
    fn communication(&self) -> u16 {
        0x17FF + self.number
    }

    fn mapping(&self) -> u16 {
        0x19FF + self.number
    }

    fn object(&self, index: u16, sub: u8) -> Option<&Object> {
        self.eds.objects.get(&ObjectId::new(index, sub))
    }

    /// A value as a number without the node id.
    fn number_of(&self, index: u16, sub: u8) -> Option<i128> {
        self.object(index, sub)?.number()?.of(self.eds.node_id)
    }

    fn skip<T>(&self, report: &mut Report, place: Place, why: &str, hint: &str) -> Result<T, Skipped> {
        report.warn(place, format!("TPDO {} is left out: {why}", self.number), hint);
        Err(Skipped::Told)
    }

    fn tpdo(&self, report: &mut Report) -> Result<Tpdo, Skipped> {
        let cob_id = self.cob_id(report)?;
        let maps = self.maps(report)?;
        let communication = self.communication();
        let transmission_type = self.number_of(communication, 2).and_then(|number| u8::try_from(number).ok());
        if let (Some(252 | 253), Some(object)) = (transmission_type, self.object(communication, 2)) {
            let message = format!("TPDO {} is sent only when it is asked for by a remote frame", self.number);
            let hint = "the gateway does not ask; give it transmission type 255 and an event timer";
            report.warn(object.place, message, hint);
        }
        Ok(Tpdo {
            number: self.number,
            cob_id,
            maps,
            transmission_type,
            event_timer_ms: self.number_of(communication, 5).and_then(|number| u16::try_from(number).ok()),
            inhibit_time_us: self
                .number_of(communication, 3)
                .and_then(|number| u16::try_from(number).ok())
                .map(|hundreds| u32::from(hundreds) * 100),
            is_configured: self.is_configured(),
        })
    }

    /// Whether a DCF changes one of its parameters.
    fn is_configured(&self) -> bool {
        [self.communication(), self.mapping()].into_iter().any(|index| {
            let range = ObjectId::new(index, 0)..=ObjectId::new(index, u8::MAX);
            self.eds.objects.range(range).any(|(_, object)| {
                let number = |value: &Option<Value>| value.as_ref().and_then(Value::whole);
                let asked = number(&object.parameter_value).and_then(|asked| asked.of(self.eds.node_id));
                let usual = number(&object.default).and_then(|usual| usual.of(self.eds.node_id));
                asked.is_some() && asked != usual
            })
        })
    }

    fn cob_id(&self, report: &mut Report) -> Result<CobId, Skipped> {
        let own = self.object(self.communication(), 1);
        let place =
            own.and_then(Object::value).map_or(own.map_or(Place::START, |own| own.place), |at| at.place);
        let base = 0x80 + 0x100 * u32::from(self.number);
        let predefined = CobId { base, plus_node_id: true };
        let is_predefined = self.number <= PREDEFINED;
        let Some(whole) = own.and_then(Object::number) else {
            if is_predefined {
                let message = format!("TPDO {} has no identifier, {predefined} is taken", self.number);
                report.warn(place, message, "that is the one of CiA 301; check it");
                return Ok(predefined);
            }
            return self.skip(
                report,
                place,
                "it has no identifier",
                "the device gives it one when it is configured",
            );
        };
        let Ok(number) = u32::try_from(whole.base) else {
            return self.skip(report, place, "its identifier is not a number of 32 bits", "");
        };
        if number & 0x8000_0000 != 0 {
            return Err(Skipped::Off);
        }
        let (is_long, base) = (number & 0x2000_0000 != 0, number & 0x1FFF_FFFF);
        let is_above = base > 0x7FF;
        if is_long != is_above {
            let why = if is_long {
                "its identifier is a small one of 29 bits"
            } else {
                "its identifier is above 0x7FF, but bit 29 is not set"
            };
            return self.skip(report, place, why, "correct sub-index 1");
        }
        let found = CobId { base, plus_node_id: whole.plus_node_id };
        if found.plus_node_id {
            return Ok(found);
        }
        match base.checked_sub(predefined.base) {
            Some(0) if is_predefined => {
                let message = format!(
                    "the identifier of TPDO {} lacks the node id, {predefined} is taken",
                    self.number
                );
                report.warn(place, message, "write $NODEID+0x180 and so on");
                Ok(predefined)
            }
            Some(id @ 1..=127) if is_predefined => {
                if self.eds.node_id.map(u32::from) != Some(id) {
                    let message = format!(
                        "the identifier of TPDO {} is that of node {id}, {predefined} is taken",
                        self.number
                    );
                    report.warn(place, message, "write $NODEID+0x180 and so on");
                }
                Ok(predefined)
            }
            _ if base == 0 => self.skip(report, place, "its identifier is 0", "correct sub-index 1"),
            _ => {
                let message = format!("TPDO {} has the same identifier for every node: {found}", self.number);
                report.warn(place, message, "only one node of a bus can use this mapping");
                Ok(found)
            }
        }
    }

    fn maps(&self, report: &mut Report) -> Result<Vec<Mapped>, Skipped> {
        let index = self.mapping();
        let first = self.object(index, 0).or_else(|| self.object(index, 1));
        let Some(first) = first else {
            let place = self.object(self.communication(), 1).map_or(Place::START, |object| object.place);
            return self.skip(report, place, &format!("{index:04X}h does not say what it carries"), "");
        };
        let count = self.object(index, 0).and_then(|_| self.number_of(index, 0));
        match count {
            Some(0) => return Err(Skipped::Off),
            Some(254 | 255) => {
                return self.skip(report, first.place, "it is a multiplexed one", "use the values by SDO");
            }
            Some(count) if !(1..=64).contains(&count) => {
                let why = format!("{index:04X}h says that it carries {count} objects");
                return self.skip(report, first.place, &why, "write 0 to 64");
            }
            _ => {}
        }
        let mut maps = Vec::new();
        let wanted = count.and_then(|count| u8::try_from(count).ok());
        for sub in 1..=wanted.unwrap_or(64) {
            let entry = self.number_of(index, sub).and_then(|entry| u32::try_from(entry).ok()).unwrap_or(0);
            if entry == 0 {
                if wanted.is_some() {
                    let place = self.object(index, sub).map_or(first.place, |object| object.place);
                    let message =
                        format!("{index:04X}h says nothing of object {sub} of TPDO {}", self.number);
                    report.warn(place, message, "what stands before it is used");
                }
                break;
            }
            maps.push(self.mapped(report, sub, entry)?);
        }
        let bits: u32 = maps.iter().map(|mapped| u32::from(mapped.bits)).sum();
        if bits > FRAME_BITS {
            return self.skip(report, first.place, &format!("it has {bits} bits"), "a frame holds 64");
        }
        if maps.iter().all(Mapped::is_gap) { Err(Skipped::Off) } else { Ok(maps) }
    }

    /// One entry of 0x1A00..: index, sub-index, bits.
    fn mapped(&self, report: &mut Report, sub: u8, entry: u32) -> Result<Mapped, Skipped> {
        let [high, low, object_sub, bits] = entry.to_be_bytes();
        let object = ObjectId::new(u16::from_be_bytes([high, low]), object_sub);
        let mapped = Mapped { object, bits };
        let place = self
            .object(self.mapping(), sub)
            .map_or(Place::START, |object| object.value().map_or(object.place, |value| value.place));
        if bits == 0 {
            return self.skip(
                report,
                place,
                &format!("it carries {object} with 0 bits"),
                "write its bits in the last byte",
            );
        }
        if !mapped.is_gap() && !self.eds.objects.contains_key(&object) {
            let message = format!("TPDO {} carries {object}, which the file does not describe", self.number);
            report.warn(place, message, format!("it is read as a number of {bits} bits without sign"));
        }
        Ok(mapped)
    }
}

#[cfg(test)]
mod tests {
    use super::super::read::read;
    use super::*;

    fn sub(index: u16, sub: u8, value: &str) -> String {
        format!("[{index:04X}sub{sub:X}]\nParameterName=p\nDataType=7\nAccessType=rw\n{value}\n")
    }

    fn found(parts: &[String]) -> (Tpdos, Vec<String>) {
        let text = parts.concat();
        let (eds, _) = read("a.eds", text.as_bytes()).unwrap();
        let mut report = Report::new("a.eds");
        let tpdos = tpdos(&mut report, &eds);
        (tpdos, report.finish().into_iter().map(|problem| problem.message).collect())
    }

    fn one(cob_id: &str) -> (Tpdos, Vec<String>) {
        found(&[
            sub(0x1800, 1, &format!("DefaultValue={cob_id}")),
            sub(0x1800, 2, "DefaultValue=255"),
            sub(0x1800, 3, "DefaultValue=100"),
            sub(0x1800, 5, "DefaultValue=1000"),
            sub(0x1A00, 0, "DefaultValue=2"),
            sub(0x1A00, 1, "DefaultValue=0x64010110"),
            sub(0x1A00, 2, "DefaultValue=0x00050008"),
            sub(0x6401, 1, ""),
        ])
    }

    #[test]
    fn content_identifier_and_times_are_those_of_the_dictionary() {
        let (tpdos, problems) = one("$NODEID+0x40000180");
        assert_eq!(problems, Vec::<String>::new());
        let [tpdo] = tpdos.sent.as_slice() else { panic!("{tpdos:?}") };
        assert_eq!((tpdo.number, tpdo.cob_id.to_string().as_str()), (1, "$NODEID+0x180"));
        assert_eq!(
            tpdo.maps.iter().map(ToString::to_string).collect::<Vec<_>>(),
            ["0x6401:1/16", "0x0005:0/8"]
        );
        assert_eq!(
            (tpdo.transmission_type, tpdo.event_timer_ms, tpdo.inhibit_time_us),
            (Some(255), Some(1000), Some(10_000))
        );
        assert!(!tpdo.is_configured);
    }

    #[test]
    fn identifiers_are_taken_as_makers_mean_them() {
        for (text, expected, problem) in [
            ("0x280 + $NODEID", "$NODEID+0x280", ""),
            ("0x180", "$NODEID+0x180", "lacks the node id"),
            ("", "$NODEID+0x180", "has no identifier"),
            ("0x1A0", "$NODEID+0x180", "is that of node 32"),
            ("0x211", "0x211", "the same identifier for every node"),
            ("0x2018ABCD", "0x18ABCD", "the same identifier for every node"),
        ] {
            let (tpdos, problems) = one(text);
            assert_eq!(tpdos.sent[0].cob_id.to_string(), expected, "{text}");
            assert_eq!(problems.is_empty(), problem.is_empty(), "{problems:?}");
            assert!(problems.iter().all(|found| found.contains(problem)), "{problems:?}");
        }
        for text in ["0x80000180", "$NODEID+0xC0000180"] {
            assert_eq!(one(text), (Tpdos { sent: Vec::new(), off: vec![1] }, Vec::new()), "{text}");
        }
        for text in ["0", "0x20000180", "0x800", "-1"] {
            let (tpdos, problems) = one(text);
            assert!(tpdos.sent.is_empty() && problems[0].starts_with("TPDO 1 is left out"), "{text}");
        }
    }

    #[test]
    fn a_dcf_goes_before_the_defaults_and_is_noticed() {
        let parts = [
            "[DeviceComissioning]\nNodeID=5\n".to_owned(),
            sub(0x1801, 1, "DefaultValue=0x80000285\nParameterValue=0x285"),
            sub(0x1A01, 0, "DefaultValue=0\nParameterValue=1"),
            sub(0x1A01, 1, "ParameterValue=0x60410010"),
            sub(0x1802, 1, "DefaultValue=$NODEID+0x380\nParameterValue=0x385"),
            sub(0x1A02, 1, "DefaultValue=0x60410010"),
        ];
        let (tpdos, _) = found(&parts);
        let shown: Vec<_> = tpdos
            .sent
            .iter()
            .map(|tpdo| (tpdo.number, tpdo.cob_id.to_string(), tpdo.is_configured))
            .collect();
        assert_eq!(shown, [(2, "$NODEID+0x280".to_owned(), true), (3, "$NODEID+0x380".to_owned(), false)]);
    }

    #[test]
    fn content_that_cannot_be_is_left_out_and_told() {
        let with = |entries: &[&str]| {
            let mut parts = vec![sub(0x1800, 1, "DefaultValue=$NODEID+0x180")];
            for (at, entry) in (0..).zip(entries) {
                parts.push(sub(0x1A00, at, &format!("DefaultValue={entry}")));
            }
            let (tpdos, problems) = found(&parts);
            (tpdos.sent.len(), tpdos.off.len(), problems.join("\n"))
        };
        for (entries, why) in [
            (&["2", "0x20000040", "0x20010001"][..], "it has 65 bits"),
            (&["1", "0x20000000"], "with 0 bits"),
            (&["254", "0x20000008"], "multiplexed"),
            (&["65", "0x20000008"], "carries 65 objects"),
            (&[], "does not say what it carries"),
        ] {
            let (sent, off, problem) = with(entries);
            assert_eq!((sent, off), (0, 0), "{entries:?}");
            assert!(problem.contains(why), "{problem}");
        }
        assert_eq!(with(&["0", "0x20000008"]).1, 1);
        assert_eq!(with(&["1", "0x00050008"]).1, 1, "nothing but gaps");
        let (sent, _, problem) = with(&["2", "0x20000008", "0"]);
        assert!(sent == 1 && problem.contains("says nothing of object 2"), "{problem}");
    }
}
