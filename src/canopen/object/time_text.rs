//! Time of day and time difference of CiA 301 as text. Both are 28 bits of milliseconds and 16 bits of days.

/// Day 0 of CANopen, 1984-01-01, counted from 1970-01-01.
const EPOCH: i64 = 5_113;
const DAY_MS: u64 = 86_400_000;
const MILLIS: u64 = 0x0FFF_FFFF;

/// `2026-01-31 12:00:00.000`. Milliseconds of more than a day count on into the following days.
pub(super) fn time_of_day(value: u64) -> String {
    let (days, millis) = parts(value);
    let (year, month, day) = civil(EPOCH + i64::try_from(days + millis / DAY_MS).unwrap_or_default());
    format!("{year:04}-{month:02}-{day:02} {}", clock(millis % DAY_MS))
}

/// `3 12:00:00.000`.
pub(super) fn time_difference(value: u64) -> String {
    let (days, millis) = parts(value);
    format!("{} {}", days + millis / DAY_MS, clock(millis % DAY_MS))
}

/// The reverse of [`time_of_day`]; also with `T` between date and time, and without the fraction.
pub(super) fn parse_time_of_day(text: &str) -> Option<[u8; 6]> {
    let (date, time) = text.split_once([' ', 'T'])?;
    let mut fields = date.split('-').map(number);
    let (year, month, day) = (fields.next()??, fields.next()??, fields.next()??);
    let days = days_from_civil(year, month, day)?;
    if fields.next().is_some() || civil(days) != (year, month, day) {
        return None;
    }
    bytes(u64::try_from(days - EPOCH).ok()?, parse_clock(time)?)
}

/// The reverse of [`time_difference`].
pub(super) fn parse_time_difference(text: &str) -> Option<[u8; 6]> {
    let (days, time) = text.split_once(' ')?;
    bytes(number(days)?.try_into().ok()?, parse_clock(time)?)
}

fn parts(value: u64) -> (u64, u64) {
    (value >> 32 & 0xFFFF, value & MILLIS)
}

fn bytes(days: u64, millis: u64) -> Option<[u8; 6]> {
    let [low, high] = u16::try_from(days).ok()?.to_le_bytes();
    let [a, b, c, d] = u32::try_from(millis).ok()?.to_le_bytes();
    Some([a, b, c, d, low, high])
}

fn clock(millis: u64) -> String {
    let seconds = millis / 1000;
    format!("{:02}:{:02}:{:02}.{:03}", seconds / 3600, seconds / 60 % 60, seconds % 60, millis % 1000)
}

fn parse_clock(text: &str) -> Option<u64> {
    let (time, fraction) = text.split_once('.').unwrap_or((text, "000"));
    let mut fields = time.split(':').map(number);
    let (hours, minutes, seconds) = (fields.next()??, fields.next()??, fields.next()??);
    let millis = number(fraction).filter(|_| fraction.len() == 3)?;
    if fields.next().is_some() || hours > 23 || minutes > 59 || seconds > 59 {
        return None;
    }
    u64::try_from(((hours * 60 + minutes) * 60 + seconds) * 1000 + millis).ok()
}

/// Up to five digits, without a sign.
fn number(text: &str) -> Option<i64> {
    let plain = (1..=5).contains(&text.len()) && text.bytes().all(|byte| byte.is_ascii_digit());
    text.parse().ok().filter(|_| plain)
}

/// Year, month and day from days since 1970-01-01, in the Gregorian calendar: eras of 400 years, whose years begin in
/// March so that the leap day is the last.
fn civil(days: i64) -> (i64, i64, i64) {
    let days = days + 719_468;
    let era = days.div_euclid(146_097);
    let day_of_era = days.rem_euclid(146_097);
    let year_of_era = (day_of_era - day_of_era / 1_460 + day_of_era / 36_524 - day_of_era / 146_096) / 365;
    let day_of_year = day_of_era - (365 * year_of_era + year_of_era / 4 - year_of_era / 100);
    let month = (5 * day_of_year + 2) / 153;
    let day = day_of_year - (153 * month + 2) / 5 + 1;
    let month = if month < 10 { month + 3 } else { month - 9 };
    (era * 400 + year_of_era + i64::from(month <= 2), month, day)
}

/// The reverse of [`civil`]; `None` when there is no such month.
fn days_from_civil(year: i64, month: i64, day: i64) -> Option<i64> {
    if !(1..=12).contains(&month) {
        return None;
    }
    let year = if month <= 2 { year - 1 } else { year };
    let era = year.div_euclid(400);
    let year_of_era = year.rem_euclid(400);
    let day_of_year = (153 * (month + if month > 2 { -3 } else { 9 }) + 2) / 5 + day - 1;
    let day_of_era = year_of_era * 365 + year_of_era / 4 - year_of_era / 100 + day_of_year;
    Some(era * 146_097 + day_of_era - 719_468)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn day_0_is_the_first_of_january_1984() {
        assert_eq!(time_of_day(0), "1984-01-01 00:00:00.000");
        assert_eq!(time_of_day((0xFFFF << 32) + 86_399_999), "2163-06-06 23:59:59.999");
    }

    #[test]
    fn every_day_survives_a_round_trip() {
        for days in 0..=0xFFFF_u64 {
            let value = (days << 32) + 43_200_000;
            let back = parse_time_of_day(&time_of_day(value)).unwrap();
            assert_eq!(back, value.to_le_bytes()[..6], "{}", time_of_day(value));
        }
    }

    #[test]
    fn the_upper_four_bits_of_the_milliseconds_are_reserved_and_ignored() {
        assert_eq!(time_difference(0xF000_0001), "0 00:00:00.001");
        assert_eq!(time_difference(86_400_001), "1 00:00:00.001");
    }

    #[test]
    fn what_is_no_time_is_refused() {
        for text in [
            "",
            "2026-01-31",
            "2026-02-29 00:00:00",
            "2026-13-01 00:00:00",
            "2026-00-01 00:00:00",
            "1983-12-31 00:00:00",
            "2163-06-07 00:00:00",
            "2026-01-31 24:00:00",
            "2026-01-31 00:60:00",
            "2026-01-31 00:00:00.5",
            "2026-01-31 00:00:00.+50",
            "2026-01-31-1 00:00:00",
        ] {
            assert_eq!(parse_time_of_day(text), None, "{text}");
        }
        assert!(parse_time_of_day("2028-02-29T23:59:59").is_some());
        assert_eq!(parse_time_difference("65536 00:00:00"), None);
        assert_eq!(parse_time_difference("-1 00:00:00"), None);
    }
}
