//! What listens, and what a reload has to try of it before anything is touched. Pure.

use std::net::SocketAddr;

use super::plan::Plan;
use super::wiring::Installation;

/// A part that listens, on all its addresses or on none.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Listener {
    /// Modbus TCP.
    Modbus,
    /// Modbus/TCP Security.
    Security,
    /// HTTP.
    Http,
    /// CiA 309-3.
    Cia309,
    /// The TCP ports of serial lines.
    Serial,
}

/// The addresses that `new` needs to take the place of `old` by this plan, each with the one that is to be free for that now.
///
/// That is itself, unless it overlaps with a listener of ours that ends before: then it is not free yet, and will be. Of such a
/// one only the host is left to try, which has to be this one's all the same: its port 0. What `is_lost` is not ours.
#[must_use]
pub fn to_try(
    old: &Installation,
    is_lost: impl Fn(Listener) -> bool,
    new: &Installation,
    plan: &Plan,
) -> Vec<(SocketAddr, SocketAddr)> {
    let ends = |listener| plan.begins_anew(listener) && !is_lost(listener);
    let ours: Vec<SocketAddr> =
        of(old).filter(|(listener, _)| ends(*listener)).map(|(_, address)| address).collect();
    let needed = of(new).filter(|(listener, _)| plan.begins_anew(*listener));
    needed
        .map(|(_, address)| {
            let is_ours = ours.iter().any(|ours| overlap(*ours, address));
            (address, if is_ours { SocketAddr::new(address.ip(), 0) } else { address })
        })
        .collect()
}

/// Every address that an installation listens on.
fn of(installation: &Installation) -> impl Iterator<Item = (Listener, SocketAddr)> {
    let Installation { table, modbus, http, cia309, .. } = installation;
    let lines = table.lines.iter().filter_map(|line| line.tcp.as_ref().map(|tcp| tcp.listen));
    let modbus_addresses = modbus.listen.iter().map(|address| (Listener::Modbus, *address));
    let security = modbus.security.listen.iter().map(|address| (Listener::Security, *address));
    modbus_addresses
        .chain(security)
        .chain([(Listener::Http, http.listen)])
        .chain(cia309.listen.map(|address| (Listener::Cia309, address)))
        .chain(lines.map(|address| (Listener::Serial, address)))
}

/// Whether one cannot be listened on beside the other.
fn overlap(one: SocketAddr, other: SocketAddr) -> bool {
    let same_host = one.ip() == other.ip() || one.ip().is_unspecified() || other.ip().is_unspecified();
    same_host && one.port() == other.port()
}
