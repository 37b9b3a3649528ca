//! What workers and clients are told. Read-only.

use protocol::message::{
    Assignment, DesiredAssignments, Prepare, Progress, Role, RunState, RunView, StageState, StageTask, StageView,
};
use protocol::stage::Backend;
use protocol::{Generation, Incarnation, TaskId, WorkerId, canonical};
use serde::{Deserialize, Serialize};

use crate::rejected::Rejected;
use crate::state::State;
use crate::state::execution::{ExecutionState, StageExecution};
use crate::state::run::{Run, Status};
use crate::state::task::{Lease, Part, Task};
use crate::state::worker::{Presence, Worker};
use crate::time::Millis;

/// A worker as clients see it: `GET /v1/workers`.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct WorkerView {
    /// Who.
    pub worker: WorkerId,
    /// Which process of that name.
    pub incarnation: Incarnation,
    /// Its process id.
    pub pid: u32,
    /// Where it computes.
    pub backend: Backend,
    /// What its kernels dispatch to, such as `avx512`.
    pub instruction_set: String,
    /// `idle`, `working`, `unreachable`, `silent` or `gone`.
    pub state: String,
    /// What it works on.
    pub task: Option<TaskId>,
}

impl State {
    /// All workers.
    pub fn worker_views(&self) -> Vec<WorkerView> {
        let view = |(name, worker): (&WorkerId, &Worker)| {
            let task = self.held_by(name).map(|(_, task)| task.id.clone());
            let state = match (worker.presence, &task) {
                (Presence::Here, None) => "idle",
                (Presence::Here, Some(_)) => "working",
                (Presence::Suspect { .. }, _) => "unreachable",
                (Presence::Silent, _) => "silent",
                (Presence::Gone, _) => "gone",
            };
            WorkerView {
                worker: name.clone(),
                incarnation: worker.incarnation,
                pid: worker.pid,
                backend: worker.backend,
                instruction_set: worker.instruction_set.clone(),
                state: state.to_owned(),
                task,
            }
        };
        self.workers.iter().map(view).collect()
    }

    /// All that a worker process should be doing.
    pub fn desired(&self, worker: &WorkerId, incarnation: Incarnation) -> Result<DesiredAssignments, Rejected> {
        let known = self.process(worker, incarnation)?;
        let held = self.held_by(worker).and_then(|(execution, task)| assignment(execution, task, worker, incarnation));
        let assignments: Vec<Assignment> = held.into_iter().collect();
        let held_nothing = assignments.is_empty();
        let leave = self.draining && assignments.is_empty();
        // A new checkpoint is not news for the worker that made it, so it does not end a wait.
        let news: Vec<Assignment> =
            assignments.iter().map(|assignment| Assignment { resume: None, ..assignment.clone() }).collect();
        let prepare = if held_nothing && !self.draining { self.to_prepare(known) } else { Vec::new() };
        let digest = canonical::digest(&(&news, &prepare, leave));
        // 53 bits, so that no JSON reader rounds it.
        let version = digest.as_bytes()[..8].iter().fold(0, |number, byte| number << 8 | u64::from(*byte)) >> 11;
        Ok(DesiredAssignments { version, assignments, prepare, leave })
    }

    /// What a worker that has nothing to do should fetch.
    fn to_prepare(&self, worker: &Worker) -> Vec<Prepare> {
        /// A worker takes one of them in the end.
        const AT_ONCE: usize = 8;
        if worker.presence != Presence::Here {
            return Vec::new();
        }
        let open = self.open_gangs.iter().filter_map(|(key, i)| {
            let execution = self.executions.get(key).filter(|execution| execution.takes(worker))?;
            let task = execution.tasks.get(*i)?;
            // A member that joins others is handed their state.
            let resume = if task.is_held() { None } else { task.newest().map(|saved| saved.manifest) };
            Some(Prepare { task: task.id.clone(), inputs: execution.inputs.clone(), resume })
        });
        open.take(AT_ONCE).collect()
    }

    /// A run as clients see it at `now`.
    pub fn view(&self, run: &Run, now: Millis) -> RunView {
        let stages = (0..run.stages.len()).map(|i| self.stage_view(run, i, now)).collect();
        let sweeps = run.sweeps.iter().map(|sweep| self.sweep_view(run, sweep)).collect();
        RunView { run: run.id.clone(), pipeline: run.pipeline.name.clone(), state: run.state, stages, sweeps }
    }

    fn stage_view(&self, run: &Run, i: usize, now: Millis) -> StageView {
        let (stage, status) = (&run.pipeline.stages[i], &run.stages[i]);
        let execution = self.execution_of(run, &stage.name).map(|execution| &**execution);
        let mut view = StageView {
            name: stage.name.clone(),
            kind: stage.settings.kind().to_owned(),
            state: StageState::Waiting,
            key: status.key(),
            outputs: Default::default(),
            metrics: Default::default(),
            progress: Progress::default(),
            wall_s: execution.map_or(0.0, |execution| execution.wall_s(now)),
            attempt: execution.map(StageExecution::attempt).unwrap_or_default(),
            workers: Vec::new(),
            instruction_set: execution.and_then(|execution| execution.instruction_set.clone()),
            message: None,
            of: stage.derived.as_ref().map(|derived| derived.of.clone()),
        };
        match status {
            Status::Waiting => {}
            Status::Sweeping => {
                view.state = StageState::Running;
                if let Some(sweep) = run.sweep(i) {
                    let sweep = self.sweep_view(run, sweep);
                    let progress = Progress {
                        done: sweep.spent,
                        total: sweep.planned,
                        unit: "steps".into(),
                        ..Default::default()
                    };
                    (view.progress, view.message) = (progress, Some(crate::sweep::in_words(&sweep)));
                }
            }
            Status::Active { .. } => {
                if let Some(execution) = execution {
                    view.workers = workers(execution);
                    view.progress = self.progress(execution);
                    view.metrics = view.progress.metrics.clone();
                    (view.state, view.message) = self.active(run, execution);
                }
            }
            Status::Done { how, known, wall_s, attempt, .. } => {
                view.state = *how;
                view.outputs = known.outputs.clone();
                view.metrics = known.metrics.clone();
                (view.wall_s, view.attempt) = (*wall_s, *attempt);
                view.progress = execution.map(|execution| self.progress(execution)).unwrap_or_default();
            }
            Status::Failed { message, .. } => {
                view.state = StageState::Failed;
                view.message = Some(message.clone());
            }
            Status::Skipped { reason, .. } => {
                view.state = StageState::Skipped;
                view.message = Some(reason.clone());
            }
        }
        view
    }

    fn active(&self, run: &Run, execution: &StageExecution) -> (StageState, Option<String>) {
        let held = execution.is_busy();
        match execution.state {
            ExecutionState::Looking => (StageState::Ready, None),
            ExecutionState::Mending { .. } => {
                (StageState::Ready, Some("waits for a damaged input to be made again".to_owned()))
            }
            ExecutionState::Bundling => (StageState::Running, None),
            ExecutionState::Open if held => (StageState::Running, None),
            ExecutionState::Open if run.state == RunState::Paused => (StageState::Ready, Some("paused".to_owned())),
            ExecutionState::Open => {
                let backing_off =
                    execution.tasks.iter().any(|task| matches!(task.lease, Lease::Waiting { not_before: Some(_) }));
                let waits_for = if backing_off {
                    format!("tries again soon (attempt {} failed)", execution.attempt())
                } else {
                    let min = execution.placement.workers.min.max(1);
                    let set =
                        execution.bound_to().map(|set| format!(" with {set}, as those before")).unwrap_or_default();
                    format!("waits for {min} idle `{}` worker(s){set}", execution.backend.name())
                };
                (StageState::Ready, Some(waits_for))
            }
            ExecutionState::Done { .. } | ExecutionState::Failed { .. } => (StageState::Running, None),
        }
    }

    /// How far a work is: its one task, or the sum over its shards while they are done.
    pub fn progress(&self, execution: &StageExecution) -> Progress {
        let of = |task: &Task| self.heard.progress.get(&task.id).map(|progress| Progress::clone(progress));
        let shards = execution.tasks.iter().filter(|task| matches!(task.part, Part::Shard { .. })).count();
        let done =
            execution.tasks.iter().filter(|task| matches!(task.part, Part::Shard { .. }) && task.output().is_some());
        match (execution.tasks.len(), execution.tasks.first()) {
            (1, Some(task)) => of(task).unwrap_or_default(),
            (_, None) => Progress::default(),
            _ => Progress {
                done: done.count() as u64,
                total: shards as u64,
                unit: "shards".to_owned(),
                metrics: Default::default(),
            },
        }
    }
}

fn workers(execution: &StageExecution) -> Vec<WorkerId> {
    execution.tasks.iter().flat_map(Task::holders).map(|member| member.worker.clone()).collect()
}

fn assignment(
    execution: &StageExecution,
    task: &Task,
    worker: &WorkerId,
    incarnation: Incarnation,
) -> Option<Assignment> {
    let Lease::Held { holders, secret, drain_by } = &task.lease else { return None };
    if !holders.iter().any(|member| member.worker == *worker && member.incarnation == incarnation) {
        return None;
    }
    let role = match task.part {
        Part::Alone => Role::Alone,
        Part::Shard { index, of } => Role::Shard { index, of },
        Part::Merge => Role::Merge { shards: execution.shards().unwrap_or_default() },
        Part::Gang => {
            Role::Member { generation: Generation(task.fence.0), members: holders.clone(), secret: secret.clone() }
        }
    };
    Some(Assignment {
        grant: task.grant_of(worker, incarnation),
        stage: StageTask {
            run: execution.run.clone(),
            name: execution.keyed_as.clone(),
            settings: execution.settings.clone(),
            inputs: execution.inputs.clone(),
            seed: execution.seed,
            checkpoint: execution.placement.checkpoint.clone(),
        },
        role,
        resume: task.newest().map(|saved| saved.manifest),
        drain: drain_by.is_some(),
    })
}
