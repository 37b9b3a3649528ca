//! Results of lookups for executions: a stored value, data of an earlier try, or the need to compute.

use std::sync::Arc;

use protocol::message::Grant;
use protocol::{Digest, RunId, StageName};
use registry::{HistoryEntry, HistoryKind, Write};

use super::deciding::Deciding;
use crate::event::Effect;
use crate::fact::Fact;
use crate::history;
use crate::register::Registration;
use crate::rejected::Rejected;
use crate::state::execution::{ExecutionState, StageExecution};
use crate::state::task::Task;
use crate::time::Millis;
use crate::value::Known;

impl Deciding<'_> {
    /// Notes that an execution makes no progress.
    pub(crate) fn quiet(&mut self, key: Digest, for_ms: u64) -> bool {
        let Some(execution) = self.state.executions.get(&key).filter(|execution| !execution.is_over()) else {
            return false;
        };
        let why = format!("no progress for {} minutes", for_ms / 60_000);
        self.history.push(HistoryEntry { why: Some(why), ..history::about(execution, HistoryKind::Stalled) });
        true
    }

    pub(crate) fn looked_up(
        &mut self,
        key: Digest,
        known: Option<Known>,
        source: Option<(RunId, StageName)>,
        archived: Option<Box<StageExecution>>,
    ) -> bool {
        let Some(execution) = self.state.executions.get(&key).map(Arc::clone) else { return false };
        if execution.state != ExecutionState::Looking {
            return false;
        }
        match (known, &execution.registration) {
            (Some(known), _) => {
                if let Some((run, stage)) = source
                    && execution.tasks.is_empty()
                {
                    self.record(Fact::ExecutionSource { key, run, stage });
                }
                let state = ExecutionState::Done { known: Arc::new(known), cached: true };
                self.record(Fact::ExecutionState { key, state });
            }
            (None, Some(registration)) => {
                let effect = self.registering(&execution, registration);
                self.record(Fact::ExecutionState { key, state: ExecutionState::Bundling });
                self.effects.push(effect);
            }
            (None, None) => {
                let fence = self.state.fence;
                match archived.filter(|archived| archived.key == key && !archived.tasks.is_empty()) {
                    _ if !execution.tasks.is_empty() => {}
                    Some(archived) => self.take_up(&archived),
                    None => self.record(Fact::Tasks { key, tasks: execution.new_tasks(fence) }),
                }
                self.record(Fact::ExecutionState { key, state: ExecutionState::Open });
            }
        }
        true
    }

    /// Restores the tasks, budgets and working time of an earlier try.
    fn take_up(&mut self, archived: &StageExecution) {
        let key = archived.key;
        let fence = self.state.fence;
        let again = |task: &Task| {
            let mut task = Task { fence: task.fence.max(fence), ..task.clone() };
            task.reset_budgets();
            task
        };
        let run = archived.run.clone();
        let stage = archived.stage.clone();
        self.record(Fact::ExecutionSource { key, run: run.clone(), stage });
        self.record(Fact::Tasks { key, tasks: archived.tasks.iter().map(again).collect() });
        if let Some(instruction_set) = archived.instruction_set.clone() {
            self.record(Fact::ExecutionInstructions { key, instruction_set });
        }
        let idle_since = Some(self.now());
        self.record(Fact::ExecutionTime { key, wall_ms: archived.wall_ms, busy_since: None, idle_since });
        if archived.resumed || archived.has_something() {
            self.resumed(key);
        }
        self.writes.push(Write::Archive { key, run, stage: archived.stage.clone(), execution: None });
    }

    /// Records that an execution continues from data of an earlier try.
    pub(crate) fn resumed(&mut self, key: Digest) {
        if !self.state.executions[&key].resumed {
            self.record(Fact::ExecutionResumed { key });
        }
    }

    /// The effect that makes the bundles of a registration.
    pub(crate) fn registering(&self, execution: &StageExecution, registration: &Registration) -> Effect {
        let owner = self.state.registrant(execution).map(|run| run.owner.clone()).unwrap_or_default();
        let promotes = registration.promote.as_ref().map(|(alias, _)| alias.clone());
        let candidates = registration.candidates.clone();
        Effect::Register { key: execution.key, candidates, promotes, owner }
    }

    pub(crate) fn bundled(&mut self, key: Digest, bundles: &[Digest]) -> Result<bool, Rejected> {
        if self.state.executions.get(&key).is_none_or(|execution| execution.state != ExecutionState::Bundling) {
            return Ok(false);
        }
        let now = self.now();
        let execution = Arc::clone(&self.state.executions[&key]);
        let registration = execution.registration.as_ref().expect("bundling is registering");
        if bundles.len() != registration.candidates.len() {
            return Err(Rejected::Invalid(format!("stage `{}` needs a bundle for each candidate", execution.stage)));
        }
        let Some(run) = self.state.registrant(&execution).cloned() else {
            // The run that registers was cancelled meanwhile.
            self.fail_execution(key, "no run waits for this registration".to_owned(), false);
            return Ok(true);
        };
        let (known, mut writes) = registration.writes(&run, &execution.stage, bundles);
        writes.push(result(&execution, None, &known, now));
        let state = ExecutionState::Done { known: Arc::new(known), cached: false };
        self.record(Fact::ExecutionState { key, state });
        self.writes.append(&mut writes);
        Ok(true)
    }
}

/// The write that stores a stage's value under its key.
pub(crate) fn result(execution: &StageExecution, grant: Option<Grant>, known: &Known, now: Millis) -> Write {
    Write::StageResult {
        grant,
        key: execution.key,
        run: execution.run.clone(),
        stage: execution.stage.clone(),
        kind: execution.settings.kind().to_owned(),
        outputs: known.outputs.clone(),
        metrics: known.metrics.clone(),
        inputs: execution.inputs.clone(),
        wall_s: execution.wall_s(now),
    }
}
