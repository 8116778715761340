//! From CAN to the line (R-ESD-001, R-ESD-035, R-ESD-036).

use super::super::channel::RING;
use super::bench::{Bench, hex};

#[test]
fn r_esd_001_032_035_data_frames_of_any_length_go_to_the_line_in_order() {
    let mut bench = Bench::sio4(0x12);
    let mut all = Vec::new();
    for length in 0..=8_u8 {
        let bytes: Vec<u8> = (0..length).map(|byte| length * 16 + byte).collect();
        let data = hex(&bytes);
        bench.frame(&format!("0BB#{data}"));
        all.extend(bytes);
    }
    bench.frame("0BB#R8");
    bench.run_for(1000);
    assert_eq!(bench.line(3), all);
}

#[test]
fn r_esd_036_the_ring_takes_256_bytes_and_what_is_lost_is_counted_from_public_copies() {
    let mut bench = Bench::sio4(0x12);
    bench.order("cts 1 off");
    for _ in 0..RING / 8 {
        bench.frame("0B9#4142434445464748");
    }
    assert!(!bench.device_remarks().contains("overflow"));
    bench.frame("0B9#494A4B");
    bench.run_for(1);
    assert!(bench.says("channel 1 to line overflow 3"), "{}", bench.device_remarks());
    bench.order("cts 1 on");
    bench.run_for(1000);
    assert_eq!(bench.line(1), b"ABCDEFGH".repeat(RING / 8));
}

#[test]
fn r_esd_036_a_sender_that_keeps_the_pace_of_the_line_loses_nothing() {
    let mut bench = Bench::sio4(0x12);
    bench.frame("700#860200120053");
    let bytes: Vec<u8> = (0..10_000_u32).map(|number| number.to_le_bytes()[0]).collect();
    for piece in bytes.chunks(8) {
        let data = hex(piece);
        bench.frame(&format!("0B9#{data}"));
        bench.run_for(3);
    }
    bench.run_for(1000);
    assert_eq!(bench.line(1), bytes);
    assert!(!bench.device_remarks().contains("overflow"));
}
