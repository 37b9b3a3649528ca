//! How much of anything the system takes, in one place: what is beyond is refused with a message that names the limit.
//!
//! A limit is chosen so that no honest use comes near it and no dishonest one can stop the others' work.

/// Stages of a submitted pipeline. Those that a sweep adds while its run goes on are bounded by
/// [`MAX_TRIALS`](crate::sweep::MAX_TRIALS) instead.
pub const STAGES: usize = 1_000;
