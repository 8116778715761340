//! Raw bits to values, values to registers' numbers.

use super::table::{Field, Scale};
use crate::process_image::Value;

/// The raw value of a field; `None` where the data is too short for it.
#[must_use]
pub fn decode(_field: &Field, _data: &[u8]) -> Option<Value> {
    None
}

/// The value in engineering units. A bool stays a bool and an unscaled number stays as it is.
#[must_use]
pub fn scale(_scale: &Scale, raw: Value) -> Value {
    raw
}
