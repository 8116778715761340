//! Lines of modules that stay go on in another table.

use super::Lines;
use crate::gateway::kept::Kept;

impl Lines {
    /// Takes over counters and what is under way. Whoever waits for a line that does not stay was answered before.
    pub(in crate::gateway) fn take_over(&mut self, old: Self, kept: &Kept) {
        for before in old.all {
            let node = kept.new_node(before.node);
            let line =
                self.all.iter_mut().find(|line| Some(line.node) == node && line.channel == before.channel);
            if let Some(line) = line {
                let (index, node) = (line.index, line.node);
                *line = before;
                (line.index, line.node) = (index, node);
            }
        }
        self.newest_send = old.newest_send;
        for (id, mut asked) in old.sends {
            if let Some(line) = kept.new_line(asked.line) {
                asked.line = line;
                self.sends.insert(id, asked);
            }
        }
        self.next_look = self.next_look.map(|look| old.next_look.unwrap_or(look));
    }
}
