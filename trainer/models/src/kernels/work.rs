//! Counts the matrix products of a thread.

use std::cell::Cell;
use std::ops::Sub;
use std::time::Duration;
#[cfg(feature = "flex")]
use std::time::Instant;

thread_local! {
    static SO_FAR: Cell<Work> = const { Cell::new(Work { operations: 0, time: Duration::ZERO }) };
}

/// Matrix products of the fused kernels.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Work {
    /// Multiplications and additions.
    pub operations: u64,
    /// Their time, with the packing of operands.
    pub time: Duration,
}

impl Work {
    /// The products of this thread so far.
    pub fn so_far() -> Self {
        SO_FAR.get()
    }

    /// Adds a product of m x k and k x n numbers that began at `begun`.
    #[cfg(feature = "flex")]
    pub(super) fn add((m, n, k): (usize, usize, usize), begun: Instant) {
        let Self { operations, time } = SO_FAR.get();
        let operations = operations.wrapping_add(2 * (m * n * k) as u64);
        SO_FAR.set(Self { operations, time: time + begun.elapsed() });
    }
}

impl Sub for Work {
    type Output = Self;

    fn sub(self, before: Self) -> Self {
        Self { operations: self.operations - before.operations, time: self.time - before.time }
    }
}
