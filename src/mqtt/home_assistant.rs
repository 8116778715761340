//! Home Assistant's MQTT discovery: what announces each node as a device with its entities. Pure.
//!
//! One retained message for each node, and one for the gateway itself, on `<prefix>/device/cangate_<gateway>/<node>/config`;
//! a node with very many tags has several. They do not change while the program runs.
//!
//! The broker is the memory of what a former run announced: the messages on these topics are read at the begin of each
//! session. One that is no longer announced is cleared; an entity that is no longer part of one is announced once more as
//! removed, which Home Assistant wants to be told in so many words.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use super::json::JsonWriter;
use super::kind::Kind;
use super::settings::BaseTopic;
use super::topics::{NodeTopics, Topics};
use crate::mapping::{AlarmDef, AlarmOwner, DEVICE_UNIT, Derived, NodeDef, Source, TagDef, TagTable};

/// Largest announcement in bytes: it is read back in the next session, where 64 KiB are taken.
const LARGEST: usize = 48 * 1024;
/// Topics to be cleared that wait; what is beyond is found again in the next session.
const MOST_CLEARED: usize = 1024;
/// Begin of the entities in an announcement.
const COMPONENTS: &str = "\"components\":{";
/// What Home Assistant's templates write for true and false.
const TRUE_FALSE: [&str; 2] = ["True", "False"];

/// The `[mqtt.home_assistant]` table of the configuration.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct HomeAssistantSettings {
    /// Announce nodes, tags and alarms to Home Assistant.
    pub enabled: bool,
    /// First part of the topics of Home Assistant's discovery, and of its `status`.
    #[schemars(with = "String")]
    pub prefix: BaseTopic,
}

impl Default for HomeAssistantSettings {
    fn default() -> Self {
        let prefix = BaseTopic::try_from("homeassistant".to_owned()).unwrap_or_default();
        Self { enabled: false, prefix }
    }
}

/// One message of discovery.
#[derive(Clone, Debug)]
struct Announcement {
    topic: Arc<str>,
    payload: Arc<str>,
    /// Its entities by their keys.
    keys: BTreeSet<String>,
}

/// What Home Assistant is to be told.
#[derive(Clone, Debug)]
pub struct HomeAssistant {
    status: String,
    /// Topics of all announcements of this gateway, of former runs too.
    own: String,
    announcements: Vec<Announcement>,
    /// The broker has answered the subscription of this session.
    subscribed: bool,
    /// To be sent: by place.
    due: BTreeSet<usize>,
    /// Entities of former runs that are to be told as removed, with their platforms: by place.
    removed: BTreeMap<usize, BTreeMap<String, String>>,
    /// Topics to be cleared.
    cleared: BTreeSet<String>,
}

impl HomeAssistant {
    /// The announcements of everything in the table; `None` unless it is asked for.
    #[must_use]
    pub fn new(
        settings: &HomeAssistantSettings,
        table: &TagTable,
        topics: &Topics,
        version: &str,
    ) -> Option<Self> {
        settings.enabled.then(|| {
            let prefix = settings.prefix.as_str();
            let own = format!("{prefix}/device/cangate_{}", plain(&table.gateway));
            let writer = Writer { table, topics, version };
            let mut announcements = Vec::new();
            writer.announce(&own, None, &mut announcements);
            for place in 0..table.nodes.len() {
                writer.announce(&own, Some(place), &mut announcements);
            }
            Self {
                status: format!("{prefix}/status"),
                own,
                announcements,
                subscribed: false,
                due: BTreeSet::new(),
                removed: BTreeMap::new(),
                cleared: BTreeSet::new(),
            }
        })
    }

    /// Topics of all announcements.
    pub fn topics(&self) -> impl Iterator<Item = &Arc<str>> {
        self.announcements.iter().map(|announcement| &announcement.topic)
    }

    /// What is to be subscribed in each session, before anything is sent.
    #[must_use]
    pub fn subscriptions(&self) -> Vec<String> {
        vec![self.status.clone(), format!("{}/+/config", self.own)]
    }

    /// What former runs announced is on its way: all is announced. Not before, because an announcement takes the place of the
    /// former one of its topic, which would never be seen.
    ///
    /// What was read before the answer came stays to be told of.
    pub fn handle_subscribed(&mut self) {
        if !std::mem::replace(&mut self.subscribed, true) {
            self.due = (0..self.announcements.len()).collect();
        }
    }

    /// Takes the place of another one in its session: what that announced is what the broker has.
    pub fn go_on_from(&mut self, old: &Self) {
        if old.subscribed {
            self.handle_subscribed();
            for Announcement { topic, payload, .. } in &old.announcements {
                self.handle_message(topic, payload.as_bytes(), true);
            }
        }
    }

    /// The session ended: the next one reads anew what the broker has.
    pub fn handle_session_down(&mut self) {
        self.subscribed = false;
        self.due.clear();
        self.removed.clear();
        self.cleared.clear();
    }

    /// A message came; those of other topics are left alone.
    pub fn handle_message(&mut self, topic: &str, payload: &[u8], retained: bool) {
        if topic == self.status {
            // It started, and knows nothing but what the broker has kept.
            if payload == b"online" {
                self.due = (0..self.announcements.len()).collect();
                self.removed.clear();
            }
            return;
        }
        let is_own = topic.strip_prefix(&self.own).is_some_and(|rest| rest.starts_with('/'));
        // What is not retained is what we say ourselves.
        if !is_own || !retained || payload.is_empty() {
            return;
        }
        match self.announcements.iter().position(|announcement| *announcement.topic == *topic) {
            None if self.cleared.len() < MOST_CLEARED => {
                self.cleared.insert(topic.to_owned());
            }
            None => {}
            Some(place) => self.compare(place, payload),
        }
    }

    /// Finds the entities of a former announcement that are no more.
    fn compare(&mut self, place: usize, payload: &[u8]) {
        let Some(announcement) = self.announcements.get(place) else { return };
        let former: Former = serde_json::from_slice(payload).unwrap_or_default();
        let gone = former.components.into_iter().filter_map(|(key, component)| {
            // One without an id is told as removed already.
            let known = announcement.keys.contains(&key) || component.unique_id.is_none();
            (!known).then_some((key, component.platform?))
        });
        let gone: BTreeMap<String, String> = gone.collect();
        if !gone.is_empty() {
            self.removed.insert(place, gone);
            self.due.insert(place);
        }
    }

    /// The next topic and payload to be sent, retained; call until `None`.
    pub fn poll_output(&mut self) -> Option<(Arc<str>, Arc<str>)> {
        if let Some(topic) = self.cleared.pop_first() {
            return Some((topic.into(), "".into()));
        }
        let place = self.due.pop_first()?;
        let announcement = self.announcements.get(place)?;
        let payload = match self.removed.get(&place) {
            None => Arc::clone(&announcement.payload),
            Some(removed) => with_removed(&announcement.payload, removed),
        };
        Some((Arc::clone(&announcement.topic), payload))
    }

    /// Whether something is to be sent.
    #[must_use]
    pub fn has_more(&self) -> bool {
        !self.due.is_empty() || !self.cleared.is_empty()
    }
}

/// What is read of an announcement of a former run.
#[derive(Debug, Default, Deserialize)]
struct Former {
    #[serde(default)]
    components: BTreeMap<String, FormerComponent>,
}

#[derive(Debug, Deserialize)]
struct FormerComponent {
    platform: Option<String>,
    unique_id: Option<String>,
}

/// An announcement in which some entities are told as removed: nothing but their platform is left of them.
fn with_removed(payload: &str, removed: &BTreeMap<String, String>) -> Arc<str> {
    let mut stubs = String::new();
    let mut json = JsonWriter::object(&mut stubs);
    for (key, platform) in removed {
        json.nested(key, |stub| stub.text("platform", platform));
    }
    let stubs = stubs.trim_start_matches('{');
    payload.replacen(COMPONENTS, &format!("{COMPONENTS}{stubs},"), 1).into()
}

/// Makes the announcements.
struct Writer<'a> {
    table: &'a TagTable,
    topics: &'a Topics,
    version: &'a str,
}

/// One entity.
enum Entity<'a> {
    /// Whether the node, or the gateway, is there.
    Online,
    Nmt,
    Tag(&'a TagDef),
    Alarm(&'a AlarmDef, &'a Arc<str>),
}

impl Writer<'_> {
    /// The announcements of a node, or of the gateway: as few as their size allows.
    fn announce(&self, own: &str, place: Option<usize>, into: &mut Vec<Announcement>) {
        let node = place.and_then(|place| self.table.nodes.get(place).zip(self.topics.nodes.get(place)));
        let object = node.map_or_else(|| "bridge".to_owned(), |(def, _)| plain(&def.name));
        let head = self.head(node);
        let entities = self.entities(place, node).into_iter().map(|entity| self.entity(node, &entity));
        let mut parts: Vec<(String, BTreeSet<String>)> = Vec::new();
        for (key, text) in entities {
            match parts.last_mut() {
                Some((part, keys)) if head.len() + part.len() + text.len() < LARGEST => {
                    part.push(',');
                    part.push_str(&text);
                    keys.insert(key);
                }
                _ => parts.push((text, BTreeSet::from([key]))),
            }
        }
        for (number, (entities, keys)) in parts.into_iter().enumerate() {
            // Names are in lower case: no node has this one.
            let object = if number == 0 { object.clone() } else { format!("{object}-PART{}", number + 1) };
            into.push(Announcement {
                topic: format!("{own}/{object}/config").into(),
                payload: format!("{head}{COMPONENTS}{entities}}}}}").into(),
                keys,
            });
        }
    }

    /// What all entities of a device have in common; ends where they begin.
    fn head(&self, node: Option<(&NodeDef, &NodeTopics)>) -> String {
        let gateway = format!("cangate.{}", self.table.gateway);
        let mut text = String::new();
        let mut json = JsonWriter::object(&mut text);
        json.nested("device", |device| {
            if let Some((def, _)) = node {
                device.text("identifiers", &format!("{gateway}.{}", def.name));
                device.text("name", &format!("{} {}", self.table.gateway, def.name));
                device.text("manufacturer", &def.device.vendor);
                device.text("model", &def.device.model);
                device.text("via_device", &gateway);
            } else {
                device.text("identifiers", &gateway);
                device.text("name", &self.table.gateway);
                device.text("model", "cangate");
                device.text("sw_version", self.version);
            }
        });
        json.nested("origin", |origin| {
            origin.text("name", "cangate");
            origin.text("sw_version", self.version);
        });
        json.integer("qos", 1);
        if let Some((_, topics)) = node {
            json.text("state_topic", &topics.state);
            availability(&mut json, &[&self.topics.bridge_state, &topics.availability]);
        }
        json.finish();
        text.pop();
        text.push(',');
        text
    }

    fn entities(&self, place: Option<usize>, node: Option<(&NodeDef, &NodeTopics)>) -> Vec<Entity<'_>> {
        let mut entities = vec![Entity::Online];
        if let Some(def) = place.and_then(|place| self.table.nodes.get(place)) {
            entities.extend(def.canopen().map(|_| Entity::Nmt));
            let tags = self.table.tags.get(def.tags.clone()).unwrap_or_default();
            entities.extend(tags.iter().filter(|tag| tag.published).map(Entity::Tag));
        }
        let alarms = self.table.alarms.iter().zip(&self.topics.alarms);
        let mine = alarms.filter(|(def, _)| match def.owner {
            AlarmOwner::Node(owner) => Some(owner.0) == place,
            AlarmOwner::Gateway | AlarmOwner::Bus(_) => node.is_none(),
        });
        entities.extend(mine.map(|(def, topic)| Entity::Alarm(def, topic)));
        entities
    }

    /// An entity's key, and itself as a member of the entities.
    fn entity(&self, node: Option<(&NodeDef, &NodeTopics)>, entity: &Entity<'_>) -> (String, String) {
        // Names of tags have no hyphen.
        let key = match entity {
            Entity::Online => "is-online".to_owned(),
            Entity::Nmt => "nmt-state".to_owned(),
            Entity::Tag(tag) => tag.name.clone(),
            Entity::Alarm(def, _) => match def.owner {
                AlarmOwner::Bus(bus) => {
                    let bus = self.table.buses.get(bus.0).map_or("", |bus| bus.name.as_str());
                    format!("alarm-{bus}.{}", def.name)
                }
                AlarmOwner::Gateway | AlarmOwner::Node(_) => format!("alarm-{}", def.name),
            },
        };
        let owner = node.map_or_else(String::new, |(def, _)| format!(".{}", def.name));
        let id = format!("cangate.{}{owner}.{key}", self.table.gateway);
        let mut text = String::new();
        let mut json = JsonWriter::object(&mut text);
        json.nested(&key, |json| {
            let is_bit = match entity {
                Entity::Online | Entity::Alarm(..) => true,
                Entity::Nmt => false,
                Entity::Tag(tag) => Kind::of(tag) == Kind::Bool,
            };
            json.text("platform", if is_bit { "binary_sensor" } else { "sensor" });
            json.text("unique_id", &id);
            match entity {
                Entity::Online => self.online(json, node),
                Entity::Nmt => {
                    json.text("name", "NMT state");
                    json.text("entity_category", "diagnostic");
                    json.text("value_template", "{{ value_json['nmt'] }}");
                }
                Entity::Tag(tag) => tag_entity(json, tag, is_bit),
                Entity::Alarm(def, topic) => self.alarm(json, def, topic),
            }
        });
        let text = text.trim_start_matches('{').to_owned();
        (key, text)
    }

    fn online(&self, json: &mut JsonWriter<'_>, node: Option<(&NodeDef, &NodeTopics)>) {
        json.text("name", "Online");
        json.text("device_class", "connectivity");
        json.text("entity_category", "diagnostic");
        json.text("state_topic", node.map_or(&self.topics.bridge_state, |(_, topics)| &topics.availability));
        json.text("value_template", "{{ value_json['state'] }}");
        json.text("payload_on", "online");
        json.text("payload_off", "offline");
        if node.is_some() {
            availability(json, &[&self.topics.bridge_state]);
        }
    }

    fn alarm(&self, json: &mut JsonWriter<'_>, def: &AlarmDef, topic: &str) {
        let bus = match def.owner {
            AlarmOwner::Bus(bus) => self.table.buses.get(bus.0).map_or("", |bus| bus.name.as_str()),
            AlarmOwner::Gateway | AlarmOwner::Node(_) => "",
        };
        let separator = if bus.is_empty() { "" } else { " " };
        json.text("name", &format!("Alarm {bus}{separator}{}", def.name.replace('_', " ")));
        json.text("device_class", "problem");
        json.text("entity_category", "diagnostic");
        json.text("state_topic", topic);
        json.text("value_template", "{{ value_json['active'] }}");
        truths(json);
        json.text("json_attributes_topic", topic);
        // A lost node has alarms, too.
        availability(json, &[&self.topics.bridge_state]);
    }
}

fn tag_entity(json: &mut JsonWriter<'_>, tag: &TagDef, is_bit: bool) {
    json.text("name", &name(&tag.name));
    // What should not be used as it stands is unknown; a reservation of the device is none of that.
    let good = format!("value_json['bad'].get('{0}', 'doubtful') == 'doubtful'", tag.name);
    json.text("value_template", &format!("{{{{ value_json['tags']['{}'] if {good} else none }}}}", tag.name));
    if is_bit {
        truths(json);
        return;
    }
    let unit = if tag.unit == DEVICE_UNIT { "" } else { tag.unit.as_str() };
    if let Some(class) = device_class(unit) {
        json.text("device_class", class);
    }
    if !unit.is_empty() {
        json.text("unit_of_measurement", unit);
    }
    let counts = matches!(tag.source, Source::Derived(Derived::RisingEdges { .. }));
    if counts {
        json.text("state_class", "total_increasing");
    } else if !unit.is_empty() || Kind::of(tag) == Kind::Real {
        json.text("state_class", "measurement");
    }
    if Kind::of(tag) == Kind::Real {
        json.integer("suggested_display_precision", tag.decimals);
    }
}

fn truths(json: &mut JsonWriter<'_>) {
    let [on, off] = TRUE_FALSE;
    json.text("payload_on", on);
    json.text("payload_off", off);
}

/// All of these topics have to say "online".
fn availability(json: &mut JsonWriter<'_>, topics: &[&Arc<str>]) {
    json.text("availability_mode", "all");
    json.array("availability", |list| {
        for topic in topics {
            list.element(|one| {
                one.text("topic", topic);
                one.text("value_template", "{{ value_json['state'] }}");
            });
        }
    });
}

/// Home Assistant's class of a quantity, where it has one that knows this unit.
fn device_class(unit: &str) -> Option<&'static str> {
    Some(match unit {
        "°C" | "°F" | "K" => "temperature",
        "bar" | "cbar" | "mbar" | "Pa" | "hPa" | "kPa" | "psi" | "mmHg" | "inHg" => "pressure",
        "V" | "mV" => "voltage",
        "A" | "mA" => "current",
        "W" | "kW" | "MW" => "power",
        "Hz" | "kHz" | "MHz" | "GHz" => "frequency",
        "ms" | "s" | "min" | "h" | "d" => "duration",
        "mm" | "cm" | "m" | "km" => "distance",
        "g" | "kg" => "weight",
        "mm/s" | "m/s" | "km/h" => "speed",
        "L/min" | "m³/h" => "volume_flow_rate",
        _ => return None,
    })
}

/// A tag's name for people: `knock_intensity_1` is "Knock intensity 1".
fn name(tag: &str) -> String {
    let words = tag.replace('_', " ");
    let mut letters = words.chars();
    letters.next().map_or_else(String::new, |first| first.to_uppercase().chain(letters).collect())
}

/// A name as one level of a discovery topic: other characters than these are not taken there.
fn plain(name: &str) -> String {
    let safe = |c: char| if c.is_ascii_alphanumeric() || matches!(c, '_' | '-') { c } else { '_' };
    name.chars().map(safe).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_are_for_people_and_levels_for_topics() {
        assert_eq!(name("knock_intensity_1"), "Knock intensity 1");
        assert_eq!(name(""), "");
        assert_eq!(plain("hall-1/ä"), "hall-1__");
    }

    #[test]
    fn a_unit_that_is_not_known_has_no_class() {
        assert_eq!(device_class("°C"), Some("temperature"));
        assert_eq!(device_class("%"), None);
    }
}
