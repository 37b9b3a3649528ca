//! The part of `decide` that follows every event, for what the event touched: stages take over what their work gave, stages whose inputs are there
//! begin, and work that nobody waits for is asked to drain.

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
    /// Brings every run that was touched up to date with its executions, until nothing moves.
    pub(crate) fn reconcile(&mut self) {
        while let Some(number) = self.unreconciled.pop_first() {
            if !self.state.runs.contains_key(&number) {
                continue;
            }
            self.state.visits += 1;
            self.go_on_with_whole_inputs(number);
            self.take_over_results(number);
            self.sweep(number);
            let run = &self.state.runs[&number];
            let (state, parked) = (run.state_by_stages(), run.parked);
            if state != run.state {
                if state == RunState::Failed {
                    let name = run.failed().map(|j| run.pipeline.stages[j].name.to_string()).unwrap_or_default();
                    self.change_run(number, |run| run.skip_rest(&format!("stage `{name}` failed")));
                }
                self.set_run_state(number, state, parked);
            }
            self.attach_ready(number);
            // Whatever moved has touched the run, so it is looked at again.
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
                    Status::Done { key, how, known: Arc::clone(known), wall_s, attempt: execution.attempt() }
                }
            };
            stages.push((j, status));
        }
        if !stages.is_empty() {
            self.record(Fact::Stages { run: number, stages });
        }
    }

    /// Starts the stages of a running run whose inputs are there.
    fn attach_ready(&mut self, number: u64) {
        let run = Arc::clone(&self.state.runs[&number]);
        if run.state != RunState::Running {
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

    /// Wants the value of a stage under `key`; one that `resolves` is given no value yet, but the digests that its key needs.
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
                    keyed_as: protocol::pipeline::keyed_as(stage).clone(),
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

    /// Whether `run` says how many workers compute a stage: not while another owner's run waits for the same.
    fn may_place(&self, run: &Run, execution: &StageExecution) -> bool {
        let others = execution.users.iter().filter_map(|(number, _)| self.state.runs.get(number));
        others.filter(|other| other.state == RunState::Running).all(|other| run.owner.controls(&other.owner.group()))
    }

    /// Wanted again after it was over: the store is asked first, and budgets are whole again.
    pub(crate) fn want_again(&mut self, execution: &StageExecution, run: &Run, stage: &StageName, lost_value: bool) {
        let key = execution.key;
        if execution.tasks.is_empty() {
            // Nothing was done here; what will be bears the name of who asks.
            self.record(Fact::ExecutionSource { key, run: run.id.clone(), stage: stage.clone() });
        }
        for i in 0..execution.tasks.len() {
            self.change(key, i, |task| if lost_value { task.reopen() } else { task.reset_budgets() });
        }
        self.record(Fact::ExecutionState { key, state: ExecutionState::Looking });
    }

    /// What no running run waits for is asked to drain; what one waits for again carries on.
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

    /// Starts or stops the count of seconds of what was touched.
    pub(crate) fn count_time(&mut self) {
        let now = self.now();
        for key in self.touched.clone() {
            self.count_time_of(key, now);
        }
    }

    fn count_time_of(&mut self, key: Digest, now: Millis) {
        let Some(execution) = self.state.executions.get(&key) else { return };
        let (wall_ms, busy_since) = match (execution.is_busy(), execution.busy_since) {
            (true, None) => (execution.wall_ms, Some(now)),
            (false, Some(since)) => (execution.wall_ms + now.since(since), None),
            (true, Some(_)) | (false, None) => return,
        };
        self.record(Fact::ExecutionTime { key, wall_ms, busy_since });
    }
}
