//! The one task that decides. Events come over a queue; each is decided on a copy of the state, stored, then published.
//!
//! What has gathered in the queue while the disk was busy is decided together: one event after the other on one copy, and
//! all that they write in one transaction. Nobody is answered before it is stored. If the store refuses it, none of it has
//! happened, and each is tried alone, so that only the one at fault is refused.
//!
//! Polls from which nothing follows, nearly all, do not queue behind the disk: they are noted beside the queue and answered at once,
//! and the actor takes the notes up before it decides anything.

use std::collections::BTreeMap;
use std::sync::{Arc, Mutex, PoisonError, RwLock};
use std::time::{Instant, SystemTime, UNIX_EPOCH};

use protocol::message::{Poll, RunView, Submit};
use protocol::pipeline::Pipeline;
use protocol::{Digest, RunId, WorkerId};
use registry::{ReadStore, Store, Write, WriteError};
use tokio::sync::{mpsc, oneshot, watch};
use tokio::task::JoinHandle;

use super::{Records, answer, effects};
use crate::decide::decide;
use crate::event::{Control, Effect, Event, Millis, Moment, Observation, Rejected};
use crate::observe::{is_quiet, observe};
use crate::outcome::refused_for_good;
use crate::state::State;
use crate::{invariants, journal};

/// How many events are decided together at most.
const TOGETHER: usize = 128;

/// Why a call was refused. Nothing has changed.
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
}

/// What the actor is asked.
#[derive(Debug)]
enum Ask {
    Event(Box<Event>, oneshot::Sender<Result<Vec<Effect>, Refused>>),
    /// With the time when it was made: the actor may get to it later, when the disk is slow.
    Observation(Observation, Millis, oneshot::Sender<Result<(), Refused>>),
}

/// What is shared between the actor and those who ask it.
#[derive(Debug)]
pub(crate) struct ActorHandle {
    asks: mpsc::Sender<Ask>,
    /// The newest quiet poll of each worker that the actor has not taken up yet, and when it came.
    polls: Mutex<BTreeMap<WorkerId, (Millis, Poll)>>,
    published: RwLock<Arc<State>>,
    changed: watch::Sender<u64>,
    trouble: Mutex<Option<String>>,
    stop: watch::Sender<bool>,
    clock: Clock,
    pub(crate) store: Store,
}

/// What the tables keep of a run that ended.
pub(super) fn read<T: serde::de::DeserializeOwned>(run: &RunId, text: &str) -> Result<T, Refused> {
    serde_json::from_str(text).map_err(|error| {
        Rejected::Conflict(format!("what is kept of run `{run}` does not read: {error}; use the build that wrote it"))
            .into()
    })
}

impl ActorHandle {
    /// Decides an event; returns once it is stored.
    pub(crate) async fn decide(&self, event: Event) -> Result<Vec<Effect>, Refused> {
        let (reply, receiver) = oneshot::channel();
        self.asks.send(Ask::Event(Box::new(event), reply)).await.map_err(|_| Refused::Stopped)?;
        answer(receiver).await
    }

    /// Takes note of what was heard, and decides what follows from it.
    pub(crate) async fn observe(&self, observation: Observation) -> Result<(), Refused> {
        let (reply, receiver) = oneshot::channel();
        self.asks.send(Ask::Observation(observation, self.now(), reply)).await.map_err(|_| Refused::Stopped)?;
        answer(receiver).await
    }

    /// Takes note of a poll; returns once what follows from it is stored.
    pub(crate) async fn poll(&self, worker: WorkerId, poll: Poll) -> Result<(), Refused> {
        if is_quiet(&self.state(), &worker, &poll)? {
            self.polls.lock().unwrap_or_else(PoisonError::into_inner).insert(worker, (self.now(), poll));
            return Ok(());
        }
        self.observe(Observation::Poll { worker, poll }).await
    }

    /// Submits a pipeline.
    pub(crate) async fn submit(&self, submit: Submit) -> Result<RunId, Refused> {
        // Beside the threads that answer heartbeats: a large one takes a while.
        let read = effects::blocking(move || {
            let pipeline: Pipeline = serde_json::from_value(submit.pipeline)
                .map_err(|e| format!("the pipeline does not parse: {e}; was it made by another build?"))?;
            pipeline.check()?;
            Ok(pipeline)
        });
        let pipeline = read.await.map_err(Rejected::Invalid)?;
        let event = Event::Submit {
            pipeline: Box::new(pipeline),
            source: submit.source,
            idempotency_key: submit.idempotency_key.clone(),
            until: submit.until,
        };
        let mut tries = 0;
        loop {
            // One that has ended is in the tables alone.
            if let Some(key) = &submit.idempotency_key
                && let Some(row) = self.store.run_by_key(key).await.map_err(WriteError::from)?
            {
                return Ok(row.run);
            }
            tries += 1;
            match self.decide(event.clone()).await {
                // Another one with this key came between the look and the event, and has ended already.
                Err(Refused::Write(WriteError::Conflict(_))) if submit.idempotency_key.is_some() && tries < 3 => {}
                decided => {
                    let run = decided?.into_iter().find_map(|effect| match effect {
                        Effect::Submitted(run) => Some(run),
                        _ => None,
                    });
                    return Ok(run.expect("a submission gives a run"));
                }
            }
        }
    }

    /// Asks something of a run, whether it is in memory or has ended.
    pub(crate) async fn control(&self, run: &RunId, action: Control) -> Result<(), Refused> {
        let mut tries = 0;
        loop {
            let archived = match self.state().run(run) {
                Ok(_) => None,
                Err(_) => match self.store.ended(run).await.map_err(WriteError::from)? {
                    Some(row) => Some(Box::new(read(run, &row.archive)?)),
                    None => None,
                },
            };
            tries += 1;
            let looked_too_early = archived.is_none();
            match self.decide(Event::Control { run: run.clone(), action, archived }).await {
                // It ended between the look and the event.
                Err(Refused::Rejected(Rejected::NotFound(_))) if looked_too_early && tries < 3 => {}
                decided => return decided.map(drop),
            }
        }
    }

    /// A run as clients see it, whether it is in memory or has ended.
    pub(crate) async fn run_view(&self, run: &RunId) -> Result<RunView, Refused> {
        self.records().run_view(run).await
    }

    /// What there is to tell of runs now. The state is read before the tables: a run that ends in between is in both, and not in
    /// neither.
    pub(crate) fn records(&self) -> Records {
        Records::new(ReadStore::clone(&self.store), self.state(), self.now())
    }

    /// The newest published state.
    pub(crate) fn state(&self) -> Arc<State> {
        Arc::clone(&self.published.read().unwrap_or_else(PoisonError::into_inner))
    }

    /// Ticks with every durable change.
    pub(crate) fn changes(&self) -> watch::Receiver<u64> {
        self.changed.subscribe()
    }

    /// Why the store takes no writes, if it does not.
    pub(crate) fn trouble(&self) -> Option<String> {
        self.trouble.lock().unwrap_or_else(PoisonError::into_inner).clone()
    }

    /// Takes note of whether the store took a write.
    pub(crate) fn wrote<T>(&self, result: &Result<T, WriteError>) {
        let mut trouble = self.trouble.lock().unwrap_or_else(PoisonError::into_inner);
        match result {
            Ok(_) => *trouble = None,
            Err(WriteError::Storage(message)) => *trouble = Some(message.clone()),
            Err(error @ WriteError::Superseded { .. }) => *trouble = Some(error.to_string()),
            Err(_) => {}
        }
    }

    /// The time.
    pub(crate) fn now(&self) -> Millis {
        self.clock.now()
    }

    /// Ends the actor and everything that waits for it.
    pub(crate) fn stop(&self) {
        let _ = self.stop.send(true);
    }

    /// Becomes true when the coordinator stops.
    pub(crate) fn stopped(&self) -> watch::Receiver<bool> {
        self.stop.subscribe()
    }

    fn publish(&self, state: &Arc<State>, durable: bool) {
        *self.published.write().unwrap_or_else(PoisonError::into_inner) = Arc::clone(state);
        if durable {
            self.changed.send_modify(|version| *version += 1);
        }
    }
}

/// The machine's wall clock.
pub(super) fn wall_clock() -> Millis {
    let wall = SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default().as_millis();
    Millis(u64::try_from(wall).unwrap_or(u64::MAX))
}

/// The machine's wall clock when the process started, and its monotonic clock since: a wall clock that is set while we run
/// would end every lease.
#[derive(Debug)]
struct Clock {
    start: Instant,
    start_ms: u64,
}

impl Clock {
    fn new(not_before: Millis) -> Self {
        Self { start: Instant::now(), start_ms: wall_clock().0.max(not_before.0) }
    }

    fn now(&self) -> Millis {
        let since = u64::try_from(self.start.elapsed().as_millis()).unwrap_or(u64::MAX);
        Millis(self.start_ms.saturating_add(since))
    }
}

/// Unpredictable bytes: a secret of the process, drawn once, and a counter.
#[derive(Debug)]
struct Entropy {
    secret: [u8; 32],
    count: u64,
}

impl Entropy {
    fn new() -> Self {
        let mut secret = [0; 32];
        getrandom::fill(&mut secret).expect("the system has random bytes");
        Self { secret, count: 0 }
    }

    fn next(&mut self) -> Digest {
        self.count += 1;
        let mut bytes = self.secret.to_vec();
        bytes.extend_from_slice(&self.count.to_le_bytes());
        Digest::of(&bytes)
    }
}

/// Starts the actor on a recovered state.
pub(crate) fn start(store: Store, state: State) -> (Arc<ActorHandle>, JoinHandle<()>) {
    let (asks, queue) = mpsc::channel(1024);
    let state = Arc::new(state);
    let actor_handle = Arc::new(ActorHandle {
        asks,
        polls: Mutex::default(),
        published: RwLock::new(Arc::clone(&state)),
        changed: watch::Sender::new(0),
        trouble: Mutex::new(None),
        stop: watch::Sender::new(false),
        clock: Clock::new(state.now),
        store,
    });
    let snapshot_at = state.seq;
    let actor =
        Actor { actor_handle: Arc::clone(&actor_handle), state, entropy: Entropy::new(), snapshot_at, snapshot: None };
    (actor_handle, tokio::spawn(actor.run(queue)))
}

struct Actor {
    actor_handle: Arc<ActorHandle>,
    state: Arc<State>,
    entropy: Entropy,
    /// The decision at which the newest snapshot was begun.
    snapshot_at: u64,
    /// A snapshot on its way.
    snapshot: Option<JoinHandle<()>>,
}

impl Actor {
    async fn run(mut self, mut queue: mpsc::Receiver<Ask>) {
        let mut stopped = self.actor_handle.stopped();
        loop {
            let ask = tokio::select! {
                biased;
                _ = stopped.wait_for(|stop| *stop) => return,
                ask = queue.recv() => ask,
            };
            let Some(first) = ask else { return };
            self.snapshot_if_due();
            let mut asks = vec![first];
            while asks.len() < TOGETHER
                && let Ok(more) = queue.try_recv()
            {
                asks.push(more);
            }
            self.take_up_polls();
            if asks.len() > 1 && self.all_happen(&mut asks).await {
                continue;
            }
            for ask in asks {
                match ask {
                    // Whoever asked may have gone away meanwhile; what was decided stands.
                    Ask::Event(event, reply) => drop(reply.send(self.happen(*event).await)),
                    Ask::Observation(observation, at, reply) => drop(reply.send(self.hear(observation, at).await)),
                }
            }
        }
    }

    /// Stores the state as a whole every so many decisions, beside whatever goes on.
    fn snapshot_if_due(&mut self) {
        let is_over = self.snapshot.as_ref().is_none_or(JoinHandle::is_finished);
        if is_over && self.state.seq >= self.snapshot_at + self.state.policy.snapshot_every {
            self.snapshot_at = self.state.seq;
            self.snapshot = Some(tokio::spawn(snapshot(self.actor_handle.store.clone(), Arc::clone(&self.state))));
        }
    }

    /// Takes the noted polls for heard, each at its own time.
    fn take_up_polls(&mut self) {
        let polls = std::mem::take(&mut *self.actor_handle.polls.lock().unwrap_or_else(PoisonError::into_inner));
        for (worker, (at, poll)) in polls {
            // What has changed since it was noted makes it moot; the worker polls again within a second.
            if matches!(is_quiet(&self.state, &worker, &poll), Ok(true)) {
                let heard = observe(Arc::make_mut(&mut self.state), at, Observation::Poll { worker, poll });
                debug_assert!(matches!(&heard, Ok(events) if events.is_empty()), "{heard:?}");
            }
        }
    }

    /// Decides all `asks` in their order, stores what they write at once, and answers them. `false`: the store refused it,
    /// and nothing has happened.
    async fn all_happen(&mut self, asks: &mut Vec<Ask>) -> bool {
        let (mut next, mut writes, mut effects) = (State::clone(&self.state), Vec::new(), Vec::new());
        let mut decided = Vec::with_capacity(asks.len());
        for ask in asks.iter() {
            decided.push(match ask {
                Ask::Event(event, _) => self.decide_on(&mut next, (**event).clone(), &mut writes),
                Ask::Observation(observation, at, _) => observe(&mut next, *at, observation.clone()).map(|events| {
                    let mut follow = Vec::new();
                    for event in events {
                        match self.decide_on(&mut next, event, &mut writes) {
                            Ok(mut effects) => follow.append(&mut effects),
                            Err(rejected) => tracing::debug!(%rejected, "moot"),
                        }
                    }
                    follow
                }),
            });
        }
        let durable = !writes.is_empty();
        if durable {
            let written = self.actor_handle.store.write(writes).await;
            self.actor_handle.wrote(&written);
            if written.is_err() {
                return false;
            }
        }
        self.state = Arc::new(next);
        self.actor_handle.publish(&self.state, durable);
        for (ask, decided) in asks.drain(..).zip(decided) {
            if let Ok(done) = &decided {
                effects.extend(done.iter().cloned());
            }
            match ask {
                Ask::Event(_, reply) => drop(reply.send(decided.map_err(Refused::Rejected))),
                Ask::Observation(_, _, reply) => drop(reply.send(decided.map(drop).map_err(Refused::Rejected))),
            }
        }
        for effect in &effects {
            effects::perform(&self.actor_handle, effect);
        }
        true
    }

    /// One event on `next`; what it writes is added to `writes`.
    fn decide_on(&mut self, next: &mut State, event: Event, writes: &mut Vec<Write>) -> Result<Vec<Effect>, Rejected> {
        let before = cfg!(debug_assertions).then(|| next.clone());
        let moment = Moment { now: self.actor_handle.now(), entropy: self.entropy.next() };
        tracing::debug!(?event, "event");
        let mut effects = decide(next, moment, event)?;
        if let Some(before) = before {
            let broken = invariants::check_change(&before, next);
            assert!(broken.is_empty(), "broken invariants: {broken:#?}");
        }
        if let Some(i) = effects.iter().position(|effect| matches!(effect, Effect::Store(_)))
            && let Effect::Store(mut stored) = effects.remove(i)
        {
            writes.append(&mut stored);
        }
        Ok(effects)
    }

    async fn hear(&mut self, observation: Observation, at: Millis) -> Result<(), Refused> {
        let events = observe(Arc::make_mut(&mut self.state), at, observation)?;
        for event in events {
            match self.happen(event).await {
                Ok(_) => {}
                // What one event of a batch did may make the next one moot.
                Err(Refused::Rejected(rejected)) => tracing::debug!(%rejected, "moot"),
                Err(refused) => return Err(refused),
            }
        }
        self.actor_handle.publish(&self.state, false);
        Ok(())
    }

    async fn happen(&mut self, event: Event) -> Result<Vec<Effect>, Refused> {
        match self.try_happen(event.clone()).await {
            Err(Refused::Write(error)) => {
                let Some(instead) = refused_for_good(&event, &error) else { return Err(Refused::Write(error)) };
                tracing::warn!(%error, "refused by the store");
                self.try_happen(instead).await?;
                Err(Refused::Write(error))
            }
            result => result,
        }
    }

    async fn try_happen(&mut self, event: Event) -> Result<Vec<Effect>, Refused> {
        let mut next = State::clone(&self.state);
        let moment = Moment { now: self.actor_handle.now(), entropy: self.entropy.next() };
        tracing::debug!(?event, "event");
        let mut effects = decide(&mut next, moment, event)?;
        let position = effects.iter().position(|effect| matches!(effect, Effect::Store(_)));
        let Some(Effect::Store(writes)) = position.map(|i| effects.remove(i)) else { return Ok(effects) };
        if cfg!(debug_assertions) {
            let broken = invariants::check_change(&self.state, &next);
            assert!(broken.is_empty(), "broken invariants: {broken:#?}");
        }
        let written = self.actor_handle.store.write(writes).await;
        self.actor_handle.wrote(&written);
        written?;
        self.state = Arc::new(next);
        self.actor_handle.publish(&self.state, true);
        for effect in &effects {
            effects::perform(&self.actor_handle, effect);
        }
        Ok(effects)
    }
}

/// Stores `state` as a whole. Whatever happens meanwhile follows on it.
pub(crate) async fn snapshot(store: Store, state: Arc<State>) {
    let seq = state.seq;
    let text = effects::blocking(move || journal::snapshot(&state)).await;
    match store.write(vec![Write::Snapshot { seq, state: text }]).await {
        Ok(()) => tracing::debug!(seq, "stored a snapshot"),
        // The facts are there; only the next start takes longer.
        Err(error) => tracing::warn!(seq, %error, "no snapshot"),
    }
}
