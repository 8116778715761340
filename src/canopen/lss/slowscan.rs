//! Finds slaves that may well have node ids, by asking for ranges of addresses and halving those in which somebody is.
//!
//! Several slaves in a range answer with the same frame, which on the bus is one. So both halves of a range are asked,
//! whatever the first said, until single addresses are left. Each is asked once more, as a stray answer could pass
//! for its own; a range that stays silent as a whole, or whose halves do though it did not, is asked again, as a frame may
//! have been lost.

use super::codec::{self, IDENTIFIED};
use super::program::{Exchange, Expect, Next, Reply};
use super::{LssAddress, LssAnswer, LssError, LssRange};

/// How often a range, or the halves of one in which somebody is, are asked when all stay silent.
const TRIES: u32 = 3;
/// Slaves that a scan finds at most: as many as a bus has nodes. A device that says yes to everything must not keep it busy
/// for ever.
const MOST: usize = 127;

/// A scan under way.
#[derive(Debug)]
pub(super) struct Slowscan {
    /// What is to be done, the next at the end. At most some entries for each bit of revision and serial number, beside
    /// the ranges that were asked for.
    tasks: Vec<Task>,
    found: Vec<LssAddress>,
    /// Addresses that said yes, with those that were found before in another range.
    hits: usize,
    asked: Option<Task>,
}

#[derive(Clone, Copy, Debug)]
enum Task {
    /// Ask whether somebody is in this range, so many times.
    Ask(LssRange, u32),
    /// Ask again for this single address.
    Confirm(LssRange),
    /// Both halves of this range were asked, so many times; before, there had been so many hits.
    Check { range: LssRange, hits: usize, tries: u32 },
}

impl Slowscan {
    /// A scan of these ranges, in their order.
    pub(super) fn new(ranges: Vec<LssRange>) -> Self {
        let tasks = ranges.into_iter().rev().map(|range| Task::Ask(range, TRIES - 1)).collect();
        Self { tasks, found: Vec::new(), hits: 0, asked: None }
    }

    /// The step after this reply.
    pub(super) fn next(&mut self, reply: Reply) -> Next {
        let yes = match reply {
            Reply::Failed(error) => return Next::Finish(Err(error)),
            Reply::Answer(_) => true,
            Reply::Done | Reply::Silence | Reply::Performed(_) => false,
        };
        match self.asked.take() {
            Some(Task::Ask(range, _)) if yes => match halves(&range) {
                Some(halves) => self.split(range, halves, 1),
                None => self.tasks.push(Task::Confirm(range)),
            },
            Some(Task::Ask(range, tries)) if tries > 1 => self.tasks.push(Task::Ask(range, tries - 1)),
            Some(Task::Confirm(range)) if yes => {
                self.hits += 1;
                if self.hits > MOST {
                    let text = "more LSS slaves said yes than a bus can have: one answers to every question";
                    return Next::Finish(Err(LssError::Nonsense(text)));
                }
                let (revision, serial) = (range.revision.0, range.serial.0);
                let address = LssAddress { vendor: range.vendor, product: range.product, revision, serial };
                // Ranges may overlap.
                if !self.found.contains(&address) {
                    self.found.push(address);
                    return Next::Found(address);
                }
            }
            Some(Task::Ask(..) | Task::Confirm(_) | Task::Check { .. }) | None => {}
        }
        self.go_on()
    }

    fn go_on(&mut self) -> Next {
        while let Some(task) = self.tasks.pop() {
            match task {
                Task::Ask(range, _) | Task::Confirm(range) => {
                    self.asked = Some(task);
                    let frames = codec::identify(&range);
                    let expect = Expect::Collect(IDENTIFIED);
                    return Next::Exchange(Exchange::new("identify remote slave", &frames, expect));
                }
                Task::Check { range, hits, tries } if self.hits == hits => {
                    if tries >= TRIES {
                        return Next::Finish(Err(LssError::Inconsistent));
                    }
                    if let Some(halves) = halves(&range) {
                        self.split(range, halves, tries + 1);
                    }
                }
                Task::Check { .. } => {}
            }
        }
        Next::Finish(Ok(LssAnswer::Found(std::mem::take(&mut self.found))))
    }

    fn split(&mut self, range: LssRange, (low, high): (LssRange, LssRange), tries: u32) {
        self.tasks.push(Task::Check { range, hits: self.hits, tries });
        self.tasks.push(Task::Ask(high, 1));
        self.tasks.push(Task::Ask(low, 1));
    }
}

/// The two halves of a range, first by serial number, then by revision; `None` for a single address.
fn halves(range: &LssRange) -> Option<(LssRange, LssRange)> {
    if let Some((low, high)) = split(range.serial) {
        return Some((LssRange { serial: low, ..*range }, LssRange { serial: high, ..*range }));
    }
    let (low, high) = split(range.revision)?;
    Some((LssRange { revision: low, ..*range }, LssRange { revision: high, ..*range }))
}

fn split((low, high): (u32, u32)) -> Option<((u32, u32), (u32, u32))> {
    let middle = low.midpoint(high);
    (low < high).then(|| ((low, middle), (middle + 1, high)))
}
