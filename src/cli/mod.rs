//! The command line: one file for each subcommand, thin.

pub mod sim;
