//! The steps of a decision, in their order.

use registry::Write;

use super::attempts::Loss;
use super::deciding::Deciding;
use super::schedule;
use crate::event::{Effect, Event};
use crate::fact::Fact;
use crate::journal::Decision;
use crate::rejected::Rejected;
use crate::state::State;
use crate::state::execution::ExecutionState;
use crate::state::worker::Sign;
use crate::time::Moment;

/// Decides on `event`. Only an accepted event changes `state`. An event that changes nothing has no effect except the
/// answer to its sender.
pub fn decide(state: &mut State, moment: Moment, event: Event) -> Result<Vec<Effect>, Rejected> {
    let moment = Moment { now: moment.now.max(state.now), ..moment };
    let mut cx = Deciding::new(state, moment);
    if !cx.happen(event)? {
        assert!(cx.facts.is_empty(), "an event that changes nothing left {:?}", cx.facts);
        return Ok(cx.effects);
    }
    cx.reconcile();
    cx.admit_changed();
    cx.drain();
    cx.count_time();
    schedule::schedule(&mut cx);
    cx.count_time();
    cx.forget();
    let Deciding { state, facts, mut writes, mut fences, mut effects, history, .. } = cx;
    (state.seq, state.now) = (state.seq + 1, moment.now);
    state.recorded += facts.len() as u64;
    let decision = Decision { now: moment.now, facts };
    let mut stored = vec![Write::Facts { seq: state.seq, facts: decision.to_json() }];
    // Writes that need a valid grant precede the fences that may end the same grant.
    stored.append(&mut writes);
    stored.append(&mut fences);
    if !history.is_empty() {
        stored.push(Write::History(history));
    }
    effects.insert(0, Effect::Store(stored));
    effects.push(Effect::Wake);
    Ok(effects)
}

impl Deciding<'_> {
    /// Applies the event itself. Returns `false` if it changes nothing.
    fn happen(&mut self, event: Event) -> Result<bool, Rejected> {
        match event {
            Event::Started { alone, park } => self.started(alone, park),
            Event::Submit { pipeline, source, idempotency_key, submission, until, owner } => {
                return self.submit(*pipeline, source, idempotency_key, submission, until, owner);
            }
            Event::Join { join, by } => self.join(join, by)?,
            Event::WorkerBack { worker } => return self.sign(&worker, Sign::Back),
            Event::WorkerReady { worker, incarnation, tasks } => return self.ready(worker, incarnation, tasks),
            Event::WorkerLeaves { worker, incarnation } => return self.leaves(worker, incarnation),
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
            Event::WorkerGone { worker, incarnation } => {
                if let Some(incarnation) = incarnation {
                    self.state.process(&worker, incarnation)?;
                }
                if !self.sign(&worker, Sign::Gone)? {
                    return Ok(false);
                }
                self.drop_worker(&worker, Loss::Lost);
            }
            Event::GangDivided { task, fence } => return self.gang_divided(&task, fence),
            Event::GangStalled { task, fence } => return self.gang_stalled(&task, fence),
            Event::Unshared => return Ok(self.share()),
            Event::Limits { limits } => return Ok(self.limit(limits)),
            Event::Quiet { key, for_ms } => return Ok(self.quiet(key, for_ms)),
            Event::Checkpoint { commit } => return self.checkpoint(commit),
            Event::Outcome { report } => return self.outcome(report),
            Event::Control { run, action, archived } => return self.control(&run, action, archived),
            Event::Drain => {
                if self.state.draining {
                    return Ok(false);
                }
                self.record(Fact::Draining { draining: true });
            }
            Event::BackoffOver { task } => return self.backoff_over(&task),
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
}
