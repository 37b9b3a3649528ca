//! The only writer of durable state: (state, moment, event) to state and effects.
//!
//! Nothing here reads a clock, a socket or a generator. Every event that changes something is journaled in the same
//! transaction as the rows it changes, before any other effect; recovery replays the journal through this very function
//! and drops the effects. After the event itself, every run is settled (stages whose work is over, stages whose inputs
//! are there), work that nobody wants is asked to wind down, and idle workers are given what is ready.

use std::collections::BTreeSet;
use std::sync::Arc;

use protocol::message::{Join, RunState};
use protocol::pipeline::Pipeline;
use protocol::{Digest, Fence, RunId, StageName, TaskId, WorkerId};
use registry::Write;

use crate::event::{Control, Effect, Event, Known, Millis, Moment, Rejected};
use crate::state::State;
use crate::state::execution::{ExecutionState, StageExecution};
use crate::state::gang::{self, Change};
use crate::state::run::Run;
use crate::state::task::{Lease, Part, Task};
use crate::state::worker::{Sign, Worker};
use crate::{journal, schedule};

/// Decides what `event` does. `state` is changed only by an accepted event; an event that changes nothing has no effect
/// but the answer to whoever sent it.
pub fn decide(state: &mut State, moment: Moment, event: Event) -> Result<Vec<Effect>, Rejected> {
    let moment = Moment { now: moment.now.max(state.now), ..moment };
    let entry = journal::entry(&moment, &event);
    let mut cx = Deciding { state, moment, writes: Vec::new(), fences: Vec::new(), effects: Vec::new() };
    if !cx.happen(event)? {
        return Ok(cx.effects);
    }
    cx.state.now = moment.now;
    cx.reconcile();
    cx.drain();
    cx.count_time();
    schedule::schedule(&mut cx);
    cx.count_time();
    let mut writes = vec![Write::Journal(entry)];
    // What a grant vouches for comes before the fences that may end that very grant.
    writes.append(&mut cx.writes);
    writes.append(&mut cx.fences);
    let mut effects = vec![Effect::Store(writes)];
    effects.append(&mut cx.effects);
    effects.push(Effect::Wake);
    Ok(effects)
}

/// A decision under way.
#[derive(Debug)]
pub(crate) struct Deciding<'a> {
    pub(crate) state: &'a mut State,
    pub(crate) moment: Moment,
    pub(crate) writes: Vec<Write>,
    pub(crate) fences: Vec<Write>,
    pub(crate) effects: Vec<Effect>,
}

/// Why a worker no longer holds what it held.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Loss {
    /// It was lost: counts against the task's budget.
    Lost,
    /// The coordinator's own restart: counts against nothing.
    Restart,
}

impl Deciding<'_> {
    pub(crate) fn now(&self) -> Millis {
        self.moment.now
    }

    /// The event itself. `false`: it changes nothing.
    fn happen(&mut self, event: Event) -> Result<bool, Rejected> {
        let now = self.now();
        match event {
            Event::Started { alone, park } => self.started(alone, park),
            Event::Submit { pipeline, source, idempotency_key, until } => {
                return self.submit(*pipeline, source, idempotency_key, until);
            }
            Event::Join { join } => self.join(join)?,
            Event::WorkerBack { worker } => return self.sign(&worker, Sign::Back),
            Event::LeaseExpired { worker, incarnation } => {
                if self.state.process(&worker, incarnation).is_err() || !self.sign(&worker, Sign::LeaseExpired)? {
                    return Ok(false);
                }
                self.drop_worker(&worker, Loss::Lost);
            }
            Event::WorkerGone { worker } => {
                if !self.sign(&worker, Sign::Gone)? {
                    return Ok(false);
                }
                self.drop_worker(&worker, Loss::Lost);
            }
            Event::PeersLost { grant, lost } => {
                let (_, task) = self.state.task(&grant.task)?;
                task.check(&grant)?;
                let lost: Vec<WorkerId> = task
                    .holders()
                    .iter()
                    .map(|member| &member.worker)
                    .filter(|worker| **worker != grant.worker && lost.contains(worker))
                    .cloned()
                    .collect();
                if lost.is_empty() {
                    return Ok(false);
                }
                self.suspect(&grant.task, &lost)?;
            }
            Event::Checkpoint { commit } => return self.checkpoint(commit),
            Event::Outcome { report } => return self.outcome(report),
            Event::Control { run, action } => return self.control(&run, action),
            Event::Drain => {
                if self.state.draining {
                    return Ok(false);
                }
                self.state.draining = true;
            }
            Event::BackoffOver { task } => {
                let (key, i) = self.place(&task)?;
                let over = self.state.change(key, i, |task| match &mut task.lease {
                    Lease::Waiting { not_before } if not_before.is_some_and(|time| time <= now) => {
                        *not_before = None;
                        true
                    }
                    Lease::Waiting { .. } | Lease::Held { .. } | Lease::Done { .. } => false,
                });
                return Ok(over);
            }
            Event::GraceOver { task, fence } => return self.grace_over(&task, fence),
            Event::LookedUp { key, known } => return Ok(self.looked_up(key, known)),
            Event::Bundled { key, bundles } => return self.bundled(key, &bundles),
            Event::RegisterRefused { key, message } => {
                if self.state.executions.get(&key).is_none_or(|execution| execution.state != ExecutionState::Bundling) {
                    return Ok(false);
                }
                self.fail_execution(key, message, true);
            }
        }
        Ok(true)
    }

    fn started(&mut self, alone: bool, park: bool) {
        let (now, before) = (self.now(), self.state.now);
        self.state.draining = false;
        for key in self.keys() {
            let execution = self.state.execution_mut(key);
            // The time during which no coordinator ran is nobody's work.
            if let Some(since) = execution.busy_since.take() {
                execution.wall_ms += before.since(since);
            }
            // Whoever is still at work goes on as if nothing had been.
            if execution.state == ExecutionState::Open && execution.has_something() && (alone || !execution.is_busy()) {
                execution.resumed = true;
            }
            match execution.state {
                ExecutionState::Looking => self.effects.push(Effect::Lookup { key }),
                ExecutionState::Bundling => {
                    let registration = execution.registration.as_ref().expect("bundling is registering");
                    let candidates = registration.candidates.clone();
                    self.effects.push(Effect::Register { key, candidates });
                }
                ExecutionState::Open | ExecutionState::Done { .. } | ExecutionState::Failed { .. } => {}
            }
        }
        let names: Vec<WorkerId> = self.state.workers.keys().cloned().collect();
        for worker in names {
            if alone {
                self.set_presence(&worker, Sign::Gone);
                self.drop_worker(&worker, Loss::Restart);
            } else {
                Arc::make_mut(&mut self.state.heard.workers).insert(worker, now);
            }
        }
        if park {
            for i in 0..self.state.runs.len() {
                if self.state.runs[i].state == RunState::Running {
                    Arc::make_mut(&mut self.state.runs[i]).parked = true;
                    self.set_run_state(i, RunState::Paused);
                }
            }
        }
    }

    fn submit(
        &mut self,
        pipeline: Pipeline,
        source: String,
        key: Option<String>,
        until: Option<StageName>,
    ) -> Result<bool, Rejected> {
        let twin = self.state.runs.iter().find(|run| key.is_some() && run.idempotency_key == key);
        if let Some(twin) = twin {
            self.effects.push(Effect::Submitted(twin.id.clone()));
            return Ok(false);
        }
        check_pipeline(&pipeline, until.as_ref())?;
        let number = self.state.runs.len() as u64 + 1;
        let run = Run::new(number, Arc::new(pipeline), source, key, until);
        let id = run.id.clone();
        for i in 0..self.state.runs.len() {
            let old = &self.state.runs[i];
            if old.parked && old.state == RunState::Paused && old.submitted.digest() == run.submitted.digest() {
                Arc::make_mut(&mut self.state.runs[i]).skip_rest(&format!("taken over by run `{id}`"));
                self.set_run_state(i, RunState::Cancelled);
            }
        }
        self.state.runs.push(Arc::new(run));
        self.write_run(self.state.runs.len() - 1);
        self.effects.push(Effect::Submitted(id));
        Ok(true)
    }

    fn join(&mut self, join: Join) -> Result<(), Rejected> {
        if !protocol::id::is_name(join.worker.as_str()) {
            return Err(Rejected::Invalid(format!("`{}` is not a worker name", join.worker)));
        }
        self.drop_worker(&join.worker, Loss::Lost);
        let last = self.state.workers.get(&join.worker).map(|worker| worker.incarnation).unwrap_or_default();
        let worker = Worker::joined(&join, last.next());
        self.effects.push(Effect::Joined(worker.incarnation));
        let now = self.now();
        Arc::make_mut(&mut self.state.heard.workers).insert(join.worker.clone(), now);
        Arc::make_mut(&mut self.state.unused).insert(join.worker.clone());
        Arc::make_mut(&mut self.state.workers).insert(join.worker, worker);
        Ok(())
    }

    fn control(&mut self, run: &RunId, action: Control) -> Result<bool, Rejected> {
        let i = self.state.run(run)?.number as usize - 1;
        let before = self.state.runs[i].state;
        let Some(after) = self.state.runs[i].after(action) else {
            return Err(Rejected::Conflict(format!("run `{run}` is {before:?} and cannot be asked to {action:?}")));
        };
        let run = Arc::make_mut(&mut self.state.runs[i]);
        run.parked = false;
        if after == before {
            return Ok(false);
        }
        match action {
            Control::Pause => {}
            Control::Cancel => run.skip_rest("cancelled"),
            Control::Resume => run.reopen(),
        }
        self.set_run_state(i, after);
        Ok(true)
    }

    fn looked_up(&mut self, key: Digest, known: Option<Known>) -> bool {
        if self.state.executions.get(&key).is_none_or(|execution| execution.state != ExecutionState::Looking) {
            return false;
        }
        let execution = self.state.execution_mut(key);
        match (known, &execution.registration) {
            (Some(known), _) => execution.state = ExecutionState::Done { known, cached: true },
            (None, Some(registration)) => {
                let candidates = registration.candidates.clone();
                execution.state = ExecutionState::Bundling;
                self.effects.push(Effect::Register { key, candidates });
            }
            (None, None) => {
                execution.open();
                let tasks: Vec<TaskId> = execution.tasks.iter().map(|task| task.id.clone()).collect();
                let places = tasks.into_iter().enumerate().map(|(i, task)| (task, (key, i)));
                Arc::make_mut(&mut self.state.tasks).extend(places);
            }
        }
        true
    }

    fn bundled(&mut self, key: Digest, bundles: &[Digest]) -> Result<bool, Rejected> {
        if self.state.executions.get(&key).is_none_or(|execution| execution.state != ExecutionState::Bundling) {
            return Ok(false);
        }
        let now = self.now();
        let execution = self.state.execution_mut(key);
        let registration = execution.registration.as_ref().expect("bundling is registering");
        if bundles.len() != registration.candidates.len() {
            return Err(Rejected::Invalid(format!("stage `{}` needs a bundle for each candidate", execution.stage)));
        }
        let (known, mut writes) = registration.writes(&execution.run, &execution.stage, bundles);
        writes.push(result(execution, None, &known, now));
        execution.state = ExecutionState::Done { known, cached: false };
        self.writes.append(&mut writes);
        Ok(true)
    }

    fn grace_over(&mut self, task: &TaskId, fence: Fence) -> Result<bool, Rejected> {
        let now = self.now();
        let (key, i) = self.place(task)?;
        let task = &self.state.executions[&key].tasks[i];
        let over = match task.lease {
            Lease::Held { drain_by, .. } => drain_by.is_some_and(|deadline| deadline <= now) && task.fence == fence,
            Lease::Waiting { .. } | Lease::Done { .. } => false,
        };
        if over {
            let fence = self.state.change(key, i, |task| task.release(None));
            self.fences.push(fence);
        }
        Ok(over)
    }

    /// Takes note of a sign of a known worker; `false` if it says nothing new.
    fn sign(&mut self, worker: &WorkerId, sign: Sign) -> Result<bool, Rejected> {
        let known = self.state.workers.get(worker);
        let known = known.ok_or_else(|| Rejected::NotFound(format!("worker `{worker}` is not known")))?;
        let before = known.presence;
        self.set_presence(worker, sign);
        Ok(self.state.workers[worker].presence != before)
    }

    fn set_presence(&mut self, worker: &WorkerId, sign: Sign) {
        let now = self.now();
        if let Some(worker) = Arc::make_mut(&mut self.state.workers).get_mut(worker) {
            worker.presence = worker.presence.after(sign, now);
            worker.suspicions += u32::from(sign == Sign::PeersLost);
        }
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

    fn drop_worker(&mut self, worker: &WorkerId, loss: Loss) {
        if let Some((key, i)) = self.state.workers.get(worker).and_then(|worker| worker.holds) {
            self.take_from(key, i, std::slice::from_ref(worker), loss);
        }
    }

    fn take_from(&mut self, key: Digest, i: usize, lost: &[WorkerId], loss: Loss) {
        let execution = &self.state.executions[&key];
        let task = &execution.tasks[i];
        let change = match task.part {
            Part::Gang => gang::without(task.holders(), lost, execution.placement.workers),
            Part::Alone | Part::Shard { .. } | Part::Merge => Change::Disband,
        };
        match change {
            Change::Keep => {}
            Change::Regroup(members) => self.regroup(key, i, members),
            Change::Disband if loss == Loss::Restart => {
                let fence = self.state.change(key, i, |task| task.release(None));
                self.fences.push(fence);
            }
            Change::Disband => {
                let names: Vec<&str> = lost.iter().map(WorkerId::as_str).collect();
                self.try_again(key, i, &format!("lost worker {}", names.join(", ")), false);
            }
        }
    }

    /// Ends a try. The next begins after a back-off, unless the budget is spent: then the work has failed.
    pub(crate) fn try_again(&mut self, key: Digest, i: usize, why: &str, fault: bool) {
        let (now, policy) = (self.now(), self.state.policy.clone());
        let tried = self.state.change(key, i, |task| {
            let drain_by = matches!(task.lease, Lease::Held { drain_by: Some(_), .. });
            task.streak += 1;
            let (count, budget, what) = if fault {
                (&mut task.faults, policy.fault_budget, "faults")
            } else {
                (&mut task.losses, policy.infrastructure_budget, "lost workers and network errors")
            };
            *count += u32::from(!drain_by);
            if *count > budget {
                return Err(format!("gave up after {count} {what}; the last: {why}"));
            }
            Ok(task.release((!drain_by).then(|| now.after(policy.backoff(task.streak)))))
        });
        match tried {
            Ok(fence) => self.fences.push(fence),
            Err(message) => self.fail_execution(key, message, fault),
        }
    }

    pub(crate) fn fail_execution(&mut self, key: Digest, message: String, own: bool) {
        self.state.execution_mut(key).state = ExecutionState::Failed { message, own };
        // Whoever still works on it can write no more.
        let held: Vec<usize> = self.state.executions[&key].tasks.held().collect();
        for i in held {
            let fence = self.state.change(key, i, |task| task.release(None));
            self.fences.push(fence);
        }
    }

    pub(crate) fn regroup(&mut self, key: Digest, i: usize, members: Vec<protocol::message::Member>) {
        let secret = self.secret(&self.state.executions[&key].tasks[i]);
        let fence = self.state.change(key, i, |task| task.regroup(members, secret));
        self.fences.push(fence);
    }

    /// Unpredictable, and different for every generation.
    pub(crate) fn secret(&self, task: &Task) -> impl FnOnce(Fence) -> String + use<> {
        let (entropy, id) = (self.moment.entropy, task.id.clone());
        move |fence| Digest::of(format!("{entropy} {id} {fence}").as_bytes()).hex()
    }

    pub(crate) fn place(&self, task: &TaskId) -> Result<(Digest, usize), Rejected> {
        self.state.place(task)
    }

    pub(crate) fn keys(&self) -> Vec<Digest> {
        self.state.executions.keys().copied().collect()
    }

    pub(crate) fn set_run_state(&mut self, i: usize, state: RunState) {
        Arc::make_mut(&mut self.state.runs[i]).state = state;
        self.write_run(i);
    }

    fn write_run(&mut self, i: usize) {
        let run = &self.state.runs[i];
        let state = serde_json::to_value(run.state).expect("a state is a word");
        self.writes.push(Write::Run {
            run: run.id.clone(),
            pipeline: serde_json::to_value(&*run.submitted).expect("a pipeline serialises"),
            source: run.source.clone(),
            state: state.as_str().unwrap_or_default().to_owned(),
            idempotency_key: run.idempotency_key.clone(),
        });
    }
}

/// The write that makes a stage's value known under its key.
pub(crate) fn result(
    execution: &StageExecution,
    grant: Option<protocol::message::Grant>,
    known: &Known,
    now: Millis,
) -> Write {
    Write::StageResult {
        grant,
        key: execution.key,
        run: execution.run.clone(),
        stage: execution.stage.clone(),
        kind: execution.settings.kind().to_owned(),
        outputs: known.outputs.clone(),
        metrics: known.metrics.clone(),
        inputs: execution.inputs.clone(),
        wall_s: execution.wall_s(now),
    }
}

/// What even a pipeline from an honest client of another build may get wrong.
fn check_pipeline(pipeline: &Pipeline, until: Option<&StageName>) -> Result<(), Rejected> {
    let mut seen = BTreeSet::new();
    for stage in &pipeline.stages {
        for input in &stage.inputs {
            if !seen.contains(&input.stage) {
                return Err(Rejected::Invalid(format!(
                    "stage `{}`: `{}` names stage `{}`, which does not stand before it",
                    stage.name, input.field, input.stage
                )));
            }
        }
        if !seen.insert(&stage.name) {
            return Err(Rejected::Invalid(format!("stage `{}` stands twice in the pipeline", stage.name)));
        }
    }
    match until {
        Some(until) if !seen.contains(until) => {
            let names: Vec<&str> = seen.iter().map(|name| name.as_str()).collect();
            Err(Rejected::Invalid(format!("`until`: there is no stage `{until}`; there is: {}", names.join(", "))))
        }
        Some(_) | None => Ok(()),
    }
}
