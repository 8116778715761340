//! The steps of managing one module: what each asks, and what it can make of the module.

use super::init_frame::Request;
use super::plan::Item;

/// What is done next.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Step {
    /// Ask whether it is there.
    Seek,
    Kind,
    Software,
    Switch,
    /// Read the status, after so many times of clearing.
    Status(u8),
    /// Clear it, for this time.
    Clear(u8),
    /// This place of the plan.
    Item(usize),
    Write(usize),
    Verify(usize),
    /// Read the status at the end.
    Confirm,
    /// All is done: read the status again and again.
    Watch,
}

/// What is known of the module.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Condition {
    /// It has not been compared since it appeared or started.
    Unknown,
    /// It is as it is wanted.
    Good,
    /// It is not; it does what it does.
    Different,
    /// It is another module.
    Other,
}

/// What a step made of the module.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Change {
    Nothing,
    /// It started anew.
    Restarted,
    /// It is in order; its watchdog may be set going.
    Configured,
    /// It answers no more.
    Lost,
}

impl Step {
    /// What it asks; `None` for one that sets something.
    pub(super) fn request(self, plan: &[Item]) -> Option<Request> {
        match self {
            Self::Seek => Some(Request::ActiveNumber),
            Self::Kind => Some(Request::ModuleType),
            Self::Software => Some(Request::SoftwareRevision),
            Self::Switch => Some(Request::Switch),
            Self::Status(_) | Self::Confirm | Self::Watch => Some(Request::Status),
            Self::Clear(_) | Self::Write(_) => None,
            Self::Item(place) | Self::Verify(place) => match plan.get(place) {
                Some(Item::Want(want)) => Some(want.request),
                Some(Item::Read(request)) => Some(*request),
                Some(Item::Store) | None => None,
            },
        }
    }

    /// The same in words.
    pub(super) fn asks_for(self, plan: &[Item]) -> String {
        match self {
            Self::Seek => "number".to_owned(),
            Self::Kind => "type".to_owned(),
            Self::Software => "software revision".to_owned(),
            Self::Switch => "coding switch".to_owned(),
            Self::Status(_) | Self::Clear(_) | Self::Confirm | Self::Watch => "status".to_owned(),
            Self::Item(place) | Self::Write(place) | Self::Verify(place) => match plan.get(place) {
                Some(Item::Want(want)) => want.what.clone(),
                Some(Item::Read(Request::Parameter(number))) => format!("user parameter 0x{number:02X}"),
                Some(Item::Read(_) | Item::Store) | None => "parameters".to_owned(),
            },
        }
    }
}
