//! A network on a test bench: frames in and everything that comes of them as lines of text.

use std::time::Duration;

use crate::can::CanId;
use crate::canopen::boot::BootSettings;
use crate::canopen::{
    ErrorControl, GuardingSettings, Network, NetworkOutput, NetworkSettings, NmtRequest, NodeEvent, NodeId,
    NodeSettings, PdoSettings, Role, StartSettings,
};
use crate::time::{Instant, Now};

/// A network and the protocol of what it did.
pub(super) struct Bench {
    pub(super) network: Network,
    lines: Vec<String>,
    now: u64,
}

impl Bench {
    /// At time 0, on a bus that can be used.
    pub(super) fn new(settings: NetworkSettings) -> Self {
        Self { network: usable(settings), lines: Vec::new(), now: 0 }
    }

    /// Runs all timers up to and including `millis`.
    pub(super) fn run(&mut self, millis: u64) -> &mut Self {
        let end = Instant::from_millis(millis);
        for round in 0.. {
            assert!(round < 1_000_000, "timers do not come to rest");
            let Some((at, _)) = self.network.poll_timeout().filter(|(at, _)| *at <= end) else { break };
            self.now = self.now.max(at.as_millis());
            self.network.handle_timeout(Now::from_millis(self.now));
            self.drain();
        }
        self.now = self.now.max(millis);
        self
    }

    /// A frame in candump notation, received at `millis`, after all that was due until then.
    pub(super) fn frame(&mut self, millis: u64, text: &str) -> &mut Self {
        self.run(millis);
        self.network.handle_frame(Now::from_millis(millis), &text.parse().unwrap());
        self.drain();
        self.run(millis)
    }

    /// Frames received one after another.
    pub(super) fn frames(&mut self, frames: &[(u64, &str)]) -> &mut Self {
        for (millis, text) in frames {
            self.frame(*millis, text);
        }
        self
    }

    /// The bus goes down or comes up.
    pub(super) fn link(&mut self, millis: u64, up: bool) -> &mut Self {
        self.run(millis);
        self.network.handle_link(Now::from_millis(millis), up);
        self.drain();
        self.run(millis)
    }

    /// A frame of ours did not leave.
    pub(super) fn not_sent(&mut self, millis: u64, text: &str) -> &mut Self {
        self.run(millis);
        self.network.handle_not_sent(Now::from_millis(millis), &text.parse().unwrap());
        self.drain();
        self
    }

    /// An operator's command.
    pub(super) fn request(&mut self, millis: u64, id: u8, request: NmtRequest) -> bool {
        self.run(millis);
        let accepted = self.network.request_nmt(Now::from_millis(millis), NodeId::new(id), request);
        self.drain();
        accepted
    }

    /// Takes down what the network wants done.
    pub(super) fn drain(&mut self) {
        while let Some(output) = self.network.poll_output() {
            let text = match output {
                NetworkOutput::Transmit(frame) => frame.to_string(),
                // Of every frame, and of every node: they have tests of their own.
                NetworkOutput::Node(_, NodeEvent::FrameSeen | NodeEvent::Supervised) => continue,
                NetworkOutput::Node(_, event) => format!("{event:?}"),
                NetworkOutput::Foreign(event) => format!("{event:?}"),
            };
            self.lines.push(format!("{} {text}", self.now));
        }
    }

    /// What happened since the last call.
    pub(super) fn take(&mut self) -> Vec<String> {
        std::mem::take(&mut self.lines)
    }

    /// The lines since the last call that contain a word.
    pub(super) fn take_those_with(&mut self, word: &str) -> Vec<String> {
        self.take().into_iter().filter(|line| line.contains(word)).collect()
    }
}

/// A network at time 0, on a bus that can be used.
pub(super) fn usable(settings: NetworkSettings) -> Network {
    let mut network = Network::new(settings, Now::from_millis(0));
    network.handle_link(Now::from_millis(0), true);
    network
}

/// A DetCon: four TPDOs of 8, 8, 8 and 6 bytes, guarded every 500 ms.
pub(super) fn detcon(id: u8) -> NodeSettings {
    let pdo = |(number, length): (u16, u8)| PdoSettings {
        number,
        cob_id: CanId::Standard(0x080 + 0x100 * number + u16::from(id)),
        length,
        strict_length: false,
        timeout: Some(Duration::from_millis(1500)),
        synchronous: false,
        shortest_period: Some(Duration::from_millis(100)),
    };
    NodeSettings {
        id: NodeId::new(id).unwrap(),
        error_control: ErrorControl::Guarding(GuardingSettings::default()),
        start: StartSettings::default(),
        sdo: None,
        boot: BootSettings::default(),
        polls: Vec::new(),
        pdos: [(1, 8), (2, 8), (3, 8), (4, 6)].into_iter().map(pdo).collect(),
        rpdos: Vec::new(),
        emergency: None,
        never_seen_after: Duration::from_secs(10),
    }
}

/// A bus with these nodes, as their master.
pub(super) fn master(nodes: Vec<NodeSettings>) -> NetworkSettings {
    NetworkSettings { nodes, ..NetworkSettings::default() }
}

/// A bus with these nodes, seen by a listener.
pub(super) fn passive(nodes: Vec<NodeSettings>) -> NetworkSettings {
    NetworkSettings { role: Role::Passive, ..master(nodes) }
}

/// A bench with one DetCon, node 1, that was found operational at time 0 with toggle bit 0.
pub(super) fn running_with(settings: NodeSettings) -> Bench {
    let mut bench = Bench::new(master(vec![settings]));
    bench.frame(0, "701#05");
    assert_eq!(
        bench.take(),
        ["0 701#R1", "0 Seen", "0 State { from: None, to: Operational, ordered: true }"]
    );
    bench
}

/// The same with the settings of [`detcon`].
pub(super) fn running() -> Bench {
    running_with(detcon(1))
}

/// A DetCon without TPDOs, so that no PDO timeout comes between.
pub(super) fn mute() -> NodeSettings {
    NodeSettings { pdos: Vec::new(), ..detcon(1) }
}
