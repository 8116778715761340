//! Conditions on tags: `knock_intensity_7 > immediate_stop_limit and sensor_used_7`.
//!
//! `or` binds weakest, then `and`, then `not`, then one comparison (`<  <=  >  >=  ==  !=`) of tags and numbers;
//! parentheses group. A bool tag alone is a condition. There is no arithmetic: that is what derived tags are for.

use crate::process_image::{Quality, TagIndex, Value};

/// A checked condition; its tags are resolved.
#[derive(Clone, Debug, PartialEq)]
pub enum Expression {
    /// All of them.
    And(Vec<Expression>),
    /// Any of them.
    Or(Vec<Expression>),
    /// Its opposite.
    Not(Box<Expression>),
    /// A bool tag is true, a number is not zero.
    Tag(TagIndex),
    /// Two values compared.
    Compare {
        /// Left side.
        left: Operand,
        /// How.
        comparison: Comparison,
        /// Right side.
        right: Operand,
    },
}

/// A side of a comparison.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Operand {
    /// A tag's value in engineering units.
    Tag(TagIndex),
    /// A number.
    Number(f64),
}

/// How two values are compared.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Comparison {
    /// `<`
    Less,
    /// `<=`
    LessOrEqual,
    /// `>`
    Greater,
    /// `>=`
    GreaterOrEqual,
    /// `==`
    Equal,
    /// `!=`
    NotEqual,
}

impl Expression {
    /// Whether the condition holds, and the worst quality of the tags that it looks at (all of them, so that the
    /// quality does not depend on short cuts). A comparison with NaN does not hold.
    pub fn evaluate(&self, tag: &impl Fn(TagIndex) -> (Value, Quality)) -> (bool, Quality) {
        match self {
            Self::And(parts) => parts.iter().fold((true, Quality::Good), |(holds, quality), part| {
                let (part_holds, part_quality) = part.evaluate(tag);
                (holds && part_holds, quality.worst(part_quality))
            }),
            Self::Or(parts) => parts.iter().fold((false, Quality::Good), |(holds, quality), part| {
                let (part_holds, part_quality) = part.evaluate(tag);
                (holds || part_holds, quality.worst(part_quality))
            }),
            Self::Not(part) => {
                let (holds, quality) = part.evaluate(tag);
                (!holds, quality)
            }
            Self::Tag(index) => {
                let (value, quality) = tag(*index);
                (value.is_true(), quality)
            }
            Self::Compare { left, comparison, right } => {
                let (left, left_quality) = left.evaluate(tag);
                let (right, right_quality) = right.evaluate(tag);
                (comparison.holds(left, right), left_quality.worst(right_quality))
            }
        }
    }

    /// The tags that it looks at.
    pub fn for_each_tag(&self, visit: &mut impl FnMut(TagIndex)) {
        match self {
            Self::And(parts) | Self::Or(parts) => parts.iter().for_each(|part| part.for_each_tag(visit)),
            Self::Not(part) => part.for_each_tag(visit),
            Self::Tag(index) => visit(*index),
            Self::Compare { left, right, .. } => {
                for side in [left, right] {
                    if let Operand::Tag(index) = side {
                        visit(*index);
                    }
                }
            }
        }
    }
}

impl Expression {
    /// The same, to change which tags they are.
    pub fn for_each_tag_mut(&mut self, visit: &mut impl FnMut(&mut TagIndex)) {
        match self {
            Self::And(parts) | Self::Or(parts) => {
                for part in parts {
                    part.for_each_tag_mut(visit);
                }
            }
            Self::Not(part) => part.for_each_tag_mut(visit),
            Self::Tag(index) => visit(index),
            Self::Compare { left, right, .. } => {
                for side in [left, right] {
                    if let Operand::Tag(index) = side {
                        visit(index);
                    }
                }
            }
        }
    }
}

impl Operand {
    fn evaluate(self, tag: &impl Fn(TagIndex) -> (Value, Quality)) -> (f64, Quality) {
        match self {
            Self::Tag(index) => {
                let (value, quality) = tag(index);
                (value.as_f64(), quality)
            }
            Self::Number(number) => (number, Quality::Good),
        }
    }
}

impl Comparison {
    /// Whether it holds of two numbers; with NaN it never does.
    #[must_use]
    #[expect(clippy::float_cmp, reason = "`==` in a mapping means equal, as its manual says")]
    pub fn holds(self, left: f64, right: f64) -> bool {
        match self {
            Self::Less => left < right,
            Self::LessOrEqual => left <= right,
            Self::Greater => left > right,
            Self::GreaterOrEqual => left >= right,
            Self::Equal => left == right,
            Self::NotEqual => left != right && !left.is_nan() && !right.is_nan(),
        }
    }
}
