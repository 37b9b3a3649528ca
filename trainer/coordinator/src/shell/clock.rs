//! The clocks of the machine.

use std::time::{Instant, SystemTime, UNIX_EPOCH};

use crate::time::Millis;

/// The machine's wall clock.
pub(super) fn wall_clock() -> Millis {
    let wall = SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default().as_millis();
    Millis(u64::try_from(wall).unwrap_or(u64::MAX))
}

/// The machine's wall clock, as tables and messages say it.
pub(super) fn wall_ms() -> i64 {
    i64::try_from(wall_clock().0).unwrap_or(i64::MAX)
}

/// The machine's wall clock when the process started, and its monotonic clock since: a wall clock that is set while we run
/// would end every lease.
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
