//! Writes of clients that are known and of others, against a desk behind which somebody takes note.

use tokio::sync::{mpsc, oneshot};

use super::*;
use crate::access::{Access, AccessEntry, Role};
use crate::gateway::Command;
use crate::gateway::command::desk::{self, Requests};
use crate::gateway::command::{Action, NmtRequest, Outcome};
use crate::mapping::{At, Sketch, SourceText, TagTable};
use crate::modbus::fixture::shared_of;
use crate::modbus::writing::Writable;
use crate::modbus::{ModbusSettings, RegisterBank, RegisterMap};
use crate::process_image::{NodeIndex, ProcessImage, Quality, Reason, Sample, Value, process_image};

/// `speed` at 100 in 0.1, `flow` at 101-102 as a float, `run` at bit 0; `level` is the device's.
const PUMP: &str = r#"
format = 1
device = { vendor = "test", model = "pump" }
[tpdo.1]
cob_id = "$NODEID+0x180"
length = 1
timeout_ms = 1500
[rpdo.1]
cob_id = "$NODEID+0x200"
length = 8
[[tag]]
name = "level"
tpdo = 1
bit = 0
type = "u8"
registers = [{ address = 103, type = "u16" }]
[[tag]]
name = "speed"
rpdo = 1
bit = 0
type = "u16"
scale = { multiply = 0.1 }
registers = [{ address = 100, type = "u16", resolution = 0.1 }]
[[tag]]
name = "flow"
rpdo = 1
bit = 16
type = "f32"
registers = [{ address = 101, type = "f32" }]
[[tag]]
name = "run"
rpdo = 1
bit = 48
type = "bool"
bit_address = 0
"#;

struct Plant {
    shared: Shared,
    desk: Desk,
    queue: mpsc::Receiver<(Command, oneshot::Sender<Outcome>)>,
    table: TagTable,
}

/// The pump at unit 2. The client 10.0.0.5 may do what the role says, and write the pump's tags.
fn plant(role: Role) -> Plant {
    let sketch = Sketch::new().mapping(SourceText::new("pump", PUMP));
    let table = sketch.node("pump", 2, "pump", |node| node.outputs = At::nowhere(true)).build().unwrap().0;
    let write = if role == Role::Viewer { vec![] } else { vec![At::nowhere("pump/*".to_owned())] };
    let modbus = vec![At::nowhere("10.0.0.5".parse().unwrap())];
    let modbus_role = Some(At::nowhere("panel".to_owned()));
    let entry = AccessEntry { role, modbus, modbus_role, write, ..AccessEntry::default() };
    let entries = [(At::nowhere("hmi".to_owned()), entry)].into();
    let (access, problems) = Access::build(&SourceText::new("", ""), &entries, &table);
    assert_eq!(problems, []);
    let writable = Writable::of(&access);
    let map = RegisterMap::build_for(&table, &ModbusSettings::default(), "cangate", writable).unwrap();
    let (desk, queue) = Desk::new(8);
    desk.set_access(Arc::new(access));
    let mut shared = shared_of(table.clone());
    shared.bank = RegisterBank::new(Arc::new(table.clone()), map.into()).into();
    shared.writers = Some(Writers::new(desk.clone()));
    Plant { shared, desk, queue, table }
}

fn hex(text: &str) -> Vec<u8> {
    let digits: String = text.split_whitespace().collect();
    (0..digits.len() / 2).map(|at| u8::from_str_radix(&digits[2 * at..2 * at + 2], 16).unwrap()).collect()
}

impl Plant {
    fn take(&self, client: &str, unit: u8, pdu: &str) -> Option<Asking> {
        self.take_as(client, &Caller::WITHOUT_TLS, unit, pdu)
    }

    fn take_as(&self, client: &str, caller: &Caller, unit: u8, pdu: &str) -> Option<Asking> {
        let writers = self.shared.writers.as_ref().unwrap();
        writers.take(&self.shared, (format!("{client}:4000").parse().unwrap(), caller), unit, &hex(pdu))
    }

    /// The answer to the known client, when the gateway says this; and what it was asked.
    async fn ask(
        &mut self,
        unit: u8,
        pdu: &str,
        outcome: Outcome,
    ) -> (Result<Vec<u8>, ExceptionCode>, Option<Action>) {
        let asking = self.take("10.0.0.5", unit, pdu).expect("it is known");
        let writers = self.shared.writers.as_ref().unwrap();
        let gateway = async {
            let (command, reply) = self.queue.recv().await.unwrap();
            reply.send(outcome).unwrap();
            command.action
        };
        let answer = writers.answer(&self.shared, &asking);
        tokio::pin!(answer, gateway);
        tokio::select! {
            biased;
            answer = &mut answer => (answer, None),
            action = &mut gateway => (answer.await, Some(action)),
        }
    }

    fn writes(&self, action: Option<Action>) -> Vec<(String, Value)> {
        let Some(Action::WriteTags { writes }) = action else { panic!("{action:?}") };
        writes.iter().map(|(tag, value)| (self.table.tag(*tag).unwrap().name.clone(), *value)).collect()
    }

    fn refused(&self) -> u64 {
        self.desk.refused().into_iter().map(|(_, count)| count).sum()
    }
}

#[tokio::test]
async fn registers_of_writable_tags_are_written_whole_in_engineering_units() {
    let mut plant = plant(Role::Operator);
    for (pdu, echo, expected) in [
        ("06 0064 00FA", "06 0064 00FA", vec![("speed".to_owned(), Value::Float(25.0))]),
        (
            "10 0064 0003 06 00FA 449A 5000",
            "10 0064 0003",
            vec![("speed".to_owned(), Value::Float(25.0)), ("flow".to_owned(), Value::Float(1234.5))],
        ),
        ("05 0000 FF00", "05 0000 FF00", vec![("run".to_owned(), Value::Bool(true))]),
        ("0F 0000 0001 01 00", "0F 0000 0001", vec![("run".to_owned(), Value::Bool(false))]),
    ] {
        let (answer, action) = plant.ask(2, pdu, Outcome::Done).await;
        assert_eq!(answer, Ok(hex(echo)), "{pdu}");
        assert_eq!(plant.writes(action), expected, "{pdu}");
    }
    // FC 23 writes first and answers with what it reads.
    let (answer, _) = plant.ask(2, "17 0001 0001 0064 0001 02 00FA", Outcome::Done).await;
    assert_eq!(answer.unwrap()[..2], [0x17, 2]);
    assert_eq!(plant.refused(), 0);
}

#[tokio::test]
async fn fc_22_changes_bits_of_a_value_that_is_known_and_is_refused_where_none_is() {
    let mut plant = plant(Role::Operator);
    let pdu = "16 0064 00F0 000A";
    for (quality, expected) in [
        (Quality::NEVER, None),
        (Quality::Bad(Reason::NotSent), None),
        (Quality::Stale(Reason::NodeNotOperational), None),
        // 0x0155, of which 0x0050 stays and 0x000A is set: 9.0.
        (Quality::Good, Some(9.0)),
        (Quality::Uncertain(Reason::NodeLost), Some(9.0)),
    ] {
        let mut image = ProcessImage::new(plant.table.tags.len(), 1, 1, 0);
        let speed = plant.table.tags.iter().position(|tag| tag.name == "speed").unwrap();
        image.tags[speed] = Sample { value: Value::Float(34.1), quality, ..Sample::NEVER };
        plant.shared.reader = process_image(image).1;
        let (answer, action) = plant.ask(2, pdu, Outcome::Done).await;
        let (expected, writes) = match expected {
            Some(value) => (Ok(hex(pdu)), vec![("speed".to_owned(), Value::Float(value))]),
            None => (Err(ExceptionCode::GatewayPathUnavailable), vec![]),
        };
        assert_eq!(answer, expected, "{quality:?}");
        assert_eq!(action.map_or(vec![], |action| plant.writes(Some(action))), writes, "{quality:?}");
    }
    assert_eq!(plant.refused(), 3);
}

#[tokio::test]
async fn what_cannot_be_written_whole_is_refused_before_anything_is_asked_and_each_is_counted() {
    let mut plant = plant(Role::Operator);
    let refused = [
        (2, "06 0065 449A", ExceptionCode::IllegalDataValue),
        (2, "10 0064 0002 04 00FA 449A", ExceptionCode::IllegalDataValue),
        (2, "06 0067 0001", ExceptionCode::IllegalDataAddress),
        (2, "10 0064 0004 08 00FA 449A 5000 0001", ExceptionCode::IllegalDataAddress),
        (2, "06 0001 0001", ExceptionCode::IllegalDataAddress),
        (2, "06 FFFF 0001", ExceptionCode::IllegalDataAddress),
        (2, "05 0001 FF00", ExceptionCode::IllegalDataAddress),
        (2, "05 0080 FF00", ExceptionCode::IllegalDataAddress),
        (2, "0F 0000 0002 01 03", ExceptionCode::IllegalDataAddress),
        (2, "17 FFFF 0001 0064 0001 02 00FA", ExceptionCode::IllegalDataAddress),
        (2, "10 0064 0002 02 00FA", ExceptionCode::IllegalDataValue),
        (9, "06 0064 0001", ExceptionCode::GatewayTargetDevice),
    ];
    for (unit, pdu, code) in refused {
        let (answer, action) = plant.ask(unit, pdu, Outcome::Done).await;
        assert_eq!((answer, action), (Err(code), None), "{pdu}");
    }
    assert_eq!(plant.refused(), 12);
}

#[tokio::test]
async fn what_is_told_of_a_refused_write_names_where_it_would_have_been_written() {
    for (unit, pdu, told) in [
        (9, "06 0064 0001", "function 6 at unit 9, address 100: "),
        (2, "16 0065 0000 0001", "function 22 at unit 2, address 101: "),
        (2, "17 0001 0001 0067 0001 02 00FA", "function 23 at unit 2, address 103, to read from 1: "),
        (2, "17 FFFF 0001 0064 0001 02 00FA", "function 23 at unit 2, address 100, to read from 65535: "),
        (2, "17 0001", "function 23 at unit 2: "),
    ] {
        let mut plant = plant(Role::Operator);
        assert!(plant.ask(unit, pdu, Outcome::Done).await.0.is_err(), "{pdu}");
        let mut requests = Requests::new(&plant.desk, mpsc::channel(1).1);
        let Some(desk::Request::Refused(refused)) = requests.next().await else { panic!("{pdu}") };
        assert!(refused[0].text.starts_with(told), "{}", refused[0].text);
    }
}

#[tokio::test]
async fn outcomes_have_the_exceptions_of_the_table() {
    let mut plant = plant(Role::Operator);
    for (outcome, code) in [
        (Outcome::Unknown, ExceptionCode::IllegalDataAddress),
        (Outcome::Rejected(String::new()), ExceptionCode::IllegalDataValue),
        (Outcome::Busy, ExceptionCode::ServerDeviceBusy),
        (Outcome::NodeUnavailable, ExceptionCode::GatewayPathUnavailable),
        (Outcome::Timeout, ExceptionCode::GatewayTargetDevice),
        (Outcome::Aborted(crate::gateway::command::AbortCode(1)), ExceptionCode::ServerDeviceFailure),
    ] {
        assert_eq!(plant.ask(2, "06 0064 00FA", outcome).await.0, Err(code));
    }
}

#[tokio::test]
async fn must_hold_writes_of_nobody_and_of_a_viewer_reach_no_gateway_and_are_all_counted() {
    let mut viewer = plant(Role::Viewer);
    for _ in 0..1000 {
        assert!(viewer.take("10.0.0.6", 2, "06 0064 00FA").is_none(), "answered as ever");
    }
    assert!(viewer.take("10.0.0.6", 247, "03 0258 000A").is_none());
    assert_eq!(viewer.refused(), 1000);
    for (unit, pdu) in [(2, "06 0064 00FA"), (2, "05 2328 FF00"), (247, "05 2328 FF00")] {
        let (answer, action) = viewer.ask(unit, pdu, Outcome::Done).await;
        assert!(answer.is_err() && action.is_none(), "{pdu}");
    }
    assert_eq!(viewer.refused(), 1003);
}

#[test]
fn mbs_r_25_a_client_with_a_certificate_is_who_its_role_says_wherever_it_comes_from() {
    let plant = plant(Role::Operator);
    let caller = |role: Option<&str>| Caller {
        role: Some(PeerRole(role.map(str::to_owned))),
        rights: crate::modbus::security::Rights::WITHOUT_TLS,
    };
    let write = "06 0064 00FA";
    assert!(plant.take_as("10.9.9.9", &caller(Some("panel")), 2, write).is_some());
    for role in [None, Some("other")] {
        assert!(plant.take_as("10.0.0.5", &caller(role), 2, write).is_none(), "{role:?}");
    }
    assert_eq!(plant.refused(), 2);
}

#[tokio::test]
async fn a_coil_acknowledges_all_alarms_of_its_unit() {
    let mut plant = plant(Role::Operator);
    let (answer, action) = plant.ask(2, "05 2328 FF00", Outcome::Done).await;
    assert_eq!(answer, Ok(hex("05 2328 FF00")));
    assert_eq!(action, Some(Action::AcknowledgeAll { node: Some(NodeIndex(0)) }));
    let (_, action) = plant.ask(247, "05 2328 FF00", Outcome::Done).await;
    assert_eq!(action, Some(Action::AcknowledgeAll { node: None }));
    assert_eq!(plant.ask(247, "05 2328 0000", Outcome::Done).await.0, Err(ExceptionCode::IllegalDataValue));
}

#[tokio::test]
async fn b_4_the_command_block_takes_arguments_a_check_and_a_command_and_shows_the_result() {
    let mut plant = plant(Role::Engineer);
    // Stop the node of unit 2: check 65535 - 2.
    let (answer, action) = plant.ask(247, "10 0258 0004 08 0002 0002 FFFD 0003", Outcome::Done).await;
    assert_eq!(answer, Ok(hex("10 0258 0004")));
    assert_eq!(action, Some(Action::Nmt { node: NodeIndex(0), request: NmtRequest::Stop }));
    let shown = "03 14 0002 0002 FFFD 0003 0001 0001 0000 0000 0000 0000";
    assert_eq!(plant.ask(247, "03 0258 000A", Outcome::Done).await.0, Ok(hex(shown)));
    for (pdu, result) in [
        ("10 0258 0004 08 0002 0002 FFFC 0003", 10),
        ("10 0258 0004 08 0009 0002 FFFD 0003", 2),
        ("10 0258 0004 08 0002 0063 FF9C 0003", 2),
        ("10 0258 0004 08 0002 0063 0000 0001", 2),
        ("10 0258 0004 08 0002 0000 0007 0001", 10),
        ("06 025B 0063", 2),
    ] {
        let (answer, action) = plant.ask(247, pdu, Outcome::Done).await;
        assert!(answer.is_ok() && action.is_none(), "{pdu}");
        let shown = plant.ask(247, "03 025C 0001", Outcome::Done).await.0.unwrap();
        assert_eq!(shown, [3, 2, 0, result], "{pdu}");
    }
    assert_eq!(plant.refused(), 6, "the audit has them too");
    assert!(plant.ask(247, "06 025C 0001", Outcome::Done).await.0.is_err(), "the result is not written");
}

/// Stop the node of unit 2.
const STOP: &str = "10 0258 0004 08 0002 0002 FFFD 0003";

#[tokio::test]
async fn b_4_a_command_whose_connection_ends_leaves_a_result_and_not_a_block_that_is_under_way_for_ever() {
    let mut plant = plant(Role::Engineer);
    let asking = plant.take("10.0.0.5", 247, STOP).unwrap();
    let writers = plant.shared.writers.clone().unwrap();
    tokio::select! {
        biased;
        answer = writers.answer(&plant.shared, &asking) => panic!("{answer:?}"),
        _command = plant.queue.recv() => {}
    }
    let shown = plant.ask(247, "03 025C 0002", Outcome::Done).await.0;
    assert_eq!(shown, Ok(hex("03 04 0008 0001")), "failed, and counted");
    assert_eq!(plant.ask(247, STOP, Outcome::Done).await.0, Ok(hex("10 0258 0004")));
    let shown = plant.ask(247, "03 025C 0002", Outcome::Done).await.0;
    assert_eq!(shown, Ok(hex("03 04 0001 0002")));
}

#[tokio::test]
async fn b_4_a_block_whose_command_is_under_way_is_busy_for_every_other_client_of_its_table() {
    let mut plant = plant(Role::Engineer);
    let asking = plant.take("10.0.0.5", 247, STOP).unwrap();
    let writers = plant.shared.writers.clone().unwrap();
    let shared = plant.shared.clone();
    let first = tokio::spawn(async move { writers.answer(&shared, &asking).await });
    let (command, reply) = plant.queue.recv().await.unwrap();
    assert_eq!(command.action, Action::Nmt { node: NodeIndex(0), request: NmtRequest::Stop });
    for pdu in [STOP, "06 0258 0009", "17 025C 0001 0258 0001 02 0009"] {
        let (answer, action) = plant.ask(247, pdu, Outcome::Done).await;
        assert_eq!((answer, action), (Err(ExceptionCode::ServerDeviceBusy), None), "{pdu}");
    }
    let shown = plant.ask(247, "03 0258 0006", Outcome::Done).await.0;
    assert_eq!(shown, Ok(hex("03 0C 0002 0002 FFFD 0003 FFFF 0000")), "nothing of it was written");
    reply.send(Outcome::Done).unwrap();
    assert_eq!(first.await.unwrap(), Ok(hex("10 0258 0004")));
    assert_eq!(plant.ask(247, STOP, Outcome::Done).await.0, Ok(hex("10 0258 0004")));
    assert_eq!(plant.refused(), 0, "what is busy is not told of");
}

#[test]
fn the_map_names_what_can_be_written() {
    let plant = plant(Role::Operator);
    let points = plant.shared.bank.map().points();
    let written: Vec<(&str, &str, &str)> = points
        .iter()
        .filter(|point| point.writable)
        .map(|point| (point.tag.as_str(), point.table.word(), point.reference.as_str()))
        .collect();
    assert_eq!(
        written,
        [
            ("speed", "holding_register", "400101"),
            ("flow", "holding_register", "400102"),
            ("run", "coil", "000001"),
            ("command.argument", "holding_register", "400601"),
            ("command.argument_2", "holding_register", "400602"),
            ("command.check", "holding_register", "400603"),
            ("command.command", "holding_register", "400604"),
            ("alarm.acknowledge_all", "coil", "009001"),
            ("alarm.acknowledge_all", "coil", "009001"),
        ]
    );
}
