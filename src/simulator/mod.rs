//! Pretend devices: pure state machines on the device's side of the bus, and one task that puts them on a bus.
