//! Execution of effects. Every effect may be executed twice, because recovery requests it again; each is answered with
//! an event.

use std::sync::Arc;
use std::time::Duration;

use checkpoint::{BlobError, model};
use protocol::artifact::Role;
use protocol::{Alias, Digest, Owner, RunId, StageName, TaskId};
use registry::blob::{IDLE, ManifestError, Protected};
use registry::{BlobStore, QueryError};
use tokio::sync::watch;

use super::actor_handle::ActorHandle;
use super::clock::wall_clock;
use crate::batch::Refused;
use crate::event::{Effect, Event, Observation};
use crate::value::{Candidate, Known};

/// Delay before a failed read of the store is repeated.
const RETRY: Duration = Duration::from_secs(1);
/// Interval between garbage collections.
const COLLECT_EVERY: Duration = Duration::from_secs(15 * 60);

/// Starts the execution of `effect`.
pub(crate) fn perform(actor_handle: &Arc<ActorHandle>, effect: &Effect) {
    let actor_handle = Arc::clone(actor_handle);
    match effect.clone() {
        // These are already done, or they answer the sender of the event.
        Effect::Store(_) | Effect::Submitted(_) | Effect::Joined(_) | Effect::Wake => {}
        Effect::Lookup { key } => {
            let looking = look_up(Arc::clone(&actor_handle), key);
            drop(actor_handle.spawn("the lookup of a stage's value", looking));
        }
        Effect::Register { key, candidates, promotes, owner } => {
            let registering = register(Arc::clone(&actor_handle), key, candidates, promotes, owner);
            drop(actor_handle.spawn("the registration of a model", registering));
        }
        Effect::Prune { task, keep, at_end } => drop(tokio::spawn(async move {
            // The next checkpoint prunes again.
            if let Err(error) = actor_handle.store.prune_checkpoints(&task, keep, at_end).await {
                tracing::warn!(%task, %error, "cannot delete old checkpoints");
            }
        })),
    }
}

async fn tell(actor_handle: &ActorHandle, event: Event) {
    loop {
        match actor_handle.decide(event.clone()).await {
            Ok(_) | Err(Refused::Stopped | Refused::Failed(_)) => return,
            // The state has changed, or another event has replaced this one.
            Err(Refused::Rejected(rejected)) => return tracing::debug!(%rejected, "moot"),
            Err(Refused::Write(error)) => {
                tracing::warn!(%error, "not stored; trying again");
                if let registry::WriteError::Gate(_)
                | registry::WriteError::Conflict(_)
                | registry::WriteError::NotFound(_)
                | registry::WriteError::Superseded { .. } = error
                {
                    return;
                }
            }
        }
        tokio::time::sleep(RETRY).await;
    }
}

async fn look_up(actor_handle: Arc<ActorHandle>, key: Digest) {
    let event = loop {
        match looked_up(&actor_handle, key).await {
            Ok(event) => break event,
            Err(error) => tracing::warn!(%key, %error, "cannot look up a stage"),
        }
        tokio::time::sleep(RETRY).await;
    };
    tell(&actor_handle, event).await;
}

async fn looked_up(actor_handle: &ActorHandle, key: Digest) -> Result<Event, QueryError> {
    if let Some((known, source)) = known(actor_handle, key).await? {
        return Ok(Event::LookedUp { key, known: Some(known), source: Some(source), archived: None });
    }
    let archived = actor_handle.store.archived_execution(key).await?;
    let archived = archived.and_then(|text| match serde_json::from_str(&text) {
        Ok(execution) => Some(execution),
        Err(error) => {
            tracing::warn!(%key, %error, "cannot read the state of an earlier try; the stage starts from scratch");
            None
        }
    });
    Ok(Event::LookedUp { key, known: None, source: None, archived })
}

/// Looks up a stage's value. It counts as known only if its artifacts are complete and intact; otherwise it is
/// recomputed, which repairs it.
async fn known(actor_handle: &ActorHandle, key: Digest) -> Result<Option<(Known, (RunId, StageName))>, QueryError> {
    let Some(row) = actor_handle.store.stage_result(key).await? else { return Ok(None) };
    let outputs = row.outputs.clone();
    let look = move |blobs: &BlobStore| outputs.values().find_map(|output| blobs.flaw(*output).transpose()).transpose();
    let flaw = actor_handle.store.ask_blobs(look).await.map_err(|e| QueryError::Blob(e.to_string()))?;
    if let Some(flaw) = &flaw {
        tracing::warn!(%key, "a stage's value is incomplete in the store and is recomputed: {flaw}");
        if let Err(error) = actor_handle.store.doubt(flaw).await {
            tracing::warn!(%key, %error, "cannot record that the blob is missing; the store still lists it");
        }
    }
    let known = Known { outputs: row.outputs, metrics: row.metrics };
    Ok(flaw.is_none().then_some((known, (row.run, row.stage))))
}

async fn register(
    actor_handle: Arc<ActorHandle>,
    key: Digest,
    candidates: Vec<Candidate>,
    promotes: Option<Alias>,
    owner: Owner,
) {
    // The token may have been revoked, or the alias protected, since the run was submitted.
    if let Some(alias) = promotes
        && let Err(why) = actor_handle.may_promote(&owner, &alias)
    {
        let message = format!("`promote.to: {alias}`: {why}; nothing was registered");
        return tell(&actor_handle, Event::RegisterRefused { key, message }).await;
    }
    loop {
        match try_to_register(&actor_handle, key, &candidates).await {
            Ok(()) => return,
            Err(away) => tracing::warn!(%key, %away, "cannot register a model; trying again"),
        }
        tokio::time::sleep(RETRY).await;
    }
}

async fn try_to_register(actor_handle: &ActorHandle, key: Digest, candidates: &[Candidate]) -> Result<(), Unbundled> {
    let candidates = candidates.to_vec();
    let event = match actor_handle.store.ask_blobs(move |blobs| bundles(blobs, &candidates)).await {
        Ok((bundles, protected)) => {
            tell(actor_handle, Event::Bundled { key, bundles }).await;
            // Rows now name the bundles.
            drop(protected);
            return Ok(());
        }
        Err(Unbundled::Refused(message)) => Event::RegisterRefused { key, message },
        Err(away @ Unbundled::Away(_)) => return Err(away),
    };
    tell(actor_handle, event).await;
    Ok(())
}

/// The reason why bundles are missing.
#[derive(Debug, thiserror::Error)]
enum Unbundled {
    /// The blob storage does not answer.
    #[error("{0}")]
    Away(String),
    /// The bundles cannot be made.
    #[error("{0}")]
    Refused(String),
}

/// Stores the bundles. The returned guards protect them from garbage collection.
fn bundles(blobs: &BlobStore, candidates: &[Candidate]) -> Result<(Vec<Digest>, Vec<Protected>), Unbundled> {
    candidates
        .iter()
        .map(|candidate| {
            let at = |e: &dyn std::fmt::Display| {
                Unbundled::Refused(format!("cannot assemble the model of stage `{}`: {e}", candidate.stage))
            };
            let unread = |e: ManifestError| match e {
                ManifestError::Blob(BlobError::Unreachable(why)) => Unbundled::Away(why),
                e => at(&e),
            };
            let given = blobs.manifest(candidate.model).map_err(unread)?;
            let part = |(role, digest): (&Role, &Digest)| Ok((role.clone(), blobs.manifest(*digest).map_err(unread)?));
            let parts = candidate.parts.iter().map(part).collect::<Result<_, Unbundled>>()?;
            let model = model::extend(&given, candidate.sampler.as_ref(), &parts).map_err(|e| at(&e))?.to_bytes();
            let protected = blobs.protect(Digest::of(&model));
            let stored = blobs.put(&model).map_err(|e| unread(ManifestError::Blob(e)))?;
            Ok((stored, protected))
        })
        .collect::<Result<Vec<_>, _>>()
        .map(|bundles| bundles.into_iter().unzip())
}

/// Releases uploads of tasks that are no longer held.
pub(crate) async fn let_go(actor_handle: &ActorHandle) {
    let state = actor_handle.state();
    let is_held = |task: &TaskId| state.task(task).is_ok_and(|(_, task)| !task.holders().is_empty());
    if let Err(error) = actor_handle.store.let_go(IDLE, is_held).await {
        tracing::warn!(%error, "the uploads of ended tasks stay until the next start");
    }
}

/// Decides the limits of groups if the token file has changed them.
async fn apply_limits(actor_handle: &ActorHandle) {
    let limits = actor_handle.tokens.current().limits();
    if limits == *actor_handle.state().policy.limits {
        return;
    }
    match actor_handle.decide(Event::Limits { limits: Arc::new(limits) }).await {
        Ok(_) | Err(Refused::Stopped | Refused::Failed(_)) => {}
        Err(error) => tracing::warn!(%error, "new limits were not stored; trying again"),
    }
}

/// Runs the timer until the coordinator stops. It does not wait for a tick to be handled, which may take as long as the
/// disk does. Only its own late wake-ups therefore indicate that this process received no polls.
pub(crate) async fn tick(actor_handle: Arc<ActorHandle>, every_ms: u64, mut stopped: watch::Receiver<bool>) {
    let every = Duration::from_millis(every_ms.max(1));
    let mut collected = tokio::time::Instant::now();
    let mut overslept = Duration::ZERO;
    let mut pending = None::<tokio::task::JoinHandle<()>>;
    loop {
        let begun = tokio::time::Instant::now();
        tokio::select! {
            biased;
            _ = stopped.wait_for(|stop| *stop) => return,
            () = tokio::time::sleep(every) => {}
        }
        overslept += begun.elapsed().saturating_sub(every);
        if pending.as_ref().is_none_or(tokio::task::JoinHandle::is_finished) {
            let actor_handle = Arc::clone(&actor_handle);
            let overslept = u64::try_from(std::mem::take(&mut overslept).as_millis()).unwrap_or(u64::MAX);
            pending = Some(tokio::spawn(async move {
                apply_limits(&actor_handle).await;
                match actor_handle.observe(Observation::Tick { overslept }).await {
                    Ok(()) | Err(Refused::Stopped | Refused::Failed(_)) => {}
                    Err(error) => tracing::warn!(%error, "a tick was not stored; trying again"),
                }
            }));
        }
        if collected.elapsed() > COLLECT_EVERY {
            collected = tokio::time::Instant::now();
            let actor_handle = Arc::clone(&actor_handle);
            tokio::spawn(async move {
                let_go(&actor_handle).await;
                if let Err(error) = actor_handle.store.gc(registry::retention::GRACE_MS).await {
                    tracing::warn!(%error, "garbage collection failed");
                }
                let kept = i64::try_from(actor_handle.allowances.history.as_millis()).unwrap_or(i64::MAX);
                let now = i64::try_from(wall_clock().0).unwrap_or(i64::MAX);
                if let Err(error) = actor_handle.store.prune_history(now.saturating_sub(kept)).await {
                    tracing::warn!(%error, "cannot delete old history");
                }
            });
        }
    }
}
