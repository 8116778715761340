//! What the values of a tag are, known before the first came: for readers that ask for a type at once. Pure.

use crate::mapping::{Derived, Field, FieldKind, Scale, Source, TagDef};

/// The kind of a tag's values.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Kind {
    /// True or false.
    Bool,
    /// Whole numbers from 0 up, of at most so many bits.
    Unsigned(u8),
    /// Whole numbers, of at most so many bits.
    Signed(u8),
    /// Any number.
    Real,
}

/// Bits of what counts edges and seconds, and of what numbers an argument.
const COUNTER: Kind = Kind::Unsigned(16);

impl Kind {
    /// Of a tag.
    #[must_use]
    pub fn of(tag: &TagDef) -> Self {
        match &tag.source {
            Source::Pdo { field, scale, .. }
            | Source::Polled { field, scale, .. }
            | Source::Adopted { field, scale, .. }
            | Source::Emergency { field, scale, .. }
            | Source::Rpdo { field, scale, .. }
            | Source::Module { field, scale, .. } => {
                Self::of_field(*field, *scale, tag.device_unit.is_some())
            }
            Source::Derived(derived) => Self::of_derived(derived),
        }
    }

    fn of_field(field: Field, scale: Scale, by_device: bool) -> Self {
        match field.kind {
            FieldKind::Bool => Self::Bool,
            // Digits or a unit that the device tells may scale it at any time.
            FieldKind::Unsigned if scale == Scale::IDENTITY && !by_device => Self::Unsigned(field.width),
            FieldKind::Signed if scale == Scale::IDENTITY && !by_device => Self::Signed(field.width),
            FieldKind::Unsigned | FieldKind::Signed | FieldKind::Float => Self::Real,
        }
    }

    fn of_derived(derived: &Derived) -> Self {
        match derived {
            Derived::Bit { .. } | Derived::Logic { .. } | Derived::Latch { .. } => Self::Bool,
            Derived::Pack { .. } => Self::Unsigned(64),
            Derived::ArgMaximum { .. }
            | Derived::Count { .. }
            | Derived::RisingEdges { .. }
            | Derived::SecondsSinceRise { .. } => COUNTER,
            Derived::EdgesWithin { .. } => Self::Unsigned(32),
            Derived::Maximum { .. } | Derived::Margin { .. } | Derived::Constant { .. } => Self::Real,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_an_unscaled_number_is_whole() {
        let field = |kind| Field { bit: 0, width: 16, kind, big_endian: false, invert: false };
        let tenths = Scale { divide: 10.0, ..Scale::IDENTITY };
        for (kind, scale, by_device, expected) in [
            (FieldKind::Bool, tenths, true, Kind::Bool),
            (FieldKind::Unsigned, Scale::IDENTITY, false, Kind::Unsigned(16)),
            (FieldKind::Signed, Scale::IDENTITY, false, Kind::Signed(16)),
            (FieldKind::Unsigned, tenths, false, Kind::Real),
            (FieldKind::Signed, Scale::IDENTITY, true, Kind::Real),
            (FieldKind::Float, Scale::IDENTITY, false, Kind::Real),
        ] {
            assert_eq!(Kind::of_field(field(kind), scale, by_device), expected, "{kind:?}");
        }
    }
}
