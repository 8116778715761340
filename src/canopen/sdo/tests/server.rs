//! An SDO server for the tests, written from CiA 301 without the client's codec: strict, so that it finds the client's
//! mistakes.

use std::collections::BTreeMap;

use crate::canopen::object::ObjectId;

type Payload = [u8; 8];

/// What the server can do.
#[derive(Clone, Copy, Debug)]
pub(super) struct Abilities {
    pub(super) blocks: bool,
    pub(super) crc: bool,
    /// Says how long an object is before it sends it.
    pub(super) sizes: bool,
    /// Segments of a block that it takes at once.
    pub(super) block: u8,
}

impl Default for Abilities {
    fn default() -> Self {
        Self { blocks: true, crc: true, sizes: true, block: 127 }
    }
}

/// A server with its objects.
#[derive(Debug, Default)]
pub(super) struct Server {
    pub(super) abilities: Abilities,
    pub(super) objects: BTreeMap<ObjectId, Vec<u8>>,
    /// Everything that was written, in order.
    pub(super) writes: Vec<(ObjectId, Vec<u8>)>,
    /// Requests other than segments that came.
    pub(super) requests: usize,
    /// The abort codes that came.
    pub(super) aborted: Vec<u32>,
    state: State,
}

#[derive(Debug, Default)]
enum State {
    #[default]
    Idle,
    Upload {
        object: ObjectId,
        rest: Vec<u8>,
        toggle: u8,
    },
    Download {
        object: ObjectId,
        data: Vec<u8>,
        size: usize,
        toggle: u8,
    },
    /// `sent`: segments of this block; 0 before the start.
    BlockUpload {
        object: ObjectId,
        data: Vec<u8>,
        from: usize,
        sent: u8,
        started: bool,
        ending: bool,
    },
    BlockDownload {
        object: ObjectId,
        data: Vec<u8>,
        size: usize,
        segment: u8,
        complete: bool,
    },
}

fn crc(data: &[u8]) -> u16 {
    let mut crc = 0_u16;
    for byte in data {
        crc ^= u16::from(*byte) << 8;
        for _ in 0..8 {
            crc = if crc >= 0x8000 { (crc << 1) ^ 0x1021 } else { crc << 1 };
        }
    }
    crc
}

fn named(command: u8, object: ObjectId, rest: [u8; 4]) -> Payload {
    let index = object.index.to_le_bytes();
    [command, index[0], index[1], object.sub, rest[0], rest[1], rest[2], rest[3]]
}

fn segment(command: u8, data: &[u8]) -> Payload {
    let mut payload = [command, 0, 0, 0, 0, 0, 0, 0];
    payload[1..=data.len()].copy_from_slice(data);
    payload
}

impl Server {
    /// A server that has one object.
    pub(super) fn with(object: ObjectId, value: &[u8]) -> Self {
        let objects = BTreeMap::from([(object, value.to_vec())]);
        Self { objects, ..Self::default() }
    }

    /// The same with other abilities.
    pub(super) fn able(self, abilities: Abilities) -> Self {
        Self { abilities, ..self }
    }

    fn abort(&mut self, object: ObjectId, code: u32) -> Vec<Payload> {
        self.state = State::Idle;
        vec![named(0x80, object, code.to_le_bytes())]
    }

    /// Takes a request; gives the answers to it.
    pub(super) fn handle(&mut self, request: Payload) -> Vec<Payload> {
        let object = ObjectId::new(u16::from_le_bytes([request[1], request[2]]), request[3]);
        let value = u32::from_le_bytes(request[4..].try_into().unwrap());
        if request[0] == 0x80 {
            self.aborted.push(value);
            self.state = State::Idle;
            return vec![];
        }
        if matches!(self.state, State::BlockDownload { complete: false, .. }) {
            return self.block_segment(request);
        }
        match request[0] >> 5 {
            0 => self.download_segment(request),
            1 => self.download(object, request, value),
            2 => self.upload(object),
            3 => self.upload_segment(request),
            5 => self.block_upload(object, request),
            6 => self.block_download(object, request, value),
            _ => self.abort(object, 0x0504_0001),
        }
    }

    fn upload(&mut self, object: ObjectId) -> Vec<Payload> {
        self.requests += 1;
        let Some(data) = self.objects.get(&object).cloned() else { return self.abort(object, 0x0602_0000) };
        if (1..=4).contains(&data.len()) {
            self.state = State::Idle;
            let mut rest = [0; 4];
            rest[..data.len()].copy_from_slice(&data);
            let unused = u8::try_from(4 - data.len()).unwrap();
            return vec![named(0x43 | unused << 2, object, rest)];
        }
        let size = u32::try_from(data.len()).unwrap();
        self.state = State::Upload { object, rest: data, toggle: 0 };
        vec![if self.abilities.sizes {
            named(0x41, object, size.to_le_bytes())
        } else {
            named(0x40, object, [0; 4])
        }]
    }

    fn upload_segment(&mut self, request: Payload) -> Vec<Payload> {
        let State::Upload { object, rest, toggle } = &mut self.state else {
            return self.abort(ObjectId::default(), 0x0504_0001);
        };
        let object = *object;
        if request[0] != 0x60 | *toggle << 4 {
            return self.abort(object, 0x0503_0000);
        }
        let len = rest.len().min(7);
        let data: Vec<u8> = rest.drain(..len).collect();
        let last = rest.is_empty();
        let unused = u8::try_from(7 - len).unwrap();
        let answer = segment(*toggle << 4 | unused << 1 | u8::from(last), &data);
        *toggle ^= 1;
        if last {
            self.state = State::Idle;
        }
        vec![answer]
    }

    fn download(&mut self, object: ObjectId, request: Payload, size: u32) -> Vec<Payload> {
        self.requests += 1;
        if !self.objects.contains_key(&object) {
            return self.abort(object, 0x0602_0000);
        }
        if request[0] & 2 != 0 {
            let len = if request[0] & 1 == 0 { 4 } else { 4 - usize::from(request[0] >> 2 & 3) };
            return self.store(object, request[4..4 + len].to_vec(), named(0x60, object, [0; 4]));
        }
        assert_eq!(request[0], 0x21, "the size is always said");
        let size = usize::try_from(size).unwrap();
        self.state = State::Download { object, data: vec![], size, toggle: 0 };
        vec![named(0x60, object, [0; 4])]
    }

    fn download_segment(&mut self, request: Payload) -> Vec<Payload> {
        let State::Download { object, data, size, toggle } = &mut self.state else {
            return self.abort(ObjectId::default(), 0x0504_0001);
        };
        let object = *object;
        if request[0] >> 4 & 1 != *toggle {
            return self.abort(object, 0x0503_0000);
        }
        let len = 7 - usize::from(request[0] >> 1 & 7);
        data.extend(&request[1..=len]);
        let answer = segment(0x20 | *toggle << 4, &[]);
        *toggle ^= 1;
        if request[0] & 1 == 0 {
            return vec![answer];
        }
        if data.len() != *size {
            return self.abort(object, 0x0607_0010);
        }
        let data = std::mem::take(data);
        self.store(object, data, answer)
    }

    fn store(&mut self, object: ObjectId, data: Vec<u8>, answer: Payload) -> Vec<Payload> {
        self.state = State::Idle;
        self.objects.insert(object, data.clone());
        self.writes.push((object, data));
        vec![answer]
    }

    fn block_upload(&mut self, object: ObjectId, request: Payload) -> Vec<Payload> {
        if request[0].is_multiple_of(4) {
            if !self.abilities.blocks {
                return self.abort(object, 0x0504_0001);
            }
            let Some(data) = self.objects.get(&object).cloned() else { return self.upload(object) };
            if data.len() <= usize::from(request[5]) {
                return self.upload(object);
            }
            assert_eq!(request[4], 127);
            let size = u32::try_from(data.len()).unwrap();
            self.state = State::BlockUpload { object, data, from: 0, sent: 0, started: false, ending: false };
            let crc = u8::from(self.abilities.crc) << 2;
            let (flag, size) = if self.abilities.sizes { (2, size) } else { (0, 0) };
            return vec![named(0xC0 | crc | flag, object, size.to_le_bytes())];
        }
        let State::BlockUpload { object, data, from, sent, started, ending } = &mut self.state else {
            return self.abort(object, 0x0504_0001);
        };
        let object = *object;
        match request[0] {
            0xA3 if !*started => *started = true,
            0xA2 if *started && !*ending && request[1] <= *sent => {
                *from = data.len().min(*from + 7 * usize::from(request[1]));
                if *from == data.len() {
                    *ending = true;
                    let unused = u8::try_from((7 - data.len() % 7) % 7).unwrap();
                    return vec![segment(0xC1 | unused << 2, &crc(data).to_le_bytes())];
                }
            }
            0xA1 if *ending => {
                self.state = State::Idle;
                return vec![];
            }
            _ => return self.abort(object, 0x0504_0001),
        }
        let rest = &data[*from..];
        let chunks: Vec<&[u8]> = rest.chunks(7).take(127).collect();
        *sent = u8::try_from(chunks.len()).unwrap();
        let all = rest.len() <= 127 * 7;
        let number = |place: usize| {
            let last = all && place + 1 == chunks.len();
            u8::try_from(place + 1).unwrap() | u8::from(last) << 7
        };
        chunks.iter().enumerate().map(|(place, chunk)| segment(number(place), chunk)).collect()
    }

    fn block_download(&mut self, object: ObjectId, request: Payload, size: u32) -> Vec<Payload> {
        if request[0] & 1 == 0 {
            self.requests += 1;
            if !self.abilities.blocks {
                return self.abort(object, 0x0504_0001);
            }
            if !self.objects.contains_key(&object) {
                return self.abort(object, 0x0602_0000);
            }
            assert_eq!(request[0], 0xC6, "size and check sum");
            let size = usize::try_from(size).unwrap();
            self.state = State::BlockDownload { object, data: vec![], size, segment: 0, complete: false };
            let crc = u8::from(self.abilities.crc) << 2;
            return vec![named(0xA0 | crc, object, [self.abilities.block, 0, 0, 0])];
        }
        let State::BlockDownload { object, data, size, complete: true, .. } = &mut self.state else {
            return self.abort(object, 0x0504_0001);
        };
        let object = *object;
        data.truncate(data.len() - usize::from(request[0] >> 2 & 7));
        if data.len() != *size {
            return self.abort(object, 0x0607_0010);
        }
        if self.abilities.crc && crc(data) != u16::from_le_bytes([request[1], request[2]]) {
            return self.abort(object, 0x0504_0004);
        }
        let data = std::mem::take(data);
        self.store(object, data, segment(0xA1, &[]))
    }

    fn block_segment(&mut self, request: Payload) -> Vec<Payload> {
        let block = self.abilities.block;
        let State::BlockDownload { data, segment: taken, complete, .. } = &mut self.state else {
            unreachable!()
        };
        let (number, last) = (request[0] & 0x7F, request[0] >= 0x80);
        let next = number == *taken + 1;
        if next {
            data.extend(&request[1..]);
            *taken = number;
            *complete = last;
        }
        if number < block && !last || number <= *taken && !next {
            return vec![];
        }
        let answer = segment(0xA2, &[*taken, block]);
        *taken = 0;
        vec![answer]
    }
}
