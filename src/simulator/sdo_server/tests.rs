//! Tests of the SDO server: each kind of transfer, in bytes as on the bus.

use std::collections::BTreeMap;

use proptest::prelude::*;

use super::block::crc;
use super::*;

/// Entries 0x2000/00 of any length, 0x2001/00 of four bytes, 0x2002/00 read-only.
#[derive(Default)]
struct Shelf(BTreeMap<u16, Vec<u8>>);

impl Dictionary for Shelf {
    fn read(&mut self, index: u16, _: u8) -> Result<Vec<u8>, Abort> {
        self.0.get(&index).cloned().ok_or(Abort::NO_OBJECT)
    }

    fn may_write(&self, index: u16, _: u8) -> Result<Option<usize>, Abort> {
        match index {
            0x2000 => Ok(None),
            0x2001 => Ok(Some(4)),
            0x2002 => Err(Abort::READ_ONLY),
            _ => Err(Abort::NO_OBJECT),
        }
    }

    fn write(&mut self, index: u16, _: u8, data: &[u8]) -> Result<(), Abort> {
        self.0.insert(index, data.to_vec());
        Ok(())
    }
}

fn bytes(text: &str) -> [u8; 8] {
    let digits: Vec<u8> = text.split(' ').map(|byte| u8::from_str_radix(byte, 16).unwrap()).collect();
    let mut bytes = [0; 8];
    bytes[..digits.len()].copy_from_slice(&digits);
    bytes
}

/// Asks, and holds the answers against what is expected; both without trailing zeros.
#[track_caller]
fn talk(server: &mut SdoServer, shelf: &mut Shelf, conversation: &[(&str, &[&str])]) {
    for (request, expected) in conversation {
        let answers = server.handle_request(bytes(request), shelf);
        let expected: Vec<_> = expected.iter().map(|answer| bytes(answer)).collect();
        assert_eq!(answers, expected, "{request}");
    }
}

fn shelf(content: &[u8]) -> Shelf {
    Shelf(BTreeMap::from([(0x2000, content.to_vec())]))
}

#[test]
fn r_dst_066_067_expedited_transfers_of_one_to_four_bytes() {
    let mut server = SdoServer::new(100);
    for (content, answer) in [
        (&[1][..], "4F 00 20 00 01"),
        (&[1, 2], "4B 00 20 00 01 02"),
        (&[1, 2, 3], "47 00 20 00 01 02 03"),
        (&[1, 2, 3, 4], "43 00 20 00 01 02 03 04"),
    ] {
        talk(&mut server, &mut shelf(content), &[("40 00 20 00", &[answer])]);
    }
    let mut shelf = shelf(&[]);
    for (request, content) in [
        ("2F 00 20 00 09 FF FF FF", &[9][..]),
        ("2B 00 20 00 09 08 FF FF", &[9, 8]),
        ("27 00 20 00 09 08 07 FF", &[9, 8, 7]),
        ("23 00 20 00 09 08 07 06", &[9, 8, 7, 6]),
        ("22 00 20 00 09 08 07 05", &[9, 8, 7, 5]),
    ] {
        talk(&mut server, &mut shelf, &[(request, &["60 00 20 00"])]);
        assert_eq!(shelf.0[&0x2000], content);
    }
}

#[test]
fn segmented_upload_announces_its_size_and_alternates_the_toggle_bit() {
    let mut server = SdoServer::new(100);
    let conversation: &[(&str, &[&str])] = &[
        ("40 00 20 00", &["41 00 20 00 0B"]),
        ("60", &["00 54 45 53 54 20 44 45"]),
        ("70", &["17 56 49 43 45"]),
        ("60", &["80 00 00 00 01 00 04 05"]),
    ];
    talk(&mut server, &mut shelf(b"TEST DEVICE"), conversation);
    talk(&mut server, &mut shelf(b""), &[("40 00 20 00", &["41 00 20 00"]), ("60", &["0F"])]);
}

#[test]
fn a_wrong_toggle_bit_ends_a_transfer_in_both_directions() {
    let mut server = SdoServer::new(100);
    let conversation: &[(&str, &[&str])] = &[
        ("40 00 20 00", &["41 00 20 00 0B"]),
        ("70", &["80 00 20 00 00 00 03 05"]),
        ("21 00 20 00 08", &["60 00 20 00"]),
        ("00 01 02 03 04 05 06 07", &["20"]),
        ("0D 08", &["80 00 20 00 00 00 03 05"]),
        ("1D 08", &["80 00 00 00 01 00 04 05"]),
    ];
    talk(&mut server, &mut shelf(b"TEST DEVICE"), conversation);
}

#[test]
fn segmented_download_is_written_at_its_end_and_as_long_as_announced() {
    let mut server = SdoServer::new(16);
    let mut shelf = shelf(&[]);
    let conversation: &[(&str, &[&str])] = &[
        ("21 00 20 00 08", &["60 00 20 00"]),
        ("00 01 02 03 04 05 06 07", &["20"]),
        ("1D 08", &["30"]),
        // Announced 9, sent 8; announced 7, sent 8; more than the server takes, with and without saying so.
        ("21 00 20 00 09", &["60 00 20 00"]),
        ("00 01 02 03 04 05 06 07", &["20"]),
        ("1D 08", &["80 00 20 00 13 00 07 06"]),
        ("21 00 20 00 07", &["60 00 20 00"]),
        ("00 01 02 03 04 05 06 07", &["20"]),
        ("1D 08", &["80 00 20 00 12 00 07 06"]),
        ("21 00 20 00 11", &["80 00 20 00 05 00 04 05"]),
        ("20 00 20 00", &["60 00 20 00"]),
        ("00 01 02 03 04 05 06 07", &["20"]),
        ("10 01 02 03 04 05 06 07", &["30"]),
        ("00 01 02 03 04 05 06 07", &["80 00 20 00 05 00 04 05"]),
    ];
    talk(&mut server, &mut shelf, conversation);
    assert_eq!(shelf.0[&0x2000], [1, 2, 3, 4, 5, 6, 7, 8]);
}

#[test]
fn r_dst_010_a_length_that_is_not_that_of_the_entry_is_refused_before_any_data() {
    let mut server = SdoServer::new(100);
    let conversation: &[(&str, &[&str])] = &[
        ("2B 01 20 00 01 02", &["80 01 20 00 13 00 07 06"]),
        ("21 01 20 00 05", &["80 01 20 00 12 00 07 06"]),
        ("22 01 20 00 01 02 03 04", &["60 01 20 00"]),
        ("23 02 20 00 01", &["80 02 20 00 02 00 01 06"]),
        ("23 03 20 00 01", &["80 03 20 00 00 00 02 06"]),
        ("40 03 20 00", &["80 03 20 00 00 00 02 06"]),
        ("E0", &["80 00 00 00 01 00 04 05"]),
    ];
    talk(&mut server, &mut shelf(&[]), conversation);
}

#[test]
fn an_abort_of_the_client_and_a_new_transfer_end_the_old_one() {
    let mut server = SdoServer::new(100);
    let conversation: &[(&str, &[&str])] = &[
        ("40 00 20 00", &["41 00 20 00 0B"]),
        ("80 00 20 00 00 00 04 05", &[]),
        ("60", &["80 00 00 00 01 00 04 05"]),
        ("21 00 20 00 08", &["60 00 20 00"]),
        ("40 00 20 00", &["41 00 20 00 0B"]),
        ("60", &["00 54 45 53 54 20 44 45"]),
    ];
    talk(&mut server, &mut shelf(b"TEST DEVICE"), conversation);
}

#[test]
fn block_upload_repeats_what_was_not_confirmed_and_ends_with_the_checksum() {
    assert_eq!(crc(b"123456789"), 0x31C3);
    let mut server = SdoServer::new(100);
    let conversation: &[(&str, &[&str])] = &[
        ("A4 00 20 00 02", &["C6 00 20 00 09"]),
        ("A3", &["01 31 32 33 34 35 36 37", "82 38 39"]),
        ("A2 01 7F", &["81 38 39"]),
        ("A2 01 7F", &["D5 C3 31"]),
        ("A1", &[]),
        ("A1", &["80 00 00 00 01 00 04 05"]),
    ];
    talk(&mut server, &mut shelf(b"123456789"), conversation);
    let conversation: &[(&str, &[&str])] = &[
        ("A4 00 20 00 00", &["80 00 20 00 02 00 04 05"]),
        ("A4 00 20 00 80", &["80 00 20 00 02 00 04 05"]),
        // A threshold above the length: an ordinary upload.
        ("A4 00 20 00 7F 09", &["41 00 20 00 09"]),
        ("A4 00 20 00 7F", &["C6 00 20 00 09"]),
        ("A3", &["01 31 32 33 34 35 36 37", "82 38 39"]),
        ("A2 03 7F", &["80 00 20 00 03 00 04 05"]),
    ];
    talk(&mut server, &mut shelf(b"123456789"), conversation);
}

#[test]
fn block_download_asks_again_for_what_did_not_come_in_turn_and_checks_the_sum() {
    let mut server = SdoServer::new(100);
    let mut shelf = shelf(&[]);
    let conversation: &[(&str, &[&str])] = &[
        ("C6 00 20 00 09", &["A4 00 20 00 7F"]),
        ("01 31 32 33 34 35 36 37", &[]),
        ("83 38 39", &["A2 01 7F"]),
        ("81 38 39", &["A2 01 7F"]),
        ("D5 C3 31", &["A1"]),
        ("C6 00 20 00 09", &["A4 00 20 00 7F"]),
        ("01 31 32 33 34 35 36 37", &[]),
        ("82 38 38", &["A2 02 7F"]),
        ("D5 C3 31", &["80 00 20 00 04 00 04 05"]),
        // Without a checksum, and one byte more than announced.
        ("C2 00 20 00 08", &["A4 00 20 00 7F"]),
        ("01 31 32 33 34 35 36 37", &[]),
        ("82 38 39", &["A2 02 7F"]),
        ("D5", &["80 00 20 00 12 00 07 06"]),
        ("C6 02 20 00 09", &["80 02 20 00 02 00 01 06"]),
    ];
    talk(&mut server, &mut shelf, conversation);
    assert_eq!(shelf.0[&0x2000], b"123456789");
}

/// A client as simple as can be, that reads 0x2000 in blocks.
fn read_in_blocks(server: &mut SdoServer, shelf: &mut Shelf, block_size: u8) -> Vec<u8> {
    let mut ask = |request: [u8; 8]| server.handle_request(request, shelf);
    let size = ask([0xA4, 0, 0x20, 0, block_size, 0, 0, 0])[0];
    let size = usize::try_from(u32::from_le_bytes(size[4..8].try_into().unwrap())).unwrap();
    let mut data = Vec::new();
    let mut segments = ask([0xA3, 0, 0, 0, 0, 0, 0, 0]);
    loop {
        for segment in &segments {
            data.extend_from_slice(&segment[1..]);
        }
        let last = segments.last().unwrap()[0];
        let answers = ask([0xA2, last & 0x7F, block_size, 0, 0, 0, 0, 0]);
        if last & 0x80 == 0 {
            segments = answers;
            continue;
        }
        let unused = usize::from(answers[0][0] >> 2 & 7);
        data.truncate(data.len() - unused);
        assert_eq!((data.len(), crc(&data).to_le_bytes()), (size, [answers[0][1], answers[0][2]]));
        ask([0xA1, 0, 0, 0, 0, 0, 0, 0]);
        return data;
    }
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(256))]

    #[test]
    fn what_is_read_in_blocks_is_what_is_there(
        content in proptest::collection::vec(any::<u8>(), 5..3000),
        block_size in 1_u8..=127,
    ) {
        let mut server = SdoServer::new(100);
        prop_assert_eq!(read_in_blocks(&mut server, &mut shelf(&content), block_size), content);
    }

    #[test]
    fn what_is_written_in_segments_is_read_back(content in proptest::collection::vec(any::<u8>(), 5..500)) {
        let (mut server, mut shelf) = (SdoServer::new(500), shelf(&[]));
        let [a, b, ..] = content.len().to_le_bytes();
        server.handle_request([0x21, 0, 0x20, 0, a, b, 0, 0], &mut shelf);
        let chunks: Vec<&[u8]> = content.chunks(7).collect();
        for (place, chunk) in chunks.iter().enumerate() {
            let mut request = [0; 8];
            request[1..=chunk.len()].copy_from_slice(chunk);
            let last = place + 1 == chunks.len();
            let unused = u8::try_from(7 - chunk.len()).unwrap();
            request[0] = u8::from(place % 2 == 1) << 4 | unused << 1 | u8::from(last);
            prop_assert_eq!(server.handle_request(request, &mut shelf)[0][0] & 0xE0, 0x20);
        }
        prop_assert_eq!(&shelf.0[&0x2000], &content);
    }

    #[test]
    fn whatever_is_asked_the_server_answers_in_bounds(
        requests in proptest::collection::vec(any::<[u8; 8]>(), 0..200),
    ) {
        let (mut server, mut shelf) = (SdoServer::new(64), shelf(&[7; 2000]));
        for mut request in requests {
            // Mostly to an entry that exists.
            if request[7] & 3 != 0 {
                request[1..4].copy_from_slice(&[0, 0x20, 0]);
            }
            prop_assert!(server.handle_request(request, &mut shelf).len() <= 127);
        }
    }
}
