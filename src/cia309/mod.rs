//! CiA 309-3: a CANopen network as lines of text over TCP (ASCII mapping of CiA 309-1).
//!
//! A client sends `[sequence] [[network] node] command`, and gets one line for it: `[sequence] OK`, a value, or
//! `[sequence] ERROR:code`. `docs/cia309.md` is the manual. The standard itself is not public: what is written here follows
//! what open implementations of it agree on, and says where they do not.
//!
//! Not here: events that nobody asked for (boot-up, EMCY, PDOs), LSS, configuration of PDOs and of guarding. They are
//! answered with code 100.
//!
//! Pure:
//! - [`settings`]: the `[cia309]` table.
//! - [`lines`]: lines out of a stream of bytes, of bounded length.
//! - [`request`]: what a line asks for. [`words`]: its words. [`format`](mod@format): values as text.
//! - [`code`]: the error codes.
//! - [`session`]: what is remembered between lines; from a request to what is asked of the gateway, and back.
//!
//! On the network:
//! - [`server`] \[IO\]: listens. [`connection`] \[IO\]: one client.

pub mod code;
pub mod connection;
pub mod format;
pub mod lines;
pub mod request;
pub mod server;
pub mod session;
pub mod settings;
pub mod words;

pub use server::Server;
pub use session::{Session, Step, Told};
pub use settings::Cia309Settings;

#[cfg(test)]
#[path = "session_tests.rs"]
mod tests;
