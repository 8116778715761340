//! Reads the configuration and its mapping files, and says what is wrong with them. \[IO\]

use std::collections::BTreeMap;
use std::ffi::OsString;
use std::io;
use std::path::Path;
use std::sync::Arc;

use super::Exit;
use super::output::{print_diagnostics, print_error, read_file};
use crate::config::{self, GatewaySettings, Loaded};
use crate::mapping::SourceText;
use crate::modbus::writing::Writable;
use crate::modbus::{MapError, RegisterMap};
use crate::supervisor::wiring::ReloadSettings;
use crate::supervisor::{Fresh, Installation, Refusal, Sources};

/// What a configuration file says, checked; warnings are printed. Else everything that is wrong is printed.
pub(super) fn configuration(file: &Path) -> Result<Loaded, Exit> {
    let source = SourceText::new(file.display().to_string(), read_file(file)?);
    load(&source, std::env::vars_os())
}

/// The same, made into what the supervisor starts.
pub(super) fn installation(file: &Path) -> Result<Installation, Exit> {
    to_installation(configuration(file)?)
}

/// A configuration file, to be read again and again; the environment is that of the start.
#[derive(Clone, Debug)]
pub(super) struct Reader {
    file: String,
    variables: Vec<(OsString, OsString)>,
}

impl Reader {
    /// Of this file.
    pub(super) fn new(file: &Path) -> Self {
        Self { file: file.display().to_string(), variables: std::env::vars_os().collect() }
    }

    /// Reads and checks it and its mapping files as they are now. Prints nothing.
    pub(super) fn read(&self) -> Result<Fresh, Refusal> {
        let mut read_file = |path: &str| std::fs::read_to_string(path);
        match read_file(&self.file) {
            Ok(text) => self.check(text, &mut read_file),
            Err(error) => {
                let problem = format!("{}: error: cannot read this file: {error}", self.file);
                Err(Refusal { problems: vec![problem], files: vec![self.file.clone().into()] })
            }
        }
    }

    /// Checks texts that were kept. Those of another file are no substitute for this one.
    pub(super) fn read_kept(&self, kept: &Sources) -> Result<Fresh, Refusal> {
        if kept.name != self.file {
            return Err(Refusal::default());
        }
        let mut read_file = |path: &str| match kept.mappings.get(path) {
            Some(Some(text)) => Ok(text.clone()),
            Some(None) | None => Err(io::ErrorKind::NotFound.into()),
        };
        self.check(kept.text.clone(), &mut read_file)
    }

    fn check(
        &self,
        text: String,
        read_file: &mut dyn FnMut(&str) -> io::Result<String>,
    ) -> Result<Fresh, Refusal> {
        let source = SourceText::new(&self.file, text);
        let mut mappings = BTreeMap::new();
        let mut asked = |path: &str| {
            let read = read_file(path);
            mappings.insert(path.to_owned(), read.as_ref().ok().cloned());
            read
        };
        let loaded = config::load(&source, self.variables.iter().cloned(), &mut asked);
        let sources = Sources { name: source.name, text: source.text, mappings };
        let refuse = |problems| Refusal { problems, files: sources.files() };
        let loaded = loaded.map_err(|problems| refuse(problems.iter().map(ToString::to_string).collect()))?;
        let map = map_of(&loaded).map_err(|error| refuse(vec![format!("{}: error: {error}", self.file)]))?;
        let warnings = loaded.warnings.clone();
        Ok(Fresh { installation: with_map(loaded, map), sources, warnings })
    }
}

/// An installation from a text inside the program; the environment does not change it.
pub(super) fn installation_from_text(text: &str, name: &str) -> Result<Installation, Exit> {
    to_installation(load(&SourceText::new(name, text), [])?)
}

/// The register map of a configuration.
pub(super) fn register_map(loaded: &Loaded) -> Result<RegisterMap, Exit> {
    map_of(loaded).map_err(|error| {
        print_error(&error.to_string());
        Exit::Configuration
    })
}

fn map_of(loaded: &Loaded) -> Result<RegisterMap, MapError> {
    let base_topic = loaded.settings.mqtt.clone().unwrap_or_default().base_topic;
    let writable = Writable::of(&loaded.access);
    RegisterMap::build_for(&loaded.table, &loaded.settings.modbus, base_topic.as_str(), writable)
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
    let map = register_map(&loaded)?;
    Ok(with_map(loaded, map))
}

fn with_map(loaded: Loaded, map: RegisterMap) -> Installation {
    let Loaded { settings, interfaces, table, access, warnings: _ } = loaded;
    let GatewaySettings { reload, allow_map_change, .. } = settings.gateway;
    Installation {
        table: Arc::new(table),
        interfaces,
        map: Arc::new(map),
        modbus: settings.modbus,
        mqtt: settings.mqtt,
        http: settings.http,
        cia309: settings.cia309,
        access: Arc::new(access),
        reload: ReloadSettings { mode: reload, allow_map_change },
    }
}
