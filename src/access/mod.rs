//! Who may ask the gateway for what, pure: the `[access.NAME]` tables.
//!
//! Nobody may ask for anything without such a table: an empty list is nobody, never everybody. This room knows roles, names and
//! what they allow; it opens no file and no socket, and knows no door. Who a client is, is found out by the door that it came to.
//!
//! - [`settings`]: the tables as they are written.
//! - [`grant`]: what one of them allows. [`password`]: what is kept of a password.
//! - [`book`]: all of them, checked; by what a client of which door is known.

pub mod book;
pub mod grant;
pub mod password;
pub mod settings;

pub use book::Access;
pub use grant::{Deed, Denied, Grant, Role};
pub use password::{PasswordHash, PasswordPlace};
pub use settings::{AccessEntry, SecretText};
