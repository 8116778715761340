//! Every request gets the answer, or the exception, that V1.1b3 asks for. Judged by a model of its own.

use cangate::modbus::pdu::{ExceptionCode, decode};
use proptest::prelude::*;

use crate::support::plant::at;
use crate::support::registers::{ask, pdu, well};

/// The exception that a PDU deserves for its form alone, told by lengths: the shape of each request, written down
/// apart from the code that is tested.
fn exception_by_form(pdu: &[u8]) -> Option<u8> {
    let number = |at: usize| u32::from(pdu[at]) << 8 | u32::from(pdu[at + 1]);
    let fine = match pdu[0] {
        1 | 2 => pdu.len() == 5 && (1..=2000).contains(&number(3)),
        3 | 4 => pdu.len() == 5 && (1..=125).contains(&number(3)),
        5 => pdu.len() == 5 && (number(3) == 0 || number(3) == 0xFF00),
        6 => pdu.len() == 5,
        15 => {
            pdu.len() >= 6
                && (1..=1968).contains(&number(3))
                && u32::from(pdu[5]) == number(3).div_ceil(8)
                && pdu.len() == 6 + usize::from(pdu[5])
        }
        16 => {
            pdu.len() >= 6
                && (1..=123).contains(&number(3))
                && u32::from(pdu[5]) == number(3) * 2
                && pdu.len() == 6 + usize::from(pdu[5])
        }
        22 => pdu.len() == 7,
        23 => {
            pdu.len() >= 10
                && (1..=125).contains(&number(3))
                && (1..=121).contains(&number(7))
                && u32::from(pdu[9]) == number(7) * 2
                && pdu.len() == 10 + usize::from(pdu[9])
        }
        43 if pdu.len() > 1 && pdu[1] != 14 => return Some(1),
        43 => pdu.len() == 4 && (1..=4).contains(&pdu[2]),
        _ => return Some(1),
    };
    (!fine).then_some(3)
}

fn exception_of_decode(pdu: &[u8]) -> Option<u8> {
    decode(pdu).err().map(u8::from)
}

/// A well-formed request of a function as far as it has one.
fn template(function: u8) -> Vec<u8> {
    match function {
        1..=4 | 6 => pdu(function, 0, 1),
        5 => pdu(5, 0, 0xFF00),
        15 => [pdu(15, 0, 9), vec![2, 0xFF, 1]].concat(),
        16 => [pdu(16, 0, 2), vec![4, 1, 2, 3, 4]].concat(),
        22 => vec![22, 0, 0, 0xFF, 0xFF, 0, 0],
        23 => vec![23, 0, 0, 0, 1, 0, 0, 0, 1, 2, 7, 7],
        43 => vec![43, 14, 1, 0],
        _ => vec![function],
    }
}

#[test]
fn s1_every_function_code_with_every_length_agrees_with_the_model() {
    let mut well_formed = 0;
    for function in 0..=255_u8 {
        let template = template(function);
        for length in 1..=253 {
            let mut cut_or_padded = template.clone();
            cut_or_padded.resize(length, 0);
            let mut ones = vec![0xFF; length];
            ones[0] = function;
            let mut zeros = vec![0; length];
            zeros[0] = function;
            // Declares as much as its length has room for.
            let mut fitting = cut_or_padded.clone();
            if let (15 | 16, Some(payload @ 1..)) = (function, length.checked_sub(6)) {
                fitting[5] = u8::try_from(payload).unwrap();
                let quantity = u16::try_from(if function == 15 { payload * 8 } else { payload / 2 }).unwrap();
                fitting[3..5].copy_from_slice(&quantity.to_be_bytes());
            }
            if let (23, Some(payload @ 1..)) = (function, length.checked_sub(10)) {
                fitting[9] = u8::try_from(payload).unwrap();
                fitting[7..9].copy_from_slice(&u16::try_from(payload / 2).unwrap().to_be_bytes());
            }
            for pdu in [cut_or_padded, ones, zeros, fitting] {
                let expected = exception_by_form(&pdu);
                well_formed += usize::from(expected.is_none());
                assert_eq!(exception_of_decode(&pdu), expected, "{pdu:02x?}");
            }
        }
    }
    assert!(well_formed > 400, "the enumeration holds good requests too: {well_formed}");
}

#[test]
fn every_quantity_is_judged_by_its_function() {
    let (bank, image) = well();
    for quantity in 0..=u16::MAX {
        for (function, most) in [(1, 2000), (2, 2000), (3, 125), (4, 125)] {
            let expected = (quantity == 0 || quantity > most).then_some(3);
            for address in [0, 0x8000, 0xFFFF] {
                assert_eq!(exception_of_decode(&pdu(function, address, quantity)), expected);
            }
            // The quantity is judged before the address: at 65535 nothing is published.
            let answer = ask(&bank, &image, at(0), 1, &pdu(function, 0xFFFF, quantity));
            assert_eq!(answer, [function | 0x80, expected.unwrap_or(2)]);
        }
        for function in [15, 16] {
            let request = [pdu(function, 0, quantity), vec![2, 0, 0]].concat();
            let fits = if function == 15 { (9..=16).contains(&quantity) } else { quantity == 1 };
            assert_eq!(exception_of_decode(&request), (!fits).then_some(3), "FC {function}, {quantity}");
        }
    }
}

#[test]
fn every_address_is_inside_a_published_block_or_answers_02() {
    let (bank, image) = well();
    // Unit 1: engine 1 at 0, engine 4 at 1000; 112 registers in use are published up to 120, bits up to 192.
    let inside = |first: u32, count: u32, blocks: &[(u32, u32)]| {
        blocks.iter().any(|(start, end)| *start <= first && first + count <= *end)
    };
    let unit_1_registers = [(0, 120), (1000, 1120)];
    let unit_1_bits = [(0, 192), (1000, 1192)];
    let gateway = [(0, 100), (200, 590)];
    for address in 0..=u16::MAX {
        for (unit, function, count, blocks) in [
            (1, 3, 1, &unit_1_registers),
            (1, 4, 1, &unit_1_registers),
            (1, 4, 120, &unit_1_registers),
            (1, 1, 1, &unit_1_bits),
            (1, 2, 1, &unit_1_bits),
            (1, 2, 192, &unit_1_bits),
            (247, 4, 1, &gateway),
            (0, 3, 100, &gateway),
            (255, 4, 125, &gateway),
        ] {
            let answer = ask(&bank, &image, at(0), unit, &pdu(function, address, count));
            let expected = inside(address.into(), count.into(), blocks);
            assert_eq!(answer[0] == function, expected, "unit {unit} FC {function} {address} x {count}");
            if !expected {
                assert_eq!(answer, [function | 0x80, 2]);
            }
        }
        assert_eq!(ask(&bank, &image, at(0), 247, &pdu(2, address, 1)), [0x82, 2], "the gateway has no bits");
    }
}

#[test]
fn what_libraries_get_wrong_is_answered_by_the_standard() {
    let (bank, image) = well();
    let cases: &[(&str, &[u8], [u8; 2])] = &[
        ("FC 3, quantity 0", &[3, 0, 0, 0, 0], [0x83, 3]),
        ("FC 3, quantity 126", &[3, 0, 0, 0, 126], [0x83, 3]),
        ("FC 3, quantity 2000", &[3, 0, 0, 7, 0xD0], [0x83, 3]),
        ("FC 3, too short", &[3, 0, 0, 0], [0x83, 3]),
        ("FC 3, a byte too many", &[3, 0, 0, 0, 1, 0], [0x83, 3]),
        ("FC 5, neither on nor off", &[5, 0, 0, 0x12, 0x34], [0x85, 3]),
        ("FC 15, 16 coils in one byte", &[15, 0, 0, 0, 16, 1, 0xFF], [0x8F, 3]),
        ("FC 16, count mismatch", &[16, 0, 0, 0, 2, 2, 0, 1], [0x90, 3]),
        ("FC 16, 32769 registers", &[16, 0, 0, 0x80, 1, 2, 0, 1], [0x90, 3]),
        ("FC 23, 32769 registers", &[23, 0, 0, 0, 1, 0, 0, 0x80, 1, 2, 0, 1], [0x97, 3]),
        ("FC 43/14, read code 9", &[0x2B, 0x0E, 9, 0], [0xAB, 3]),
        ("FC 43/13", &[0x2B, 0x0D, 0, 0, 1, 0x10, 0, 0, 0], [0xAB, 1]),
        ("FC 43, no type", &[0x2B], [0xAB, 3]),
        ("function code 0x83", &[0x83, 1], [0x83, 1]),
        ("function code 0", &[0], [0x80, 1]),
        ("FC 8", &[8, 0, 0, 0x12, 0x34], [0x88, 1]),
        ("FC 3, last address", &[3, 0xFF, 0xFF, 0, 1], [0x83, 2]),
        ("FC 3, wraps around", &[3, 0xFF, 0xFF, 0, 2], [0x83, 2]),
    ];
    for (what, request, expected) in cases {
        assert_eq!(ask(&bank, &image, at(0), 1, request), expected, "{what}");
    }
}

#[test]
fn f38_a_well_formed_write_answers_02_as_nothing_can_be_written() {
    let (bank, image) = well();
    for function in [5, 6, 15, 16, 22, 23] {
        let request = template(function);
        assert_eq!(ask(&bank, &image, at(0), 1, &request), [function | 0x80, 2]);
        assert_eq!(ask(&bank, &image, at(0), 247, &request), [function | 0x80, 2]);
    }
}

#[test]
fn an_unknown_unit_answers_0b_whatever_is_asked() {
    let (bank, image) = well();
    let known = [0, 1, 2, 3, 247, 255];
    for unit in 0..=255 {
        for request in [pdu(4, 0, 1), pdu(4, 0, 0), template(6), template(43), vec![99]] {
            let answer = ask(&bank, &image, at(0), unit, &request);
            let unknown = answer == [request[0] | 0x80, u8::from(ExceptionCode::GatewayTargetDevice)];
            assert_eq!(unknown, !known.contains(&unit), "unit {unit}: {answer:02x?}");
        }
    }
}

proptest! {
    #[test]
    fn no_bytes_can_make_decoding_panic_or_disagree_with_the_model(
        bytes in prop::collection::vec(any::<u8>(), 1..=253),
        function in prop::sample::select(vec![1_u8, 2, 3, 4, 5, 6, 15, 16, 22, 23, 43]),
    ) {
        prop_assert_eq!(exception_of_decode(&bytes), exception_by_form(&bytes));
        let mut known = bytes;
        known[0] = function;
        prop_assert_eq!(exception_of_decode(&known), exception_by_form(&known));
        prop_assert!(decode(&[]).is_err());
    }

    #[test]
    fn every_answer_is_a_frame_of_at_most_260_bytes(
        bytes in prop::collection::vec(any::<u8>(), 1..=253),
        unit in any::<u8>(),
    ) {
        let (bank, image) = well();
        // `ask` checks the form of the answer.
        prop_assert!(ask(&bank, &image, at(0), unit, &bytes).len() <= 253);
    }
}
