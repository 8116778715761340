//! SDO client (CiA 301, 7.2.4): reads and writes the objects of one node, expedited, in segments or in blocks.

mod abort;
mod error;
mod request;

pub use abort::AbortCode;
pub use error::{ProtocolError, SdoError};
pub use request::{
    Refused, SdoAction, SdoCounters, SdoOutput, SdoPriority, SdoRequest, SdoSettings, TransferId,
};
