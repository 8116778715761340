//! Topics of Sparkplug B: `spBv1.0/<group>/<message>/<edge node>[/<device>]` (Sparkplug 3.0, chapter 4).

use std::sync::Arc;

use super::settings::SparkplugSettings;
use crate::mapping::TagTable;

/// Every topic of one edge node, made once.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct EdgeTopics {
    /// The edge node's last will, and its goodbye.
    pub ndeath: Arc<str>,
    /// Commands to the edge node.
    pub ncmd: String,
    dcmd: String,
    /// Birth, data, death by origin: the edge node, then the devices.
    origins: Vec<[Arc<str>; 3]>,
}

impl EdgeTopics {
    /// For everything in the table.
    #[must_use]
    pub fn new(settings: &SparkplugSettings, table: &TagTable) -> Self {
        let edge = settings.edge_node_for(&table.gateway);
        let group = &settings.group_id;
        let topic = |message: &str, device: Option<&str>| {
            let end = device.map(|device| format!("/{device}")).unwrap_or_default();
            format!("spBv1.0/{group}/{message}/{edge}{end}")
        };
        let of_node = ["NBIRTH", "NDATA", "NDEATH"].map(|message| topic(message, None).into());
        let devices = table
            .nodes
            .iter()
            .map(|node| ["DBIRTH", "DDATA", "DDEATH"].map(|message| topic(message, Some(&node.name)).into()));
        Self {
            ndeath: topic("NDEATH", None).into(),
            ncmd: topic("NCMD", None),
            dcmd: topic("DCMD", None),
            origins: [of_node].into_iter().chain(devices).collect(),
        }
    }

    /// All commands to devices.
    #[must_use]
    pub fn dcmd_filter(&self) -> String {
        format!("{}/+", self.dcmd)
    }

    /// The device that a topic of a DCMD names.
    #[must_use]
    pub fn commanded<'a>(&self, topic: &'a str) -> Option<&'a str> {
        topic.strip_prefix(&self.dcmd)?.strip_prefix('/')
    }

    /// NBIRTH or DBIRTH.
    #[must_use]
    pub fn birth(&self, origin: usize) -> Arc<str> {
        self.of(origin, |[birth, _, _]| birth)
    }

    /// NDATA or DDATA.
    #[must_use]
    pub fn data(&self, origin: usize) -> Arc<str> {
        self.of(origin, |[_, data, _]| data)
    }

    /// NDEATH or DDEATH.
    #[must_use]
    pub fn death(&self, origin: usize) -> Arc<str> {
        self.of(origin, |[_, _, death]| death)
    }

    /// Every origin has its topics; there is none beyond.
    fn of(&self, origin: usize, pick: impl Fn(&[Arc<str>; 3]) -> &Arc<str>) -> Arc<str> {
        Arc::clone(self.origins.get(origin).map_or(&self.ndeath, pick))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn tck_id_topic_structure_an_edge_node_has_four_levels() {
        let table = TagTable { gateway: "hall-1".into(), ..TagTable::default() };
        let mut settings = SparkplugSettings { group_id: "works".into(), ..SparkplugSettings::default() };
        let topics = EdgeTopics::new(&settings, &table);
        assert_eq!(&*topics.birth(0), "spBv1.0/works/NBIRTH/hall-1");
        assert_eq!(&*topics.data(0), "spBv1.0/works/NDATA/hall-1");
        assert_eq!(&*topics.ndeath, "spBv1.0/works/NDEATH/hall-1");
        assert_eq!(topics.ncmd, "spBv1.0/works/NCMD/hall-1");
        assert_eq!(topics.dcmd_filter(), "spBv1.0/works/DCMD/hall-1/+");
        assert_eq!(topics.commanded("spBv1.0/works/DCMD/hall-1/engine1"), Some("engine1"));
        assert_eq!(topics.commanded("spBv1.0/works/DCMD/hall-10/engine1"), None);
        settings.edge_node_id = Some("north".into());
        assert_eq!(&*EdgeTopics::new(&settings, &table).birth(0), "spBv1.0/works/NBIRTH/north");
    }
}
