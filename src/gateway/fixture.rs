//! A small tag table for tests of this room: one bus, two nodes of the same kind.

use crate::mapping::{Sketch, SourceText, TagTable};

/// TPDO1, 2 bytes: `level` (byte 0, 0..255 = 0..100 %) and bit `trip` (byte 1 bit 0); byte 1 bit 7 is reserved.
/// TPDO2, 1 byte: `limit`. Derived: `trips`, `trip_latched`, `margin`, `trip_age`.
const SMALL: &str = r#"
format = 1
device = { vendor = "test", model = "small" }

[tpdo.1]
cob_id = "$NODEID+0x180"
length = 2
timeout_ms = 1500
reserved_bits = [[15, 1]]

[tpdo.2]
cob_id = "$NODEID+0x280"
length = 1
timeout_ms = 1500

[[tag]]
name = "level"
tpdo = 1
bit = 0
type = "u8"
scale = { multiply = 100, divide = 255 }

[[tag]]
name = "trip"
tpdo = 1
bit = 8
type = "bool"

[[tag]]
name = "limit"
tpdo = 2
bit = 0
type = "u8"
scale = { multiply = 100, divide = 255 }

[[derived]]
name = "trips"
rising_edges = "trip"

[[derived]]
name = "trip_latched"
latch = "trip"

[[derived]]
name = "margin"
margin = { of = "level", to = "limit" }

[[derived]]
name = "trip_age"
seconds_since_rise = "trip"

[[alarm]]
name = "trip"
when = "trip"
priority = "high"
text = "It trips."
action = "See why."
"#;

/// The table: `engine1` with node id 1, `engine2` with node id 2.
pub(super) fn table() -> TagTable {
    of(SMALL)
}

/// The same nodes, with a mapping of the test's own.
pub(super) fn of(mapping: &str) -> TagTable {
    let sketch = Sketch::new().mapping(SourceText::new("small", mapping));
    let sketch = sketch.node("engine1", 1, "small", |_| ()).node("engine2", 2, "small", |_| ());
    sketch.build().unwrap().0
}
