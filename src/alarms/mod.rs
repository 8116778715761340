//! The alarm list (ISA-18.2, IEC 62682), pure: states, delays, latching, acknowledgement, suppression, first-out.
//!
//! Told whether each condition holds; tells which alarms changed their state. Not here: what a condition is (the
//! mapping's expressions and the gateway's built-in conditions decide that), texts, topics.
//!
//! - [`spec`]: what each alarm is like.
//! - [`state`]: the state machine of one alarm.
//! - `suppression`: which alarm tells the cause of which.
//! - [`list`]: all alarms; delays, chatter, suppression, first-out.

pub mod list;
pub mod spec;
pub mod state;
mod suppression;

pub use list::{AcknowledgeError, AlarmList, Transition};
pub use spec::AlarmSpec;
pub use state::{AlarmEvent, AlarmMachine};

#[cfg(test)]
mod fixture;
#[cfg(test)]
mod tests;
