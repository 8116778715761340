//! The services one by one, with the frames of the manual.

use std::time::Duration;

use super::*;
use crate::canopen::NodeId;

fn node(id: u8) -> NodeId {
    NodeId::new(id).unwrap()
}

fn script() -> Script {
    Script::new(LssSettings::default())
}

/// A script whose one slave is in configuration state.
fn configuring() -> Script {
    let mut script = script();
    let frames = script.begin(LssJob::SwitchGlobal { state: LssState::Configuration, only_slave: true });
    assert_eq!(frames, ["7E5#0401000000000000", "Done"]);
    script
}

#[test]
fn r_dst_091_r_dst_099_v_dst_19_switch_selective_is_four_frames_and_one_answer() {
    let mut script = script();
    let target = LssAddress { revision: 0, ..DST };
    let frames = script.begin(LssJob::SwitchSelective(target));
    assert_eq!(
        frames,
        ["7E5#403D020000000000", "7E5#4178563412000000", "7E5#4200000000000000", "7E5#4340E20100000000"]
    );
    assert_eq!(script.answer("7E4#4400000000000000"), ["Done"]);
}

#[test]
fn r_dst_097_switch_global_is_one_frame_for_all_and_not_answered() {
    for (state, frame) in
        [(LssState::Configuration, "7E5#0401000000000000"), (LssState::Waiting, "7E5#0400000000000000")]
    {
        let mut script = script();
        assert_eq!(script.begin(LssJob::SwitchGlobal { state, only_slave: true }), [frame, "Done"]);
    }
}

#[test]
fn r_dst_095_r_dst_104_v_dst_19_inquire_address() {
    let mut script = configuring();
    assert_eq!(script.begin(LssJob::InquireAddress), ["7E5#5A00000000000000"]);
    assert_eq!(script.answer("7E4#5A3D020000000000"), ["7E5#5B00000000000000"]);
    assert_eq!(script.answer("7E4#5B78563412000000"), ["7E5#5C00000000000000"]);
    assert_eq!(script.answer("7E4#5C03020100000000"), ["7E5#5D00000000000000"]);
    assert_eq!(script.answer("7E4#5D40E20100000000"), [format!("Address({DST:?})")]);
    assert_eq!(DST.to_string(), "vendor 0x23D product 0x12345678 revision 0x10203 serial 123456");
}

#[test]
fn r_dst_105_v_dst_19_inquire_node_id() {
    for (answer, outcome) in [
        ("7E4#5E01000000000000", "NodeId(Some(node 1))"),
        ("7E4#5EFF000000000000", "NodeId(None)"),
        ("7E4#5E00000000000000", "Nonsense(\"the LSS slave told a node id that is none\")"),
    ] {
        let mut script = configuring();
        assert_eq!(script.begin(LssJob::InquireNodeId), ["7E5#5E00000000000000"]);
        assert_eq!(script.answer(answer), [outcome]);
    }
}

#[test]
fn r_dst_100_r_dst_120_v_dst_19_configure_node_id_and_its_refusal() {
    let mut script = configuring();
    assert_eq!(script.begin(LssJob::ConfigureNodeId(Some(node(5)))), ["7E5#1105000000000000"]);
    assert_eq!(script.answer("7E4#1100000000000000"), ["Done"]);
    assert_eq!(script.begin(LssJob::ConfigureNodeId(None)), ["7E5#11FF000000000000"]);
    assert_eq!(
        script.answer("7E4#1101000000000000"),
        ["Refused { service: \"configure node id\", code: 1, specific: 0 }"]
    );
    let error = LssError::Refused { service: "configure node id", code: 1, specific: 0 };
    assert!(error.to_string().contains("out of range"), "{error}");
}

#[test]
fn r_dst_007_101_116_v_dst_19_configure_bit_rate_by_the_standard_table() {
    let mut script = configuring();
    let rate = LssBitRate::from_kbit(250).unwrap();
    assert_eq!(script.begin(LssJob::ConfigureBitRate(rate)), ["7E5#1300030000000000"]);
    assert_eq!(script.answer("7E4#1300000000000000"), ["Done"]);
    assert_eq!(script.begin(LssJob::ConfigureBitRate(rate)), ["7E5#1300030000000000"]);
    let refused = script.answer("7E4#1301000000000000");
    assert_eq!(refused, ["Refused { service: \"configure bit rate\", code: 1, specific: 0 }"]);
    for (kbit, index) in [(1000, 0), (800, 1), (500, 2), (250, 3), (125, 4), (50, 6), (20, 7), (10, 8)] {
        let rate = LssBitRate::from_kbit(kbit).unwrap();
        assert_eq!((rate.index(), rate.kbit()), (index, kbit));
    }
    assert_eq!(LssBitRate::from_kbit(100), None);
    assert_eq!(LssBitRate::from_kbit(0), None);
}

#[test]
fn r_dst_102_activate_bit_rate_tells_the_delay_and_gets_no_answer() {
    let mut script = configuring();
    let delay = Duration::from_millis(100);
    assert_eq!(script.begin(LssJob::ActivateBitRate { delay }), ["7E5#1564000000000000", "Done"]);
    let delay = Duration::from_millis(65_536);
    let error = script.master.request(at(0), LssJob::ActivateBitRate { delay }).unwrap_err();
    assert!(error.to_string().contains("65535 ms"), "{error}");
}

#[test]
fn r_dst_103_v_dst_19_store_shows_both_texts_of_a_refusal() {
    for (answer, text) in [
        ("7E4#1701000000000000", "cannot store (CiA 305), or the node id is out of range (DST P92C)"),
        ("7E4#1702000000000000", "cannot reach its memory"),
        ("7E4#17FF010000000000", "there is nothing to store"),
        ("7E4#17FF070000000000", "manufacturer's error 7"),
        ("7E4#1709000000000000", "error 9"),
    ] {
        let mut script = configuring();
        assert_eq!(script.begin(LssJob::Store), ["7E5#1700000000000000"]);
        script.master.handle_frame(script.now, &answer.parse().unwrap());
        let Some(LssOutput::Done(Err(error))) = script.master.poll_output() else { panic!() };
        assert!(error.to_string().contains(text), "{error}");
    }
}

#[test]
fn r_dst_106_v_dst_19_identify_remote_slave() {
    let range = LssRange { vendor: 0x23D, product: 0x1234_5678, revision: (0, 0), serial: (0, u32::MAX) };
    let mut script = script();
    assert_eq!(
        script.begin(LssJob::Identify(range)),
        [
            "7E5#463D020000000000",
            "7E5#4778563412000000",
            "7E5#4800000000000000",
            "7E5#4900000000000000",
            "7E5#4A00000000000000",
            "7E5#4BFFFFFFFF000000"
        ]
    );
    assert_eq!(script.answer("7E4#4F00000000000000"), ["Answered(true)"]);
    script.begin(LssJob::Identify(range));
    assert_eq!(script.silence(), ["Answered(false)"]);
    let backwards = LssRange { serial: (2, 1), ..range };
    assert!(script.master.request(at(0), LssJob::Identify(backwards)).is_err());
}

#[test]
fn r_dst_109_v_dst_19_identify_non_configured() {
    let mut script = script();
    assert_eq!(script.begin(LssJob::IdentifyNonConfigured), ["7E5#4C00000000000000"]);
    assert_eq!(script.answer("7E4#5000000000000000"), ["Answered(true)"]);
}

#[test]
fn r_dst_110_an_answer_is_waited_for_200_ms_and_that_to_store_1000_ms() {
    let mut script = configuring();
    for (job, millis) in [(LssJob::InquireNodeId, 200), (LssJob::Store, 1000)] {
        let before = script.now;
        assert_eq!(script.begin(job).len(), 1);
        let outcome = script.silence();
        assert_eq!(outcome.len(), 1, "nothing is repeated: {outcome:?}");
        assert!(outcome[0].starts_with("NoAnswer"), "{outcome:?}");
        assert_eq!(script.now.since(before), Duration::from_millis(millis));
    }
    let error = LssError::NoAnswer { service: "store", after: Duration::from_millis(1000) };
    assert_eq!(error.to_string(), "no LSS slave answered `store` within 1000 ms");
}

#[test]
fn r_dst_115_the_answer_to_store_may_have_a_zero_only_if_allowed() {
    let mut strict = configuring();
    strict.begin(LssJob::Store);
    assert!(strict.answer("7E4#0000000000000000").is_empty());
    assert_eq!(strict.answer("7E4#1700000000000000"), ["Done"]);
    let mut script = Script::new(LssSettings { accept_zero_cs: true, ..LssSettings::default() });
    script.begin(LssJob::SwitchGlobal { state: LssState::Configuration, only_slave: true });
    script.begin(LssJob::InquireNodeId);
    assert!(script.answer("7E4#0000000000000000").is_empty(), "to store alone");
    script.answer("7E4#5E01000000000000");
    script.begin(LssJob::Store);
    assert_eq!(script.answer("7E4#0000000000000000"), ["Done"]);
}

#[test]
fn r_dst_111_nothing_is_configured_while_several_slaves_could_obey() {
    let configure = || {
        [
            LssJob::ConfigureNodeId(Some(node(5))),
            LssJob::ConfigureBitRate(LssBitRate::from_kbit(250).unwrap()),
            LssJob::ActivateBitRate { delay: Duration::ZERO },
            LssJob::Store,
        ]
    };
    let mut script = script();
    for job in configure() {
        assert!(matches!(script.master.request(at(0), job), Err(LssError::Nonsense(_))));
    }
    script.begin(LssJob::SwitchGlobal { state: LssState::Configuration, only_slave: false });
    for job in configure() {
        assert_eq!(script.master.request(at(9), job), Err(LssError::NotConfirmed));
    }
    // A selected slave among all that are in configuration state is not alone.
    script.begin(LssJob::SwitchSelective(DST));
    script.answer("7E4#4400000000000000");
    assert_eq!(script.master.request(at(9), LssJob::Store), Err(LssError::NotConfirmed));
    script.begin(LssJob::SwitchGlobal { state: LssState::Waiting, only_slave: false });
    script.begin(LssJob::SwitchSelective(DST));
    assert_eq!(script.answer("7E4#4400000000000000"), ["Done"]);
    for job in configure() {
        script.begin(job);
        script.master.cancel(script.now);
        script.outputs();
    }
}

#[test]
fn one_job_at_a_time_and_none_while_the_bus_is_down() {
    let mut script = script();
    script.begin(LssJob::IdentifyNonConfigured);
    assert_eq!(script.master.request(at(1), LssJob::InquireNodeId), Err(LssError::Busy));
    script.master.pause();
    assert_eq!(script.outputs(), ["BusUnavailable"]);
    assert_eq!(script.master.request(at(2), LssJob::InquireNodeId), Err(LssError::BusUnavailable));
    script.master.resume();
    assert_eq!(script.begin(LssJob::IdentifyNonConfigured).len(), 1);
    script.master.handle_not_sent(script.now, &"7E5#4C00000000000000".parse().unwrap());
    assert_eq!(script.outputs(), ["BusUnavailable"]);
    script.begin(LssJob::IdentifyNonConfigured);
    script.master.cancel(script.now);
    assert_eq!(script.outputs(), ["Cancelled"]);
    assert!(script.master.is_idle());
}

#[test]
fn answers_that_nobody_waits_for_are_counted() {
    let mut script = script();
    assert!(script.answer("7E4#4F00000000000000").is_empty());
    script.begin(LssJob::IdentifyNonConfigured);
    assert!(script.answer("7E4#4F00000000000000").is_empty());
    assert_eq!(script.master.unasked(), 2);
    assert!(script.answer("7E4#50").is_empty(), "not 8 bytes");
    assert!(script.answer("7E5#5000000000000000").is_empty(), "not from a slave");
    assert_eq!(script.answer("7E4#5000000000000000"), ["Answered(true)"]);
}
