//! Tests of the SDO client: its rules one by one, and against a server on a bus that loses, repeats and delays frames.

mod faults;
mod rules;
mod server;

use super::{SdoAction, SdoClient, SdoError, SdoOutput, SdoRequest, SdoSettings, TransferId};
