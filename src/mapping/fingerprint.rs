//! Which mapping fits a node of which only frames were seen. Pure.
//!
//! A device is recognised by what its mapping says of it, never by a rule in the program: the identifiers and lengths of its
//! TPDOs, how its life is watched, and where the node told its name, the model. Devices without an identity object can be
//! told apart only so; therefore an answer is a proposal, which says on what it rests.

use std::cmp::Reverse;
use std::collections::{BTreeMap, BTreeSet};

use super::{DeviceDef, Sketch, SourceText};
use crate::can::CanId;
use crate::canopen::{ErrorControl, NodeId, NodeSettings};

/// What was seen of a node.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Sighting {
    /// Its id.
    pub node: NodeId,
    /// Identifiers of TPDOs that were seen, with all lengths that they had.
    pub tpdos: BTreeMap<CanId, BTreeSet<u8>>,
    /// Whether it told its state by itself (`true`) or when it was asked; `None`: neither was seen.
    pub heartbeat: Option<bool>,
    /// Its device name, object 0x1008, where it was read.
    pub name: Option<String>,
}

/// How well a mapping fits.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Fit {
    /// Nothing speaks against it, and something for it: some of its TPDOs, though not all that come regularly; or all, but it
    /// has only one, which many a device has as well.
    Possible,
    /// All its regular TPDOs with their lengths, no other, and there are several; or the node's name is that of the model
    /// and nothing speaks against it.
    Probable,
}

/// A mapping that fits.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Candidate {
    /// Name of the mapping.
    pub mapping: String,
    /// The device type that it describes.
    pub device: DeviceDef,
    /// How well.
    pub fit: Fit,
}

/// The mappings that fit, the best first; of equal ones in the order given. `mappings`: name and text of each.
///
/// Mappings that have problems fit nothing: `cangate check` tells of them.
#[must_use]
pub fn candidates(sighting: &Sighting, mappings: &[(&str, &str)]) -> Vec<Candidate> {
    let mut found: Vec<Candidate> =
        mappings.iter().filter_map(|(name, text)| candidate(sighting, name, text)).collect();
    found.sort_by_key(|candidate| Reverse(candidate.fit));
    found
}

fn candidate(sighting: &Sighting, name: &str, text: &str) -> Option<Candidate> {
    let sketch = Sketch::new().mapping(SourceText::new(name, text));
    let (table, _) = sketch.node("seen", sighting.node.get(), name, |_| ()).build().ok()?;
    let node = table.nodes.into_iter().next()?;
    let named = sighting.name.as_ref().is_some_and(|name| names(name, &node.device.model));
    let fit = fit(sighting, &node.canopen, named)?;
    Some(Candidate { mapping: name.to_owned(), device: node.device, fit })
}

/// Whether a device name holds the model: `DST P92C CANopen` holds `DST P92C`.
fn names(name: &str, model: &str) -> bool {
    !model.is_empty() && name.to_lowercase().contains(&model.to_lowercase())
}

fn fit(sighting: &Sighting, settings: &NodeSettings, named: bool) -> Option<Fit> {
    let watched_otherwise = match (&settings.error_control, sighting.heartbeat) {
        (ErrorControl::Guarding(_), Some(heartbeat)) => heartbeat,
        // Every device answers a guard request or does not; one that was asked and answered may well send heartbeats when
        // it is told to.
        (ErrorControl::Heartbeat { .. } | ErrorControl::None, _) | (_, None) => false,
    };
    let strange = sighting.tpdos.iter().any(|(id, lengths)| {
        let known = settings.pdos.iter().find(|pdo| pdo.cob_id == *id);
        !known.is_some_and(|pdo| lengths.iter().all(|length| fits(*length, pdo.length, pdo.strict_length)))
    });
    if watched_otherwise || strange {
        return None;
    }
    // Others come only when something happens.
    let mut regular = settings.pdos.iter().filter(|pdo| pdo.timeout.is_some());
    let complete = regular.all(|pdo| sighting.tpdos.contains_key(&pdo.cob_id));
    match (sighting.tpdos.len(), complete) {
        _ if named => Some(Fit::Probable),
        (0, _) => None,
        (1, _) | (_, false) => Some(Fit::Possible),
        (_, true) => Some(Fit::Probable),
    }
}

/// Whether a frame of this length can be that TPDO; longer ones are padded.
fn fits(seen: u8, length: u8, strict: bool) -> bool {
    seen == length || seen > length && !strict
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::mapping::shipped::SHIPPED;

    const SENSOR: &str = r#"
format = 1
[device]
vendor = "Example"
model = "P5"
description = "A transmitter with one TPDO"
[error_control]
kind = "heartbeat"
heartbeat_timeout_ms = 1500
[tpdo.1]
cob_id = "$NODEID+0x180"
length = 5
period_ms = 1000
[[tag]]
name = "pressure"
tpdo = 1
bit = 0
type = "i32"
"#;

    fn sighting(node: u8, tpdos: &[(u16, &[u8])]) -> Sighting {
        let tpdos =
            tpdos.iter().map(|(id, lengths)| (CanId::Standard(*id), lengths.iter().copied().collect()));
        Sighting { node: NodeId::new(node).unwrap(), tpdos: tpdos.collect(), heartbeat: None, name: None }
    }

    fn found(sighting: &Sighting) -> Vec<(String, Fit)> {
        let mut mappings = vec![("sensor", SENSOR)];
        mappings.extend(SHIPPED.iter().filter(|(name, _)| *name == "motortech-detcon"));
        candidates(sighting, &mappings).into_iter().map(|found| (found.mapping, found.fit)).collect()
    }

    fn one(mapping: &str, fit: Fit) -> Vec<(String, Fit)> {
        vec![(mapping.to_owned(), fit)]
    }

    const DETCON: [(u16, &[u8]); 4] = [(0x183, &[8]), (0x283, &[8]), (0x383, &[8]), (0x483, &[6])];

    #[test]
    fn the_mapping_for_tests_is_good() {
        assert_eq!(crate::mapping::check_mapping(&SourceText::new("sensor", SENSOR)).map(drop), Ok(()));
    }

    #[test]
    fn four_tpdos_with_their_lengths_are_probably_a_detcon() {
        assert_eq!(found(&sighting(3, &DETCON)), one("motortech-detcon", Fit::Probable));
        let guarded = Sighting { heartbeat: Some(false), ..sighting(3, &DETCON) };
        assert_eq!(found(&guarded), one("motortech-detcon", Fit::Probable));
    }

    #[test]
    fn padding_of_the_last_tpdo_is_no_other_device() {
        let padded = [DETCON[0], DETCON[1], DETCON[2], (0x483, &[8][..])];
        assert_eq!(found(&sighting(3, &padded)), one("motortech-detcon", Fit::Probable));
    }

    #[test]
    fn a_device_of_which_only_a_part_was_seen_is_a_possibility() {
        assert_eq!(found(&sighting(3, &DETCON[..3])), one("motortech-detcon", Fit::Possible));
    }

    #[test]
    fn one_tpdo_alone_is_never_more_than_a_possibility() {
        assert_eq!(found(&sighting(1, &[(0x181, &[5])])), one("sensor", Fit::Possible));
    }

    #[test]
    fn a_name_that_was_read_settles_it() {
        let named = Sighting { name: Some("Example p5 V2".to_owned()), ..sighting(1, &[(0x181, &[5])]) };
        assert_eq!(found(&named), one("sensor", Fit::Probable));
        let silent = Sighting { name: Some("P5".to_owned()), ..sighting(1, &[]) };
        assert_eq!(found(&silent), one("sensor", Fit::Probable));
    }

    #[test]
    fn another_length_another_tpdo_or_another_error_control_is_another_device() {
        for other in [
            sighting(3, &[DETCON[0], DETCON[1], DETCON[2], (0x483, &[5])]),
            sighting(3, &[DETCON[0], DETCON[1], DETCON[2], DETCON[3], (0x203, &[1])]),
            sighting(3, &[(0x183, &[5, 8]), DETCON[1], DETCON[2], DETCON[3]]),
            sighting(1, &DETCON),
            Sighting { heartbeat: Some(true), ..sighting(3, &DETCON) },
            sighting(3, &[]),
        ] {
            assert_eq!(found(&other), [], "{other:?}");
        }
    }
}
