//! The actor as everybody else sees it: what may be asked, the newest stored state, and whether anything still goes on.

use std::future::Future;
use std::panic::AssertUnwindSafe;
use std::sync::{Arc, Mutex, OnceLock, PoisonError};

use futures::FutureExt as _;
use protocol::message::{Poll, RunView, StorageProblem, Submit};
use protocol::pipeline::Pipeline;
use protocol::stage::Register;
use protocol::{Alias, Digest, Group, ModelName, Owner, RunId, WorkerId, limits};
use registry::{Proof, QueryError, ReadStore, Store, WriteError};
use tokio::sync::{Semaphore, mpsc, oneshot, watch};
use tokio::task::JoinHandle;

use super::allowances::Allowances;
use super::blocking::blocking;
use super::clock::{Clock, wall_clock, wall_ms};
use super::records::{Records, read};
use super::secrets::Secrets;
use super::storage::{self, unless_away};
use super::token_table::TokenTable;
use super::versions::resolve_versions;
use super::vouching::Reach;
use crate::batch::{Ask, Front, Refused};
use crate::event::{Effect, Event, Observation};
use crate::outcome::refused_for_good;
use crate::rejected::Rejected;
use crate::state::State;
use crate::state::run::Control;
use crate::time::Millis;

/// How many asks wait for the actor; more wait for room.
const QUEUE: usize = 1024;

/// Where an answer goes.
pub(super) type Reply = oneshot::Sender<Result<Vec<Effect>, Refused>>;

/// What is shared between the actor and those who ask it.
#[derive(Debug)]
pub(crate) struct ActorHandle {
    asks: mpsc::Sender<(Ask, Reply)>,
    /// Places for calls of clients, and for batches that go past the actor to the disk.
    pub(crate) clients: Semaphore,
    pub(crate) batches: Semaphore,
    /// Turns of questions that read much, and places to wait for one.
    pub(crate) reads: Semaphore,
    pub(crate) readers: Semaphore,
    /// Limits of runs and tokens.
    pub(crate) allowances: Allowances,
    front: Arc<Front>,
    /// The state of the newest snapshot that is stored.
    pub(super) snapshot: tokio::sync::Mutex<Arc<State>>,
    changed: watch::Sender<u64>,
    trouble: Mutex<Option<StorageProblem>>,
    failure: OnceLock<String>,
    stop: watch::Sender<bool>,
    clock: Clock,
    /// Who may do what now.
    pub(crate) tokens: Arc<TokenTable>,
    pub(crate) store: Store,
    pub(crate) secrets: Secrets,
    pub(crate) reach: Arc<Reach>,
}

impl ActorHandle {
    /// A handle, and the queue of what is asked through it.
    pub(super) fn new(
        store: Store,
        secrets: Secrets,
        now: Millis,
        front: Arc<Front>,
        tokens: Arc<TokenTable>,
        snapshot: State,
        allowances: Allowances,
    ) -> (Self, mpsc::Receiver<(Ask, Reply)>) {
        let (asks, queue) = mpsc::channel(QUEUE);
        let handle = Self {
            asks,
            clients: Semaphore::new(limits::CLIENTS_WAITING),
            batches: Semaphore::new(limits::BATCHES_WAITING),
            reads: Semaphore::new(limits::READS_AT_ONCE),
            readers: Semaphore::new(limits::READS_WAITING),
            allowances,
            front,
            snapshot: tokio::sync::Mutex::new(Arc::new(snapshot)),
            changed: watch::Sender::new(0),
            trouble: Mutex::new(None),
            failure: OnceLock::new(),
            stop: watch::Sender::new(false),
            clock: Clock::new(now),
            tokens,
            store,
            secrets,
            reach: Arc::default(),
        };
        (handle, queue)
    }

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

    /// Decides an event; returns once it is stored. What rows are to name is proven whole before it is queued, so that nobody but the
    /// asker waits for the place where the blobs lie.
    pub(crate) async fn decide(&self, event: Event) -> Result<Vec<Effect>, Refused> {
        let mut artifacts = event.artifacts();
        if artifacts.is_empty() {
            return self.ask(Ask::Event(Box::new(event))).await;
        }
        loop {
            let mut proofs = Vec::with_capacity(artifacts.len());
            for artifact in &artifacts {
                match self.prove(*artifact).await {
                    Ok(proof) => proofs.push(proof),
                    Err(error) => return Err(self.refused(&event, error).await),
                }
            }
            match self.ask(Ask::Event(Box::new(event.clone()))).await {
                // It names what was committed before; or a collection has come between.
                Err(Refused::Write(WriteError::Unproven { artifact })) => {
                    if !artifacts.contains(&artifact) {
                        artifacts.push(artifact);
                    }
                }
                decided => return decided,
            }
        }
    }

    async fn prove(&self, artifact: Digest) -> Result<Proof, WriteError> {
        let proven = unless_away(&self.store, self.store.prove(artifact)).await;
        proven.map_err(|away| WriteError::Unreachable(away.to_string()))?
    }

    /// What is decided instead of an event that names what is not whole, and never will be; gives why it was refused.
    async fn refused(&self, event: &Event, error: WriteError) -> Refused {
        let Some(instead) = refused_for_good(event, &error) else { return error.into() };
        tracing::warn!(%error, "refused, for what it names is not whole");
        match self.ask(Ask::Event(Box::new(instead))).await {
            Ok(_) => error.into(),
            Err(refused) => refused,
        }
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

    /// Submits a pipeline of `owner`, who sees the models of the group `sees`, or all.
    pub(crate) async fn submit(&self, mut submit: Submit, owner: Owner, sees: Option<Group>) -> Result<RunId, Refused> {
        submit.idempotency_key = submit.idempotency_key.map(|key| owner.group().key(&key));
        // Beside the threads that answer heartbeats: a large one takes a while.
        let read = blocking(move || {
            let pipeline: Pipeline = serde_json::from_value(submit.pipeline)
                .map_err(|e| format!("the pipeline does not parse: {e}; was it made by another build?"))?;
            pipeline.check()?;
            Ok(pipeline)
        });
        let mut pipeline = read.await.map_err(Rejected::Invalid)?;
        // One that was submitted before has its versions already.
        if let Some(key) = &submit.idempotency_key
            && let Some(row) = self.store.run_by_key(key).await.map_err(WriteError::from)?
        {
            return Ok(row.run);
        }
        self.check_registrations(&pipeline, &owner).await?;
        let seen = self.seen_store(sees.as_ref());
        resolve_versions(&mut pipeline, &seen).await.map_err(|error| match error {
            QueryError::NotFound(why) | QueryError::Invalid(why) => Refused::from(Rejected::Invalid(why)),
            error => Refused::from(WriteError::from(error)),
        })?;
        let event = Event::Submit {
            pipeline: Box::new(pipeline),
            source: submit.source,
            idempotency_key: submit.idempotency_key.clone(),
            until: submit.until,
            owner,
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

    /// Refuses a pipeline that would move an alias or add to a model that is not its owner's to change.
    async fn check_registrations(&self, pipeline: &Pipeline, owner: &Owner) -> Result<(), Refused> {
        for stage in &pipeline.stages {
            let Some(settings) = stage.settings.get::<Register>() else { continue };
            let forbidden = |why: &str| Rejected::Forbidden(format!("stage `{}`: {why}", stage.name));
            let invalid = |e: protocol::id::ParseNameError| Rejected::Invalid(format!("stage `{}`: {e}", stage.name));
            let model: ModelName = settings.model.parse().map_err(invalid)?;
            if self.store.model(&model).await.map_err(WriteError::from)?.is_some() {
                let group = self.model_owner(&model).await?;
                if !owner.admin && group.as_ref().is_none_or(|group| !owner.controls(group)) {
                    return Err(forbidden(&format!("model `{model}` belongs to another owner")).into());
                }
            }
            if settings.promote.to.is_empty() {
                continue;
            }
            let alias: Alias = settings.promote.to.parse().map_err(invalid)?;
            self.may_promote(owner, &alias).map_err(|why| forbidden(&format!("`promote.to: {alias}`: {why}")))?;
        }
        Ok(())
    }

    /// Why the token of a run's owner may not move an alias of its own models now.
    pub(crate) fn may_promote(&self, owner: &Owner, alias: &Alias) -> Result<(), String> {
        self.tokens.current().may_move(owner.into(), alias, Some(&owner.group()), wall_clock().0)
    }

    /// The group that a model belongs to.
    pub(crate) async fn model_owner(&self, model: &ModelName) -> Result<Option<Group>, WriteError> {
        Ok(self.store.model_owners(Some(model)).await?.remove(model))
    }

    /// The group that a run belongs to, whether it is in memory or has ended.
    pub(crate) async fn run_owner(&self, run: &RunId) -> Result<Option<Group>, WriteError> {
        match self.state().run(run) {
            Ok(run) => Ok(Some(run.owner.group())),
            Err(_) => Ok(self.store.run_owners(std::slice::from_ref(run)).await?.remove(run)),
        }
    }

    /// The store as one who sees the group `sees`, or all, sees it.
    pub(crate) fn seen_store(&self, sees: Option<&Group>) -> ReadStore {
        match sees {
            Some(group) => self.store.seen_by(group),
            None => ReadStore::clone(&self.store),
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
        self.records_for(None)
    }

    /// The same, for one who sees the group `sees`, or all.
    pub(crate) fn records_for(&self, sees: Option<Group>) -> Records {
        let (state, now) = (self.state(), self.now());
        Records::new(self.seen_store(sees.as_ref()), state, now, sees)
    }

    /// The newest stored state.
    pub(crate) fn state(&self) -> Arc<State> {
        self.front.state()
    }

    /// Says that something durable has changed.
    pub(super) fn change(&self) {
        self.changed.send_modify(|version| *version += 1);
    }

    /// Ticks with every durable change.
    pub(crate) fn changes(&self) -> watch::Receiver<u64> {
        self.changed.subscribe()
    }

    /// Why the store takes no writes, if it does not.
    pub(crate) fn trouble(&self) -> Option<String> {
        let trouble = self.trouble.lock().unwrap_or_else(PoisonError::into_inner);
        trouble.as_ref().map(|problem| problem.what.clone())
    }

    /// What is wrong with the store's disk or with the place where its blobs lie.
    pub(crate) fn storage(&self) -> Option<StorageProblem> {
        let trouble = self.trouble.lock().unwrap_or_else(PoisonError::into_inner).clone();
        trouble.or_else(|| storage::problem(&self.store))
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
        self.change();
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
            Err(error @ (WriteError::Storage(_) | WriteError::Superseded { .. })) => {
                let since_ms = trouble.as_ref().map_or_else(wall_ms, |problem| problem.since_ms);
                *trouble = Some(StorageProblem { since_ms, what: error.to_string() });
            }
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
