//! Computed tags.

use std::time::Duration;

use super::super::expression::Expression;
use crate::process_image::TagIndex;

/// A value computed from other tags of the same node. `among` lists name the candidates in order; `valid`, where given,
/// is a bool tag for each of them: a candidate whose tag is not true is left out.
#[derive(Clone, Debug, PartialEq)]
pub enum Derived {
    /// One bit of an unsigned tag.
    Bit {
        /// The tag.
        of: TagIndex,
        /// 0 = lowest.
        bit: u8,
    },
    /// Bool tags as the bits of a number, the first lowest.
    Pack {
        /// The tags.
        of: Vec<TagIndex>,
    },
    /// A condition.
    Logic {
        /// It.
        when: Expression,
    },
    /// The highest value.
    Maximum {
        /// Candidates.
        among: Vec<TagIndex>,
        /// Their validity.
        valid: Option<Vec<TagIndex>>,
    },
    /// Which candidate is highest: its number; that of the first among equals.
    ArgMaximum {
        /// Candidates.
        among: Vec<TagIndex>,
        /// Their validity.
        valid: Option<Vec<TagIndex>>,
        /// Their numbers, one for each.
        numbers: Vec<u16>,
    },
    /// The smallest distance up to a limit, `limit - value`; negative above it.
    Margin {
        /// Candidates.
        among: Vec<TagIndex>,
        /// Their validity.
        valid: Option<Vec<TagIndex>>,
        /// The limit.
        limit: TagIndex,
    },
    /// How many bool tags are true.
    Count {
        /// Candidates.
        of: Vec<TagIndex>,
    },
    /// Rising edges of a bool tag since the start, modulo 65,536.
    RisingEdges {
        /// The bool tag.
        of: TagIndex,
    },
    /// Seconds since the last rising edge of a bool tag; 65,535 = never, or longer ago than 65,534 s.
    SecondsSinceRise {
        /// The bool tag.
        of: TagIndex,
    },
    /// A bool tag that stays true until the node's alarms are acknowledged while the source is false.
    Latch {
        /// The bool tag.
        of: TagIndex,
    },
    /// Rising edges of a bool tag within the last `window`.
    EdgesWithin {
        /// The bool tag.
        of: TagIndex,
        /// How far back.
        window: Duration,
    },
    /// A number that the installation sets for the node, good from the start.
    Constant {
        /// It.
        value: f64,
    },
}

impl Derived {
    /// The tags that it is computed from.
    pub fn for_each_input(&self, visit: &mut impl FnMut(TagIndex)) {
        match self {
            Self::Bit { of, .. }
            | Self::RisingEdges { of }
            | Self::SecondsSinceRise { of }
            | Self::Latch { of }
            | Self::EdgesWithin { of, .. } => visit(*of),
            Self::Pack { of } | Self::Count { of } => of.iter().for_each(|tag| visit(*tag)),
            Self::Logic { when } => when.for_each_tag(visit),
            Self::Maximum { among, valid } | Self::ArgMaximum { among, valid, .. } => {
                among.iter().chain(valid.iter().flatten()).for_each(|tag| visit(*tag));
            }
            Self::Margin { among, valid, limit } => {
                among.iter().chain(valid.iter().flatten()).chain([limit]).for_each(|tag| visit(*tag));
            }
            Self::Constant { .. } => {}
        }
    }

    /// The same, to change which tags they are.
    pub fn for_each_input_mut(&mut self, visit: &mut impl FnMut(&mut TagIndex)) {
        match self {
            Self::Bit { of, .. }
            | Self::RisingEdges { of }
            | Self::SecondsSinceRise { of }
            | Self::Latch { of }
            | Self::EdgesWithin { of, .. } => visit(of),
            Self::Pack { of } | Self::Count { of } => of.iter_mut().for_each(visit),
            Self::Logic { when } => when.for_each_tag_mut(visit),
            Self::Maximum { among, valid } | Self::ArgMaximum { among, valid, .. } => {
                among.iter_mut().chain(valid.iter_mut().flatten()).for_each(visit);
            }
            Self::Margin { among, valid, limit } => {
                among.iter_mut().chain(valid.iter_mut().flatten()).chain([limit]).for_each(visit);
            }
            Self::Constant { .. } => {}
        }
    }
}
