//! What waits while the disk is busy, what is decided together, and who is answered when: all of the actor but its queue, its
//! clock and its disk, which its driver brings along.
//!
//! What has gathered is decided together: one event after the other on one copy of the state, and all that they write in one
//! transaction. Nobody is answered before it is stored. If the store refuses it, none of it has happened, and each is tried
//! alone, so that only the one at fault is refused.
//!
//! Polls from which nothing follows, nearly all, do not queue behind the disk: [`Front`] answers them from the newest stored
//! state and notes them, and [`Batches`] takes the notes up before it decides anything.

use std::collections::{BTreeMap, VecDeque};
use std::sync::{Arc, Mutex, PoisonError, RwLock};

use protocol::WorkerId;
use protocol::message::Poll;
use registry::{Write, WriteError};

use crate::decide::decide;
use crate::event::{Effect, Event, Observation};
use crate::invariants;
use crate::observe::{is_quiet, observe};
use crate::outcome::refused_for_good;
use crate::rejected::Rejected;
use crate::state::State;
use crate::time::{Millis, Moment};

/// How many asks are decided together at most.
pub const TOGETHER: usize = 128;

/// Why an ask was refused. Nothing has changed.
#[derive(Debug, thiserror::Error)]
pub enum Refused {
    /// It does not fit what is.
    #[error(transparent)]
    Rejected(#[from] Rejected),
    /// The store did not take it.
    #[error(transparent)]
    Write(#[from] WriteError),
    /// The coordinator is stopping.
    #[error("the coordinator is stopping")]
    Stopped,
    /// A part of the coordinator has panicked, and nothing is decided any more.
    #[error("the coordinator has failed: {0}")]
    Failed(String),
}

/// What the decider is asked.
#[derive(Debug, Clone)]
pub enum Ask {
    /// To decide it.
    Event(Box<Event>),
    /// To take note of it, and to decide what follows; with the time when it was made, for it may wait long.
    Observation(Observation, Millis),
}

/// What is answered beside the queue: reads of the newest stored state, and quiet polls.
#[derive(Debug)]
pub struct Front {
    published: RwLock<Arc<State>>,
    /// The newest quiet poll of each worker that was not taken up yet, and when it came.
    polls: Mutex<BTreeMap<WorkerId, (Millis, Poll)>>,
}

impl Front {
    /// The newest stored state.
    pub fn state(&self) -> Arc<State> {
        Arc::clone(&self.published.read().unwrap_or_else(PoisonError::into_inner))
    }

    /// Notes a poll that came at `at`, if nothing follows from it; else it is handed back as what is to be asked.
    pub fn poll(&self, at: Millis, worker: WorkerId, poll: Poll) -> Result<Option<Ask>, Rejected> {
        if is_quiet(&self.state(), &worker, &poll)? {
            self.polls.lock().unwrap_or_else(PoisonError::into_inner).insert(worker, (at, poll));
            return Ok(None);
        }
        Ok(Some(Ask::Observation(Observation::Poll { worker, poll }, at)))
    }

    fn publish(&self, state: &Arc<State>) {
        *self.published.write().unwrap_or_else(PoisonError::into_inner) = Arc::clone(state);
    }

    fn take_polls(&self) -> BTreeMap<WorkerId, (Millis, Poll)> {
        std::mem::take(&mut *self.polls.lock().unwrap_or_else(PoisonError::into_inner))
    }
}

/// What the driver of the batches does next.
#[derive(Debug)]
pub enum Turn<T> {
    /// Nothing waits.
    Idle,
    /// Store this as one transaction, and say what came of it with [`Batches::stored`].
    Store(Vec<Write>),
    /// A batch is over.
    Done(Done<T>),
}

/// What came of a batch. Nobody is answered, and nothing else done, before this.
#[derive(Debug)]
pub struct Done<T> {
    /// Something was stored: those who wait for a change look again.
    pub durable: bool,
    /// The answers, in the order in which they were asked for, each for its ticket. Empty after a batch of several that the store
    /// refused: they are tried alone.
    pub answers: Vec<(T, Result<Vec<Effect>, Refused>)>,
    /// What is to be done.
    pub effects: Vec<Effect>,
}

/// Asks in batches. `T` is the ticket by which an answer finds its asker.
#[derive(Debug)]
pub struct Batches<T> {
    front: Arc<Front>,
    /// The newest stored state, with what was heard since.
    state: Arc<State>,
    waiting: VecDeque<(Ask, T)>,
    /// What was refused together.
    alone: VecDeque<(Ask, T)>,
    flight: Option<Flight<T>>,
}

/// What is decided and not stored yet.
#[derive(Debug)]
struct Flight<T> {
    next: State,
    decided: Vec<(Ask, T, Result<Vec<Effect>, Rejected>)>,
    /// Why the store refused the event in whose place this one happens.
    instead: Option<WriteError>,
    durable: bool,
}

impl<T> Batches<T> {
    /// Goes on from `state`, which is stored.
    pub fn new(state: State) -> Self {
        let state = Arc::new(state);
        let front = Front { published: RwLock::new(Arc::clone(&state)), polls: Mutex::default() };
        Self { front: Arc::new(front), state, waiting: VecDeque::new(), alone: VecDeque::new(), flight: None }
    }

    /// What is answered beside the queue.
    pub fn front(&self) -> &Arc<Front> {
        &self.front
    }

    /// The newest stored state, with what was heard since.
    pub fn state(&self) -> &Arc<State> {
        &self.state
    }

    /// Whether another ask would be in the next batch.
    pub fn has_room(&self) -> bool {
        self.waiting.len() < TOGETHER
    }

    /// Whether nothing waits to be decided.
    pub fn is_idle(&self) -> bool {
        self.waiting.is_empty() && self.alone.is_empty()
    }

    /// Queues an ask.
    pub fn ask(&mut self, ask: Ask, ticket: T) {
        self.waiting.push_back((ask, ticket));
    }

    /// Decides what waits. `moment` is asked once for each event.
    ///
    /// # Panics
    /// While a batch is on its way to the store.
    pub fn decide(&mut self, moment: impl FnMut() -> Moment) -> Turn<T> {
        assert!(self.flight.is_none(), "one batch at a time");
        self.take_up_polls();
        let asks: Vec<(Ask, T)> = match self.alone.pop_front() {
            Some(one) => vec![one],
            None => self.waiting.drain(..self.waiting.len().min(TOGETHER)).collect(),
        };
        if asks.is_empty() {
            return Turn::Idle;
        }
        self.decide_all(asks, None, moment)
    }

    /// Says what came of [`Turn::Store`].
    ///
    /// # Panics
    /// If nothing was on its way.
    pub fn stored(&mut self, written: Result<(), WriteError>, moment: impl FnMut() -> Moment) -> Turn<T> {
        let flight = self.flight.take().expect("a batch was on its way to the store");
        match written {
            Ok(()) => Turn::Done(self.conclude(flight)),
            Err(error) => self.refused(flight, error, moment),
        }
    }

    /// Takes the noted polls for heard, each at its own time.
    fn take_up_polls(&mut self) {
        for (worker, (at, poll)) in self.front.take_polls() {
            let quiet = is_quiet(&self.state, &worker, &poll);
            let heard = observe(Arc::make_mut(&mut self.state), at, Observation::Poll { worker, poll });
            // Where something follows by now, from what has changed since it was noted, the worker says it again within a second. If its
            // process is over, there is nothing to hear.
            debug_assert!(quiet != Ok(true) || heard.as_ref().is_ok_and(Vec::is_empty), "{heard:?}");
        }
    }

    fn decide_all(
        &mut self,
        asks: Vec<(Ask, T)>,
        instead: Option<WriteError>,
        mut moment: impl FnMut() -> Moment,
    ) -> Turn<T> {
        let (mut next, mut writes) = (State::clone(&self.state), Vec::new());
        let mut decided = Vec::with_capacity(asks.len());
        for (ask, ticket) in asks {
            let result = match &ask {
                Ask::Event(event) => decide_on(&mut next, moment(), (**event).clone(), &mut writes),
                Ask::Observation(observation, at) => observe(&mut next, *at, observation.clone()).map(|events| {
                    let mut effects = Vec::new();
                    for event in events {
                        match decide_on(&mut next, moment(), event, &mut writes) {
                            Ok(mut follow) => effects.append(&mut follow),
                            // What one event did may make the next one moot.
                            Err(rejected) => tracing::debug!(%rejected, "moot"),
                        }
                    }
                    effects
                }),
            };
            decided.push((ask, ticket, result));
        }
        let flight = Flight { next, decided, instead, durable: !writes.is_empty() };
        if !flight.durable {
            return Turn::Done(self.conclude(flight));
        }
        self.flight = Some(flight);
        Turn::Store(writes)
    }

    /// It is stored: now it has happened.
    fn conclude(&mut self, flight: Flight<T>) -> Done<T> {
        let Flight { next, decided, mut instead, durable } = flight;
        self.state = Arc::new(next);
        self.front.publish(&self.state);
        let mut done = Done { durable, answers: Vec::with_capacity(decided.len()), effects: Vec::new() };
        for (_, ticket, result) in decided {
            done.effects.extend(result.iter().flatten().cloned());
            let answer = match (result, instead.take()) {
                (Ok(_), Some(error)) => Err(error.into()),
                (result, _) => result.map_err(Refused::Rejected),
            };
            done.answers.push((ticket, answer));
        }
        done
    }

    /// The store refused it: none of it has happened.
    fn refused(&mut self, flight: Flight<T>, error: WriteError, moment: impl FnMut() -> Moment) -> Turn<T> {
        let Flight { next, mut decided, instead, .. } = flight;
        let nothing = Done { durable: false, answers: Vec::new(), effects: Vec::new() };
        if decided.len() > 1 {
            self.alone.extend(decided.into_iter().map(|(ask, ticket, _)| (ask, ticket)));
            return Turn::Done(nothing);
        }
        let Some((ask, ticket, _)) = decided.pop() else { return Turn::Done(nothing) };
        match &ask {
            Ask::Event(event) if instead.is_none() => {
                if let Some(event) = refused_for_good(event, &error) {
                    tracing::warn!(%error, "refused by the store");
                    return self.decide_all(vec![(Ask::Event(Box::new(event)), ticket)], Some(error), moment);
                }
            }
            // That nothing could be stored of what follows does not mean that nothing was heard.
            Ask::Observation(..) => Arc::make_mut(&mut self.state).heard = next.heard,
            Ask::Event(_) => {}
        }
        Turn::Done(Done { answers: vec![(ticket, Err(error.into()))], ..nothing })
    }
}

/// One event on `next`; what it writes is added to `writes`.
fn decide_on(next: &mut State, moment: Moment, event: Event, writes: &mut Vec<Write>) -> Result<Vec<Effect>, Rejected> {
    let before = cfg!(debug_assertions).then(|| next.clone());
    tracing::debug!(?event, "event");
    let decided = decide(next, moment, event);
    let stores = |effects: &[Effect]| effects.iter().position(|effect| matches!(effect, Effect::Store(_)));
    let position = decided.as_deref().ok().and_then(stores);
    if let Some(before) = before {
        let broken = match position {
            Some(_) => invariants::check_change(&before, next),
            None => invariants::check_unchanged(&before, next),
        };
        assert!(broken.is_empty(), "broken invariants: {broken:#?}");
    }
    let mut effects = decided?;
    if let Some(Effect::Store(mut stored)) = position.map(|i| effects.remove(i)) {
        writes.append(&mut stored);
    }
    Ok(effects)
}
