//! Tests of the network as a whole.
//!
//! - `bench`: frames in candump notation in, lines of text out.
//! - `worked_examples`: guarding and boot-up, step by step.
//! - `boot`: a node that is configured before it is started.
//! - `broadcasts`: SYNC and TIME. `supply`: RPDOs.
//! - `duties`: starting, orders, TPDOs, heartbeat.
//! - `surroundings`: other masters, strangers, the passive role, a bus that fails.
//! - `duplicates`: two devices with one node id.
//! - `properties`: random input; a day of quiet guarding.

mod bench;
mod boot;
mod boot_plant;
mod broadcasts;
mod duplicates;
mod duties;
mod properties;
mod supply;
mod surroundings;
mod worked_examples;
