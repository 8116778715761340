//! Device mappings: what the bytes of a device mean, where they stand in the register map, when to raise an alarm.
//!
//! Reads text, opens no file. From the mapping files and the installation's buses and nodes it makes one checked,
//! resolved, immutable [`TagTable`], or a list of [`Diagnostic`]s, all at once, each with file, line, column and hint.
//!
//! - [`file`](mod@file): the TOML form of a mapping, as `mappings/README.md` teaches it. [`shipped`](mod@shipped): those that come
//!   with the program.
//! - [`installation`]: the `[bus.*]` and `[node.*]` tables of the configuration.
//! - [`build`](mod@build): from both to the tag table, or to everything that is wrong.
//! - [`builtin`]: the alarms that every gateway, bus and node has.
//! - [`table`]: the result.
//! - [`eds`]: mappings made from EDS and DCF files.
//! - [`expression`]: conditions on tags; [`expression_parser`] reads them.
//! - [`objection`]: why a value should not be used as it stands.
//! - [`unit`](mod@unit): physical units that devices tell, and the way from one to another.
//! - [`codec`]: raw bits to values, values to registers.
//! - [`fingerprint`]: which mapping fits a node that was only overheard.
//! - [`diagnostic`]: messages about files. [`reader`]: strict TOML; [`At`]: a value and its place; [`suggest`]: "did you mean".

mod at;
pub mod build;
pub mod builtin;
pub mod codec;
pub mod diagnostic;
pub mod eds;
pub mod expression;
pub mod expression_parser;
pub mod file;
pub mod fingerprint;
pub mod installation;
pub mod objection;
mod offset;
pub mod reader;
pub mod shipped;
pub mod suggest;
pub mod table;
#[cfg(test)]
pub mod testing;
pub mod unit;

pub use at::At;
pub use build::{Installation, Sketch, build, check_mapping, is_name, share_port, sort_problems};
pub use diagnostic::{Diagnostic, Severity, SourceText};
pub use expression::Expression;
pub use objection::Objection;
pub use reader::{is_mapping, locate};
pub use shipped::shipped;
pub use table::{
    AlarmCondition, AlarmDef, AlarmOwner, BuiltIn, BusDef, DEVICE_UNIT, Derived, DeviceDef, DeviceUnit,
    EmergencyDef, EmergencyPart, Encoding, ErrorDef, EsdBusDef, Field, FieldKind, LineDef, LineEncoding,
    LineMqtt, LineTcp, LineText, LineValue, ModuleCarrier, ModuleValue, NodeDef, OnLoss, Protocol,
    PublishDef, ReadOnly, Reading, RegisterDef, RpdoDef, Scale, Source, Space, TagDef, TagTable, Told,
    WriteLimits, Writing,
};

/// JSON Schema of a device mapping, for editors.
#[must_use]
pub fn schema() -> serde_json::Value {
    schemars::schema_for!(file::MappingFile).to_value()
}
