//! The part of `decide` that follows every event, for the objects that the event touched. Stages take over results of
//! their executions, ready stages start, and unwanted work is asked to drain.

use std::collections::BTreeMap;
use std::sync::Arc;

use protocol::message::{RunState, StageState};
use protocol::stage::{Register, Shape};
use protocol::{Digest, StageName, canonical};

use crate::decide::deciding::Deciding;
use crate::event::Effect;
use crate::fact::Fact;
use crate::register::Registration;
use crate::state::execution::{ExecutionState, StageExecution};
use crate::state::run::{Run, Status};
use crate::state::shared::Set;
use crate::state::tasks::Tasks;
use crate::time::Millis;

impl Deciding<'_> {
    /// Updates every touched run from its executions, until nothing changes.
    pub(crate) fn reconcile(&mut self) {
        while let Some(number) = self.unreconciled.pop_first() {
            if !self.state.runs.contains_key(&number) {
                continue;
            }
            self.state.visits += 1;
            if self.state.runs[&number].state.is_final() {
                self.give_no_longer(number);
            }
            self.go_on_with_whole_inputs(number);
            self.take_over_results(number);
            self.sweep(number);
            let run = &self.state.runs[&number];
            let state = run.state_by_stages();
            let parked = run.parked;
            if state != run.state {
                if state == RunState::Failed {
                    let name = run.failed().map(|j| run.pipeline.stages[j].name.to_string()).unwrap_or_default();
                    self.change_run(number, |run| run.skip_rest(&format!("stage `{name}` failed")));
                }
                self.set_run_state(number, state, parked);
            }
            self.attach_ready(number);
            // A change marks the run as unreconciled, so the loop visits it again.
        }
    }

    fn take_over_results(&mut self, number: u64) {
        let now = self.now();
        let run = Arc::clone(&self.state.runs[&number]);
        let mut stages = Vec::new();
        for (j, key) in run.all_active() {
            self.count_time_of(key, now);
            let execution = &self.state.executions[&key];
            let status = match &execution.state {
                ExecutionState::Looking
                | ExecutionState::Open
                | ExecutionState::Mending { .. }
                | ExecutionState::Bundling => continue,
                ExecutionState::Failed { message, .. } => Status::Failed { key, message: message.clone() },
                ExecutionState::Done { .. } if execution.resolves => Status::Waiting,
                ExecutionState::Done { known, cached } => {
                    let how = match (cached, execution.resumed) {
                        (true, _) => StageState::Cached,
                        (false, true) => StageState::Resumed,
                        (false, false) => StageState::Ran,
                    };
                    let wall_s = if *cached { 0.0 } else { execution.wall_s(now) };
                    let peak_memory = self.state.peak_memory(execution).filter(|_| !cached);
                    let known = Arc::clone(known);
                    let attempt = execution.attempt();
                    Status::Done { key, how, known, wall_s, attempt, peak_memory }
                }
            };
            stages.push((j, status));
        }
        if !stages.is_empty() {
            self.record(Fact::Stages { run: number, stages });
        }
    }

    /// Starts the stages of a running run whose inputs are available.
    fn attach_ready(&mut self, number: u64) {
        let run = Arc::clone(&self.state.runs[&number]);
        if !run.is_at_work() {
            return;
        }
        let mut stages = Vec::new();
        for (j, status) in run.stages.iter().enumerate() {
            if *status == Status::Waiting
                && let Some(inputs) = run.inputs(j)
            {
                let status = if run.pipeline.stages[j].sweep.is_some() {
                    self.begin_sweep(number, j)
                } else if run.is_resolved(j, &inputs) {
                    let key = run.pipeline.identity(&run.pipeline.stages[j], &inputs).key();
                    self.attach(&run, j, inputs, key, false)
                } else {
                    let key = canonical::digest(&("files of a stage", &run.id, &run.pipeline.stages[j].name));
                    self.attach(&run, j, inputs, key, true)
                };
                stages.push((j, status));
            }
        }
        if !stages.is_empty() {
            self.record(Fact::Stages { run: number, stages });
        }
    }

    /// Requests the value of a stage under `key`. With `resolves`, the execution computes only the digests that the
    /// stage's key needs.
    fn attach(&mut self, run: &Run, j: usize, inputs: BTreeMap<String, Digest>, key: Digest, resolves: bool) -> Status {
        let stage = &run.pipeline.stages[j];
        let registration = match stage.settings.get::<Register>().map(|settings| Registration::gather(run, settings)) {
            Some(Ok(registration)) => Some(registration),
            Some(Err(message)) => return Status::Failed { key, message },
            None => {
                assert!(stage.settings.shape() != Shape::Registry, "only `register` changes the registry");
                None
            }
        };
        match self.state.executions.get(&key).cloned() {
            Some(execution) => {
                if execution.placement != stage.placement && self.may_place(run, &execution) {
                    self.record(Fact::ExecutionPlacement { key, placement: stage.placement.clone() });
                }
                let lost = match execution.state {
                    ExecutionState::Looking
                    | ExecutionState::Open
                    | ExecutionState::Mending { .. }
                    | ExecutionState::Bundling => return Status::Active { key },
                    ExecutionState::Done { .. } => true,
                    ExecutionState::Failed { .. } => {
                        if execution.has_something() {
                            self.resumed(key);
                        }
                        false
                    }
                };
                self.want_again(&execution, run, &stage.name, lost);
            }
            None => {
                let execution = StageExecution {
                    key,
                    run: run.id.clone(),
                    stage: stage.name.clone(),
                    keyed_as: pipeline::keyed_as(stage).clone(),
                    settings: stage.settings.clone(),
                    inputs,
                    resolves,
                    seed: run.pipeline.seed,
                    backend: run.pipeline.backend,
                    placement: stage.placement.clone(),
                    registration,
                    state: ExecutionState::Looking,
                    tasks: Tasks::default(),
                    wall_ms: 0,
                    busy_since: None,
                    idle_since: Some(self.now()),
                    resumed: false,
                    instruction_set: None,
                    users: Set::default(),
                };
                self.record(Fact::Execution { execution: Box::new(execution) });
            }
        }
        self.effects.push(Effect::Lookup { key });
        Status::Active { key }
    }

    /// Returns true if `run` may set the number of workers of an execution: no running run of another owner waits for
    /// it.
    fn may_place(&self, run: &Run, execution: &StageExecution) -> bool {
        let others = execution.users.iter().filter_map(|(number, _)| self.state.runs.get(number));
        others.filter(|other| other.is_at_work()).all(|other| run.owner.controls(&other.owner.group()))
    }

    /// Reopens an execution that was over, with full budgets. The store is queried for the value first.
    pub(crate) fn want_again(&mut self, execution: &StageExecution, run: &Run, stage: &StageName, lost_value: bool) {
        let key = execution.key;
        if execution.tasks.is_empty() {
            // No task exists yet; future ones get the ids of this run.
            self.record(Fact::ExecutionSource { key, run: run.id.clone(), stage: stage.clone() });
        }
        for i in 0..execution.tasks.len() {
            self.change(key, i, |task| if lost_value { task.reopen() } else { task.reset_budgets() });
        }
        self.record(Fact::ExecutionState { key, state: ExecutionState::Looking });
    }

    /// Asks holders of unwanted tasks to drain, and those of wanted ones to continue.
    pub(crate) fn drain(&mut self) {
        let deadline = self.now().after(self.state.policy.grace_ms);
        for key in self.touched.clone() {
            let Some(execution) = self.state.executions.get(&key).cloned() else { continue };
            if !execution.tasks.is_any_held() {
                continue;
            }
            self.state.visits += 1;
            let enough = execution.is_enough();
            let carry_on = !self.state.draining && enough && self.state.is_wanted(&execution);
            if !execution.tasks.all_draining(!carry_on) {
                for i in execution.tasks.held() {
                    self.change(key, i, |task| task.drain((!carry_on).then_some(deadline)));
                }
            }
        }
    }

    /// Starts or stops the working time of touched executions.
    pub(crate) fn count_time(&mut self) {
        let now = self.now();
        for key in self.touched.clone() {
            self.count_time_of(key, now);
        }
    }

    fn count_time_of(&mut self, key: Digest, now: Millis) {
        let Some(execution) = self.state.executions.get(&key) else { return };
        let wall_ms = execution.wall_ms;
        let time = match (execution.is_busy(), execution.busy_since) {
            (true, None) => Fact::ExecutionTime { key, wall_ms, busy_since: Some(now), idle_since: None },
            (false, Some(since)) => {
                let wall_ms = wall_ms + now.since(since);
                Fact::ExecutionTime { key, wall_ms, busy_since: None, idle_since: Some(now) }
            }
            (true, Some(_)) | (false, None) => return,
        };
        self.record(time);
    }
}
