//! Recomputation of inputs that a worker found damaged or missing; their readers wait.
//!
//! Runs keep their values meanwhile, because recomputation gives the same value. Only executions in memory can be
//! recomputed, which are all of a run since its submission. The next submission finds other damage.

use std::collections::BTreeMap;
use std::sync::Arc;

use protocol::{Digest, StageName};

use super::deciding::Deciding;
use crate::event::Effect;
use crate::fact::Fact;
use crate::state::execution::ExecutionState;

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
        for (giver, (number, stage)) in &givers {
            let execution = Arc::clone(&self.state.executions[giver]);
            let run = Arc::clone(&self.state.runs[number]);
            // Another reader may have found the damage before.
            if execution.is_over() {
                self.want_again(&execution, &run, stage, true);
                self.effects.push(Effect::Lookup { key: *giver });
            }
        }
        self.record(Fact::ExecutionState {
            key,
            state: ExecutionState::Mending { inputs: givers.into_keys().collect() },
        });
    }

    /// The executions that produced the inputs of an execution, each with a run and a stage that have its value.
    fn givers(&self, key: Digest) -> BTreeMap<Digest, (u64, StageName)> {
        let execution = &self.state.executions[&key];
        let mut givers = BTreeMap::new();
        for (number, stage) in &execution.users {
            let Some(run) = self.state.runs.get(number) else { continue };
            for input in &run.pipeline.stages[*stage].inputs {
                let Some(status) = run.status(&input.stage) else { continue };
                let (Some(giver), Some(known)) = (status.key(), status.known()) else { continue };
                let is_read = known.outputs.values().any(|output| execution.inputs.values().any(|read| read == output));
                if is_read && self.state.executions.contains_key(&giver) {
                    givers.insert(giver, (run.number, input.stage.clone()));
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
                    Some(_) => None,
                    None => Some("it is no longer known".to_owned()),
                });
                let is_whole = inputs.iter().all(|input| matches!(state(input), Some(ExecutionState::Done { .. })));
                if let Some(why) = failed {
                    self.fail_execution(key, format!("a damaged input could not be recomputed: {why}"), false);
                } else if is_whole {
                    self.record(Fact::ExecutionState { key, state: ExecutionState::Open });
                }
            }
        }
    }
}
