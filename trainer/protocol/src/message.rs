//! Messages between workers, the coordinator and its clients: JSON over HTTP.
//!
//! Workers pull. `poll` is both heartbeat and request for work: a worker reports its work, and the coordinator answers
//! with the full set of assignments that the worker should have. The worker then starts and stops work to match it. A
//! lost answer does no harm, because the next one has the same content.
//!
//! Every write carries a [`Grant`]. The coordinator checks its fence in the transaction that stores the write. It
//! answers 409 with the code `stale-fence` to an old one.
//!
//! Names and grants are not secret. [`proof`](crate::proof) says how a call proves whose it is.

mod problem;
mod run;
mod worker;

pub use problem::{ApiError, CODES, Problem};
pub use run::{
    Listing, RunState, RunSummary, RunView, StageState, StageView, StorageProblem, Submit, SweepView, Times,
    TrialState, TrialView,
};
pub use worker::{
    Assignment, CommitCheckpoint, DesiredAssignments, Doing, FailureClass, Gone, Grant, Join, Joined, LogBatch,
    LossCause, LostPeer, Member, MetricBatch, MetricRow, PROTOCOL_VERSION, Poll, Prepare, Progress, ReportOutcome,
    Role, StageTask, TaskOutcome,
};
