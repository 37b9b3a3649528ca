//! The thread that computes: runs one assignment after the other and reports how each ended.

use std::any::Any;
use std::backtrace::{Backtrace, BacktraceStatus};
use std::cell::RefCell;
use std::collections::BTreeMap;
use std::panic::{self, AssertUnwindSafe};
use std::sync::Arc;
use std::time::Duration;

use burn::tensor::Device;
use protocol::Digest;
use protocol::message::{FailureClass, ReportOutcome, Role, TaskOutcome};
use protocol::proof::Vouched;
use stages::context::{AttemptContext, ContextError, GangContext, Outcome, Part, StageError};
use stages::external;
use stages::external::DataAccess;
use telemetry::SPANS;
use tracing::Span;

use crate::active_assignment::ActiveAssignment;
use crate::assignments::Shared;
use crate::cache::Cache;
use crate::client::{CallError, Client};
use crate::context::HttpContext;
use crate::failpoints;
use crate::process;
use crate::retry::{self, GaveUp};
use crate::stage_limits::{self, StageLimits};

/// Interface of the stage kinds to a worker. Tests implement their own.
pub(crate) trait Kinds: Send + Sync {
    fn alone(&self, context: &mut dyn AttemptContext) -> Result<Outcome, StageError>;
    fn part(&self, context: &mut dyn AttemptContext, part: Part) -> Result<Outcome, StageError>;
    fn gang(&self, context: &mut dyn GangContext) -> Result<Outcome, StageError>;
}

/// Resources of the stage thread.
pub(crate) struct Bench {
    pub(crate) kinds: Arc<dyn Kinds>,
    pub(crate) client: Client,
    pub(crate) cache: Arc<Cache>,
    pub(crate) data: Arc<DataAccess>,
    pub(crate) device: Device,
    pub(crate) limits: StageLimits,
}

/// Runs assignments until the poll ends.
pub(crate) fn run(shared: &Shared, bench: &Bench) {
    loop {
        let ticket = shared.work.ticket();
        if let Some(held) = shared.next() {
            attempt(&held, bench);
            held.finish();
            drop(held);
            process::give_memory_back();
        } else if shared.is_over() {
            return;
        } else {
            shared.work.wait(ticket, Duration::from_secs(1));
        }
    }
}

fn attempt(held: &Arc<ActiveAssignment>, bench: &Bench) {
    let assignment = held.assignment();
    let grant = &assignment.grant;
    let _entered = span(held).entered();
    tracing::info!(task = %grant.task, attempt = %grant.attempt, fence = %grant.fence, kind = assignment.stage.settings.kind(), "begin");
    let mut context = HttpContext::new(
        held.clone(),
        bench.client.clone(),
        bench.cache.clone(),
        bench.data.clone(),
        bench.device.clone(),
    );
    context.log_opening();
    let part = |part, context: &mut HttpContext| bench.kinds.part(context, part).map(Done::Stage);
    let stage = AssertUnwindSafe(|| match assignment.role {
        Role::Alone => bench.kinds.alone(&mut context).map(Done::Stage),
        Role::Shard { index, of } => part(Part::Shard { index: index as usize, of: of as usize }, &mut context),
        Role::Merge { shards } => part(Part::Merge { shards }, &mut context),
        Role::Member { .. } => bench.kinds.gang(&mut context).map(Done::Stage),
        Role::Resolve => match external::digests(&context) {
            Err(StageError::Interrupted) => Ok(Done::Stage(Outcome::Yielded { at: 0 })),
            found => found.map(Done::Resolved),
        },
    });
    let computing = tracing::trace_span!(target: SPANS, "stage", otel.name = %format_args!("stage {}", assignment.stage.settings.kind()));
    let work = || computing.in_scope(|| panic::catch_unwind(stage));
    let caught = stage_limits::within(&bench.limits, held, &bench.client, work);
    let result = caught.unwrap_or_else(|payload| Err(StageError::Fault(panic_message(&*payload))));
    let Some(outcome) = outcome(result, held, &mut context) else { return };

    failpoints::hit("outcome::before_report");
    let receipts = match &outcome {
        TaskOutcome::Finished { output, .. } => context.receipts(*output),
        TaskOutcome::Resolved { .. } | TaskOutcome::Yielded { .. } | TaskOutcome::Failed { .. } => BTreeMap::new(),
    };
    let reporting = tracing::trace_span!(target: SPANS, "report", outcome = %summary(&outcome));
    let reported = reporting.in_scope(|| report(held, bench, &outcome, &receipts));
    failpoints::hit("outcome::after_report");
    match reported {
        Ok(()) => tracing::info!(task = %grant.task, attempt = %grant.attempt, "end: {}", summary(&outcome)),
        Err(GaveUp::Ended(reason)) => tracing::info!(task = %grant.task, "the outcome arrived too late: {reason}"),
        Err(GaveUp::Answer(error)) => {
            tracing::error!(task = %grant.task, "the outcome was refused: {error}");
            // Without this report, the coordinator would wait for the end as long as this worker lives.
            let class = match error {
                CallError::Storage(_) => FailureClass::Storage,
                CallError::Refused(_) | CallError::Unauthorized(_) => FailureClass::Refused,
                _ => FailureClass::Infrastructure,
            };
            let message = format!("its outputs were refused: {error}");
            if let Err(GaveUp::Answer(error)) =
                report(held, bench, &TaskOutcome::Failed { class, message }, &BTreeMap::new())
            {
                tracing::error!(task = %grant.task, "the report of the failure was refused, too: {error}");
            }
        }
    }
}

/// The span of an attempt, in the trace of its run.
fn span(held: &ActiveAssignment) -> Span {
    let assignment = held.assignment();
    let stage = &assignment.stage;
    let grant = &assignment.grant;
    let span = tracing::trace_span!(
        target: SPANS, "task", stride.run = %stage.run, stride.stage = %stage.name, stride.kind = stage.settings.kind(),
        stride.task = %grant.task, stride.attempt = grant.attempt.0, stride.worker = %grant.worker
    );
    telemetry::join_run(&span, stage.run.as_str());
    span
}

fn report(
    held: &ActiveAssignment,
    bench: &Bench,
    outcome: &TaskOutcome,
    receipts: &BTreeMap<Digest, String>,
) -> Result<(), GaveUp> {
    // A repeated report is recognised by being equal.
    let peak_memory = held.peak_memory();
    retry::until_ended(held, "reporting the outcome", |credential| {
        let report = ReportOutcome { peak_memory, ..ReportOutcome::new(credential.grant.clone(), outcome.clone()) };
        let vouched = Vouched { what: report, receipts: receipts.clone() };
        bench.client.wait(bench.client.tell("/v1/outcomes", credential, &vouched))
    })
}

/// Result of an assignment.
enum Done {
    /// Outcome of a stage.
    Stage(Outcome),
    /// Digests of the data outside the store that a stage's settings name.
    Resolved(BTreeMap<String, Digest>),
}

/// The outcome to report. `None` if the grant has ended, or if rank 0 reports it.
fn outcome(
    result: Result<Done, StageError>,
    held: &ActiveAssignment,
    context: &mut HttpContext,
) -> Option<TaskOutcome> {
    let task = held.grant().task;
    let outcome = match told(result) {
        Ok(outcome) => outcome,
        Err(reason) => {
            tracing::info!(%task, "dropped: {reason}");
            return None;
        }
    };
    let has_failed = matches!(outcome, TaskOutcome::Failed { .. });
    if let TaskOutcome::Failed { message, .. } = &outcome {
        tracing::error!(%task, "{message}");
    }
    if has_failed || held.leads() {
        context.log_end(&outcome);
    }
    // Recorded values belong to the outcome; without them the outcome is not reported. A failure is reported anyway, after the
    // lines before it, so that they can be read.
    let outcome = match context.flush() {
        Err(error) if has_failed => {
            tracing::warn!(%task, "the last lines of a failed attempt are lost: {error}");
            Ok(outcome)
        }
        Err(error) => told(Err(error.into())),
        Ok(()) => Ok(outcome),
    };
    let outcome = held.ended().map_or(outcome, Err);
    match outcome {
        Err(reason) => {
            tracing::info!(%task, "dropped: {reason}");
            None
        }
        Ok(outcome @ TaskOutcome::Failed { .. }) => Some(outcome),
        Ok(_) if !held.leads() => {
            tracing::info!(%task, "end; rank 0 reports");
            None
        }
        Ok(outcome) => Some(outcome),
    }
}

/// The outcome that a result means, or why the grant has ended.
fn told(result: Result<Done, StageError>) -> Result<TaskOutcome, String> {
    match result {
        Ok(Done::Resolved(digests)) => Ok(TaskOutcome::Resolved { digests }),
        Ok(Done::Stage(Outcome::Finished { output, metrics })) => {
            let metrics = metrics.into_iter().filter(|(_, value)| value.is_finite()).collect();
            Ok(TaskOutcome::Finished { output, metrics })
        }
        Ok(Done::Stage(Outcome::Yielded { at })) => Ok(TaskOutcome::Yielded { at }),
        Err(StageError::Context(ContextError::GrantEnded(reason))) => Err(reason),
        Err(error) => {
            let message = error.to_string();
            let class = match error.class() {
                FailureClass::Fault if is_out_of_memory(&message) => FailureClass::OutOfMemory,
                class => class,
            };
            Ok(TaskOutcome::Failed { class, message })
        }
    }
}

/// Recognises a failed allocation. Device backends panic with a text, without a type to match.
fn is_out_of_memory(message: &str) -> bool {
    let message = message.to_ascii_lowercase();
    message.contains("out of memory") || message.contains("outofmemory")
}

fn summary(outcome: &TaskOutcome) -> String {
    match outcome {
        TaskOutcome::Finished { output, .. } => format!("finished, {}", output.short()),
        TaskOutcome::Resolved { digests } => format!("{} digests", digests.len()),
        TaskOutcome::Yielded { at } => format!("yielded at {at}"),
        TaskOutcome::Failed { class, .. } => format!("failed, {class:?}"),
    }
}

thread_local! {
    static WHERE: RefCell<Option<String>> = const { RefCell::new(None) };
}

/// Installs a hook that logs panics with their place and remembers the place for the report.
pub(crate) fn log_panics() {
    panic::set_hook(Box::new(|info| {
        let place = info.location().map_or_else(|| "an unknown place".to_owned(), ToString::to_string);
        tracing::error!("panic at {place}: {}", text(info.payload()));
        // Unit tests have no log; the harness shows this beside the failed test.
        #[cfg(test)]
        eprintln!("panic at {place}: {}", text(info.payload()));
        let trace = Backtrace::capture();
        if trace.status() == BacktraceStatus::Captured {
            tracing::error!("{trace}");
        }
        WHERE.with(|last| *last.borrow_mut() = Some(place));
    }));
}

fn text(payload: &(dyn Any + Send)) -> &str {
    let text = payload.downcast_ref::<&str>().copied().or_else(|| payload.downcast_ref::<String>().map(String::as_str));
    text.unwrap_or("a panic without a message")
}

fn panic_message(payload: &(dyn Any + Send)) -> String {
    match WHERE.with(|last| last.borrow_mut().take()) {
        Some(place) => format!("panic at {place}: {}", text(payload)),
        None => format!("panic: {}", text(payload)),
    }
}
