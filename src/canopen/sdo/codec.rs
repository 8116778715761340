//! SDO frames (CiA 301, 7.2.4.3): what a client sends, and what a server answers. Always 8 bytes, unused ones 0
//! (R-DST-065).

use super::AbortCode;
use crate::can::CanId;
use crate::canopen::NodeId;
use crate::canopen::object::ObjectId;

/// The data of an SDO frame.
pub(super) type Payload = [u8; 8];

/// Data bytes of a segment.
pub(super) const SEGMENT: usize = 7;
/// Segments of a block, at most.
pub(super) const BLOCK: u8 = 127;

/// The identifier of requests to a node, 0x600 + node id.
#[must_use]
pub fn request_id(node: NodeId) -> CanId {
    CanId::Standard(0x600 + u16::from(node.get()))
}

/// The identifier of a node's answers, 0x580 + node id.
#[must_use]
pub fn answer_id(node: NodeId) -> CanId {
    CanId::Standard(0x580 + u16::from(node.get()))
}

/// What a client sends.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Request<'a> {
    /// Begin to read.
    Read(ObjectId),
    /// The next segment.
    ReadSegment { toggle: bool },
    /// Write one to four bytes.
    WriteExpedited(ObjectId, &'a [u8]),
    /// Begin to write so many bytes in segments.
    WriteSegmented(ObjectId, usize),
    /// Up to seven bytes.
    WriteSegment { toggle: bool, data: &'a [u8], last: bool },
    /// Begin to read in blocks of [`BLOCK`] segments; the server may answer as to [`Request::Read`] when the object is not
    /// longer than `threshold` bytes.
    BlockRead { object: ObjectId, threshold: u8 },
    /// Now send.
    BlockReadStart,
    /// The block came up to this segment.
    BlockReadAcknowledge { segment: u8 },
    /// Everything came.
    BlockReadEnd,
    /// Begin to write so many bytes in blocks.
    BlockWrite(ObjectId, usize),
    /// Up to seven bytes; segments of a block count from 1.
    BlockWriteSegment { segment: u8, data: &'a [u8], last: bool },
    /// That was all; so many bytes of the last segment do not count.
    BlockWriteEnd { unused: u8, crc: u16 },
    /// The client gives up.
    Abort(ObjectId, AbortCode),
}

impl Request<'_> {
    /// The bytes on the bus.
    pub(super) fn payload(&self) -> Payload {
        match *self {
            Self::Read(object) => with_object(0x40, object, [0; 4]),
            Self::ReadSegment { toggle } => with_rest(0x60 | bit(toggle, 4), &[]),
            Self::WriteExpedited(object, data) => {
                with_object(0x23 | unused(4, data) << 2, object, padded(data))
            }
            Self::WriteSegmented(object, len) => with_object(0x21, object, size(len)),
            Self::WriteSegment { toggle, data, last } => {
                with_rest(bit(toggle, 4) | unused(SEGMENT, data) << 1 | bit(last, 0), data)
            }
            Self::BlockRead { object, threshold } => with_object(0xA4, object, [BLOCK, threshold, 0, 0]),
            Self::BlockReadStart => with_rest(0xA3, &[]),
            Self::BlockReadAcknowledge { segment } => with_rest(0xA2, &[segment, BLOCK]),
            Self::BlockReadEnd => with_rest(0xA1, &[]),
            Self::BlockWrite(object, len) => with_object(0xC6, object, size(len)),
            Self::BlockWriteSegment { segment, data, last } => with_rest(bit(last, 7) | segment, data),
            Self::BlockWriteEnd { unused, crc } => with_rest(0xC1 | unused << 2, &crc.to_le_bytes()),
            Self::Abort(object, code) => with_object(0x80, object, code.0.to_le_bytes()),
        }
    }
}

/// What a server answers; segments of a block read apart, which only their place in the transfer tells from others.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Answer {
    /// The whole value; `len` as the server says, if it does.
    ReadExpedited { object: ObjectId, data: [u8; 4], len: Option<usize> },
    /// Segments are to be asked for; how many bytes they have, if the server says so.
    ReadSegmented { object: ObjectId, size: Option<u32> },
    /// A segment, of which the first `len` bytes count.
    Segment { toggle: bool, data: [u8; SEGMENT], len: usize, last: bool },
    /// Written, or ready for segments.
    Written { object: ObjectId },
    /// A segment was taken.
    SegmentWritten { toggle: bool },
    /// Ready to send blocks; `crc`: with a check sum.
    BlockRead { object: ObjectId, crc: bool, size: Option<u32> },
    /// All blocks were sent.
    BlockReadEnd { unused: u8, crc: u16 },
    /// Ready to take blocks of so many segments.
    BlockWrite { object: ObjectId, crc: bool, block: u8 },
    /// The block came up to this segment; the next may have so many.
    BlockAcknowledged { segment: u8, block: u8 },
    /// Everything came.
    BlockWritten,
    /// The server gives up.
    Abort { object: ObjectId, code: AbortCode },
    /// No such answer exists.
    Unknown,
}

impl Answer {
    /// From the bytes on the bus. Unused bytes are ignored (R-DST-065).
    pub(super) fn parse(payload: Payload) -> Self {
        let [command, low, high, sub, a, b, c, d] = payload;
        let object = ObjectId::new(u16::from_le_bytes([low, high]), sub);
        let value = u32::from_le_bytes([a, b, c, d]);
        let flag = |bit: u8| command >> bit & 1 == 1;
        match command >> 5 {
            0 => {
                let len = SEGMENT - usize::from(command >> 1 & 7);
                Self::Segment { toggle: flag(4), data: [low, high, sub, a, b, c, d], len, last: flag(0) }
            }
            1 => Self::SegmentWritten { toggle: flag(4) },
            2 if flag(1) => {
                let len = flag(0).then(|| 4 - usize::from(command >> 2 & 3));
                Self::ReadExpedited { object, data: [a, b, c, d], len }
            }
            2 => Self::ReadSegmented { object, size: flag(0).then_some(value) },
            3 => Self::Written { object },
            4 if command == 0x80 => Self::Abort { object, code: AbortCode(value) },
            5 => match command & 3 {
                0 => Self::BlockWrite { object, crc: flag(2), block: a },
                1 => Self::BlockWritten,
                2 => Self::BlockAcknowledged { segment: low, block: high },
                _ => Self::Unknown,
            },
            6 if flag(0) => {
                Self::BlockReadEnd { unused: command >> 2 & 7, crc: u16::from_le_bytes([low, high]) }
            }
            6 => Self::BlockRead { object, crc: flag(2), size: flag(1).then_some(value) },
            _ => Self::Unknown,
        }
    }

    /// The code, if this is an abort of that object.
    pub(super) fn abort_of(&self, wanted: ObjectId) -> Option<AbortCode> {
        if let Self::Abort { object, code } = *self { (object == wanted).then_some(code) } else { None }
    }

    /// The object that the answer names; segments name none.
    pub(super) fn object(&self) -> Option<ObjectId> {
        match *self {
            Self::ReadExpedited { object, .. }
            | Self::ReadSegmented { object, .. }
            | Self::Written { object }
            | Self::BlockRead { object, .. }
            | Self::BlockWrite { object, .. }
            | Self::Abort { object, .. } => Some(object),
            Self::Segment { .. }
            | Self::SegmentWritten { .. }
            | Self::BlockReadEnd { .. }
            | Self::BlockAcknowledged { .. }
            | Self::BlockWritten
            | Self::Unknown => None,
        }
    }
}

fn bit(set: bool, place: u8) -> u8 {
    u8::from(set) << place
}

/// How many bytes of a field are not used.
fn unused(field: usize, data: &[u8]) -> u8 {
    u8::try_from(field.saturating_sub(data.len())).unwrap_or_default()
}

fn size(len: usize) -> [u8; 4] {
    u32::try_from(len).unwrap_or(u32::MAX).to_le_bytes()
}

/// The first `N` bytes, filled up with 0.
fn padded<const N: usize>(data: &[u8]) -> [u8; N] {
    let mut field = [0; N];
    for (to, from) in field.iter_mut().zip(data) {
        *to = *from;
    }
    field
}

fn with_object(command: u8, object: ObjectId, rest: [u8; 4]) -> Payload {
    let [low, high] = object.index.to_le_bytes();
    let [a, b, c, d] = rest;
    [command, low, high, object.sub, a, b, c, d]
}

fn with_rest(command: u8, rest: &[u8]) -> Payload {
    let mut payload = [command, 0, 0, 0, 0, 0, 0, 0];
    for (to, from) in payload.iter_mut().skip(1).zip(rest) {
        *to = *from;
    }
    payload
}

/// The check sum of block transfers: CRC-16 with polynomial 0x1021, from 0 on (CiA 301, 7.2.4.3.16).
pub(super) fn crc(data: &[u8]) -> u16 {
    data.iter().fold(0, |crc, byte| {
        (0..8).fold(
            crc ^ u16::from(*byte) << 8,
            |crc: u16, _| {
                if crc & 0x8000 == 0 { crc << 1 } else { crc << 1 ^ 0x1021 }
            },
        )
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::can::CanFrame;

    fn frame(payload: Payload) -> String {
        let id = request_id(NodeId::new(1).unwrap());
        CanFrame::data_frame(id, &payload).unwrap().to_string()
    }

    fn answer(text: &str) -> Answer {
        let frame: CanFrame = text.parse().unwrap();
        assert_eq!(frame.id(), answer_id(NodeId::new(1).unwrap()));
        Answer::parse(frame.data().try_into().unwrap())
    }

    fn object(text: &str) -> ObjectId {
        text.parse().unwrap()
    }

    #[test]
    fn r_dst_012_066_070_v_dst_13_reads_of_the_manual() {
        for (request, reply, name, data) in [
            ("601#4030610100000000", "581#433061010000C03F", "0x6130:1", [0x00, 0x00, 0xC0, 0x3F]),
            ("601#4030910100000000", "581#43309101A0860100", "0x9130:1", 100_000_i32.to_le_bytes()),
            ("601#4030610200000000", "581#433061020000C841", "0x6130:2", 25.0_f32.to_le_bytes()),
            ("601#4030910200000000", "581#4330910219000000", "0x9130:2", 25_i32.to_le_bytes()),
        ] {
            assert_eq!(frame(Request::Read(object(name)).payload()), request);
            assert_eq!(answer(reply), Answer::ReadExpedited { object: object(name), data, len: Some(4) });
        }
        assert_eq!(frame(Request::Read(object("0x1800:5")).payload()), "601#4000180500000000");
        let timer = Answer::ReadExpedited { object: object("0x1800:5"), data: [0xE8, 3, 0, 0], len: Some(2) };
        assert_eq!(answer("581#4B001805E8030000"), timer);
    }

    #[test]
    fn r_dst_066_expedited_answers_of_every_length() {
        for (command, len) in
            [(0x4F, Some(1)), (0x4B, Some(2)), (0x47, Some(3)), (0x43, Some(4)), (0x42, None)]
        {
            let read = Answer::parse([command, 0x08, 0x10, 2, 1, 2, 3, 4]);
            assert_eq!(
                read,
                Answer::ReadExpedited { object: object("0x1008:2"), data: [1, 2, 3, 4], len },
                "{command:02X}"
            );
        }
        assert_eq!(
            answer("581#40081000FFFFFFFF"),
            Answer::ReadSegmented { object: object("0x1008:0"), size: None }
        );
    }

    #[test]
    fn r_dst_012_067_085_086_v_dst_12_14_15_17_18_writes_of_the_manual() {
        for (request, name, data) in [
            ("601#2B171000E8030000", "0x1017:0", vec![0xE8, 3]),
            ("601#2B17100000000000", "0x1017:0", vec![0, 0]),
            ("601#2F001802FF000000", "0x1800:2", vec![0xFF]),
            ("601#2F00180201000000", "0x1800:2", vec![1]),
            ("601#2B001805FA000000", "0x1800:5", vec![250, 0]),
            ("601#2F001A0000000000", "0x1A00:0", vec![0]),
            ("601#23001A0120013061", "0x1A00:1", 0x6130_0120_u32.to_le_bytes().to_vec()),
            ("601#23001A0220023091", "0x1A00:2", 0x9130_0220_u32.to_le_bytes().to_vec()),
            ("601#23001A0300000000", "0x1A00:3", vec![0; 4]),
            ("601#2F001A0002000000", "0x1A00:0", vec![2]),
            ("601#2310100173617665", "0x1010:1", b"save".to_vec()),
            ("601#231110016C6F6164", "0x1011:1", b"load".to_vec()),
            ("601#232561017A65726F", "0x6125:1", b"zero".to_vec()),
            ("601#23801F0008000000", "0x1F80:0", vec![8, 0, 0, 0]),
            ("601#2331610100004E00", "0x6131:1", 0x004E_0000_u32.to_le_bytes().to_vec()),
            ("601#233161010000AB00", "0x6131:1", 0x00AB_0000_u32.to_le_bytes().to_vec()),
            ("601#2331610100004EFD", "0x6131:1", 0xFD4E_0000_u32.to_le_bytes().to_vec()),
            ("601#2F32610103000000", "0x6132:1", vec![3]),
            ("601#2F004F0003000000", "0x4F00:0", vec![3]),
            ("601#2F014F0005000000", "0x4F01:0", vec![5]),
            ("601#27081000AABBCC00", "0x1008:0", vec![0xAA, 0xBB, 0xCC]),
        ] {
            assert_eq!(frame(Request::WriteExpedited(object(name), &data).payload()), request);
        }
        for (reply, name) in [
            ("581#6000180200000000", "0x1800:2"),
            ("581#60001A0000000000", "0x1A00:0"),
            ("581#6010100100000000", "0x1010:1"),
            ("581#60014F0000000000", "0x4F01:0"),
        ] {
            assert_eq!(answer(reply), Answer::Written { object: object(name) });
        }
    }

    #[test]
    fn r_dst_068_v_dst_16_18_aborts_of_the_manual() {
        for (reply, name, code) in [
            ("581#8000100002000106", "0x1000:0", 0x0601_0002),
            ("581#8025610101000106", "0x6125:1", 0x0601_0001),
            ("581#8000200000000206", "0x2000:0", 0x0602_0000),
            ("581#8018100511000906", "0x1018:5", 0x0609_0011),
            ("581#8000180230000906", "0x1800:2", 0x0609_0030),
            ("581#80001A0141000406", "0x1A00:1", 0x0604_0041),
            ("581#80001A0042000406", "0x1A00:0", 0x0604_0042),
            ("581#8000180513000706", "0x1800:5", 0x0607_0013),
            ("581#80004F0030000906", "0x4F00:0", 0x0609_0030),
            ("581#80014F0030000906", "0x4F01:0", 0x0609_0030),
        ] {
            assert_eq!(answer(reply), Answer::Abort { object: object(name), code: AbortCode(code) });
        }
        let abort = Request::Abort(object("0x1018:1"), AbortCode::TIMEOUT);
        assert_eq!(frame(abort.payload()), "601#8018100100000405");
    }

    #[test]
    fn r_dst_072_v_dst_21_segments_of_the_device_name() {
        assert_eq!(frame(Request::Read(object("0x1008:0")).payload()), "601#4008100000000000");
        let name = object("0x1008:0");
        assert_eq!(answer("581#4108100010000000"), Answer::ReadSegmented { object: name, size: Some(16) });
        assert_eq!(frame(Request::ReadSegment { toggle: false }.payload()), "601#6000000000000000");
        assert_eq!(frame(Request::ReadSegment { toggle: true }.payload()), "601#7000000000000000");
        for (reply, toggle, data, len, last) in [
            ("581#0044535420503932", false, *b"DST P92", 7, false),
            ("581#10432043414E6F70", true, *b"C CANop", 7, false),
            ("581#0B656E0000000000", false, *b"en\0\0\0\0\0", 2, true),
            ("581#1756494345000000", true, *b"VICE\0\0\0", 4, true),
        ] {
            assert_eq!(answer(reply), Answer::Segment { toggle, data, len, last });
        }
    }

    #[test]
    fn segments_that_are_written() {
        assert_eq!(frame(Request::WriteSegmented(object("0x1008:0"), 10).payload()), "601#210810000A000000");
        let segment = |toggle, data, last| frame(Request::WriteSegment { toggle, data, last }.payload());
        assert_eq!(segment(false, b"DST P92", false), "601#0044535420503932");
        assert_eq!(segment(true, b"C C", true), "601#1943204300000000");
        assert_eq!(segment(false, b"", true), "601#0F00000000000000");
        assert_eq!(answer("581#2000000000000000"), Answer::SegmentWritten { toggle: false });
        assert_eq!(answer("581#3000000000000000"), Answer::SegmentWritten { toggle: true });
    }

    #[test]
    fn blocks_that_are_read() {
        let name = object("0x1008:0");
        assert_eq!(
            frame(Request::BlockRead { object: name, threshold: 28 }.payload()),
            "601#A40810007F1C0000"
        );
        assert_eq!(frame(Request::BlockReadStart.payload()), "601#A300000000000000");
        assert_eq!(frame(Request::BlockReadAcknowledge { segment: 5 }.payload()), "601#A2057F0000000000");
        assert_eq!(frame(Request::BlockReadEnd.payload()), "601#A100000000000000");
        assert_eq!(
            answer("581#C608100000010000"),
            Answer::BlockRead { object: name, crc: true, size: Some(256) }
        );
        assert_eq!(
            answer("581#C008100000010000"),
            Answer::BlockRead { object: name, crc: false, size: None }
        );
        assert_eq!(answer("581#CDC3310000000000"), Answer::BlockReadEnd { unused: 3, crc: 0x31C3 });
    }

    #[test]
    fn blocks_that_are_written() {
        let name = object("0x1008:0");
        assert_eq!(frame(Request::BlockWrite(name, 256).payload()), "601#C608100000010000");
        let segment =
            |segment, data, last| frame(Request::BlockWriteSegment { segment, data, last }.payload());
        assert_eq!(segment(1, b"DST P92", false), "601#0144535420503932");
        assert_eq!(segment(127, b"C", true), "601#FF43000000000000");
        assert_eq!(
            frame(Request::BlockWriteEnd { unused: 6, crc: 0x31C3 }.payload()),
            "601#D9C3310000000000"
        );
        assert_eq!(
            answer("581#A40810007F000000"),
            Answer::BlockWrite { object: name, crc: true, block: 127 }
        );
        assert_eq!(answer("581#A07F000000000000").object(), Some(ObjectId::new(0x7F, 0)));
        assert_eq!(answer("581#A27F400000000000"), Answer::BlockAcknowledged { segment: 127, block: 64 });
        assert_eq!(answer("581#A100000000000000"), Answer::BlockWritten);
    }

    #[test]
    fn what_is_no_answer_is_unknown() {
        for command in [0x81, 0x9F, 0xA3, 0xA7, 0xE0, 0xFF] {
            assert_eq!(Answer::parse([command, 0, 0, 0, 0, 0, 0, 0]), Answer::Unknown, "{command:02X}");
        }
    }

    #[test]
    fn the_check_sum_is_that_of_the_standard() {
        assert_eq!(crc(b"123456789"), 0x31C3);
        assert_eq!(crc(b""), 0);
    }
}
