//! Recomputation of inputs that a worker found damaged or missing; their readers wait.
//!
//! Runs keep their values meanwhile, because recomputation gives the same value. Only executions in memory can be
//! recomputed, which are all of a run since its submission. The next submission finds other damage.

use std::collections::BTreeSet;
use std::sync::Arc;

use protocol::Digest;

use super::deciding::Deciding;
use crate::event::Effect;
use crate::fact::Fact;
use crate::state::execution::{ExecutionState, StageExecution};
use crate::state::run::Status;

impl Deciding<'_> {
    /// Handles an attempt at task `i` that found a damaged input. It counts as a fault, which ends the writing to a
    /// disk that damages everything.
    pub(crate) fn mend(&mut self, key: Digest, i: usize, message: &str) {
        let givers = self.givers(key);
        if givers.is_empty() {
            return self.fail_execution(key, message.to_owned(), false);
        }
        self.try_again(key, i, message, true);
        if self.state.executions[&key].state != ExecutionState::Open {
            return;
        }
        // The other tasks read the same inputs.
        for i in self.state.executions[&key].tasks.held().collect::<Vec<_>>() {
            let fence = self.change(key, i, |task| task.release(None));
            self.fences.push(fence);
        }
        for (giver, number, stage) in &givers {
            let run = Arc::clone(&self.state.runs[number]);
            // A resumed run has values of executions that were forgotten with it, and that another run has begun since.
            if !self.state.executions[giver].users.contains(&(*number, *stage)) {
                self.record(Fact::Stages { run: *number, stages: vec![(*stage, run.stages[*stage].clone())] });
            }
            let execution = Arc::clone(&self.state.executions[giver]);
            // Another reader may have found the damage before.
            if execution.is_over() {
                self.want_again(&execution, &run, &run.pipeline.stages[*stage].name, true);
                self.effects.push(Effect::Lookup { key: *giver });
            }
        }
        self.record(Fact::ExecutionState {
            key,
            state: ExecutionState::Mending { inputs: givers.into_iter().map(|(giver, ..)| giver).collect() },
        });
    }

    /// The executions that produced the inputs of an execution, each with all runs that read both, and its stage there.
    fn givers(&self, key: Digest) -> Vec<(Digest, u64, usize)> {
        let execution = &self.state.executions[&key];
        let mut givers = Vec::new();
        for (number, stage) in &execution.users {
            let Some(run) = self.state.runs.get(number) else { continue };
            for input in &run.pipeline.stages[*stage].inputs {
                let Some(gave) = run.position(&input.stage) else { continue };
                let status = &run.stages[gave];
                let (Some(giver), Some(known)) = (status.key(), status.known()) else { continue };
                let is_read = known.outputs.values().any(|output| execution.inputs.values().any(|read| read == output));
                if is_read && self.state.executions.contains_key(&giver) {
                    givers.push((giver, *number, gave));
                }
            }
        }
        givers
    }

    /// Reopens executions whose inputs have been recomputed, and fails those whose inputs cannot be.
    pub(crate) fn go_on_with_whole_inputs(&mut self, number: u64) {
        let run = Arc::clone(&self.state.runs[&number]);
        for (_, key) in run.all_active() {
            let mut waiting = self.state.mended_for(key);
            waiting.push(key);
            for key in waiting {
                let Some(execution) = self.state.executions.get(&key) else { continue };
                let ExecutionState::Mending { inputs } = &execution.state else { continue };
                let state = |input| self.state.executions.get(input).map(|giver| &giver.state);
                let failed = inputs.iter().find_map(|input| match state(input) {
                    Some(ExecutionState::Failed { message, .. }) => Some(message.clone()),
                    _ => None,
                });
                let is_whole = self.are_done(inputs);
                if let Some(why) = failed {
                    self.fail_execution(key, format!("a damaged input could not be recomputed: {why}"), false);
                } else if is_whole {
                    self.record(Fact::ExecutionState { key, state: ExecutionState::Open });
                }
            }
        }
    }

    fn are_done(&self, inputs: &BTreeSet<Digest>) -> bool {
        let is_done = |giver: &Arc<StageExecution>| matches!(giver.state, ExecutionState::Done { .. });
        inputs.iter().all(|input| self.state.executions.get(input).is_some_and(is_done))
    }

    /// Ends the waiting for executions that only ended runs use: these are forgotten. A reader that finds its input still
    /// damaged then asks its own runs' executions, which may have other keys and the same values.
    pub(crate) fn give_no_longer(&mut self, number: u64) {
        let run = Arc::clone(&self.state.runs[&number]);
        for giver in run.stages.iter().filter_map(Status::key) {
            let is_over = |number| self.state.runs.get(number).is_none_or(|run| run.state.is_final());
            let Some(execution) = self.state.executions.get(&giver) else { continue };
            if !execution.users.iter().all(|(number, _)| is_over(number)) {
                continue;
            }
            for key in self.state.waiting_for(giver) {
                let Some(execution) = self.state.executions.get(&key) else { continue };
                let ExecutionState::Mending { inputs } = &execution.state else { continue };
                let mut inputs = inputs.clone();
                if inputs.remove(&giver) {
                    let is_whole = self.are_done(&inputs);
                    let state = if is_whole { ExecutionState::Open } else { ExecutionState::Mending { inputs } };
                    self.record(Fact::ExecutionState { key, state });
                }
            }
        }
    }
}
