//! Reads the configuration and its mapping files, and says what is wrong with them. \[IO\]

use std::ffi::OsString;
use std::path::Path;
use std::sync::Arc;

use super::Exit;
use super::output::{print_diagnostics, print_error, read_file};
use crate::config::{self, Loaded};
use crate::mapping::SourceText;
use crate::modbus::RegisterMap;
use crate::supervisor::Installation;

/// What a configuration file says, checked; warnings are printed. Else everything that is wrong is printed.
pub(super) fn configuration(file: &Path) -> Result<Loaded, Exit> {
    let source = SourceText::new(file.display().to_string(), read_file(file)?);
    load(&source, std::env::vars_os())
}

/// The same, made into what the supervisor starts.
pub(super) fn installation(file: &Path) -> Result<Installation, Exit> {
    to_installation(configuration(file)?)
}

/// An installation from a text inside the program; the environment does not change it.
pub(super) fn installation_from_text(text: &str, name: &str) -> Result<Installation, Exit> {
    to_installation(load(&SourceText::new(name, text), [])?)
}

/// The register map of a configuration.
pub(super) fn register_map(loaded: &Loaded) -> Result<RegisterMap, Exit> {
    let base_topic = loaded.settings.mqtt.clone().unwrap_or_default().base_topic;
    RegisterMap::build(&loaded.table, &loaded.settings.modbus, base_topic.as_str()).map_err(|error| {
        print_error(&error.to_string());
        Exit::Configuration
    })
}

fn load(
    source: &SourceText,
    variables: impl IntoIterator<Item = (OsString, OsString)>,
) -> Result<Loaded, Exit> {
    let loaded = config::load(source, variables, &mut |path| std::fs::read_to_string(path));
    match loaded {
        Ok(loaded) => {
            print_diagnostics(&loaded.warnings);
            Ok(loaded)
        }
        Err(problems) => {
            print_diagnostics(&problems);
            Err(Exit::Configuration)
        }
    }
}

fn to_installation(loaded: Loaded) -> Result<Installation, Exit> {
    let map = Arc::new(register_map(&loaded)?);
    let Loaded { settings, interfaces, table, warnings: _ } = loaded;
    Ok(Installation {
        table: Arc::new(table),
        interfaces,
        map,
        modbus: settings.modbus,
        mqtt: settings.mqtt,
        http: settings.http,
        cia309: settings.cia309,
    })
}
