//! Which mapping fits a node, by its frames and by what it says of itself. Pure.
//!
//! A device is recognised by what its mapping says of it, never by a rule in the program. A node that told its identity is
//! what it says. Of others the identifiers and lengths of their TPDOs are compared, and how their life is watched: devices
//! without an identity object can be told apart only so, therefore such an answer is a proposal.

use std::cmp::Reverse;
use std::collections::{BTreeMap, BTreeSet};
use std::time::Duration;

use super::{DeviceDef, Sketch, SourceText};
use crate::can::CanId;
use crate::canopen::boot::BootStep;
use crate::canopen::object::ObjectId;
use crate::canopen::{ErrorControl, NodeId, NodeSettings, PdoSettings};

/// Vendor id.
const VENDOR: ObjectId = ObjectId::new(0x1018, 1);

/// What was seen of a node.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Sighting {
    /// Its id.
    pub node: NodeId,
    /// Identifiers of TPDOs that were seen, with all lengths that they had.
    pub tpdos: BTreeMap<CanId, BTreeSet<u8>>,
    /// How long TPDOs of it were listened to: from the first to the last.
    pub listened: Duration,
    /// Whether it told its state by itself (`true`) or when it was asked; `None`: neither was seen.
    pub heartbeat: Option<bool>,
    /// Its device name, object 0x1008, where it was read.
    pub name: Option<String>,
    /// What was read of its device type 0x1000 and its identity 0x1018.
    pub identity: BTreeMap<ObjectId, u32>,
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
    /// The node says so itself: all that the mapping knows of its identity was read and is as it should be, its vendor and
    /// something else among it, and its name is no other model's. What its frames look like does not count then: a device
    /// that is still as it was shipped sends others.
    Certain,
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
    /// Its frames are what this device sends. Where it is not, but another candidate's are, there are two devices.
    pub sends: bool,
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
    let named = sighting.name.as_ref().map(|name| names(name, &node.device.model));
    let canopen = node.protocol.canopen()?;
    let by_frames = fit(sighting, canopen, &node.device, named == Some(true));
    let fit = match identity(&sighting.identity, canopen) {
        Some(false) => return None,
        Some(true) if named != Some(false) => Some(Fit::Certain),
        Some(true) => Some(Fit::Probable),
        None => by_frames,
    };
    Some(Candidate { mapping: name.to_owned(), device: node.device, fit: fit?, sends: by_frames.is_some() })
}

/// Whether the node is by its identity the device that a mapping is for; `None`: that cannot be said.
fn identity(read: &BTreeMap<ObjectId, u32>, settings: &NodeSettings) -> Option<bool> {
    let expected = settings.boot.steps.iter().filter_map(|step| {
        if let BootStep::Identity { object, expected, .. } = step { Some((*object, *expected)) } else { None }
    });
    let expected: Vec<(ObjectId, u32)> = expected.collect();
    if expected.iter().any(|(object, value)| read.get(object).is_some_and(|told| told != value)) {
        return Some(false);
    }
    let all = expected.iter().all(|(object, _)| read.contains_key(object));
    let vendor = expected.iter().any(|(object, _)| *object == VENDOR);
    (all && vendor && expected.len() > 1).then_some(true)
}

/// Whether a device name holds the model: `DST P92C CANopen` holds `DST P92C`.
fn names(name: &str, model: &str) -> bool {
    !model.is_empty() && name.to_lowercase().contains(&model.to_lowercase())
}

fn fit(sighting: &Sighting, settings: &NodeSettings, device: &DeviceDef, named: bool) -> Option<Fit> {
    let watched_otherwise = match (&settings.error_control, sighting.heartbeat) {
        (ErrorControl::Guarding(_), Some(heartbeat)) => heartbeat,
        // Every device answers a guard request or does not; one that was asked and answered may well send heartbeats when
        // it is told to.
        (ErrorControl::Heartbeat { .. } | ErrorControl::None, _) | (_, None) => false,
    };
    let strange = sighting.tpdos.iter().any(|(id, lengths)| {
        let known = settings.pdos.iter().find(|pdo| pdo.cob_id == *id);
        !known.is_some_and(|pdo| fits(lengths, pdo, device))
    });
    // Others come only when something happens.
    let regular = settings.pdos.iter().filter_map(|pdo| Some((pdo.cob_id, pdo.timeout?)));
    let missing: Vec<Duration> =
        regular.filter(|(id, _)| !sighting.tpdos.contains_key(id)).map(|(_, timeout)| timeout).collect();
    let overdue = missing.iter().any(|timeout| *timeout <= sighting.listened);
    if watched_otherwise || strange || overdue {
        return None;
    }
    let complete = missing.is_empty();
    match (sighting.tpdos.len(), complete) {
        _ if named => Some(Fit::Probable),
        (0, _) => None,
        (1, _) | (_, false) => Some(Fit::Possible),
        (_, true) => Some(Fit::Probable),
    }
}

/// Whether frames of these lengths can be that TPDO: longer ones are padded, and a device that the gateway has not set up
/// yet may send another content; but not both by turns.
fn fits(seen: &BTreeSet<u8>, pdo: &PdoSettings, device: &DeviceDef) -> bool {
    let as_mapped = |length: &u8| *length == pdo.length || *length > pdo.length && !pdo.strict_length;
    let as_shipped = |length: &u8| device.shipped_lengths.get(&pdo.number) == Some(length);
    seen.iter().all(as_mapped) || seen.iter().all(as_shipped)
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
        Sighting {
            node: NodeId::new(node).unwrap(),
            tpdos: tpdos.collect(),
            listened: Duration::ZERO,
            heartbeat: None,
            name: None,
            identity: BTreeMap::new(),
        }
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

    const DST: [(ObjectId, u32); 2] =
        [(ObjectId::new(0x1000, 0), 0x0002_0194), (ObjectId::new(0x1018, 1), 0x23D)];

    fn shipped(sighting: &Sighting) -> Vec<(String, Fit)> {
        candidates(sighting, SHIPPED).into_iter().map(|found| (found.mapping, found.fit)).collect()
    }

    #[test]
    fn r_dst_001_a_node_that_told_its_identity_is_what_it_says_whatever_it_sends() {
        let sent: [&[(u16, &[u8])]; 4] =
            [&[], &[(0x181, &[5])], &[(0x181, &[8])], &[(0x181, &[5, 8]), (0x281, &[8])]];
        for tpdos in sent {
            let told = Sighting { identity: DST.into(), ..sighting(1, tpdos) };
            assert_eq!(shipped(&told)[0], ("danfoss-dst-p92c".to_owned(), Fit::Certain), "{tpdos:?}");
        }
        let named =
            Sighting { name: Some("DST P92C CANopen".to_owned()), identity: DST.into(), ..sighting(1, &[]) };
        assert_eq!(shipped(&named), one("danfoss-dst-p92c", Fit::Certain));
        let sister = Sighting { name: Some("DST P110".to_owned()), ..named };
        assert_eq!(shipped(&sister), one("danfoss-dst-p92c", Fit::Probable));
    }

    #[test]
    fn r_dst_001_a_node_that_says_to_be_another_is_no_dst_and_a_part_of_an_identity_proves_nothing() {
        let other = Sighting { identity: [DST[0], (VENDOR, 0x23E)].into(), ..sighting(1, &[(0x181, &[5])]) };
        assert_eq!(shipped(&other), []);
        let part = Sighting { identity: [DST[1]].into(), ..sighting(1, &[]) };
        assert_eq!(shipped(&part), []);
    }

    #[test]
    fn a_transmitter_as_shipped_or_set_up_is_perhaps_one_and_with_other_lengths_none() {
        let perhaps = one("danfoss-dst-p92c", Fit::Possible);
        let heard = |length: u8| Sighting {
            listened: Duration::from_secs(5),
            heartbeat: Some(true),
            ..sighting(5, &[(0x185, &[length])])
        };
        assert_eq!((shipped(&heard(5)), shipped(&heard(8))), (perhaps.clone(), perhaps));
        assert_eq!(shipped(&heard(3)), []);
    }

    #[test]
    fn a_device_whose_other_tpdos_never_came_in_all_that_time_is_another_device() {
        let alone = |listened| Sighting { listened, ..sighting(3, &DETCON[..1]) };
        let is_detcon =
            |sighting: &Sighting| found(sighting).iter().any(|(name, _)| name == "motortech-detcon");
        assert!(is_detcon(&alone(Duration::from_millis(1400))));
        assert!(!is_detcon(&alone(Duration::from_secs(5))));
    }

    #[test]
    fn a_device_that_says_to_be_one_and_sends_like_another_is_two() {
        let both = Sighting {
            identity: DST.into(),
            ..sighting(1, &[(0x181, &[8]), (0x281, &[8]), (0x381, &[8]), (0x481, &[6])])
        };
        let found: Vec<_> = candidates(&both, SHIPPED)
            .into_iter()
            .map(|found| (found.mapping, found.fit, found.sends))
            .collect();
        assert_eq!(
            found,
            [
                ("danfoss-dst-p92c".to_owned(), Fit::Certain, false),
                ("motortech-detcon".to_owned(), Fit::Probable, true)
            ]
        );
    }
}
