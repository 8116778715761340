//! A device played by the test: it answers guard requests and NMT commands exactly as told, and sends nothing unasked.
//!
//! Ours is `cangate sim`; this one is for conversations in which each frame matters, and it is not made of the gateway's code.

use std::sync::atomic::{AtomicBool, AtomicU8, AtomicU32, Ordering::SeqCst};
use std::sync::{Arc, Mutex};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use socketcan::{CanDataFrame, CanFrame, CanSocket, EmbeddedFrame, Frame, Socket, StandardId};

use super::bus::BUS;

/// What the device does now; the test changes it.
#[derive(Debug)]
struct Behaviour {
    node: u8,
    state: AtomicU8,
    toggle: AtomicBool,
    answers: AtomicBool,
    toggles: AtomicBool,
    obeys: AtomicBool,
    replies: AtomicU32,
    stop: AtomicBool,
    /// Held while a request is dealt with, and while several things change that must hold for the next one.
    turn: Mutex<()>,
    tpdos: Mutex<Option<[Vec<u8>; 4]>>,
    requests: Mutex<Vec<Instant>>,
}

/// A device on vcan0.
pub struct Device {
    behaviour: Arc<Behaviour>,
    thread: Option<JoinHandle<()>>,
    socket: CanSocket,
}

/// Period of its TPDOs, if it has any to send.
const PERIOD: Duration = Duration::from_millis(500);

impl Device {
    /// A device in the given state, whose next reply has toggle 0.
    pub fn start(node: u8, state: u8) -> Self {
        let behaviour = Arc::new(Behaviour {
            node,
            state: AtomicU8::new(state),
            toggle: AtomicBool::new(false),
            answers: AtomicBool::new(true),
            toggles: AtomicBool::new(true),
            obeys: AtomicBool::new(true),
            replies: AtomicU32::new(0),
            stop: AtomicBool::new(false),
            turn: Mutex::new(()),
            tpdos: Mutex::new(None),
            requests: Mutex::new(Vec::new()),
        });
        let socket = CanSocket::open(BUS).unwrap();
        socket.set_read_timeout(Duration::from_millis(20)).unwrap();
        let told = behaviour.clone();
        let thread = std::thread::spawn(move || live(&told, &socket));
        Self { behaviour, thread: Some(thread), socket: CanSocket::open(BUS).unwrap() }
    }

    /// Sends a data frame.
    pub fn send(&self, id: u16, data: &[u8]) {
        send(&self.socket, id, data);
    }

    /// Power cycle: boot-up message, toggle 0, pre-operational.
    pub fn restart(&self) {
        // No request in between: its answer would take the first toggle bit.
        let _turn = self.behaviour.turn.lock().unwrap();
        self.behaviour.toggle.store(false, SeqCst);
        self.behaviour.state.store(127, SeqCst);
        self.send(0x700 + u16::from(self.behaviour.node), &[0]);
    }

    /// Its NMT state.
    pub fn state(&self) -> u8 {
        self.behaviour.state.load(SeqCst)
    }

    /// Puts it into a state without any frame.
    pub fn set_state(&self, state: u8) {
        self.behaviour.state.store(state, SeqCst);
    }

    /// Whether guard requests are answered. A request without answer toggles the bit all the same.
    pub fn answer(&self, answer: bool) {
        self.behaviour.answers.store(answer, SeqCst);
    }

    /// Whether the toggle bit changes.
    pub fn toggle(&self, toggle: bool) {
        self.behaviour.toggles.store(toggle, SeqCst);
    }

    /// Answers from the next request on, that one with this toggle bit, alternating after it.
    pub fn answer_from(&self, toggle: bool) {
        let _turn = self.behaviour.turn.lock().unwrap();
        self.behaviour.toggle.store(toggle, SeqCst);
        self.behaviour.toggles.store(true, SeqCst);
        self.behaviour.answers.store(true, SeqCst);
    }

    /// Answers the next request with the toggle bit of the last reply, alternating after it.
    pub fn repeat_once(&self) {
        let _turn = self.behaviour.turn.lock().unwrap();
        self.behaviour.toggle.fetch_not(SeqCst);
    }

    /// Whether NMT commands have an effect.
    pub fn obey(&self, obey: bool) {
        self.behaviour.obeys.store(obey, SeqCst);
    }

    /// Data of TPDO1-4, sent every 500 ms while operational.
    pub fn send_periodically(&self, tpdos: [&[u8]; 4]) {
        *self.behaviour.tpdos.lock().unwrap() = Some(tpdos.map(<[u8]>::to_vec));
    }

    /// No more TPDOs.
    pub fn send_nothing(&self) {
        *self.behaviour.tpdos.lock().unwrap() = None;
    }

    /// Replies sent so far.
    pub fn replies(&self) -> u32 {
        self.behaviour.replies.load(SeqCst)
    }

    /// When guard requests came.
    pub fn requests(&self) -> Vec<Instant> {
        self.behaviour.requests.lock().unwrap().clone()
    }
}

impl Drop for Device {
    fn drop(&mut self) {
        self.behaviour.stop.store(true, SeqCst);
        if let Some(thread) = self.thread.take() {
            let _ = thread.join();
        }
    }
}

fn send(socket: &CanSocket, id: u16, data: &[u8]) {
    let frame = CanDataFrame::new(StandardId::new(id).unwrap(), data).unwrap();
    // A device notices nothing when its cable is cut.
    let _ = socket.write_frame(&frame);
}

fn live(device: &Behaviour, socket: &CanSocket) {
    let mut due = Instant::now();
    while !device.stop.load(SeqCst) {
        if let Ok(frame) = socket.read_frame() {
            receive(device, socket, &frame);
        }
        if device.state.load(SeqCst) == 5
            && Instant::now() >= due
            && let Some(tpdos) = device.tpdos.lock().unwrap().as_ref()
        {
            for (base, data) in [0x180, 0x280, 0x380, 0x480].into_iter().zip(tpdos) {
                send(socket, base + u16::from(device.node), data);
            }
            due = Instant::now() + PERIOD;
        }
    }
}

fn receive(device: &Behaviour, socket: &CanSocket, frame: &CanFrame) {
    let error_control = 0x700 + u32::from(device.node);
    match frame {
        CanFrame::Remote(request) if request.raw_id() & 0x1FFF_FFFF == error_control => {
            let _turn = device.turn.lock().unwrap();
            device.requests.lock().unwrap().push(Instant::now());
            let toggle = device.toggle.load(SeqCst);
            if device.toggles.load(SeqCst) {
                device.toggle.store(!toggle, SeqCst);
            }
            if device.answers.load(SeqCst) {
                send(
                    socket,
                    0x700 + u16::from(device.node),
                    &[device.state.load(SeqCst) | u8::from(toggle) << 7],
                );
                device.replies.fetch_add(1, SeqCst);
            }
        }
        CanFrame::Data(command) if command.raw_id() == 0 && device.obeys.load(SeqCst) => {
            if let [command, node] = command.data()
                && (*node == device.node || *node == 0)
            {
                match command {
                    1 => device.state.store(5, SeqCst),
                    2 => device.state.store(4, SeqCst),
                    0x80 => device.state.store(127, SeqCst),
                    _ => {}
                }
            }
        }
        _ => {}
    }
}
