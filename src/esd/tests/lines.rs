//! Serial lines: what comes in as chunks and messages, what goes out in order and at the pace of the line.

use std::time::Duration;

use super::bench::{Bench, line, module, network, sio1};
use crate::can::{CanFrame, CanId};
use crate::esd::{
    FlowControl, Framing, ModuleIndex, ModuleKind, ModuleSettings, Network, NetworkOutput, NetworkSettings,
    SendRefused, SerialMode,
};
use crate::time::{Instant, Now, Timestamp};

/// SIO1 with the switch 0x23, that of the examples; only its data is exchanged.
fn tunnel() -> ModuleSettings {
    ModuleSettings { management: None, ..module(ModuleKind::Sio1, 0x23) }
}

fn bench(settings: ModuleSettings) -> Bench {
    Bench::new(network(vec![settings]), Vec::new())
}

fn with_byte_time(micros: u64) -> ModuleSettings {
    let mut settings = tunnel();
    settings.channels[0].byte_time = Duration::from_micros(micros);
    settings
}

fn send(bench: &mut Bench, id: u64, bytes: &[u8]) -> Result<(), SendRefused> {
    let now = bench.now();
    let taken = bench.network.send(now, ModuleIndex(0), 0, id, bytes.to_vec());
    bench.drain();
    taken
}

#[test]
fn r_esd_001_032_034_v_esd_02_bytes_of_the_line_one_by_one() {
    let mut bench = bench(tunnel());
    for (millis, text) in [(0, "15E#EE"), (20, "15E#DD"), (40, "15E#88")] {
        bench.frame(millis, text);
    }
    let received: Vec<_> = bench.events().into_iter().filter(|event| event.contains("received")).collect();
    let expected = ["0 line 0 received \\xee", "0 line 0 received \\xdd", "0 line 0 received \\x88"];
    assert_eq!(received, expected);
}

#[test]
fn r_esd_034_v_esd_04_v_esd_05_frames_of_any_length_and_end_marks_over_frames() {
    let mut settings = tunnel();
    settings.channels[0].framing = Framing { delimiter: b"\r\n".to_vec(), longest: 8, idle: None };
    let mut bench = bench(settings);
    for text in ["15E#61626364", "15E#0D", "15E#", "15E#0A30313233343536", "15E#3838"] {
        bench.frame(0, text);
    }
    assert_eq!(
        bench.events(),
        [
            "0 Appeared",
            "0 line 0 received abcd",
            "0 line 0 received \\r",
            "0 line 0 received ",
            "0 line 0 received \\n0123456",
            "0 line 0 message abcd by delimiter",
            "0 line 0 received 88",
            "0 line 0 message 01234568 by length",
        ]
    );
}

#[test]
fn remote_and_29_bit_frames_are_no_data() {
    let mut bench = bench(tunnel());
    bench.frame(0, "15E#R4").frame(0, "0000015E#41").frame(0, "15F#41");
    assert_eq!(bench.take(), Vec::<String>::new());
}

#[test]
fn r_esd_034_a_pause_ends_a_message_and_so_does_a_bus_that_goes_down() {
    let mut settings = tunnel();
    settings.channels[0].framing.idle = Some(Duration::from_millis(30));
    let mut bench = bench(settings);
    bench.frame(0, "15E#41").frame(29, "15E#42").run(58);
    assert_eq!(bench.events().len(), 3);
    bench.run(59);
    assert_eq!(bench.events(), ["0 line 0 message AB by idle"]);
    bench.frame(70, "15E#43").link(71, false).run(1000);
    assert_eq!(bench.events(), ["0 line 0 received C", "0 line 0 message C by cut"]);
}

#[test]
fn r_esd_035_039_v_esd_03_bytes_go_out_in_frames_of_8_at_most_in_order() {
    let mut bench = bench(tunnel());
    bench.send(0, 1, b"Hello").run(5);
    assert_eq!(bench.frames(), ["15F#48656C6C6F"]);
    bench.send(10, 2, b"").run(15);
    assert_eq!(bench.take(), ["10 0 line 0 job 2 Done"], "nothing to send");
    bench.send(100, 3, b"0123456789").send(100, 4, b"ab").run(105);
    assert_eq!(
        bench.take(),
        [
            "100 15F#3031323334353637",
            "100 0 line 0 sent 8",
            "100 15F#3839",
            "100 0 line 0 sent 2",
            "100 0 line 0 job 3 Done",
            "100 15F#6162",
            "100 0 line 0 sent 2",
            "100 0 line 0 job 4 Done",
        ],
        "one job after the other"
    );
}

/// A module's ring, drained by its line; times in nanoseconds.
struct Ring {
    empty_at: u64,
    byte_time: u64,
    /// Bytes.
    highest: u64,
}

impl Ring {
    fn new(byte_time: u64) -> Self {
        Self { empty_at: 0, byte_time, highest: 0 }
    }

    fn put(&mut self, micros: u64, bytes: usize) {
        let now = micros * 1000;
        self.empty_at = self.empty_at.max(now) + self.byte_time * u64::try_from(bytes).unwrap();
        self.highest = self.highest.max((self.empty_at - now).div_ceil(self.byte_time));
    }
}

/// Runs a network that is called `late` microseconds after its deadlines; what its frames do to rings of modules. Gives the
/// time until all jobs were done in microseconds, and how full the rings were at most.
fn run_late(
    mut network: Network,
    rings: &mut [(CanId, Ring)],
    jobs: usize,
    late: impl Fn(u64) -> u64,
) -> u64 {
    let mut now = 0;
    let mut done = 0;
    for round in 0.. {
        assert!(round < 2_000_000, "no end");
        let mut sent = Vec::new();
        while let Some(output) = network.poll_output() {
            match output {
                NetworkOutput::Transmit(frame) => {
                    let (_, ring) = rings.iter_mut().find(|(id, _)| *id == frame.id()).unwrap();
                    ring.put(now, frame.data().len());
                    sent.push(frame);
                }
                NetworkOutput::Module(_, crate::esd::ModuleEvent::SendDone { .. }) => done += 1,
                NetworkOutput::Module(..) | NetworkOutput::ForeignCommand(_) => {}
            }
        }
        if done == jobs {
            return now;
        }
        if !sent.is_empty() {
            for frame in sent {
                network.handle_sent(moment(now), &frame);
            }
            continue;
        }
        let (due, _) = network.poll_timeout().unwrap();
        now = now.max(due.as_micros()).max(if due.as_micros() > now {
            due.as_micros() + late(round)
        } else {
            now
        });
        network.handle_timeout(moment(now));
    }
    0
}

fn moment(micros: u64) -> Now {
    Now { instant: Instant::from_micros(micros), utc: Timestamp::default() }
}

fn full_network(rate_micros: u64, modules: u8, bit_rate: u32) -> (Network, Vec<(CanId, Ring)>) {
    let mut rings = Vec::new();
    let modules: Vec<_> = (0..modules)
        .map(|place| {
            let mut settings = module(ModuleKind::Sio4, 0x1A + place);
            settings.management = None;
            for line in &mut settings.channels {
                line.byte_time = Duration::from_micros(rate_micros);
                // The real rate is a little lower than the nominal one (R-ESD-010).
                rings.push((line.rx_id, Ring::new(rate_micros * 1001)));
            }
            settings
        })
        .collect();
    let count = modules.len();
    let settings = NetworkSettings { bit_rate, ..network(modules) };
    let mut network = Network::new(settings, moment(0));
    network.handle_link(moment(0), true);
    for module in 0..count {
        for channel in 0..5 {
            for job in 0..2 {
                network.send(moment(0), ModuleIndex(module), channel, job, vec![0x55; 4096]).unwrap();
            }
        }
    }
    (network, rings)
}

#[test]
fn r_esd_010_036_037_the_ring_of_a_module_never_overflows_and_the_line_is_used_though_timers_are_late() {
    // 38400 bit/s, 5 lines, timers up to 12 ms late.
    let (network, mut rings) = full_network(260, 1, 1_000_000);
    let took = run_late(network, &mut rings, 10, |round| (round * 7919) % 12_000);
    for (_, ring) in &rings {
        assert!(ring.highest <= 72, "{} bytes in a ring of 256", ring.highest);
    }
    let line = 8192 * 260;
    assert!(took <= line * 104 / 100, "{took} us for what takes the line {line}");
}

#[test]
fn r_esd_037_timers_that_are_very_late_slow_a_line_down_and_overflow_nothing() {
    let (network, mut rings) = full_network(260, 1, 1_000_000);
    run_late(network, &mut rings, 10, |_| 100_000);
    assert!(rings.iter().all(|(_, ring)| ring.highest <= 72));
}

#[test]
fn r_esd_037_what_waits_on_its_way_to_the_bus_does_not_drain_and_more_comes_only_when_it_left() {
    let mut bench = bench(with_byte_time(1000));
    bench.holds_back = true;
    bench.send(0, 1, &[0x55; 512]).run(5_000);
    assert_eq!(bench.frames().len(), 8, "64 bytes, however long they wait");
    // Five of them leave.
    for _ in 0..5 {
        let now = bench.now();
        bench.network.handle_sent(now, &"15F#5555555555555555".parse().unwrap());
    }
    bench.drain();
    bench.run(5_005);
    assert_eq!(bench.frames().len(), 0, "they are in the ring now");
    bench.run(5_100);
    assert_eq!(bench.frames().len(), 5, "as many as are known to have left and drained");
}

#[test]
fn r_esd_037_a_gap_is_kept_after_a_frame_that_left_late() {
    let mut settings = tunnel();
    settings.channels[0].gap = Some(Duration::from_millis(7));
    let mut bench = bench(settings);
    bench.holds_back = true;
    bench.send(0, 1, &[0; 16]).run(100);
    assert_eq!(bench.frames().len(), 1);
    let now = bench.now();
    bench.network.handle_sent(now, &"15F#0000000000000000".parse().unwrap());
    bench.run(200);
    let lines = bench.take();
    assert!(lines.iter().any(|line| line.starts_with("107 15F#")), "{lines:?}");
}

#[test]
fn r_esd_037_frames_that_leave_in_order_tell_of_those_before_them() {
    let mut bench = bench(with_byte_time(1000));
    bench.holds_back = true;
    let bytes: Vec<u8> = (0..128).collect();
    bench.send(0, 1, &bytes).run(100);
    assert_eq!(bench.frames().len(), 8);
    let now = bench.now();
    bench.network.handle_sent(now, &"15F#38393A3B3C3D3E3F".parse().unwrap());
    bench.run(200);
    assert_eq!(bench.frames().len(), 8, "all eight left");
}

#[test]
fn data_takes_a_part_of_the_bus_only_and_all_lines_have_their_share_of_it() {
    // Ten lines of 230400 bit/s on a bus of 125 kbit/s.
    let (network, mut rings) = full_network(43, 2, 125_000);
    let took = run_late(network, &mut rings, 20, |_| 0);
    let bits = 20 * 512 * u64::from("15F#0000000000000000".parse::<CanFrame>().unwrap().wire_bits());
    let permille = bits * 8 * 1000 / took;
    assert!((550..=605).contains(&permille), "{permille} permille of the bus");
}

#[test]
fn no_more_than_16_frames_are_given_out_at_once() {
    let (mut network, _) = full_network(43, 4, 125_000);
    let mut frames = 0;
    while let Some(output) = network.poll_output() {
        frames += usize::from(matches!(output, NetworkOutput::Transmit(_)));
    }
    assert!((10..=16).contains(&frames), "{frames}");
}

#[test]
fn lines_of_one_module_do_not_wait_for_each_other() {
    let mut settings = tunnel();
    settings.channels = (1..=2).map(|channel| line(ModuleKind::Sio4, 0x23, channel)).collect();
    settings.channels[0].byte_time = Duration::from_millis(100);
    let mut bench = bench(settings);
    bench.send(0, 1, &[0; 512]).run(1000);
    bench.take();
    let now = bench.now();
    bench.network.send(now, ModuleIndex(0), 1, 2, b"x".to_vec()).unwrap();
    bench.drain();
    bench.run(1000);
    assert!(bench.take().iter().any(|line| line.contains("line 1 job 2 Done")));
}

#[test]
fn r_esd_037_a_gap_that_was_asked_for_is_kept() {
    let mut settings = tunnel();
    settings.channels[0].gap = Some(Duration::from_millis(7));
    let mut bench = bench(settings);
    bench.send(0, 1, &[0; 24]).send(0, 2, b"x").run(100);
    let lines = bench.take();
    let times: Vec<_> =
        lines.iter().filter(|line| line.contains('#')).map(|line| line.split(' ').next().unwrap()).collect();
    assert_eq!(times, ["0", "7", "14", "21"]);
}

#[test]
fn r_esd_039_sixteen_jobs_of_4096_bytes_wait_for_a_line_at_most() {
    let mut bench = bench(with_byte_time(1000));
    assert_eq!(send(&mut bench, 0, &[0; 4097]), Err(SendRefused::TooLong));
    for job in 0..16 {
        assert_eq!(send(&mut bench, job, &[0; 4096]), Ok(()));
    }
    assert_eq!(send(&mut bench, 16, &[0]), Err(SendRefused::Full));
    let now = bench.now();
    assert_eq!(bench.network.send(now, ModuleIndex(0), 1, 9, vec![0]), Err(SendRefused::Unavailable));
    assert_eq!(bench.network.send(now, ModuleIndex(1), 0, 9, vec![0]), Err(SendRefused::Unavailable));
}

#[test]
fn bytes_for_a_bus_that_is_down_or_a_module_that_is_not_there_are_refused() {
    let mut down = Bench::down(network(vec![tunnel()]), Vec::new());
    assert_eq!(send(&mut down, 1, b"x"), Err(SendRefused::Unavailable));
    let mut unseen = bench(sio1());
    assert_eq!(send(&mut unseen, 1, b"x"), Err(SendRefused::Unavailable));
    let mut lost = Bench::settled(sio1());
    lost.modules[0].on = false;
    lost.run(10_000);
    assert_eq!(send(&mut lost, 1, b"x"), Err(SendRefused::Unavailable));
}

#[test]
fn what_waits_when_the_bus_goes_down_is_given_up_and_told_with_its_count() {
    let mut bench = bench(with_byte_time(10_000));
    bench.send(0, 1, &[0; 100]).send(0, 2, &[0; 3]).run(50);
    bench.take();
    bench.link(50, false).run(5000);
    let events = bench.events();
    assert_eq!(
        events,
        [
            "0 line 0 job 1 Broken { handed: 64, sent: 64, why: BusDown }",
            "0 line 0 job 2 Broken { handed: 0, sent: 0, why: BusDown }"
        ]
    );
    bench.link(5001, true).send(5002, 3, b"x").run(6000);
    assert_eq!(bench.frames(), ["15F#78"], "nothing of it is sent later");
}

#[test]
fn what_waits_when_the_module_starts_anew_or_is_lost_is_given_up() {
    for lost in [false, true] {
        let mut settings = sio1();
        // 150 bit/s on the way out.
        settings.channels[0].serial_mode = SerialMode::from_value(0x2873);
        let mut bench = Bench::settled(settings);
        bench.send(600, 1, &[0; 1000]).run(700);
        bench.take();
        if lost {
            bench.modules[0].on = false;
        } else {
            bench.modules[0].restart();
        }
        bench.run(6000);
        let events = bench.events();
        let broken = events.iter().position(|event| event.contains("job 1 Broken")).unwrap();
        let why = events.iter().position(|event| event.contains(if lost { "Lost" } else { "Restarted" }));
        assert_eq!(why, Some(broken - 1), "{events:?}");
    }
}

#[test]
fn a_frame_that_finds_no_room_in_the_queue_is_sent_a_little_later_and_nothing_after_it_overtakes() {
    let mut bench = bench(tunnel());
    bench.refuse = vec!["15F#61"];
    bench.send(0, 1, b"a1234567b").run(100);
    assert_eq!(bench.take(), Vec::<String>::new());
    bench.refuse.clear();
    bench.run(200);
    let lines = bench.take();
    let expected = ["15F#6131323334353637", "sent 8", "15F#62", "sent 1", "job 1 Done"];
    assert_eq!(lines.len(), 5, "{lines:?}");
    assert!(lines.iter().zip(expected).all(|(line, expected)| line.ends_with(expected)), "{lines:?}");
}

#[test]
fn where_there_is_no_room_for_long_the_job_ends_with_its_count() {
    let mut bench = bench(tunnel());
    bench.refuse = vec!["15F#62"];
    bench.send(0, 1, b"a1234567b").send(0, 2, b"c").run(3000);
    let events = bench.events();
    assert!(
        events.contains(&"0 line 0 job 1 Broken { handed: 8, sent: 8, why: NoRoom }".to_owned()),
        "{events:?}"
    );
    let second = "0 line 0 job 2 Broken { handed: 0, sent: 0, why: NoRoom }";
    assert!(events.contains(&second.to_owned()), "it may be the next piece: {events:?}");
}

#[test]
fn a_frame_that_comes_back_later_ends_its_job_where_it_stood() {
    let mut bench = bench(with_byte_time(10_000));
    let bytes: Vec<u8> = (0..100).collect();
    bench.send(0, 1, &bytes).run(50);
    bench.take();
    bench.not_sent(50, "15F#08090A0B0C0D0E0F").run(60);
    assert_eq!(bench.events(), ["0 line 0 job 1 Broken { handed: 64, sent: 8, why: NotSent }"]);
    bench.not_sent(70, "15F#1011121314151617").run(10_000);
    assert_eq!(bench.take(), Vec::<String>::new());
}

#[test]
fn xoff_holds_a_line_until_xon_and_neither_is_data() {
    let mut settings = with_byte_time(1000);
    settings.channels[0].flow_control = FlowControl::XonXoff;
    let mut bench = bench(settings);
    bench.send(0, 1, &[0x55; 40]).run(0);
    assert_eq!(bench.frames().len(), 2, "little is under way when the other end says stop");
    bench.frame(1, "15E#411342").run(1000);
    assert_eq!(bench.frames(), Vec::<String>::new());
    bench.frame(1000, "15E#11").run(1100);
    let lines = bench.take();
    assert!(lines.iter().any(|line| line.ends_with("job 1 Done")), "{lines:?}");
}

#[test]
fn an_xoff_that_is_never_taken_back_gives_up_what_waits_after_a_minute() {
    let mut settings = tunnel();
    settings.channels[0].flow_control = FlowControl::XonXoff;
    let mut bench = bench(settings);
    bench.frame(0, "15E#13").send(1, 1, b"x").run(59_999);
    bench.take();
    bench.run(60_001);
    assert_eq!(bench.events(), ["0 line 0 job 1 Broken { handed: 0, sent: 0, why: Xoff }"]);
    bench.send(60_002, 2, b"y").run(60_003);
    assert_eq!(bench.frames(), ["15F#79"], "the line is tried again");
}

#[test]
fn without_flow_control_all_bytes_are_data() {
    let mut bench = bench(tunnel());
    bench.frame(0, "15E#1113").send(1, 1, b"x").run(2);
    assert!(bench.take().iter().any(|line| line.ends_with("received \\x11\\x13")));
}

#[test]
fn r_esd_039_what_waits_behind_a_job_that_breaks_off_is_given_up_too() {
    let mut bench = bench(with_byte_time(10_000));
    let bytes: Vec<u8> = (0..100).collect();
    bench.send(0, 1, &bytes).send(0, 2, b"next").send(0, 3, b"last").run(50);
    bench.take();
    bench.not_sent(50, "15F#08090A0B0C0D0E0F").run(10_000);
    let none = |job| format!("0 line 0 job {job} Broken {{ handed: 0, sent: 0, why: NotSent }}");
    let first = "0 line 0 job 1 Broken { handed: 64, sent: 8, why: NotSent }".to_owned();
    assert_eq!(bench.take(), [format!("50 {first}"), format!("50 {}", none(2)), format!("50 {}", none(3))]);
    bench.send(10_001, 4, b"anew").run(10_002);
    assert_eq!(bench.frames(), ["15F#616E6577"], "what comes later is sent");
}

#[test]
fn a_frame_of_a_job_that_is_done_which_comes_back_is_told_of_and_nothing_goes_out_behind_the_hole() {
    let mut bench = bench(with_byte_time(10_000));
    bench.send(0, 1, b"12345678abc").run(10);
    assert!(bench.events().contains(&"0 line 0 job 1 Done".to_owned()));
    let bytes: Vec<u8> = (0..100).collect();
    bench.send(20, 2, &bytes).send(20, 3, b"x").run(50);
    bench.take();
    bench.not_sent(50, "15F#3132333435363738").run(10_000);
    let events = bench.events();
    assert_eq!(events.len(), 3, "{events:?}");
    assert_eq!(events[0], "0 line 0 not sent 8");
    assert!(events[1].starts_with("0 line 0 job 2 Broken { handed: "), "{events:?}");
    assert_eq!(events[2], "0 line 0 job 3 Broken { handed: 0, sent: 0, why: NotSent }");
    bench.not_sent(10_001, "15F#3132333435363738");
    assert_eq!(bench.events(), Vec::<String>::new(), "it can come back once only");
}

#[test]
fn equal_frames_of_two_jobs_do_not_hide_a_hole() {
    let mut bench = bench(with_byte_time(10_000));
    bench.send(0, 1, &[0x55; 8]).send(0, 2, &[0x55; 100]).run(50);
    bench.take();
    bench.not_sent(50, "15F#5555555555555555").run(51);
    assert_eq!(
        bench.events(),
        ["0 line 0 job 2 Broken { handed: 56, sent: 0, why: NotSent }"],
        "nobody knows which it was"
    );
}

#[test]
fn a_frame_that_was_given_out_just_now_is_counted_when_an_earlier_one_comes_back() {
    let mut bench = bench(with_byte_time(10_000));
    bench.holds_back = true;
    let bytes: Vec<u8> = (0..100).collect();
    bench.send(0, 1, &bytes);
    let now = bench.now();
    bench.network.handle_timeout(now);
    bench.drain();
    assert_eq!(bench.frames().len(), 2, "the second is given out and not settled");
    bench.network.handle_not_sent(now, &"15F#0001020304050607".parse().unwrap());
    bench.drain();
    let events = bench.events();
    assert_eq!(events, ["0 line 0 sent 8", "0 line 0 job 1 Broken { handed: 16, sent: 0, why: NotSent }"]);
    bench.run(5000);
    assert_eq!(bench.take(), Vec::<String>::new());
}

#[test]
fn r_esd_037_a_gap_slows_a_line_down_and_never_makes_it_faster_than_it_is() {
    let mut settings = with_byte_time(10_000);
    settings.channels[0].gap = Some(Duration::from_millis(1));
    let mut bench = bench(settings);
    bench.send(0, 1, &[0; 512]).run(1000);
    let bytes = 8 * bench.frames().len();
    assert!((150..=176).contains(&bytes), "{bytes} bytes in a second for a line of 100 a second");
}

#[test]
fn an_xoff_that_is_said_again_and_again_holds_no_longer() {
    let mut settings = tunnel();
    settings.channels[0].flow_control = FlowControl::XonXoff;
    let mut bench = bench(settings);
    bench.frame(0, "15E#13").send(1, 1, b"x").frame(30_000, "15E#13").frame(59_000, "15E#13");
    bench.take();
    bench.run(60_001);
    assert_eq!(bench.events(), ["0 line 0 job 1 Broken { handed: 0, sent: 0, why: Xoff }"]);
}
