//! What a managed module is to be like: the list that it is compared with (R-ESD-054, 063, 064, 066, 081).

use super::answer::Answer;
use super::identifiers::ModuleNumber;
use super::init_frame::{Request, Setting};
use super::parameters::{FIRST_TX_DELAY, SerialBits, can_tx_mode_of, serial_mode_of};
use super::settings::{ChannelSettings, ManagementSettings};
use crate::can::CanId;

/// One step of making a module what it is to be.
#[derive(Clone, Debug, PartialEq)]
pub(super) enum Item {
    /// Something is compared, and written where it differs.
    Want(Want),
    /// Something is only read.
    Read(Request),
    /// What was written is stored.
    Store,
}

/// Something that a module is to have.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Want {
    /// What it is, in words.
    pub(super) what: String,
    /// How it is asked for.
    pub(super) request: Request,
    /// What is to be answered.
    pub(super) wanted: Answer,
    /// Which bits of a value are wanted; of anything else all are.
    pub(super) bits: SerialBits,
    /// How it is written.
    pub(super) setting: Setting,
    /// Writing it is allowed.
    pub(super) may_be_written: bool,
    /// It is kept in the memory of the module by "store"; the watchdog is not.
    pub(super) is_parameter: bool,
}

/// The list for a module. Identifiers of 29 bits, which it cannot have, are left out.
pub(super) fn plan(settings: &ManagementSettings, channels: &[ChannelSettings]) -> Vec<Item> {
    let mut items = Vec::new();
    let want = |items: &mut Vec<Item>, what: String, request: Request, wanted: Answer, setting: Setting| {
        let may_be_written = settings.configure;
        let bits = SerialBits::ALL;
        items.push(Item::Want(Want {
            what,
            request,
            wanted,
            bits,
            setting,
            may_be_written,
            is_parameter: true,
        }));
    };
    for channel in channels {
        let (number, place) = (channel.number, channel.number.saturating_sub(1));
        if let Some(id) = standard(channel.tx_id) {
            let what = format!("TxId of channel {number}");
            want(&mut items, what, Request::TxId(place), Answer::Id(id), Setting::TxId(place, id));
        }
        if let Some(id) = standard(channel.rx_id) {
            let what = format!("RxId of channel {number}");
            let wanted = Answer::Ids { first: id, last: id };
            want(&mut items, what, Request::RxId(place), wanted, Setting::RxId(place, id));
        }
        let parameter = |items: &mut Vec<Item>, what: &str, parameter: u8, value: u16| {
            let what = format!("{what} of channel {number} (user parameter 0x{parameter:02X})");
            let setting = Setting::Parameter(parameter, value);
            want(items, what, Request::Parameter(parameter), Answer::Value(value), setting);
        };
        if let Some(mode) = channel.can_tx_mode {
            let value = if settings.min_char_high { mode.value_with_min_char_high() } else { mode.value() };
            parameter(&mut items, "CAN Tx mode", can_tx_mode_of(number), value);
        }
        if let Some(mode) = channel.serial_mode {
            let turned = if channel.stop_bit_set == 1 { SerialBits::STOP_BITS.0 } else { 0 };
            parameter(&mut items, "Serial mode", serial_mode_of(number), mode.value() ^ turned);
            if let Some(Item::Want(want)) = items.last_mut() {
                want.bits = channel.serial_bits;
            }
        } else {
            // What is sent to the line keeps the pace that the module really has.
            items.push(Item::Read(Request::Parameter(serial_mode_of(number))));
        }
    }
    let delay = Request::Parameter(FIRST_TX_DELAY);
    if let Some(wanted) = settings.first_tx_delay {
        let millis = u16::try_from(wanted.as_millis()).unwrap_or(u16::MAX);
        let what = "First Tx activate delay (user parameter 0x00)".to_owned();
        want(&mut items, what, delay, Answer::Value(millis), Setting::Parameter(FIRST_TX_DELAY, millis));
    } else {
        items.push(Item::Read(delay));
    }
    items.push(Item::Store);
    items.extend(watchdog(settings));
    items
}

/// What may be set in a managed module beside its status: what is wanted and may be written, and to store it where that is
/// asked for. A watchdog that was set going is switched off when the gateway stops. With each the bits of its value that are
/// wanted: the others are as they were found.
#[must_use]
pub fn allowed_settings(
    settings: &ManagementSettings,
    channels: &[ChannelSettings],
) -> Vec<(Setting, SerialBits)> {
    let whole = |setting| (setting, SerialBits::ALL);
    let mut allowed = vec![whole(Setting::ClearStatus)];
    for item in plan(settings, channels) {
        match item {
            Item::Want(want) if want.may_be_written => allowed.push((want.setting, want.bits)),
            Item::Store if settings.store => allowed.push(whole(Setting::Store)),
            Item::Want(_) | Item::Store | Item::Read(_) => {}
        }
    }
    if settings.watchdog.is_some() {
        allowed.push(whole(Setting::WatchdogTime { millis: 0, factor: 0 }));
    }
    allowed
}

/// The watchdog comes after "store", so that it is not stored: it is not for whoever uses the module next.
fn watchdog(settings: &ManagementSettings) -> Vec<Item> {
    let Some(watchdog) = settings.watchdog else { return Vec::new() };
    let Some(id) = standard(watchdog.id) else { return Vec::new() };
    let millis = u16::try_from(watchdog.time.as_millis()).unwrap_or(u16::MAX);
    let factor = watchdog.factor.max(1);
    let item = |what: &str, request, wanted, setting| {
        let what = what.to_owned();
        let bits = SerialBits::ALL;
        Item::Want(Want { what, request, wanted, bits, setting, may_be_written: true, is_parameter: false })
    };
    vec![
        item("WTxId of the watchdog", Request::WatchdogId, Answer::Id(id), Setting::WatchdogId(id)),
        item(
            "WDtime of the watchdog",
            Request::WatchdogTime,
            Answer::WatchdogTime { millis, factor: Some(factor) },
            Setting::WatchdogTime { millis, factor },
        ),
    ]
}

/// The number of an identifier of 11 bits.
pub(super) fn standard(id: CanId) -> Option<u16> {
    match id {
        CanId::Standard(id) => Some(id),
        CanId::Extended(_) => None,
    }
}

impl Want {
    /// Whether what was found is as wanted.
    pub(super) fn is_met(&self, found: Answer) -> bool {
        self.in_place_of(found) == found
    }

    /// What is wanted of a module that has this.
    fn in_place_of(&self, found: Answer) -> Answer {
        match (self.wanted, found) {
            (Answer::Value(wanted), Answer::Value(found)) => Answer::Value(self.bits.merged(found, wanted)),
            (wanted, _) => wanted,
        }
    }

    /// How it is written into a module that has this: what nobody asks for stays.
    pub(super) fn setting_over(&self, found: Option<Answer>) -> Setting {
        match (self.setting, found.map(|found| self.in_place_of(found))) {
            (Setting::Parameter(number, _), Some(Answer::Value(value))) => Setting::Parameter(number, value),
            (setting, _) => setting,
        }
    }

    /// What is wrong, for people.
    pub(super) fn difference(&self, module: ModuleNumber, found: Answer) -> String {
        let (what, wanted) = (&self.what, self.in_place_of(found));
        let why = match (found, self.may_be_written) {
            (Answer::Unknown, _) => {
                return format!("{what} of module {module}: it does not know this command");
            }
            (_, true) => "though it was written",
            (_, false) => "and is not written, because `configure` is off",
        };
        format!("{what} of module {module} is {found}, wanted is {wanted}, {why}")
    }
}
