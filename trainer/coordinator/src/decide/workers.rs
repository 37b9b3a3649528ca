//! Life of worker processes: join, poll, silence and end.

use std::collections::BTreeSet;

use protocol::message::{Join, Member};
use protocol::{Incarnation, TaskId, WorkerId};

use super::attempts::Loss;
use super::deciding::Deciding;
use crate::event::Effect;
use crate::fact::Fact;
use crate::rejected::Rejected;
use crate::state::evidence;
use crate::state::task::{Lease, Part};
use crate::state::worker::{Identity, Sign, Worker};

impl Deciding<'_> {
    /// Assigns a worker name to a new process, if the old process has ended or is the same.
    pub(crate) fn join(&mut self, join: Join, by: Identity) -> Result<(), Rejected> {
        if !protocol::id::is_name(join.worker.as_str()) {
            return Err(Rejected::Invalid(format!("`{}` is not a worker name", join.worker)));
        }
        join.labels.check().map_err(|error| Rejected::Invalid(error.to_string()))?;
        if let Some(known) = self.state.workers.get(&join.worker) {
            known.gives_way_to(&join.worker, &by)?;
        }
        self.drop_worker(&join.worker, Loss::Lost);
        let process = Worker::joined(&join, by, self.state.incarnation.next());
        self.effects.push(Effect::Joined(process.incarnation));
        let now = self.now();
        self.state.heard.workers.insert_mut(join.worker.clone(), now);
        self.record(Fact::Worker { worker: join.worker, process });
        Ok(())
    }

    /// Notes the tasks whose inputs a worker has fetched. Returns `false` if none is new.
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

    /// Gives no more work to a worker whose process was asked to end. Its gang continues without it if another member
    /// holds the state; otherwise the worker saves first. Returns `false` if it is known to be leaving.
    pub(crate) fn leaves(&mut self, worker: WorkerId, incarnation: Incarnation) -> Result<bool, Rejected> {
        let known = self.state.process(&worker, incarnation)?;
        if known.leaving {
            return Ok(false);
        }
        let process = Worker { leaving: true, ..known.clone() };
        let held = known.holds;
        self.record(Fact::Worker { worker: worker.clone(), process });
        let Some((key, i)) = held else { return Ok(true) };
        let task = &self.state.executions[&key].tasks[i];
        let left: Vec<Member> = task.holders().iter().filter(|member| member.worker != worker).cloned().collect();
        let stays = |member: &Member| self.state.workers.get(&member.worker).is_some_and(Worker::is_available);
        let holds = |member: &Member| evidence::holds(&self.state.heard.words, task, member).is_some();
        let goes_on = task.part == Part::Gang
            && matches!(task.lease, Lease::Held { drain_by: None, .. })
            && left.len() >= self.state.executions[&key].range().min.max(1)
            && left.iter().any(|member| stays(member) && holds(member));
        if goes_on {
            tracing::info!(%worker, task = %task.id, "leaves its gang, which continues");
            self.regroup(key, i, left);
        }
        Ok(true)
    }

    /// Applies a sign to a known worker. Returns `false` if it changes nothing.
    pub(crate) fn sign(&mut self, worker: &WorkerId, sign: Sign) -> Result<bool, Rejected> {
        let known = self.state.workers.get(worker);
        let known = known.ok_or_else(|| Rejected::NotFound(format!("worker `{worker}` is not known")))?;
        let is_over = known.shunned.is_some_and(|until| until <= self.now()) && sign == Sign::Back;
        if known.presence.after(sign, self.now()) == known.presence && !is_over {
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
        process.shunned = process.shunned.filter(|until| sign != Sign::Back || *until > now);
        if process != *known {
            self.record(Fact::Worker { worker: worker.clone(), process });
        }
    }

    pub(crate) fn drop_worker(&mut self, worker: &WorkerId, loss: Loss) {
        if let Some((key, i)) = self.state.workers.get(worker).and_then(|worker| worker.holds) {
            self.take_from(key, i, std::slice::from_ref(worker), loss);
        }
    }
}
