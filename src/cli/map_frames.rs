//! `cangate map --frames`: every frame that a configuration lets the gateway send. \[IO\]

use serde::Serialize;

use super::Exit;
use super::output::print_error;
use crate::gateway::allowed_frames::{AllowedFrame, AllowedFrames};
use crate::mapping::TagTable;
use crate::modbus::MapFormat;

/// One line of the list.
#[derive(Serialize)]
struct Row {
    bus: String,
    /// In hexadecimal: three digits for 11 bits, eight for 29.
    id: String,
    kind: &'static str,
    /// Empty: everybody.
    node: String,
    /// As candump writes it, or in words.
    data: String,
    at_most: String,
    why: String,
}

const HEADINGS: [&str; 7] = ["bus", "id", "kind", "node", "data", "at_most", "why"];

impl Row {
    fn new(table: &TagTable, frame: &AllowedFrame) -> Self {
        Self {
            bus: table.buses.get(frame.bus.0).map(|bus| bus.name.clone()).unwrap_or_default(),
            id: frame.id.to_string(),
            kind: frame.kind.word(),
            node: frame
                .node
                .and_then(|node| table.node(node))
                .map(|node| node.name.clone())
                .unwrap_or_default(),
            data: frame.shape.to_string(),
            at_most: frame.at_most.clone(),
            why: frame.why.clone(),
        }
    }

    fn cells(&self) -> [&str; 7] {
        [&self.bus, &self.id, self.kind, &self.node, &self.data, &self.at_most, &self.why]
    }
}

/// The list as a text that ends with a line feed.
pub(super) fn text(table: &TagTable, format: MapFormat) -> Result<String, Exit> {
    let allowed = AllowedFrames::new(table);
    let rows: Vec<Row> = allowed.list().iter().map(|frame| Row::new(table, frame)).collect();
    match format {
        MapFormat::Table => Ok(terminal(&rows)),
        MapFormat::Csv => Ok(csv(&rows)),
        MapFormat::Json => Ok(json(&rows)),
        MapFormat::Md | MapFormat::St => {
            print_error("the list of frames is written as table, csv or json");
            Err(Exit::Usage)
        }
    }
}

fn terminal(rows: &[Row]) -> String {
    if rows.is_empty() {
        return "nothing is sent: there is no node, or every bus is passive\n".to_owned();
    }
    let headings = ["Bus", "Id", "Kind", "Node", "Data", "At most", "Why"];
    let lines: Vec<[&str; 7]> = std::iter::once(headings).chain(rows.iter().map(Row::cells)).collect();
    let width = |column: usize| {
        lines.iter().filter_map(|line| line.get(column)).map(|cell| cell.chars().count()).max()
    };
    let widths: Vec<usize> = (0..HEADINGS.len()).map(|column| width(column).unwrap_or_default()).collect();
    let mut text = String::new();
    for line in &lines {
        let cells: Vec<String> =
            line.iter().zip(&widths).map(|(cell, width)| format!("{cell:width$}")).collect();
        text.push_str(cells.join("  ").trim_end());
        text.push('\n');
    }
    text
}

fn csv(rows: &[Row]) -> String {
    let mut text = HEADINGS.join(",") + "\n";
    for row in rows {
        // No cell has a quotation mark or a line feed; words have commas.
        let cells =
            row.cells().map(|cell| if cell.contains(',') { format!("\"{cell}\"") } else { cell.to_owned() });
        text.push_str(&cells.join(","));
        text.push('\n');
    }
    text
}

/// One frame to a line, so that two lists can be compared as texts.
fn json(rows: &[Row]) -> String {
    // Plain structs of texts: there is nothing that could not be written.
    let lines: Vec<String> = rows.iter().map(|row| serde_json::to_string(row).unwrap_or_default()).collect();
    format!("{{\"frames\":[\n{}\n]}}\n", lines.join(",\n"))
}
