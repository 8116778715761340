//! Ports for servers that are told where to listen, as programs are that have configuration files.

use std::net::{Ipv4Addr, SocketAddr, TcpListener};
use std::sync::Mutex;

/// None of these does the kernel give to anyone who does not ask for it (its own begin at 32768).
const FIRST: u16 = 20_000;
const LAST: u16 = 32_000;

/// An address of 127.0.0.1 at which nobody listens, given to nobody else in this process.
pub fn free_address() -> SocketAddr {
    static NEXT: Mutex<u16> = Mutex::new(0);
    let mut next = NEXT.lock().unwrap();
    for _ in FIRST..LAST {
        if *next == 0 {
            // Another run of the tests on this machine begins elsewhere.
            *next = FIRST + u16::try_from(std::process::id() * 101 % u32::from(LAST - FIRST)).unwrap();
        }
        let address = SocketAddr::from((Ipv4Addr::LOCALHOST, *next));
        *next = if *next == LAST { FIRST } else { *next + 1 };
        if TcpListener::bind(address).is_ok() {
            return address;
        }
    }
    panic!("no port is free from {FIRST} to {LAST}");
}

#[test]
fn no_port_is_given_twice_and_none_that_is_taken() {
    let first = free_address();
    let _taken = TcpListener::bind(SocketAddr::from((Ipv4Addr::LOCALHOST, first.port() + 1)));
    let mut given: Vec<u16> = (0..100).map(|_| free_address().port()).collect();
    assert!(!given.contains(&first.port()));
    given.sort_unstable();
    given.dedup();
    assert_eq!(given.len(), 100);
}
