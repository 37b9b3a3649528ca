//! The moment from which a token is refused: `2026-12-31` (the day is still allowed, in UTC) or an RFC 3339 time.

use std::fmt;
use std::str::FromStr;

const DAY_S: i64 = 24 * 60 * 60;

/// A moment, kept also as the text that it was parsed from.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Expiry {
    at_ms: u64,
    text: String,
}

impl Expiry {
    /// Returns true at and after this moment.
    pub fn is_over(&self, now_ms: u64) -> bool {
        now_ms >= self.at_ms
    }
}

impl fmt::Display for Expiry {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.text)
    }
}

impl FromStr for Expiry {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, Self::Err> {
        let seconds = seconds(text).ok_or_else(|| {
            format!("`{text}` is not a time; expected a day such as `2026-12-31`, or `2026-12-31T18:00:00Z`")
        })?;
        let at_ms = u64::try_from(seconds).map_err(|_| format!("`{text}` is before 1970"))? * 1000;
        Ok(Self { at_ms, text: text.to_owned() })
    }
}

/// The moment in seconds since 1970.
fn seconds(text: &str) -> Option<i64> {
    let Some((day, time)) = text.split_once(['T', 't']) else { return Some(days(text)? * DAY_S + DAY_S) };
    let zone = time.find(['Z', 'z', '+', '-'])?;
    let (clock, zone) = time.split_at(zone);
    let offset = match zone {
        "Z" | "z" => 0,
        _ => {
            let (hours, minutes) = zone[1..].split_once(':')?;
            let offset = number(hours, 2, 0..=23)? * 3600 + number(minutes, 2, 0..=59)? * 60;
            if zone.starts_with('-') { -offset } else { offset }
        }
    };
    let (clock, fraction) = clock.split_once('.').unwrap_or((clock, "0"));
    if fraction.is_empty() || !fraction.bytes().all(|byte| byte.is_ascii_digit()) {
        return None;
    }
    let parts: Vec<&str> = clock.split(':').collect();
    let [hours, minutes, seconds] = parts.as_slice() else { return None };
    let clock = number(hours, 2, 0..=23)? * 3600 + number(minutes, 2, 0..=59)? * 60 + number(seconds, 2, 0..=60)?;
    Some(days(day)? * DAY_S + clock - offset)
}

/// Days from 1970-01-01 to a day of the Gregorian calendar.
fn days(text: &str) -> Option<i64> {
    let parts: Vec<&str> = text.split('-').collect();
    let [year, month, day] = parts.as_slice() else { return None };
    let year = number(year, 4, 1..=9999)?;
    let month = number(month, 2, 1..=12)?;
    let day = number(day, 2, 1..=length(year, month))?;
    let months: i64 = (1..month).map(|month| length(year, month)).sum();
    let before = year - 1;
    let to_year = before * 365 + before / 4 - before / 100 + before / 400;
    Some(to_year + months + day - 1 - 719_162)
}

fn length(year: i64, month: i64) -> i64 {
    let is_leap = year % 4 == 0 && (year % 100 != 0 || year % 400 == 0);
    match month {
        2 if is_leap => 29,
        2 => 28,
        4 | 6 | 9 | 11 => 30,
        _ => 31,
    }
}

fn number(text: &str, digits: usize, range: std::ops::RangeInclusive<i64>) -> Option<i64> {
    let is_plain = text.len() == digits && text.bytes().all(|byte| byte.is_ascii_digit());
    text.parse().ok().filter(|number| is_plain && range.contains(number))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn days_last_to_their_end_and_times_to_the_second() {
        for (text, seconds) in [
            ("1970-01-01", 86_400),
            ("2026-12-31", 1_798_761_600),
            ("2024-02-29", 1_709_251_200),
            ("2026-11-24T19:30:00Z", 1_795_548_600),
            ("2026-11-24T20:30:00+01:00", 1_795_548_600),
            ("2026-11-24T14:00:00.25-05:30", 1_795_548_600),
        ] {
            let expiry: Expiry = text.parse().expect(text);
            assert_eq!(expiry.at_ms, seconds * 1000, "{text}");
            assert!(expiry.is_over(seconds * 1000) && !expiry.is_over(seconds * 1000 - 1), "{text}");
            assert_eq!(expiry.to_string(), text);
        }
    }

    #[test]
    fn what_is_no_time_is_refused() {
        for text in [
            "",
            "tomorrow",
            "2026",
            "2026-13-01",
            "2026-02-29",
            "2026-1-1",
            "2026-12-31T",
            "2026-12-31T18:00",
            "26-12-31",
            "2026-12-31T18:00:00",
            "2026-12-31T18:00Z",
            "2026-12-31T18:00:00.Z",
            "2026-12-31T25:00:00Z",
            "1969-12-01",
        ] {
            assert!(text.parse::<Expiry>().is_err(), "{text}");
        }
    }
}
