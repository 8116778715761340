//! The mappings that come with the program.

/// Name and text of each, by name.
pub const SHIPPED: &[(&str, &str)] = &[
    ("danfoss-dst-p92c", include_str!("../../mappings/danfoss-dst-p92c.toml")),
    ("esd-can-cbm-sio1", include_str!("../../mappings/esd-can-cbm-sio1.toml")),
    ("esd-can-cbm-sio4", include_str!("../../mappings/esd-can-cbm-sio4.toml")),
    ("motortech-detcon", include_str!("../../mappings/motortech-detcon.toml")),
];

/// The text of a shipped mapping.
#[must_use]
pub fn shipped(name: &str) -> Option<&'static str> {
    SHIPPED.iter().find(|(known, _)| *known == name).map(|(_, text)| *text)
}
