//! On what ground a request is made.

use std::sync::Arc;

use super::Action;
use crate::access::{Deed, Grant};

/// On what ground a request is made. There is none without one of these.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Authority {
    /// The configuration opened a serial line for whoever reaches its TCP port or may publish to its topic: bytes may be sent on
    /// it, and nothing else.
    SerialLine,
    /// The configuration opened the objects of the nodes for whoever reaches the port (`[cia309]`, `canopen_objects`).
    Objects {
        /// They may be written too, and NMT commands be sent.
        write: bool,
    },
    /// The client is known by an `[access.NAME]`.
    Grant(Arc<Grant>),
}

impl Authority {
    /// Whether it is good for a request.
    ///
    /// # Errors
    /// Why not.
    pub fn permits(&self, action: &Action) -> Result<(), String> {
        let (door, permitted) = match self {
            Self::Grant(grant) => return permitted(grant, action),
            Self::SerialLine => ("a serial line", matches!(action, Action::SerialSend { .. })),
            Self::Objects { write } => {
                let changes = matches!(action, Action::SdoWrite { .. } | Action::Nmt { .. });
                let permitted = matches!(action, Action::SdoRead { .. }) || (*write && changes);
                (if *write { "objects" } else { "objects that are only read" }, permitted)
            }
        };
        if permitted { Ok(()) } else { Err(format!("this door was opened for {door}")) }
    }
}

fn permitted(grant: &Grant, action: &Action) -> Result<(), String> {
    let allowed = match action {
        // A write of nothing is for the gateway to refuse.
        Action::WriteTags { writes } => {
            writes.iter().try_for_each(|(tag, _)| grant.allows(Deed::Write(*tag)))
        }
        Action::Acknowledge { .. } | Action::AcknowledgeAll { .. } => grant.allows(Deed::Acknowledge),
        Action::Reset { .. } => grant.allows(Deed::Reset),
        Action::SerialSend { .. } => grant.allows(Deed::SerialSend),
        Action::Nmt { .. } => grant.allows(Deed::Nmt),
        Action::SdoRead { .. } => grant.allows(Deed::SdoRead),
        Action::SdoWrite { .. } => grant.allows(Deed::SdoWrite),
    };
    allowed.map_err(|denied| denied.to_string())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::access::Role;
    use crate::canopen::NmtRequest;
    use crate::gateway::command::ObjectId;
    use crate::process_image::{AlarmIndex, LineIndex, NodeIndex, TagIndex, Value};

    /// Every action; of writes one of a listed tag, and one of a listed and another.
    fn actions() -> [Action; 9] {
        let (node, object, timeout) = (NodeIndex(0), ObjectId::new(0x1017, 0), None);
        let write = |tags: &[usize]| Action::WriteTags {
            writes: tags.iter().map(|tag| (TagIndex(*tag), Value::Unsigned(1))).collect(),
        };
        [
            Action::Acknowledge { alarm: AlarmIndex(0), raise: None },
            Action::AcknowledgeAll { node: None },
            Action::Reset { alarm: AlarmIndex(0) },
            write(&[1]),
            write(&[1, 2]),
            Action::SerialSend { line: LineIndex(0), bytes: vec![1] },
            Action::SdoRead { node, object, len: None, timeout },
            Action::SdoWrite { node, object, data: vec![0], timeout },
            Action::Nmt { node, request: NmtRequest::Stop },
        ]
    }

    #[test]
    fn cr_2_1_every_authority_against_every_action() {
        let grant = |role| Authority::Grant(Arc::new(Grant::new("hmi", role, [TagIndex(1)])));
        let table = [
            (grant(Role::Viewer), [0, 0, 0, 0, 0, 0, 0, 0, 0]),
            (grant(Role::Operator), [1, 1, 1, 1, 0, 1, 0, 0, 0]),
            (grant(Role::Engineer), [1, 1, 1, 1, 0, 1, 1, 1, 1]),
            (Authority::SerialLine, [0, 0, 0, 0, 0, 1, 0, 0, 0]),
            (Authority::Objects { write: false }, [0, 0, 0, 0, 0, 0, 1, 0, 0]),
            (Authority::Objects { write: true }, [0, 0, 0, 0, 0, 0, 1, 1, 1]),
        ];
        for (authority, row) in table {
            for (action, permitted) in actions().iter().zip(row) {
                assert_eq!(authority.permits(action).is_ok(), permitted == 1, "{authority:?}: {action:?}");
            }
        }
    }
}
