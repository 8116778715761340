//! The command line: one file for each subcommand, thin.

pub mod map;
pub mod sim;
