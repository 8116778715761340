//! One step of a boot: from answer to answer.

use super::pdo::PdoTask;
use super::{BootEvent, BootFailure, BootStep};
use crate::canopen::object::ObjectId;
use crate::canopen::sdo::{SdoError, SdoRequest};

/// 0x1010:1, and what is written there: "save".
const STORE: ObjectId = ObjectId::new(0x1010, 1);
const SAVE: [u8; 4] = *b"save";
/// Error register, and the newest error.
const ERROR_REGISTER: ObjectId = ObjectId::new(0x1001, 0);
const NEWEST_ERROR: ObjectId = ObjectId::new(0x1003, 1);
/// Device type.
const DEVICE_TYPE: ObjectId = ObjectId::new(0x1000, 0);

/// An answer to the last request, or none at the beginning.
pub(super) type Answer = Option<Result<Vec<u8>, SdoError>>;

/// What comes next.
#[derive(Debug)]
pub(super) enum Advance {
    /// Ask the node; its answer is to be given to the next call.
    Ask(SdoRequest),
    /// Tell, and go on without an answer.
    Tell(BootEvent),
    /// An object was written: count it, and go on without an answer.
    Wrote(ObjectId),
    /// Go on without an answer when the node is pre-operational.
    EnterPreOperational,
    /// The step is done.
    Done,
    /// The boot has failed.
    Failed(BootFailure),
}

impl Advance {
    /// Why the boot cannot go on: nobody answered, or the node said no.
    pub(super) fn failed(object: ObjectId, error: SdoError) -> Self {
        Self::Failed(match error {
            SdoError::Timeout { .. } | SdoError::BusUnavailable => BootFailure::NoAnswer,
            error @ (SdoError::Abort(_)
            | SdoError::Protocol(_)
            | SdoError::Interrupted
            | SdoError::TooLong { .. }
            | SdoError::TooSlow { .. }) => BootFailure::Configuration { object, error },
        })
    }
}

/// A step under way.
#[derive(Debug)]
pub(super) enum Task {
    Identity { object: ObjectId, expected: u32, tolerated: bool, told: bool },
    Read { object: ObjectId, told: bool },
    Write(Write),
    Errors(Errors),
    Pdo(PdoTask),
    Save { needed: bool },
}

/// Asks what is wrong with the node.
#[derive(Clone, Copy, Debug)]
pub(super) enum Errors {
    Begin,
    Register,
    Newest { register: Option<u8> },
    Told,
}

/// Sees to it that an object has a value.
#[derive(Debug)]
pub(super) struct Write {
    object: ObjectId,
    data: Vec<u8>,
    optional: bool,
    phase: WritePhase,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum WritePhase {
    Begin,
    Compare,
    /// Whether its value can be read at all.
    Write {
        readable: bool,
    },
    Verify,
    Written,
    Refused,
}

impl Task {
    /// `written`: objects that the steps before wrote.
    pub(super) fn new(step: &BootStep, written: u32) -> Self {
        match step {
            BootStep::Identity { object, expected, tolerated } => {
                Self::Identity { object: *object, expected: *expected, tolerated: *tolerated, told: false }
            }
            BootStep::Read { object } => Self::Read { object: *object, told: false },
            BootStep::Write { object, data, optional } => Self::Write(Write {
                object: *object,
                data: data.clone(),
                optional: *optional,
                phase: WritePhase::Begin,
            }),
            BootStep::Errors => Self::Errors(Errors::Begin),
            BootStep::Pdo(setup) => Self::Pdo(PdoTask::new(setup.clone(), false)),
            BootStep::Rpdo(setup) => Self::Pdo(PdoTask::new(setup.clone(), true)),
            BootStep::Save => Self::Save { needed: written > 0 },
        }
    }

    /// Goes on.
    pub(super) fn advance(&mut self, answer: Answer, may_run: bool) -> Advance {
        match self {
            Self::Identity { told: true, .. } => Advance::Done,
            Self::Identity { object, expected, tolerated, told } => {
                let result = identity(*object, *expected, answer);
                if let Advance::Failed(other @ BootFailure::Identity { .. }) = &result
                    && *tolerated
                {
                    *told = true;
                    return Advance::Tell(BootEvent::OtherDevice(other.clone()));
                }
                result
            }
            Self::Read { object, told } => read(*object, told, answer),
            Self::Write(write) => write.advance(answer),
            Self::Errors(errors) => errors.advance(answer),
            Self::Pdo(task) => task.advance(answer, may_run),
            Self::Save { needed } => match answer {
                None if *needed => Advance::Ask(SdoRequest::write(STORE, SAVE.to_vec())),
                None | Some(Ok(_)) => Advance::Done,
                Some(Err(error)) => Advance::failed(STORE, error),
            },
        }
    }
}

fn identity(object: ObjectId, expected: u32, answer: Answer) -> Advance {
    let data = match answer {
        None => return Advance::Ask(SdoRequest::read(object).of_len(4)),
        Some(Err(error)) => return Advance::failed(object, error),
        Some(Ok(data)) => data,
    };
    let Ok(bytes) = <[u8; 4]>::try_from(data.as_slice()) else {
        return Advance::Failed(BootFailure::Length { object, length: data.len() });
    };
    let found = u32::from_le_bytes(bytes);
    if found == expected {
        return Advance::Done;
    }
    let letter = match (object, object.sub) {
        (DEVICE_TYPE, _) => 'C',
        (_, 1) => 'D',
        (_, 2) => 'M',
        (_, 3) => 'N',
        (..) => 'O',
    };
    Advance::Failed(BootFailure::Identity { object, expected, found, letter })
}

fn read(object: ObjectId, told: &mut bool, answer: Answer) -> Advance {
    let data = match answer {
        None if *told => return Advance::Done,
        None => return Advance::Ask(SdoRequest::read(object)),
        Some(Ok(data)) => Some(data),
        Some(Err(SdoError::Abort(_))) => None,
        Some(Err(error)) => return Advance::failed(object, error),
    };
    *told = true;
    Advance::Tell(BootEvent::Object { object, data })
}

impl Errors {
    fn advance(&mut self, answer: Answer) -> Advance {
        let object = if matches!(self, Self::Register) { ERROR_REGISTER } else { NEWEST_ERROR };
        let data = match answer {
            Some(Ok(data)) => Some(data),
            Some(Err(SdoError::Abort(_))) | None => None,
            Some(Err(error)) => return Advance::failed(object, error),
        };
        match *self {
            Self::Begin => {
                *self = Self::Register;
                Advance::Ask(SdoRequest::read(ERROR_REGISTER))
            }
            Self::Register => {
                *self = Self::Newest { register: data.and_then(|data| data.first().copied()) };
                Advance::Ask(SdoRequest::read(NEWEST_ERROR))
            }
            Self::Newest { register } => {
                *self = Self::Told;
                // R-DST-080: the code is in the lower half.
                let code = match data.as_deref() {
                    Some([low, high, ..]) => u16::from_le_bytes([*low, *high]),
                    Some(_) | None => 0,
                };
                Advance::Tell(BootEvent::Errors { register, code })
            }
            Self::Told => Advance::Done,
        }
    }
}

impl Write {
    fn advance(&mut self, answer: Answer) -> Advance {
        let object = self.object;
        match (self.phase, answer) {
            (WritePhase::Begin, _) => {
                self.phase = WritePhase::Compare;
                Advance::Ask(SdoRequest::read(object).of_len(self.data.len()))
            }
            (WritePhase::Compare, Some(Ok(data))) if data == self.data => Advance::Done,
            // What cannot be read can still be written, but then it is written at each boot.
            (WritePhase::Compare, Some(result @ (Ok(_) | Err(SdoError::Abort(_))))) => {
                self.phase = WritePhase::Write { readable: result.is_ok() };
                Advance::Ask(SdoRequest::write(object, self.data.clone()).repeatable())
            }
            (WritePhase::Write { readable: true }, Some(Ok(_))) => {
                self.phase = WritePhase::Verify;
                Advance::Ask(SdoRequest::read(object).of_len(self.data.len()))
            }
            (WritePhase::Write { .. }, Some(Ok(_))) => self.written(),
            (WritePhase::Write { .. }, Some(Err(error @ SdoError::Abort(_)))) if self.optional => {
                self.phase = WritePhase::Refused;
                Advance::Tell(BootEvent::Refused { object, error })
            }
            (WritePhase::Verify, Some(Ok(data))) if data == self.data => self.written(),
            (WritePhase::Verify, Some(Ok(_))) => Advance::Failed(BootFailure::NotKept { object }),
            (_, Some(Err(error))) => Advance::failed(object, error),
            (_, Some(Ok(_)) | None) => Advance::Done,
        }
    }

    fn written(&mut self) -> Advance {
        self.phase = WritePhase::Written;
        Advance::Wrote(self.object)
    }
}
