//! # cangate: a CANopen gateway to Modbus TCP and MQTT
//!
//! **This page is the map of the code.**
//!
//! ```text
//! CAN bus                                                             plant network
//!    |  frames                                                              ^
//!    v                                                                      |
//! can/task ---BusEvent---> gateway/task ---- process image ---> modbus/server   (reads on demand)
//! (owns socket)            (owns Gateway)    (one writer,  ---> mqtt/client     (changes + journal)
//!    ^                           |            many readers)---> web/server      (snapshot, metrics)
//!    |                           |                              ---> cia309/server   (objects, by commands)
//!    |                           |                              ---> serial/server   (bytes of serial lines, both ways)
//!    +------ frames to send -----+ <-------- Command + reply ---------------+
//! ```
//!
//! ## Rooms, in reading order
//!
//! | room | what it knows | may import |
//! |---|---|---|
//! | [`time`] | the clock | nothing |
//! | [`can`] | frames, buses | time |
//! | [`canopen`] | the CANopen master, pure | `can::frame`, time |
//! | [`esd`] | the manager of esd's serial modules, pure | `can::frame`, time |
//! | [`process_image`] | values, quality, status, journal | time, the words `canopen::NmtState` and `canopen::emcy` |
//! | [`mapping`] | what bytes mean; the tag table | `process_image`, canopen ids and settings, `can::BusIndex`, bit rates, `slots::AllowList` |
//! | [`alarms`] | the alarm list, pure | `process_image`, time |
//! | [`access`] | who may ask for what, pure | `process_image`, mapping, `slots::Network` |
//! | [`gateway`] | joins the above, pure but for its task | can, canopen, `process_image`, mapping, alarms, access, time |
//! | [`base64`] | bytes as text, pure | nothing |
//! | [`store`] | records on disk that outlive the process, pure but for its files | time |
//! | [`slots`] | the places for clients of TCP servers: who gets in, who must go, each served by a task of its own | time |
//! | [`tls`] | certificates and keys in files, handshakes, why one fails | time |
//! | [`modbus`], [`mqtt`], [`web`] | the process image as registers, topics, pages | `process_image`, mapping, `gateway::command`, slots, base64, store, tls, time |
//! | [`cia309`] | the CANopen networks as lines of text (CiA 309-3) | as those, objects and their types of canopen |
//! | [`serial`] | serial lines of esd modules as TCP ports | as those |
//! | [`simulator`] | pretend devices | can, canopen ids and NMT, time |
//! | [`config`] | the installation's settings | each room's settings types |
//! | [`supervisor`] | wires and watches the tasks | every room |
//! | [`cli`] | one file for each subcommand | every room |
//!
//! `tests/architecture.rs` holds this table against the code.
//!
//! ## Invariants
//!
//! 1. Only `time.rs` reads a clock.
//! 2. Only files whose first line says \[IO\] touch sockets, files or tokio (and `process_image/handles.rs`, `time.rs`).
//! 3. Only `gateway/task.rs` holds the [`process_image::ImageWriter`].
//! 4. Views (modbus, mqtt, web, cia309, serial) do not know each other.
//! 5. Every queue has a bound and says what happens when it is full.
//! 6. No value without quality and time.
//! 7. Nothing from a network can panic the process.
//! 8. Of the gateway, only `canopen` and `esd` build frames, and only frames of the kinds that the configuration allows leave:
//!    NMT commands, guard requests and SDO requests to its nodes; SYNC, TIME, RPDOs and the gateway's own heartbeat only where
//!    it asks for them; commands to its esd modules and data for their lines; in the passive role none. The list is
//!    [`gateway::allowed_frames`], and each frame is held against it on its one way out. (The simulator, which is a device,
//!    builds its own.)
//!
//! ## The seam
//!
//! Everything that lives in time has the same four verbs: `handle_*` takes what came in, `handle_timeout` what became
//! due, `poll_output` gives what is to be done, `poll_timeout` when to come back. One input, then drain, then wait.
//!
//! ## Where a change goes
//!
//! | to add | touch |
//! |---|---|
//! | a device | one file in `mappings/`; no Rust, but for the line in `mapping/shipped.rs` that builds it in |
//! | a data type or scaling rule | `mapping/codec.rs`, `mapping/build/fields.rs` |
//! | a derived tag | `mapping/table/derived.rs` ([`mapping::Derived`]), `mapping/file/tags.rs`, `mapping/build/derived.rs`, `gateway/derived.rs`, `modbus/source.rs` |
//! | an alarm that needs the gateway's own eyes | [`mapping::BuiltIn`], `mapping/builtin.rs`, `gateway/conditions.rs` |
//! | a simulated device | a folder in `simulator/`, a variant in `simulator/kind.rs` and in `cli/args.rs` |
//! | a northbound | a new room; one field in `config`; one spawn in `supervisor` |

pub mod access;
pub mod alarms;
pub mod base64;
pub mod can;
pub mod canopen;
pub mod cia309;
pub mod cli;
pub mod config;
pub mod esd;
pub mod gateway;
pub mod mapping;
pub mod modbus;
pub mod mqtt;
pub mod process_image;
pub mod serial;
pub mod simulator;
pub mod slots;
pub mod store;
pub mod supervisor;
pub mod telemetry;
pub mod time;
pub mod tls;
pub mod web;
