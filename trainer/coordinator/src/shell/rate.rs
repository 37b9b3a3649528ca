//! A limit of calls per second for each token, by a token bucket that fills at that rate.

use std::collections::HashMap;
use std::sync::{Mutex, PoisonError};
use std::time::{Duration, Instant};

/// Seconds of unused calls that a caller may accumulate.
const SAVED_S: u32 = 10;
/// Maximum number of buckets; normally there is one per token.
const BUCKETS: usize = 10_000;

/// Buckets by caller.
#[derive(Debug)]
pub(crate) struct Rates {
    calls: u32,
    buckets: Mutex<HashMap<String, Bucket>>,
}

#[derive(Debug)]
struct Bucket {
    left: f64,
    at: Instant,
}

impl Rates {
    /// Creates a limit of `calls` per second.
    pub(crate) fn new(calls: u32) -> Self {
        Self { calls, buckets: Mutex::default() }
    }

    /// Takes a call at `now`; an error has the time to wait for the next one.
    pub(crate) fn take(&self, caller: &str, now: Instant) -> Result<(), Duration> {
        let most = f64::from(self.calls) * f64::from(SAVED_S);
        let mut buckets = self.buckets.lock().unwrap_or_else(PoisonError::into_inner);
        if buckets.len() >= BUCKETS {
            buckets.clear();
        }
        let bucket = buckets.entry(caller.to_owned()).or_insert(Bucket { left: most, at: now });
        let since = now.saturating_duration_since(bucket.at).as_secs_f64();
        *bucket = Bucket { left: (bucket.left + since * f64::from(self.calls)).min(most), at: now };
        if bucket.left < 1.0 {
            return Err(Duration::from_secs_f64((1.0 - bucket.left) / f64::from(self.calls.max(1))));
        }
        bucket.left -= 1.0;
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_token_makes_its_calls_a_second_and_no_other_waits_for_it() {
        let rates = Rates::new(5);
        let begun = Instant::now();
        let made = |caller, now| (0..1000).take_while(|_| rates.take(caller, now).is_ok()).count();
        assert_eq!(made("a", begun), 50, "what was saved up");
        assert_eq!(made("b", begun), 50, "another's");
        let later = begun + Duration::from_secs(2);
        assert_eq!(made("a", later), 10, "two seconds of five");
        let wait = rates.take("a", later).expect_err("none is left");
        assert!(wait <= Duration::from_millis(200), "{wait:?}");
        assert_eq!(rates.take("a", later + wait + Duration::from_millis(1)), Ok(()));
    }
}
