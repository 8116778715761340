//! Tag tables for tests.

use super::{Sketch, TagTable};

/// One bus `can0` with a DetCon of each name, in the order of their names, with node ids 1, 2, 3 and so on.
///
/// # Panics
///
/// Where the shipped mapping has a problem.
#[must_use]
pub fn detcon(nodes: &[&str]) -> TagTable {
    let mut nodes = nodes.to_vec();
    nodes.sort_unstable();
    let sketch = (1..)
        .zip(nodes)
        .fold(Sketch::new(), |sketch, (id, name)| sketch.node(name, id, "motortech-detcon", |_| ()));
    let (table, warnings) = sketch.build().unwrap();
    assert_eq!(warnings, []);
    table
}
