//! The tests that see more than one room. One binary, one table of contents.
//!
//! | file | what is proved |
//! |---|---|
//! | `architecture` | which room may import which; file sizes; what the pure rooms must not touch |
//! | `conversations` | the gateway core against scripted frames, in candump notation |
//! | `devices` | the gateway core against our simulators, with loss, delay and duplicates |
//! | `neighbours` | the gateway beside a second device of the same node id, and beside healthy ones |
//! | `emergencies` | errors that devices tell of: alarms, tags, what is read at the start, storms |
//! | `disturbance` | SDO under loss, duplication and delay costs the other nodes nothing; prints the worst delays |
//! | `eds` | EDS and DCF files of any quality become mappings; an import moves nothing that it gave away |
//! | `clashes` | identifiers that two participants of a bus would send |
//! | `mappings` | every shipped mapping checks; every message about a wrong one says what, where and how to mend it |
//! | `contract` | golden files: register map, topics, payloads. Never edited to pass |
//! | `outputs` | RPDOs: who may be sent what; what a write needs; SYNC operation of a transmitter |
//! | `modbus_server` | the Modbus TCP server over loopback sockets |
//! | `contract_mqtt` | golden files: topics and payloads. Never edited to pass |
//! | `mqtt_publisher` | what is published when |
//! | `mqtt_client` | the MQTT client against good, slow and hostile brokers |
//! | `web_server` | health, metrics, page |
//! | `lifecycle` | the program as a process: start, stop, exit codes |
//! | `objects` | objects of nodes through the gateway: by CiA 309-3 and by FC 43/13, against the simulated transmitter |
//! | `properties` | random input: no panic, no torn value |
//! | `documents` | the documents against the program: alarms, keys, commands, names of tests |
//! | `transmitter` | the gateway with the shipped mapping of the DST P92C against the simulated one |
//! | `transmitter_frames` | the worked frames of that device, decoded |
//! | `transmitter_rules` | what the gateway does with it, requirement by requirement |
//! | `requirements` | every requirement has a test whose name cites it, or a reason |
//!
//! Tests on a real CAN bus are in `tests/vcan`, those of the container in `tests/container`.

#![allow(
    clippy::allow_attributes,
    clippy::as_conversions,
    clippy::doc_markdown,
    clippy::expect_used,
    clippy::float_cmp,
    clippy::indexing_slicing,
    clippy::panic,
    clippy::print_stderr,
    clippy::print_stdout,
    clippy::too_many_lines,
    clippy::unwrap_used,
    clippy::wildcard_enum_match_arm,
    dead_code,
    reason = "a test may fail loudly; helpers in `support` are not used by every test"
)]

mod adopt;
mod architecture;
mod clashes;
mod commissioned;
mod contract;
mod contract_mqtt;
mod conversations;
mod devices;
mod disturbance;
mod documents;
mod eds;
mod emergencies;
mod lifecycle;
mod mappings;
mod modbus_server;
mod mqtt_client;
mod mqtt_publisher;
mod neighbours;
mod objects;
mod outputs;
mod properties;
mod requirements;
mod support;
mod transmitter;
mod transmitter_frames;
mod transmitter_rules;
mod units;
mod web_server;
