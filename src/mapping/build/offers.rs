//! Where serial lines are offered: TCP ports, topics, registers.

// Addresses only; nothing here opens a socket.
use core::net::{IpAddr, Ipv6Addr, SocketAddr};
use std::ops::Range;

use super::super::installation::ChannelEntry;
use super::super::table::{LineDef, LineMqtt, LineTcp, LineText};
use super::super::{At, SourceText};
use super::lines::used;
use super::problems::Problems;
use super::tags::{Context, FIRST_REGISTER};
use crate::canopen::Role;
use crate::esd::ModuleKind;
use crate::slots::{AllowList, Network};

/// The lines of a module that are used, with where each is offered.
pub fn lines(problems: &mut Problems, context: &Context<'_>, kind: ModuleKind) -> Vec<LineDef> {
    for (_, _, entry) in used(context, kind) {
        warn_of_writing(problems, context, entry);
    }
    let lines = used(context, kind).into_iter().map(|(number, _, entry)| LineDef {
        node: context.node,
        channel: usize::from(number - 1),
        number,
        description: entry.description.clone(),
        tcp: tcp(problems, context.config, entry),
        mqtt: LineMqtt {
            publish: entry.mqtt.unwrap_or(true),
            encoding: entry.encoding.into(),
            write: entry.mqtt_write.value,
        },
        text: text(problems, context, entry),
    });
    lines.collect()
}

/// Nothing goes out on the lines of a bus where the gateway is passive.
fn warn_of_writing(problems: &mut Problems, context: &Context<'_>, entry: &ChannelEntry) {
    let Some(bus) = context.bus.as_ref().filter(|bus| bus.role == Role::Passive) else { return };
    for (key, at) in [("write", entry.write.as_ref()), ("mqtt_write", Some(&entry.mqtt_write))] {
        let Some(at) = at.filter(|at| at.value) else { continue };
        let message = format!("`{key}` means nothing: the gateway is passive on bus `{}`", bus.name);
        let hint = "leave it out, or make the gateway master there: until then nothing goes out on the line";
        problems.warning(context.config, &at.span, message, hint);
    }
}

fn tcp(problems: &mut Problems, config: &SourceText, entry: &ChannelEntry) -> Option<LineTcp> {
    let most = entry.max_connections.as_ref();
    let most = most.map_or(8, |at| problems.within(config, at, "max_connections", 1..=64));
    let allow = allow(problems, config, entry);
    let Some(at) = &entry.listen else {
        let without = [
            ("allow", entry.allow.as_ref().map(|at| &at.span)),
            ("max_connections", entry.max_connections.as_ref().map(|at| &at.span)),
            ("write", entry.write.as_ref().map(|at| &at.span)),
        ];
        for (key, span) in without.into_iter().filter_map(|(key, span)| Some((key, span?))) {
            let message = format!("`{key}` means nothing without `listen`");
            problems.error(config, span, message, "say where to listen: listen = \"127.0.0.1:4001\"");
        }
        return None;
    };
    let Ok(listen) = at.value.parse::<SocketAddr>() else {
        let message = format!("`{}` is not an address with a port", at.value);
        problems.error(config, &at.span, message, "for example \"127.0.0.1:4001\" or \"[::1]:4001\"");
        return None;
    };
    if !listen.ip().is_loopback() && allow.is_open() {
        let message = format!("whoever reaches {listen} over the network can use this serial line");
        let hint = "say who may, with `allow = [\"10.0.0.0/8\"]`, or listen at 127.0.0.1";
        problems.warning(config, &at.span, message, hint);
    }
    let write = entry.write.as_ref().is_none_or(|at| at.value);
    Some(LineTcp { listen, allow, max_connections: u16::try_from(most).unwrap_or(8), write })
}

fn allow(problems: &mut Problems, config: &SourceText, entry: &ChannelEntry) -> AllowList {
    let mut ranges = Vec::new();
    let Some(list) = &entry.allow else { return AllowList::default() };
    if list.value.is_empty() {
        let message = "nobody could connect with an empty `allow`";
        problems.error(config, &list.span, message, "leave it out, or name addresses: [\"10.0.0.0/8\"]");
    }
    for text in &list.value {
        let range = text.value.parse::<Network>();
        if range.is_err() {
            let message = format!("`{}` is no address and no range of addresses", text.value);
            problems.error(config, &text.span, message, "for example \"192.168.1.20\" or \"10.0.0.0/8\"");
        }
        ranges.extend(range);
    }
    AllowList::new(ranges)
}

fn text(problems: &mut Problems, context: &Context<'_>, entry: &ChannelEntry) -> Option<LineText> {
    let config = context.config;
    let length = entry.text_length.as_ref().map(|at| problems.within(config, at, "text_length", 1..=64));
    let registers = 1 + length.unwrap_or(32);
    let Some(at) = &entry.text_register else {
        if let Some(at) = &entry.text_length {
            let message = "`text_length` means nothing without `text_register`";
            problems.error(
                config,
                &at.span,
                message,
                "say from which register on the last message is to stand",
            );
        }
        return None;
    };
    let highest = u64::from(u16::MAX) + 1 - registers;
    let address = problems.within(config, at, "text_register", FIRST_REGISTER..=highest);
    Some(LineText { address: u16::try_from(address).ok()?, registers: u16::try_from(registers).ok()? })
}

/// The table of a line in the configuration.
fn entry_of<'a>(context: &Context<'a>, line: &LineDef) -> Option<&'a ChannelEntry> {
    context.entry.channel.get(&At::nowhere(line.number.to_string()))
}

/// The registers of last messages, whose they are, and where the configuration says so.
pub fn texts(context: &Context<'_>, lines: &[LineDef]) -> Vec<(Range<u64>, String, Range<usize>)> {
    let texts = lines.iter().filter_map(|line| {
        let text = line.text?;
        let first = u64::from(text.address);
        let owner = format!("the last message of channel {}", line.number);
        let span = entry_of(context, line)?.text_register.as_ref()?.span.clone();
        Some((first..first + u64::from(text.registers), owner, span))
    });
    texts.collect()
}

/// Whether nobody can listen at both: they are of one port, and an address of the one is an address of the other. `[::]` is
/// every address here, also of IPv4. Port 0 is a free one that the system chooses.
#[must_use]
pub fn share_port(one: SocketAddr, other: SocketAddr) -> bool {
    let everywhere = |ip: IpAddr| ip == IpAddr::V6(Ipv6Addr::UNSPECIFIED);
    let (ip, other_ip) = (one.ip().to_canonical(), other.ip().to_canonical());
    let of_ipv4 = ip.is_ipv4() && other_ip.is_ipv4() && (ip.is_unspecified() || other_ip.is_unspecified());
    let shared = ip == other_ip || everywhere(ip) || everywhere(other_ip) || of_ipv4;
    one.port() == other.port() && one.port() != 0 && shared
}

/// No line listens at the port of another, or of the gateway itself. `known`: those before, with their owners.
pub fn check_ports(
    problems: &mut Problems,
    context: &Context<'_>,
    node: &str,
    lines: &[LineDef],
    known: &mut Vec<(SocketAddr, String)>,
) {
    for line in lines {
        let Some(listen) = line.tcp.as_ref().map(|tcp| tcp.listen) else { continue };
        let owner = format!("channel {} of node `{node}`", line.number);
        if let Some((_, other)) = known.iter().find(|(other, _)| share_port(*other, listen)) {
            let listen_at = entry_of(context, line).and_then(|entry| entry.listen.as_ref());
            let span = listen_at.map(|at| at.span.clone());
            let message = format!("{other} and {owner} listen at the same port, {listen}");
            problems.error(
                context.config,
                &span.unwrap_or_default(),
                message,
                "give each line a port of its own",
            );
        }
        known.push((listen, owner));
    }
}
