//! Removal of ended runs and unused executions from memory; their data stays in the tables.

use registry::Write;

use super::deciding::Deciding;
use super::runs::word;
use crate::fact::Fact;
use crate::state::execution::ExecutionState;

impl Deciding<'_> {
    /// Removes ended runs, then executions without a waiting run and without a busy worker.
    pub(crate) fn forget(&mut self) {
        for number in std::mem::take(&mut self.runs) {
            let Some(run) = self.state.runs.get(&number).filter(|run| run.state.is_final()).cloned() else { continue };
            let view = self.state.view(&run, self.now());
            self.writes.push(Write::RunEnded {
                run: run.id.clone(),
                state: word(run.state),
                view: serde_json::to_string(&view).expect("a view serialises"),
                archive: serde_json::to_string(&*run).expect("a run serialises"),
            });
            self.record(Fact::RunForgotten { run: number });
        }
        for key in std::mem::take(&mut self.touched) {
            let Some(execution) = self.state.executions.get(&key).cloned() else { continue };
            if !execution.users.is_empty() || execution.is_busy() {
                continue;
            }
            let is_done = matches!(execution.state, ExecutionState::Done { .. });
            if !is_done && execution.attempt().0 > 0 {
                self.writes.push(Write::Archive {
                    key,
                    run: execution.run.clone(),
                    stage: execution.stage.clone(),
                    execution: Some(serde_json::to_string(&*execution).expect("an execution serialises")),
                });
            }
            self.record(Fact::ExecutionForgotten { key });
        }
    }
}
