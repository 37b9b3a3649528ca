//! Batching of requests while the disk is busy. This is the actor without its queue, clock and disk, which the driver
//! supplies.
//!
//! Gathered requests are decided together: one event after the other on one copy of the state, with all writes in one
//! transaction. Answers follow only after it is stored. If the store refuses the transaction, no event of it has
//! happened. Each request is then tried alone, so that only the faulty one is refused.
//!
//! Nearly all polls have no consequences and do not queue behind the disk. [`Front`] answers them from the newest
//! stored state and notes them; [`Batches`] applies the notes before the next decision.

use std::collections::{BTreeMap, VecDeque};
use std::sync::{Arc, Mutex, PoisonError, RwLock};

use protocol::WorkerId;
use protocol::message::Poll;
use registry::{Write, WriteError};

use crate::decide::decide;
use crate::decide::outcome::refused_for_good;
use crate::event::{Effect, Event, Observation};
use crate::invariants;
use crate::observe::{is_quiet, observe};
use crate::rejected::Rejected;
use crate::state::State;
use crate::time::{Millis, Moment};

/// Maximum number of requests in a batch.
pub const TOGETHER: usize = 128;

/// The reason for refusing a request. The state is unchanged.
#[derive(Debug, thiserror::Error)]
pub enum Refused {
    /// The decision rejected it.
    #[error(transparent)]
    Rejected(#[from] Rejected),
    /// The store refused it.
    #[error(transparent)]
    Write(#[from] WriteError),
    /// The coordinator is stopping.
    #[error("the coordinator is stopping")]
    Stopped,
    /// A part of the coordinator panicked; it makes no more decisions.
    #[error("the coordinator has failed: {0}")]
    Failed(String),
}

/// A request for the decider.
#[derive(Debug, Clone)]
pub enum Ask {
    /// An event to decide.
    Event(Box<Event>),
    /// An observation to note and to decide its consequences, with its time, because it may wait long.
    Observation(Observation, Millis),
}

/// Serves requests that bypass the queue: reads of the newest stored state, and quiet polls.
#[derive(Debug)]
pub struct Front {
    published: RwLock<Arc<State>>,
    /// The newest quiet poll of each worker that was not applied yet, with its time.
    polls: Mutex<BTreeMap<WorkerId, (Millis, Poll)>>,
}

impl Front {
    /// The newest stored state.
    pub fn state(&self) -> Arc<State> {
        Arc::clone(&self.published.read().unwrap_or_else(PoisonError::into_inner))
    }

    /// Notes a poll received at `at` if it has no consequences; otherwise returns it as a request to queue.
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

/// The next action of the driver.
#[derive(Debug)]
pub enum Turn<T> {
    /// No request waits.
    Idle,
    /// Store this as one transaction and pass the result to [`Batches::stored`].
    Store(Vec<Write>),
    /// A batch is complete.
    Done(Done<T>),
}

/// The result of a batch. All answers and effects follow from here.
#[derive(Debug)]
pub struct Done<T> {
    /// Set if something was stored; waiters for a change check again.
    pub durable: bool,
    /// Answers in the order of the requests, each with its ticket. Empty if the store refused a batch of several, which
    /// are then tried alone.
    pub answers: Vec<(T, Result<Vec<Effect>, Refused>)>,
    pub effects: Vec<Effect>,
}

/// Batches of requests. `T` is the ticket that connects an answer with its request.
#[derive(Debug)]
pub struct Batches<T> {
    front: Arc<Front>,
    /// The newest stored state and all later observations.
    state: Arc<State>,
    waiting: VecDeque<(Ask, T)>,
    /// Requests of a refused batch.
    alone: VecDeque<(Ask, T)>,
    flight: Option<Flight<T>>,
}

/// A batch that is decided but not stored yet.
#[derive(Debug)]
struct Flight<T> {
    next: State,
    decided: Vec<(Ask, T, Result<Vec<Effect>, Rejected>)>,
    /// The store's error for the original event, if this event replaces it.
    instead: Option<WriteError>,
    durable: bool,
}

impl<T> Batches<T> {
    /// Continues from `state`, which is stored.
    pub fn new(state: State) -> Self {
        let state = Arc::new(state);
        let front = Front { published: RwLock::new(Arc::clone(&state)), polls: Mutex::default() };
        Self { front: Arc::new(front), state, waiting: VecDeque::new(), alone: VecDeque::new(), flight: None }
    }

    /// The part that serves requests without the queue.
    pub fn front(&self) -> &Arc<Front> {
        &self.front
    }

    /// The newest stored state and all later observations.
    pub fn state(&self) -> &Arc<State> {
        &self.state
    }

    /// Returns true if another request would fit into the next batch.
    pub fn has_room(&self) -> bool {
        self.waiting.len() < TOGETHER
    }

    /// Returns true if no request waits.
    pub fn is_idle(&self) -> bool {
        self.waiting.is_empty() && self.alone.is_empty()
    }

    pub fn ask(&mut self, ask: Ask, ticket: T) {
        self.waiting.push_back((ask, ticket));
    }

    /// Decides the next batch. `moment` is called once for each event.
    ///
    /// # Panics
    /// If a batch is being stored.
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

    /// Reports the result of [`Turn::Store`].
    ///
    /// # Panics
    /// If no batch is being stored.
    pub fn stored(&mut self, written: Result<(), WriteError>, moment: impl FnMut() -> Moment) -> Turn<T> {
        let flight = self.flight.take().expect("a batch was on its way to the store");
        match written {
            Ok(()) => Turn::Done(self.conclude(flight)),
            Err(error) => self.refused(flight, error, moment),
        }
    }

    /// Applies the noted polls, each at its own time.
    fn take_up_polls(&mut self) {
        for (worker, (at, poll)) in self.front.take_polls() {
            let quiet = is_quiet(&self.state, &worker, &poll);
            let heard = observe(Arc::make_mut(&mut self.state), at, Observation::Poll { worker, poll });
            // The state may have changed since the poll was noted, so that something now follows from it. The worker
            // polls again within a second. If its process has ended, the poll is obsolete.
            debug_assert!(quiet != Ok(true) || heard.as_ref().is_ok_and(Vec::is_empty), "{heard:?}");
        }
    }

    fn decide_all(
        &mut self,
        asks: Vec<(Ask, T)>,
        instead: Option<WriteError>,
        mut moment: impl FnMut() -> Moment,
    ) -> Turn<T> {
        let mut next = State::clone(&self.state);
        let mut writes = Vec::new();
        let mut decided = Vec::with_capacity(asks.len());
        for (ask, ticket) in asks {
            let result = match &ask {
                Ask::Event(event) => decide_on(&mut next, moment(), (**event).clone(), &mut writes),
                Ask::Observation(observation, at) => observe(&mut next, *at, observation.clone()).map(|events| {
                    let mut effects = Vec::new();
                    for event in events {
                        match decide_on(&mut next, moment(), event, &mut writes) {
                            Ok(mut follow) => effects.append(&mut follow),
                            // An earlier event of this poll may have made this one obsolete.
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

    /// Publishes a batch after it is stored.
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

    /// Discards a batch that the store refused.
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
            // Keep the observation itself, even though its consequences could not be stored.
            Ask::Observation(..) => Arc::make_mut(&mut self.state).heard = next.heard,
            Ask::Event(_) => {}
        }
        Turn::Done(Done { answers: vec![(ticket, Err(error.into()))], ..nothing })
    }
}

/// Decides one event on `next` and appends its writes to `writes`.
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
