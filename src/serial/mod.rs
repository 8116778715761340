//! Serial lines of esd modules as TCP ports: raw bytes, as serial device servers have it.
//!
//! Every connection reads; the first that sends writes, until it ends. What comes in on a line goes to each connection by
//! a cursor of its own, so that nobody waits for a slow one: who falls behind by more than the process image keeps is
//! disconnected, and told of. What a client sends goes to the gateway in pieces, two at a time, and its socket is read no
//! faster than the line takes them.
//!
//! - [`seat`]: who writes, pure. [`opening`]: who is a browser, pure. [`told`]: what is told once a minute and not at every time, pure.
//!   [`end`]: how connections end, and what is told of it.
//! - [`server`] \[IO\]: listens, and wakes the connections.
//! - [`connection`] \[IO\]: one client.

pub mod connection;
pub mod end;
pub mod opening;
pub mod seat;
pub mod server;
pub mod told;

pub use server::Server;
