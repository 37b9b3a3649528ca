//! How much of anything the system takes, in one place: what is beyond is refused with a message that names the limit.
//!
//! A limit is chosen so that no honest use comes near it and no dishonest one can stop the others' work.

/// Stages of a submitted pipeline. Those that a sweep adds while its run goes on are bounded by
/// [`MAX_TRIALS`](crate::sweep::MAX_TRIALS) instead.
pub const STAGES: usize = 1_000;

/// Bytes of a call that says little: a poll, a checkpoint's or a task's end, a command.
pub const CALL_BYTES: usize = 1 << 20;
/// Bytes of a batch of values or of log lines.
pub const BATCH_BYTES: usize = 16 << 20;
/// Bytes of a submission, which carries its pipeline as it was written and as it was read.
pub const SUBMISSION_BYTES: usize = 8 << 20;
/// Bytes of a blob.
pub const BLOB_BYTES: usize = 8 << 30;
/// Bytes of all calls together, blobs excepted, that are in memory at a time; more wait.
pub const CALLS_BYTES: usize = 32 << 20;
