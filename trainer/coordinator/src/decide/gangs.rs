//! Failures within gangs: complaints, failing or hung members, and the consequences for the remaining members.

use std::sync::Arc;

use protocol::message::{LossCause, Member};
use protocol::{Digest, Fence, TaskId, WorkerId};

use super::attempts::Loss;
use super::deciding::Deciding;
use crate::fact::Fact;
use crate::rejected::Rejected;
use crate::state::State;
use crate::state::evidence::{self, Complaints, Leaver, Verdict};
use crate::state::task::{Part, Task};
use crate::state::worker::Sign;

impl Deciding<'_> {
    /// Removes members from a gang with complaints. Returns `false` if the complaint is obsolete or the hearing is
    /// still open.
    pub(crate) fn gang_divided(&mut self, task: &TaskId, fence: Fence) -> Result<bool, Rejected> {
        let (key, i) = self.place(task)?;
        let execution = Arc::clone(&self.state.executions[&key]);
        let task = &execution.tasks[i];
        if task.fence != fence || !task.is_held() {
            return Ok(false);
        }
        let members = task.holders();
        let words = Arc::clone(&self.state.heard.words);
        let suspicions: Vec<u32> =
            members.iter().map(|member| self.state.workers.get(&member.worker).map_or(0, |w| w.suspicions)).collect();
        let now = self.now();
        let hearing_ms = self.state.policy.hearing_ms;
        let verdict_of = |slow| Complaints::of(&words, task, slow).verdict(now, hearing_ms, &suspicions);
        let mut verdict = verdict_of(true);
        // A gang with a slow member is better than one with too few members.
        if let Verdict::Leave(leavers) = &verdict
            && members.len() - leavers.len() < execution.range().min.max(1)
            && leavers.iter().any(|leaver| leaver.cause == LossCause::Slow)
        {
            verdict = verdict_of(false);
        }
        let leavers = match verdict {
            Verdict::Open => return Ok(false),
            Verdict::Leave(leavers) if leavers.is_empty() => return Ok(false),
            Verdict::Leave(leavers) => leavers,
        };
        let gone: Vec<WorkerId> = leavers.iter().map(|leaver| members[leaver.rank].worker.clone()).collect();
        for Leaver { rank, cause, accuser } in leavers {
            self.suspect(&members[rank].worker, cause);
            if let Some(accuser) = accuser {
                self.weigh_on(&members[accuser].worker);
            }
        }
        self.take_from(key, i, &gone, Loss::Lost);
        Ok(true)
    }

    /// Removes a hung member that the rest of its gang waits for.
    pub(crate) fn gang_stalled(&mut self, task: &TaskId, fence: Fence) -> Result<bool, Rejected> {
        let now = self.now();
        let stall_ms = self.state.policy.stall_ms;
        let (key, i) = self.place(task)?;
        let task = &self.state.executions[&key].tasks[i];
        let Some(rank) = evidence::hung(&self.state.heard.words, task, now, stall_ms).filter(|_| task.fence == fence)
        else {
            return Ok(false);
        };
        let worker = task.holders()[rank].worker.clone();
        // Its state is the only copy.
        if !self.state.goes_on_without(task, &worker) {
            return Ok(false);
        }
        tracing::warn!(task = %task.id, %worker, "the gang has made no step for {} s and waits for this worker; \
            removing it from the gang", stall_ms / 1000);
        self.leave(key, i, &worker, LossCause::Unreachable);
        Ok(true)
    }

    /// Removes a member from its gang for a while.
    pub(crate) fn leave(&mut self, key: Digest, i: usize, worker: &WorkerId, cause: LossCause) {
        self.suspect(worker, cause);
        self.take_from(key, i, std::slice::from_ref(worker), Loss::Lost);
    }

    /// Returns true if `worker` is known to hold the state of a task.
    pub(crate) fn has_state(&self, task: &Task, worker: &WorkerId) -> bool {
        let mut members = task.holders().iter().filter(|member| member.worker == *worker);
        members.any(|member| evidence::holds(&self.state.heard.words, task, member).is_some())
    }

    /// Returns true if one of `members` may hold the state: it has reported so, or has reported nothing yet.
    pub(crate) fn may_hold(&self, task: &Task, members: &[Member]) -> bool {
        let may =
            |member| evidence::word(&self.state.heard.words, task, member).is_none_or(|word| word.holds.is_some());
        members.iter().any(may)
    }

    /// Shuns a worker, longer than the last time unless that was long ago. It has to report again which inputs it has
    /// and which members it reaches.
    fn suspect(&mut self, worker: &WorkerId, cause: LossCause) {
        let now = self.now();
        self.weigh_on(worker);
        let Some(known) = self.state.workers.get(worker) else { return };
        let mut process = known.clone();
        process.presence = process.presence.after(Sign::PeersLost, now);
        process.shunned = Some(now.after(self.state.policy.shunned_ms(cause, process.suspicions)));
        process.ready.clear();
        self.record(Fact::Worker { worker: worker.clone(), process });
    }

    /// Adds one suspicion of a worker, after dropping faded ones.
    fn weigh_on(&mut self, worker: &WorkerId) {
        let now = self.now();
        let Some(known) = self.state.workers.get(worker) else { return };
        let mut process = known.clone();
        let faded = process.suspected.map_or(0, |then| now.since(then) / self.state.policy.fade_ms.max(1));
        let left = process.suspicions.saturating_sub(u32::try_from(faded).unwrap_or(u32::MAX));
        process.suspicions = left.saturating_add(1);
        process.suspected = Some(now);
        self.record(Fact::Worker { worker: worker.clone(), process });
    }
}

impl State {
    /// Returns true if a gang keeps its state in memory without `worker`, because another member holds it.
    pub(crate) fn goes_on_without(&self, task: &Task, worker: &WorkerId) -> bool {
        let others = task.holders().iter().filter(|member| member.worker != *worker);
        task.part == Part::Gang
            && others.into_iter().any(|member| evidence::holds(&self.heard.words, task, member).is_some())
    }
}
