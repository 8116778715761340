//! Whatever comes, a module neither panics nor grows.

use proptest::prelude::*;

use super::super::channel::{Channel, LINE_LIMIT, RING};
use super::super::parameters::Model;
use super::bench::{Bench, prompt};
use crate::can::{CanFrame, CanId};
use crate::simulator::Device;
use crate::time::Now;

/// A frame that may concern module 12: commands to it, data, guard requests, and anything.
fn frame() -> impl Strategy<Value = CanFrame> {
    let id = prop_oneof![4 => Just(0x700_u16), 3 => 0x0B4_u16..0x0C0, 1 => Just(0x512), 1 => 0_u16..0x800];
    let data = prop_oneof![
        3 => (any::<u8>(), 0_u8..8, 0_u8..4, prop_oneof![Just(0x12_u8), Just(0)], any::<u16>()).prop_map(
            |(command, sub, second, number, value)| {
                let [high, low] = value.to_be_bytes();
                vec![command, sub, second, number, high, low]
            }
        ),
        2 => proptest::collection::vec(any::<u8>(), 0..=8),
    ];
    (id, data, prop::bool::weighted(0.1)).prop_map(|(id, data, remote)| {
        let id = CanId::standard(id).unwrap();
        if remote { CanFrame::remote_frame(id, 1) } else { CanFrame::data_frame(id, &data) }.unwrap()
    })
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 64, ..ProptestConfig::default() })]

    #[test]
    fn random_frames_and_bytes_neither_panic_nor_grow_memory(
        steps in proptest::collection::vec((frame(), 0_u64..50, any::<bool>(), 0_usize..300), 1..200)
    ) {
        let mut bench = Bench::of(&prompt(Model::Sio4), 0x12);
        let mut now = 0;
        for (frame, pause, drain, said) in steps {
            now += pause;
            let moment = Now::from_millis(now);
            bench.device.handle_frame(moment, &frame);
            bench.device.handle_serial(moment, 1, &vec![0x0D; said]);
            bench.device.handle_timeout(moment);
            let frames = if drain { std::iter::from_fn(|| bench.device.poll_output()).count() } else { 0 };
            prop_assert!(frames <= 512, "{frames}");
            for channel in bench.device.module().channels() {
                prop_assert!(channel.waiting().iter().all(|waiting| *waiting <= RING.max(LINE_LIMIT)));
            }
        }
    }
}

#[test]
fn a_hundred_thousand_frames_that_nobody_fetches_take_no_more_memory() {
    let mut bench = Bench::sio4(0x12);
    let frames: Vec<CanFrame> = ["700#020000120567", "0B9#4142434445464748", "0BD#0D", "700#000300120567"]
        .iter()
        .map(|frame| frame.parse().unwrap())
        .collect();
    for (count, frame) in (0_u64..100_000).zip(frames.iter().cycle()) {
        let moment = Now::from_millis(count / 10);
        bench.device.handle_frame(moment, frame);
        bench.device.handle_serial(moment, 1, b"x");
    }
    let waiting: usize = bench.device.module().channels().iter().flat_map(Channel::waiting).sum();
    assert!(waiting <= 5 * (2 * RING + 2 * LINE_LIMIT), "{waiting}");
    assert!(std::iter::from_fn(|| bench.device.poll_output()).count() <= 512);
}
