//! Lines and their answers, without a network and without a device.

use std::sync::Arc;
use std::time::Duration;

use super::lines::{LONGEST_LINE, Lines};
use super::session::{Asked, Session, Step};
use crate::gateway::command::{AbortCode, Action, NmtRequest, ObjectId, Outcome};
use crate::mapping::{Sketch, TagTable};
use crate::process_image::NodeIndex;
use crate::simulator::random::Random;

/// Nodes 1 and 5 on one bus.
fn table() -> Arc<TagTable> {
    let sketch =
        Sketch::new().node("a", 1, "danfoss-dst-p92c", |_| ()).node("b", 5, "motortech-detcon", |_| ());
    Arc::new(sketch.build().unwrap().0)
}

/// The same with a second bus, on which nobody is.
fn two_networks() -> Arc<TagTable> {
    let mut table = (*table()).clone();
    let mut second = table.buses[0].clone();
    second.name = "can1".into();
    table.buses.push(second);
    Arc::new(table)
}

fn reader() -> Session {
    Session::new(table(), false)
}

fn writer() -> Session {
    Session::new(table(), true)
}

fn answer(session: &mut Session, line: &str) -> String {
    let step = session.handle_line(line.as_bytes());
    let (Step::Answer(text) | Step::NotUnderstood(text) | Step::Refused(text, _)) = step else {
        panic!("{line}: {step:?}")
    };
    text
}

/// The answer without its comment.
fn code(session: &mut Session, line: &str) -> String {
    let text = answer(session, line);
    text.split(" #").next().unwrap().to_owned()
}

fn ask(session: &mut Session, line: &str) -> (Action, Asked) {
    let step = session.handle_line(line.as_bytes());
    let Step::Ask(action, asked) = step else { panic!("{line}: {step:?}") };
    (action, asked)
}

fn read_action(object: ObjectId, len: Option<usize>) -> Action {
    Action::SdoRead { node: NodeIndex(0), object, len, timeout: None }
}

#[test]
fn a_read_in_all_its_spellings_asks_the_gateway() {
    let object = ObjectId::new(0x1018, 1);
    for line in [
        "[1] 1 1 read 0x1018 1 u32",
        "[1] 1 r 0x1018 1 u32",
        "[1] 1 R 0X1018 0x01 U32",
        "\t[ 1 ]  1 Read  4120\t1 u32  # the vendor",
        "[1]1 r 0x1018 1 u32",
        "[0x1] 1 r 0x1018 1 u32#",
    ] {
        let (action, asked) = ask(&mut reader(), line);
        assert_eq!(action, read_action(object, Some(4)), "{line}");
        assert_eq!(asked.answer(&Outcome::Read(vec![0x3D, 2, 0, 0])), "[1] 573");
    }
    let (action, asked) = ask(&mut reader(), "[7] 1 r 0x1018 1");
    assert_eq!(action, read_action(object, None));
    assert_eq!(asked.answer(&Outcome::Read(vec![0x3D, 2, 0, 0])), "[7] 3D 02 00 00");
    let (_, asked) = ask(&mut reader(), "1 r 0x1008 0 vs");
    assert_eq!(asked.answer(&Outcome::Read(b"DST P92C".to_vec())), "[0] \"DST P92C\"");
}

#[test]
fn what_comes_of_a_request_has_the_code_of_the_standard() {
    let told = |outcome: &Outcome| {
        let (_, asked) = ask(&mut reader(), "[9] 1 r 0x2000 0 u16");
        asked.answer(outcome)
    };
    assert_eq!(
        told(&Outcome::Aborted(AbortCode(0x0602_0000))),
        "[9] ERROR:0x06020000 #object does not exist"
    );
    assert_eq!(told(&Outcome::Aborted(AbortCode(0x1234_5678))), "[9] ERROR:0x12345678");
    for (outcome, code) in [
        (Outcome::Timeout, "[9] ERROR:0x05040000 #"),
        (Outcome::Read(vec![1, 2, 3, 4]), "[9] ERROR:0x06070010 #"),
        (Outcome::Busy, "[9] ERROR:102 #"),
        (Outcome::NodeUnavailable, "[9] ERROR:102 #"),
        (Outcome::Rejected("passive".into()), "[9] ERROR:102 #passive"),
        (Outcome::Failed("two\r\nlines".into()), "[9] ERROR:102 #two  lines"),
        (Outcome::Unknown, "[9] ERROR:107"),
        (Outcome::Done, "[9] OK"),
    ] {
        assert!(told(&outcome).starts_with(code), "{outcome:?}: {}", told(&outcome));
    }
}

#[test]
fn without_writes_nothing_that_changes_a_device_is_asked_of_the_gateway() {
    for line in [
        "[3] 1 w 0x1017 0 u16 500",
        "[3] 1 write 0x1017 0 u16 500",
        "[3] 1 start",
        "[3] 1 stop",
        "[3] 1 preop",
        "[3] 1 preoperational",
        "[3] 1 reset node",
        "[3] 1 reset comm",
        "[3] 1 reset communication",
        "[3] 0 stop",
    ] {
        assert_eq!(code(&mut reader(), line), "[3] ERROR:100", "{line}");
    }
    assert!(answer(&mut reader(), "[3] 1 stop").contains("`writes` in [cia309]"));
}

#[test]
fn with_writes_objects_are_written_and_nodes_commanded() {
    let (action, asked) = ask(&mut writer(), "[3] 1 w 0x1017 0 u16 500");
    let object = ObjectId::new(0x1017, 0);
    assert_eq!(action, Action::SdoWrite { node: NodeIndex(0), object, data: vec![0xF4, 1], timeout: None });
    assert_eq!(asked.answer(&Outcome::Done), "[3] OK");
    for (line, request) in [
        ("[3] 5 start", NmtRequest::Start),
        ("[3] 1 5 STOP", NmtRequest::Stop),
        ("[3] 5 preop", NmtRequest::EnterPreOperational),
        ("[3] 5 Reset Node", NmtRequest::ResetNode),
        ("[3] 5 reset comm", NmtRequest::ResetCommunication),
    ] {
        let (action, _) = ask(&mut writer(), line);
        assert_eq!(action, Action::Nmt { node: NodeIndex(1), request }, "{line}");
    }
    assert_eq!(code(&mut writer(), "[3] 0 stop"), "[3] ERROR:107", "all nodes at once is not offered");
}

#[test]
fn network_and_node_are_kept_for_lines_that_name_none() {
    let mut session = reader();
    assert_eq!(code(&mut session, "[1] r 0x1000 0 u32"), "[1] ERROR:105");
    assert_eq!(answer(&mut session, "[2] set node 1"), "[2] OK");
    let (action, _) = ask(&mut session, "[3] r 0x1000 0 u32");
    assert_eq!(action, read_action(ObjectId::new(0x1000, 0), Some(4)));
    assert_eq!(code(&mut session, "[4] 9 r 0x1000 0 u32"), "[4] ERROR:107", "not configured");
    assert_eq!(code(&mut session, "[4] 200 r 0x1000 0 u32"), "[4] ERROR:107");
    assert_eq!(code(&mut session, "[4] 256 r 0x1000 0 u32"), "[4] ERROR:107");
    assert_eq!(code(&mut session, "[5] 2 1 r 0x1000 0 u32"), "[5] ERROR:106");
    assert_eq!(code(&mut session, "[5] 70000 1 r 0x1000 0 u32"), "[5] ERROR:106");
    assert_eq!(code(&mut session, "[6] set node 128"), "[6] ERROR:107");
    assert_eq!(code(&mut session, "[7] set network 2"), "[7] ERROR:106");

    let mut session = Session::new(two_networks(), false);
    assert_eq!(code(&mut session, "[1] 1 r 0x1000 0 u32"), "[1] ERROR:104", "which of the two?");
    assert_eq!(code(&mut session, "[1] 2 1 r 0x1000 0 u32"), "[1] ERROR:107");
    ask(&mut session, "[1] 1 1 r 0x1000 0 u32");
    assert_eq!(answer(&mut session, "[2] set network 1"), "[2] OK");
    ask(&mut session, "[3] 1 r 0x1000 0 u32");
    assert_eq!(answer(&mut session, "[4] 2 set node 1"), "[4] OK");
    assert_eq!(code(&mut session, "[5] r 0x1000 0 u32"), "[5] ERROR:107", "the network changed with it");
    assert!(answer(&mut session, "[6] set network 3").contains("1 = can0, 2 = can1"));
}

#[test]
fn the_sdo_time_out_is_that_of_the_session_and_bounded() {
    let mut session = reader();
    assert_eq!(answer(&mut session, "[1] 1 set sdo_timeout 2000"), "[1] OK");
    let (action, _) = ask(&mut session, "[2] 1 r 0x1000 0");
    assert!(
        matches!(action, Action::SdoRead { timeout: Some(timeout), .. } if timeout == Duration::from_secs(2))
    );
    assert_eq!(code(&mut session, "[3] set sdo_timeout 10001"), "[3] ERROR:101");
    assert_eq!(code(&mut session, "[3] set sdo_timeout 0"), "[3] ERROR:101");
}

#[test]
fn lines_that_ask_for_nothing_are_not_answered() {
    for line in ["", " ", "\t", "# [1] start", "  # comment", "\r"] {
        assert_eq!(reader().handle_line(line.as_bytes()), Step::Nothing, "{line:?}");
    }
}

#[test]
fn a_web_page_cannot_send_lines_through_a_browser() {
    for line in ["POST / HTTP/1.1", "GET /[1]%201%20stop HTTP/1.0", "PRI * HTTP/2.0"] {
        assert_eq!(writer().handle_line(line.as_bytes()), Step::End, "{line}");
    }
    let line = b"[1] 1 w 0x2000 0 vs \"GET / HTTP/1.1\"";
    assert!(matches!(writer().handle_line(line), Step::Ask(..)), "a text may say so");
}

#[test]
fn what_is_not_understood_is_a_syntax_error_with_its_sequence_number() {
    for line in [
        "[4]",
        "[4] 1",
        "[4] 1 hello",
        "[4] 1 2 3 start",
        "[4] 1x r 0x1000 0",
        "[4] 01 r 0x1000 0",
        "[4] 1 r",
        "[4] 1 r 0x1000",
        "[4] 1 r 0x10000 0",
        "[4] 1 r 0x1000 256",
        "[4] 1 r 0x1000 010",
        "[4] 1 r 0x1000 0 float",
        "[4] 1 r 0x1000 0 u32 more",
        "[4] 1 r -1 0",
        "[4] 1 r 0x 0",
        "[4] 1 w 0x1017 0 u16",
        "[4] 1 w 0x1017 0 u16 65536",
        "[4] 1 w 0x1017 0 u16 1 2",
        "[4] 1 w 0x1017 0 vs \"open",
        "[4] 1 start now",
        "[4] 1 reset",
        "[4] 1 reset all",
        "[4] set",
        "[4] set node",
        "[4] set node one",
        "[4] set colour 1",
        "[4] 1 1 set node 1",
        "[4] 1 set network 1",
        "[4] info",
        "[4] \"start\"",
    ] {
        assert_eq!(code(&mut writer(), line), "[4] ERROR:101", "{line}");
    }
    for line in ["[", "[]", "[x] start", "[1", "[4294967296] start", "[-1] start", "hello", "]"] {
        assert_eq!(code(&mut writer(), line), "[0] ERROR:101", "{line}");
    }
}

#[test]
fn a_line_that_is_no_text_is_the_last_one() {
    for line in
        [b"[1] \xFF".as_slice(), b"\x16\x03\x01\x02", b"[1] 1 r 0x1018 1 u32\0", b"# \x1B", b"[1] 1 stop\x7F"]
    {
        let Step::Last(text) = writer().handle_line(line) else { panic!("{line:02x?}") };
        assert!(text.starts_with("[0] ERROR:101"), "{text}");
    }
    assert!(matches!(reader().handle_line(b"\t[1]\t1 r 0x1018 1\r"), Step::Ask(..)));
    assert!(matches!(reader().handle_line("[1] 1 # µ".as_bytes()), Step::NotUnderstood(_)));
}

#[test]
fn commands_that_are_refused_are_told_with_what_was_asked_for_and_why() {
    let told = |mut session: Session, line: &str| {
        let Step::Refused(answer, told) = session.handle_line(line.as_bytes()) else { panic!("{line}") };
        (answer, told.verb, told.text)
    };
    let (answer, verb, text) = told(reader(), "[7] 1 w 0x1017 0 u16 500");
    assert!(answer.starts_with("[7] ERROR:100 "), "{answer}");
    assert_eq!(verb, "sdo_write");
    assert!(text.starts_with("0x1017:0 of node 1: writes and NMT commands are not enabled"), "{text}");
    assert_eq!(told(reader(), "[8] 1 stop").1, "nmt");
    let (_, verb, text) = told(writer(), "[9] 1 99 reset node");
    assert_eq!(verb, "nmt");
    assert!(text.starts_with("ResetNode of node 99 in network 1: no node 99"), "{text}");
    // A read changes nothing.
    assert!(matches!(writer().handle_line(b"[1] 99 r 0x1018 1"), Step::Answer(_)));
}

#[test]
fn only_what_is_understood_keeps_a_place() {
    for line in ["hello", "[4] 1 hello", "[x] start"] {
        assert!(matches!(writer().handle_line(line.as_bytes()), Step::NotUnderstood(_)), "{line}");
    }
    assert!(matches!(writer().handle_line(b"[1] 9 start"), Step::Refused(..)));
    for line in ["[1] set network 9", "[1] 1 init 0", "[1] info version"] {
        assert!(matches!(writer().handle_line(line.as_bytes()), Step::Answer(_)), "{line}");
    }
}

#[test]
fn requests_of_the_standard_that_are_not_served_say_so() {
    for line in [
        "[5] 1 read pdo 1",
        "[5] 1 r p 1",
        "[5] 1 write pdo 1 1 0x12",
        "[5] set rpdo 1 0x182 sync0 1 0x2003 0 u8",
        "[5] set tpdox 1",
        "[5] 1 enable guarding 100 3",
        "[5] 1 disable heartbeat",
        "[5] 1 init 0",
        "[5] set heartbeat 50",
        "[5] set id 1",
        "[5] set command_timeout 1000",
        "[5] set sdo_block 1",
        "[5] boot_up_indication Enable",
        "[5] lss_switch_glob 1",
        "[5] _lss_fastscan",
    ] {
        assert_eq!(code(&mut writer(), line), "[5] ERROR:100", "{line}");
    }
}

#[test]
fn info_version_has_the_seven_fields_of_the_standard() {
    let text = answer(&mut reader(), "[6] info version");
    assert_eq!(text.split(' ').count(), 8, "{text}");
    assert!(text.starts_with("[6] 0 0 0.0 0 1 3.0 "), "{text}");
}

/// A line made of pieces of real ones, with some letters changed.
fn random_line(random: &mut Random) -> Vec<u8> {
    const PIECES: [&str; 36] = [
        "[1]",
        "[",
        "]",
        "1",
        "0x1018",
        "0",
        "127",
        "r",
        "read",
        "w",
        "write",
        "start",
        "stop",
        "reset",
        "node",
        "comm",
        "set",
        "network",
        "sdo_timeout",
        "info",
        "version",
        "u32",
        "vs",
        "d",
        "t",
        "hex",
        "\"a b\"",
        "\"",
        "#",
        "-1",
        "1.5",
        "pdo",
        "lss_store",
        "\\x",
        "99999999999999999999",
        "Zm9v",
    ];
    const WHOLE: [&str; 4] =
        ["[1] 1 r 0x1018 1 u32 ", "[2] 1 1 w 0x1017 0 vs \"a b\" ", "[3] 5 reset comm ", "[4] set node 1 "];
    let mut line = Vec::new();
    let pieces = if random.between(0, 2) == 0 {
        line.extend_from_slice(WHOLE[usize::try_from(random.between(0, 3)).unwrap()].as_bytes());
        0
    } else {
        random.between(0, 9)
    };
    for _ in 0..pieces {
        let place = usize::try_from(random.between(0, 35)).unwrap();
        line.extend_from_slice(PIECES[place].as_bytes());
        if random.between(0, 9) > 0 {
            line.push(b' ');
        }
    }
    for _ in 0..random.between(-6, 3) {
        let byte = u8::try_from(random.between(0, 255)).unwrap();
        let place = usize::try_from(random.between(0, i32::try_from(line.len()).unwrap())).unwrap();
        if byte != b'\n' {
            line.insert(place, byte);
        }
    }
    line
}

#[test]
fn a_hundred_thousand_lines_of_any_kind_are_answered_with_one_line_or_none() {
    let mut random = Random::new(309);
    let (mut reading, mut writing) = (reader(), writer());
    let (mut asked_for, mut refused) = (0, 0);
    for _ in 0..100_000 {
        let line = random_line(&mut random);
        for session in [&mut reading, &mut writing] {
            let answer = match session.handle_line(&line) {
                Step::Nothing | Step::End => continue,
                Step::Answer(text)
                | Step::NotUnderstood(text)
                | Step::Last(text)
                | Step::Refused(text, _) => {
                    refused += u32::from(text.contains("ERROR:"));
                    text
                }
                Step::Ask(_, asked) => {
                    asked_for += 1;
                    asked.answer(&Outcome::Read(line.clone()))
                }
            };
            assert!(
                answer.starts_with('[') && !answer.chars().any(char::is_control),
                "{line:02x?}: {answer:?}"
            );
            assert!(answer.len() < 400, "{answer}");
        }
        assert!(!matches!(
            reading.handle_line(&line),
            Step::Ask(Action::SdoWrite { .. } | Action::Nmt { .. }, _)
        ));
    }
    assert!(asked_for > 100 && refused > 10_000, "{asked_for} {refused}");
}

#[test]
fn any_stream_of_bytes_is_cut_into_lines_in_bounded_memory() {
    let mut random = Random::new(1);
    let (mut lines, mut session) = (Lines::default(), writer());
    for chunk_number in 0..20_000 {
        let chunk: Vec<u8> = (0..random.between(1, 300))
            .map(|_| u8::try_from(random.between(0, 255)).unwrap())
            .map(|byte| if byte == b'\n' && chunk_number % 50 != 0 { b'x' } else { byte })
            .collect();
        lines.push(&chunk);
        while let Some(line) = lines.next_line() {
            if let Ok(line) = line {
                session.handle_line(line);
            }
        }
        assert!(lines.held() < LONGEST_LINE + chunk.len());
    }
}
