//! A node that is configured before it is started, against a device in the form of a table of objects.

use std::collections::BTreeMap;
use std::time::Duration;

use super::bench::{detcon, master};
use crate::can::{CanFrame, CanId};
use crate::canopen::boot::{BootEvent, BootFailure, BootSettings, BootStep, MappingMode, PdoSetup};
use crate::canopen::object::{MappedObject, ObjectId};
use crate::canopen::polls::Poll;
use crate::canopen::sdo::SdoSettings;
use crate::canopen::{
    ErrorControl, Network, NetworkOutput, NmtRequest, NmtState, NodeEvent, NodeId, NodeSettings, PdoIndex,
    PdoSettings, RpdoIndex, RpdoSettings, RpdoTrigger,
};
use crate::time::Now;

const fn object(index: u16, sub: u8) -> ObjectId {
    ObjectId::new(index, sub)
}

/// A device of the kind of DST P92C: expedited SDO, heartbeat every 500 ms once its producer time is set, one TPDO.
struct Device {
    objects: BTreeMap<ObjectId, Vec<u8>>,
    state: NmtState,
    /// Objects in the order in which they were written, and the state in which.
    writes: Vec<(ObjectId, NmtState)>,
    refuse: Option<(ObjectId, u32)>,
    mute: bool,
}

impl Device {
    fn new() -> Self {
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

    fn answer(&mut self, request: &CanFrame) -> Option<CanFrame> {
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

struct Plant {
    network: Network,
    device: Device,
    now: u64,
    told: Vec<BootEvent>,
    begun: u32,
    /// Of each reading of the polled object whether it succeeded.
    polled: Vec<bool>,
    nmt: Vec<String>,
    /// When RPDOs were sent.
    rpdos: Vec<u64>,
}

fn setup(mode: MappingMode, set_invalid: bool) -> PdoSetup {
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

fn steps() -> Vec<BootStep> {
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
    fn new(steps: Vec<BootStep>) -> Self {
        let node = NodeSettings {
            error_control: ErrorControl::Heartbeat { timeout: Duration::from_millis(1500) },
            sdo: Some(SdoSettings::default()),
            boot: BootSettings { steps, ..BootSettings::default() },
            polls: vec![Poll {
                object: object(0x6131, 1),
                period: Duration::from_secs(1),
                length: 4,
                read_by_boot: false,
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
        let network = Network::new(master(vec![node]), Now::from_millis(0));
        Self {
            network,
            device: Device::new(),
            now: 0,
            told: Vec::new(),
            begun: 0,
            polled: Vec::new(),
            nmt: Vec::new(),
            rpdos: Vec::new(),
        }
    }

    fn drain(&mut self) {
        while let Some(output) = self.network.poll_output() {
            match output {
                NetworkOutput::Transmit(frame) => {
                    if frame.id() == CanId::Standard(0) {
                        self.nmt.push(frame.to_string());
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
                NetworkOutput::Node(..) | NetworkOutput::Foreign(_) => {}
            }
        }
    }

    fn frame(&mut self, text: &str) {
        self.network.handle_frame(Now::from_millis(self.now), &text.parse().unwrap());
        self.drain();
    }

    /// Runs timers; the device sends its heartbeat once that is switched on.
    fn run(&mut self, millis: u64) -> &mut Self {
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

    fn link_up(&mut self) -> &mut Self {
        self.network.handle_link(Now::from_millis(self.now), true);
        self.drain();
        self.run(1400)
    }

    fn written(&self) -> Vec<String> {
        self.device.writes.iter().map(|(object, _)| object.to_string()).collect()
    }
}

#[test]
fn r_dst_024_a_node_is_identified_configured_in_the_right_order_and_then_started() {
    let mut plant = Plant::new(steps());
    plant.link_up();
    let expected =
        ["0x1017:0", "0x1800:2", "0x1800:5", "0x1A00:0", "0x1A00:1", "0x1A00:2", "0x1A00:0", "0x1010:1"];
    assert_eq!(plant.written(), expected);
    assert_eq!(plant.device.objects[&object(0x1A00, 1)], 0x6130_0120_u32.to_le_bytes());
    assert_eq!(plant.device.objects[&object(0x1A00, 0)], [2]);
    assert_eq!(plant.nmt, ["000#8001", "000#0101"], "it might have run; started once, when all is done");
    assert!(plant.told.contains(&BootEvent::Object {
        object: object(0x6131, 1),
        data: Some(0x0022_0000_u32.to_le_bytes().to_vec())
    }));
    assert_eq!(plant.told.last(), Some(&BootEvent::Done { written: 7 }));
}

#[test]
fn r_dst_090_a_gateway_that_starts_again_writes_nothing_and_does_not_stop_the_node() {
    let mut plant = Plant::new(steps());
    plant.link_up();
    let mut again = Plant::new(steps());
    again.device = plant.device;
    again.device.writes.clear();
    again.frame("701#05");
    again.link_up();
    assert_eq!(again.written(), Vec::<String>::new());
    assert_eq!(again.nmt, Vec::<String>::new());
    assert_eq!(again.told.last(), Some(&BootEvent::Done { written: 0 }));
}

#[test]
fn r_dst_023_an_operational_node_is_made_pre_operational_before_its_mapping_is_changed() {
    let mut plant = Plant::new(vec![BootStep::Pdo(setup(MappingMode::Write, true))]);
    plant.device.state = NmtState::Operational;
    plant.frame("701#05");
    plant.link_up();
    assert_eq!(plant.nmt, ["000#8001", "000#0101"]);
    assert!(plant.device.writes.iter().all(|(_, state)| *state == NmtState::PreOperational));
    let expected =
        ["0x1800:2", "0x1800:5", "0x1800:1", "0x1A00:0", "0x1A00:1", "0x1A00:2", "0x1A00:0", "0x1800:1"];
    assert_eq!(plant.written(), expected);
    assert_eq!(
        plant.device.objects[&object(0x1800, 1)],
        0x181_u32.to_le_bytes(),
        "valid again, else as it was"
    );
}

#[test]
fn r_dst_023_a_node_whose_state_is_not_known_is_made_pre_operational_before_its_mapping_is_changed() {
    let mut plant = Plant::new(vec![BootStep::Pdo(setup(MappingMode::Write, false))]);
    plant.device.state = NmtState::Operational;
    plant.link_up();
    assert_eq!(plant.nmt, ["000#8001", "000#0101"]);
    assert!(plant.device.writes.iter().all(|(_, state)| *state == NmtState::PreOperational));
    // One that is as it should be is not disturbed.
    let mut again = Plant::new(vec![BootStep::Pdo(setup(MappingMode::Write, false))]);
    again.device = plant.device;
    again.link_up();
    assert!(!again.nmt.contains(&"000#8001".to_owned()), "{:?}", again.nmt);
}

#[test]
fn r_dst_001_another_device_is_not_started_and_the_letter_says_why() {
    let mut plant = Plant::new(steps());
    plant.device.objects.insert(object(0x1018, 1), 0x1_u32.to_le_bytes().to_vec());
    plant.link_up().run(60_000);
    assert_eq!(plant.nmt, Vec::<String>::new());
    assert_eq!(plant.written(), Vec::<String>::new());
    let expected =
        BootFailure::Identity { object: object(0x1018, 1), expected: 0x23D, found: 1, letter: 'D' };
    assert_eq!(plant.told, [BootEvent::Failed(expected)], "told once, though it is tried again");
    plant.frame("701#7F");
    assert_eq!(plant.nmt, Vec::<String>::new());
}

#[test]
fn r_dst_053_a_silent_node_is_asked_ever_more_seldom_and_at_once_when_it_shows_itself() {
    let mut plant = Plant::new(steps());
    plant.device.mute = true;
    plant.link_up().run(120_000);
    assert_eq!(plant.told, [BootEvent::Failed(BootFailure::NoAnswer)]);
    plant.device.mute = false;
    plant.frame("081#11F0210000000000");
    plant.run(1000);
    let done = plant.told.iter().any(|event| matches!(event, BootEvent::Done { .. }));
    assert!(done, "R-DST-052: an EMCY is a sign of life");
    assert_eq!(plant.nmt, ["000#8001", "000#0101"]);
}

#[test]
fn r_dst_080_081_a_node_is_asked_what_is_wrong_with_it_and_a_refusal_is_no_error() {
    let told = |register: Option<u8>, newest: Option<u32>| {
        let mut plant = Plant::new(vec![BootStep::Errors]);
        // K-DST-09: a count of 1 says nothing.
        plant.device.objects.insert(object(0x1003, 0), vec![1]);
        plant.device.objects.extend(register.map(|register| (object(0x1001, 0), vec![register])));
        plant.device.objects.extend(newest.map(|newest| (object(0x1003, 1), newest.to_le_bytes().to_vec())));
        plant.link_up();
        assert_eq!(plant.told.last(), Some(&BootEvent::Done { written: 0 }));
        plant.told.remove(0)
    };
    assert_eq!(told(Some(0x21), Some(0x0021_F011)), BootEvent::Errors { register: Some(0x21), code: 0xF011 });
    assert_eq!(told(Some(0), Some(0)), BootEvent::Errors { register: Some(0), code: 0 });
    assert_eq!(told(Some(1), None), BootEvent::Errors { register: Some(1), code: 0 });
    assert_eq!(told(None, None), BootEvent::Errors { register: None, code: 0 });
}

#[test]
fn r_dst_052_a_lost_node_that_sends_an_emergency_message_instead_of_a_boot_up_is_booted() {
    let mut plant = Plant::new(steps());
    plant.link_up().run(3000);
    plant.device.mute = true;
    plant.run(3000);
    plant.told.clear();
    plant.device = Device::new();
    for _ in 0..3 {
        plant.frame("081#0063810000000000");
    }
    assert_eq!(plant.begun, 2, "once, however many there are");
    plant.run(3000);
    assert!(plant.told.iter().any(|event| matches!(event, BootEvent::Done { .. })), "{:?}", plant.told);
    assert_eq!(plant.device.state, NmtState::Operational);
}

#[test]
fn r_dst_052_so_is_one_that_sent_it_before_it_was_missed() {
    let mut plant = Plant::new(steps());
    plant.link_up().run(3000);
    plant.told.clear();
    plant.device = Device::new();
    plant.frame("081#0063810000000000");
    plant.run(10_000);
    assert!(plant.told.iter().any(|event| matches!(event, BootEvent::Done { .. })), "{:?}", plant.told);
    assert_eq!(plant.device.state, NmtState::Operational);
}

#[test]
fn r_dst_064_a_boot_up_message_begins_everything_anew() {
    let mut plant = Plant::new(steps());
    plant.link_up();
    plant.told.clear();
    plant.device.objects = Device::new().objects;
    plant.device.state = NmtState::PreOperational;
    plant.frame("701#00");
    plant.run(1000);
    assert_eq!(plant.told.last(), Some(&BootEvent::Done { written: 7 }));
    assert_eq!(plant.nmt, ["000#8001", "000#0101", "000#0101"], "one that booted is pre-operational");
}

#[test]
fn r_dst_024_verify_tells_and_adopt_takes_what_the_node_has() {
    for (mode, tells) in [(MappingMode::Verify, true), (MappingMode::Adopt { timed: true }, false)] {
        let mut plant = Plant::new(vec![BootStep::Pdo(setup(mode, false))]);
        plant.link_up();
        assert_eq!(plant.written(), Vec::<String>::new(), "{mode:?}");
        let deviation = plant.told.contains(&BootEvent::Deviation { pdo: PdoIndex(0) });
        assert_eq!(deviation, tells, "{mode:?}");
        let mapped = plant
            .told
            .iter()
            .find_map(|event| if let BootEvent::Mapped(mapped) = event { Some(mapped) } else { None });
        let mapped = mapped.unwrap();
        assert_eq!(mapped.length(), 5);
        assert_eq!(
            mapped.maps.iter().map(|each| each.entry()).collect::<Vec<_>>(),
            [0x9130_0120, 0x6150_0108]
        );
        plant.frame("181#A086010000");
    }
}

#[test]
fn r_dst_119_a_tpdo_on_another_identifier_is_taken_from_there() {
    let mut plant = Plant::new(vec![BootStep::Pdo(setup(MappingMode::Adopt { timed: true }, false))]);
    plant.device.objects.insert(object(0x1800, 1), 0x1A5_u32.to_le_bytes().to_vec());
    plant.link_up();
    let node = NodeId::new(1).unwrap();
    let received = |plant: &mut Plant, frame: &str| {
        plant.network.handle_frame(Now::from_millis(plant.now), &frame.parse().unwrap());
        std::iter::from_fn(|| plant.network.poll_output())
            .any(|output| matches!(output, NetworkOutput::Node(id, NodeEvent::Pdo { .. }) if id == node))
    };
    assert!(received(&mut plant, "1A5#A086010000"));
    // Bit 29: it has 29 bits.
    plant.device.objects.insert(object(0x1800, 1), 0x2001_2345_u32.to_le_bytes().to_vec());
    plant.frame("701#00");
    plant.run(1000);
    assert!(received(&mut plant, "00012345#A086010000"));
    assert!(!received(&mut plant, "1A5#A086010000"));
    plant.device.objects.insert(object(0x1800, 1), 0x1A5_u32.to_le_bytes().to_vec());
    plant.frame("701#00");
    plant.run(1000);
    assert!(!received(&mut plant, "181#A086010000"));
}

#[test]
fn k_dst_15_a_setting_that_may_be_refused_does_not_keep_the_node_from_starting() {
    let write = |optional| BootStep::Write { object: object(0x6131, 1), data: vec![0, 0, 0x4E, 0], optional };
    for optional in [true, false] {
        let mut plant = Plant::new(vec![write(optional)]);
        plant.device.refuse = Some((object(0x6131, 1), 0x0609_0030));
        plant.link_up();
        assert_eq!(plant.nmt.len(), usize::from(optional));
    }
}

#[test]
fn r_dst_071_a_stopped_node_is_made_pre_operational_before_it_is_asked() {
    let mut plant = Plant::new(steps());
    plant.network.handle_link(Now::from_millis(0), true);
    plant.frame("701#04");
    plant.device.state = NmtState::Stopped;
    plant.run(3000);
    assert_eq!(plant.nmt.first().map(String::as_str), Some("000#8001"));
    assert_eq!(plant.nmt.last().map(String::as_str), Some("000#0101"));
}

#[test]
fn r_dst_034_what_was_known_is_forgotten_at_every_boot_up_and_when_the_bus_was_away() {
    let mut plant = Plant::new(steps());
    plant.link_up();
    assert_eq!(plant.begun, 1);
    plant.network.handle_link(Now::from_millis(plant.now), false);
    plant.link_up();
    assert_eq!(plant.begun, 2);
    plant.frame("701#00");
    assert_eq!(plant.begun, 3, "at once, not when it is asked");
}

#[test]
fn r_dst_071_088_a_stopped_node_is_not_read_and_its_polled_values_are_not_kept_alive() {
    let mut plant = Plant::new(steps());
    plant.link_up().run(2000);
    assert!(plant.polled.len() >= 3 && plant.polled.iter().all(|good| *good), "{:?}", plant.polled);
    plant.network.request_nmt(Now::from_millis(plant.now), NodeId::new(1), NmtRequest::Stop);
    plant.drain();
    plant.polled.clear();
    plant.run(3000);
    assert!(plant.polled.len() >= 2 && plant.polled.iter().all(|good| !*good), "{:?}", plant.polled);
}

/// The device with an RPDO that carries 0x6411:1 at 0x201, looked at before it is started.
fn with_rpdo(mode: MappingMode, cob_id: u32) -> Plant {
    let setup = PdoSetup {
        maps: vec![MappedObject::from_entry(0x6411_0110)],
        transmission_type: None,
        event_timer: None,
        ..setup(mode, false)
    };
    let mut plant = Plant::new(vec![
        BootStep::Write { object: object(0x1017, 0), data: 500_u16.to_le_bytes().to_vec(), optional: false },
        BootStep::Rpdo(setup),
    ]);
    plant.device.objects.extend([
        (object(0x1400, 1), cob_id.to_le_bytes().to_vec()),
        (object(0x1400, 2), vec![255]),
        (object(0x1600, 0), vec![1]),
        (object(0x1600, 1), 0x6200_0108_u32.to_le_bytes().to_vec()),
    ]);
    let node = NodeId::new(1).unwrap();
    plant.network.set_rpdo(Now::from_millis(0), node, RpdoIndex(0), Some([0; 8]));
    plant.link_up().run(3_000);
    plant
}

#[test]
fn an_rpdo_is_mapped_as_the_file_says_before_the_first_is_sent() {
    let plant = with_rpdo(MappingMode::Write, 0x201);
    assert_eq!(plant.written(), ["0x1017:0", "0x1600:0", "0x1600:1", "0x1600:0"]);
    assert_eq!(plant.device.objects[&object(0x1600, 1)], 0x6411_0110_u32.to_le_bytes());
    let done = plant.told.iter().position(|event| matches!(event, BootEvent::Done { .. }));
    assert!(done.is_some(), "{:?}", plant.told);
    assert!(!plant.rpdos.is_empty() && plant.rpdos[0] > 20, "{:?}", plant.rpdos);
}

#[test]
fn an_rpdo_that_the_device_takes_otherwise_is_not_sent() {
    for (mode, cob_id) in
        [(MappingMode::Verify, 0x201), (MappingMode::Write, 0x202), (MappingMode::Write, 0x8000_0201)]
    {
        let plant = with_rpdo(mode, cob_id);
        assert!(plant.nmt.contains(&"000#0101".to_owned()), "the node runs all the same");
        assert_eq!(plant.rpdos, Vec::<u64>::new(), "{mode:?} {cob_id:X}");
    }
}

/// The manual leaves open whether a mapping that is too long is refused at its last entry or with their number.
#[test]
fn r_dst_018_019_a_mapping_that_is_refused_is_told_with_the_code_and_the_node_not_started() {
    for (refused, code) in [(1, 0x0604_0041), (2, 0x0604_0042), (0, 0x0604_0042)] {
        let mut plant = Plant::new(vec![BootStep::Pdo(setup(MappingMode::Write, false))]);
        plant.device.refuse = Some((object(0x1A00, refused), code));
        if refused == 0 {
            // Switching the PDO off is no matter of length.
            plant.device.objects.insert(object(0x1A00, 0), vec![0]);
        }
        plant.link_up();
        assert_eq!(plant.nmt, ["000#8001"], "not started");
        let failure = plant.told.iter().find_map(|event| {
            if let BootEvent::Failed(failure) = event { Some(failure.to_string()) } else { None }
        });
        let text = failure.unwrap();
        assert!(
            text.contains(&format!("0x1A00:{refused}")) && text.contains(&format!("0x{code:08X}")),
            "{text}"
        );
    }
}
