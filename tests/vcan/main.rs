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
//! | `link` | a network that loses every packet for a while |
//! | `outage` | sixteen engines, a broker that is away for long, a gateway that is killed again and again |
//! | `socket` | the bus room alone: link states, lost frames, full queues, receive times |
//! | `many` | two devices, two clients, a second master |
//! | `commissioning` | scan, init, nmt, sdo: what they send, and that a scan sends nothing |
//! | `transmitter` | a DST P92C from its box to its values: clash, LSS, configuration, EMCY, loss, no needless write |
//! | `secure` | Modbus/TCP Security with pymodbus, by certificates made as docs/security.md says |
//! | `serial` | the lines of a CAN-CBM-SIO4: data each way on all, by TCP, pty and MQTT; resets, watchdog, suspend, a dead bus |
//! | `foreign` | python-canopen as a device known by its EDS alone, as judge of SDO transfers, as a second client |
//! | `sparkplug` | a foreign host (pysparkplug) decodes and judges every message: births, deaths, rebirth, sequence, history |
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
mod link;
mod many;
mod namespace;
mod outage;
mod pulse;
mod secure;
mod serial;
mod silence;
mod socket;
mod sparkplug;
mod start;
mod transmitter;
