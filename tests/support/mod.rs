//! What several tests need.
pub mod fake_broker;
pub mod plant;
