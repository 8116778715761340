//! Values of esd modules as tags.

use super::*;
use crate::mapping::installation::EsdEntry;
use crate::mapping::{At, LineValue, ModuleValue, Sketch};
use crate::time::Timestamp;

const NODE: NodeIndex = NodeIndex(0);

/// A SIO1, managed or not.
fn table(managed: bool) -> TagTable {
    let esd = EsdEntry { reply_id: managed.then(|| At::nowhere(0x7A0)), ..EsdEntry::default() };
    let sketch = Sketch::new().bus(|bus| bus.esd = Some(At::nowhere(esd)));
    let (table, warnings) = sketch.node("reader", 0x1A, "esd-can-cbm-sio1", |_| ()).build().unwrap();
    assert_eq!(warnings, []);
    table
}

fn now() -> Now {
    Now { instant: Instant::from_millis(0), utc: Timestamp::from_micros(0) }
}

fn tell(tags: &mut Tags, table: &TagTable, value: ModuleCarrier, number: u64) {
    let carrier = CarrierIndex::of_module(&table.nodes[0], value).unwrap();
    tags.apply(table, now(), (NODE, carrier), &number.to_le_bytes(), Quality::Good);
}

fn value(tags: &Tags, table: &TagTable, name: &str) -> (Value, Quality) {
    let sample = &tags.samples()[table.find_tag(NODE, name).unwrap().0];
    (sample.value, sample.quality)
}

#[test]
fn r_esd_038_074_counters_and_status_of_a_module_become_tags() {
    let table = table(true);
    let mut tags = Tags::new(&table, now());
    assert_eq!(value(&tags, &table, "can_status").1, Quality::NEVER);
    tell(&mut tags, &table, ModuleCarrier::Line(0, LineValue::BytesReceived), 0x1_0000_0007);
    tell(&mut tags, &table, ModuleCarrier::Line(0, LineValue::SecondsSinceSent), 65_535);
    tell(&mut tags, &table, ModuleCarrier::Module(ModuleValue::Status), 0x83);
    let good = |value| (value, Quality::Good);
    assert_eq!(value(&tags, &table, "channel_1_bytes_received"), good(Value::Unsigned(7)), "modulo 2^32");
    assert_eq!(value(&tags, &table, "channel_1_seconds_since_sent"), good(Value::Unsigned(65_535)));
    assert_eq!(value(&tags, &table, "can_status"), good(Value::Unsigned(0x83)));
    assert_eq!(value(&tags, &table, "new_on_bus"), good(Value::Bool(true)));
    assert_eq!(value(&tags, &table, "can_error"), good(Value::Bool(false)));
}

#[test]
fn what_a_module_is_not_asked_for_spoils_nothing() {
    for managed in [false, true] {
        let table = table(managed);
        let mut tags = Tags::new(&table, now());
        assert!(!tags.all_good(NODE), "no counter has a value yet");
        for value in LineValue::ALL {
            tell(&mut tags, &table, ModuleCarrier::Line(0, value), 0);
        }
        assert_eq!(tags.all_good(NODE), !managed);
        for value in ModuleValue::ALL {
            tell(&mut tags, &table, ModuleCarrier::Module(value), 0);
        }
        assert!(tags.all_good(NODE));
    }
}
