//! LSS master (CiA 305): finds devices, gives them node ids and bit rates.
//!
//! - [`types`]: what is asked of it, and what it gives back.

mod types;

pub use types::{
    LssActivation, LssAddress, LssAnswer, LssBitRate, LssChange, LssDuty, LssError, LssJob, LssKnown,
    LssOutput, LssRange, LssSettings, LssState, LssTarget, Performed,
};
