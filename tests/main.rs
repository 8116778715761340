//! The tests that see more than one room. One binary, one table of contents.
//!
//! | file | what is proved |
//! |---|---|
//! | `architecture` | which room may import which; file sizes; what the pure rooms must not touch |
//! | `canary` | secrets with marks in them, right and wrong: found in no log, message, page, topic or file |
//! | `commands` | who may ask for what, what is told of it, what reaches the bus |
//! | `refusals` | whoever asks without a right, at every door: no frame, and all of it in the audit |
//! | `conversations` | the gateway core against scripted frames, in candump notation |
//! | `devices` | the gateway core against our simulators, with loss, delay and duplicates |
//! | `neighbours` | the gateway beside a second device of the same node id, and beside healthy ones |
//! | `emergencies` | errors that devices tell of: alarms, tags, what is read at the start, storms |
//! | `disturbance` | SDO under loss, duplication and delay costs the other nodes nothing; prints the worst delays |
//! | `eds` | EDS and DCF files of any quality become mappings; an import moves nothing that it gave away |
//! | `clashes` | identifiers that two participants of a bus would send |
//! | `mappings` | every shipped mapping checks; every message about a wrong one says what, where and how to mend it |
//! | `mistakes` | keys of mappings and configurations that contradict each other or have no effect |
//! | `contract` | golden files: register map, topics, payloads. Never edited to pass |
//! | `allowed_frames` | what may be sent on CAN: the list, and that nothing else can leave |
//! | `exchange` | the gateway core goes on with another configuration: what stays, what begins anew |
//! | `object_writes` | tags that are objects: the key of the mapping, writes within their limits, by HTTP the whole way |
//! | `reload` | another configuration is taken in while everything runs; a bad one changes nothing |
//! | `reload_buses` | buses that come and go with a reload |
//! | `mutations` | configuration and mapping files with random damage: every error has its place, nothing is taken in part |
//! | `outputs` | RPDOs: who may be sent what; what a write needs; SYNC operation of a transmitter |
//! | `plc331`, `plc331_master`, `plc331_page` | what replaces an esd CAN-CBM-PLC/331: its configuration, what it does on the bus, and the page on it |
//! | `modbus_server` | the Modbus TCP server over loopback sockets |
//! | `modbus_security` | Modbus/TCP Security: certificates, roles, and openssl as a foreign client |
//! | `contract_mqtt` | golden files: topics and payloads. Never edited to pass |
//! | `mqtt_exchange` | another configuration while a session with the broker lasts |
//! | `mqtt_publisher` | what is published when |
//! | `home_assistant` | what Home Assistant is told: golden file, what a former run left, a real broker |
//! | `sparkplug` | what the edge node of Sparkplug B says when |
//! | `mqtt_5` | what MQTT 5 adds: reasons, limits of the broker, properties, expiry, answers where they are asked for |
//! | `mqtt_client` | the MQTT client against good, slow and hostile brokers |
//! | `mqtt_store` | what is on disk for the broker: long outages, kills, full and broken disks |
//! | `mqtt_tls` | MQTT over TLS against mosquitto: what is refused and why, certificates that are exchanged |
//! | `web_commands` | commands by HTTP: tokens, refusals, limits |
//! | `web_login` | logging in to the page: passwords, sessions, guesses, requests from elsewhere, who may read |
//! | `web_server` | health, metrics, page |
//! | `web_tls` | the page over TLS: certificates, their exchange, wrong clients, curl |
//! | `serial_lines` | serial lines as TCP ports over loopback sockets: readers, the writer, limits |
//! | `serial_mqtt` | serial lines by MQTT: messages, command topics, a broker that is away |
//! | `serial_registers` | the last message of a serial line in registers; the map |
//! | `lifecycle` | the program as a process: start, stop, exit codes |
//! | `kills` | the program killed with signal 9, judged by a foreign broker and a checker of its own |
//! | `disks` | the program on a disk that fills up, turns read-only, or is slow |
//! | `objects` | objects of nodes through the gateway: by CiA 309-3 and by FC 43/13, against the simulated transmitter |
//! | `properties` | random input: no panic, no torn value |
//! | `documents` | the documents against the program: alarms, keys, commands, names of tests |
//! | `security_page` | the commands of docs/security.md, run as they stand: broker, gateway and PLC meet |
//! | `tls` | certificates in files, handshakes, what is said of those that fail |
//! | `transmitter` | the gateway with the shipped mapping of the DST P92C against the simulated one |
//! | `transmitter_frames` | the worked frames of that device, decoded |
//! | `transmitter_rules` | what the gateway does with it, requirement by requirement |
//! | `serial_bus` | an esd module, a DetCon and a gateway on one bus: its lines, resets, suspend, a dead bus |
//! | `serial_modules` | esd modules in the configuration: keys, refusals, clashes of identifiers |
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
mod allowed_frames;
mod architecture;
mod canary;
mod clashes;
mod commands;
mod commissioned;
mod contract;
mod contract_mqtt;
mod conversations;
mod devices;
mod disks;
mod disturbance;
mod documents;
mod eds;
mod emergencies;
mod exchange;
mod home_assistant;
mod kills;
mod lifecycle;
mod mappings;
mod mistakes;
mod modbus_security;
mod modbus_server;
mod mqtt_5;
mod mqtt_client;
mod mqtt_exchange;
mod mqtt_publisher;
mod mqtt_store;
mod mqtt_tls;
mod mutations;
mod neighbours;
mod object_writes;
mod objects;
mod outputs;
mod plc331;
mod plc331_master;
mod plc331_page;
mod properties;
mod refusals;
mod reload;
mod reload_buses;
mod requirements;
mod security_page;
mod serial_bus;
mod serial_lines;
mod serial_modules;
mod serial_mqtt;
mod serial_registers;
mod sparkplug;
mod support;
mod tls;
mod transmitter;
mod transmitter_frames;
mod transmitter_rules;
mod units;
mod web_commands;
mod web_login;
mod web_server;
mod web_tls;
