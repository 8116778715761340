//! What several tests need.
pub mod plant;
