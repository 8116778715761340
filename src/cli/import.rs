//! `cangate import FILE.eds`: a device mapping from an EDS or DCF. \[IO\]

use std::fmt;
use std::io;
use std::path::Path;

use super::args::ImportArguments;
use super::output::{print_diagnostics, print_error, print_text, write_out};
use super::{Exit, eds_files};
use crate::mapping::SourceText;
use crate::mapping::eds::{self, Eds, Imported};

/// Writes the mapping, to standard output or to a file, which is updated if it is there already; warnings and a summary go
/// to standard error.
pub(super) fn run(arguments: &ImportArguments) -> Exit {
    if arguments.list {
        return eds_files::list(&arguments.file).err().unwrap_or(Exit::Ok);
    }
    let output = arguments.output.as_deref();
    match make(&arguments.file, output) {
        Ok(made) => {
            let exit = match output {
                Some(file) if made.is_unchanged => {
                    print_text(&format!("{} stays as it is", file.display()));
                    Exit::Ok
                }
                Some(file) => replace(&made.imported.text, file),
                None => write_out(&made.imported.text, None),
            };
            if exit == Exit::Ok {
                print_text(&made.to_string());
            }
            exit
        }
        Err(exit) => exit,
    }
}

/// What came of an import.
struct Made {
    eds: Eds,
    imported: Imported,
    warnings: usize,
    is_unchanged: bool,
}

impl fmt::Display for Made {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let counted =
            |count: usize, what: &str| format!("{count} {what}{}", if count == 1 { "" } else { "s" });
        let Imported { tpdos, tags, settings, registers_used, bits_used, .. } = self.imported;
        write!(f, "{}: {}, {}", self.eds.file, counted(tpdos, "TPDO"), counted(tags, "tag"))?;
        if registers_used > 0 {
            write!(f, ", registers up to {}", registers_used - 1)?;
        }
        if bits_used > 0 {
            write!(f, ", bits up to {}", bits_used - 1)?;
        }
        if settings > 0 {
            write!(f, ", {}", counted(settings, "setting"))?;
        }
        write!(f, ", {}", counted(self.warnings, "warning"))?;
        if let Some(id) = self.eds.node_id {
            write!(f, "\nit is configured as node {id}: [node.NAME] id = {id}")?;
        }
        if let Some(rate) = self.eds.bit_rate {
            write!(f, "\nit is configured for {rate} bit/s: [bus.NAME] bit_rate = {rate}")?;
        }
        Ok(())
    }
}

fn make(file: &Path, output: Option<&Path>) -> Result<Made, Exit> {
    let bytes = std::fs::read(file).map_err(|error| cannot_read(file, &error))?;
    let previous = match output.map(|output| (output, std::fs::read_to_string(output))) {
        Some((output, Ok(text))) => Some(SourceText::new(output.display().to_string(), text)),
        Some((output, Err(error))) if error.kind() != io::ErrorKind::NotFound => {
            return Err(cannot_read(output, &error));
        }
        Some((_, Err(_))) | None => None,
    };
    let told = |problems: Vec<_>| {
        print_diagnostics(&problems);
        Exit::Configuration
    };
    let (eds, warnings) = eds::read(&file.display().to_string(), &bytes).map_err(told)?;
    print_diagnostics(&warnings);
    let imported = eds::import(&eds, previous.as_ref()).map_err(told)?;
    print_diagnostics(&imported.warnings);
    Ok(Made {
        is_unchanged: previous.is_some_and(|previous| previous.text == imported.text),
        warnings: warnings.len() + imported.warnings.len(),
        eds,
        imported,
    })
}

fn cannot_read(file: &Path, error: &io::Error) -> Exit {
    print_error(&format!("cannot read {}: {error}", file.display()));
    Exit::Io
}

/// Writes a file beside the old one and puts it in its place, so that what was written by hand is not lost half-way.
fn replace(text: &str, file: &Path) -> Exit {
    let mut beside = file.as_os_str().to_owned();
    beside.push(".new");
    let beside = Path::new(&beside);
    match std::fs::write(beside, text).and_then(|()| std::fs::rename(beside, file)) {
        Ok(()) => Exit::Ok,
        Err(error) => {
            print_error(&format!("cannot write {}: {error}", file.display()));
            Exit::Io
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const EDS: &str = "[DeviceInfo]\nVendorName=V\nProductName=P\n[DeviceComissioning]\nNodeID=5\nBaudrate=250\n\
        [1800]\nParameterName=c\nObjectType=9\n[1800sub1]\nDataType=7\nAccessType=rw\nDefaultValue=$NODEID+0x180\n\
        [1A00]\nParameterName=m\nObjectType=9\n[1A00sub1]\nDataType=7\nAccessType=rw\nDefaultValue=0x64010110\n\
        [6401]\nParameterName=Level\nObjectType=8\n[6401sub1]\nParameterName=Tank\nDataType=6\nAccessType=ro\n";

    fn arguments(folder: &Path, eds: &[u8]) -> ImportArguments {
        let file = folder.join("a.eds");
        std::fs::write(&file, eds).unwrap();
        ImportArguments { file, output: Some(folder.join("a.toml")), list: false }
    }

    #[test]
    fn a_mapping_is_written_and_updated_in_place() {
        let folder = tempfile::tempdir().unwrap();
        let arguments = arguments(folder.path(), EDS.as_bytes());
        let output = arguments.output.clone().unwrap();
        assert_eq!(run(&arguments), Exit::Ok);
        let first = std::fs::read_to_string(&output).unwrap();
        assert!(first.contains("name = \"level_tank\""), "{first}");
        let own = first.replace("unit = \"\"", "unit = \"m\"") + "\n# mine\n";
        std::fs::write(&output, &own).unwrap();
        assert_eq!(run(&arguments), Exit::Ok);
        assert_eq!(std::fs::read_to_string(&output).unwrap(), own);
        assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 2, "nothing is left beside it");
    }

    #[test]
    fn the_summary_counts_and_tells_what_a_dcf_says_of_its_node() {
        let folder = tempfile::tempdir().unwrap();
        let arguments = arguments(folder.path(), EDS.as_bytes());
        let mut made = make(&arguments.file, None).ok().unwrap();
        made.eds.file = "a.eds".to_owned();
        assert_eq!(
            made.to_string(),
            "a.eds: 1 TPDO, 1 tag, registers up to 100, 0 warnings\n\
             it is configured as node 5: [node.NAME] id = 5\n\
             it is configured for 250000 bit/s: [bus.NAME] bit_rate = 250000"
        );
    }

    #[test]
    fn exit_codes_tell_an_unreadable_file_from_a_malformed_one() {
        let folder = tempfile::tempdir().unwrap();
        let good = arguments(folder.path(), EDS.as_bytes());
        let none = ImportArguments { file: folder.path().join("none.eds"), output: None, list: false };
        assert_eq!(run(&none), Exit::Io);
        std::fs::write(good.output.as_ref().unwrap(), "format = 1\n").unwrap();
        assert_eq!(run(&good), Exit::Configuration, "a mapping that import did not write");
        assert_eq!(std::fs::read_to_string(good.output.as_ref().unwrap()).unwrap(), "format = 1\n");
        let nowhere = ImportArguments { output: Some(folder.path().join("no/where.toml")), ..good };
        assert_eq!(run(&nowhere), Exit::Io);
        assert_eq!(run(&arguments(folder.path(), b"no EDS")), Exit::Configuration);
    }
}
