//! Tests of the simulated esd modules, in numbers-time, in candump notation.

mod bench;
mod examples;
mod identifiers;
mod init;
mod lines;
mod parameters;
mod random;
mod scenarios;
mod start;
mod status;
mod supervisor;
mod suspend;
mod to_can;
mod to_serial;
mod watchdog;
