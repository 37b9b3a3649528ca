//! The one task that decides. Events come over a queue; what has gathered there is decided and answered by [`Batches`], which
//! says what to store and does no more than that. This file brings the queue, the clock and the disk.
//!
//! If a part without which nothing goes on panics, the coordinator has failed: everybody who waits and everybody who comes is told so
//! at once, and [`Handle::trouble`](super::Handle::trouble) says it to whoever runs the process. What was acknowledged is stored.

use std::future::Future;
use std::panic::AssertUnwindSafe;
use std::sync::{Arc, Mutex, OnceLock, PoisonError};
use std::time::{Instant, SystemTime, UNIX_EPOCH};

use futures::FutureExt as _;
use protocol::message::{Poll, RunView, Submit};
use protocol::pipeline::Pipeline;
use protocol::{Digest, RunId, WorkerId, limits};
use registry::{ReadStore, Store, Write, WriteError};
use tokio::sync::{Semaphore, mpsc, oneshot, watch};
use tokio::task::JoinHandle;

use super::{Records, effects};
use crate::batch::{Ask, Batches, Done, Front, Refused, Turn};
use crate::event::{Control, Effect, Event, Millis, Moment, Observation, Rejected};
use crate::journal;
use crate::state::State;

/// How many asks wait for the actor; more wait for room.
const QUEUE: usize = 1024;

/// Where an answer goes.
type Reply = oneshot::Sender<Result<Vec<Effect>, Refused>>;

/// What is shared between the actor and those who ask it.
#[derive(Debug)]
pub(crate) struct ActorHandle {
    asks: mpsc::Sender<(Ask, Reply)>,
    /// Places for calls of clients, and for batches that go past the actor to the disk.
    pub(crate) clients: Semaphore,
    pub(crate) batches: Semaphore,
    front: Arc<Front>,
    changed: watch::Sender<u64>,
    trouble: Mutex<Option<String>>,
    failure: OnceLock<String>,
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
    async fn ask(&self, ask: Ask) -> Result<Vec<Effect>, Refused> {
        let (reply, receiver) = oneshot::channel();
        if self.asks.send((ask, reply)).await.is_ok()
            && let Ok(answer) = receiver.await
        {
            return answer;
        }
        // The actor is gone. What it panicked of is known only after all that it held was dropped.
        let _ = self.stopped().wait_for(|stop| *stop).await;
        Err(self.over())
    }

    /// Why nobody answers any more.
    pub(crate) fn over(&self) -> Refused {
        self.failure.get().map_or(Refused::Stopped, |failure| Refused::Failed(failure.clone()))
    }

    /// Decides an event; returns once it is stored.
    pub(crate) async fn decide(&self, event: Event) -> Result<Vec<Effect>, Refused> {
        self.ask(Ask::Event(Box::new(event))).await
    }

    /// Takes note of what was heard, and decides what follows from it.
    pub(crate) async fn observe(&self, observation: Observation) -> Result<(), Refused> {
        self.ask(Ask::Observation(observation, self.now())).await.map(drop)
    }

    /// Takes note of a poll; returns once what follows from it is stored.
    pub(crate) async fn poll(&self, worker: WorkerId, poll: Poll) -> Result<(), Refused> {
        match self.front.poll(self.now(), worker, poll)? {
            None => Ok(()),
            Some(ask) => self.ask(ask).await.map(drop),
        }
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

    /// The newest stored state.
    pub(crate) fn state(&self) -> Arc<State> {
        self.front.state()
    }

    /// Ticks with every durable change.
    pub(crate) fn changes(&self) -> watch::Receiver<u64> {
        self.changed.subscribe()
    }

    /// Why the store takes no writes, if it does not.
    pub(crate) fn trouble(&self) -> Option<String> {
        self.trouble.lock().unwrap_or_else(PoisonError::into_inner).clone()
    }

    /// What has panicked, if something has.
    pub(crate) fn failure(&self) -> Option<&str> {
        self.failure.get().map(String::as_str)
    }

    /// Nothing goes on from here: `what` has panicked.
    fn fail(&self, what: &str, panic: &(dyn std::any::Any + Send)) {
        let said = panic.downcast_ref::<String>().map(String::as_str).or(panic.downcast_ref::<&str>().copied());
        let message = format!("{what} panicked: {}", said.unwrap_or("it did not say why"));
        tracing::error!("{message}");
        // The first one tells; those that follow are mostly its consequences.
        let _ = self.failure.set(message);
        self.stop();
        self.changed.send_modify(|version| *version += 1);
    }

    /// Starts `part`, without which nothing goes on: if it panics, the coordinator has failed.
    pub(crate) fn spawn(
        self: &Arc<Self>,
        what: &'static str,
        part: impl Future<Output = ()> + Send + 'static,
    ) -> JoinHandle<()> {
        let actor_handle = Arc::clone(self);
        tokio::spawn(async move {
            if let Err(panic) = AssertUnwindSafe(part).catch_unwind().await {
                actor_handle.fail(what, &*panic);
            }
        })
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
    let (asks, queue) = mpsc::channel(QUEUE);
    let (clock, snapshot_at) = (Clock::new(state.now), state.seq);
    let batches = Batches::new(state);
    let actor_handle = Arc::new(ActorHandle {
        asks,
        clients: Semaphore::new(limits::CLIENTS_WAITING),
        batches: Semaphore::new(limits::BATCHES_WAITING),
        front: Arc::clone(batches.front()),
        changed: watch::Sender::new(0),
        trouble: Mutex::new(None),
        failure: OnceLock::new(),
        stop: watch::Sender::new(false),
        clock,
        store,
    });
    let moments = Moments { actor_handle: Arc::clone(&actor_handle), entropy: Entropy::new() };
    let actor = Actor { actor_handle: Arc::clone(&actor_handle), batches, moments, snapshot_at, snapshot: None };
    let task = actor_handle.spawn("the actor, which decides everything,", actor.run(queue));
    (actor_handle, task)
}

/// When events are decided, and what is unpredictable about them.
struct Moments {
    actor_handle: Arc<ActorHandle>,
    entropy: Entropy,
}

impl Moments {
    fn next(&mut self) -> Moment {
        Moment { now: self.actor_handle.now(), entropy: self.entropy.next() }
    }
}

struct Actor {
    actor_handle: Arc<ActorHandle>,
    batches: Batches<Reply>,
    moments: Moments,
    /// The decision at which the newest snapshot was begun.
    snapshot_at: u64,
    /// A snapshot on its way.
    snapshot: Option<JoinHandle<()>>,
}

impl Actor {
    async fn run(mut self, mut queue: mpsc::Receiver<(Ask, Reply)>) {
        let mut stopped = self.actor_handle.stopped();
        loop {
            if self.batches.is_idle() {
                let first = tokio::select! {
                    biased;
                    _ = stopped.wait_for(|stop| *stop) => return,
                    first = queue.recv() => first,
                };
                let Some((ask, reply)) = first else { return };
                self.batches.ask(ask, reply);
            }
            while self.batches.has_room()
                && let Ok((ask, reply)) = queue.try_recv()
            {
                self.batches.ask(ask, reply);
            }
            self.snapshot_if_due();
            fail::fail_point!("actor::decide");
            let mut turn = self.batches.decide(|| self.moments.next());
            while let Turn::Store(writes) = turn {
                let written = self.actor_handle.store.write(writes).await;
                self.actor_handle.wrote(&written);
                turn = self.batches.stored(written, || self.moments.next());
            }
            if let Turn::Done(done) = turn {
                self.done(done);
            }
        }
    }

    fn done(&self, done: Done<Reply>) {
        if done.durable {
            self.actor_handle.changed.send_modify(|version| *version += 1);
        }
        for (reply, answer) in done.answers {
            // Whoever asked may have gone away meanwhile; what was decided stands.
            let _ = reply.send(answer);
        }
        for effect in &done.effects {
            effects::perform(&self.actor_handle, effect);
        }
    }

    /// Stores the state as a whole every so many decisions, beside whatever goes on.
    fn snapshot_if_due(&mut self) {
        let state = self.batches.state();
        let is_over = self.snapshot.as_ref().is_none_or(JoinHandle::is_finished);
        if is_over && state.seq >= self.snapshot_at + state.policy.snapshot_every {
            self.snapshot_at = state.seq;
            let storing = snapshot(self.actor_handle.store.clone(), Arc::clone(state));
            self.snapshot = Some(self.actor_handle.spawn("the storing of a snapshot", storing));
        }
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
