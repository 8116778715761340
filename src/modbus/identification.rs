//! Device identification (FC 43/14): who is asked, in texts, for every unit id.

use super::gateway_block::MAP_VERSION;
use super::pdu::{Access, ENCAPSULATED, ExceptionCode, MEI_IDENTIFICATION};
use super::points::hash_text;
use crate::mapping::{NodeDef, TagTable};

/// The objects of one unit.
#[derive(Clone, Debug, Default)]
pub struct Identification {
    /// Sorted by id; basic 0-2, regular up to 6, extended from 0x80.
    objects: Vec<(u8, String)>,
}

/// All objects, by stream or one by one.
const CONFORMITY: u8 = 0x83;
/// Bytes of an answer before its first object.
const HEADER: usize = 7;
/// Bytes of an answer.
const LONGEST: usize = super::frame::LONGEST_PDU;
/// Longest text that fits beside its id and length.
const LONGEST_TEXT: usize = LONGEST - HEADER - 2;

const VERSION: &str = env!("CARGO_PKG_VERSION");

impl Identification {
    /// Those of the gateway.
    #[must_use]
    pub fn of_gateway(table: &TagTable, map_hash: u64) -> Self {
        let nodes = table.nodes.len().to_string();
        Self::new([
            (0x00, "cangate".to_owned()),
            (0x01, "cangate".to_owned()),
            (0x02, VERSION.to_owned()),
            (0x04, "CANopen gateway".to_owned()),
            (0x05, "gateway".to_owned()),
            (0x06, table.gateway.clone()),
            (0x80, hash_text(map_hash)),
            (0x81, MAP_VERSION.to_string()),
            (0x82, nodes),
        ])
    }

    /// Those of a node; of the first one where several share a unit id.
    #[must_use]
    pub fn of_node(table: &TagTable, node: &NodeDef, map_hash: u64) -> Self {
        let bus = table.buses.get(node.bus.0).map_or_else(String::new, |bus| bus.name.clone());
        Self::new([
            (0x00, node.device.vendor.clone()),
            (0x01, node.device.mapping.clone()),
            (0x02, VERSION.to_owned()),
            (0x04, node.device.description.clone()),
            (0x05, node.device.model.clone()),
            (0x06, node.name.clone()),
            (0x80, hash_text(map_hash)),
            (0x81, MAP_VERSION.to_string()),
            (0x82, node.number().to_string()),
            (0x83, bus),
        ])
    }

    fn new<const N: usize>(objects: [(u8, String); N]) -> Self {
        let cut = |(id, mut text): (u8, String)| {
            text.truncate(text.floor_char_boundary(LONGEST_TEXT));
            (id, text)
        };
        Self { objects: objects.into_iter().map(cut).collect() }
    }

    /// Appends the PDU of an answer.
    ///
    /// A stream that asks for an object that there is not begins at the first one; more objects than one answer holds
    /// are told by "more follows" and the id to ask for next (V1.1b3, 6.21).
    ///
    /// # Errors
    /// 02 for a single object that there is not.
    pub fn answer(&self, access: Access, object: u8, out: &mut Vec<u8>) -> Result<(), ExceptionCode> {
        let last = match access {
            Access::Basic => 0x02,
            Access::Regular => 0x7F,
            Access::Extended | Access::Individual => 0xFF,
        };
        let offered = self.objects.iter().take_while(|(id, _)| *id <= last);
        let first = match self.objects.iter().position(|(id, _)| *id == object && *id <= last) {
            Some(place) => place,
            None if access == Access::Individual => return Err(ExceptionCode::IllegalDataAddress),
            None => 0,
        };
        let start = out.len();
        out.extend_from_slice(&[ENCAPSULATED, MEI_IDENTIFICATION, access.code(), CONFORMITY, 0, 0, 0]);
        let limit = if access == Access::Individual { 1 } else { usize::MAX };
        let (mut count, mut next) = (0, None);
        for (id, text) in offered.skip(first).take(limit) {
            if out.len() - start + 2 + text.len() > LONGEST {
                next = Some(*id);
                break;
            }
            out.extend_from_slice(&[*id, u8::try_from(text.len()).unwrap_or(u8::MAX)]);
            out.extend_from_slice(text.as_bytes());
            count += 1;
        }
        if let Some([more, next_id, objects]) = out.get_mut(start + 4..start + HEADER) {
            *more = if next.is_some() { 0xFF } else { 0 };
            *next_id = next.unwrap_or(0);
            *objects = count;
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn identification(texts: &[(u8, usize)]) -> Identification {
        Identification { objects: texts.iter().map(|(id, length)| (*id, "x".repeat(*length))).collect() }
    }

    /// Object ids of an answer, and the id to go on with.
    fn ids(identification: &Identification, access: Access, object: u8) -> (Vec<u8>, Option<u8>) {
        let mut out = Vec::new();
        identification.answer(access, object, &mut out).unwrap();
        assert!(out.len() <= LONGEST);
        assert_eq!(out[..4], [0x2B, 0x0E, access.code(), 0x83]);
        let mut rest = &out[HEADER..];
        let mut ids = Vec::new();
        while let [id, length, more @ ..] = rest {
            ids.push(*id);
            rest = &more[usize::from(*length)..];
        }
        assert_eq!(usize::from(out[6]), ids.len());
        (ids, (out[4] == 0xFF).then_some(out[5]))
    }

    #[test]
    fn each_category_takes_in_the_one_below() {
        let all = identification(&[(0, 5), (1, 5), (2, 5), (4, 5), (6, 5), (0x80, 5)]);
        assert_eq!(ids(&all, Access::Basic, 0), (vec![0, 1, 2], None));
        assert_eq!(ids(&all, Access::Regular, 0), (vec![0, 1, 2, 4, 6], None));
        assert_eq!(ids(&all, Access::Extended, 0), (vec![0, 1, 2, 4, 6, 0x80], None));
        assert_eq!(ids(&all, Access::Extended, 4), (vec![4, 6, 0x80], None));
        assert_eq!(ids(&all, Access::Individual, 6), (vec![6], None));
    }

    #[test]
    fn a_stream_from_an_unknown_object_begins_at_the_first() {
        let all = identification(&[(0, 5), (1, 5), (2, 5), (0x80, 5)]);
        assert_eq!(ids(&all, Access::Extended, 0x55), (vec![0, 1, 2, 0x80], None));
        assert_eq!(ids(&all, Access::Basic, 0x80), (vec![0, 1, 2], None));
        let mut out = Vec::new();
        assert_eq!(all.answer(Access::Individual, 0x55, &mut out), Err(ExceptionCode::IllegalDataAddress));
        assert!(out.is_empty());
    }

    #[test]
    fn what_does_not_fit_follows() {
        let all = identification(&[(0, 100), (1, 100), (2, 100), (4, LONGEST_TEXT)]);
        assert_eq!(ids(&all, Access::Extended, 0), (vec![0, 1], Some(2)));
        assert_eq!(ids(&all, Access::Extended, 2), (vec![2], Some(4)));
        assert_eq!(ids(&all, Access::Extended, 4), (vec![4], None));
    }

    #[test]
    fn a_long_text_is_cut_between_characters() {
        let cut = Identification::new([(0, "ä".repeat(200))]);
        assert_eq!(cut.objects[0].1.len(), LONGEST_TEXT - LONGEST_TEXT % 2);
    }
}
