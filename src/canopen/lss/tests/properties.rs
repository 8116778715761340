//! Whatever comes in, every job that is taken ends once, and nothing but LSS frames is sent.

use std::time::Duration;

use proptest::prelude::*;

use super::*;
use crate::can::{CanFrame, CanId};
use crate::canopen::NodeId;

#[derive(Clone, Debug)]
enum Happening {
    Job(LssJob),
    Answer(u8, [u8; 7]),
    Frame(Vec<u8>),
    Performed(Performed),
    Wait(u64),
    NotSent,
    Cancel,
    Pause,
    Resume,
}

fn job() -> impl Strategy<Value = LssJob> {
    let range = (any::<[u32; 4]>(), any::<[u32; 2]>()).prop_map(|([vendor, product, a, b], [c, d])| {
        LssRange { vendor, product, revision: (a.min(b), a.max(b)), serial: (c.min(d), c.max(d)) }
    });
    let change = (any::<[bool; 5]>(), 1_u8..=127).prop_map(|([one, known, all, rate, now], id)| LssChange {
        target: if one { LssTarget::OnlySlave { confirmed: true } } else { LssTarget::Address(DST) },
        node: NodeId::new(1).filter(|_| known),
        stop_all: all,
        node_id: NodeId::new(id),
        bit_rate: LssBitRate::from_kbit(250).filter(|_| rate),
        activation: if now {
            LssActivation::Now { delay: Duration::from_millis(100) }
        } else {
            LssActivation::PowerCycle
        },
    });
    prop_oneof![
        Just(LssJob::SwitchGlobal { state: LssState::Configuration, only_slave: true }),
        Just(LssJob::SwitchSelective(DST)),
        Just(LssJob::ConfigureNodeId(None)),
        Just(LssJob::Store),
        Just(LssJob::InquireAddress),
        Just(LssJob::InquireNodeId),
        Just(LssJob::IdentifyNonConfigured),
        Just(LssJob::Fastscan(LssKnown::default())),
        range.clone().prop_map(LssJob::Identify),
        prop::collection::vec(range, 0..3).prop_map(LssJob::Slowscan),
        change.prop_map(LssJob::Change),
    ]
}

fn happening() -> impl Strategy<Value = Happening> {
    let command =
        prop::sample::select(vec![0x11, 0x13, 0x17, 0x44, 0x4F, 0x50, 0x5A, 0x5B, 0x5C, 0x5D, 0x5E, 0]);
    let performed = prop_oneof![
        3 => Just(Performed::Yes),
        1 => Just(Performed::No),
        1 => any::<u32>().prop_map(Performed::Value),
        1 => Just(Performed::Failed("no".to_owned())),
    ];
    prop_oneof![
        4 => job().prop_map(Happening::Job),
        9 => (command, any::<[u8; 7]>()).prop_map(|(command, rest)| Happening::Answer(command, rest)),
        1 => prop::collection::vec(any::<u8>(), 0..=8).prop_map(Happening::Frame),
        6 => performed.prop_map(Happening::Performed),
        20 => (0_u64..300).prop_map(Happening::Wait),
        1 => Just(Happening::NotSent),
        1 => Just(Happening::Cancel),
        1 => Just(Happening::Pause),
        3 => Just(Happening::Resume),
    ]
}

proptest! {
    #[test]
    fn every_job_ends_once(happenings in prop::collection::vec(happening(), 1..200)) {
        let mut master = LssMaster::new(LssSettings::default());
        let (mut now, mut taken, mut done) = (0, 0, 0);
        let mut last: Option<CanFrame> = None;
        let mut drain = |master: &mut LssMaster, last: &mut Option<CanFrame>| {
            while let Some(output) = master.poll_output() {
                match output {
                    LssOutput::Transmit(frame) => {
                        assert_eq!((frame.id(), frame.dlc()), (CanId::Standard(0x7E5), 8));
                        *last = Some(frame);
                    }
                    LssOutput::Done(_) => done += 1,
                    LssOutput::Perform(_) | LssOutput::Found(_) => {}
                }
            }
            done
        };
        for happening in happenings {
            match happening {
                Happening::Job(job) => taken += u32::from(master.request(at(now), job).is_ok()),
                Happening::Answer(command, [a, b, c, d, e, f, g]) => {
                    let data = [command, a, b, c, d, e, f, g];
                    let frame = CanFrame::data_frame(CanId::Standard(0x7E4), &data).unwrap();
                    master.handle_frame(at(now), &frame);
                }
                Happening::Frame(data) => {
                    let frame = CanFrame::data_frame(CanId::Standard(0x7E4), &data).unwrap();
                    master.handle_frame(at(now), &frame);
                }
                Happening::Performed(performed) => master.handle_performed(at(now), performed),
                Happening::Wait(millis) => {
                    now += millis;
                    master.handle_timeout(at(now));
                }
                Happening::NotSent => {
                    if let Some(frame) = last {
                        master.handle_not_sent(at(now), &frame);
                    }
                }
                Happening::Cancel => master.cancel(at(now)),
                Happening::Pause => master.pause(),
                Happening::Resume => master.resume(),
            }
            drain(&mut master, &mut last);
        }
        for _ in 0..10_000 {
            if master.is_idle() {
                break;
            }
            match master.poll_timeout() {
                Some((due, _)) => {
                    now = now.max(due.as_millis());
                    master.handle_timeout(at(now));
                }
                None => master.handle_performed(at(now), Performed::Failed("no".to_owned())),
            }
            drain(&mut master, &mut last);
        }
        prop_assert!(master.is_idle());
        prop_assert_eq!(drain(&mut master, &mut last), taken);
    }
}
