//! Read-only views of the state for workers and clients.

use std::collections::BTreeSet;

use pipeline::PipelineStage;
use protocol::message::{
    Assignment, DesiredAssignments, Prepare, Progress, Role, RunState, RunSummary, RunView, StageState, StageTask,
    StageView,
};
use protocol::stage::{Backend, Shape};
use protocol::units::grouped;
use protocol::{Digest, Generation, Incarnation, Labels, StageName, TaskId, WorkerId, canonical};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use crate::note::note;
use crate::rejected::Rejected;
use crate::state::State;
use crate::state::execution::{ExecutionState, StageExecution};
use crate::state::run::{Run, Status};
use crate::state::task::{Lease, Part, Task};
use crate::state::worker::{Presence, Worker};
use crate::time::Millis;

/// A worker as clients see it: `GET /v1/workers`.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
pub struct WorkerView {
    pub worker: WorkerId,
    /// The number of its newest process.
    pub incarnation: Incarnation,
    /// The operating system's process id.
    pub pid: u32,
    /// The backend that it computes on.
    pub backend: Backend,
    /// The instruction set that its kernels use, such as `avx512`.
    pub instruction_set: String,
    /// `idle`, `working`, `leaving`, `unreachable`, `silent` or `gone`.
    pub state: String,
    /// The task that it holds.
    pub task: Option<TaskId>,
    /// Labels that stages may require.
    #[serde(default, skip_serializing_if = "Labels::is_empty")]
    pub labels: Labels,
}

impl State {
    /// Views of all workers.
    pub fn worker_views(&self) -> Vec<WorkerView> {
        let mut views = Vec::new();
        for (name, worker) in &self.workers {
            let task = self.held_by(name).map(|(_, task)| task.id.clone());
            let state = match (worker.presence, &task) {
                (Presence::Here, None) if worker.leaving => "leaving",
                (Presence::Here, None) => "idle",
                (Presence::Here, Some(_)) => "working",
                (Presence::Suspect { .. }, _) => "unreachable",
                (Presence::Silent, _) => "silent",
                (Presence::Gone, _) => "gone",
            };
            views.push(WorkerView {
                worker: name.clone(),
                incarnation: worker.incarnation,
                pid: worker.pid,
                backend: worker.backend,
                instruction_set: worker.instruction_set.clone(),
                state: state.to_owned(),
                task,
                labels: worker.labels.clone(),
            });
        }
        views
    }

    /// The complete set of assignments of a worker process.
    pub fn desired(&self, worker: &WorkerId, incarnation: Incarnation) -> Result<DesiredAssignments, Rejected> {
        let known = self.process(worker, incarnation)?;
        let held = self.held_by(worker).and_then(|(execution, task)| assignment(execution, task, worker, incarnation));
        let assignments: Vec<Assignment> = held.into_iter().collect();
        let held_nothing = assignments.is_empty();
        let leave = self.draining && assignments.is_empty();
        // The worker made the new checkpoint itself, so a checkpoint must not end its wait.
        let news: Vec<Assignment> =
            assignments.iter().map(|assignment| Assignment { resume: None, ..assignment.clone() }).collect();
        let prepare = if held_nothing && !self.draining { self.to_prepare(known) } else { Vec::new() };
        let digest = canonical::digest(&(&news, &prepare, leave));
        // 53 bits, which JSON readers with double-precision numbers preserve.
        let version = digest.as_bytes()[..8].iter().fold(0, |number, byte| number << 8 | u64::from(*byte)) >> 11;
        Ok(DesiredAssignments { version, assignments, prepare, leave })
    }

    /// The tasks whose inputs an idle worker should fetch.
    fn to_prepare(&self, worker: &Worker) -> Vec<Prepare> {
        /// Limit, because a worker takes only one of them in the end.
        const AT_ONCE: usize = 8;
        if !worker.is_available() {
            return Vec::new();
        }
        let open = self.open_gangs.iter().filter_map(|(key, i)| {
            let execution = self.executions.get(key).filter(|execution| execution.takes(worker))?;
            let task = execution.tasks.get(*i).filter(|task| !task.is_held() || worker.shunned.is_none())?;
            // A member that joins a running gang gets the state from its peers.
            let resume = if task.is_held() { None } else { task.newest().map(|saved| saved.manifest) };
            let inputs = execution.artifacts();
            let peers = task.holders().to_vec();
            Some(Prepare { task: task.id.clone(), inputs, resume, peers })
        });
        open.take(AT_ONCE).collect()
    }

    /// The artifacts and checkpoints that a task reads.
    pub fn read_by(&self, task: &TaskId) -> Result<BTreeSet<Digest>, Rejected> {
        let (execution, task) = self.task(task)?;
        let mut read: BTreeSet<Digest> = execution.inputs.values().copied().collect();
        read.extend(task.checkpoints.iter().map(|saved| saved.manifest));
        if task.part == Part::Merge {
            read.extend(execution.shards().unwrap_or_default());
        }
        Ok(read)
    }

    /// The artifacts and checkpoints that a worker may read: those of the task that it holds, or of the tasks that it prepares for.
    pub fn readable_by(&self, worker: &WorkerId) -> BTreeSet<Digest> {
        if let Some((_, task)) = self.held_by(worker) {
            return self.read_by(&task.id).unwrap_or_default();
        }
        let prepare = self.workers.get(worker).map(|known| self.to_prepare(known)).unwrap_or_default();
        prepare.iter().flat_map(|task| task.inputs.values().copied().chain(task.resume)).collect()
    }

    /// A run as clients see it at `now`.
    pub fn view(&self, run: &Run, now: Millis) -> RunView {
        let mut stages: Vec<StageView> = (0..run.stages.len()).map(|i| self.stage_view(run, i, now)).collect();
        // A sweep may have made thousands of stages, and all of them wait for the same workers.
        for stage in stages.iter_mut().filter(|stage| stage.wants_workers.is_some() && stage.of.is_none()) {
            let place = self.execution_of(run, &stage.name).and_then(|execution| self.where_workers_are(execution));
            if let (Some(message), Some(place)) = (&mut stage.message, place) {
                *message = format!("{message}; {place}");
            }
        }
        let sweeps = run.sweeps.iter().map(|sweep| self.sweep_view(run, sweep)).collect();
        RunView { sweeps, ..self.without_sweeps(run, stages) }
    }

    /// A run as lists show it at `now`, without times.
    pub fn summary(&self, run: &Run, now: Millis) -> RunSummary {
        // Sweeps may have made thousands of stages, which a summary leaves out.
        let main = run.pipeline.stages.iter().enumerate().filter(|(_, stage)| stage.derived.is_none());
        let stages: Vec<StageView> = main.map(|(i, _)| self.stage_view(run, i, now)).collect();
        RunSummary::of(&self.without_sweeps(run, stages))
    }

    fn without_sweeps(&self, run: &Run, stages: Vec<StageView>) -> RunView {
        let queued = run.queued && run.state == RunState::Running;
        let note = if queued { self.why_queued(run) } else { note(run.state, &stages) };
        RunView {
            run: run.id.clone(),
            pipeline: run.pipeline.name.clone(),
            owner: run.owner.clone(),
            state: run.state,
            interrupted: run.is_interrupted(),
            priority: run.submitted.priority,
            queued,
            note,
            stages,
            sweeps: Vec::new(),
            storage: None,
            times: Default::default(),
        }
    }

    fn stage_view(&self, run: &Run, i: usize, now: Millis) -> StageView {
        let stage = &run.pipeline.stages[i];
        let status = &run.stages[i];
        let execution = self.execution_of(run, &stage.name).map(|execution| &**execution);
        let needs: BTreeSet<&StageName> = stage.inputs.iter().map(|input| &input.stage).collect();
        let mut view = StageView {
            name: stage.name.clone(),
            kind: stage.settings.kind().to_owned(),
            state: StageState::Waiting,
            key: status.key(),
            outputs: Default::default(),
            metrics: Default::default(),
            progress: Progress::default(),
            wall_s: execution.map_or(0.0, |execution| execution.wall_s(now)),
            peak_memory: execution.and_then(|execution| self.peak_memory(execution)),
            attempt: execution.map(StageExecution::attempt).unwrap_or_default(),
            workers: Vec::new(),
            instruction_set: execution.and_then(|execution| execution.instruction_set.clone()),
            message: None,
            wants_workers: None,
            of: stage.derived.as_ref().map(|derived| derived.of.clone()),
            copy_of: stage.copy_of.clone(),
            times: Default::default(),
            needs: needs.into_iter().cloned().collect(),
        };
        self.add_status(&mut view, run, i, execution);
        view
    }

    /// Adds what the status of stage `i` knows: state, results, or progress and the reason of waiting.
    fn add_status(&self, view: &mut StageView, run: &Run, i: usize, execution: Option<&StageExecution>) {
        match &run.stages[i] {
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
                    (view.progress, view.message) = (progress, Some(crate::decide::sweep::in_words(&sweep)));
                }
            }
            Status::Active { .. } => {
                if let Some(execution) = execution {
                    view.workers = workers(execution);
                    view.progress = self.progress(execution);
                    view.metrics = view.progress.metrics.clone();
                    (view.state, view.message) = self.active(run, execution);
                    if view.state == StageState::Ready && self.wants_workers(run, execution) {
                        view.wants_workers = Some(execution.placement.workers.min.max(1));
                    }
                }
            }
            Status::Done { how, known, wall_s, attempt, peak_memory, .. } => {
                view.state = *how;
                view.outputs = known.outputs.clone();
                view.metrics = known.metrics.clone();
                (view.wall_s, view.attempt, view.peak_memory) = (*wall_s, *attempt, *peak_memory);
                view.progress = whole(
                    &run.pipeline.stages[i],
                    execution.map(|execution| self.progress(execution)).unwrap_or_default(),
                );
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
    }

    fn active(&self, run: &Run, execution: &StageExecution) -> (StageState, Option<String>) {
        let held = execution.is_busy();
        match execution.state {
            ExecutionState::Looking => (StageState::Ready, None),
            ExecutionState::Mending { .. } => {
                (StageState::Ready, Some("waits for the recomputation of a damaged input".to_owned()))
            }
            ExecutionState::Bundling => (StageState::Running, None),
            ExecutionState::Open if held => (StageState::Running, None),
            ExecutionState::Open if run.is_interrupted() || self.draining => {
                (StageState::Ready, interrupted_at(execution))
            }
            ExecutionState::Open if run.state == RunState::Paused => (StageState::Ready, Some("paused".to_owned())),
            ExecutionState::Open if run.queued => (StageState::Ready, Some("queued".to_owned())),
            ExecutionState::Open if backs_off(execution) => {
                (StageState::Ready, Some(format!("retries soon (attempt {} failed)", execution.attempt())))
            }
            ExecutionState::Open => {
                let min = execution.placement.workers.min.max(1);
                let workers = if min == 1 { "worker" } else { "workers" };
                let set = execution
                    .bound_to()
                    .map(|set| format!(" with {set}, like the earlier workers"))
                    .unwrap_or_default();
                let requires = &execution.placement.requires;
                let labels = if requires.is_empty() { String::new() } else { format!(" labelled `{requires}`") };
                let backend = execution.backend.name();
                (StageState::Ready, Some(format!("waits for {min} idle `{backend}` {workers}{labels}{set}")))
            }
            ExecutionState::Done { .. } | ExecutionState::Failed { .. } => (StageState::Running, None),
        }
    }

    /// Returns true if a stage could begin and lacks only workers.
    fn wants_workers(&self, run: &Run, execution: &StageExecution) -> bool {
        execution.state == ExecutionState::Open && run.is_at_work() && !execution.is_busy() && !self.draining
    }

    /// The highest memory that a worker's process reported for an execution, in bytes.
    pub fn peak_memory(&self, execution: &StageExecution) -> Option<u64> {
        let mut peak = None;
        for task in &execution.tasks {
            let reported = task.reported.as_ref().and_then(|report| report.peak_memory);
            peak = peak.max(reported).max(self.heard.memory.get(&task.id).copied());
        }
        peak
    }

    /// The progress of an execution. A single task has its newest report, or without a worker its newest checkpoint.
    /// Several tasks have the number of completed shards.
    pub fn progress(&self, execution: &StageExecution) -> Progress {
        let of = |task: &Task| self.heard.progress.get(&task.id).map(|progress| Progress::clone(progress));
        let shards = execution.tasks.iter().filter(|task| matches!(task.part, Part::Shard { .. })).count();
        let done =
            execution.tasks.iter().filter(|task| matches!(task.part, Part::Shard { .. }) && task.output().is_some());
        match (execution.tasks.len(), execution.tasks.first()) {
            (_, None) => Progress::default(),
            (1, Some(task)) => {
                let saved = saved(task, execution);
                let idle = execution.state == ExecutionState::Open && !execution.is_busy();
                match of(task) {
                    // Work continues at its checkpoint, which can be before or after the last report.
                    // A worker that has just begun has nothing to report yet.
                    Some(heard) if (idle || heard.total == 0) && saved.total > 0 => {
                        Progress { metrics: heard.metrics, ..saved }
                    }
                    Some(heard) => heard,
                    None => saved,
                }
            }
            _ => Progress {
                done: done.count() as u64,
                total: shards as u64,
                unit: "shards".to_owned(),
                metrics: Default::default(),
            },
        }
    }
}

fn backs_off(execution: &StageExecution) -> bool {
    execution.tasks.iter().any(|task| matches!(task.lease, Lease::Waiting { not_before: Some(_) }))
}

/// The progress of a training according to its newest checkpoint.
fn saved(task: &Task, execution: &StageExecution) -> Progress {
    match (task.newest(), execution.settings.training()) {
        (Some(saved), Some(training)) => {
            Progress { done: saved.step, total: training.end().0, unit: "steps".to_owned(), ..Progress::default() }
        }
        (None, _) | (_, None) => Progress::default(),
    }
}

/// Describes the point at which interrupted work continues; `None` if it had not started.
fn interrupted_at(execution: &StageExecution) -> Option<String> {
    let shards = execution.tasks.iter().filter(|task| matches!(task.part, Part::Shard { .. }));
    let (total, done) =
        shards.fold((0, 0), |(total, done), task| (total + 1, done + u64::from(task.output().is_some())));
    if total > 0 && done > 0 {
        return Some(format!("interrupted at {done} of {total} shards"));
    }
    let saved = execution.tasks.iter().find_map(Task::newest).map(|saved| grouped(saved.step));
    match (saved, execution.settings.training()) {
        (Some(step), Some(training)) => Some(format!("interrupted at {step} of {} steps", grouped(training.end().0))),
        (Some(step), None) => Some(format!("interrupted at step {step}")),
        (None, _) if execution.attempt().0 > 0 => Some("interrupted before anything was saved".to_owned()),
        (None, _) => None,
    }
}

/// The progress of a finished stage. The newest report is older than the stage's end, and a short stage may have none.
fn whole(stage: &PipelineStage, reported: Progress) -> Progress {
    let mut progress = reported;
    if progress.total == 0 {
        let (total, unit) = match (stage.settings.training(), stage.settings.shape()) {
            (Some(training), _) => (training.end().0, "steps"),
            (None, Shape::Map) => (u64::from(stage.settings.shards()), "shards"),
            (None, Shape::Gang | Shape::Plain | Shape::Registry) => (0, ""),
        };
        (progress.total, progress.unit) = (total, unit.to_owned());
    }
    progress.done = progress.total;
    progress
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
    let Lease::Held { holders, secret, drain_by, .. } = &task.lease else { return None };
    if !holders.iter().any(|member| member.worker == *worker && member.incarnation == incarnation) {
        return None;
    }
    let role = match task.part {
        Part::Alone => Role::Alone,
        Part::Resolve => Role::Resolve,
        Part::Shard { index, of } => Role::Shard { index, of },
        Part::Merge => Role::Merge { shards: execution.shards().unwrap_or_default() },
        Part::Gang => {
            Role::Member { generation: Generation(task.fence.0), members: holders.clone(), secret: secret.clone() }
        }
    };
    Some(Assignment {
        grant: task.grant_of(worker, incarnation),
        secret: String::new(),
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
