//! `cangate schema config|mapping`: JSON Schema of the files, for editors. \[IO\]

use super::Exit;
use super::args::SchemaArguments;
use super::output::write_out;

/// Which file.
#[derive(Clone, Copy, Debug, PartialEq, Eq, clap::ValueEnum)]
pub enum Schema {
    /// The configuration.
    Config,
    /// A device mapping.
    Mapping,
}

/// Prints the schema.
pub(super) fn run(arguments: &SchemaArguments) -> Exit {
    write_out(&format!("{}\n", schema(arguments.of)), None)
}

/// The schema as indented JSON.
#[must_use]
pub fn schema(which: Schema) -> String {
    let schema = match which {
        Schema::Config => crate::config::schema(),
        Schema::Mapping => crate::mapping::schema(),
    };
    format!("{schema:#}")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn both_schemas_are_json_that_names_their_keys() {
        for (which, key) in [(Schema::Config, "gateway"), (Schema::Mapping, "tpdo")] {
            let value: serde_json::Value = serde_json::from_str(&schema(which)).unwrap();
            assert!(value["properties"][key].is_object());
            assert_eq!(value["additionalProperties"], false);
        }
    }
}
