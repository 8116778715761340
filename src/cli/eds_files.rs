//! The EDS and DCF files of a folder, and `cangate import --list`. \[IO\]

use std::path::{Path, PathBuf};

use super::Exit;
use super::output::{print_diagnostics, print_error, print_line};
use crate::mapping::eds::{self, Eds, Object, ObjectId};

/// A file that was read.
#[derive(Debug)]
pub(super) struct EdsFile {
    /// Where it is.
    pub(super) path: PathBuf,
    /// As it is.
    pub(super) bytes: Vec<u8>,
    /// What it says.
    pub(super) eds: Eds,
}

/// The files `*.eds` and `*.dcf` of a folder, by their names, or one file; and how many of them are none, which is told with the
/// reason. Oddities are not told: import does.
pub(super) fn eds_files(path: &Path) -> Result<(Vec<EdsFile>, usize), Exit> {
    let (mut files, mut unreadable) = (Vec::new(), 0);
    for path in paths(path)? {
        let bytes = std::fs::read(&path).map_err(|error| cannot_read(&path, &error))?;
        match eds::read(&path.display().to_string(), &bytes) {
            Ok((eds, _)) => files.push(EdsFile { path, bytes, eds }),
            Err(problems) => {
                print_diagnostics(&problems);
                unreadable += 1;
            }
        }
    }
    Ok((files, unreadable))
}

fn paths(path: &Path) -> Result<Vec<PathBuf>, Exit> {
    if !path.is_dir() {
        return Ok(vec![path.to_owned()]);
    }
    let mut paths = Vec::new();
    for entry in std::fs::read_dir(path).map_err(|error| cannot_read(path, &error))? {
        let found = entry.map_err(|error| cannot_read(path, &error))?.path();
        let ending = found.extension().and_then(|ending| ending.to_str()).map(str::to_ascii_lowercase);
        if matches!(ending.as_deref(), Some("eds" | "dcf")) && found.is_file() {
            paths.push(found);
        }
    }
    paths.sort();
    Ok(paths)
}

fn cannot_read(path: &Path, error: &std::io::Error) -> Exit {
    print_error(&format!("cannot read {}: {error}", path.display()));
    Exit::Io
}

/// Prints what devices the files are of (R-ESD-110): 78 where one of them is no EDS, after all others.
pub(super) fn list(path: &Path) -> Result<(), Exit> {
    let (files, unreadable) = eds_files(path)?;
    let mut rows =
        vec![["File", "Vendor", "Product", "Vendor id", "Product code", "Node"].map(str::to_owned)];
    rows.extend(files.iter().map(row));
    let widths: Vec<usize> = (0..6)
        .map(|column| rows.iter().filter_map(|row| row.get(column)).map(|cell| cell.chars().count()).max())
        .map(Option::unwrap_or_default)
        .collect();
    for row in rows {
        let line: Vec<String> =
            row.iter().zip(&widths).map(|(cell, width)| format!("{cell:width$}")).collect();
        if !print_line(line.join("  ").trim_end()) {
            break;
        }
    }
    if unreadable == 0 { Ok(()) } else { Err(Exit::Configuration) }
}

fn row(file: &EdsFile) -> [String; 6] {
    let device = &file.eds.device;
    let identity = |sub, said: Option<u32>| {
        let object = file.eds.objects.get(&ObjectId::new(0x1018, sub)).and_then(Object::number);
        let number = object.map(|number| number.base).filter(|number| *number != 0).or(said.map(i128::from));
        number.map_or_else(|| "-".to_owned(), |number| format!("0x{number:X}"))
    };
    let text = |text: &str| if text.is_empty() { "-".to_owned() } else { text.to_owned() };
    [
        file.path.file_name().unwrap_or_default().display().to_string(),
        text(&device.vendor_name),
        text(&device.product_name),
        identity(1, device.vendor_number),
        identity(2, device.product_number),
        file.eds.node_id.map_or_else(|| "-".to_owned(), |id| id.to_string()),
    ]
}
