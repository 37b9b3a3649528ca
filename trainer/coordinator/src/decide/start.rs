//! Recovery after a start of the coordinator.

use std::sync::Arc;

use protocol::message::RunState;
use protocol::{Digest, WorkerId};

use super::attempts::Loss;
use super::deciding::Deciding;
use crate::event::Effect;
use crate::fact::Fact;
use crate::state::execution::ExecutionState;
use crate::state::worker::Sign;

impl Deciding<'_> {
    pub(crate) fn started(&mut self, alone: bool, park: bool) {
        let now = self.now();
        let before = self.state.now;
        self.record(Fact::Draining { draining: false });
        let keys: Vec<Digest> = self.state.executions.keys().copied().collect();
        for key in keys {
            let execution = Arc::clone(&self.state.executions[&key]);
            // Time without a running coordinator does not count as work.
            if let Some(since) = execution.busy_since {
                let wall_ms = execution.wall_ms + before.since(since);
                self.record(Fact::ExecutionTime { key, wall_ms, busy_since: None, idle_since: Some(now) });
            }
            // Workers that are still busy continue undisturbed.
            if execution.state == ExecutionState::Open && execution.has_something() && (alone || !execution.is_busy()) {
                self.resumed(key);
            }
            match execution.state {
                ExecutionState::Looking => self.effects.push(Effect::Lookup { key }),
                ExecutionState::Bundling => {
                    let registration = execution.registration.as_ref().expect("bundling is registering");
                    self.effects.push(self.registering(&execution, registration));
                }
                ExecutionState::Open
                | ExecutionState::Mending { .. }
                | ExecutionState::Done { .. }
                | ExecutionState::Failed { .. } => {}
            }
        }
        let names: Vec<WorkerId> = self.state.workers.keys().cloned().collect();
        for worker in names {
            if alone {
                self.set_presence(&worker, Sign::Gone);
                self.drop_worker(&worker, Loss::Restart);
                self.record(Fact::WorkerForgotten { worker });
            } else {
                self.state.heard.workers.insert_mut(worker, now);
            }
        }
        if park {
            for run in self.state.runs.values().cloned().collect::<Vec<_>>() {
                if run.state == RunState::Running {
                    self.set_run_state(run.number, RunState::Paused, true);
                }
            }
        }
        // The limits may have changed since the last start.
        self.admit_all();
    }
}
