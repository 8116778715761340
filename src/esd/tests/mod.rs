//! Tests of the network as a whole.
//!
//! - `bench`: a network on a bus with pretended modules; everything that comes of it as lines of text.
//! - `managing`: finding, comparing, writing, looking after. `disturbed`: the same where things go wrong.
//! - `guarding`: the watchdog. `orders`: what operators ask for, and the passive role.
//! - `lines`: serial lines.
//! - `properties`: random input, lost and doubled answers, random order.

mod bench;
mod disturbed;
mod guarding;
mod lines;
mod managing;
mod orders;
mod properties;
