//! The program as its own process on a real CAN interface, with foreign programs around it. Run by `tests/all vcan`.
//!
//! | file | what is proved |
//! |---|---|
//! | `harness` | (processes, bus, broker, clients, a played device) |
//! | `harness_itself` | the harness measures what it says: without this no other result counts |
//! | `start` | cold start before and after the device, power cycle, probe at start-up |
//! | `examples` | the worked examples V-DET-01..19, sent by cansend, read over Modbus and MQTT |
//! | `guarding` | lost and found again, toggle bit, restart in the middle of operation |
//! | `pulse` | a 100 ms trip that a slow client sees |
//! | `silence` | which frames the gateway ever sends, also when it is stopped or killed; the passive role |
//! | `faults` | interface down, deleted, bus-off; a full bus |
//! | `broker` | a broker that is killed again and again |
//! | `socket` | the bus room alone: link states, lost frames, full queues, receive times |
//! | `many` | two devices, two clients, a second master |
//! | `commissioning` | scan, init, nmt, sdo: what they send, and that a scan sends nothing |
//! | `transmitter` | a DST P92C from its box to its values: clash, LSS, configuration, EMCY, loss, no needless write |
//! | `foreign` | python-canopen as a device known by its EDS alone, as judge of SDO transfers, as a second client |
//! | `namespace` | a gateway that reaches the bus from a network namespace of its own, as in a container |
//!
//! vcan0 is there once, so the tests run one after another; each begins with a new interface.

#![allow(
    clippy::allow_attributes,
    clippy::as_conversions,
    clippy::cast_possible_truncation,
    clippy::disallowed_methods,
    clippy::doc_markdown,
    clippy::expect_used,
    clippy::indexing_slicing,
    clippy::panic,
    clippy::print_stderr,
    clippy::print_stdout,
    clippy::redundant_closure_for_method_calls,
    clippy::too_many_lines,
    clippy::unwrap_used,
    clippy::wildcard_enum_match_arm,
    dead_code,
    missing_docs,
    reason = "a test may fail loudly; helpers are not used by every test"
)]

mod broker;
mod commissioning;
mod examples;
mod faults;
mod foreign;
mod guarding;
mod harness;
mod harness_itself;
mod many;
mod namespace;
mod pulse;
mod silence;
mod socket;
mod start;
mod transmitter;
