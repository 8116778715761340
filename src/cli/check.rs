//! `cangate check FILE...`: everything that is wrong with configuration and mapping files \[IO\].

use std::fmt;
use std::path::{Path, PathBuf};

use super::Exit;
use super::args::CheckArguments;
use super::output::{print_line, print_text};
use crate::config;
use crate::mapping::{Diagnostic, Severity, SourceText, check_mapping, is_mapping};

/// What came of checking some files. Shown, it is one message after the other and a last line that counts them.
#[derive(Clone, Debug, Default)]
pub struct Report {
    /// Errors and warnings, file by file.
    pub problems: Vec<Diagnostic>,
    /// Files that were looked at.
    pub files: usize,
}

impl Report {
    /// Whether there is an error: the exit code is then 78.
    #[must_use]
    pub fn has_errors(&self) -> bool {
        self.count(Severity::Error) > 0
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
    let variables: Vec<(String, String)> = std::env::vars().collect();
    let report = check(&arguments.files, &variables);
    if report.problems.is_empty() {
        print_line(&report.to_string());
    } else {
        print_text(&report.to_string());
    }
    if report.has_errors() { Exit::Configuration } else { Exit::Ok }
}

/// Checks configuration files (with the mappings that they use, and the environment's `CANGATE__` variables over them) and
/// mapping files, told apart by their content.
#[must_use]
pub fn check(files: &[PathBuf], variables: &[(String, String)]) -> Report {
    let problems = files.iter().flat_map(|file| check_file(file, variables)).collect();
    Report { problems, files: files.len() }
}

fn check_file(file: &Path, variables: &[(String, String)]) -> Vec<Diagnostic> {
    let name = file.display().to_string();
    let source = match std::fs::read_to_string(file) {
        Ok(text) => SourceText::new(name, text),
        Err(error) => {
            let hint = "give the name of a configuration or mapping file";
            return vec![SourceText::new(name, "").error(
                &(0..0),
                format!("cannot read this file: {error}"),
                hint,
            )];
        }
    };
    let found = if is_mapping(&source) {
        check_mapping(&source)
    } else {
        let mut read_file = |path: &str| std::fs::read_to_string(path);
        config::load(&source, variables.iter().cloned(), &mut read_file).map(|loaded| loaded.warnings)
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
        let report = check(&paths, &[("CANGATE__X__Y".to_owned(), "1".to_owned())]);
        assert!(report.has_errors());
        let text = report.to_string();
        assert!(text.contains("CANGATE__X__Y"), "{text}");
        assert!(text.contains("own.toml:2:1: error: key `model` is missing"), "{text}");
        assert!(text.contains("none.toml:1:1: error: cannot read this file"), "{text}");
        assert!(text.ends_with("3 files checked: 4 errors, 0 warnings"), "{text}");
    }
}
