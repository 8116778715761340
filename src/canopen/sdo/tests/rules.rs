//! The rules of the client, one by one, frame by frame.

use std::time::Duration;

use super::*;
use crate::canopen::sdo::transfer::append;

#[test]
fn r_dst_066_r_dst_067_v_dst_12_v_dst_13_expedited_transfers_of_the_manual() {
    let mut client = client(SdoSettings::default());
    let write = SdoRequest::write(ObjectId::new(0x1017, 0), vec![0xE8, 0x03]);
    assert_eq!(ask(&mut client, 0, 1, write), ["601#2B171000E8030000"]);
    assert_eq!(answer(&mut client, 5, "581#6017100000000000"), ["1 []"]);
    let read = SdoRequest::read(ObjectId::new(0x6130, 1));
    assert_eq!(ask(&mut client, 10, 2, read), ["601#4030610100000000"]);
    assert_eq!(answer(&mut client, 15, "581#433061010000C03F"), ["2 [00, 00, C0, 3F]"]);
    assert_eq!(ask(&mut client, 20, 3, SdoRequest::read(TIMER)), ["601#4000180500000000"]);
    assert_eq!(answer(&mut client, 25, "581#4B001805E8030000"), ["3 [E8, 03]"]);
    assert!(client.is_idle());
    assert_eq!((client.counters().succeeded, client.poll_timeout()), (3, None));
}

#[test]
fn r_dst_065_unused_bytes_are_sent_as_0_and_ignored_on_receipt() {
    let mut client = client(SdoSettings::default());
    assert_eq!(ask(&mut client, 0, 1, SdoRequest::write(TIMER, vec![7])), ["601#2F00180507000000"]);
    assert_eq!(answer(&mut client, 5, "581#60001805DEADBEEF"), ["1 []"]);
    ask(&mut client, 100, 2, SdoRequest::read(TIMER));
    assert_eq!(answer(&mut client, 105, "581#4F00180507ADBEEF"), ["2 [07]"]);
    ask(&mut client, 200, 3, SdoRequest::read(NAME));
    answer(&mut client, 201, "581#4108100002000000");
    assert_eq!(answer(&mut client, 202, "581#0B656EDEADBEEF00"), ["3 [65, 6E]"]);
}

#[test]
fn r_dst_072_v_dst_21_the_device_name_comes_in_segments() {
    let mut client = client(SdoSettings::default());
    assert_eq!(ask(&mut client, 0, 1, SdoRequest::read(NAME)), ["601#4008100000000000"]);
    assert_eq!(answer(&mut client, 1, "581#4108100010000000"), ["601#6000000000000000"]);
    assert_eq!(answer(&mut client, 2, "581#0044535420503932"), ["601#7000000000000000"]);
    assert_eq!(answer(&mut client, 3, "581#10432043414E6F70"), ["601#6000000000000000"]);
    let name: Vec<u8> = b"DST P92C CANopen".to_vec();
    assert_eq!(answer(&mut client, 4, "581#0B656E0000000000"), [format!("1 {name:02X?}")]);
}

#[test]
fn r_dst_068_r_dst_069_an_abort_ends_the_transfer_by_its_code() {
    for (reply, code, text) in [
        ("581#8000180513000706", 0x0607_0013, "length of the data too low"),
        ("581#800018052301CDAB", 0xABCD_0123, "0xABCD0123"),
    ] {
        let mut client = client(SdoSettings::default());
        client.request(at(0), TransferId(1), SdoRequest::write(TIMER, vec![1])).unwrap();
        client.handle_answer(at(1), &reply.parse().unwrap());
        client.poll_output();
        let Some(SdoOutput::Done(TransferId(1), Err(error))) = client.poll_output() else { panic!() };
        assert_eq!(error, SdoError::Abort(AbortCode(code)));
        assert!(error.to_string().contains(text), "{error}");
    }
}

#[test]
fn r_dst_073_a_read_is_repeated_twice_then_fails_with_a_time_out() {
    let mut client = client(SdoSettings::default());
    let request = "601#4000180500000000";
    assert_eq!(ask(&mut client, 0, 1, SdoRequest::read(TIMER)), [request]);
    assert_eq!(client.poll_timeout(), Some((at(500), "SDO answer")));
    assert!(wait(&mut client, 499).is_empty());
    assert_eq!(wait(&mut client, 500), [request]);
    assert_eq!(wait(&mut client, 1000), [request]);
    assert_eq!(wait(&mut client, 1500), ["601#8000180500000405", "1 Timeout { after: 500ms, requests: 3 }"]);
    assert_eq!(client.counters().timeouts, 3);
}

#[test]
fn r_dst_073_a_write_is_sent_once_unless_the_request_allows_more() {
    let mut client = client(SdoSettings::default());
    let frame = "601#2B001805FA000000";
    assert_eq!(ask(&mut client, 0, 1, SdoRequest::write(TIMER, vec![250, 0])), [frame]);
    assert_eq!(wait(&mut client, 500), ["601#8000180500000405", "1 Timeout { after: 500ms, requests: 1 }"]);
    let request = SdoRequest::write(TIMER, vec![250, 0]).repeatable();
    assert_eq!(ask(&mut client, 2000, 2, request), [frame]);
    assert_eq!(wait(&mut client, 2500), [frame]);
    assert_eq!(answer(&mut client, 2501, "581#6000180500000000"), ["2 []"]);
}

#[test]
fn r_dst_073_store_and_restore_may_take_longer() {
    for (index, action, frame) in
        [(0x1010, b"save", "601#2310100173617665"), (0x1011, b"load", "601#231110016C6F6164")]
    {
        let mut client = client(SdoSettings::default());
        let request = SdoRequest::write(ObjectId::new(index, 1), action.to_vec());
        assert_eq!(ask(&mut client, 0, 1, request), [frame]);
        assert!(wait(&mut client, 2999).is_empty());
        assert!(wait(&mut client, 3000)[1].starts_with("1 Timeout { after: 3s"));
    }
}

#[test]
fn r_dst_073_one_transfer_at_a_time_and_boot_before_commands() {
    let mut client = client(SdoSettings::default());
    let read = |sub| SdoRequest::read(ObjectId::new(0x1018, sub));
    assert_eq!(ask(&mut client, 0, 1, read(1)), ["601#4018100100000000"]);
    assert!(ask(&mut client, 0, 2, read(2)).is_empty());
    assert!(ask(&mut client, 0, 3, read(3).for_boot()).is_empty());
    assert!(ask(&mut client, 0, 4, read(4).for_boot()).is_empty());
    for (millis, sub, next) in [(1, 1, 3), (2, 3, 4), (3, 4, 2)] {
        let outputs = answer(&mut client, millis, &format!("581#4F18100{sub}07000000"));
        assert_eq!(outputs, [format!("{sub} [07]"), format!("601#4018100{next}00000000")]);
    }
}

#[test]
fn a_full_queue_refuses_and_says_so() {
    let mut client = client(SdoSettings::default());
    for id in 0..9 {
        client.request(at(0), TransferId(id), SdoRequest::read(TIMER)).unwrap();
    }
    let refused = client.request(at(0), TransferId(9), SdoRequest::read(TIMER));
    assert_eq!(refused, Err(Refused::QueueFull { limit: 8 }));
    client.request(at(0), TransferId(10), SdoRequest::read(TIMER).for_boot()).unwrap();
    let long = SdoRequest::write(TIMER, vec![0; 65_537]);
    let refused = client.request(at(0), TransferId(11), long);
    assert_eq!(refused, Err(Refused::TooLong { len: 65_537, longest: 65_536 }));
}

#[test]
fn answers_for_other_objects_are_counted_and_ignored() {
    let mut client = client(SdoSettings::default());
    assert!(answer(&mut client, 0, "581#4B001805E8030000").is_empty(), "nothing was asked");
    ask(&mut client, 0, 1, SdoRequest::read(TIMER));
    for (count, foreign) in [
        (2, "581#4B001803E8030000"),
        (3, "581#4B001905E8030000"),
        (4, "581#6000180500000000"),
        (5, "581#8000180400000206"),
        (6, "581#0044535420503932"),
        (7, "581#2000000000000000"),
        (8, "581#FF00180500000000"),
    ] {
        assert!(answer(&mut client, 1, foreign).is_empty(), "{foreign}");
        assert_eq!(client.counters().unasked, count);
    }
    assert!(answer(&mut client, 1, "581#4B0018").is_empty());
    assert!(answer(&mut client, 1, "581#R8").is_empty());
    assert!(answer(&mut client, 1, "582#4B001805E8030000").is_empty());
    assert_eq!(client.counters().malformed, 2);
    assert_eq!(client.poll_timeout(), Some((at(500), "SDO answer")), "they do not prolong the wait");
    assert_eq!(answer(&mut client, 2, "581#4B001805E8030000"), ["1 [E8, 03]"]);
}

#[test]
fn a_late_answer_is_not_taken_for_that_to_the_next_request() {
    let mut client = client(SdoSettings::default());
    ask(&mut client, 0, 1, SdoRequest::write(TIMER, vec![1, 0]));
    assert!(wait(&mut client, 500)[1].starts_with("1 Timeout"));
    // The same object again: nothing is sent before a late answer must have come.
    assert!(ask(&mut client, 501, 2, SdoRequest::write(TIMER, vec![2, 0])).is_empty());
    assert_eq!(client.poll_timeout(), Some((at(1000), "SDO request that waits")));
    assert!(answer(&mut client, 999, "581#6000180500000000").is_empty());
    assert_eq!(client.counters().unasked, 1);
    assert_eq!(wait(&mut client, 1000), ["601#2B00180502000000"]);
    assert_eq!(answer(&mut client, 1001, "581#8000180530000906"), ["2 Abort(0x06090030)"]);
}

#[test]
fn after_a_repeated_read_the_second_answer_is_waited_for() {
    let mut client = client(SdoSettings::default());
    ask(&mut client, 0, 1, SdoRequest::read(TIMER));
    wait(&mut client, 500);
    assert_eq!(answer(&mut client, 510, "581#4B00180501000000"), ["1 [01, 00]"]);
    assert!(ask(&mut client, 600, 2, SdoRequest::read(TIMER)).is_empty());
    assert!(answer(&mut client, 610, "581#4B00180501000000").is_empty(), "the answer to the repetition");
    assert_eq!(wait(&mut client, 1500), ["601#4000180500000000"]);
    assert_eq!(answer(&mut client, 1501, "581#4B00180502000000"), ["2 [02, 00]"]);
}

#[test]
fn the_copy_of_an_answer_does_not_answer_the_next_request_for_the_same_object() {
    let mut client = client(SdoSettings::default());
    ask(&mut client, 0, 1, SdoRequest::write(TIMER, vec![1, 0]));
    assert!(ask(&mut client, 0, 2, SdoRequest::write(TIMER, vec![2, 0])).is_empty());
    assert_eq!(answer(&mut client, 5, "581#6000180500000000"), ["1 []"]);
    assert!(answer(&mut client, 6, "581#6000180500000000").is_empty());
    assert_eq!(wait(&mut client, 25), ["601#2B00180502000000"]);
}

#[test]
fn the_copy_of_a_segment_is_ignored_once() {
    let mut client = client(SdoSettings::default());
    ask(&mut client, 0, 1, SdoRequest::read(NAME));
    answer(&mut client, 1, "581#4108100010000000");
    assert!(answer(&mut client, 1, "581#4108100010000000").is_empty());
    answer(&mut client, 2, "581#0044535420503932");
    assert!(answer(&mut client, 2, "581#0044535420503932").is_empty());
    assert_eq!(client.counters().duplicates, 2);
    assert_eq!(
        answer(&mut client, 3, "581#0044535420503932"),
        ["601#8008100000000305", "1 Protocol(Toggle)"],
        "a second is a stuck toggle"
    );
}

#[test]
fn a_toggle_error_is_aborted_with_05030000() {
    let mut client = client(SdoSettings::default());
    ask(&mut client, 0, 1, SdoRequest::read(NAME));
    answer(&mut client, 1, "581#4108100010000000");
    assert_eq!(
        answer(&mut client, 2, "581#1044535420503932"),
        ["601#8008100000000305", "1 Protocol(Toggle)"]
    );
    let write = SdoRequest::write(NAME, b"DST P92C".to_vec());
    assert_eq!(ask(&mut client, 2000, 2, write), ["601#2108100008000000"]);
    assert_eq!(answer(&mut client, 2001, "581#6008100000000000"), ["601#0044535420503932"]);
    assert_eq!(
        answer(&mut client, 2002, "581#3000000000000000"),
        ["601#8008100000000305", "2 Protocol(Toggle)"]
    );
}

#[test]
fn the_size_that_came_is_held_against_the_size_that_was_announced() {
    for (announced, last, frames) in [
        ("581#4108100005000000", "581#0044535420503932", "601#8008100010000706"),
        ("581#4108100008000000", "581#0144535420503932", ""),
        ("581#4108100006000000", "581#0144535420503932", ""),
    ] {
        let mut client = client(SdoSettings::default());
        ask(&mut client, 0, 1, SdoRequest::read(NAME));
        answer(&mut client, 1, announced);
        let outputs = answer(&mut client, 2, last);
        assert!(outputs.last().unwrap().starts_with("1 Protocol(Size"), "{outputs:?}");
        assert_eq!(outputs.len() == 2, !frames.is_empty(), "the server is told unless it is done");
        assert!(frames.is_empty() || outputs[0] == frames, "{outputs:?}");
    }
}

#[test]
fn an_object_that_is_too_long_is_not_read() {
    let settings = SdoSettings { longest: 10, ..SdoSettings::default() };
    let mut announced = client(settings);
    ask(&mut announced, 0, 1, SdoRequest::read(NAME));
    assert_eq!(
        answer(&mut announced, 1, "581#410810000B000000"),
        ["601#8008100005000405", "1 TooLong { longest: 10 }"]
    );
    let mut unannounced = client(settings);
    ask(&mut unannounced, 0, 1, SdoRequest::read(NAME));
    answer(&mut unannounced, 1, "581#4008100000000000");
    answer(&mut unannounced, 2, "581#0044535420503932");
    assert_eq!(
        answer(&mut unannounced, 3, "581#1044535420503932"),
        ["601#8008100005000405", "1 TooLong { longest: 10 }"]
    );
}

#[test]
fn empty_segments_without_end_are_refused() {
    let mut client = client(SdoSettings::default());
    ask(&mut client, 0, 1, SdoRequest::read(NAME));
    answer(&mut client, 1, "581#4008100000000000");
    assert_eq!(
        answer(&mut client, 2, "581#0E00000000000000"),
        ["601#8008100000000008", "1 Protocol(EmptySegment)"]
    );
}

#[test]
fn an_answer_of_unsaid_length_has_the_length_that_the_caller_knows() {
    let mut client = client(SdoSettings::default());
    ask(&mut client, 0, 1, SdoRequest::read(TIMER).of_len(2));
    assert_eq!(answer(&mut client, 1, "581#42001805E8030000"), ["1 [E8, 03]"]);
    ask(&mut client, 100, 2, SdoRequest::read(TIMER));
    assert_eq!(answer(&mut client, 101, "581#42001805E8030000"), ["2 [E8, 03, 00, 00]"]);
}

#[test]
fn a_client_that_comes_between_our_segments_is_noticed() {
    let mut client = client(SdoSettings::default());
    ask(&mut client, 0, 1, SdoRequest::read(NAME));
    answer(&mut client, 1, "581#4108100010000000");
    // The server works for somebody else now. No abort: it would hit the other.
    assert!(answer(&mut client, 2, "581#4109100008000000").is_empty());
    assert_eq!(client.poll_timeout(), Some((at(1001), "SDO repetition")));
    assert!(answer(&mut client, 3, "581#0044535420503932").is_empty(), "not ours");
    assert_eq!(wait(&mut client, 1001), ["601#4008100000000000"]);

    let write = SdoRequest::write(NAME, b"DST P92C".to_vec());
    let mut client = self::client(SdoSettings::default());
    ask(&mut client, 0, 2, write);
    answer(&mut client, 1, "581#6008100000000000");
    assert_eq!(answer(&mut client, 2, "581#4B001805E8030000"), ["2 Interrupted"]);
}

#[test]
fn a_bus_that_is_down_fails_everything_at_once() {
    let mut client = client(SdoSettings::default());
    ask(&mut client, 0, 1, SdoRequest::read(NAME));
    ask(&mut client, 0, 2, SdoRequest::read(TIMER));
    ask(&mut client, 0, 3, SdoRequest::read(TIMER).for_boot());
    client.pause();
    let failed: Vec<_> = [1, 3, 2].iter().map(|id| format!("{id} BusUnavailable")).collect();
    assert_eq!(outputs(&mut client), failed);
    assert_eq!(client.poll_timeout(), None);
    let refused = client.request(at(10), TransferId(4), SdoRequest::read(TIMER));
    assert_eq!(refused, Err(Refused::BusUnavailable));
    client.resume(at(9000));
    assert!(ask(&mut client, 9001, 5, SdoRequest::read(NAME)).is_empty(), "the old answer may still come");
    assert!(answer(&mut client, 9002, "581#4F08100041000000").is_empty());
    assert_eq!(wait(&mut client, 9500), ["601#4008100000000000"]);
}

#[test]
fn a_request_that_did_not_leave_is_not_held_against_the_node() {
    let settings = SdoSettings { repeat: 1, ..SdoSettings::default() };
    let mut client = client(settings);
    let frame = "601#2B001805FA000000";
    assert_eq!(ask(&mut client, 0, 1, SdoRequest::write(TIMER, vec![250, 0])), [frame]);
    client.handle_not_sent(&frame.parse().unwrap());
    assert_eq!(wait(&mut client, 500), [frame], "what did not leave was not written");
    client.handle_not_sent(&frame.parse().unwrap());
    assert_eq!(wait(&mut client, 1000), ["601#8000180500000405", "1 BusUnavailable"]);
}

#[test]
fn a_transfer_that_never_ends_is_ended() {
    let settings = SdoSettings { within: Duration::from_secs(2), ..SdoSettings::default() };
    let mut client = client(settings);
    ask(&mut client, 0, 1, SdoRequest::read(NAME));
    answer(&mut client, 400, "581#4008100000000000");
    for (millis, head) in [(800, "00"), (1200, "10"), (1600, "00"), (1999, "10")] {
        answer(&mut client, millis, &format!("581#{head}44535420503932"));
    }
    assert_eq!(client.poll_timeout(), Some((at(2000), "SDO answer")));
    assert_eq!(wait(&mut client, 2000), ["601#8008100000000405", "1 TooSlow { within: 2s }"]);
}

#[test]
fn a_break_in_the_middle_of_a_read_begins_it_again_after_a_rest() {
    let mut client = client(SdoSettings::default());
    ask(&mut client, 0, 1, SdoRequest::read(NAME));
    answer(&mut client, 1, "581#4108100010000000");
    assert_eq!(wait(&mut client, 501), ["601#8008100000000405"]);
    assert!(answer(&mut client, 600, "581#0044535420503932").is_empty(), "late");
    assert_eq!(wait(&mut client, 1001), ["601#4008100000000000"]);
}

#[test]
fn memory_is_not_taken_for_what_is_only_announced() {
    let mut data = Vec::new();
    for len in 0..2000 {
        append(&mut data, &[len.try_into().unwrap_or(0); 5], 10_000);
        assert!(data.capacity() <= 10_000, "{}", data.capacity());
        assert!(data.capacity() <= 64.max(2 * data.len()), "{} for {}", data.capacity(), data.len());
    }
}

#[test]
fn requests_tell_reads_from_writes() {
    let write = SdoRequest::write(TIMER, vec![1]);
    assert!(!write.idempotent && write.clone().repeatable().idempotent);
    assert_eq!(write.action, SdoAction::Write(vec![1]));
    assert_eq!(ProtocolError::Command(0x20).to_string(), "unexpected command byte 0x20");
}
