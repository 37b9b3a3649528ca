//! The part of `decide` that follows every event: stages take over what their work gave, stages whose inputs are there
//! begin, and work that nobody waits for is asked to wind down.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;

use protocol::Digest;
use protocol::message::{RunState, StageState};
use protocol::stage::{Register, Shape};

use crate::decide::Deciding;
use crate::event::{Effect, Millis};
use crate::register::Registration;
use crate::state::execution::{ExecutionState, StageExecution};
use crate::state::run::Status;
use crate::state::tasks::Tasks;

impl Deciding<'_> {
    /// Brings every run up to date with its works, until nothing moves.
    pub(crate) fn reconcile(&mut self) {
        for i in 0..self.state.runs.len() {
            loop {
                let mut moved = self.take_over_results(i);
                moved |= self.sweep(i);
                let settled = self.state.runs[i].settled();
                if settled != self.state.runs[i].state {
                    if settled == RunState::Failed {
                        let run = Arc::make_mut(&mut self.state.runs[i]);
                        let name = run.failed().map(|j| run.pipeline.stages[j].name.to_string()).unwrap_or_default();
                        run.skip_rest(&format!("stage `{name}` failed"));
                    }
                    self.set_run_state(i, settled);
                }
                if !self.attach_ready(i) && !moved {
                    break;
                }
            }
        }
    }

    fn take_over_results(&mut self, i: usize) -> bool {
        let now = self.now();
        let mut moved = false;
        for j in 0..self.state.runs[i].stages.len() {
            let Status::Active { key } = self.state.runs[i].stages[j] else { continue };
            self.count_time_of(key, now);
            let execution = &self.state.executions[&key];
            let status = match &execution.state {
                ExecutionState::Looking | ExecutionState::Open | ExecutionState::Bundling => continue,
                ExecutionState::Failed { message, .. } => Status::Failed { key, message: message.clone() },
                ExecutionState::Done { known, cached } => {
                    let how = match (cached, execution.resumed) {
                        (true, _) => StageState::Cached,
                        (false, true) => StageState::Resumed,
                        (false, false) => StageState::Ran,
                    };
                    let wall_s = if *cached { 0.0 } else { execution.wall_s(now) };
                    Status::Done { key, how, known: known.clone(), wall_s, attempt: execution.attempt() }
                }
            };
            Arc::make_mut(&mut self.state.runs[i]).stages[j] = status;
            moved = true;
        }
        moved
    }

    /// Starts the stages of a running run whose inputs are there.
    fn attach_ready(&mut self, i: usize) -> bool {
        if self.state.runs[i].state != RunState::Running {
            return false;
        }
        let mut moved = false;
        for j in 0..self.state.runs[i].stages.len() {
            if self.state.runs[i].stages[j] == Status::Waiting
                && let Some(inputs) = self.state.runs[i].inputs(j)
            {
                let status = if self.state.runs[i].pipeline.stages[j].sweep.is_some() {
                    self.begin_sweep(i, j)
                } else {
                    self.attach(i, j, inputs)
                };
                Arc::make_mut(&mut self.state.runs[i]).stages[j] = status;
                moved = true;
            }
        }
        moved
    }

    fn attach(&mut self, i: usize, j: usize, inputs: BTreeMap<String, Digest>) -> Status {
        let run = Arc::clone(&self.state.runs[i]);
        let stage = &run.pipeline.stages[j];
        let key = run.pipeline.identity(stage, &inputs).key();
        let registration = match stage.settings.get::<Register>().map(|settings| Registration::gather(&run, settings)) {
            Some(Ok(registration)) => Some(registration),
            Some(Err(message)) => return Status::Failed { key, message },
            None => {
                assert!(stage.settings.shape() != Shape::Registry, "only `register` changes the registry");
                None
            }
        };
        match self.state.executions.contains_key(&key).then(|| self.state.execution_mut(key)) {
            Some(execution) => {
                execution.placement = stage.placement.clone();
                match execution.state {
                    ExecutionState::Looking | ExecutionState::Open | ExecutionState::Bundling => {
                        return Status::Active { key };
                    }
                    ExecutionState::Done { .. } => execution.want_again(true),
                    ExecutionState::Failed { .. } => {
                        execution.resumed |= execution.has_something();
                        execution.want_again(false);
                    }
                }
            }
            None => {
                let execution = StageExecution {
                    key,
                    run: run.id.clone(),
                    stage: stage.name.clone(),
                    keyed_as: protocol::pipeline::keyed_as(stage).clone(),
                    settings: stage.settings.clone(),
                    inputs,
                    seed: run.pipeline.seed,
                    backend: run.pipeline.backend,
                    placement: stage.placement.clone(),
                    registration,
                    state: ExecutionState::Looking,
                    tasks: Tasks::default(),
                    wall_ms: 0,
                    busy_since: None,
                    resumed: false,
                };
                self.state.executions.insert(key, Arc::new(execution));
            }
        }
        self.effects.push(Effect::Lookup { key });
        Status::Active { key }
    }

    /// StageExecution that no running run waits for is asked to wind down; work that one waits for again carries on.
    pub(crate) fn drain(&mut self) {
        let deadline = self.now().after(self.state.policy.grace_ms);
        let wanted: BTreeSet<Digest> = self.state.wanted().into_iter().collect();
        for key in self.keys() {
            let carry_on = wanted.contains(&key) && !self.state.draining;
            if !self.state.executions[&key].tasks.all_draining(!carry_on) {
                let held: Vec<usize> = self.state.executions[&key].tasks.held().collect();
                for i in held {
                    self.state.change(key, i, |task| task.drain((!carry_on).then_some(deadline)));
                }
            }
        }
    }

    pub(crate) fn count_time(&mut self) {
        let now = self.now();
        for key in self.keys() {
            self.count_time_of(key, now);
        }
    }

    fn count_time_of(&mut self, key: Digest, now: Millis) {
        let execution = &self.state.executions[&key];
        if execution.is_busy() != execution.busy_since.is_some() {
            self.state.execution_mut(key).count_time(now);
        }
    }
}
