//! `cangate dcf`: a DCF for each node of a configuration, from its EDS. \[IO\]

use std::path::Path;

use super::args::DcfArguments;
use super::eds_files::{EdsFile, eds_files};
use super::output::{print_diagnostics, print_error, print_text, write_bytes};
use super::{Exit, load};
use crate::canopen::boot::BootStep;
use crate::canopen::object::ObjectId;
use crate::mapping::eds::{Commissioning, Eds, Object, dcf};
use crate::mapping::{NodeDef, TagTable};

/// Writes the DCF of one node to standard output, or of several into a folder.
pub(super) fn run(arguments: &DcfArguments) -> Exit {
    write(arguments).err().unwrap_or(Exit::Ok)
}

fn write(arguments: &DcfArguments) -> Result<(), Exit> {
    let table = load::configuration(&arguments.config)?.table;
    let nodes = chosen(&table, &arguments.nodes)?;
    if nodes.len() > 1 && arguments.output.is_none() {
        print_error("there are several nodes: name one, or a folder with -o");
        return Err(Exit::Usage);
    }
    let mut files = Vec::new();
    for path in &arguments.eds {
        let (found, unreadable) = eds_files(path)?;
        files.extend(found);
        // In a folder there may be anything; what no node needs does no harm.
        if unreadable > 0 && !path.is_dir() {
            return Err(Exit::Configuration);
        }
    }
    let mut missing = Vec::new();
    for node in &nodes {
        // Somebody who names one node and one file means them.
        let is_meant = arguments.nodes.len() == 1 && files.len() == 1;
        let fitting = best(node, &files).or(files.first().filter(|_| is_meant));
        match fitting {
            Some(file) => write_one(&table, node, file, arguments.output.as_deref())?,
            None => missing.push(format!("`{}` ({} {})", node.name, node.device.vendor, node.device.model)),
        }
    }
    if missing.is_empty() {
        return Ok(());
    }
    print_error(&format!("no EDS is of the device of {}", missing.join(", ")));
    Err(Exit::Configuration)
}

/// The nodes that were named, or all.
fn chosen<'a>(table: &'a TagTable, names: &[String]) -> Result<Vec<&'a NodeDef>, Exit> {
    if names.is_empty() {
        return Ok(table.nodes.iter().filter(|node| node.canopen().is_some()).collect());
    }
    let find = |name: &String| {
        table.nodes.iter().find(|node| node.name == *name).ok_or_else(|| {
            print_error(&format!("there is no node `{name}` in this configuration"));
            Exit::Usage
        })
    };
    names.iter().map(find).collect()
}

/// The file of a node's device: an EDS rather than a DCF, which has values of its own, and of those that of the node itself.
fn best<'a>(node: &NodeDef, files: &'a [EdsFile]) -> Option<&'a EdsFile> {
    let own = node.canopen().map(|settings| settings.id.get());
    let rank = |file: &EdsFile| (file.eds.node_id.is_some(), file.eds.node_id != own);
    files.iter().filter(|file| fits(node, &file.eds)).min_by_key(|file| rank(file))
}

/// Whether an EDS is of the device of a node: by the numbers of maker and product where both have them, else by their names.
fn fits(node: &NodeDef, eds: &Eds) -> bool {
    let identity = |sub| {
        let object = ObjectId::new(0x1018, sub);
        node.canopen()?.boot.steps.iter().find_map(|step| match step {
            BootStep::Identity { object: found, expected, .. } if *found == object => Some(*expected),
            BootStep::Identity { .. }
            | BootStep::Read { .. }
            | BootStep::Write { .. }
            | BootStep::Errors
            | BootStep::Pdo(_)
            | BootStep::Rpdo(_)
            | BootStep::Save => None,
        })
    };
    let said = |sub, number: Option<u32>| {
        let object = eds.objects.get(&ObjectId::new(0x1018, sub)).and_then(Object::number);
        let object = object.and_then(|number| u32::try_from(number.base).ok());
        object.or(number).filter(|number| *number != 0)
    };
    let vendor = identity(1).zip(said(1, eds.device.vendor_number));
    let product = identity(2).zip(said(2, eds.device.product_number));
    match (vendor, product) {
        (Some((vendor, its)), Some((product, its_product))) => vendor == its && product == its_product,
        _ => node.device.vendor == eds.device.vendor_name && node.device.model == eds.device.product_name,
    }
}

fn write_one(table: &TagTable, node: &NodeDef, file: &EdsFile, folder: Option<&Path>) -> Result<(), Exit> {
    let (Some(bus), Some(settings)) = (table.buses.get(node.bus.0), node.canopen()) else {
        print_error(&format!("`{}` is no CANopen device, so it has no DCF", node.name));
        return Err(Exit::Usage);
    };
    let name = format!("{}.dcf", node.name);
    let commissioning =
        Commissioning { name: &node.name, network: &bus.name, bit_rate: bus.bit_rate, settings };
    let (bytes, warnings) = dcf(&file.eds, &file.bytes, &name, commissioning).map_err(|problems| {
        print_diagnostics(&problems);
        Exit::Configuration
    })?;
    print_diagnostics(&warnings);
    let output = folder.map(|folder| folder.join(&name));
    let canonical = |path: &Path| path.canonicalize().ok();
    let is_source = |output: &Path| canonical(output).is_some_and(|it| canonical(&file.path) == Some(it));
    if output.as_deref().is_some_and(is_source) {
        print_error(&format!("{} is what it would be made from; give another folder", file.path.display()));
        return Err(Exit::Io);
    }
    let exit = write_bytes(&bytes, output.as_deref());
    if exit != Exit::Ok {
        return Err(exit);
    }
    if let Some(output) = output {
        print_text(&format!("{} from {}", output.display(), file.path.display()));
    }
    Ok(())
}
