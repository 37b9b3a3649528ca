//! The only module of this crate that reads the clock. The one decision that uses the time is the grace period of fresh
//! blobs in a collection.

use std::time::{SystemTime, UNIX_EPOCH};

/// Returns milliseconds since 1970, UTC.
pub(crate) fn now_ms() -> i64 {
    SystemTime::now().duration_since(UNIX_EPOCH).map_or(0, |d| i64::try_from(d.as_millis()).unwrap_or(i64::MAX))
}

/// Formats a time as `2026-03-01 12:30:05 UTC`.
pub(crate) fn format_ms(ms: i64) -> String {
    let time = chrono::DateTime::from_timestamp_millis(ms).unwrap_or_default();
    time.format("%Y-%m-%d %H:%M:%S UTC").to_string()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn dates_are_those_of_the_calendar() {
        assert_eq!(format_ms(0), "1970-01-01 00:00:00 UTC");
        assert_eq!(format_ms(951_827_696_000), "2000-02-29 12:34:56 UTC");
        assert_eq!(format_ms(1_798_761_599_999), "2026-12-31 23:59:59 UTC");
    }
}
