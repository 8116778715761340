//! Tests of the simulated DST P92C, in numbers-time, in candump notation.

mod bench;
mod guide;
mod lss;
mod objects;
mod scenarios;
mod slave;
mod transmission;
mod values;
