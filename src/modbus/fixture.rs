//! What a connection of a gateway shares, for tests.

use std::sync::Arc;

use super::connection::Shared;
use super::{ModbusSettings, RegisterBank, RegisterMap};
use crate::mapping::TagTable;
use crate::process_image::{ProcessImage, process_image};
use crate::time::Clock;

/// A gateway without nodes.
pub fn shared() -> Shared {
    shared_of(TagTable::default())
}

/// A gateway that has seen nothing yet.
pub fn shared_of(table: TagTable) -> Shared {
    let table = Arc::new(table);
    let settings = ModbusSettings::default();
    let map = RegisterMap::build(&table, &settings, "cangate").unwrap();
    let (_, reader) = process_image(ProcessImage::default());
    Shared {
        bank: RegisterBank::new(table, map.into()).into(),
        reader,
        clock: Clock::start(),
        counters: Arc::default(),
        accounts: Arc::default(),
        rate: None,
        idle_timeout: None,
        partial_frame_timeout: settings.partial_frame_timeout(),
        send_timeout: settings.send_timeout(),
        objects: None,
        writers: None,
    }
}
