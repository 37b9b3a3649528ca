//! Gangs that cannot go on as they are: complaints, members that fail or hang, and what that means for those who stay.

use std::sync::Arc;

use protocol::message::{LossCause, Member};
use protocol::{Digest, Fence, TaskId, WorkerId};

use super::attempts::Loss;
use super::deciding::Deciding;
use crate::fact::Fact;
use crate::rejected::Rejected;
use crate::state::evidence::{self, Leaver, Quarrel, Verdict};
use crate::state::task::{Part, Task};
use crate::state::worker::Sign;

impl Deciding<'_> {
    /// Takes members out of a gang of which some complain of others; `false` if that is over, or not all has been heard.
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
        let (now, hearing_ms) = (self.now(), self.state.policy.hearing_ms);
        let judge = |slow| Quarrel::of(&words, task, slow).verdict(now, hearing_ms, &suspicions);
        let mut verdict = judge(true);
        // A slow member is better than too few.
        if let Verdict::Leave(leavers) = &verdict
            && members.len() - leavers.len() < execution.range().min.max(1)
            && leavers.iter().any(|leaver| leaver.cause == LossCause::Slow)
        {
            verdict = judge(false);
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

    /// Takes out the member that a gang waits for without end.
    pub(crate) fn gang_stalled(&mut self, task: &TaskId, fence: Fence) -> Result<bool, Rejected> {
        let (now, stall_ms) = (self.now(), self.state.policy.stall_ms);
        let (key, i) = self.place(task)?;
        let task = &self.state.executions[&key].tasks[i];
        let Some(rank) = evidence::hung(&self.state.heard.words, task, now, stall_ms).filter(|_| task.fence == fence)
        else {
            return Ok(false);
        };
        let worker = task.holders()[rank].worker.clone();
        // What it holds is all there is.
        if !self.goes_on_without(task, &worker) {
            return Ok(false);
        }
        tracing::warn!(task = %task.id, %worker, "its gang has not had a step more for {} s and waits for it", stall_ms / 1000);
        self.leave(key, i, &worker, LossCause::Unreachable);
        Ok(true)
    }

    /// Takes a member out of its gang for a while.
    pub(crate) fn leave(&mut self, key: Digest, i: usize, worker: &WorkerId, cause: LossCause) {
        self.suspect(worker, cause);
        self.take_from(key, i, std::slice::from_ref(worker), Loss::Lost);
    }

    /// Whether a gang has what is in memory without `worker`: another member holds the state.
    pub(crate) fn goes_on_without(&self, task: &Task, worker: &WorkerId) -> bool {
        let others = task.holders().iter().filter(|member| member.worker != *worker);
        task.part == Part::Gang
            && others.into_iter().any(|member| evidence::holds(&self.state.heard.words, task, member).is_some())
    }

    /// Whether `worker` is known to hold the state of a task.
    pub(crate) fn has_state(&self, task: &Task, worker: &WorkerId) -> bool {
        let mut members = task.holders().iter().filter(|member| member.worker == *worker);
        members.any(|member| evidence::holds(&self.state.heard.words, task, member).is_some())
    }

    /// Whether one of `members` may have the state: it said so, or has said nothing yet.
    pub(crate) fn may_hold(&self, task: &Task, members: &[Member]) -> bool {
        let may =
            |member| evidence::word(&self.state.heard.words, task, member).is_none_or(|word| word.holds.is_some());
        members.iter().any(may)
    }

    /// Keeps a worker away from others for longer than the last time, unless that was long ago. What it has fetched and whom it reaches it
    /// has to say anew.
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

    /// Counts a suspicion of a worker, after those that have not faded.
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
