//! Time of computation, for estimates.

use std::time::{Duration, Instant};

use nix::time::{ClockId, clock_gettime};
use protocol::stage::Backend;

/// A clock that runs while a stage computes.
#[derive(Debug, Clone, Copy)]
pub(crate) enum Clock {
    /// The processor time of this thread, which other programs on the machine do not lengthen.
    Thread,
    /// The time since this moment, for devices that compute beside the thread.
    Wall(Instant),
}

impl Clock {
    /// The clock that suits a backend.
    pub(crate) fn of(backend: Backend) -> Self {
        if backend.is_cpu() { Self::Thread } else { Self::Wall(Instant::now()) }
    }

    /// The time on the clock.
    pub(crate) fn read(self) -> Duration {
        match self {
            // Every system that we build for has this clock.
            Self::Thread => clock_gettime(ClockId::CLOCK_THREAD_CPUTIME_ID).map(Duration::from).unwrap_or_default(),
            Self::Wall(start) => start.elapsed(),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn waiting_takes_no_time_on_a_processor() {
        let (processor, wall) = (Clock::of(Backend::Flex), Clock::of(Backend::Wgpu));
        let before = processor.read();
        std::thread::sleep(Duration::from_millis(60));
        assert!(processor.read() - before < Duration::from_millis(30));
        assert!(wall.read() >= Duration::from_millis(60));
    }
}
