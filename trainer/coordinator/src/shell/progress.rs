//! Watch over progress: a stage that work has begun on and that stands still is noted in the history.

use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::Duration;

use protocol::Digest;
use protocol::message::Progress;
use tokio::time::{Instant, timeout};

use super::actor_handle::ActorHandle;
use crate::batch::Refused;
use crate::event::Event;
use crate::state::State;
use crate::state::execution::StageExecution;
use crate::state::task::Lease;

/// Longest time between two looks.
const LOOK: Duration = Duration::from_secs(60);

/// The progress of a stage. An equal value later means that nothing moved.
#[derive(Debug, PartialEq)]
struct Pace {
    tasks_done: usize,
    steps: Option<u64>,
    reported: Option<Arc<Progress>>,
}

impl Pace {
    /// The pace of an execution; `None` while no running run wants it and before work on it begins, so that a queue is
    /// no standstill.
    fn of(state: &State, execution: &StageExecution) -> Option<Self> {
        let mut users = execution.users.iter().filter_map(|(run, _)| state.runs.get(run));
        let has_begun = execution.tasks.iter().any(|task| task.attempt.0 > 0);
        if execution.is_over() || !has_begun || !users.any(|run| run.is_at_work()) {
            return None;
        }
        let tasks_done = execution.tasks.iter().filter(|task| matches!(task.lease, Lease::Done { .. })).count();
        let holders = execution.tasks.iter().flat_map(|task| task.holders());
        let words = holders.filter_map(|member| state.heard.words.get(&member.worker));
        let steps = words.filter_map(|word| word.holds).max();
        let task = execution.tasks.iter().next().filter(|_| execution.tasks.len() == 1);
        let reported = task.and_then(|task| state.heard.progress.get(&task.id).cloned());
        Some(Self { tasks_done, steps, reported })
    }
}

/// A stage's pace, since when it has it, and whether that was noted.
#[derive(Debug)]
struct Standing {
    pace: Pace,
    since: Instant,
    noted: bool,
}

/// Notes each stage that stands still for `quiet`, once until it moves again.
pub(super) async fn watch(actor_handle: Arc<ActorHandle>, quiet: Duration) {
    let mut stopped = actor_handle.stopped();
    let mut standing: BTreeMap<Digest, Standing> = BTreeMap::new();
    // An error means that the coordinator has ended.
    while timeout(LOOK.min(quiet / 10), stopped.wait_for(|stop| *stop)).await.is_err() {
        let state = actor_handle.state();
        let now = Instant::now();
        let mut seen = BTreeMap::new();
        for (key, execution) in state.executions.iter() {
            let Some(pace) = Pace::of(&state, execution) else { continue };
            let known = standing.remove(key).filter(|known| known.pace == pace);
            seen.insert(*key, known.unwrap_or(Standing { pace, since: now, noted: false }));
        }
        standing = seen;
        for (key, standing) in &mut standing {
            let stood = now.duration_since(standing.since);
            if standing.noted || stood < quiet {
                continue;
            }
            let for_ms = u64::try_from(stood.as_millis()).unwrap_or(u64::MAX);
            match actor_handle.decide(Event::Quiet { key: *key, for_ms }).await {
                Ok(_) => standing.noted = true,
                Err(Refused::Stopped | Refused::Failed(_)) => return,
                Err(error) => tracing::warn!(%error, "cannot note that a stage stands still; trying again"),
            }
        }
    }
}
