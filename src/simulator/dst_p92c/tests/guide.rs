//! The object dictionary as the maker's guide lists it, beside the table in the program: what one of the two has wrong, the
//! other does not know.

use std::collections::{BTreeMap, BTreeSet};

use super::bench::Bench;

/// Index, sub-index, type, access (assumed for 6131/2, of which the guide says none) and default where there is one.
const GUIDE: &str = "
1000/0 u32 ro 0x00020194, 1001/0 u8 ro 0x00, 1003/0 u8 rw 0x01, 1003/1 u32 ro -, 1005/0 u32 rw 0x80,
1008/0 str ro -, 1009/0 str ro -, 100A/0 str ro -, 1010/0 u8 ro 1, 1010/1 u32 rw 0x01, 1011/0 u8 ro 1,
1011/1 u32 rw 0x01, 1014/0 u32 ro 0x81, 1016/0 u8 ro 1, 1016/1 u32 rw 0, 1017/0 u16 rw 0, 1018/0 u8 ro 4,
1018/1 u32 ro 0x23D, 1018/2 u32 ro -, 1018/3 u32 ro -, 1018/4 u32 ro -, 1800/0 u8 ro 5, 1800/1 u32 rw 0x181,
1800/2 u8 rw 0x01, 1800/3 u16 rw 0, 1800/4 u8 rw 0, 1800/5 u16 rw 0x3E8, 1A00/0 u8 rw 2,
1A00/1 u32 rw 0x91300120, 1A00/2 u32 rw 0x61500108, 1A00/3 u32 rw 0, 1A00/4 u32 rw 0, 1F80/0 u32 rw 4,
3000/0 u16 rw 0, 3001/0 u16 rw 0, 3002/0 u16 rw 0, 3003/0 u16 rw 0, 4E00/0 u8 ro 4, 4E00/1 u8 ro 11,
4E00/2 u32 ro 223344, 4E00/3 u16 ro 5566, 4E00/4 str ro -, 4F00/0 u8 rw 4, 4F01/0 u8 rw 1, 6110/0 u8 ro 2,
6110/1 u16 ro 0x5A, 6110/2 u16 ro 0x64, 6124/0 u8 ro 1, 6124/1 f32 rw -, 6125/0 u8 ro 1, 6125/1 u32 wo -,
6130/0 u8 ro 2, 6130/1 f32 ro -, 6130/2 f32 ro -, 6131/0 u8 ro 2, 6131/1 u32 rw 0x00220000,
6131/2 u32 rw 0x002D0000, 6132/0 u8 ro 2, 6132/1 u8 rw 0, 6132/2 u8 rw 0, 6133/0 u8 ro 2, 6133/1 f32 rw 0,
6133/2 f32 rw 0, 6135/0 u8 ro 2, 6135/1 f32 rw 2147483520, 6135/2 f32 rw 2147483520, 6148/0 u8 ro 2,
6148/1 f32 ro -, 6148/2 f32 ro -, 6149/0 u8 ro 2, 6149/1 f32 ro -, 6149/2 f32 ro -, 6150/0 u8 ro 2,
6150/1 u8 ro 0, 6150/2 u8 ro 0, 61A0/0 u8 ro 1, 61A0/1 u8 rw 1, 61A1/0 u8 ro 1, 61A1/1 u8 rw 30,
7100/0 u8 ro 2, 7100/1 i16 ro -, 7100/2 i16 ro -, 9124/0 u8 ro 1, 9124/1 i32 rw 0, 9130/0 u8 ro 2,
9130/1 i32 ro -, 9130/2 i32 ro -, 9133/0 u8 ro 2, 9133/1 i32 rw 0, 9133/2 i32 rw 0, 9134/0 u8 ro 2,
9134/1 i32 rw -2147483648, 9134/2 i32 rw -2147483648, 9135/0 u8 ro 2, 9135/1 i32 rw 2147483520,
9135/2 i32 rw 2147483520, 9148/0 u8 ro 2, 9148/1 i32 ro -, 9148/2 i32 ro -, 9149/0 u8 ro 2, 9149/1 i32 ro -,
9149/2 i32 ro -
";

struct Entry {
    key: (u16, u8),
    kind: &'static str,
    access: &'static str,
    default: &'static str,
}

fn guide() -> Vec<Entry> {
    let entry = |text: &'static str| {
        let [key, kind, access, default] = *text.split(' ').collect::<Vec<_>>() else { panic!("{text}") };
        let (index, sub) = key.split_once('/').unwrap();
        Entry { key: (u16::from_str_radix(index, 16).unwrap(), sub.parse().unwrap()), kind, access, default }
    };
    GUIDE.split([',', '\n']).map(str::trim).filter(|text| !text.is_empty()).map(entry).collect()
}

/// The first four bytes of the answer to an upload, and its abort code where it is one.
fn upload(bench: &mut Bench, (index, sub): (u16, u8)) -> (String, u32) {
    let [low, high] = index.to_le_bytes();
    let answer = bench.ask(&format!("601#40{low:02X}{high:02X}{sub:02X}00000000"));
    let data = answer.strip_prefix("581#").unwrap_or_else(|| panic!("{index:04X}/{sub}: {answer}"));
    let number = u32::from_str_radix(&data[8..], 16).unwrap().swap_bytes();
    (data[..2].to_owned(), number)
}

fn bits(kind: &str, text: &str) -> u32 {
    match (kind, text.strip_prefix("0x")) {
        (_, Some(digits)) => u32::from_str_radix(digits, 16).unwrap(),
        ("f32", None) => text.parse::<f32>().unwrap().to_bits(),
        ("i32", None) => text.parse::<i32>().unwrap().cast_unsigned(),
        (_, None) => text.parse().unwrap(),
    }
}

#[test]
fn r_dst_002_003_008_009_010_every_object_of_the_guide_has_its_type_access_and_default() {
    let mut bench = Bench::ready();
    let lengths = BTreeMap::from([("u8", 1), ("u16", 2), ("i16", 2), ("u32", 4), ("i32", 4), ("f32", 4)]);
    for Entry { key, kind, access, default } in guide() {
        let name = format!("{:04X}/{}", key.0, key.1);
        let (command, number) = upload(&mut bench, key);
        let expected = match (access, kind) {
            ("wo", _) => "80",
            (_, "str") => "41",
            (_, "u8") => "4F",
            (_, "u16" | "i16") => "4B",
            (..) => "43",
        };
        assert_eq!(command, expected, "{name}");
        if default != "-" {
            assert_eq!(number, bits(kind, default), "{name}");
        }
        let length = lengths.get(kind).copied().unwrap_or(4);
        // One byte too many or too few is refused in any case, and only what can be written says so of the length.
        let wrong = if length == 4 { 3 } else { length + 1 };
        let code = bench.write(key.0, key.1, wrong, 0);
        let of_length = if length == 4 { 0x0607_0013 } else { 0x0607_0012 };
        assert_eq!(code, if access == "ro" { 0x0601_0002 } else { of_length }, "{name}");
    }
    assert_eq!(upload(&mut bench, (0x6125, 1)).1, 0x0601_0001);
}

#[test]
fn r_dst_008_there_is_nothing_that_the_guide_does_not_list() {
    let mut bench = Bench::ready();
    let listed: BTreeSet<(u16, u8)> = guide().into_iter().map(|entry| entry.key).collect();
    let indices: BTreeSet<u16> = listed.iter().map(|(index, _)| *index).collect();
    for index in (0x1000..=0x9FFF).filter(|index| !indices.contains(index)) {
        assert_eq!(upload(&mut bench, (index, 0)), ("80".to_owned(), 0x0602_0000), "{index:04X}");
    }
    for index in indices {
        for sub in (0..=255).filter(|sub| !listed.contains(&(index, *sub))) {
            let found = upload(&mut bench, (index, sub));
            assert_eq!(found, ("80".to_owned(), 0x0609_0011), "{index:04X}/{sub}");
        }
    }
}
