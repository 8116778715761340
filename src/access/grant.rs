//! What a client may ask for.

use std::collections::BTreeSet;
use std::fmt;
use std::sync::Arc;

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use crate::process_image::TagIndex;

/// How much a client is trusted with; each may do what those before it may.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "lowercase")]
pub enum Role {
    /// Reads.
    #[default]
    Viewer,
    /// Acknowledges and resets alarms, writes listed tags, sends on serial lines.
    Operator,
    /// Also NMT commands, and objects by SDO.
    Engineer,
}

impl Role {
    /// All of them.
    pub const ALL: [Self; 3] = [Self::Viewer, Self::Operator, Self::Engineer];

    /// The word in the configuration.
    #[must_use]
    pub fn word(self) -> &'static str {
        match self {
            Self::Viewer => "viewer",
            Self::Operator => "operator",
            Self::Engineer => "engineer",
        }
    }
}

/// A kind of thing that can be asked for.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Deed {
    /// Looking at values.
    Read,
    /// Acknowledging alarms.
    Acknowledge,
    /// Resetting latched alarms.
    Reset,
    /// Writing a tag.
    Write(TagIndex),
    /// Sending on a serial line.
    SerialSend,
    /// An NMT command.
    Nmt,
    /// Reading an object by SDO.
    SdoRead,
    /// Writing an object by SDO.
    SdoWrite,
}

impl Deed {
    /// The least role that may do it.
    #[must_use]
    pub fn role(self) -> Role {
        match self {
            Self::Read => Role::Viewer,
            Self::Acknowledge | Self::Reset | Self::Write(_) | Self::SerialSend => Role::Operator,
            Self::Nmt | Self::SdoRead | Self::SdoWrite => Role::Engineer,
        }
    }
}

/// Why something is not allowed.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum Denied {
    /// The role is too small.
    #[error("`{name}` is {role}, and this needs {needs}")]
    Role {
        /// Name of the table.
        name: String,
        /// What it is.
        role: Role,
        /// What it would have to be.
        needs: Role,
    },
    /// The tag is not listed.
    #[error("this tag is not among those that `{0}` may write")]
    Tag(String),
}

impl fmt::Display for Role {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.word())
    }
}

/// What one `[access.NAME]` allows.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Grant {
    name: Arc<str>,
    role: Role,
    tags: BTreeSet<TagIndex>,
}

impl Grant {
    /// A grant of this name. `tags`: those that it may write.
    #[must_use]
    pub fn new(name: &str, role: Role, tags: impl IntoIterator<Item = TagIndex>) -> Self {
        Self { name: name.into(), role, tags: tags.into_iter().collect() }
    }

    /// The name of its table, for the journal.
    #[must_use]
    pub fn name(&self) -> &Arc<str> {
        &self.name
    }

    /// Its role.
    #[must_use]
    pub fn role(&self) -> Role {
        self.role
    }

    /// Tags that it may write.
    pub fn tags(&self) -> impl Iterator<Item = TagIndex> {
        self.tags.iter().copied()
    }

    /// Whether it may do this.
    ///
    /// # Errors
    /// Why not.
    pub fn allows(&self, deed: Deed) -> Result<(), Denied> {
        let needs = deed.role();
        if self.role < needs {
            return Err(Denied::Role { name: self.name.to_string(), role: self.role, needs });
        }
        match deed {
            Deed::Write(tag) if !self.tags.contains(&tag) => Err(Denied::Tag(self.name.to_string())),
            Deed::Read
            | Deed::Acknowledge
            | Deed::Reset
            | Deed::Write(_)
            | Deed::SerialSend
            | Deed::Nmt
            | Deed::SdoRead
            | Deed::SdoWrite => Ok(()),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const LISTED: TagIndex = TagIndex(3);
    const OTHER: TagIndex = TagIndex(4);

    /// By deed: what viewer, operator and engineer may.
    const TABLE: [(Deed, [bool; 3]); 9] = [
        (Deed::Read, [true, true, true]),
        (Deed::Acknowledge, [false, true, true]),
        (Deed::Reset, [false, true, true]),
        (Deed::Write(LISTED), [false, true, true]),
        (Deed::Write(OTHER), [false, false, false]),
        (Deed::SerialSend, [false, true, true]),
        (Deed::Nmt, [false, false, true]),
        (Deed::SdoRead, [false, false, true]),
        (Deed::SdoWrite, [false, false, true]),
    ];

    #[test]
    fn cr_2_1_each_role_may_do_what_the_table_says_and_nothing_else() {
        for (deed, row) in TABLE {
            for (role, allowed) in Role::ALL.into_iter().zip(row) {
                let grant = Grant::new("hmi", role, [LISTED]);
                assert_eq!(grant.allows(deed).is_ok(), allowed, "{role}: {deed:?}");
            }
        }
    }

    #[test]
    fn s10_an_empty_list_of_tags_is_no_tag() {
        let grant = Grant::new("hmi", Role::Engineer, []);
        assert_eq!(grant.allows(Deed::Write(LISTED)), Err(Denied::Tag("hmi".into())));
    }

    #[test]
    fn a_refusal_says_who_is_what_and_what_it_takes() {
        let denied = Grant::new("hmi", Role::Operator, []).allows(Deed::Nmt).unwrap_err();
        assert_eq!(denied.to_string(), "`hmi` is operator, and this needs engineer");
    }
}
