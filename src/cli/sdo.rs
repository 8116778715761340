//! `cangate sdo read|write`: one object of one node. \[IO\]

use std::time::Duration;

use tokio_util::sync::CancellationToken;

use super::Exit;
use super::output::{block_on, print_error, print_line};
use super::sdo_tag::{self, TagObject};
use super::session::{Machine, Session, SessionError, Step, check_company};
use super::tool_args::{ObjectOrTag, SdoArguments, SdoCommand};
use crate::can::CanFrame;
use crate::can::interface::Interface;
use crate::canopen::object::{DataType, ObjectId};
use crate::canopen::sdo::{Refused, SdoClient, SdoError, SdoOutput, SdoRequest, SdoSettings, TransferId};
use crate::canopen::{NodeId, well_known};
use crate::time::{Clock, Instant, Now};

/// One transfer.
pub(super) struct Transfer {
    client: SdoClient,
}

impl Transfer {
    /// Begins it.
    ///
    /// # Errors
    /// The value is too long.
    pub(super) fn begin(
        now: Instant,
        node: NodeId,
        settings: SdoSettings,
        request: SdoRequest,
    ) -> Result<Self, Refused> {
        let mut client = SdoClient::new(node, settings);
        client.request(now, TransferId(0), request)?;
        Ok(Self { client })
    }
}

impl Machine for Transfer {
    type Output = Result<Vec<u8>, SdoError>;

    fn handle_frame(&mut self, now: Now, frame: &CanFrame) {
        self.client.handle_answer(now.instant, frame);
    }

    fn handle_not_sent(&mut self, _: Now, frame: &CanFrame) {
        self.client.handle_not_sent(frame);
    }

    fn handle_timeout(&mut self, now: Now) {
        self.client.handle_timeout(now.instant);
    }

    fn poll_output(&mut self) -> Option<Step<Self::Output>> {
        Some(match self.client.poll_output()? {
            SdoOutput::Transmit(frame) => Step::Transmit(frame),
            SdoOutput::Done(_, result) => Step::Done(result),
        })
    }

    fn poll_timeout(&self) -> Option<Instant> {
        self.client.poll_timeout().map(|(at, _)| at)
    }
}

/// Reads or writes, and prints what came of it.
pub(super) fn run(arguments: &SdoArguments) -> Exit {
    let job = match Job::new(arguments) {
        Ok(job) => job,
        Err(exit) => return exit,
    };
    let request = match job.request(&arguments.action) {
        Ok(request) => request,
        Err(text) => {
            print_error(&text);
            return Exit::Usage;
        }
    };
    let settings = settings(arguments);
    block_on(async {
        let done = match check_company(&arguments.interface) {
            Ok(()) => transfer(&arguments.interface, arguments.node, settings, request, Clock::start()).await,
            Err(error) => Err(error),
        };
        match done {
            Ok(Ok(bytes)) => {
                if let Some(text) = job.told(&arguments.action, &bytes) {
                    print_line(&text);
                }
                Exit::Ok
            }
            Ok(Err(error)) => {
                let node = arguments.node;
                print_error(&format!("{} of node {node}: {error}", job.object()));
                if error == SdoError::BusUnavailable { Exit::Io } else { Exit::Refused }
            }
            Err(error) => {
                print_error(&error.to_string());
                error.exit()
            }
        }
    })
}

fn settings(arguments: &SdoArguments) -> SdoSettings {
    SdoSettings {
        timeout: Duration::from_millis(arguments.timeout_ms.into()),
        store_timeout: Duration::from_millis(arguments.store_timeout_ms.into()),
        repeat: arguments.repeat,
        block: arguments.block,
        ..SdoSettings::default()
    }
}

/// What is to be transferred, as it was called.
enum Job {
    Object(ObjectId),
    Tag(TagObject),
}

impl Job {
    fn new(arguments: &SdoArguments) -> Result<Self, Exit> {
        let (SdoCommand::Read { object, .. } | SdoCommand::Write { object, .. }) = &arguments.action;
        match object {
            ObjectOrTag::Object(object) => Ok(Self::Object(*object)),
            ObjectOrTag::Tag(name) => sdo_tag::find(arguments, name).map(Self::Tag),
        }
    }

    fn object(&self) -> ObjectId {
        match self {
            Self::Object(object) => *object,
            Self::Tag(tag) => tag.object(),
        }
    }

    fn request(&self, action: &SdoCommand) -> Result<SdoRequest, String> {
        match self {
            Self::Object(object) => request(action, *object),
            Self::Tag(tag) => tag.request(action),
        }
    }

    fn told(&self, action: &SdoCommand, bytes: &[u8]) -> Option<String> {
        match self {
            Self::Object(object) => told(action, *object, bytes),
            Self::Tag(tag) => tag.told(action, bytes),
        }
    }
}

/// What is asked of the client.
fn request(action: &SdoCommand, object: ObjectId) -> Result<SdoRequest, String> {
    match action {
        SdoCommand::Read { data_type, .. } => {
            let size = data_type.or_else(|| well_known::data_type(object)).and_then(DataType::size);
            let request = SdoRequest::read(object);
            Ok(match size {
                Some(size) => request.of_len(size),
                None => request,
            })
        }
        SdoCommand::Write { value, data_type, .. } => {
            let data_type = data_type.or_else(|| well_known::data_type(object)).ok_or_else(|| {
                format!("the type of {object} is not known: say it, for example --type u16; the device's manual or EDS tells it")
            })?;
            let bytes = data_type.encode(value).map_err(|error| format!("{object}: {error}"))?;
            Ok(SdoRequest::write(object, bytes))
        }
    }
}

/// One transfer on a bus.
async fn transfer(
    interface: &Interface,
    node: NodeId,
    settings: SdoSettings,
    request: SdoRequest,
    clock: Clock,
) -> Result<Result<Vec<u8>, SdoError>, SessionError> {
    let mut session = Session::open(interface, false, clock, CancellationToken::new()).await?;
    // Nothing was asked yet, and the value was made from what was typed: only its length can be refused.
    let Ok(mut transfer) = Transfer::begin(clock.now().instant, node, settings, request) else {
        return Ok(Err(SdoError::TooLong { longest: settings.longest }));
    };
    let result = session.run(&mut transfer).await?;
    // A last frame, an abort for example, has still to leave; whether it does changes nothing for us.
    let _ = session.close().await;
    Ok(result)
}

/// What is printed after a success.
fn told(action: &SdoCommand, object: ObjectId, bytes: &[u8]) -> Option<String> {
    match action {
        SdoCommand::Read { raw: true, .. } => DataType::OctetString.decode(bytes).ok(),
        SdoCommand::Read { data_type, .. } => {
            let data_type = data_type.or_else(|| well_known::data_type(object));
            let name = well_known::name(object).map_or_else(String::new, |name| format!("  {name}"));
            Some(format!("{object} = {}{name}", readings(bytes, data_type)))
        }
        SdoCommand::Write { value, .. } => Some(format!("{object} is written: {value}")),
    }
}

/// A value as its type says; without one, or where it has another length, the bytes and what they could mean.
fn readings(bytes: &[u8], data_type: Option<DataType>) -> String {
    let hex = bytes.iter().map(|byte| format!("{byte:02X}")).collect::<Vec<_>>().join(" ");
    if let Some(data_type) = data_type {
        match data_type.decode(bytes) {
            Ok(text) if is_unsigned(data_type) => {
                let digits: Vec<String> = bytes.iter().rev().map(|byte| format!("{byte:02X}")).collect();
                return format!("{text}  0x{}  ({data_type})", digits.concat());
            }
            Ok(text) => return format!("{text}  ({data_type})"),
            Err(error) => return format!("{hex}  ({error}; {})", guesses(bytes)),
        }
    }
    if bytes.is_empty() { "(no bytes)".to_owned() } else { format!("{hex}  ({})", guesses(bytes)) }
}

fn is_unsigned(data_type: DataType) -> bool {
    use DataType::{U8, U16, U24, U32, U40, U48, U56, U64};
    [U8, U16, U24, U32, U40, U48, U56, U64].contains(&data_type)
}

/// What bytes of an unknown type could mean.
fn guesses(bytes: &[u8]) -> String {
    use DataType::{F32, F64, I8, I16, I24, I32, I64, U8, U16, U24, U32, U64};
    let types = [U8, I8, U16, I16, U24, I24, U32, I32, F32, U64, I64, F64];
    let numbers = types.into_iter().filter_map(|each| Some(format!("{each} {}", each.decode(bytes).ok()?)));
    let printable = !bytes.is_empty() && bytes.iter().all(|byte| matches!(byte, 0x20..=0x7E | 0));
    let text = DataType::VisibleString.decode(bytes).ok().filter(|text| printable && !text.is_empty());
    let all: Vec<String> = numbers.chain(text.map(|text| format!("text \"{text}\""))).collect();
    if all.is_empty() { format!("{} bytes", bytes.len()) } else { all.join(", ") }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::can::virtual_bus;
    use crate::can::{BusEvent, BusReader, BusWriter};
    use crate::canopen::sdo::AbortCode;

    fn object(action: &SdoCommand) -> ObjectId {
        let (SdoCommand::Read { object, .. } | SdoCommand::Write { object, .. }) = action;
        let ObjectOrTag::Object(object) = object else { panic!("{object:?}") };
        *object
    }

    fn request(action: &SdoCommand) -> Result<SdoRequest, String> {
        super::request(action, object(action))
    }

    fn told(action: &SdoCommand, bytes: &[u8]) -> Option<String> {
        super::told(action, object(action), bytes)
    }

    fn read(object: &str, data_type: Option<DataType>) -> SdoCommand {
        SdoCommand::Read { object: object.parse().unwrap(), data_type, raw: false }
    }

    fn write(object: &str, value: &str, data_type: Option<DataType>) -> SdoCommand {
        SdoCommand::Write { object: object.parse().unwrap(), value: value.to_owned(), data_type }
    }

    /// A device that answers requests as told, once each, in this order; then it is silent.
    async fn ask(
        bus: &'static str,
        answers: &'static [(&'static str, &'static str)],
        action: &SdoCommand,
    ) -> Result<Vec<u8>, SdoError> {
        let clock = Clock::start();
        let (mut heard, mut say) = virtual_bus::join(bus, clock);
        let device = tokio::spawn(async move {
            for (request, answer) in answers {
                loop {
                    if let BusEvent::Frame { frame, .. } = heard.recv().await.unwrap() {
                        assert_eq!(frame.to_string(), *request);
                        break;
                    }
                }
                say.send(&answer.parse().unwrap()).await.unwrap();
            }
            heard
        });
        let interface = format!("virtual:{bus}").parse().unwrap();
        let node = NodeId::new(1).unwrap();
        let result =
            transfer(&interface, node, SdoSettings::default(), request(action).unwrap(), clock).await;
        device.await.unwrap();
        result.unwrap()
    }

    #[tokio::test(start_paused = true)]
    async fn r_dst_066_an_object_is_read_and_shown_by_its_type() {
        let action = read("0x1000:0", None);
        let bytes =
            ask("sdo-read", &[("601#4000100000000000", "581#4300100094010200")], &action).await.unwrap();
        assert_eq!(told(&action, &bytes).unwrap(), "0x1000:0 = 131476  0x00020194  (u32)  device type");
    }

    #[tokio::test(start_paused = true)]
    async fn r_dst_067_a_write_of_a_known_object_needs_no_type() {
        let action = write("0x1017:0", "500", None);
        let done = ask("sdo-write", &[("601#2B171000F4010000", "581#6017100000000000")], &action).await;
        assert_eq!(done, Ok(vec![]));
        assert_eq!(told(&action, &[]).unwrap(), "0x1017:0 is written: 500");
    }

    /// What the documents say on a node id that is written by SDO; then comes `cangate nmt reset-node`.
    #[tokio::test(start_paused = true)]
    async fn v_dst_18_r_dst_011_117_118_120_121_node_id_and_bit_rate_are_written_and_saved() {
        for (bus, object, value, data_type, request, answer) in [
            ("sdo-node", "0x4F01:0", "5", Some(DataType::U8), "601#2F014F0005000000", "581#60014F0000000000"),
            ("sdo-rate", "0x4F00:0", "3", Some(DataType::U8), "601#2F004F0003000000", "581#60004F0000000000"),
            ("sdo-save", "0x1010:1", "0x65766173", None, "601#2310100173617665", "581#6010100100000000"),
        ] {
            let answers = Box::leak(Box::new([(request, answer)]));
            assert_eq!(ask(bus, answers, &write(object, value, data_type)).await, Ok(vec![]), "{object}");
        }
        let refused = write("0x4F01:0", "128", Some(DataType::U8));
        let answers = &[("601#2F014F0080000000", "581#80014F0030000906")];
        let error = ask("sdo-range", answers, &refused).await.unwrap_err().to_string();
        assert!(error.contains("0x06090030"), "{error}");
    }

    #[tokio::test(start_paused = true)]
    async fn r_dst_068_an_abort_is_told_by_code_and_name() {
        let action = read("0x2000:0", None);
        let error =
            ask("sdo-abort", &[("601#4000200000000000", "581#8000200000000206")], &action).await.unwrap_err();
        assert_eq!(error, SdoError::Abort(AbortCode(0x0602_0000)));
        assert!(error.to_string().contains("0x06020000, object does not exist"), "{error}");
    }

    #[tokio::test(start_paused = true)]
    async fn r_dst_073_a_node_that_does_not_answer_is_asked_three_times() {
        let error = ask("sdo-silence", &[], &read("0x1000:0", None)).await.unwrap_err();
        assert!(matches!(error, SdoError::Timeout { requests: 3, .. }), "{error:?}");
    }

    #[test]
    fn bytes_of_an_unknown_type_are_shown_with_what_they_could_mean() {
        assert_eq!(readings(&[0xFF, 0xFF], None), "FF FF  (u16 65535, i16 -1)");
        assert_eq!(
            readings(&[0, 0, 0x80, 0x3F], None),
            "00 00 80 3F  (u32 1065353216, i32 1065353216, f32 1)"
        );
        assert_eq!(readings(b"DST", None), "44 53 54  (u24 5526340, i24 5526340, text \"DST\")");
        assert_eq!(readings(&[], None), "(no bytes)");
        assert_eq!(readings(&[7; 9], None), "07 07 07 07 07 07 07 07 07  (9 bytes)");
        let wrong = readings(&[1, 0], Some(DataType::U8));
        assert!(wrong.starts_with("01 00  (") && wrong.contains("u16 1"), "{wrong}");
    }

    #[test]
    fn what_a_device_says_cannot_steer_the_terminal() {
        assert!(!readings(b"\x1B[2Jhello", None).contains('\x1B'));
        assert!(!readings(b"\x1B[2Jhello", Some(DataType::VisibleString)).contains('\x1B'));
    }

    #[test]
    fn a_write_without_a_known_type_or_with_a_wrong_value_is_refused_before_anything_is_sent() {
        let error = request(&write("0x6124:1", "1.5", None)).unwrap_err();
        assert!(error.contains("--type"), "{error}");
        let error = request(&write("0x1017:0", "65536", None)).unwrap_err();
        assert!(error.contains("0 to 65535"), "{error}");
        assert!(request(&write("0x6124:1", "-1.5", Some(DataType::F32))).is_ok());
    }

    #[test]
    fn raw_prints_the_bytes_alone() {
        let raw = SdoCommand::Read { object: "0x1000:0".parse().unwrap(), data_type: None, raw: true };
        assert_eq!(told(&raw, &[0x94, 0x01, 0x02, 0x00]).unwrap(), "94010200");
    }
}
