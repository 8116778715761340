//! What several tests need.
pub mod fake_broker;
pub mod modbus;
pub mod plant;
pub mod registers;
