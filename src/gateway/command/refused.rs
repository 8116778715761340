//! Requests that were refused for want of a right, on their way to the journal: counted one by one, told in groups. Whoever
//! hammers at a door costs a place in a short list, not one in the queue of the gateway.

use std::collections::BTreeMap;

use super::{Action, CommandSource, Door};

/// Kinds of refusals that are kept apart between two looks. Those of further clients are counted as if they were of one.
const MOST_KINDS: usize = 64;

/// Requests of one client that are alike, and were refused.
#[derive(Clone, Debug, PartialEq)]
pub struct Refused {
    /// Who asked last.
    pub source: CommandSource,
    /// The word of what was asked for.
    pub verb: &'static str,
    /// What was asked for last, where it was understood so far.
    pub action: Option<Action>,
    /// What else is to be said of it.
    pub text: String,
    /// How many, at least one.
    pub count: u64,
}

/// By door, client and name of its access, and the word of what was asked for.
type Kind = (Door, String, String, &'static str);

/// What was refused since it was looked at.
#[derive(Debug, Default)]
pub(super) struct Ledger {
    kinds: BTreeMap<Kind, Refused>,
    totals: [u64; Door::ALL.len()],
}

impl Ledger {
    /// Some were refused.
    pub(super) fn note(&mut self, refused: Refused) {
        for (door, total) in Door::ALL.into_iter().zip(&mut self.totals) {
            if door == refused.source.door {
                *total = total.saturating_add(refused.count);
            }
        }
        let source = &refused.source;
        let access = source.access.as_deref().unwrap_or_default().to_owned();
        let mut kind = (source.door, source.without_port().client, access, refused.verb);
        if self.kinds.len() >= MOST_KINDS && !self.kinds.contains_key(&kind) {
            (kind.1, kind.2, kind.3) = (String::new(), String::new(), "");
        }
        let before = self.kinds.get(&kind).map_or(0, |before| before.count);
        let count = before.saturating_add(refused.count);
        self.kinds.insert(kind, Refused { count, ..refused });
    }

    pub(super) fn is_empty(&self) -> bool {
        self.kinds.is_empty()
    }

    /// Takes all.
    pub(super) fn take(&mut self) -> Vec<Refused> {
        std::mem::take(&mut self.kinds).into_values().collect()
    }

    /// How many were ever refused at each of [`Door::ALL`].
    pub(super) fn totals(&self) -> [u64; Door::ALL.len()] {
        self.totals
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn refused(client: &str, verb: &'static str) -> Refused {
        let source = CommandSource::modbus(client.to_owned());
        Refused { source, verb, action: None, text: String::new(), count: 1 }
    }

    #[test]
    fn those_of_one_client_are_counted_together_from_whatever_port_they_come() {
        let mut ledger = Ledger::default();
        for port in 1..=1000 {
            ledger.note(refused(&format!("10.0.0.7:{port}"), "write"));
        }
        ledger.note(refused("10.0.0.7:1", "nmt"));
        ledger.note(refused("10.0.0.8:1", "write"));
        let counts: Vec<u64> = ledger.take().iter().map(|refused| refused.count).collect();
        assert_eq!(counts, [1, 1000, 1]);
        assert!(ledger.is_empty());
        assert_eq!(ledger.totals(), [1002, 0, 0, 0, 0]);
    }

    #[test]
    fn s9_however_many_clients_there_are_the_list_is_short_and_none_is_forgotten() {
        let mut ledger = Ledger::default();
        for client in 0..100_000_u32 {
            ledger.note(refused(&format!("{}:1", core::net::Ipv4Addr::from_bits(client)), "write"));
        }
        let taken = ledger.take();
        assert_eq!(taken.len(), MOST_KINDS + 1);
        assert_eq!(taken.iter().map(|refused| refused.count).sum::<u64>(), 100_000);
    }
}
