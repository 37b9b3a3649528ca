//! The only one who decides: (state, moment, event) to facts and effects.
//!
//! Nothing here reads a clock, a socket or a generator. What is decided is a list of facts; `Deciding::record` is the one way to
//! change the state, and keeps each fact. They are stored in the same transaction as the rows that they imply, before any other effect;
//! recovery applies them and decides nothing again. After the event itself, every run that it touched is reconciled (stages whose work is
//! over, stages whose inputs are there), work that nobody wants is asked to wind down, idle workers are given what is ready, and what has
//! ended leaves memory for the tables.
//!
//! A decision looks at what its facts touch, and at no other run or execution: what it costs does not grow with what there ever was.

use std::collections::BTreeSet;
use std::sync::Arc;

use protocol::message::{Join, RunState};
use protocol::pipeline::Pipeline;
use protocol::{Digest, Fence, Incarnation, RunId, StageName, TaskId, WorkerId, limits};
use registry::Write;

use crate::event::{Control, Effect, Event, Known, Millis, Moment, Rejected};
use crate::fact::{Fact, TaskChange};
use crate::journal::Decision;
use crate::schedule;
use crate::state::State;
use crate::state::execution::{ExecutionState, StageExecution};
use crate::state::gang::{self, Change};
use crate::state::run::{Run, Status};
use crate::state::task::{Lease, Part, Task};
use crate::state::worker::{Sign, Worker};

/// Decides what `event` does. `state` is changed only by an accepted event; an event that changes nothing has no effect
/// but the answer to whoever sent it.
pub fn decide(state: &mut State, moment: Moment, event: Event) -> Result<Vec<Effect>, Rejected> {
    let moment = Moment { now: moment.now.max(state.now), ..moment };
    let mut cx = Deciding::new(state, moment);
    if !cx.happen(event)? {
        assert!(cx.facts.is_empty(), "an event that changes nothing left {:?}", cx.facts);
        return Ok(cx.effects);
    }
    cx.reconcile();
    cx.drain();
    cx.count_time();
    schedule::schedule(&mut cx);
    cx.count_time();
    cx.forget();
    let Deciding { state, facts, mut writes, mut fences, mut effects, .. } = cx;
    (state.seq, state.now) = (state.seq + 1, moment.now);
    state.recorded += facts.len() as u64;
    let decision = Decision { now: moment.now, facts };
    let mut stored = vec![Write::Facts { seq: state.seq, facts: decision.to_json() }];
    // What a grant vouches for comes before the fences that may end that very grant.
    stored.append(&mut writes);
    stored.append(&mut fences);
    effects.insert(0, Effect::Store(stored));
    effects.push(Effect::Wake);
    Ok(effects)
}

/// A decision under way.
#[derive(Debug)]
pub(crate) struct Deciding<'a> {
    pub(crate) state: &'a mut State,
    pub(crate) moment: Moment,
    pub(crate) facts: Vec<Fact>,
    pub(crate) writes: Vec<Write>,
    pub(crate) fences: Vec<Write>,
    pub(crate) effects: Vec<Effect>,
    /// Runs that were touched and are not reconciled yet.
    pub(crate) unsettled: BTreeSet<u64>,
    /// Runs that were touched.
    runs: BTreeSet<u64>,
    /// Executions that were touched, or whose users were.
    pub(crate) touched: BTreeSet<Digest>,
}

impl<'a> Deciding<'a> {
    fn new(state: &'a mut State, moment: Moment) -> Self {
        Self {
            state,
            moment,
            facts: Vec::new(),
            writes: Vec::new(),
            fences: Vec::new(),
            effects: Vec::new(),
            unsettled: BTreeSet::new(),
            runs: BTreeSet::new(),
            touched: BTreeSet::new(),
        }
    }

    /// Makes a fact true, and keeps it: the only way to change the state.
    pub(crate) fn record(&mut self, fact: Fact) {
        self.touch(&fact);
        if let Err(misfit) = self.state.apply(&fact) {
            panic!("{misfit}: {fact:?}");
        }
        self.facts.push(fact);
    }

    /// Notes what `fact`, which comes next, may have consequences for.
    fn touch(&mut self, fact: &Fact) {
        let mut runs = Vec::new();
        match fact {
            Fact::Run { run } => runs.push(run.number),
            Fact::RunState { run, .. } => {
                runs.push(*run);
                let known = self.state.runs.get(run).into_iter();
                self.touched.extend(known.flat_map(|run| &run.stages).filter_map(|status| match status {
                    Status::Active { key } => Some(*key),
                    _ => None,
                }));
            }
            Fact::Stages { run, stages } => {
                runs.push(*run);
                if let Some(run) = self.state.runs.get(run) {
                    let before = stages.iter().filter_map(|(i, _)| run.stages.get(*i)?.key());
                    self.touched.extend(before);
                }
                self.touched.extend(stages.iter().filter_map(|(_, status)| status.key()));
            }
            Fact::StagesAdded { run, .. } | Fact::SweepBegun { run, .. } | Fact::SweepMoved { run, .. } => {
                runs.push(*run)
            }
            Fact::RunForgotten { run } => {
                let known = self.state.runs.get(run).into_iter();
                self.touched.extend(known.flat_map(|run| &run.stages).filter_map(Status::key));
            }
            Fact::Execution { execution } => drop(self.touched.insert(execution.key)),
            Fact::ExecutionState { key, .. } => {
                self.touched.insert(*key);
                runs.extend(self.state.executions.get(key).into_iter().flat_map(|execution| execution.users.keys()));
            }
            Fact::ExecutionPlacement { key, .. }
            | Fact::ExecutionSource { key, .. }
            | Fact::ExecutionTime { key, .. }
            | Fact::ExecutionResumed { key }
            | Fact::ExecutionInstructions { key, .. }
            | Fact::Tasks { key, .. }
            | Fact::Task { key, .. } => drop(self.touched.insert(*key)),
            Fact::Draining { .. } => {
                let held = self.state.workers.values().filter_map(|worker| worker.holds);
                self.touched.extend(held.map(|(key, _)| key));
            }
            Fact::ExecutionForgotten { .. } | Fact::Worker { .. } | Fact::WorkerForgotten { .. } => {}
        }
        self.unsettled.extend(&runs);
        self.runs.extend(runs);
    }

    /// Changes a task: what `change` makes of it is the fact, not how.
    pub(crate) fn change<T>(&mut self, key: Digest, i: usize, change: impl FnOnce(&mut Task) -> T) -> T {
        let before = &self.state.executions[&key].tasks[i];
        let mut after = before.clone();
        let made = change(&mut after);
        let new = TaskChange::between(before, &after);
        if !new.is_nothing() {
            self.record(Fact::Task { key, task: i, change: Box::new(new) });
        }
        debug_assert_eq!(self.state.executions[&key].tasks[i], after);
        made
    }

    /// Changes a run: what `change` makes of it is the fact, not how.
    pub(crate) fn change_run<T>(&mut self, number: u64, change: impl FnOnce(&mut Run) -> T) -> T {
        let before = Arc::clone(&self.state.runs[&number]);
        let mut after = Run::clone(&before);
        let made = change(&mut after);
        let stages = after.pipeline.stages[before.pipeline.stages.len()..].to_vec();
        if !stages.is_empty() {
            self.record(Fact::StagesAdded { run: number, stages });
        }
        for sweep in &after.sweeps {
            match before.sweep(sweep.stage) {
                Some(old) if Arc::ptr_eq(old, sweep) => {}
                Some(old) => {
                    let is_new = |(trial, why): &(&usize, &String)| old.failures.get(*trial) != Some(*why);
                    let failures = sweep.failures.iter().filter(is_new).map(|(trial, why)| (*trial, why.clone()));
                    self.record(Fact::SweepMoved {
                        run: number,
                        stage: sweep.stage,
                        progress: sweep.search.since(&old.search),
                        places: sweep.places[old.places.len()..].to_vec(),
                        failures: failures.collect(),
                    });
                }
                None => self.record(Fact::SweepBegun { run: number, sweep: Box::new(Clone::clone(&**sweep)) }),
            }
        }
        let is_new = |(i, status): &(usize, &Status)| before.stages.get(*i).unwrap_or(&Status::Waiting) != *status;
        let stages: Vec<(usize, Status)> =
            after.stages.iter().enumerate().filter(is_new).map(|(i, status)| (i, status.clone())).collect();
        if !stages.is_empty() {
            self.record(Fact::Stages { run: number, stages });
        }
        if (before.state, before.parked) != (after.state, after.parked) {
            self.record(Fact::RunState { run: number, state: after.state, parked: after.parked });
        }
        debug_assert_eq!(*self.state.runs[&number], after);
        made
    }
}

/// Why a worker no longer holds what it held.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Loss {
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
            Event::WorkerReady { worker, incarnation, tasks } => return self.ready(worker, incarnation, tasks),
            Event::LeaseExpired { worker, incarnation } => {
                if self.state.process(&worker, incarnation).is_err() || !self.sign(&worker, Sign::LeaseExpired)? {
                    return Ok(false);
                }
                self.drop_worker(&worker, Loss::Lost);
            }
            Event::WorkerForgotten { worker, incarnation } => {
                let forgotten = self.state.process(&worker, incarnation).is_ok_and(|worker| worker.is_away());
                if !forgotten {
                    return Ok(false);
                }
                self.record(Fact::WorkerForgotten { worker });
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
            Event::Control { run, action, archived } => return self.control(&run, action, archived),
            Event::Drain => {
                if self.state.draining {
                    return Ok(false);
                }
                self.record(Fact::Draining { draining: true });
            }
            Event::BackoffOver { task } => {
                let (key, i) = self.place(&task)?;
                let over = self.change(key, i, |task| match &mut task.lease {
                    Lease::Waiting { not_before } if not_before.is_some_and(|time| time <= now) => {
                        *not_before = None;
                        true
                    }
                    Lease::Waiting { .. } | Lease::Held { .. } | Lease::Done { .. } => false,
                });
                return Ok(over);
            }
            Event::GraceOver { task, fence } => return self.grace_over(&task, fence),
            Event::LookedUp { key, known, source, archived } => return Ok(self.looked_up(key, known, source, archived)),
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
        self.record(Fact::Draining { draining: false });
        let keys: Vec<Digest> = self.state.executions.keys().copied().collect();
        for key in keys {
            let execution = Arc::clone(&self.state.executions[&key]);
            // The time during which no coordinator ran is nobody's work.
            if let Some(since) = execution.busy_since {
                let wall_ms = execution.wall_ms + before.since(since);
                self.record(Fact::ExecutionTime { key, wall_ms, busy_since: None });
            }
            // Whoever is still at work goes on as if nothing had been.
            if execution.state == ExecutionState::Open && execution.has_something() && (alone || !execution.is_busy()) {
                self.resumed(key);
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
                self.record(Fact::WorkerForgotten { worker });
            } else {
                Arc::make_mut(&mut self.state.heard.workers).insert(worker, now);
            }
        }
        if park {
            for run in self.state.runs.values().cloned().collect::<Vec<_>>() {
                if run.state == RunState::Running {
                    self.set_run_state(run.number, RunState::Paused, true);
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
        // A run that has ended is found in the tables, before the event.
        let twin = self.state.runs.values().find(|run| key.is_some() && run.idempotency_key == key);
        if let Some(twin) = twin {
            self.effects.push(Effect::Submitted(twin.id.clone()));
            return Ok(false);
        }
        check_pipeline(&pipeline, until.as_ref())?;
        let run = Run::new(self.state.submitted + 1, Arc::new(pipeline), key, until);
        for old in self.state.runs.values().cloned().collect::<Vec<_>>() {
            if old.parked && old.state == RunState::Paused && old.submitted.digest() == run.submitted.digest() {
                self.change_run(old.number, |old| old.skip_rest(&format!("taken over by run `{}`", run.id)));
                self.set_run_state(old.number, RunState::Cancelled, old.parked);
            }
        }
        self.writes.push(Write::Run {
            run: run.id.clone(),
            pipeline: serde_json::to_value(&*run.submitted).expect("a pipeline serialises"),
            source,
            state: word(run.state),
            idempotency_key: run.idempotency_key.clone(),
        });
        self.effects.push(Effect::Submitted(run.id.clone()));
        self.record(Fact::Run { run: Box::new(run) });
        Ok(true)
    }

    fn join(&mut self, join: Join) -> Result<(), Rejected> {
        if !protocol::id::is_name(join.worker.as_str()) {
            return Err(Rejected::Invalid(format!("`{}` is not a worker name", join.worker)));
        }
        self.drop_worker(&join.worker, Loss::Lost);
        let process = Worker::joined(&join, self.state.incarnation.next());
        self.effects.push(Effect::Joined(process.incarnation));
        let now = self.now();
        Arc::make_mut(&mut self.state.heard.workers).insert(join.worker.clone(), now);
        self.record(Fact::Worker { worker: join.worker, process });
        Ok(())
    }

    fn control(&mut self, id: &RunId, action: Control, archived: Option<Box<Run>>) -> Result<bool, Rejected> {
        let archived = archived.filter(|run| run.id == *id);
        let (run, known) = match (self.state.run(id), archived) {
            (Ok(run), _) => (Arc::clone(run), true),
            (Err(_), Some(run)) => (Arc::from(run), false),
            (Err(unknown), None) => return Err(unknown),
        };
        let before = run.state;
        let Some(after) = run.after(action) else {
            return Err(Rejected::Conflict(format!("run `{id}` is {before:?} and cannot be asked to {action:?}")));
        };
        if after == before && !run.parked {
            return Ok(false);
        }
        if !known {
            self.record(Fact::Run { run: Box::new(Run::clone(&run)) });
        }
        match action {
            Control::Pause => {}
            Control::Cancel => self.change_run(run.number, |run| run.skip_rest("cancelled")),
            Control::Resume => self.change_run(run.number, Run::reopen),
        }
        self.set_run_state(run.number, after, false);
        Ok(true)
    }

    fn looked_up(
        &mut self,
        key: Digest,
        known: Option<Known>,
        source: Option<(RunId, StageName)>,
        archived: Option<Box<StageExecution>>,
    ) -> bool {
        let Some(execution) = self.state.executions.get(&key).map(Arc::clone) else { return false };
        if execution.state != ExecutionState::Looking {
            return false;
        }
        match (known, &execution.registration) {
            (Some(known), _) => {
                if let Some((run, stage)) = source
                    && execution.tasks.is_empty()
                {
                    self.record(Fact::ExecutionSource { key, run, stage });
                }
                let state = ExecutionState::Done { known: Arc::new(known), cached: true };
                self.record(Fact::ExecutionState { key, state });
            }
            (None, Some(registration)) => {
                let candidates = registration.candidates.clone();
                self.record(Fact::ExecutionState { key, state: ExecutionState::Bundling });
                self.effects.push(Effect::Register { key, candidates });
            }
            (None, None) => {
                let fence = self.state.fence;
                match archived.filter(|archived| archived.key == key && !archived.tasks.is_empty()) {
                    _ if !execution.tasks.is_empty() => {}
                    Some(archived) => self.take_up(&archived),
                    None => self.record(Fact::Tasks { key, tasks: execution.new_tasks(fence) }),
                }
                self.record(Fact::ExecutionState { key, state: ExecutionState::Open });
            }
        }
        true
    }

    /// Goes on from what an earlier try left.
    fn take_up(&mut self, archived: &StageExecution) {
        let (key, fence) = (archived.key, self.state.fence);
        let again = |task: &Task| {
            let mut task = Task { fence: task.fence.max(fence), ..task.clone() };
            task.reset_budgets();
            task
        };
        let (run, stage) = (archived.run.clone(), archived.stage.clone());
        self.record(Fact::ExecutionSource { key, run: run.clone(), stage });
        self.record(Fact::Tasks { key, tasks: archived.tasks.iter().map(again).collect() });
        if let Some(instruction_set) = archived.instruction_set.clone() {
            self.record(Fact::ExecutionInstructions { key, instruction_set });
        }
        self.record(Fact::ExecutionTime { key, wall_ms: archived.wall_ms, busy_since: None });
        if archived.resumed || archived.has_something() {
            self.resumed(key);
        }
        self.writes.push(Write::Archive { key, run, stage: archived.stage.clone(), execution: None });
    }

    /// It goes on from something that an earlier try has saved.
    pub(crate) fn resumed(&mut self, key: Digest) {
        if !self.state.executions[&key].resumed {
            self.record(Fact::ExecutionResumed { key });
        }
    }

    fn bundled(&mut self, key: Digest, bundles: &[Digest]) -> Result<bool, Rejected> {
        if self.state.executions.get(&key).is_none_or(|execution| execution.state != ExecutionState::Bundling) {
            return Ok(false);
        }
        let now = self.now();
        let execution = Arc::clone(&self.state.executions[&key]);
        let registration = execution.registration.as_ref().expect("bundling is registering");
        if bundles.len() != registration.candidates.len() {
            return Err(Rejected::Invalid(format!("stage `{}` needs a bundle for each candidate", execution.stage)));
        }
        let (known, mut writes) = registration.writes(&execution.run, &execution.stage, bundles);
        writes.push(result(&execution, None, &known, now));
        let state = ExecutionState::Done { known: Arc::new(known), cached: false };
        self.record(Fact::ExecutionState { key, state });
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
            let fence = self.change(key, i, |task| task.release(None));
            self.fences.push(fence);
        }
        Ok(over)
    }

    /// Takes note of what a worker has fetched ahead; `false` if all of that is known or over.
    fn ready(&mut self, worker: WorkerId, incarnation: Incarnation, tasks: Vec<TaskId>) -> Result<bool, Rejected> {
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
    fn sign(&mut self, worker: &WorkerId, sign: Sign) -> Result<bool, Rejected> {
        let known = self.state.workers.get(worker);
        let known = known.ok_or_else(|| Rejected::NotFound(format!("worker `{worker}` is not known")))?;
        if known.presence.after(sign, self.now()) == known.presence {
            return Ok(false);
        }
        self.set_presence(worker, sign);
        Ok(true)
    }

    fn set_presence(&mut self, worker: &WorkerId, sign: Sign) {
        let now = self.now();
        let Some(known) = self.state.workers.get(worker) else { return };
        let mut process = known.clone();
        process.presence = process.presence.after(sign, now);
        process.suspicions += u32::from(sign == Sign::PeersLost);
        if process != *known {
            self.record(Fact::Worker { worker: worker.clone(), process });
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

    pub(crate) fn take_from(&mut self, key: Digest, i: usize, lost: &[WorkerId], loss: Loss) {
        let execution = &self.state.executions[&key];
        let task = &execution.tasks[i];
        let change = match task.part {
            Part::Gang => gang::without(task.holders(), lost, execution.range()),
            Part::Alone | Part::Shard { .. } | Part::Merge => Change::Disband,
        };
        match change {
            Change::Keep => {}
            Change::Regroup(members) => self.regroup(key, i, members),
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

    /// Ends a try. The next begins after a back-off, unless the budget is spent: then the work has failed.
    pub(crate) fn try_again(&mut self, key: Digest, i: usize, why: &str, fault: bool) {
        let (now, policy) = (self.now(), self.state.policy.clone());
        let tried = self.change(key, i, |task| {
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
        self.record(Fact::ExecutionState { key, state: ExecutionState::Failed { message, own } });
        // Whoever still works on it can write no more.
        let held: Vec<usize> = self.state.executions[&key].tasks.held().collect();
        for i in held {
            let fence = self.change(key, i, |task| task.release(None));
            self.fences.push(fence);
        }
    }

    pub(crate) fn regroup(&mut self, key: Digest, i: usize, members: Vec<protocol::message::Member>) {
        let secret = self.secret(&self.state.executions[&key].tasks[i]);
        let fence = self.change(key, i, |task| task.regroup(members, secret));
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

    pub(crate) fn set_run_state(&mut self, number: u64, state: RunState, parked: bool) {
        let run = self.state.runs[&number].id.clone();
        self.record(Fact::RunState { run: number, state, parked });
        // The row of one that ends is written when it leaves memory, at the end of this decision.
        if !state.is_final() {
            self.writes.push(Write::RunState { run, state: word(state) });
        }
    }

    /// What has ended leaves memory for the tables: runs, then executions that nobody waits for or works on.
    fn forget(&mut self) {
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

/// A run's state as it stands in its row.
fn word(state: RunState) -> String {
    let state = serde_json::to_value(state).expect("a state is a word");
    state.as_str().unwrap_or_default().to_owned()
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
    if pipeline.stages.len() > limits::STAGES {
        let stages = pipeline.stages.len();
        return Err(Rejected::Invalid(format!(
            "the pipeline has {stages} stages; expected at most {}",
            limits::STAGES
        )));
    }
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
