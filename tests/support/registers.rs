//! The made-up plant with a register map, and ways to ask it.

use std::sync::Arc;

use cangate::mapping::{Encoding, OnLoss, RegisterDef, Space, TagTable};
use cangate::modbus::frame::{Frame, Parsed, parse};
use cangate::modbus::{ModbusSettings, RegisterBank, RegisterMap, service};
use cangate::process_image::ProcessImage;
use cangate::time::Now;

use super::plant;

/// Four engines: 1 shows invalid values as such, 2 holds them, 3 answers with an exception; 4 stands on unit 1 at
/// offset 1000. Tag and alarm places are those of `plant`.
pub fn table() -> TagTable {
    let mut table = (*plant::table(4)).clone();
    for place in 0..4 {
        let first = table.nodes[place].tags.start;
        let registers = [
            (100, Encoding::U16, 0.01),
            (101, Encoding::I16, 0.01),
            (102, Encoding::U32, 0.01),
            (104, Encoding::I32, 0.01),
            (106, Encoding::F32, 1.0),
            (108, Encoding::Raw16, 1.0),
            (110, Encoding::Raw32, 1.0),
        ];
        let defs = registers.map(|(address, encoding, resolution)| RegisterDef {
            space: Space::Register,
            address,
            encoding,
            resolution,
        });
        table.tags[first].registers = defs.to_vec();
        for (tag, address) in [(1, 96), (2, 1), (3, 0)] {
            table.tags[first + tag].registers =
                vec![RegisterDef { space: Space::Bit, address, encoding: Encoding::Bool, resolution: 1.0 }];
        }
        let alarms = table.nodes[place].alarms.start;
        for (alarm, bit) in [0, 3, 16].into_iter().enumerate() {
            table.alarms[alarms + alarm].bit = Some(bit);
        }
    }
    table.nodes[1].on_loss = OnLoss::Hold;
    table.nodes[2].on_loss = OnLoss::Exception;
    table.nodes[3].unit_id = 1;
    table.nodes[3].offset = 1000;
    table
}

/// A bank over a table.
pub fn bank(table: TagTable, settings: &ModbusSettings) -> RegisterBank {
    let map = RegisterMap::build(&table, settings, "cangate").unwrap();
    RegisterBank::new(Arc::new(table), Arc::new(map))
}

/// A bank and an image in which all is well.
pub fn well() -> (RegisterBank, ProcessImage) {
    let table = table();
    let image = plant::image(&table);
    (bank(table, &ModbusSettings::default()), image)
}

/// The PDU that answers a PDU.
pub fn ask(bank: &RegisterBank, image: &ProcessImage, now: Now, unit: u8, pdu: &[u8]) -> Vec<u8> {
    let mut out = Vec::new();
    let exception = service::answer(bank, image, now, &Frame { transaction: 0xBEEF, unit, pdu }, &mut out);
    let Parsed::Frame(answer) = parse(&out) else { panic!("the answer is no frame: {out:02x?}") };
    assert_eq!((answer.transaction, answer.unit, answer.length()), (0xBEEF, unit, out.len()));
    let function = pdu.first().copied().unwrap_or(0);
    match exception {
        Some(code) => assert_eq!(answer.pdu, [function | 0x80, code.into()]),
        None => assert_eq!(answer.pdu[0], function),
    }
    answer.pdu.to_vec()
}

/// A request with two numbers: address and quantity, or address and value.
pub fn pdu(function: u8, address: u16, quantity: u16) -> Vec<u8> {
    let mut pdu = vec![function];
    pdu.extend(address.to_be_bytes());
    pdu.extend(quantity.to_be_bytes());
    pdu
}

/// Input registers, or the exception.
pub fn registers(
    bank: &RegisterBank,
    image: &ProcessImage,
    now: Now,
    unit: u8,
    address: u16,
    quantity: u16,
) -> Result<Vec<u16>, u8> {
    let answer = ask(bank, image, now, unit, &pdu(4, address, quantity));
    if answer[0] == 0x84 {
        return Err(answer[1]);
    }
    assert_eq!(usize::from(answer[1]), usize::from(quantity) * 2);
    assert_eq!(answer.len(), 2 + usize::from(quantity) * 2);
    Ok(answer[2..].chunks(2).map(|pair| u16::from_be_bytes([pair[0], pair[1]])).collect())
}

/// Discrete inputs, or the exception.
pub fn bits(
    bank: &RegisterBank,
    image: &ProcessImage,
    unit: u8,
    address: u16,
    quantity: u16,
) -> Result<Vec<bool>, u8> {
    let answer = ask(bank, image, Now::default(), unit, &pdu(2, address, quantity));
    if answer[0] == 0x82 {
        return Err(answer[1]);
    }
    assert_eq!(usize::from(answer[1]), answer.len() - 2);
    let all = answer[2..].iter().flat_map(|byte| (0..8).map(move |bit| byte >> bit & 1 == 1));
    let all: Vec<bool> = all.collect();
    assert_eq!(all.len(), usize::from(quantity).next_multiple_of(8));
    assert!(all[usize::from(quantity)..].iter().all(|bit| !bit), "padding bits are 0");
    Ok(all[..usize::from(quantity)].to_vec())
}
