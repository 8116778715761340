//! Block transfers, frame by frame.

use super::*;
use crate::canopen::sdo::codec::crc;

fn blocks() -> SdoSettings {
    SdoSettings { block: true, ..SdoSettings::default() }
}

fn bytes(len: usize) -> Vec<u8> {
    (0..len).map(|place| u8::try_from(place % 251).unwrap()).collect()
}

#[test]
fn everything_of_every_size_is_read_and_written_by_every_kind_of_transfer() {
    let kinds = [
        Abilities::default(),
        Abilities { sizes: false, block: 1, ..Abilities::default() },
        Abilities { block: 5, ..Abilities::default() },
        Abilities { crc: false, ..Abilities::default() },
        Abilities { blocks: false, ..Abilities::default() },
    ];
    for abilities in kinds {
        for settings in [blocks(), SdoSettings::default()] {
            for len in (0..40).chain([888, 889, 890, 1778, 1779, 5000]) {
                let mut server = Server::with(NAME, &bytes(len)).able(abilities);
                let mut client = client(settings);
                let read = converse(&mut client, &mut server, SdoRequest::read(NAME));
                assert_eq!(read, Ok(bytes(len)), "{len} bytes, {abilities:?}");
                let data: Vec<u8> = bytes(len).into_iter().rev().collect();
                let written = converse(&mut client, &mut server, SdoRequest::write(NAME, data.clone()));
                assert_eq!(written, Ok(vec![]), "{len} bytes, {abilities:?}");
                assert_eq!(server.writes, [(NAME, data)]);
                assert_eq!(client.counters().unasked + client.counters().duplicates, 0);
            }
        }
    }
}

#[test]
fn blocks_are_refused_once_and_the_transfer_goes_on_in_segments() {
    let abilities = Abilities { blocks: false, ..Abilities::default() };
    let mut server = Server::with(NAME, &bytes(50)).able(abilities);
    let mut client = client(blocks());
    assert_eq!(ask(&mut client, 0, 1, SdoRequest::read(NAME)), ["601#A40810007F1C0000"]);
    assert_eq!(answer(&mut client, 1, "581#8008100001000405"), ["601#4008100000000000"]);
    answer(&mut client, 2, "581#8008100000000206");
    let read = converse(&mut client, &mut server, SdoRequest::read(NAME));
    assert_eq!(read, Ok(bytes(50)));
    assert!(server.aborted.is_empty(), "it was not asked for blocks again");
    let missing = converse(&mut self::client(blocks()), &mut Server::default(), SdoRequest::read(NAME));
    assert_eq!(missing, Err(SdoError::Abort(AbortCode(0x0602_0000))));
}

#[test]
fn blocks_without_a_check_sum_are_not_used() {
    let mut client = client(blocks());
    ask(&mut client, 0, 1, SdoRequest::read(NAME));
    assert_eq!(
        answer(&mut client, 1, "581#C208100014000000"),
        ["601#8008100000000008", "601#4008100000000000"]
    );
    let mut client = self::client(blocks());
    ask(&mut client, 0, 2, SdoRequest::write(NAME, bytes(29)));
    assert_eq!(
        answer(&mut client, 1, "581#A00810007F000000"),
        ["601#8008100000000008", "601#210810001D000000"]
    );
}

#[test]
fn a_node_that_does_not_answer_to_blocks_is_asked_without() {
    let mut client = client(blocks());
    assert_eq!(ask(&mut client, 0, 1, SdoRequest::read(NAME)), ["601#A40810007F1C0000"]);
    assert_eq!(wait(&mut client, 500), ["601#4008100000000000"]);
}

#[test]
fn a_short_object_is_not_sent_in_blocks() {
    let mut client = client(blocks());
    assert_eq!(ask(&mut client, 0, 1, SdoRequest::read(TIMER)), ["601#A40018057F1C0000"]);
    assert_eq!(answer(&mut client, 1, "581#4B001805E8030000"), ["1 [E8, 03]"]);
}

/// A client that reads 20 bytes in a block: the server is ready, and has sent the first segment.
fn reading_a_block() -> SdoClient {
    let mut client = client(blocks());
    ask(&mut client, 0, 1, SdoRequest::read(NAME));
    assert_eq!(answer(&mut client, 1, "581#C608100014000000"), ["601#A300000000000000"]);
    assert!(answer(&mut client, 2, "581#0100010203040506").is_empty());
    client
}

#[test]
fn segments_of_a_block_that_get_lost_are_asked_for_again() {
    let mut client = reading_a_block();
    assert!(answer(&mut client, 3, "581#0100010203040506").is_empty(), "a copy");
    assert_eq!(answer(&mut client, 4, "581#830E0F1011121300"), ["601#A2017F0000000000"]);
    assert!(answer(&mut client, 4, "581#830E0F1011121300").is_empty(), "a copy");
    assert!(answer(&mut client, 5, "581#010708090A0B0C0D").is_empty());
    assert_eq!(answer(&mut client, 6, "581#820E0F1011121300"), ["601#A2027F0000000000"]);
    let [low, high] = crc(&bytes(20)).to_le_bytes();
    let end = CanFrame::data_frame(CanId::Standard(0x581), &[0xC5, low, high, 0, 0, 0, 0, 0]);
    let outputs = answer(&mut client, 7, &end.unwrap().to_string());
    assert_eq!(outputs, ["601#A100000000000000".to_owned(), format!("1 {:02X?}", bytes(20))]);
}

#[test]
fn a_block_with_a_wrong_check_sum_is_aborted() {
    let mut client = reading_a_block();
    answer(&mut client, 3, "581#020708090A0B0C0D");
    answer(&mut client, 4, "581#830E0F1011121300");
    assert_eq!(answer(&mut client, 5, "581#C5FFFF0000000000"), ["601#8008100004000405", "1 Protocol(Crc)"]);
}

#[test]
fn a_block_that_breaks_off_is_begun_again() {
    let mut client = reading_a_block();
    assert_eq!(wait(&mut client, 502), ["601#8008100000000405"]);
    assert_eq!(wait(&mut client, 1002), ["601#A40810007F1C0000"]);
    let mut client = reading_a_block();
    assert_eq!(answer(&mut client, 3, "581#8008100000000008"), ["1 Abort(0x08000000)"]);
}

#[test]
fn a_block_that_brings_nothing_new_ends() {
    let mut client = client(blocks());
    ask(&mut client, 0, 1, SdoRequest::read(NAME));
    answer(&mut client, 1, "581#C608100014000000");
    for millis in 2..5 {
        assert_eq!(answer(&mut client, millis, "581#8300000000000000"), ["601#A2007F0000000000"]);
        answer(&mut client, millis, "581#8300000000000000");
    }
    assert_eq!(
        answer(&mut client, 5, "581#8300000000000000"),
        ["601#8008100003000405", "1 Protocol(NoProgress)"]
    );
}

#[test]
fn a_block_is_written_in_bursts_so_that_others_get_their_turn() {
    let mut client = client(blocks());
    let write = SdoRequest::write(NAME, bytes(7 * 20));
    assert_eq!(ask(&mut client, 0, 1, write), ["601#C60810008C000000"]);
    let first = answer(&mut client, 1, "581#A408100014000000");
    assert_eq!((first.len(), first[0].as_str()), (8, "601#0100010203040506"));
    assert_eq!(client.poll_timeout(), Some((at(11), "SDO block segments")));
    assert_eq!(wait(&mut client, 11).len(), 8);
    let last = wait(&mut client, 21);
    assert_eq!(last.len(), 4);
    assert!(last[3].starts_with("601#94"), "{last:?}");
    // Five segments were lost.
    assert_eq!(answer(&mut client, 22, "581#A20F140000000000").len(), 5);
    let end = answer(&mut client, 23, "581#A205140000000000");
    assert!(end[0].starts_with("601#C1"), "{end:?}");
    assert_eq!(answer(&mut client, 24, "581#A100000000000000"), ["1 []"]);
}

#[test]
fn a_server_that_breaks_the_rules_of_blocks_is_refused() {
    for (frames, expected) in [
        (vec!["581#A408100000000000"], "1 Protocol(BlockSize(0))"),
        (vec!["581#A408100080000000"], "1 Protocol(BlockSize(128))"),
        (
            vec!["581#A40810007F000000", "581#A2097F0000000000"],
            "1 Protocol(Sequence { acknowledged: 9, sent: 6 })",
        ),
        (vec!["581#A40810007F000000", "581#A100000000000000"], "1 Protocol(Command(161))"),
        (vec!["581#A40810007F000000", "581#A201000000000000"], "1 Protocol(BlockSize(0))"),
    ] {
        let mut client = client(blocks());
        ask(&mut client, 0, 1, SdoRequest::write(NAME, bytes(40)));
        let outputs: Vec<_> = frames.iter().flat_map(|frame| answer(&mut client, 1, frame)).collect();
        assert_eq!(outputs.last().unwrap(), expected);
        assert!(outputs[outputs.len() - 2].starts_with("601#80"), "{outputs:?}");
    }
}
