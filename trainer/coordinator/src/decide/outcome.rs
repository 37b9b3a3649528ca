//! Reports of task holders: checkpoints and ends of attempts. This part of `decide` checks which reports are accepted.
//!
//! | report \ from | rank 0 (or alone) | another member | an old grant |
//! |---|---|---|---|
//! | checkpoint | committed | refused | refused: stale fence |
//! | resolved | done, for a task that resolves | refused | as for finished |
//! | finished | done | done | refused, unless it repeats the accepted report |
//! | yielded | waits | the member leaves the gang | as above |
//! | failed: infrastructure, fault, damaged; another member holds the state | the member leaves the gang | the same | as above |
//! | failed: infrastructure | tried again | the member leaves the gang | as above |
//! | failed: fault | tried again | tried again | as above |
//! | failed: memory; others in the gang | tried without the member | tried without the member | as above |
//! | failed: an input is damaged | waits until the input is recomputed | the same | as above |
//! | failed: input, diverged, refused, storage; only another member holds the state | the member leaves the gang | the same | as above |
//! | failed: input, diverged, memory and alone, refused, storage | final | final | as above |
//!
//! A failing member therefore costs its gang no step while another member holds the state.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;

use protocol::message::{CommitCheckpoint, FailureClass, Grant, LossCause, ReportOutcome, TaskOutcome};
use protocol::stage::StageSettings;
use protocol::sweep::STATE_OUTPUT;
use protocol::{Digest, WorkerId, canonical};
use registry::{Write, WriteError};

use crate::decide::attempts::Loss;
use crate::decide::deciding::Deciding;
use crate::decide::executions::result;
use crate::event::{Effect, Event};
use crate::fact::Fact;
use crate::rejected::Rejected;
use crate::state::execution::ExecutionState;
use crate::state::task::{Lease, Part, Saved, Task};
use crate::value::Known;

impl Deciding<'_> {
    pub(crate) fn checkpoint(&mut self, commit: CommitCheckpoint) -> Result<bool, Rejected> {
        let CommitCheckpoint { grant, step, manifest, metrics } = commit;
        let (execution, task) = self.state.task(&grant.task)?;
        if task.check(&grant)? != 0 {
            let worker = &grant.worker;
            return Err(Rejected::Conflict(format!(
                "worker `{worker}` is not rank 0 of its gang; only rank 0 commits checkpoints"
            )));
        }
        match task.newest() {
            Some(newest) if newest.step == step && newest.manifest == manifest => return Ok(false),
            Some(newest) if newest.step == step => {
                let message = registry::two_states(&task.id, step, &newest.manifest.to_string(), &manifest.to_string());
                let (key, _) = self.place(&grant.task)?;
                self.fail_execution(key, message, false);
                return Ok(true);
            }
            Some(newest) if newest.step > step => {
                return Err(Rejected::Conflict(format!(
                    "task `{}` already has a checkpoint at step {}; expected a later step than {step}",
                    task.id, newest.step
                )));
            }
            Some(_) | None => {}
        }
        let keep = execution.placement.checkpoint.keep.clone();
        let (key, i) = self.place(&grant.task)?;
        let saved = Saved { step, manifest, metrics: metrics.clone() };
        let dropped = self.change(key, i, |task| task.save(saved, &keep));
        if !dropped.is_empty() {
            self.effects.push(Effect::Prune { task: grant.task.clone(), keep, at_end: false });
        }
        self.writes.push(Write::Checkpoint { grant, step, manifest, metrics });
        Ok(true)
    }

    pub(crate) fn outcome(&mut self, report: ReportOutcome) -> Result<bool, Rejected> {
        let grant = &report.grant;
        let (_, task) = self.state.task(&grant.task)?;
        if task.reported.as_ref() == Some(&report) {
            return Ok(false);
        }
        let rank = task.check(grant)?;
        let (key, i) = self.place(&grant.task)?;
        let worker = grant.worker.clone();
        let resolves = self.state.executions[&key].resolves;
        match &report.outcome {
            TaskOutcome::Resolved { digests } => self.resolved(key, i, digests)?,
            TaskOutcome::Finished { .. } if resolves => {
                let task = &grant.task;
                return Err(Rejected::Conflict(format!("task `{task}` digests files; it has no artifact")));
            }
            // From any member that led the gang when it published the value: all compute the same one.
            TaskOutcome::Finished { output, metrics } => {
                self.finished(&report, key, i, *output, metrics.clone())?;
            }
            // It led the gang when it saved and stopped. The others continue with their own state.
            TaskOutcome::Yielded { .. } if rank != 0 => {
                self.take_from(key, i, std::slice::from_ref(&worker), Loss::Lost);
            }
            TaskOutcome::Yielded { .. } => {
                let now = self.now();
                let soon = now.after(self.state.policy.backoff_ms);
                // The pause keeps the task from a worker that is about to end and has not said so.
                let leaves = self.state.workers.get(&worker).is_some_and(|worker| worker.leaving);
                self.change(key, i, |task| {
                    let asked = leaves || matches!(task.lease, Lease::Held { drain_by: Some(_), .. });
                    task.give_back((!asked).then_some(soon));
                });
            }
            TaskOutcome::Failed { class, message } => self.failed(key, i, &worker, *class, message, rank),
        }
        self.accepted(key, i, &report);
        Ok(true)
    }

    /// Handles the failure of a member: the gang continues without it, the task is tried again, or the stage fails.
    fn failed(&mut self, key: Digest, i: usize, worker: &WorkerId, class: FailureClass, message: &str, rank: usize) {
        let task = &self.state.executions[&key].tasks[i];
        if class != FailureClass::OutOfMemory
            && self.state.goes_on_without(task, worker)
            && !(class.is_final() && self.has_state(task, worker))
        {
            self.leave(key, i, worker, LossCause::Unreachable);
            return;
        }
        match class {
            FailureClass::Infrastructure if rank != 0 => self.leave(key, i, worker, LossCause::Unreachable),
            FailureClass::Infrastructure | FailureClass::Fault => {
                self.try_again(key, i, message, class == FailureClass::Fault);
            }
            // The others have the same weights but perhaps more memory, so they continue without this member.
            FailureClass::OutOfMemory if task.holders().len() > 1 => {
                self.change(key, i, |task| task.too_small.push(worker.clone()));
                self.take_from(key, i, std::slice::from_ref(worker), Loss::Lost);
            }
            FailureClass::Damaged => self.mend(key, i, message),
            FailureClass::Input
            | FailureClass::Diverged
            | FailureClass::OutOfMemory
            | FailureClass::Refused
            | FailureClass::Storage => {
                let own = class != FailureClass::Storage;
                self.fail_execution(key, message.to_owned(), own);
            }
        }
    }

    fn accepted(&mut self, key: Digest, i: usize, report: &ReportOutcome) {
        self.change(key, i, |task| task.reported = Some(report.clone()));
    }

    /// Accepts the digests of a stage's files outside the store, from which the stage gets a key.
    fn resolved(&mut self, key: Digest, i: usize, digests: &BTreeMap<String, Digest>) -> Result<(), Rejected> {
        let execution = Arc::clone(&self.state.executions[&key]);
        let named: BTreeSet<String> = execution.settings.folders().into_iter().map(|folder| folder.field).collect();
        if !execution.resolves || named.iter().ne(digests.keys()) {
            let stage = &execution.stage;
            return Err(Rejected::Conflict(format!("stage `{stage}` needs no digests, or digests of other files")));
        }
        self.change(key, i, |task| task.finish(canonical::digest(digests)));
        for (run, stage) in execution.users.iter().copied() {
            self.record(Fact::Resolved { run, stage, digests: digests.clone() });
        }
        let known = Arc::new(Known { outputs: BTreeMap::new(), metrics: BTreeMap::new() });
        self.record(Fact::ExecutionState { key, state: ExecutionState::Done { known, cached: false } });
        Ok(())
    }

    fn finished(
        &mut self,
        report: &ReportOutcome,
        key: Digest,
        i: usize,
        output: Digest,
        metrics: BTreeMap<String, f64>,
    ) -> Result<(), Rejected> {
        let now = self.now();
        let grant = report.grant.clone();
        let execution = &self.state.executions[&key];
        let state = left_state(&execution.settings, &execution.tasks[i])?;
        self.change(key, i, |task| task.finish(output));
        let execution = &self.state.executions[&key];
        if let Part::Shard { .. } = execution.tasks[i].part {
            self.writes.push(Write::Shard { grant, output });
            return Ok(());
        }
        let name = execution.settings.output().name;
        let mut outputs = BTreeMap::from([(name.to_owned(), output)]);
        outputs.extend(state.map(|state| (STATE_OUTPUT.to_owned(), state)));
        let known = Known { outputs, metrics };
        let write = result(execution, Some(grant), &known, now);
        let keep = execution.placement.checkpoint.keep.clone();
        self.record(Fact::ExecutionState {
            key,
            state: ExecutionState::Done { known: Arc::new(known), cached: false },
        });
        self.writes.push(write);
        // The value is stored, so no attempt resumes from these checkpoints. Those stay that the pipeline asks for.
        if !self.change(key, i, |task| std::mem::take(&mut task.checkpoints)).is_empty() {
            self.effects.push(Effect::Prune { task: report.grant.task.clone(), keep, at_end: true });
        }
        Ok(())
    }
}

/// The checkpoint that a stage with an early stop leaves for its successor: that of its last step, which every training
/// saves.
fn left_state(settings: &StageSettings, task: &Task) -> Result<Option<Digest>, Rejected> {
    let Some(training) = settings.training().filter(|training| training.stop.is_some()) else { return Ok(None) };
    let end = training.end().0;
    match task.newest() {
        Some(saved) if saved.step == end => Ok(Some(saved.manifest)),
        other => {
            let newest = other.map_or("none".to_owned(), |saved| format!("of step {}", saved.step));
            Err(Rejected::Conflict(format!(
                "task `{}` finished without its checkpoint of step {end}, where another stage continues; its newest one is {newest}",
                task.id
            )))
        }
    }
}

/// The event that replaces one that the store refuses permanently.
pub fn refused_for_good(event: &Event, error: &WriteError) -> Option<Event> {
    let (message, is_missing) = match error {
        WriteError::Conflict(message) | WriteError::Gate(message) => (message.clone(), false),
        WriteError::NotFound(message) => (message.clone(), true),
        WriteError::StaleFence { .. }
        | WriteError::Superseded { .. }
        | WriteError::Storage(_)
        | WriteError::Unproven { .. }
        | WriteError::Unreachable(_)
        | WriteError::Internal(_) => return None,
    };
    let failed = |grant: &Grant| {
        // A missing artifact was collected between its upload and its report, or never arrived; another attempt within
        // the budget uploads it again. A conflict is a second value for the same key, which another computation would
        // not repair.
        let class = if is_missing { FailureClass::Fault } else { FailureClass::Storage };
        let outcome = TaskOutcome::Failed { class, message: message.clone() };
        Some(Event::Outcome { report: ReportOutcome::new(grant.clone(), outcome) })
    };
    match event {
        Event::Bundled { key, .. } => Some(Event::RegisterRefused { key: *key, message }),
        Event::Outcome { report } => failed(&report.grant),
        Event::Checkpoint { commit } => failed(&commit.grant),
        _ => None,
    }
}
