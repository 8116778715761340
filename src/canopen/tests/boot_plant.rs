//! A device in the form of a table of objects, and a network that configures it, for tests of the boot.

use std::collections::BTreeMap;
use std::time::Duration;

use super::bench::{detcon, master};
use crate::can::{CanFrame, CanId};
use crate::canopen::boot::{BootEvent, BootSettings, BootStep, MappingMode, PdoSetup};
use crate::canopen::object::{MappedObject, ObjectId};
use crate::canopen::polls::Poll;
use crate::canopen::sdo::SdoSettings;
use crate::canopen::{
    ErrorControl, Network, NetworkOutput, NmtState, NodeEvent, NodeSettings, PdoIndex, PdoSettings,
    RpdoSettings, RpdoTrigger,
};
use crate::time::Now;

pub(super) const fn object(index: u16, sub: u8) -> ObjectId {
    ObjectId::new(index, sub)
}

/// A device of the kind of DST P92C: expedited SDO, heartbeat every 500 ms once its producer time is set, one TPDO.
pub(super) struct Device {
    pub(super) objects: BTreeMap<ObjectId, Vec<u8>>,
    pub(super) state: NmtState,
    /// Objects in the order in which they were written, and the state in which.
    pub(super) writes: Vec<(ObjectId, NmtState)>,
    pub(super) refuse: Option<(ObjectId, u32)>,
    pub(super) mute: bool,
}

impl Device {
    pub(super) fn new() -> Self {
        let objects = [
            (object(0x1000, 0), 0x0002_0194_u32.to_le_bytes().to_vec()),
            (object(0x1010, 1), 1_u32.to_le_bytes().to_vec()),
            (object(0x1017, 0), 0_u16.to_le_bytes().to_vec()),
            (object(0x1018, 1), 0x23D_u32.to_le_bytes().to_vec()),
            (object(0x1800, 1), 0x181_u32.to_le_bytes().to_vec()),
            (object(0x1800, 2), vec![1]),
            (object(0x1800, 3), vec![0, 0]),
            (object(0x1800, 5), 1000_u16.to_le_bytes().to_vec()),
            (object(0x1A00, 0), vec![2]),
            (object(0x1A00, 1), 0x9130_0120_u32.to_le_bytes().to_vec()),
            (object(0x1A00, 2), 0x6150_0108_u32.to_le_bytes().to_vec()),
            (object(0x6131, 1), 0x0022_0000_u32.to_le_bytes().to_vec()),
        ];
        Self {
            objects: objects.into_iter().collect(),
            state: NmtState::PreOperational,
            writes: Vec::new(),
            refuse: None,
            mute: false,
        }
    }

    pub(super) fn answer(&mut self, request: &CanFrame) -> Option<CanFrame> {
        let reply = |data: [u8; 8]| CanFrame::data_frame(CanId::Standard(0x581), &data);
        if request.id() == CanId::Standard(0) {
            self.state = match request.data()[0] {
                1 => NmtState::Operational,
                2 => NmtState::Stopped,
                _ => NmtState::PreOperational,
            };
            return None;
        }
        if self.mute || request.id() != CanId::Standard(0x601) {
            return None;
        }
        assert_ne!(self.state, NmtState::Stopped, "{request}: a stopped node takes no SDO requests");
        let data: [u8; 8] = request.data().try_into().unwrap();
        let (low, high, sub) = (data[1], data[2], data[3]);
        let object = ObjectId::new(u16::from_le_bytes([low, high]), sub);
        if let Some((refused, code)) = self.refuse
            && refused == object
            && data[0] != 0x40
        {
            let [a, b, c, d] = code.to_le_bytes();
            return reply([0x80, low, high, sub, a, b, c, d]);
        }
        if data[0] == 0x40 {
            let Some(value) = self.objects.get(&object) else {
                return reply([0x80, low, high, sub, 0, 0, 2, 6]);
            };
            let mut answer = [0x43 | u8::try_from(4 - value.len()).unwrap() << 2, low, high, sub, 0, 0, 0, 0];
            answer[4..4 + value.len()].copy_from_slice(value);
            return reply(answer);
        }
        let length = 4 - usize::from(data[0] >> 2 & 3);
        self.objects.insert(object, data[4..4 + length].to_vec());
        self.writes.push((object, self.state));
        reply([0x60, low, high, sub, 0, 0, 0, 0])
    }
}

pub(super) struct Plant {
    pub(super) network: Network,
    pub(super) device: Device,
    pub(super) now: u64,
    pub(super) told: Vec<BootEvent>,
    pub(super) begun: u32,
    /// Of each reading of the polled object whether it succeeded.
    pub(super) polled: Vec<bool>,
    pub(super) nmt: Vec<String>,
    /// States that were told, and whether they were ordered.
    pub(super) states: Vec<(NmtState, bool)>,
    /// TPDOs came that were no longer expected.
    pub(super) surprises: u32,
    /// Arrives when the next NMT command is sent, before the device has it.
    pub(super) in_flight: Option<&'static str>,
    /// When RPDOs were sent.
    pub(super) rpdos: Vec<u64>,
}

pub(super) fn setup(mode: MappingMode, set_invalid: bool) -> PdoSetup {
    let maps = [0x6130_0120, 0x9130_0220].map(MappedObject::from_entry).to_vec();
    PdoSetup {
        pdo: PdoIndex(0),
        number: 1,
        mode,
        maps,
        transmission_type: Some(255),
        inhibit_time: None,
        event_timer: Some(100),
        set_invalid,
    }
}

pub(super) fn steps() -> Vec<BootStep> {
    vec![
        BootStep::Identity { object: object(0x1000, 0), expected: 0x0002_0194, tolerated: false },
        BootStep::Identity { object: object(0x1018, 1), expected: 0x23D, tolerated: false },
        BootStep::Write { object: object(0x1017, 0), data: 500_u16.to_le_bytes().to_vec(), optional: false },
        BootStep::Pdo(setup(MappingMode::Write, false)),
        BootStep::Read { object: object(0x6131, 1) },
        BootStep::Save,
    ]
}

impl Plant {
    pub(super) fn new(steps: Vec<BootStep>) -> Self {
        Self::with(steps, |_| ())
    }

    pub(super) fn with(steps: Vec<BootStep>, change: impl FnOnce(&mut NodeSettings)) -> Self {
        let mut node = NodeSettings {
            error_control: ErrorControl::Heartbeat { timeout: Duration::from_millis(1500) },
            sdo: Some(SdoSettings::default()),
            boot: BootSettings { steps, ..BootSettings::default() },
            polls: vec![Poll {
                object: object(0x6131, 1),
                period: Duration::from_secs(1),
                length: 4,
                read_by_boot: false,
                unless_sent: None,
            }],
            pdos: vec![PdoSettings {
                number: 1,
                cob_id: CanId::Standard(0x181),
                length: 8,
                strict_length: false,
                timeout: None,
                synchronous: false,
                shortest_period: None,
            }],
            rpdos: vec![RpdoSettings {
                number: 1,
                cob_id: CanId::Standard(0x201),
                length: 2,
                trigger: RpdoTrigger::Event,
                refresh: Some(Duration::from_secs(1)),
                inhibit: Duration::ZERO,
            }],
            ..detcon(1)
        };
        change(&mut node);
        let network = Network::new(master(vec![node]), Now::from_millis(0));
        Self {
            network,
            device: Device::new(),
            now: 0,
            told: Vec::new(),
            begun: 0,
            polled: Vec::new(),
            nmt: Vec::new(),
            states: Vec::new(),
            surprises: 0,
            in_flight: None,
            rpdos: Vec::new(),
        }
    }

    pub(super) fn drain(&mut self) {
        while let Some(output) = self.network.poll_output() {
            match output {
                NetworkOutput::Transmit(frame) => {
                    if frame.id() == CanId::Standard(0) {
                        self.nmt.push(frame.to_string());
                        if let Some(frame) = self.in_flight.take() {
                            self.network.handle_frame(Now::from_millis(self.now), &frame.parse().unwrap());
                        }
                        self.device.answer(&frame);
                        let state = [self.device.state.code()];
                        let heartbeat = CanFrame::data_frame(CanId::Standard(0x701), &state).unwrap();
                        self.network.handle_frame(Now::from_millis(self.now), &heartbeat);
                    }
                    if frame.id() == CanId::Standard(0x201) {
                        self.rpdos.push(self.now);
                    }
                    if let Some(answer) = self.device.answer(&frame) {
                        self.network.handle_frame(Now::from_millis(self.now), &answer);
                    }
                }
                NetworkOutput::Node(_, NodeEvent::Boot(BootEvent::Begun)) => self.begun += 1,
                NetworkOutput::Node(_, NodeEvent::Boot(event)) => self.told.push(event),
                NetworkOutput::Node(_, NodeEvent::Polled { result, .. }) => self.polled.push(result.is_ok()),
                NetworkOutput::Node(_, NodeEvent::State { to, ordered, .. }) => {
                    self.states.push((to, ordered));
                }
                NetworkOutput::Node(_, NodeEvent::PdoInUnexpectedState { .. }) => self.surprises += 1,
                NetworkOutput::Node(..) | NetworkOutput::Foreign(_) => {}
            }
        }
    }

    pub(super) fn frame(&mut self, text: &str) {
        self.network.handle_frame(Now::from_millis(self.now), &text.parse().unwrap());
        self.drain();
    }

    /// Runs timers; the device sends its heartbeat once that is switched on.
    pub(super) fn run(&mut self, millis: u64) -> &mut Self {
        let end = self.now + millis;
        while self.now < end {
            self.now += 1;
            let now = Now::from_millis(self.now);
            if self.network.poll_timeout().is_some_and(|(at, _)| at <= now.instant) {
                self.network.handle_timeout(now);
                self.drain();
            }
            let period = self.device.objects.get(&object(0x1017, 0)).filter(|_| !self.device.mute);
            let period = period.map_or(0, |data| u64::from(u16::from_le_bytes([data[0], data[1]])));
            if period > 0 && self.now.is_multiple_of(period) {
                self.frame(&format!("701#{:02X}", self.device.state.code()));
            }
        }
        self
    }

    pub(super) fn link_up(&mut self) -> &mut Self {
        self.network.handle_link(Now::from_millis(self.now), true);
        self.drain();
        self.run(1400)
    }

    pub(super) fn written(&self) -> Vec<String> {
        self.device.writes.iter().map(|(object, _)| object.to_string()).collect()
    }
}
