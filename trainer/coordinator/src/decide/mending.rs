//! Inputs that a worker found damaged or missing are made again, while what reads them waits.
//!
//! Runs keep their values meanwhile: what is made again is what was there. Only what the coordinator has in memory can be made again, which
//! is all of a run since it was submitted; of others the next submission finds the damage.

use std::collections::BTreeMap;
use std::sync::Arc;

use protocol::{Digest, StageName};

use super::deciding::Deciding;
use crate::event::Effect;
use crate::fact::Fact;
use crate::state::execution::ExecutionState;

impl Deciding<'_> {
    /// A try at task `i` of an execution has found something damaged. It counts as a fault, so that a disk that damages everything is
    /// not written to for ever.
    pub(crate) fn mend(&mut self, key: Digest, i: usize, message: &str) {
        let givers = self.givers(key);
        if givers.is_empty() {
            return self.fail_execution(key, message.to_owned(), false);
        }
        self.try_again(key, i, message, true);
        if self.state.executions[&key].state != ExecutionState::Open {
            return;
        }
        // The others read the same.
        for i in self.state.executions[&key].tasks.held().collect::<Vec<_>>() {
            let fence = self.change(key, i, |task| task.release(None));
            self.fences.push(fence);
        }
        for (giver, (number, stage)) in &givers {
            let (execution, run) = (Arc::clone(&self.state.executions[giver]), Arc::clone(&self.state.runs[number]));
            // Others may have found the damage before.
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

    /// The executions that gave what an execution reads, each with a run and a stage that have it.
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

    /// What waited for its inputs to be made again goes on once they are, and fails if they cannot be.
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
                    None => Some("it is not known any more".to_owned()),
                });
                let is_whole = inputs.iter().all(|input| matches!(state(input), Some(ExecutionState::Done { .. })));
                if let Some(why) = failed {
                    self.fail_execution(key, format!("an input was damaged and could not be made again: {why}"), false);
                } else if is_whole {
                    self.record(Fact::ExecutionState { key, state: ExecutionState::Open });
                }
            }
        }
    }
}
