//! The places for clients of a TCP server: who gets in, and who must go when all are taken. All TCP servers but the page's stand on it.
//!
//! Pure:
//! - [`places`]: who must go when all places are taken.
//! - [`allow`]: addresses that may come at all.
//! - [`bucket`]: how often a client may ask.
//!
//! On the network:
//! - [`clients`] \[IO\]: lets a connection in, gives it its place, and ends another one for it if need be.
//! - [`listening`] \[IO\]: listens, accepts, and serves each client in a task of its own.

pub mod allow;
pub mod bucket;
pub mod clients;
pub mod listening;
pub mod places;

pub use allow::{AllowList, Network};
pub use bucket::{Bucket, Rate};
pub use clients::{Clients, Leave, Limits, Place, Places, ServerName, TurnedAway};
pub use listening::{BindError, Service};
pub use places::{Activity, SlotId, Slots, Taken};
