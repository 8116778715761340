//! What the tests stand on: processes, bus, broker, clients, a played device.

pub mod broker;
pub mod bus;
pub mod device;
pub mod flood;
pub mod gateway;
pub mod modbus;
#[path = "../../support/ports.rs"]
pub mod ports;
pub mod process;
pub mod proxy;
pub mod wait;
