//! The command line: one file for each subcommand, thin.

pub mod check;
pub mod schema;
pub mod sim;
