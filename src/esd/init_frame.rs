//! Commands on the INIT-Id as bytes (R-ESD-044..050, 057). Their answers: [`answer`](super::answer).
//!
//! A command has 6 bytes: command, sub-command, 0 but for two exceptions, module number, and two bytes of parameter, numbers
//! with the high byte first (R-ESD-045..047). Modules do not react to anything else, and so neither does
//! [`InitCommand::parse`].

use super::identifiers::{INIT_ID, ModuleNumber};
use crate::can::CanFrame;

/// Identifiers of the esd protocol have 11 bits.
const HIGHEST_ID: u16 = 0x7FF;
/// There are 128 user parameters (R-ESD-066).
const HIGHEST_PARAMETER: u8 = 0x7F;

/// A command on the INIT-Id.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum InitCommand {
    /// A question; the module answers once, on the identifier that is given with it.
    Request {
        /// To whom.
        module: ModuleNumber,
        /// What is asked.
        request: Request,
        /// `CTxId`, 0..=0x7FF.
        reply_id: u16,
    },
    /// Something is set. It is never acknowledged, whatever comes of it (R-ESD-054).
    Set {
        /// In whom.
        module: ModuleNumber,
        /// What.
        setting: Setting,
    },
    /// An order of the supervisor.
    Supervisor {
        /// To whom; `None`: to all modules of the bus (R-ESD-072).
        module: Option<ModuleNumber>,
        /// What.
        order: Order,
    },
    /// All modules of this range that have news answer with an empty frame (R-ESD-069).
    Service {
        /// The lowest number.
        low: u8,
        /// The highest.
        high: u8,
        /// `CTxId`, 0..=0x7FF.
        reply_id: u16,
    },
}

/// What a module can be asked.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Request {
    /// Its type.
    ModuleType,
    /// The value of its coding switches.
    Switch,
    /// Type and number as text.
    AsciiId,
    /// Its firmware.
    SoftwareRevision,
    /// Its serial number.
    SerialNumber,
    /// The number in its memory; 0 where it works with default parameters (K-ESD-14).
    SavedNumber,
    /// The number that it listens to.
    ActiveNumber,
    /// Its CAN status byte.
    Status,
    /// The bit rate in its memory.
    BitRate,
    /// `WTxId`.
    WatchdogId,
    /// `WDtime`.
    WatchdogTime,
    /// `TxId` of a channel; 0 for the first.
    TxId(u8),
    /// `RxId` of a channel; 0 for the first.
    RxId(u8),
    /// Tx activate time of a channel; 0 for the first.
    TxActivateTime(u8),
    /// A user parameter, 0..=0x7F.
    Parameter(u8),
}

impl Request {
    /// Command and sub-command.
    #[must_use]
    pub fn head(self) -> [u8; 2] {
        match self {
            Self::ModuleType => [0x00, 0x00],
            Self::Switch => [0x00, 0x01],
            Self::AsciiId => [0x00, 0x02],
            Self::SoftwareRevision => [0x00, 0x03],
            Self::SerialNumber => [0x00, 0x05],
            Self::SavedNumber => [0x01, 0x00],
            Self::ActiveNumber => [0x01, 0x01],
            Self::Status => [0x01, 0x02],
            Self::BitRate => [0x01, 0x03],
            Self::WatchdogId => [0x01, 0x04],
            Self::WatchdogTime => [0x01, 0x05],
            Self::TxId(channel) => [0x02, channel],
            Self::RxId(channel) => [0x03, channel],
            Self::TxActivateTime(channel) => [0x04, channel],
            Self::Parameter(number) => [0x06, number],
        }
    }

    fn from_head(head: [u8; 2]) -> Option<Self> {
        Some(match head {
            [0x00, 0x00] => Self::ModuleType,
            [0x00, 0x01] => Self::Switch,
            [0x00, 0x02] => Self::AsciiId,
            [0x00, 0x03] => Self::SoftwareRevision,
            [0x00, 0x05] => Self::SerialNumber,
            [0x01, 0x00] => Self::SavedNumber,
            [0x01, 0x01] => Self::ActiveNumber,
            [0x01, 0x02] => Self::Status,
            [0x01, 0x03] => Self::BitRate,
            [0x01, 0x04] => Self::WatchdogId,
            [0x01, 0x05] => Self::WatchdogTime,
            [0x02, channel] => Self::TxId(channel),
            [0x03, channel] => Self::RxId(channel),
            [0x04, channel] => Self::TxActivateTime(channel),
            [0x06, number @ 0..=HIGHEST_PARAMETER] => Self::Parameter(number),
            _ => return None,
        })
    }
}

/// What can be set in a module.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Setting {
    /// All parameters go into its memory. That the number of the module is to be repeated comes from public copies of the
    /// manual (R-ESD-067).
    Store,
    /// The number that it listens to from now on (R-ESD-068).
    Number(ModuleNumber),
    /// Bits 2 and 7 of the status byte become 0 (R-ESD-075).
    ClearStatus,
    /// The bit rate after it was stored and the module reset, as the registers BTR0 and BTR1 (R-ESD-079).
    BitRate([u8; 2]),
    /// `WTxId`, 0..=0x7FF.
    WatchdogId(u16),
    /// `WDtime`.
    WatchdogTime {
        /// ms; 0 switches the watchdog off.
        millis: u16,
        /// Life time factor. Its place is known from public copies of the manual only (R-ESD-089).
        factor: u8,
    },
    /// `TxId` of a channel, 0 for the first; 0..=0x7FF, at work at once (R-ESD-063).
    TxId(u8, u16),
    /// `RxId` of a channel, 0 for the first; 0..=0x7FF, at work at once.
    RxId(u8, u16),
    /// Tx activate time of a channel, 0 for the first, in ms.
    TxActivateTime(u8, u16),
    /// A user parameter, 0..=0x7F, and its value.
    Parameter(u8, u16),
}

impl Setting {
    /// The 6 bytes for a module.
    fn bytes(self, module: ModuleNumber) -> [u8; 6] {
        let number = module.get();
        let (head, third, value) = match self {
            Self::Store => ([0x81, 0x00], 0, [number, 0]),
            Self::Number(new) => ([0x81, 0x01], 0, [new.get(), 0]),
            Self::ClearStatus => ([0x81, 0x02], 0, [0, 0]),
            Self::BitRate(registers) => ([0x81, 0x03], 0, registers),
            Self::WatchdogId(id) => ([0x81, 0x04], 0, id.to_be_bytes()),
            Self::WatchdogTime { millis, factor } => ([0x81, 0x05], factor, millis.to_be_bytes()),
            Self::TxId(channel, id) => ([0x82, channel], 0, id.to_be_bytes()),
            Self::RxId(channel, id) => ([0x83, channel], 0, id.to_be_bytes()),
            Self::TxActivateTime(channel, millis) => ([0x84, channel], 0, millis.to_be_bytes()),
            Self::Parameter(parameter, value) => ([0x86, parameter], 0, value.to_be_bytes()),
        };
        [head[0], head[1], third, number, value[0], value[1]]
    }

    fn parse(head: [u8; 2], third: u8, module: ModuleNumber, value: [u8; 2]) -> Option<Self> {
        let number = u16::from_be_bytes(value);
        let id = (number <= HIGHEST_ID).then_some(number);
        Some(match (head, third) {
            ([0x81, 0x00], 0) if value == [module.get(), 0] => Self::Store,
            ([0x81, 0x01], 0) if value[1] == 0 => Self::Number(ModuleNumber::new(value[0])?),
            ([0x81, 0x02], 0) if value == [0, 0] => Self::ClearStatus,
            ([0x81, 0x03], 0) => Self::BitRate(value),
            ([0x81, 0x04], 0) => Self::WatchdogId(id?),
            ([0x81, 0x05], factor) => Self::WatchdogTime { millis: number, factor },
            ([0x82, channel], 0) => Self::TxId(channel, id?),
            ([0x83, channel], 0) => Self::RxId(channel, id?),
            ([0x84, channel], 0) => Self::TxActivateTime(channel, number),
            ([0x86, parameter @ 0..=HIGHEST_PARAMETER], 0) => Self::Parameter(parameter, number),
            _ => return None,
        })
    }
}

/// An order of the supervisor. All but two are carried out only with exactly their parameters (R-ESD-071).
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Order {
    /// Start anew.
    Reset,
    /// In place of a remote frame on `WTxId`. Its parameters are not known; 0 is sent.
    Watchdog,
    /// Start anew with default parameters.
    DefaultReset,
    /// Hold all channels (R-ESD-041).
    Suspend,
    /// Let them go on.
    Continue,
    /// Bit 2 of the status byte becomes 0. Its parameters are not known; 0 is sent.
    ClearCanError,
}

impl Order {
    const ALL: [Self; 6] =
        [Self::Reset, Self::Watchdog, Self::DefaultReset, Self::Suspend, Self::Continue, Self::ClearCanError];

    /// Sub-command and parameters.
    fn code(self) -> (u8, [u8; 2]) {
        match self {
            Self::Reset => (0x00, [0xAA, 0xAA]),
            Self::Watchdog => (0x02, [0, 0]),
            Self::DefaultReset => (0x03, [0xAA, 0xAA]),
            Self::Suspend => (0x04, [0x5A, 0x5A]),
            Self::Continue => (0x04, [0xA5, 0xA5]),
            Self::ClearCanError => (0x05, [0, 0]),
        }
    }
}

impl InitCommand {
    /// The frame. Identifiers above 0x7FF lose their upper bits.
    #[must_use]
    pub fn frame(self) -> CanFrame {
        let id = |id: u16| (id & HIGHEST_ID).to_be_bytes();
        let bytes = match self {
            Self::Request { module, request, reply_id } => {
                let [command, sub] = request.head();
                let [high, low] = id(reply_id);
                [command, sub, 0, module.get(), high, low]
            }
            Self::Set { module, setting } => setting.bytes(module),
            Self::Supervisor { module, order } => {
                let (sub, [first, second]) = order.code();
                [0xFF, sub, 0, module.map_or(0, ModuleNumber::get), first, second]
            }
            Self::Service { low, high, reply_id } => {
                let [first, second] = id(reply_id);
                [0x7F, low, high, 0, first, second]
            }
        };
        CanFrame::data_frame(INIT_ID, &bytes).unwrap_or_else(|| unreachable!("six bytes fit"))
    }

    /// What a frame says; `None` where it is no command, is not 6 bytes long, or says what nobody understands.
    #[must_use]
    pub fn parse(frame: &CanFrame) -> Option<Self> {
        let [command, sub, third, number, high, low] = *frame.data() else { return None };
        if frame.id() != INIT_ID {
            return None;
        }
        let value = [high, low];
        let id = Some(u16::from_be_bytes(value)).filter(|id| *id <= HIGHEST_ID);
        match (command, third, number) {
            (0x7F, above, 0) => Some(Self::Service { low: sub, high: above, reply_id: id? }),
            (0xFF, 0, _) => {
                let module = if number == 0 { None } else { Some(ModuleNumber::new(number)?) };
                let order = Order::ALL.into_iter().find(|order| order.code() == (sub, value))?;
                Some(Self::Supervisor { module, order })
            }
            (0x80.., ..) => {
                let module = ModuleNumber::new(number)?;
                let setting = Setting::parse([command, sub], third, module, value)?;
                Some(Self::Set { module, setting })
            }
            (_, 0, _) => {
                let module = ModuleNumber::new(number)?;
                Some(Self::Request { module, request: Request::from_head([command, sub])?, reply_id: id? })
            }
            _ => None,
        }
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn module() -> ModuleNumber {
        ModuleNumber::new(0x12).unwrap()
    }

    fn request(request: Request) -> String {
        InitCommand::Request { module: module(), request, reply_id: 0x567 }.frame().to_string()
    }

    fn set(setting: Setting) -> String {
        InitCommand::Set { module: module(), setting }.frame().to_string()
    }

    fn order(module: Option<ModuleNumber>, order: Order) -> String {
        InitCommand::Supervisor { module, order }.frame().to_string()
    }

    #[test]
    fn r_esd_044_045_046_047_050_v_esd_06_requests_and_settings_byte_for_byte() {
        assert_eq!(request(Request::TxId(0)), "700#020000120567");
        assert_eq!(set(Setting::TxId(0, 0x1AA)), "700#8200001201AA");
        assert_eq!(set(Setting::RxId(0, 0x155)), "700#830000120155");
        assert_eq!(request(Request::RxId(0)), "700#030000120567");
        assert_eq!(request(Request::SoftwareRevision), "700#000300120567");
        assert_eq!(request(Request::SerialNumber), "700#000500120567");
        assert_eq!(request(Request::Switch), "700#000100120567");
        assert_eq!(request(Request::ActiveNumber), "700#010100120567");
        assert_eq!(request(Request::SavedNumber), "700#010000120567");
        let service = InitCommand::Service { low: 0x01, high: 0x12, reply_id: 0x567 };
        assert_eq!(service.frame().to_string(), "700#7F0112000567");
        assert_eq!(set(Setting::ClearStatus), "700#810200120000", "V-ESD-07");
    }

    #[test]
    fn r_esd_057_the_rest_of_the_commands_byte_for_byte() {
        assert_eq!(request(Request::ModuleType), "700#000000120567");
        assert_eq!(request(Request::AsciiId), "700#000200120567");
        assert_eq!(request(Request::Status), "700#010200120567");
        assert_eq!(request(Request::BitRate), "700#010300120567");
        assert_eq!(request(Request::WatchdogId), "700#010400120567");
        assert_eq!(request(Request::WatchdogTime), "700#010500120567");
        assert_eq!(request(Request::TxActivateTime(4)), "700#040400120567");
        assert_eq!(set(Setting::TxActivateTime(4, 1000)), "700#8404001203E8");
        assert_eq!(set(Setting::Number(ModuleNumber::new(0x44).unwrap())), "700#810100124400");
    }

    #[test]
    fn r_esd_067_from_public_copies_store_repeats_the_module_number() {
        assert_eq!(set(Setting::Store), "700#810000121200");
    }

    #[test]
    fn r_esd_066_v_esd_09_user_parameters_byte_for_byte() {
        assert_eq!(set(Setting::Parameter(2, 0x1173)), "700#860200121173");
        assert_eq!(set(Setting::Parameter(1, 0x1411)), "700#860100121411");
        assert_eq!(set(Setting::Parameter(1, 0x148B)), "700#86010012148B");
        assert_eq!(set(Setting::Parameter(0, 0)), "700#860000120000");
        assert_eq!(request(Request::Parameter(0x22)), "700#062200120567");
    }

    #[test]
    fn r_esd_071_072_108_109_v_esd_08_orders_of_the_supervisor_byte_for_byte() {
        assert_eq!(order(None, Order::Reset), "700#FF000000AAAA");
        assert_eq!(order(Some(module()), Order::DefaultReset), "700#FF030012AAAA");
        assert_eq!(order(Some(module()), Order::Reset), "700#FF000012AAAA");
        assert_eq!(order(Some(module()), Order::Suspend), "700#FF0400125A5A");
        assert_eq!(order(Some(module()), Order::Continue), "700#FF040012A5A5");
        assert_eq!(order(None, Order::Suspend), "700#FF0400005A5A");
        assert_eq!(order(Some(module()), Order::Watchdog), "700#FF0200120000", "V-ESD-11");
        assert_eq!(order(Some(module()), Order::ClearCanError), "700#FF0500120000");
        for wrong in ["700#FF000012AAAB", "700#FF000012AA", "700#FF0012AAAA", "700#FF000012AAAA00"] {
            assert_eq!(InitCommand::parse(&wrong.parse().unwrap()), None, "{wrong}");
        }
    }

    #[test]
    fn r_esd_089_from_public_copies_v_esd_11_watchdog_byte_for_byte() {
        assert_eq!(set(Setting::WatchdogId(0x512)), "700#810400120512");
        assert_eq!(set(Setting::WatchdogTime { millis: 1000, factor: 3 }), "700#8105031203E8");
        assert_eq!(set(Setting::WatchdogTime { millis: 0, factor: 0 }), "700#810500120000");
    }

    #[test]
    fn r_esd_079_v_esd_10_bit_rate_as_registers() {
        assert_eq!(set(Setting::BitRate([0x03, 0x1C])), "700#81030012031C");
    }

    #[test]
    fn r_esd_045_049_063_what_modules_do_not_understand_is_no_command() {
        for wrong in [
            "701#020000120567",
            "700#R6",
            "00000700#020000120567",
            "700#0200001205",
            "700#02000012056700",
            "700#020000000567",
            "700#020000FF0567",
            "700#020100120800",
            "700#020001120567",
            "700#000400120567",
            "700#090000120567",
            "700#068000120567",
            "700#8200001208AA",
            "700#850000120000",
            "700#810000121300",
        ] {
            assert_eq!(InitCommand::parse(&wrong.parse().unwrap()), None, "{wrong}");
        }
    }

    proptest! {
        #[test]
        fn r_esd_048_what_is_understood_is_written_back_and_bit_7_is_set_for_all_but_questions(
            command in prop::sample::select(vec![0_u8, 1, 2, 3, 4, 6, 0x7F, 0x81, 0x82, 0x83, 0x84, 0x86, 0xFF]),
            sub in 0_u8..8,
            third in prop_oneof![3 => Just(0_u8), 1 => any::<u8>()],
            number: u8,
            value in prop_oneof![Just(0_u16), Just(0xAAAA), Just(0x5A5A), Just(0x567), any::<u16>()],
        ) {
            let [high, low] = value.to_be_bytes();
            let frame = CanFrame::data_frame(INIT_ID, &[command, sub, third, number, high, low]).unwrap();
            if let Some(parsed) = InitCommand::parse(&frame) {
                prop_assert_eq!(parsed.frame(), frame);
                let asks = matches!(parsed, InitCommand::Request { .. } | InitCommand::Service { .. });
                prop_assert_eq!(asks, command & 0x80 == 0);
            }
        }
    }
}
