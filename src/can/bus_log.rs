//! What the log is told of one bus. Pure, but for the log.

use super::outage::{Outage, OutageMessage, Repeats};
use super::{BusCounters, BusError, Link};
use crate::time::Instant;

/// What the log has been told of a bus.
#[derive(Debug)]
pub struct BusLog {
    interface: String,
    outage: Outage,
    passive: Repeats,
    suspected_bit_rate: bool,
    told_of_acknowledging: bool,
}

impl BusLog {
    /// For the interface that is written so in the configuration.
    #[must_use]
    pub fn new(interface: &str) -> Self {
        Self {
            interface: interface.to_owned(),
            outage: Outage::default(),
            passive: Repeats::default(),
            suspected_bit_rate: false,
            told_of_acknowledging: false,
        }
    }

    /// The state of the link has changed.
    pub fn handle_link(&mut self, link: Link, at: Instant) {
        let message = match self.trouble(link) {
            Some(reason) => self.outage.handle_down(&reason, at),
            None => self.outage.handle_up(at),
        };
        self.write(message);
        let interface = &self.interface;
        if link == Link::ErrorActive {
            tracing::debug!(interface, "error active");
        }
        if link == Link::ErrorPassive
            && let Some(unsaid) = self.passive.admit(at)
        {
            let text = "error passive: nobody acknowledges, or wiring or bit rate are wrong";
            tracing::warn!(interface, unsaid, "{text}");
        }
    }

    /// The bus could not be opened, or was lost.
    pub fn handle_error(&mut self, error: &BusError, now: Instant) {
        let message = self.outage.handle_down(&format!("{error}; trying again until it works"), now);
        self.write(message);
    }

    /// To be called once a second or so.
    pub fn handle_timeout(&mut self, now: Instant) {
        let message = self.outage.handle_timeout(now);
        self.write(message);
    }

    /// There are new counters. Whether they are told as those of a wrong bit rate: once is enough (R-DET-089).
    pub fn handle_counters(&mut self, counters: &BusCounters) -> bool {
        if self.suspected_bit_rate || !counters.bit_rate_is_suspect() {
            return false;
        }
        self.suspected_bit_rate = true;
        let bit_rate = counters.bit_rate.map_or_else(|| "unknown".to_owned(), |rate| format!("{rate} bit/s"));
        tracing::warn!(
            interface = self.interface,
            bit_rate,
            error_frames = counters.error_frames,
            "errors and not one valid frame: the bit rate may differ from that of the bus; else look at the wiring \
             and the terminators"
        );
        true
    }

    /// Whether the controller of an interface that should only listen does so, as far as that is known. Whether it is told
    /// that it does not: once is enough.
    pub fn handle_listening(&mut self, listens_only: Option<bool>) -> bool {
        if listens_only != Some(false) || self.told_of_acknowledging {
            return false;
        }
        self.told_of_acknowledging = true;
        tracing::warn!(
            interface = self.interface,
            "the passive role sends no frame, but this interface acknowledges those of others, and disturbs the bus at \
             a wrong bit rate; where the controller can, `ip link set {0} down` and \
             `ip link set {0} up type can listen-only on`",
            self.interface
        );
        true
    }

    /// Why a bus in this state cannot be used, if so.
    fn trouble(&self, link: Link) -> Option<String> {
        let interface = &self.interface;
        // Only the names of the host's interfaces have no colon.
        let is_of_the_host = !interface.contains(':');
        match link {
            Link::ErrorActive | Link::ErrorPassive => None,
            Link::BusOff if is_of_the_host => Some(format!(
                "bus-off: the controller has left the bus; it comes back by itself where the interface has a \
                 restart-ms, else with `ip link set {interface} type can restart`"
            )),
            Link::BusOff => Some("bus-off: the controller has left the bus".to_owned()),
            Link::Down | Link::Absent => {
                Some(format!("the interface is down; bring it up with `ip link set {interface} up`"))
            }
        }
    }

    fn write(&self, message: Option<OutageMessage>) {
        let interface = &self.interface;
        match message {
            Some(OutageMessage::Begun { reason, unsaid }) => tracing::warn!(interface, unsaid, "{reason}"),
            Some(OutageMessage::Over { lasted }) => {
                tracing::info!(interface, seconds = lasted.as_secs(), "the bus works again");
            }
            None => {}
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_bus_that_is_down_or_off_is_in_trouble_and_its_end_is_told() {
        for link in [Link::Absent, Link::Down, Link::BusOff] {
            let mut log = BusLog::new("can0");
            log.handle_link(link, Instant::START);
            assert!(log.outage.handle_up(Instant::START).is_some(), "{link:?}");
        }
        for link in [Link::ErrorActive, Link::ErrorPassive] {
            assert_eq!(BusLog::new("can0").trouble(link), None);
        }
    }

    #[test]
    fn only_an_interface_of_the_host_is_restarted_by_the_host() {
        let hint = |interface| BusLog::new(interface).trouble(Link::BusOff).unwrap().contains("ip link set");
        assert!(hint("can0"));
        assert!(!hint("slcan:/dev/ttyACM0?bitrate=125000"));
    }

    #[test]
    fn r_det_089_a_suspected_bit_rate_is_told_once() {
        let mut log = BusLog::new("can0");
        assert!(!log.handle_counters(&BusCounters::default()));
        let suspect = BusCounters { bus_off_count: 1, ..BusCounters::default() };
        assert!(log.handle_counters(&suspect));
        assert!(!log.handle_counters(&suspect));
    }

    #[test]
    fn an_interface_that_acknowledges_in_the_passive_role_is_told_of_once() {
        let mut log = BusLog::new("can0");
        assert!(!log.handle_listening(None), "no controller, or nothing is known");
        assert!(!log.handle_listening(Some(true)));
        assert!(log.handle_listening(Some(false)));
        assert!(!log.handle_listening(Some(false)));
    }
}
