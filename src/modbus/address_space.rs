//! Which addresses exist and what they show: sorted once, so that a read walks and does not search.

use std::ops::Range;

use super::register_map::MapError;

/// One address space of one unit: its registers, or its bits.
#[derive(Clone, Debug)]
pub struct AddressSpace<S> {
    /// The published blocks: sorted, apart from each other. Inside them there are no holes.
    covered: Vec<Range<u32>>,
    /// Sorted by address, without overlap. An address of a block that no entry has is reserved and reads 0.
    entries: Vec<Entry<S>>,
}

/// What stands at an address.
#[derive(Clone, Debug)]
pub struct Entry<S> {
    /// First address.
    pub address: u32,
    /// Addresses that it takes.
    pub count: u32,
    /// What it shows.
    pub show: S,
}

/// An address space in the making.
#[derive(Debug)]
pub struct AddressSpaceBuilder<S> {
    claims: Vec<(Range<u32>, String)>,
    covered: Vec<Range<u32>>,
    entries: Vec<Entry<S>>,
}

impl<S> AddressSpace<S> {
    /// The entries that a read touches; `None` when it leaves the published blocks.
    #[must_use]
    pub fn read(&self, start: u16, quantity: u16) -> Option<&[Entry<S>]> {
        let start = u32::from(start);
        let end = start + u32::from(quantity);
        let block = self.covered.get(self.covered.partition_point(|block| block.end <= start))?;
        if start < block.start || block.end < end {
            return None;
        }
        let first = self.entries.partition_point(|entry| entry.address + entry.count <= start);
        let last = self.entries.partition_point(|entry| entry.address < end);
        self.entries.get(first..last)
    }

    /// All entries, by address.
    #[must_use]
    pub fn entries(&self) -> &[Entry<S>] {
        &self.entries
    }
}

impl<S> AddressSpaceBuilder<S> {
    /// Nothing yet.
    #[must_use]
    pub fn new() -> Self {
        Self { claims: Vec::new(), covered: Vec::new(), entries: Vec::new() }
    }

    /// These addresses belong to `owner` and to nobody else.
    pub fn claim(&mut self, addresses: Range<u32>, owner: impl Into<String>) {
        self.claims.push((addresses, owner.into()));
    }

    /// These addresses are published; several owners may publish the same reserved ones.
    pub fn publish(&mut self, addresses: Range<u32>) {
        self.covered.push(addresses);
    }

    /// What stands at an address that was claimed and published.
    pub fn show(&mut self, address: u32, count: u16, show: S) {
        self.entries.push(Entry { address, count: u32::from(count), show });
    }

    /// The finished space.
    ///
    /// # Errors
    /// Two owners claim the same address, or one claims an address that does not exist. `unit_id` and `table` are for
    /// the message.
    pub fn build(mut self, unit_id: u8, table: &'static str) -> Result<AddressSpace<S>, MapError> {
        self.claims.sort_by_key(|(addresses, _)| addresses.start);
        for pair in self.claims.windows(2) {
            if let [(first, first_owner), (second, second_owner)] = pair
                && second.start < first.end
            {
                return Err(MapError::Overlap {
                    unit_id,
                    table,
                    address: second.start,
                    first: first_owner.clone(),
                    second: second_owner.clone(),
                });
            }
        }
        if let Some((addresses, owner)) = self.claims.last()
            && addresses.end > ADDRESSES
        {
            return Err(MapError::BeyondEnd {
                unit_id,
                table,
                address: addresses.end - 1,
                owner: owner.clone(),
            });
        }
        self.entries.sort_by_key(|entry| entry.address);
        Ok(AddressSpace { covered: merged(self.covered), entries: self.entries })
    }
}

impl<S> Default for AddressSpaceBuilder<S> {
    fn default() -> Self {
        Self::new()
    }
}

/// Addresses of a space.
const ADDRESSES: u32 = 0x1_0000;

/// The ranges sorted, those that touch joined, cut off at the end of the space.
fn merged(mut ranges: Vec<Range<u32>>) -> Vec<Range<u32>> {
    ranges.sort_by_key(|range| range.start);
    let mut merged: Vec<Range<u32>> = Vec::new();
    for range in ranges {
        let end = range.end.min(ADDRESSES);
        match merged.last_mut() {
            Some(last) if range.start <= last.end => last.end = last.end.max(end),
            _ if range.start < end => merged.push(range.start..end),
            _ => {}
        }
    }
    merged
}

#[cfg(test)]
mod tests {
    use super::*;

    fn space() -> AddressSpace<char> {
        let mut builder = AddressSpaceBuilder::new();
        builder.publish(10..20);
        builder.publish(20..30);
        builder.publish(65_530..65_540);
        builder.show(25, 1, 'c');
        builder.show(12, 2, 'a');
        builder.show(20, 2, 'b');
        builder.build(1, "input registers").unwrap()
    }

    fn shown(start: u16, quantity: u16) -> Option<String> {
        space().read(start, quantity).map(|entries| entries.iter().map(|entry| entry.show).collect())
    }

    #[test]
    fn a_read_sees_the_entries_that_it_touches() {
        assert_eq!(shown(10, 20).as_deref(), Some("abc"));
        assert_eq!(shown(13, 7).as_deref(), Some("a"));
        assert_eq!(shown(13, 8).as_deref(), Some("ab"));
        assert_eq!(shown(14, 6).as_deref(), Some(""));
        assert_eq!(shown(65_535, 1).as_deref(), Some(""));
    }

    #[test]
    fn a_read_must_stay_within_one_block() {
        for (start, quantity) in
            [(9, 1), (9, 2), (10, 21), (29, 2), (30, 1), (0, 125), (65_529, 2), (65_535, 2)]
        {
            assert_eq!(shown(start, quantity), None, "{start} {quantity}");
        }
    }

    #[test]
    fn an_overlap_names_both_owners() {
        let mut builder = AddressSpaceBuilder::<()>::new();
        builder.claim(0..100, "the node block");
        builder.claim(99..101, "tag `x`");
        let error = builder.build(3, "input registers").unwrap_err().to_string();
        assert!(
            error.contains("the node block") && error.contains("tag `x`") && error.contains("99"),
            "{error}"
        );
    }

    #[test]
    fn an_address_beyond_the_last_is_refused() {
        let mut builder = AddressSpaceBuilder::<()>::new();
        builder.claim(65_535..65_537, "tag `x`");
        assert!(matches!(builder.build(3, "input registers"), Err(MapError::BeyondEnd { .. })));
    }
}
