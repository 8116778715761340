//! `cangate check FILE...`: everything that is wrong with configuration and mapping files \[IO\].

use std::ffi::OsString;
use std::fmt;
use std::path::{Path, PathBuf};

use super::args::CheckArguments;
use super::output::{print_error, print_line, print_text};
use super::{Exit, check_files, load};
use crate::config;
use crate::mapping::{Diagnostic, Severity, SourceText, check_mapping, is_mapping};
use crate::supervisor::Plan;

/// What came of checking some files. Shown, it is one message after the other and a last line that counts them.
#[derive(Clone, Debug, Default)]
pub struct Report {
    /// Errors and warnings, file by file.
    pub problems: Vec<Diagnostic>,
    /// Files that were looked at.
    pub files: usize,
    /// One of them could not be read.
    pub unreadable: bool,
}

impl Report {
    /// Whether there is an error.
    #[must_use]
    pub fn has_errors(&self) -> bool {
        self.count(Severity::Error) > 0
    }

    /// 74 when a file could not be read, for then not all was checked; 78 when there is an error.
    #[must_use]
    pub fn exit(&self) -> Exit {
        match (self.unreadable, self.has_errors()) {
            (true, _) => Exit::Io,
            (false, true) => Exit::Configuration,
            (false, false) => Exit::Ok,
        }
    }

    fn count(&self, severity: Severity) -> usize {
        self.problems.iter().filter(|problem| problem.severity == severity).count()
    }
}

impl fmt::Display for Report {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        for problem in &self.problems {
            writeln!(f, "{problem}")?;
        }
        let counted =
            |count: usize, what: &str| format!("{count} {what}{}", if count == 1 { "" } else { "s" });
        let (errors, warnings) = (self.count(Severity::Error), self.count(Severity::Warning));
        let files = counted(self.files, "file");
        match (errors, warnings) {
            (0, 0) => write!(f, "{files} checked, nothing to complain about"),
            _ => write!(f, "{files} checked: {}, {}", counted(errors, "error"), counted(warnings, "warning")),
        }
    }
}

/// Prints the report: on standard output when all is well, on standard error when not.
pub(super) fn run(arguments: &CheckArguments) -> Exit {
    if let Some(running) = &arguments.against {
        return against(running, &arguments.files).unwrap_or_else(|exit| exit);
    }
    let variables: Vec<(OsString, OsString)> = std::env::vars_os().collect();
    let report = check(&arguments.files, &variables);
    if report.problems.is_empty() {
        print_line(&report.to_string());
    } else {
        print_text(&report.to_string());
    }
    report.exit()
}

/// Prints what a reload would change.
fn against(running: &Path, files: &[PathBuf]) -> Result<Exit, Exit> {
    let [file] = files else {
        print_error("--against compares with one configuration file");
        return Err(Exit::Usage);
    };
    let (old, new) = (load::installation(running)?, load::installation(file)?);
    let plan = Plan::new(&old, &new);
    if plan.is_empty() {
        print_line("nothing changes");
    }
    for line in &plan.lines {
        print_line(line);
    }
    if plan.map_breaks.is_empty() || new.reload.allow_map_change {
        return Ok(Exit::Ok);
    }
    print_line("a reload refuses this: published addresses change; see `allow_map_change` under [gateway]");
    Ok(Exit::Different)
}

/// Checks configuration files (with the mappings that they use, and the environment's `CANGATE__` variables over them) and
/// mapping files, told apart by their content.
#[must_use]
pub fn check(files: &[PathBuf], variables: &[(OsString, OsString)]) -> Report {
    let mut report = Report { files: files.len(), ..Report::default() };
    for file in files {
        let name = file.display().to_string();
        match std::fs::read_to_string(file) {
            Ok(text) => report.problems.extend(check_text(&SourceText::new(name, text), variables)),
            Err(error) => {
                let hint = "give the name of a configuration or mapping file";
                let message = format!("cannot read this file: {error}");
                report.problems.push(Diagnostic::without_place(name, message, hint));
                report.unreadable = true;
            }
        }
    }
    report
}

fn check_text(source: &SourceText, variables: &[(OsString, OsString)]) -> Vec<Diagnostic> {
    let found = if is_mapping(source) {
        check_mapping(source)
    } else {
        let mut read_file = |path: &str| std::fs::read_to_string(path);
        config::load(source, variables.iter().cloned(), &mut read_file).map(|loaded| {
            let files = check_files::check(source, &loaded.settings);
            loaded.warnings.into_iter().chain(files).collect()
        })
    };
    found.unwrap_or_else(|problems| problems)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn folder(files: &[(&str, &str)]) -> (tempfile::TempDir, Vec<PathBuf>) {
        let folder = tempfile::tempdir().unwrap();
        let paths = files
            .iter()
            .map(|(name, text)| {
                let path = folder.path().join(name);
                std::fs::create_dir_all(path.parent().unwrap()).unwrap();
                std::fs::write(&path, text).unwrap();
                path
            })
            .collect();
        (folder, paths)
    }

    const CONFIG: &str =
        "version = 1\n[bus.can0]\ninterface = 'virtual:x'\n[node.a]\nbus = 'can0'\nid = 1\nmapping = 'own'\n";

    #[test]
    fn configuration_and_mapping_files_are_told_apart_and_checked() {
        let mapping = crate::mapping::shipped("motortech-detcon").unwrap();
        let (_folder, paths) = folder(&[("cangate.toml", CONFIG), ("mappings/own.toml", mapping)]);
        let report = check(&paths, &[]);
        assert!(!report.has_errors(), "{report}");
        assert_eq!(report.to_string(), "2 files checked, nothing to complain about");
    }

    #[test]
    fn all_problems_of_all_files_are_told() {
        let mapping = "format = 1\n[device]\nvendor = 'x'\n";
        let (folder, mut paths) = folder(&[("cangate.toml", CONFIG), ("mappings/own.toml", mapping)]);
        paths.push(folder.path().join("none.toml"));
        let report = check(&paths, &[("CANGATE__X__Y".into(), "1".into())]);
        assert_eq!(report.exit(), Exit::Io, "not all could be checked");
        assert_eq!(check(&paths[..2], &[]).exit(), Exit::Configuration);
        let text = report.to_string();
        assert!(text.contains("CANGATE__X__Y"), "{text}");
        assert!(text.contains("own.toml:2:1: error: key `model` is missing"), "{text}");
        assert!(text.contains("none.toml: error: cannot read this file"), "{text}");
        assert!(text.ends_with("3 files checked: 4 errors, 0 warnings"), "{text}");
    }
}
