//! FC 43/13 byte by byte.

use super::*;
use crate::can::BusIndex;
use crate::gateway::command::AbortCode;
use crate::mapping::installation::{NodeEntry, Offset};
use crate::mapping::{At, Sketch};

fn bytes(hex: &str) -> Vec<u8> {
    let digits: String = hex.split_whitespace().collect();
    (0..digits.len())
        .step_by(2)
        .map(|place| u8::from_str_radix(&digits[place..place + 2], 16).unwrap())
        .collect()
}

fn reference(hex: &str) -> Reference {
    decode(&bytes(hex)).unwrap()
}

fn answered(request: &str, outcome: &Outcome) -> Result<Vec<u8>, ExceptionCode> {
    let mut out = Vec::new();
    reference(request).answer(outcome, &mut out).map(|()| out)
}

/// A node with unit id and node id 1, and two nodes, 2 and 3, that share unit id 9.
fn table() -> TagTable {
    let shares = |offset| {
        move |node: &mut NodeEntry| {
            node.unit_id = Some(At::nowhere(9));
            node.offset = Some(At::nowhere(Offset::Fixed(offset)));
        }
    };
    let sketch = Sketch::new().node("a", 1, "danfoss-dst-p92c", |_| ());
    let sketch = sketch.node("b", 2, "motortech-detcon", shares(0));
    sketch.node("c", 3, "danfoss-dst-p92c", shares(1000)).build().unwrap().0
}

/// The same, but that the last of them is node 2 of a second bus.
fn table_of_two_buses() -> TagTable {
    let mut table = table();
    table.buses.push(table.buses[0].clone());
    table.nodes[2].bus = BusIndex(1);
    let id = table.nodes[1].canopen().unwrap().id;
    let crate::mapping::Protocol::Canopen(settings) = &mut table.nodes[2].protocol else { panic!() };
    settings.id = id;
    table
}

#[test]
fn the_exchange_of_a_makers_manual_byte_by_byte() {
    let request = "2B 0D 02 00 00 01 2101 01 0000 0004";
    let read = Outcome::Read(bytes("9AC50000"));
    assert_eq!(answered(request, &read), Ok(bytes("2B 0D 02 00 00 01 2101 01 0000 0004 9AC50000")));
    let Ok(Action::SdoRead { node, object, .. }) = reference(request).action(&table(), 0xFF) else {
        panic!()
    };
    assert_eq!((node, object), (NodeIndex(0), ObjectId::new(0x2101, 1)));
}

#[test]
fn options_come_back_in_their_order_and_a_network_chooses_the_bus() {
    let request = "2B 0D 26 00 11 01 33 01 1000 00 0000 0008";
    let read = Outcome::Read(bytes("94010200"));
    assert_eq!(
        answered(request, &read),
        Ok(bytes("2B 0D 26 00 11 01 33 01 1000 00 0000 0004 94010200")),
        "fewer bytes than were asked for: the object has no more"
    );
    assert!(reference(request).action(&table(), 247).is_ok());
    let other = reference("2B 0D 04 00 02 01 1000 00 0000 0004");
    assert_eq!(other.action(&table(), 247), Err(ExceptionCode::IllegalDataAddress));
}

#[test]
fn an_object_that_is_too_long_for_one_pdu_is_read_in_parts() {
    let object: Vec<u8> = (0..=255).cycle().take(600).collect();
    let read = Outcome::Read(object.clone());
    let (mut got, mut parts) = (Vec::new(), 0);
    loop {
        let start = u16::try_from(got.len()).unwrap();
        let mut request = bytes("2B 0D 00 00 01 1F50 01 0000 FFFF");
        request[8..10].copy_from_slice(&start.to_be_bytes());
        let mut out = Vec::new();
        decode(&request).unwrap().answer(&read, &mut out).unwrap();
        assert!(out.len() <= LONGEST_PDU);
        assert_eq!(usize::from(u16::from_be_bytes([out[10], out[11]])), out.len() - HEADER);
        got.extend_from_slice(&out[HEADER..]);
        parts += 1;
        if out[2] & MORE_FOLLOWS == 0 {
            break;
        }
    }
    assert_eq!((got, parts), (object, 3));
    let beyond = "2B 0D 00 00 01 1F50 01 0258 0001";
    assert_eq!(answered(beyond, &read), Err(ExceptionCode::IllegalDataAddress));
    assert_eq!(answered("2B 0D 00 00 01 1F50 01 0000 0001", &Outcome::Read(vec![])).unwrap().len(), HEADER);
}

#[test]
fn a_write_brings_the_whole_object_and_is_confirmed_without_it() {
    let request = "2B 0D 01 00 01 6132 02 0000 0001 02";
    assert!(reference(request).writes());
    let Ok(Action::SdoWrite { data, .. }) = reference(request).action(&table(), 1) else { panic!() };
    assert_eq!(data, [2]);
    assert_eq!(answered(request, &Outcome::Done), Ok(bytes("2B 0D 01 00 01 6132 02 0000 0001")));
}

#[test]
fn s1_what_is_not_well_formed_answers_03() {
    for wrong in [
        "2B 0D",
        "2B 0D 00 00 01 1000 00 0000",
        "2B 0D 00 01 01 1000 00 0000 0004",
        "2B 0D 80 00 01 1000 00 0000 0004",
        "2B 0D 40 00 00 01 1000 00 0000 0004",
        "2B 0D 10 00 01 1000 00 0000 0004",
        "2B 0D 08 00 01 1000 00 0000 0004",
        "2B 0D 00 00 01 1000 00 0000 0000",
        "2B 0D 00 00 01 1000 00 0000 0004 01",
        "2B 0D 01 00 01 1000 00 0000 0002 01",
        "2B 0D 01 00 01 1000 00 0001 0001 01",
        "2B 0D 02 00 01 1000 00 0000 0004",
    ] {
        assert_eq!(decode(&bytes(wrong)), Err(ExceptionCode::IllegalDataValue), "{wrong}");
    }
}

#[test]
fn at_the_unit_id_of_a_node_only_that_node_can_be_named() {
    let [first, second, third] =
        [1, 2, 3].map(|node| reference(&format!("2B 0D 00 00 0{node} 1000 00 0000 0004")));
    assert!(first.action(&table(), 1).is_ok() && second.action(&table(), 9).is_ok());
    assert!(third.action(&table(), 9).is_ok(), "of those that share a unit id each can be named");
    assert!(first.action(&table(), 0).is_ok() && second.action(&table(), 255).is_ok());
    for (reference, unit) in [(&first, 9), (&second, 1), (&third, 1)] {
        assert_eq!(reference.action(&table(), unit), Err(ExceptionCode::IllegalDataAddress));
    }
    let nobody = reference("2B 0D 00 00 00 1000 00 0000 0004");
    assert_eq!(nobody.action(&table(), 1), Err(ExceptionCode::IllegalDataAddress));
}

#[test]
fn of_two_nodes_alike_behind_a_unit_id_neither_is_taken_at_a_venture() {
    let table = table_of_two_buses();
    for unit in [9, 247] {
        let either = reference("2B 0D 00 00 02 1000 00 0000 0004");
        assert_eq!(either.action(&table, unit), Err(ExceptionCode::IllegalDataAddress), "unit {unit}");
        for (request, place) in
            [("2B 0D 04 00 01 02 1000 00 0000 0004", 1), ("2B 0D 04 00 02 02 1000 00 0000 0004", 2)]
        {
            let Ok(Action::SdoRead { node, .. }) = reference(request).action(&table, unit) else {
                panic!("{request}")
            };
            assert_eq!(node, NodeIndex(place), "unit {unit}");
        }
    }
}

#[test]
fn every_outcome_has_the_exception_of_the_table() {
    for (outcome, exception) in [
        (Outcome::Unknown, ExceptionCode::IllegalDataAddress),
        (Outcome::Rejected(String::new()), ExceptionCode::IllegalDataValue),
        (Outcome::Busy, ExceptionCode::ServerDeviceBusy),
        (Outcome::NodeUnavailable, ExceptionCode::GatewayPathUnavailable),
        (Outcome::Timeout, ExceptionCode::GatewayTargetDevice),
        (Outcome::Aborted(AbortCode(0x0602_0000)), ExceptionCode::ServerDeviceFailure),
        (Outcome::Failed(String::new()), ExceptionCode::ServerDeviceFailure),
    ] {
        assert_eq!(answered("2B 0D 00 00 01 1000 00 0000 0004", &outcome), Err(exception), "{outcome:?}");
    }
}
