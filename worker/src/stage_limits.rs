//! Limits of a stage: memory and time.
//!
//! A thread checks both while a stage computes, and notes the highest memory. Exceeding a limit is reported as a final
//! failure. The coordinator then ends the grant, and the stage stops at its next check. If it does not stop, the process
//! exits, which frees its memory.

use std::collections::BTreeMap;
use std::sync::mpsc::{self, RecvTimeoutError};
use std::thread;
use std::time::{Duration, Instant};

use protocol::message::{FailureClass, ReportOutcome, Role, TaskOutcome};
use protocol::proof::Vouched;

use crate::active_assignment::ActiveAssignment;
use crate::client::Client;
use crate::process::{self, Memory};

/// Interval between two checks.
const PERIOD: Duration = Duration::from_millis(100);
/// Tries to report the failure before the process exits.
const TRIES: u32 = 20;

/// Limits of every stage of a worker.
#[derive(Debug, Clone)]
pub struct StageLimits {
    /// Bytes of memory of the process, without mapped files.
    pub memory: Option<u64>,
    /// Longest duration of a stage that is no training.
    pub time: Option<Duration>,
    /// Time for a stage beyond a limit to stop; then the process exits.
    pub grace: Duration,
}

impl Default for StageLimits {
    /// Nine tenths of the machine's memory, and no time limit.
    fn default() -> Self {
        let memory = process::machine_memory().map(|bytes| bytes / 10 * 9);
        Self { memory, time: None, grace: Duration::from_secs(10) }
    }
}

impl StageLimits {
    /// Returns class and message of a limit that a stage exceeds after `time` with `memory` bytes, if it exceeds one.
    fn exceeded(&self, held: &ActiveAssignment, time: Duration, memory: Option<u64>) -> Option<(FailureClass, String)> {
        let gib = |bytes: u64| bytes as f64 / f64::from(1 << 30);
        if let (Some(most), Some(used)) = (self.memory, memory)
            && used > most
        {
            let message = format!(
                "is out of memory: it uses {:.2} GiB; expected at most {:.2} GiB; use less data, more `batch.slices` \
                 or a smaller `network`, or start its worker with a larger `--stage-memory`",
                gib(used),
                gib(most)
            );
            return Some((FailureClass::OutOfMemory, message));
        }
        let most = self.time.filter(|_| !matches!(held.assignment().role, Role::Member { .. }))?;
        (time > most).then(|| {
            let time = time.as_secs();
            let most = most.as_secs();
            let message = format!(
                "is not done after {time} s; expected at most {most} s; use less data or more `shards`, or start its \
                 worker with a larger `--stage-time`"
            );
            (FailureClass::Refused, message)
        })
    }
}

/// Runs `work` within the limits.
pub(crate) fn within<T>(limits: &StageLimits, held: &ActiveAssignment, client: &Client, work: impl FnOnce() -> T) -> T {
    thread::scope(|scope| {
        let (working, ended) = mpsc::channel::<()>();
        let peak_before = process::memory().map_or(u64::MAX, |memory| memory.peak);
        measured(held, peak_before);
        scope.spawn(move || watch(limits, held, client, peak_before, &ended));
        let done = work();
        measured(held, peak_before);
        drop(working);
        done
    })
}

/// Reads the memory of the process, and notes it for the assignment. The system's own peak is exact, but is of the
/// whole life of the process. It is therefore noted only if it has risen since the assignment began.
fn measured(held: &ActiveAssignment, peak_before: u64) -> Option<Memory> {
    let memory = process::memory()?;
    held.saw_memory(if memory.peak > peak_before { memory.peak } else { memory.resident });
    Some(memory)
}

/// Watches a stage until it has ended.
fn watch(limits: &StageLimits, held: &ActiveAssignment, client: &Client, peak_before: u64, ended: &mpsc::Receiver<()>) {
    let begun = Instant::now();
    let is_running = |period| ended.recv_timeout(period) == Err(RecvTimeoutError::Timeout);
    let (class, message) = loop {
        if !is_running(PERIOD) {
            return;
        }
        if let Some(exceeded) =
            limits.exceeded(held, begun.elapsed(), measured(held, peak_before).map(|memory| memory.anonymous))
        {
            break exceeded;
        }
    };
    tracing::error!(task = %held.grant().task, "{message}");
    for _ in 0..TRIES {
        let outcome = TaskOutcome::Failed { class, message: message.clone() };
        let credential = held.credential();
        let peak_memory = held.peak_memory();
        let what = ReportOutcome { peak_memory, ..ReportOutcome::new(credential.grant.clone(), outcome) };
        let report = Vouched { what, receipts: BTreeMap::new() };
        let reported = client.wait(client.tell("/v1/outcomes", &credential, &report));
        match reported {
            Err(error) if error.may_pass() && held.ended().is_none() => {
                if !is_running(PERIOD) {
                    return;
                }
            }
            _ => break,
        }
    }
    if is_running(limits.grace) {
        tracing::error!("the stage exceeds a limit and does not stop; ending this process");
        std::process::exit(1);
    }
}
