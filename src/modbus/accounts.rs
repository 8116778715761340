//! What each client asked, by its address, pure; for metrics and the page.

// Addresses only; `core` has no sockets.
use core::net::IpAddr;
use std::collections::BTreeMap;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use crate::slots::Network;

/// Addresses that are remembered. When there are more, one without a connection is forgotten, the longest known first; while all have
/// one, newcomers are counted together.
const REMEMBERED: usize = 256;

/// The accounts of all addresses.
#[derive(Debug, Default)]
pub struct Accounts {
    reserved: Mutex<Vec<Network>>,
    known: Mutex<Known>,
}

#[derive(Debug, Default)]
struct Known {
    next: u64,
    accounts: BTreeMap<IpAddr, (u64, Arc<Account>)>,
    others: Arc<Account>,
}

/// Counters of one address.
#[derive(Debug, Default)]
struct Account {
    open: AtomicU64,
    connections: AtomicU64,
    requests: AtomicU64,
    exceptions: AtomicU64,
    delayed: AtomicU64,
    refused: AtomicU64,
}

/// A connection that is counted as open until this is dropped.
#[derive(Debug)]
pub struct Opened(Arc<Account>);

/// The counters of one address at one moment.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct ClientValues {
    /// `None`: addresses that could not be remembered, together.
    pub address: Option<IpAddr>,
    /// It has a reserved place.
    pub reserved: bool,
    /// Connections open now.
    pub open: u64,
    /// Connections since the start.
    pub connections: u64,
    /// Requests answered, exceptions included.
    pub requests: u64,
    /// Exceptions answered.
    pub exceptions: u64,
    /// Of the requests: those that waited, as it asks faster than it may.
    pub delayed: u64,
    /// Connections that were not let in.
    pub refused: u64,
}

fn count(counter: &AtomicU64) {
    counter.fetch_add(1, Ordering::Relaxed);
}

impl Accounts {
    /// None yet. `reserved`: addresses that are never forgotten.
    #[must_use]
    pub fn new(reserved: Vec<Network>) -> Self {
        Self { reserved: Mutex::new(reserved), known: Mutex::default() }
    }

    /// Others have reserved places from now on.
    pub fn set_reserved(&self, reserved: Vec<Network>) {
        *self.reserved.lock().unwrap_or_else(PoisonError::into_inner) = reserved;
    }

    /// A connection of an address begins.
    #[must_use]
    pub fn open(&self, address: IpAddr) -> Opened {
        let account = self.of(address);
        count(&account.connections);
        count(&account.open);
        Opened(account)
    }

    /// A connection of an address was not let in.
    pub fn refused(&self, address: IpAddr) {
        count(&self.of(address).refused);
    }

    /// All of them, in the order of their addresses.
    #[must_use]
    pub fn values(&self) -> Vec<ClientValues> {
        let known = self.known();
        let all = known.accounts.iter().map(|(address, (_, account))| (Some(*address), account));
        let others = Some((None, &known.others)).filter(|(_, others)| others.is_used());
        all.chain(others)
            .map(|(address, account)| account.values(address, self.is_reserved(address)))
            .collect()
    }

    /// Whether an address has a reserved place.
    #[must_use]
    pub fn is_reserved(&self, address: Option<IpAddr>) -> bool {
        let reserved = self.reserved.lock().unwrap_or_else(PoisonError::into_inner);
        address.is_some_and(|address| reserved.iter().any(|network| network.contains(address)))
    }

    fn known(&self) -> MutexGuard<'_, Known> {
        self.known.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn of(&self, address: IpAddr) -> Arc<Account> {
        let address = address.to_canonical();
        let mut known = self.known();
        if let Some((_, account)) = known.accounts.get(&address) {
            return Arc::clone(account);
        }
        if known.accounts.len() >= REMEMBERED {
            let idle = known.accounts.iter().filter(|(address, (_, account))| {
                account.open.load(Ordering::Relaxed) == 0 && !self.is_reserved(Some(**address))
            });
            let oldest = idle.min_by_key(|(_, (number, _))| *number).map(|(address, _)| *address);
            match oldest {
                Some(oldest) => known.accounts.remove(&oldest),
                None => return Arc::clone(&known.others),
            };
        }
        known.next += 1;
        let account = Arc::<Account>::default();
        let number = known.next;
        known.accounts.insert(address, (number, Arc::clone(&account)));
        account
    }
}

impl Account {
    fn is_used(&self) -> bool {
        self.connections.load(Ordering::Relaxed) + self.refused.load(Ordering::Relaxed) > 0
    }

    fn values(&self, address: Option<IpAddr>, reserved: bool) -> ClientValues {
        let value = |counter: &AtomicU64| counter.load(Ordering::Relaxed);
        ClientValues {
            address,
            reserved,
            open: value(&self.open),
            connections: value(&self.connections),
            requests: value(&self.requests),
            exceptions: value(&self.exceptions),
            delayed: value(&self.delayed),
            refused: value(&self.refused),
        }
    }
}

impl Opened {
    /// A request was answered.
    pub fn request(&self, is_exception: bool) {
        count(&self.0.requests);
        if is_exception {
            count(&self.0.exceptions);
        }
    }

    /// A request has to wait.
    pub fn delayed(&self) {
        count(&self.0.delayed);
    }
}

impl Drop for Opened {
    fn drop(&mut self) {
        self.0.open.fetch_sub(1, Ordering::Relaxed);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn address(number: u16) -> IpAddr {
        let [high, low] = number.to_be_bytes();
        IpAddr::from([10, 0, high, low])
    }

    #[test]
    fn each_address_has_its_counters_however_it_is_written() {
        let accounts = Accounts::new(vec!["10.0.0.1".parse().unwrap()]);
        let one = accounts.open("::ffff:10.0.0.1".parse().unwrap());
        let two = accounts.open(address(1));
        one.request(false);
        two.request(true);
        two.delayed();
        accounts.refused(address(2));
        drop(one);
        let values = accounts.values();
        assert_eq!(values.len(), 2);
        let first = ClientValues {
            address: Some(address(1)),
            reserved: true,
            open: 1,
            connections: 2,
            requests: 2,
            exceptions: 1,
            delayed: 1,
            refused: 0,
        };
        assert_eq!(values[0], first);
        assert_eq!((values[1].refused, values[1].connections, values[1].reserved), (1, 0, false));
    }

    #[test]
    fn a_flood_of_addresses_is_forgotten_and_who_is_there_or_listed_is_not() {
        let accounts = Accounts::new(vec!["10.0.0.1".parse().unwrap()]);
        drop(accounts.open(address(1)));
        let here = accounts.open(address(2));
        for number in 3..2_000 {
            drop(accounts.open(address(number)));
        }
        let values = accounts.values();
        assert_eq!(values.len(), REMEMBERED);
        assert_eq!((values[0].address, values[1].address), (Some(address(1)), Some(address(2))));
        let many: Vec<Opened> = (2_000..2_400).map(|number| accounts.open(address(number))).collect();
        here.request(false);
        let values = accounts.values();
        let others = values.last().unwrap();
        assert_eq!((others.address, values.len()), (None, REMEMBERED + 1));
        let open: u64 = values.iter().map(|client| client.open).sum();
        assert_eq!(open, u64::try_from(many.len() + 1).unwrap());
    }
}
