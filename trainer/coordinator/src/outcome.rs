//! What holders of a task report: checkpoints and ends. The part of `decide` that checks whose word counts.
//!
//! | report \ from | rank 0 (or alone) | another member | an old grant |
//! |---|---|---|---|
//! | checkpoint | committed | refused | refused: stale fence |
//! | finished | done | refused | refused, unless it is the accepted report sent again |
//! | yielded | waits | refused | as above |
//! | failed: infrastructure | tried again | the member leaves the gang | as above |
//! | failed: fault | tried again | tried again | as above |
//! | failed: input, diverged, memory, storage | final | final | as above |

use std::collections::BTreeMap;

use protocol::message::{CommitCheckpoint, FailureClass, ReportOutcome, TaskOutcome};
use protocol::stage::{Keep, StageSettings};
use protocol::sweep::STATE_OUTPUT;
use protocol::{Digest, WorkerId};
use registry::Write;

use crate::decide::{Deciding, result};
use crate::event::{Effect, Known, Rejected};
use crate::state::execution::ExecutionState;
use crate::state::task::{Lease, Part, Saved, Task};

impl Deciding<'_> {
    pub(crate) fn checkpoint(&mut self, commit: CommitCheckpoint) -> Result<bool, Rejected> {
        let CommitCheckpoint { grant, step, manifest, metrics } = commit;
        let (execution, task) = self.state.task(&grant.task)?;
        if task.check(&grant)? != 0 {
            return Err(only_rank_0(&grant.worker, "commits checkpoints"));
        }
        match task.newest() {
            Some(newest) if newest.step == step && newest.manifest == manifest => return Ok(false),
            Some(newest) if newest.step > step => {
                return Err(Rejected::Conflict(format!(
                    "task `{}` has a checkpoint at step {} already; one at step {step} would go back",
                    task.id, newest.step
                )));
            }
            Some(_) | None => {}
        }
        let keep = execution.placement.checkpoint.keep.clone();
        let (key, i) = self.place(&grant.task)?;
        let saved = Saved { step, manifest, metrics: metrics.clone() };
        let dropped = self.state.change(key, i, |task| task.save(saved, &keep));
        if !dropped.is_empty() {
            self.effects.push(Effect::Prune { task: grant.task.clone(), keep });
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
        match &report.outcome {
            TaskOutcome::Finished { output, metrics } => {
                if rank != 0 {
                    return Err(only_rank_0(&worker, "reports the end"));
                }
                self.finished(&report, key, i, *output, metrics.clone())?;
            }
            TaskOutcome::Yielded { .. } => {
                if rank != 0 {
                    return Err(only_rank_0(&worker, "reports the end"));
                }
                let now = self.now();
                let soon = now.after(self.state.policy.backoff_ms);
                self.state.change(key, i, |task| {
                    let asked = matches!(task.lease, Lease::Held { drain_by: Some(_), .. });
                    task.give_back((!asked).then_some(soon));
                });
            }
            TaskOutcome::Failed { class, message } => {
                let fault = match class {
                    FailureClass::Fault => true,
                    FailureClass::Infrastructure => false,
                    FailureClass::Input
                    | FailureClass::Diverged
                    | FailureClass::OutOfMemory
                    | FailureClass::Storage => {
                        let own = *class != FailureClass::Storage;
                        self.fail_execution(key, message.clone(), own);
                        self.accepted(key, i, &report);
                        return Ok(true);
                    }
                };
                if rank != 0 && !fault {
                    self.suspect(&grant.task.clone(), &[worker])?;
                } else {
                    self.try_again(key, i, message, fault);
                }
            }
        }
        self.accepted(key, i, &report);
        Ok(true)
    }

    fn accepted(&mut self, key: Digest, i: usize, report: &ReportOutcome) {
        self.state.change(key, i, |task| task.reported = Some(report.clone()));
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
        self.state.change(key, i, |task| task.finish(output));
        let execution = self.state.execution_mut(key);
        if let Part::Shard { .. } = execution.tasks[i].part {
            self.writes.push(Write::Shard { grant, output });
            return Ok(());
        }
        let name = execution.settings.output().name;
        let mut outputs = BTreeMap::from([(name.to_owned(), output)]);
        outputs.extend(state.map(|state| (STATE_OUTPUT.to_owned(), state)));
        let known = Known { outputs, metrics };
        let write = result(execution, Some(grant), &known, now);
        execution.state = ExecutionState::Done { known, cached: false };
        self.writes.push(write);
        // The value is there: what an interrupted try would have gone on from is of no use any more, but for the last way
        // from one checkpoint to the next, which `trainer run --verify` walks again, and the best, if they were asked for.
        if !self.state.change(key, i, |task| std::mem::take(&mut task.checkpoints)).is_empty() {
            let keep = Keep { latest: 2, ..self.state.executions[&key].placement.checkpoint.keep.clone() };
            self.effects.push(Effect::Prune { task: report.grant.task.clone(), keep });
        }
        Ok(())
    }
}

/// The state that a stage leaves which stops before its schedule's end: the checkpoint of its last step, which every training saves.
fn left_state(settings: &StageSettings, task: &Task) -> Result<Option<Digest>, Rejected> {
    let Some(training) = settings.training().filter(|training| training.stop.is_some()) else { return Ok(None) };
    let end = training.end().0;
    match task.newest() {
        Some(saved) if saved.step == end => Ok(Some(saved.manifest)),
        other => Err(Rejected::Conflict(format!(
            "task `{}` stops at step {end} for another stage to go on from, but its newest checkpoint is of step {:?}",
            task.id,
            other.map(|saved| saved.step)
        ))),
    }
}

fn only_rank_0(worker: &WorkerId, what: &str) -> Rejected {
    Rejected::Conflict(format!("worker `{worker}` is not rank 0 of its gang, which alone {what}"))
}
