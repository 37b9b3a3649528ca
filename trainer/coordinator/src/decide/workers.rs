//! Worker processes: that they come, are heard, fall silent and go.

use std::collections::BTreeSet;

use protocol::message::{Grant, Join};
use protocol::{Incarnation, TaskId, WorkerId};

use super::attempts::Loss;
use super::deciding::Deciding;
use crate::event::Effect;
use crate::fact::Fact;
use crate::rejected::Rejected;
use crate::state::worker::{Sign, Worker};

impl Deciding<'_> {
    pub(crate) fn join(&mut self, join: Join) -> Result<(), Rejected> {
        if !protocol::id::is_name(join.worker.as_str()) {
            return Err(Rejected::Invalid(format!("`{}` is not a worker name", join.worker)));
        }
        self.drop_worker(&join.worker, Loss::Lost);
        let process = Worker::joined(&join, self.state.incarnation.next());
        self.effects.push(Effect::Joined(process.incarnation));
        let now = self.now();
        self.state.heard.workers.insert_mut(join.worker.clone(), now);
        self.record(Fact::Worker { worker: join.worker, process });
        Ok(())
    }

    /// Takes note of what a worker has fetched ahead; `false` if all of that is known or over.
    pub(crate) fn ready(
        &mut self,
        worker: WorkerId,
        incarnation: Incarnation,
        tasks: Vec<TaskId>,
    ) -> Result<bool, Rejected> {
        let known = self.state.process(&worker, incarnation)?;
        let ready: BTreeSet<TaskId> = tasks.into_iter().filter(|task| self.state.tasks.contains_key(task)).collect();
        if ready.is_subset(&known.ready) {
            return Ok(false);
        }
        let process = Worker { ready, ..known.clone() };
        self.record(Fact::Worker { worker, process });
        Ok(true)
    }

    /// Takes note of a sign of a known worker; `false` if it says nothing new.
    pub(crate) fn sign(&mut self, worker: &WorkerId, sign: Sign) -> Result<bool, Rejected> {
        let known = self.state.workers.get(worker);
        let known = known.ok_or_else(|| Rejected::NotFound(format!("worker `{worker}` is not known")))?;
        if known.presence.after(sign, self.now()) == known.presence {
            return Ok(false);
        }
        self.set_presence(worker, sign);
        Ok(true)
    }

    pub(crate) fn set_presence(&mut self, worker: &WorkerId, sign: Sign) {
        let now = self.now();
        let Some(known) = self.state.workers.get(worker) else { return };
        let mut process = known.clone();
        process.presence = process.presence.after(sign, now);
        process.suspicions += u32::from(sign == Sign::PeersLost);
        if process != *known {
            self.record(Fact::Worker { worker: worker.clone(), process });
        }
    }

    /// A member of a gang says whom it cannot reach; `false` if those are no members any more.
    pub(crate) fn peers_lost(&mut self, grant: &Grant, lost: &[WorkerId]) -> Result<bool, Rejected> {
        let (_, task) = self.state.task(&grant.task)?;
        task.check(grant)?;
        let members = task.holders().iter().map(|member| &member.worker);
        let lost: Vec<WorkerId> =
            members.filter(|worker| **worker != grant.worker && lost.contains(worker)).cloned().collect();
        if lost.is_empty() {
            return Ok(false);
        }
        self.suspect(&grant.task, &lost)?;
        Ok(true)
    }

    /// Takes members out of a gang whose peers cannot reach them.
    pub(crate) fn suspect(&mut self, task: &TaskId, lost: &[WorkerId]) -> Result<(), Rejected> {
        for worker in lost {
            self.set_presence(worker, Sign::PeersLost);
        }
        let (key, i) = self.place(task)?;
        self.take_from(key, i, lost, Loss::Lost);
        Ok(())
    }

    pub(crate) fn drop_worker(&mut self, worker: &WorkerId, loss: Loss) {
        if let Some((key, i)) = self.state.workers.get(worker).and_then(|worker| worker.holds) {
            self.take_from(key, i, std::slice::from_ref(worker), loss);
        }
    }
}
