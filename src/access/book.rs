//! All `[access.NAME]` tables, checked; who is known by what.

// Addresses only; `core` has no sockets.
use core::net::IpAddr;
use std::collections::BTreeMap;
use std::ops::Range;
use std::sync::Arc;

use super::password::{PasswordHash, PasswordPlace};
use super::settings::AccessEntry;
use super::{Grant, Role};
use crate::mapping::suggest::closest;
use crate::mapping::{At, Diagnostic, SourceText, TagTable};
use crate::process_image::TagIndex;
use crate::slots::Network;

/// Who may ask for what. The default is nobody.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Access {
    tables: Vec<Table>,
}

#[derive(Clone, Debug, PartialEq)]
struct Table {
    grant: Arc<Grant>,
    modbus: Vec<Network>,
    modbus_role: Option<String>,
    mqtt: bool,
    token_file: Option<String>,
    password: Option<PasswordPlace>,
}

/// Whether a text can be the name of an access table, and so stand in journals, topics and metrics (S12).
fn is_name(text: &str) -> bool {
    let good = |byte: u8| byte.is_ascii_alphanumeric() || matches!(byte, b'_' | b'-');
    (1..=64).contains(&text.len()) && text.bytes().all(good)
}

impl Access {
    /// Checks the tables against each other and against the tags that there are. Gives them, and all that is wrong with them,
    /// errors and warnings.
    #[must_use]
    pub fn build(
        source: &SourceText,
        entries: &BTreeMap<At<String>, AccessEntry>,
        table: &TagTable,
    ) -> (Self, Vec<Diagnostic>) {
        let mut problems = Vec::new();
        let mut tables = Vec::new();
        for (name, entry) in entries {
            let check = Check { source, table, name };
            check.entry(entry, &mut problems);
            let tags = check.tags(entry, &mut problems);
            let text = |at: &Option<At<String>>| at.as_ref().map(|at| at.value.clone());
            tables.push(Table {
                grant: Arc::new(Grant::new(&name.value, entry.role, tags)),
                modbus: entry.modbus.iter().map(|at| at.value).collect(),
                modbus_role: text(&entry.modbus_role),
                mqtt: entry.mqtt.as_ref().is_some_and(|at| at.value),
                token_file: text(&entry.token_file),
                password: check.password(entry, &mut problems),
            });
        }
        problems.extend(shared(source, entries));
        (Self { tables }, problems)
    }

    /// Who a Modbus client without TLS is.
    #[must_use]
    pub fn of_address(&self, address: IpAddr) -> Option<&Arc<Grant>> {
        self.find(|table| table.modbus.iter().any(|network| network.contains(address)))
    }

    /// Who a Modbus client with this role in its certificate is.
    #[must_use]
    pub fn of_role(&self, role: &str) -> Option<&Arc<Grant>> {
        self.find(|table| table.modbus_role.as_deref() == Some(role))
    }

    /// Who can come by Modbus.
    pub fn of_modbus(&self) -> impl Iterator<Item = &Arc<Grant>> {
        let tables =
            self.tables.iter().filter(|table| !table.modbus.is_empty() || table.modbus_role.is_some());
        tables.map(|table| &table.grant)
    }

    /// Who comes through the broker.
    #[must_use]
    pub fn of_broker(&self) -> Option<&Arc<Grant>> {
        self.find(|table| table.mqtt)
    }

    /// Who has a token, each with the file that it stands in.
    pub fn tokens(&self) -> impl Iterator<Item = (&Arc<Grant>, &str)> {
        self.tables.iter().filter_map(|table| Some((&table.grant, table.token_file.as_deref()?)))
    }

    /// Who has a password, each with where its hash stands.
    pub fn passwords(&self) -> impl Iterator<Item = (&Arc<Grant>, &PasswordPlace)> {
        self.tables.iter().filter_map(|table| Some((&table.grant, table.password.as_ref()?)))
    }

    /// All grants, in the order of their names.
    pub fn grants(&self) -> impl Iterator<Item = &Arc<Grant>> {
        self.tables.iter().map(|table| &table.grant)
    }

    fn find(&self, is_it: impl Fn(&Table) -> bool) -> Option<&Arc<Grant>> {
        self.tables.iter().find(|table| is_it(table)).map(|table| &table.grant)
    }
}

/// One table against the rest of the configuration.
struct Check<'a> {
    source: &'a SourceText,
    table: &'a TagTable,
    name: &'a At<String>,
}

impl Check<'_> {
    fn entry(&self, entry: &AccessEntry, problems: &mut Vec<Diagnostic>) {
        let name = &self.name.value;
        let mut tell = |span: &Range<usize>, message: String, hint: &str| {
            problems.push(self.source.error(span, message, hint));
        };
        if !is_name(name) {
            let message = format!("`{name}` cannot be the name of an access table");
            tell(&self.name.span, message, "use 1 to 64 of A-Z, a-z, 0-9, _ and -");
        }
        if let Some(first) = entry.write.first().filter(|_| entry.role == Role::Viewer) {
            let message = format!("`{name}` is a viewer, who writes nothing");
            tell(&first.span, message, "leave out `write`, or make it an operator");
        }
        for at in [&entry.modbus_role, &entry.token_file, &entry.password_file].into_iter().flatten() {
            if at.value.is_empty() {
                tell(&at.span, "this is empty".to_owned(), "leave it out where there is none");
            }
        }
        let known = !entry.modbus.is_empty()
            || entry.mqtt.as_ref().is_some_and(|at| at.value)
            || entry.password.is_some()
            || [&entry.modbus_role, &entry.token_file, &entry.password_file].into_iter().any(Option::is_some);
        if !known {
            let message = format!("nobody is known as `{name}`");
            let hint = "add `modbus`, `modbus_role`, `mqtt`, `token_file` or `password`";
            problems.push(self.source.warning(&self.name.span, message, hint));
        }
    }

    fn password(&self, entry: &AccessEntry, problems: &mut Vec<Diagnostic>) -> Option<PasswordPlace> {
        let Some(at) = &entry.password else {
            return entry.password_file.as_ref().map(|at| PasswordPlace::File(at.value.clone()));
        };
        if let Some(file) = &entry.password_file {
            let message = "`password` is there too, and one of the two would be in vain";
            problems.push(self.source.error(&file.span, message, "leave one of them out"));
        }
        let hash = PasswordHash::parse(&at.value.0);
        let hash = hash.map_err(|error| {
            let hint = "`cangate password` makes one; a password itself never stands here";
            problems.push(self.source.error(&at.span, error.to_string(), hint));
        });
        hash.ok().map(PasswordPlace::Here)
    }

    /// The tags under `write`.
    fn tags(&self, entry: &AccessEntry, problems: &mut Vec<Diagnostic>) -> Vec<TagIndex> {
        let mut tags = Vec::new();
        for at in &entry.write {
            match self.matched(&at.value) {
                Ok(found) => tags.extend(found),
                Err((message, hint)) => problems.push(self.source.error(&at.span, message, hint)),
            }
        }
        tags
    }

    fn matched(&self, pattern: &str) -> Result<Vec<TagIndex>, (String, String)> {
        let table = self.table;
        let Some((node_name, tag_name)) = pattern.split_once('/') else {
            let hint = "write \"node/tag\", or \"node/*\" for all that can be written of a node";
            return Err((format!("`{pattern}` names no tag"), hint.to_owned()));
        };
        let Some(node) = table.find_node(node_name) else {
            let hint = did_you_mean(node_name, table.nodes.iter().map(|node| node.name.as_str()));
            return Err((format!("there is no node `{node_name}`"), hint));
        };
        let range = table.node(node).map(|node| node.tags.clone()).unwrap_or_default();
        if tag_name == "*" {
            let all: Vec<TagIndex> = range.map(TagIndex).filter(|tag| table.writing(*tag).is_ok()).collect();
            if all.is_empty() {
                let hint = "its mapping must have tags in RPDOs, and the node `outputs = true`; or objects with `writable = true`";
                return Err((format!("no tag of `{node_name}` can be written"), hint.to_owned()));
            }
            return Ok(all);
        }
        let Some(tag) = table.find_tag(node, tag_name) else {
            let names = table.tags.get(range).unwrap_or_default().iter().map(|tag| tag.name.as_str());
            return Err((
                format!("there is no tag `{tag_name}` in `{node_name}`"),
                did_you_mean(tag_name, names),
            ));
        };
        match table.writing(tag) {
            Ok(_) => Ok(vec![tag]),
            Err(why) => {
                let hint = "tags of RPDOs can be written, where the node has `outputs = true`, and objects that its mapping calls `writable`";
                Err((format!("`{pattern}` cannot be written: {why}"), hint.to_owned()))
            }
        }
    }
}

fn did_you_mean<'a>(wrong: &str, known: impl Iterator<Item = &'a str>) -> String {
    closest(wrong, known).map_or_else(
        || "`cangate map` lists nodes and tags".to_owned(),
        |close| format!("did you mean `{close}`?"),
    )
}

/// What two tables both claim: nobody could say which of them a client is.
fn shared(source: &SourceText, entries: &BTreeMap<At<String>, AccessEntry>) -> Vec<Diagnostic> {
    let mut problems = Vec::new();
    let mut claims: Vec<(&At<String>, Claim<'_>, &Range<usize>)> = Vec::new();
    for (name, entry) in entries {
        let networks = entry.modbus.iter().map(|at| (Claim::Network(at.value), &at.span));
        let role = entry.modbus_role.iter().map(|at| (Claim::Role(&at.value), &at.span));
        let mqtt = entry.mqtt.iter().filter(|at| at.value).map(|at| (Claim::Broker, &at.span));
        for (claim, span) in networks.chain(role).chain(mqtt) {
            let other = claims.iter().find(|(owner, other, _)| *owner != name && other.meets(&claim));
            if let Some((owner, _, before)) = other {
                let (line, column) = source.position(before.start);
                let message =
                    format!("{} is also in [access.{}], at {line}:{column}", claim.text(), owner.value);
                problems.push(source.error(span, message, "each client is one of them: leave it in one"));
            }
            claims.push((name, claim, span));
        }
    }
    problems
}

enum Claim<'a> {
    Network(Network),
    Role(&'a str),
    Broker,
}

impl Claim<'_> {
    fn meets(&self, other: &Self) -> bool {
        match (self, other) {
            (Self::Network(one), Self::Network(other)) => one.overlaps(other),
            (Self::Role(one), Self::Role(other)) => one == other,
            (Self::Broker, Self::Broker) => true,
            (Self::Network(_) | Self::Role(_) | Self::Broker, _) => false,
        }
    }

    fn text(&self) -> String {
        match self {
            Self::Network(network) => format!("a client of {network}"),
            Self::Role(role) => format!("the role `{role}`"),
            Self::Broker => "who comes through the broker".to_owned(),
        }
    }
}

#[cfg(test)]
#[path = "book_tests.rs"]
mod tests;
