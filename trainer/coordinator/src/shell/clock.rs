//! Access to the machine's clocks.

use std::time::{Instant, SystemTime, UNIX_EPOCH};

use crate::time::Millis;

/// The wall clock.
pub(super) fn wall_clock() -> Millis {
    let wall = SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default().as_millis();
    Millis(u64::try_from(wall).unwrap_or(u64::MAX))
}

/// The wall clock in the type of tables and messages.
pub(super) fn wall_ms() -> i64 {
    i64::try_from(wall_clock().0).unwrap_or(i64::MAX)
}

/// The wall clock at the start of the process, advanced by the monotonic clock. Setting the wall clock while the
/// process runs would otherwise expire every lease.
#[derive(Debug)]
pub(super) struct Clock {
    start: Instant,
    start_ms: u64,
}

impl Clock {
    pub(super) fn new(not_before: Millis) -> Self {
        Self { start: Instant::now(), start_ms: wall_clock().0.max(not_before.0) }
    }

    pub(super) fn now(&self) -> Millis {
        let since = u64::try_from(self.start.elapsed().as_millis()).unwrap_or(u64::MAX);
        Millis(self.start_ms.saturating_add(since))
    }
}
