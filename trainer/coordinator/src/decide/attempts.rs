//! Attempts at tasks: their ends, their successors, and the members with which a gang continues.

use protocol::message::Member;
use protocol::{Digest, Fence, TaskId, WorkerId};

use super::deciding::Deciding;
use crate::fact::Fact;
use crate::rejected::Rejected;
use crate::state::execution::ExecutionState;
use crate::state::gang::{self, Change};
use crate::state::task::{Lease, Part, Task};

/// The reason why a worker no longer holds a task.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Loss {
    /// The worker was lost; this counts against the task's budget.
    Lost,
    /// The coordinator restarted; this counts against no budget.
    Restart,
}

impl Deciding<'_> {
    pub(crate) fn take_from(&mut self, key: Digest, i: usize, lost: &[WorkerId], loss: Loss) {
        let execution = &self.state.executions[&key];
        let task = &execution.tasks[i];
        let change = match task.part {
            Part::Gang => gang::without(task.holders(), lost, execution.range()),
            Part::Alone | Part::Resolve | Part::Shard { .. } | Part::Merge => Change::Disband,
        };
        match change {
            Change::Keep => {}
            Change::Regroup(members) => self.regroup(key, i, members),
            Change::Disband if loss == Loss::Lost && self.saves_first(&task.clone(), lost) => {
                let members = task.holders().iter().filter(|member| !lost.contains(&member.worker)).cloned().collect();
                self.regroup(key, i, members);
            }
            Change::Disband if loss == Loss::Restart => {
                let fence = self.change(key, i, |task| task.release(None));
                self.fences.push(fence);
            }
            Change::Disband => {
                let names: Vec<&str> = lost.iter().map(WorkerId::as_str).collect();
                self.try_again(key, i, &format!("lost worker {}", names.join(", ")), false);
            }
        }
    }

    /// Returns true if a gang with too few members has one with unsaved state. It saves before the gang is disbanded.
    fn saves_first(&self, task: &Task, lost: &[WorkerId]) -> bool {
        let left: Vec<Member> = task.holders().iter().filter(|m| !lost.contains(&m.worker)).cloned().collect();
        task.part == Part::Gang && !left.is_empty() && self.may_hold(task, &left)
    }

    /// Ends an attempt. The next one starts after a back-off. If the budget is spent, the execution fails instead.
    pub(crate) fn try_again(&mut self, key: Digest, i: usize, why: &str, fault: bool) {
        let now = self.now();
        let policy = self.state.policy.clone();
        self.why = Some(why.to_owned());
        let tried = self.change(key, i, |task| {
            let drain_by = matches!(task.lease, Lease::Held { drain_by: Some(_), .. });
            task.streak += 1;
            task.remember_failure();
            let (count, budget, what) = if fault {
                (&mut task.faults, policy.fault_budget, "faults")
            } else {
                (&mut task.losses, policy.infrastructure_budget, "lost workers and network errors")
            };
            *count += u32::from(!drain_by);
            if *count > budget {
                return Err(format!("gave up after {count} {what}; the last one: {why}"));
            }
            Ok(task.release((!drain_by).then(|| now.after(policy.backoff(task.streak)))))
        });
        self.why = None;
        match tried {
            Ok(fence) => self.fences.push(fence),
            Err(message) => self.fail_execution(key, message, fault),
        }
    }

    pub(crate) fn fail_execution(&mut self, key: Digest, message: String, own: bool) {
        self.record(Fact::ExecutionState { key, state: ExecutionState::Failed { message, own } });
        // Release the held tasks: raising their fences stops workers that are still busy with them from writing.
        let held: Vec<usize> = self.state.executions[&key].tasks.held().collect();
        for i in held {
            let fence = self.change(key, i, |task| task.release(None));
            self.fences.push(fence);
        }
    }

    pub(crate) fn regroup(&mut self, key: Digest, i: usize, members: Vec<Member>) {
        let secret = self.secret(&self.state.executions[&key].tasks[i]);
        let fence = self.change(key, i, |task| task.regroup(members, secret));
        self.fences.push(fence);
    }

    /// Derives the secret of a generation: unpredictable, and different for every fence.
    pub(crate) fn secret(&self, task: &Task) -> impl FnOnce(Fence) -> String + use<> {
        let entropy = self.moment.entropy;
        let id = task.id.clone();
        move |fence| Digest::of(format!("{entropy} {id} {fence}").as_bytes()).hex()
    }

    pub(crate) fn grace_over(&mut self, task: &TaskId, fence: Fence) -> Result<bool, Rejected> {
        let now = self.now();
        let (key, i) = self.place(task)?;
        let task = &self.state.executions[&key].tasks[i];
        let over = match task.lease {
            Lease::Held { drain_by, .. } => drain_by.is_some_and(|deadline| deadline <= now) && task.fence == fence,
            Lease::Waiting { .. } | Lease::Done { .. } => false,
        };
        if over {
            let fence = self.change(key, i, |task| task.release(None));
            self.fences.push(fence);
        }
        Ok(over)
    }

    pub(crate) fn backoff_over(&mut self, task: &TaskId) -> Result<bool, Rejected> {
        let now = self.now();
        let (key, i) = self.place(task)?;
        Ok(self.change(key, i, |task| task.end_backoff(now)))
    }
}
