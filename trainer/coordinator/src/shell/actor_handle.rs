//! Access to the actor for other tasks: requests, the newest stored state, and the actor's health.

use std::future::Future;
use std::panic::AssertUnwindSafe;
use std::sync::{Arc, Mutex, OnceLock, PoisonError};

use futures::FutureExt as _;
use pipeline::Pipeline;
use protocol::message::{Poll, RunView, StorageProblem, Submit};
use protocol::stage::Register;
use protocol::units::size;
use protocol::{Alias, Digest, Group, ModelName, Owner, RunId, StageName, WorkerId, canonical, limits};
use registry::{Proof, QueryError, ReadStore, RunRow, Store, WriteError};
use tokio::sync::{Semaphore, mpsc, oneshot, watch};
use tokio::task::JoinHandle;

use super::allowances::Allowances;
use super::blocking::blocking;
use super::clock::{Clock, wall_clock, wall_ms};
use super::launchers::Launchers;
use super::lines::Lines;
use super::meters::Meters;
use super::records::{Records, read};
use super::run_times::TimesCache;
use super::secrets::Secrets;
use super::storage::{self, unless_away};
use super::streams::Streams;
use super::token_table::TokenTable;
use super::versions::resolve_versions;
use super::vouching::Reach;
use crate::batch::{Ask, Front, Refused};
use crate::decide::outcome::refused_for_good;
use crate::event::{Effect, Event, Observation};
use crate::rejected::Rejected;
use crate::state::State;
use crate::state::run::Control;
use crate::time::Millis;

/// Maximum number of requests in the queue; further callers wait for room.
const QUEUE: usize = 1024;

/// The sender for the answer to a request.
pub(super) type Reply = oneshot::Sender<Result<Vec<Effect>, Refused>>;

/// A submission by its idempotency key.
struct Sent {
    /// The key as the client wrote it, for messages.
    shown: String,
    /// The key among those of its owner; without one, each submission is a run.
    key: Option<String>,
    /// Digest of the submission.
    digest: Option<Digest>,
}

impl Sent {
    /// Takes the key out of `submit`.
    fn of(submit: &mut Submit, owner: &Owner) -> Self {
        let shown = submit.idempotency_key.take();
        let key = shown.as_ref().map(|key| owner.group().key(key));
        let digest = key.is_some().then(|| canonical::digest(&*submit));
        Self { shown: shown.unwrap_or_default(), key, digest }
    }

    /// Refuses a run with this key of another submission.
    fn check(&self, row: &RunRow) -> Result<(), Refused> {
        match (&row.submission, &self.digest) {
            (Some(stored), Some(sent)) if *stored != sent.to_string() => {
                let key = &self.shown;
                let message = format!("idempotency key `{key}` belongs to another submission, run `{}`", row.run);
                Err(Refused::from(Rejected::Conflict(message)))
            }
            _ => Ok(()),
        }
    }
}

/// State shared between the actor and its callers.
#[derive(Debug)]
pub(crate) struct ActorHandle {
    asks: mpsc::Sender<(Ask, Reply)>,
    /// Permits for calls of clients, and for batches that go to the disk without the actor.
    pub(crate) clients: Semaphore,
    pub(crate) batches: Semaphore,
    /// Permits for reading much data, and for waiting to do so.
    pub(crate) reads: Semaphore,
    pub(crate) readers: Semaphore,
    /// Limits of runs and tokens.
    pub(crate) allowances: Allowances,
    front: Arc<Front>,
    /// The state of the newest stored snapshot.
    pub(super) snapshot: tokio::sync::Mutex<Arc<State>>,
    changed: watch::Sender<u64>,
    trouble: Mutex<Option<StorageProblem>>,
    failure: OnceLock<String>,
    stop: watch::Sender<bool>,
    clock: Clock,
    /// The current tokens and their permissions.
    pub(crate) tokens: Arc<TokenTable>,
    pub(crate) store: Store,
    pub(crate) secrets: Secrets,
    pub(crate) reach: Arc<Reach>,
    pub(crate) meters: Meters,
    pub(crate) streams: Streams,
    pub(crate) launchers: Launchers,
    pub(crate) lines: Lines,
    times: Arc<TimesCache>,
}

impl ActorHandle {
    /// Creates a handle and its queue of requests.
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
            meters: Meters::default(),
            streams: Streams::default(),
            launchers: Launchers::default(),
            lines: Lines::default(),
            times: Arc::default(),
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
        // The actor has ended. A panic message becomes available only after all of its data was dropped.
        let _ = self.stopped().wait_for(|stop| *stop).await;
        Err(self.over())
    }

    /// The reason why requests are no longer answered.
    pub(crate) fn over(&self) -> Refused {
        self.failure.get().map_or(Refused::Stopped, |failure| Refused::Failed(failure.clone()))
    }

    /// Decides an event and returns once it is stored. Artifacts that rows will name are proven complete before the
    /// event is queued, so that only the caller waits for the blob storage.
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
                // The event names an artifact committed earlier, or a garbage collection has run meanwhile.
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

    /// Decides the replacement of an event whose artifact is incomplete for good; returns the reason of the refusal.
    async fn refused(&self, event: &Event, error: WriteError) -> Refused {
        let Some(instead) = refused_for_good(event, &error) else { return error.into() };
        tracing::warn!(%error, "refused: a named artifact is incomplete");
        match self.ask(Ask::Event(Box::new(instead))).await {
            Ok(_) => error.into(),
            Err(refused) => refused,
        }
    }

    /// Notes an observation and decides its consequences.
    pub(crate) async fn observe(&self, observation: Observation) -> Result<(), Refused> {
        self.ask(Ask::Observation(observation, self.now())).await.map(drop)
    }

    /// Notes a poll and returns once its consequences are stored.
    pub(crate) async fn poll(&self, worker: WorkerId, poll: Poll) -> Result<(), Refused> {
        match self.front.poll(self.now(), worker, poll)? {
            None => Ok(()),
            Some(ask) => self.ask(ask).await.map(drop),
        }
    }

    /// Submits a pipeline of `owner`, who sees the models of group `sees`, or all models if it is `None`.
    pub(crate) async fn submit(&self, mut submit: Submit, owner: Owner, sees: Option<Group>) -> Result<RunId, Refused> {
        let sent = Sent::of(&mut submit, &owner);
        // A large pipeline takes a while, so it is parsed outside the threads that answer heartbeats.
        let read = blocking(move || {
            let pipeline: Pipeline = serde_json::from_value(submit.pipeline)
                .map_err(|e| format!("cannot parse the pipeline: {e}; use the same build for client and server"))?;
            pipeline.check()?;
            Ok(pipeline)
        });
        let mut pipeline = read.await.map_err(Rejected::Invalid)?;
        // A run submitted earlier already has its versions.
        if let Some(run) = self.sent_before(&sent).await? {
            return Ok(run);
        }
        self.check_bytes(&owner.group()).await?;
        self.check_registrations(&pipeline, &owner).await?;
        let seen = self.seen_store(sees.as_ref());
        resolve_versions(&mut pipeline, &seen).await.map_err(|error| match error {
            QueryError::NotFound(why) | QueryError::Invalid(why) => Refused::from(Rejected::Invalid(why)),
            error => Refused::from(WriteError::from(error)),
        })?;
        self.enter(pipeline, (submit.source, submit.until), owner, sent).await
    }

    /// Submits a pipeline that the server made and that reads no versions.
    pub(crate) async fn submit_own(
        &self,
        pipeline: Pipeline,
        mut submit: Submit,
        owner: Owner,
    ) -> Result<RunId, Refused> {
        let sent = Sent::of(&mut submit, &owner);
        self.enter(pipeline, (submit.source, submit.until), owner, sent).await
    }

    /// The run of an earlier submission with the same idempotency key.
    async fn sent_before(&self, sent: &Sent) -> Result<Option<RunId>, Refused> {
        let Some(key) = &sent.key else { return Ok(None) };
        let Some(row) = self.store.run_by_key(key).await.map_err(WriteError::from)? else { return Ok(None) };
        sent.check(&row)?;
        Ok(Some(row.run))
    }

    /// Decides a submission, once for each idempotency key.
    async fn enter(
        &self,
        pipeline: Pipeline,
        (source, until): (String, Option<StageName>),
        owner: Owner,
        sent: Sent,
    ) -> Result<RunId, Refused> {
        let event = Event::Submit {
            pipeline: Box::new(pipeline),
            source,
            idempotency_key: sent.key.clone(),
            submission: sent.digest,
            until,
            owner,
        };
        let mut tries = 0;
        loop {
            // An ended run is only in the tables.
            if let Some(run) = self.sent_before(&sent).await? {
                return Ok(run);
            }
            tries += 1;
            match self.decide(event.clone()).await {
                // Another run with this key was submitted after the lookup and has already ended.
                Err(Refused::Write(WriteError::Conflict(_))) if sent.key.is_some() && tries < 3 => {}
                decided => {
                    let run = decided?.into_iter().find_map(|effect| match effect {
                        Effect::Submitted(run) => Some(run),
                        _ => None,
                    });
                    let run = run.expect("a submission gives a run");
                    // Another submission with this key may have been decided just before.
                    if sent.key.is_some()
                        && let Some(row) = self.store.run(&run).await.map_err(WriteError::from)?
                    {
                        sent.check(&row)?;
                    }
                    return Ok(run);
                }
            }
        }
    }

    /// Refuses a submission of a group that has stored as much as it may.
    async fn check_bytes(&self, group: &Group) -> Result<(), Refused> {
        let Some(most) = self.state().policy.limits_of(group).bytes else { return Ok(()) };
        let stored = self.store.group_bytes(group).await.map_err(WriteError::from)?;
        if stored < most {
            return Ok(());
        }
        let message = format!("{group} has stored {}; the limit is {}", size(stored), size(most));
        Err(Rejected::UsedUp(message).into())
    }

    /// Refuses a pipeline that would move an alias or extend a model without the owner's permission.
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

    /// Checks that the token of a run's owner may currently move an alias of its own models.
    pub(crate) fn may_promote(&self, owner: &Owner, alias: &Alias) -> Result<(), String> {
        self.tokens.current().may_move(owner.into(), alias, Some(&owner.group()), wall_clock().0)
    }

    /// The group that owns a model.
    pub(crate) async fn model_owner(&self, model: &ModelName) -> Result<Option<Group>, WriteError> {
        Ok(self.store.model_owners(Some(model)).await?.remove(model))
    }

    /// The group that owns a run, active or ended.
    pub(crate) async fn run_owner(&self, run: &RunId) -> Result<Option<Group>, WriteError> {
        match self.state().run(run) {
            Ok(run) => Ok(Some(run.owner.group())),
            Err(_) => Ok(self.store.run_owners(std::slice::from_ref(run)).await?.remove(run)),
        }
    }

    /// The store as group `sees` sees it, or all of it if `sees` is `None`.
    pub(crate) fn seen_store(&self, sees: Option<&Group>) -> ReadStore {
        match sees {
            Some(group) => self.store.seen_by(group),
            None => ReadStore::clone(&self.store),
        }
    }

    /// Controls a run, active or ended.
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
                // The run ended after the lookup.
                Err(Refused::Rejected(Rejected::NotFound(_))) if looked_too_early && tries < 3 => {}
                decided => return decided.map(drop),
            }
        }
    }

    /// A run as clients see it, active or ended.
    pub(crate) async fn run_view(&self, run: &RunId) -> Result<RunView, Refused> {
        self.records().run_view(run).await
    }

    /// Current records of all runs. The state is read before the tables, so that a run that ends in between is in both
    /// rather than in neither.
    pub(crate) fn records(&self) -> Records {
        self.records_for(None)
    }

    /// Current records as group `sees` sees them, or all of them.
    pub(crate) fn records_for(&self, sees: Option<Group>) -> Records {
        let state = self.state();
        let now = self.now();
        Records::new(self.seen_store(sees.as_ref()), state, now, sees).with_times(Arc::clone(&self.times))
    }

    /// The newest stored state.
    pub(crate) fn state(&self) -> Arc<State> {
        self.front.state()
    }

    /// Notifies of a durable change.
    pub(super) fn change(&self) {
        self.changed.send_modify(|version| *version += 1);
    }

    /// A receiver that is notified of every durable change.
    pub(crate) fn changes(&self) -> watch::Receiver<u64> {
        self.changed.subscribe()
    }

    /// The reason why the store refuses writes, if it does.
    pub(crate) fn trouble(&self) -> Option<String> {
        let trouble = self.trouble.lock().unwrap_or_else(PoisonError::into_inner);
        trouble.as_ref().map(|problem| problem.what.clone())
    }

    /// The current problem of the store's disk or of the blob storage.
    pub(crate) fn storage(&self) -> Option<StorageProblem> {
        let trouble = self.trouble.lock().unwrap_or_else(PoisonError::into_inner).clone();
        trouble.or_else(|| storage::problem(&self.store))
    }

    /// The message of the first panic, if any.
    pub(crate) fn failure(&self) -> Option<&str> {
        self.failure.get().map(String::as_str)
    }

    /// Stops the coordinator because `what` panicked.
    fn fail(&self, what: &str, panic: &(dyn std::any::Any + Send)) {
        let said = panic.downcast_ref::<String>().map(String::as_str).or(panic.downcast_ref::<&str>().copied());
        let message = format!("{what} panicked: {}", said.unwrap_or("without a message"));
        tracing::error!("{message}");
        // The first panic counts; later ones are usually its consequences.
        let _ = self.failure.set(message);
        self.stop();
        self.change();
    }

    /// Returns true unless another process may lead the catalog.
    pub(crate) fn leads(&self) -> bool {
        self.store.leadership().is_none_or(registry::Leadership::leads)
    }

    /// Stops the coordinator once another process leads the catalog.
    pub(crate) async fn end_when_superseded(self: Arc<Self>, mut stopped: watch::Receiver<bool>) {
        let Some(leadership) = self.store.leadership() else { return };
        tokio::select! {
            // An error means that the coordinator has ended.
            _ = stopped.wait_for(|stop| *stop) => {}
            () = leadership.superseded() => {
                let message = format!("another process leads the catalog; this one's epoch {} is over", leadership.epoch());
                tracing::error!("{message}");
                let _ = self.failure.set(message);
                self.stop();
                self.change();
            }
        }
    }

    /// Starts an essential task. If it panics, the coordinator has failed.
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

    /// Updates the store's problem from the result of a write.
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

    pub(crate) fn now(&self) -> Millis {
        self.clock.now()
    }

    /// Stops the actor and everything that waits for it.
    pub(crate) fn stop(&self) {
        let _ = self.stop.send(true);
    }

    /// A receiver that becomes true when the coordinator stops.
    pub(crate) fn stopped(&self) -> watch::Receiver<bool> {
        self.stop.subscribe()
    }
}
