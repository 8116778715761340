//! What the messages of Sparkplug B consist of. Pure.

use super::catalogue::{Catalogue, GOOD, millis};
use super::history::Kept;
use super::payload::{DataType, Metric, MetricValue, Payload, PropertySet, REBIRTH};
use crate::time::Now;

/// NDEATH: the number of the session and nothing else (tck-id-topics-ndeath-payload, tck-id-topics-ndeath-seq).
pub(super) fn death(now: Now, bd_seq: u8) -> Payload {
    Payload { timestamp: Some(millis(now.utc)), metrics: vec![bd_seq_metric(now, bd_seq)], seq: None }
}

/// What only NBIRTH has. Neither has an alias, so that it can be asked for by whoever knows nothing of this edge node
/// (tck-id-operational-behavior-data-commands-rebirth-name-aliases).
pub(super) fn of_edge_node(now: Now, bd_seq: u8) -> [Metric; 2] {
    let rebirth = MetricValue::Boolean(false);
    [bd_seq_metric(now, bd_seq), named(now, REBIRTH, DataType::Boolean, rebirth)]
}

fn bd_seq_metric(now: Now, bd_seq: u8) -> Metric {
    named(now, "bdSeq", DataType::Int64, MetricValue::Long(bd_seq.into()))
}

fn named(now: Now, name: &str, data_type: DataType, value: MetricValue) -> Metric {
    Metric {
        name: Some(name.to_owned()),
        timestamp: Some(millis(now.utc)),
        datatype: Some(data_type.code()),
        value: Some(value),
        ..Metric::default()
    }
}

/// A message with a sequence number.
pub(super) fn numbered(now: Now, seq: u8, metrics: Vec<Metric>) -> Payload {
    Payload { timestamp: Some(millis(now.utc)), metrics, seq: Some(seq.into()) }
}

/// A metric of data; its quality is told where it is not good, and where it is another one than before.
pub(super) fn data(catalogue: &Catalogue, kept: &Kept, requalified: bool) -> Option<Metric> {
    let mut metric = catalogue.metric(kept.metric)?.data(kept.datum, kept.at);
    if requalified || kept.quality != GOOD {
        let mut properties = PropertySet::default();
        properties.push_quality(kept.quality);
        metric.properties = Some(properties);
    }
    Some(metric)
}

/// A metric of data that was kept.
pub(super) fn historical(catalogue: &Catalogue, kept: &Kept) -> Option<Metric> {
    let metric = data(catalogue, kept, false)?;
    Some(Metric { is_historical: Some(true), ..metric })
}
