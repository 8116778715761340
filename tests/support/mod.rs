//! What several tests need.
pub mod conversation;
pub mod fake_broker;
pub mod modbus;
pub mod plant;
pub mod registers;
pub mod world;
