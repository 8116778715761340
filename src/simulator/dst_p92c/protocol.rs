//! A DST P92C as it behaves on the bus: NMT, boot-up, SDO, LSS, heartbeat, EMCY, TPDO1. Pure.

use std::collections::VecDeque;
use std::time::Duration;

use super::super::emcy::Errors;
use super::super::lss_slave::{LssAddress, LssSlave};
use super::super::sdo_server::SdoServer;
use super::super::slave::{Slave, SlaveFaults, SlaveWork};
use super::dictionary::Objects;
use super::faults::Faults;
use super::hydraulics::Reading;
use super::measurement::Measurement;
use super::object_table::Key;
use super::services::{LSS_REQUEST, START_UP_ERROR};
use super::settings::{DstSettings, kbit};
use super::store::Store;
use super::tpdo::Tpdo;
use crate::can::{CanFrame, CanId};
use crate::canopen::{NmtRequest, NmtState, NodeId, cob_id};
use crate::time::{Instant, Now};

/// Most bytes of a download; all entries that can be written are numbers.
const LONGEST_DOWNLOAD: usize = 64;
/// 0x1F80: after initialisation the device enters Operational by itself (R-DST-058).
const SELF_START: u32 = 8;

/// The device. Powered off when made.
#[derive(Clone, Debug)]
pub struct DstP92c {
    pub(super) slave: Slave,
    pub(super) settings: DstSettings,
    pub(super) objects: Objects,
    pub(super) measurement: Measurement,
    pub(super) store: Store,
    pub(super) sdo: SdoServer,
    pub(super) lss: LssSlave,
    pub(super) errors: Errors,
    pub(super) tpdo: Tpdo,
    pub(super) faults: Faults,
    bus_kbit: u16,
    /// Index of the bit rate that the device runs at.
    bit_rate: u8,
    boot_at: Option<Instant>,
    pub(super) heartbeat_at: Option<Instant>,
    /// The end of the silence around a change of the bit rate.
    pub(super) switched_at: Option<Instant>,
    pub(super) answers: VecDeque<(Instant, [u8; 8])>,
}

/// What can become due.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Work {
    Slave(SlaveWork),
    FinishBoot,
    FinishSwitch,
    Answer,
    Heartbeat,
    Tpdo,
}

/// R-DST-082.
fn register_bits(code: u16) -> u8 {
    match code {
        0x8100 => 1 << 4,
        0x4000 => 1 << 3,
        0xF011 | 0x6363 => 1 << 5,
        0x6161 | 0x6300 => 1 << 7,
        _ => 0,
    }
}

impl DstP92c {
    /// A device without power, whose stored address is that of the settings.
    #[must_use]
    pub fn new(node: NodeId, settings: DstSettings) -> Self {
        let serial = settings.serial_number.wrapping_add(u32::from(node.get() - 1));
        let address =
            LssAddress { vendor: 0x23D, product: settings.product_code, revision: settings.revision, serial };
        Self {
            slave: Slave::new(node),
            objects: Objects::new(&settings, node, serial),
            measurement: Measurement::new(settings.span_bar),
            store: Store::new(node, settings.bit_rate),
            sdo: SdoServer::new(LONGEST_DOWNLOAD),
            lss: LssSlave::new(address),
            errors: Errors::new(register_bits),
            tpdo: Tpdo::default(),
            faults: Faults::default(),
            bus_kbit: settings.bus_kbit,
            bit_rate: settings.bit_rate,
            boot_at: None,
            heartbeat_at: None,
            switched_at: None,
            answers: VecDeque::new(),
            settings,
        }
    }

    /// Its node id.
    #[must_use]
    pub fn node(&self) -> NodeId {
        self.slave.node()
    }

    /// Its NMT state; `None` = powered off.
    #[must_use]
    pub fn state(&self) -> Option<NmtState> {
        self.slave.state()
    }

    /// The newest error that the device reports; 0 = none.
    #[must_use]
    pub fn error(&self) -> u16 {
        self.errors.code()
    }

    /// Whether it hears and can be heard: at another bit rate than the bus, or while it changes its own, it is deaf and
    /// mute.
    #[must_use]
    pub fn is_on_the_air(&self) -> bool {
        let fits = self.bus_kbit == 0 || kbit(self.bit_rate) == Some(self.bus_kbit);
        fits && self.switched_at.is_none()
    }

    /// Switches the power on. No effect when on.
    pub fn power_on(&mut self, now: Now) {
        self.advance(now.instant);
        if self.state().is_none() {
            self.errors.forget_what_was_told();
            self.boot(now.instant);
            self.advance(now.instant);
        }
    }

    /// Switches the power off: silence at once, and all but the memory is lost.
    pub fn power_off(&mut self, now: Now) {
        self.advance(now.instant);
        self.slave.power_off();
        self.silence();
        self.boot_at = None;
        self.lss.reset();
    }

    /// The sensors see something else.
    pub fn update(&mut self, now: Now, reading: Reading) {
        self.advance(now.instant);
        self.measurement.read(reading);
        self.measure(now.instant);
        self.advance(now.instant);
    }

    /// Switches faults of the device and of any slave on and off, and breaks sensors.
    pub fn update_faults(&mut self, now: Now, change: impl FnOnce(&mut Faults, &mut SlaveFaults)) {
        self.advance(now.instant);
        let mut slave = *self.slave.faults();
        let ordered = self.faults.error;
        change(&mut self.faults, &mut slave);
        self.slave.set_faults(now.instant, slave);
        self.measurement.broken = self.faults.broken;
        if let Some(code) = ordered {
            self.errors.set(code, self.faults.error == Some(code));
        }
        self.measure(now.instant);
        self.advance(now.instant);
    }

    /// The bus runs at another bit rate now.
    pub fn set_bus(&mut self, now: Now, kbit: u16) {
        self.advance(now.instant);
        self.bus_kbit = kbit;
    }

    /// Somebody has changed an object from inside.
    pub fn set_object(&mut self, now: Now, key: Key, raw: Option<u32>) {
        self.advance(now.instant);
        self.objects.set(key, raw);
        self.apply(now.instant, key);
        self.advance(now.instant);
    }

    /// Takes a frame that another participant sent.
    pub fn handle_frame(&mut self, now: Now, frame: &CanFrame) {
        self.advance(now.instant);
        self.receive(now.instant, frame);
        self.advance(now.instant);
    }

    /// What became due.
    pub fn handle_timeout(&mut self, now: Now) {
        self.advance(now.instant);
    }

    /// The next frame to send; call until `None`.
    pub fn poll_output(&mut self) -> Option<CanFrame> {
        self.slave.poll_output()
    }

    /// When `handle_timeout` is to be called at the latest.
    #[must_use]
    pub fn poll_timeout(&self) -> Option<Instant> {
        self.next_work().map(|(due, _)| due)
    }

    /// Does what is due, in the order of time. Ends, because all work moves its own deadline beyond `now`.
    fn advance(&mut self, now: Instant) {
        while let Some((_, work)) = self.next_work().filter(|(due, _)| *due <= now) {
            self.perform(now, work);
        }
    }

    fn next_work(&self) -> Option<(Instant, Work)> {
        let slave = self.slave.next_work().map(|(due, work)| (due, Work::Slave(work)));
        let own = [
            (self.boot_at, Work::FinishBoot),
            (self.switched_at, Work::FinishSwitch),
            (self.answers.front().map(|(due, _)| *due), Work::Answer),
            (self.heartbeat_at, Work::Heartbeat),
            (self.tpdo.due(&self.objects), Work::Tpdo),
        ];
        let own = own.into_iter().filter_map(|(due, work)| Some((due?, work)));
        slave.into_iter().chain(own).min_by_key(|(due, _)| *due)
    }

    fn perform(&mut self, now: Instant, work: Work) {
        match work {
            Work::Slave(SlaveWork::Restart) => self.boot(now),
            Work::Slave(work @ (SlaveWork::ForeignStop | SlaveWork::ForeignGuard)) => {
                if let Some(frame) = self.slave.interfere(now, work) {
                    self.receive(now, &frame);
                }
            }
            Work::FinishBoot => self.finish_boot(now),
            Work::FinishSwitch => {
                // R-DST-102: the old node id, and Stopped as before.
                self.switched_at = None;
                self.bit_rate = self.store.bit_rate;
                self.send_boot_up();
            }
            Work::Answer => {
                if let Some((_, answer)) = self.answers.pop_front() {
                    self.send(CanId::Standard(0x580 + u16::from(self.node().get())), &answer);
                }
            }
            Work::Heartbeat => {
                self.schedule_heartbeat(now);
                if let Some(state) = self.state().filter(|_| !self.faults.mute_heartbeat) {
                    self.send(cob_id::error_control(self.node()), &[state.code()]);
                }
            }
            Work::Tpdo => {
                let pdo = self.tpdo.take(now, &self.objects);
                if let Some((id, payload)) = pdo.filter(|_| !self.faults.mute_pdo) {
                    self.send(id, &payload);
                }
            }
        }
    }

    pub(super) fn send(&mut self, id: CanId, data: &[u8]) {
        if self.is_on_the_air() {
            self.slave.send(id, data);
        }
    }

    pub(super) fn send_boot_up(&mut self) {
        if self.is_on_the_air() {
            self.slave.send_boot_up();
        }
    }

    /// Everything that is under way ends.
    fn silence(&mut self) {
        self.tpdo.stop();
        self.sdo.reset();
        self.answers.clear();
        (self.heartbeat_at, self.switched_at) = (None, None);
    }

    /// Power-on or reset node: what is stored becomes active (R-DST-117).
    fn boot(&mut self, now: Instant) {
        self.silence();
        self.lss.reset();
        self.slave.boot(now);
        self.slave.set_node(self.store.node);
        self.bit_rate = self.store.bit_rate;
        self.measurement.zero_pa = self.store.zero_pa;
        self.measurement.forget_status();
        self.objects.set_node(self.store.node);
        self.objects.load(&self.store, |_| true);
        self.boot_at = Some(now + self.settings.boot);
    }

    fn finish_boot(&mut self, now: Instant) {
        self.boot_at = None;
        self.errors.set(START_UP_ERROR, self.faults.boot_error);
        self.slave.enter(NmtState::PreOperational);
        self.measurement.show(&mut self.objects);
        self.find_errors();
        // R-DST-051, R-DST-052.
        if !self.errors.any() || self.settings.boot_on_error {
            self.send_boot_up();
        }
        self.errors.forget_what_was_told();
        self.tell_errors();
        self.schedule_heartbeat(now);
        if self.objects.raw((0x1F80, 0)) == SELF_START {
            self.start(now);
        }
    }

    fn start(&mut self, now: Instant) {
        if self.state() != Some(NmtState::Operational) {
            self.slave.enter(NmtState::Operational);
            self.tpdo.start(now, &self.objects);
            self.tell_errors();
        }
    }

    pub(super) fn schedule_heartbeat(&mut self, now: Instant) {
        let period = u64::from(self.objects.raw((0x1017, 0)));
        self.heartbeat_at = (period != 0).then(|| now + Duration::from_millis(period));
    }

    fn receive(&mut self, now: Instant, frame: &CanFrame) {
        if self.state().is_none_or(|state| state == NmtState::Initialising) || !self.is_on_the_air() {
            return;
        }
        if let Some(request) = self.slave.command(frame) {
            // R-DST-093.
            if !self.lss.is_in_configuration() {
                self.obey(now, request);
            }
            return;
        }
        // Remote frames ask for nothing here; an identifier of 29 bits is another one (R-DST-005).
        let (false, id) = (frame.is_remote(), frame.id()) else { return };
        if id == self.sdo_request() {
            self.serve(now, frame.data());
        } else if id == LSS_REQUEST {
            self.configure(now, frame.data());
        } else if Some(id) == self.sync() && frame.data().len() <= 1 {
            self.tpdo.handle_sync(now, self.settings.reply_delay, &self.objects);
        }
    }

    /// The identifier of SYNC.
    pub(super) fn sync(&self) -> Option<CanId> {
        u16::try_from(self.objects.raw((0x1005, 0))).ok().and_then(CanId::standard)
    }

    /// Where SDO requests to it come.
    pub(super) fn sdo_request(&self) -> CanId {
        CanId::Standard(0x600 + u16::from(self.node().get()))
    }

    fn obey(&mut self, now: Instant, request: NmtRequest) {
        match request {
            NmtRequest::Start => self.start(now),
            NmtRequest::Stop => {
                self.slave.enter(NmtState::Stopped);
                self.tpdo.stop();
            }
            NmtRequest::EnterPreOperational => {
                self.slave.enter(NmtState::PreOperational);
                self.tpdo.stop();
                self.tell_errors();
            }
            NmtRequest::ResetNode => self.boot(now),
            NmtRequest::ResetCommunication => {
                self.silence();
                self.slave.boot(now);
                self.objects.load(&self.store, |index| (0x1000..0x2000).contains(&index));
                self.boot_at = Some(now + self.settings.boot);
            }
        }
    }
}
