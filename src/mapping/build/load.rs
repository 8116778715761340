//! Whether a bus can carry what comes in each cycle of SYNC (R-ESD-117), and its serial lines.

use std::time::Duration;

use super::Installation;
use super::problems::Problems;
use super::sync::LAST_SYNCHRONOUS;
use super::tags::Context;
use crate::can::{BusIndex, CanFrame, CanId};
use crate::canopen::{ErrorControl, NodeSettings, Role, RpdoTrigger, cob_id};
use crate::esd::{BUS_PERCENT, CanTxMode, ChannelSettings, MinChar, ModuleSettings, SerialMode};
use crate::mapping::table::{BusDef, LineDef};

/// Above this share of the bit rate, in 0.1 %, a SYNC period is doubted.
const HIGHEST_LOAD: u64 = 700;

/// Something that is sent again and again.
#[derive(Clone, Copy, Debug)]
enum Pace {
    /// After each SYNC whose number is a multiple of this.
    Sync(u64),
    /// Once in this time.
    Every(Duration),
}

/// What nodes and gateway send cyclically, bus by bus.
#[derive(Debug, Default)]
pub struct Load {
    cyclic: Vec<(BusIndex, u64, Pace)>,
    lines: Vec<LineLoad>,
}

/// What a serial line puts on its bus while it is busy, in bit/s.
#[derive(Clone, Copy, Debug)]
struct LineLoad {
    bus: BusIndex,
    incoming: u64,
    outgoing: u64,
}

impl Load {
    /// Adds what a node sends, and what it is sent.
    pub fn add(&mut self, context: &Context<'_>, bus: BusIndex, settings: &NodeSettings) {
        let mut add = |id, length, pace| self.cyclic.push((bus, bits(id, length), pace));
        for (tpdo, pdo) in context.tpdos.iter().zip(&settings.pdos) {
            let millis = |millis: u64| Pace::Every(Duration::from_millis(millis));
            let timer = tpdo.section.period_ms.as_ref().or(tpdo.event_timer(context).map(|(_, at)| at));
            let pace = match tpdo.transmission_type(context) {
                // Type 0 comes after a SYNC too, at worst after each.
                Some((_, at)) if at.value <= LAST_SYNCHRONOUS => Some(Pace::Sync(at.value.max(1))),
                Some(_) | None => timer.filter(|at| at.value > 0).map(|at| millis(at.value)),
            };
            if let Some(pace) = pace {
                add(pdo.cob_id, pdo.length, pace);
            }
        }
        for rpdo in &settings.rpdos {
            match (rpdo.trigger, rpdo.refresh) {
                (RpdoTrigger::Sync(every), _) => {
                    add(rpdo.cob_id, rpdo.length, Pace::Sync(u64::from(every.max(1))));
                }
                (RpdoTrigger::Event, Some(refresh)) => {
                    add(rpdo.cob_id, rpdo.length, Pace::Every(refresh));
                }
                (RpdoTrigger::Event, None) => {}
            }
        }
        let state = cob_id::error_control(settings.id);
        match &settings.error_control {
            ErrorControl::Guarding(guarding) => {
                add(state, 0, Pace::Every(guarding.guard_time));
                add(state, 1, Pace::Every(guarding.guard_time));
            }
            // How often it comes stands nowhere; it has to come within the time-out.
            ErrorControl::Heartbeat { timeout } => add(state, 1, Pace::Every(*timeout / 3)),
            ErrorControl::None => {}
        }
    }

    /// Adds the serial lines of a module that are used.
    pub fn add_lines(
        &mut self,
        context: &Context<'_>,
        bus: BusIndex,
        module: &ModuleSettings,
        lines: &[LineDef],
    ) {
        let passive = context.bus.as_ref().is_some_and(|bus| bus.role == Role::Passive);
        for line in lines {
            let Some(channel) = module.channels.iter().find(|channel| channel.number == line.number) else {
                continue;
            };
            let written = !passive && (line.mqtt.write || line.tcp.as_ref().is_some_and(|tcp| tcp.write));
            let outgoing = if written { outgoing(channel) } else { 0 };
            self.lines.push(LineLoad { bus, incoming: incoming(channel), outgoing });
        }
    }

    /// Tells buses that cannot carry all their serial lines at once.
    fn check_lines(&self, problems: &mut Problems, installation: &Installation<'_>, buses: &[BusDef]) {
        for (index, (bus, name)) in buses.iter().zip(installation.buses.keys()).enumerate() {
            let lines = self.lines.iter().filter(|line| line.bus.0 == index);
            let (incoming, outgoing) = lines.fold((0, 0), |(incoming, outgoing), line| {
                (incoming + line.incoming, outgoing + line.outgoing)
            });
            let rate = u64::from(bus.bit_rate.max(1));
            let load = (incoming + outgoing.min(rate * u64::from(BUS_PERCENT) / 100)) * 1_000 / rate;
            if load <= HIGHEST_LOAD {
                continue;
            }
            let message = format!(
                "while all its serial lines are busy both ways, bus `{}` is loaded to about {} % of its {} bit/s",
                bus.name,
                load.div_ceil(10),
                bus.bit_rate
            );
            let hint = format!(
                "more than {} % delays everything else: pack more characters into a frame (`min_char`, `inhibit_ms`), \
                 lower the rates of the lines, or use a higher bit rate (`bit_rate`)",
                HIGHEST_LOAD / 10
            );
            problems.warning(installation.config, &name.span, message, hint);
        }
    }

    /// Tells buses that would have no room left.
    pub fn check(&self, problems: &mut Problems, installation: &Installation<'_>, buses: &[BusDef]) {
        self.check_lines(problems, installation, buses);
        for (index, (bus, entry)) in buses.iter().zip(installation.buses.values()).enumerate() {
            let (Some(sync), Some(at)) = (bus.sync, &entry.sync) else { continue };
            let Some(period) = sync.period.filter(|period| !period.is_zero()) else { continue };
            let own = bus.own_heartbeat.map(|own| {
                (BusIndex(index), bits(cob_id::error_control(own.node), 1), Pace::Every(own.period))
            });
            let length = u8::from(sync.overflow.is_some());
            let sync = (BusIndex(index), bits(sync.cob_id, length), Pace::Sync(1));
            let load = permille(
                self.cyclic.iter().copied().chain([sync]).chain(own).filter(|(bus, ..)| bus.0 == index),
                period,
                bus.bit_rate,
            );
            if load > HIGHEST_LOAD {
                let message = format!(
                    "with a SYNC every {} us bus `{}` is loaded to about {} % of its {} bit/s",
                    period.as_micros(),
                    bus.name,
                    load.div_ceil(10),
                    bus.bit_rate
                );
                let hint = format!(
                    "more than {} % leaves no room for anything else: use a longer period, higher transmission \
                     types, or a higher bit rate (`bit_rate`)",
                    HIGHEST_LOAD / 10
                );
                problems.warning(installation.config, &at.span, message, hint);
            }
        }
    }
}

/// What a line can bring at its full rate, in bit/s of the bus: a frame holds what came in since the one before.
fn incoming(channel: &ChannelSettings) -> u64 {
    let mode = channel.can_tx_mode.unwrap_or(CanTxMode::DEFAULT);
    let serial = channel.serial_mode.or_else(|| SerialMode::from_value(SerialMode::DEFAULT_VALUE));
    let rate = u64::from(serial.map_or(0, SerialMode::receives));
    let most = u64::from(mode.max_char.clamp(1, 8));
    let least = match mode.min_char {
        MinChar::Bytes(bytes) => u64::from(bytes),
        // Messages are longer than a frame.
        MinChar::Cr
        | MinChar::Lf
        | MinChar::CrDropped
        | MinChar::LfDropped
        | MinChar::CrDropsBoth
        | MinChar::LfDropsBoth => most,
    };
    let gathered = rate * u64::from(mode.inhibit) / 1_000;
    let length = least.max(gathered).clamp(1, most);
    let frames = (rate / length).min(1_000_u64.checked_div(u64::from(mode.inhibit)).unwrap_or(u64::MAX));
    frames * bits(channel.tx_id, u8::try_from(length).unwrap_or(8))
}

/// What a line can take at its full rate, in bit/s of the bus.
fn outgoing(channel: &ChannelSettings) -> u64 {
    let of_bytes = channel.byte_time * 8;
    let frame = channel.gap.unwrap_or_default().max(of_bytes).as_nanos().max(1);
    u64::try_from(u128::from(bits(channel.rx_id, 8)) * 1_000_000_000 / frame).unwrap_or(u64::MAX)
}

/// Bits of a frame on the wire.
fn bits(id: CanId, length: u8) -> u64 {
    let payload = [0; 8];
    let payload = payload.get(..usize::from(length.min(8))).unwrap_or_default();
    CanFrame::data_frame(id, payload).map_or(0, |frame| u64::from(frame.wire_bits()))
}

/// The share of the bit rate that is used, in 0.1 %.
fn permille(frames: impl Iterator<Item = (BusIndex, u64, Pace)>, period: Duration, bit_rate: u32) -> u64 {
    // Billionths of a bit per second, so that what is cut off does not count.
    let used = frames.map(|(_, bits, pace)| {
        let every = match pace {
            Pace::Sync(every) => period.as_nanos() * u128::from(every),
            Pace::Every(time) => time.as_nanos(),
        };
        u128::from(bits) * 1_000_000_000_000_000_000 / every.max(1)
    });
    let (used, whole) = (used.sum::<u128>(), u128::from(bit_rate.max(1)) * 1_000_000);
    u64::try_from((used + whole / 2) / whole).unwrap_or(u64::MAX)
}
