//! Calls of workers: join, poll, leave.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;
use std::time::Duration;

use axum::Json;
use axum::extract::State;
use protocol::WorkerId;
use protocol::message::{DesiredAssignments, Gone, Join, Joined, PROTOCOL_VERSION, Poll};
use protocol::proof::Process;
use protocol::stage::StageSettings;

use super::actor_handle::ActorHandle;
use super::body::Message;
use super::extract::Path;
use super::failure::Failure;
use super::line::Line;
use super::secrets::Proof;
use crate::event::{Effect, Event};
use crate::rejected::Rejected;

pub(crate) async fn join(
    State(actor_handle): State<Arc<ActorHandle>>,
    proof: Proof,
    Message(join, _): Message<Join>,
) -> Result<Json<Joined>, Failure> {
    if join.protocol != PROTOCOL_VERSION {
        let message = format!(
            "worker `{}` uses version {} of the protocol, this coordinator uses {PROTOCOL_VERSION}; use one build for both",
            join.worker, join.protocol
        );
        return Err(Rejected::Invalid(message).into());
    }
    let other = other_code(&join.code_versions, &StageSettings::code_versions());
    if !other.is_empty() {
        let message = format!(
            "worker `{}` computes other versions of stage kinds than this coordinator: {}; use one build for both",
            join.worker,
            other.join(", ")
        );
        return Err(Rejected::Invalid(message).into());
    }
    let by = proof.of_join(&join.worker)?;
    let effects = actor_handle.decide(Event::Join { join, by }).await?;
    let incarnation = effects.into_iter().find_map(|effect| match effect {
        Effect::Joined(incarnation) => Some(incarnation),
        _ => None,
    });
    let policy = actor_handle.state().policy.clone();
    let incarnation = incarnation.expect("a join gives an incarnation");
    Ok(Json(Joined { incarnation, lease_ms: policy.lease_ms, poll_ms: policy.idle_poll_ms() }))
}

/// Most kinds that a refusal names.
const NAMED: usize = 3;

/// Says which kinds have another version in `found` than in `expected`; kinds without one have version 1.
fn other_code(found: &BTreeMap<String, u32>, expected: &BTreeMap<String, u32>) -> Vec<String> {
    let version = |versions: &BTreeMap<String, u32>, kind: &str| versions.get(kind).copied().unwrap_or(1);
    let kinds: BTreeSet<&String> = found.keys().chain(expected.keys()).collect();
    let other = kinds.into_iter().filter(|kind| version(found, kind) != version(expected, kind));
    let says = |kind: &String| {
        format!("`{}` {} instead of {}", kind.escape_debug(), version(found, kind), version(expected, kind))
    };
    other.take(NAMED).map(says).collect()
}

/// Answers at once if the worker's orders have changed, otherwise after `poll_ms`, or later if there is nothing to report.
pub(crate) async fn poll(
    State(actor_handle): State<Arc<ActorHandle>>,
    Path(worker): Path<WorkerId>,
    proof: Proof,
    Message(poll, _): Message<Poll>,
) -> Result<Json<DesiredAssignments>, Failure> {
    let process = Process { worker, incarnation: poll.incarnation };
    proof.of_process(&actor_handle.state(), &process)?;
    let line = Line::new(Arc::clone(&actor_handle), process.clone());
    let answer = desired(&actor_handle, &proof, process, poll).await;
    line.answered();
    answer
}

async fn desired(
    actor_handle: &ActorHandle,
    proof: &Proof,
    Process { worker, incarnation }: Process,
    poll: Poll,
) -> Result<Json<DesiredAssignments>, Failure> {
    let (version, has_work) = (poll.version, !poll.doing.is_empty());
    let mut changes = actor_handle.changes();
    let mut stopped = actor_handle.stopped();
    let begun = tokio::time::Instant::now();
    actor_handle.poll(worker.clone(), poll).await?;
    loop {
        changes.mark_unchanged();
        let state = actor_handle.state();
        let mut desired = state.desired(&worker, incarnation)?;
        for assignment in &mut desired.assignments {
            assignment.secret = actor_handle.secrets.of_grant(&proof.caller.name, &assignment.grant);
        }
        if desired.version != version {
            return Ok(Json(desired));
        }
        let is_idle = !has_work && desired.assignments.is_empty() && desired.prepare.is_empty();
        let wait = if is_idle { state.policy.idle_poll_ms() } else { state.policy.poll_ms };
        let deadline = begun + Duration::from_millis(wait);
        drop(state);
        tokio::select! {
            changed = tokio::time::timeout_at(deadline, changes.changed()) => {
                if !matches!(changed, Ok(Ok(()))) {
                    return Ok(Json(desired));
                }
            }
            _ = stopped.wait_for(|stop| *stop) => return Err(actor_handle.over().into()),
        }
    }
}

pub(crate) async fn gone(
    State(actor_handle): State<Arc<ActorHandle>>,
    Path(worker): Path<WorkerId>,
    proof: Proof,
    Message(gone, _): Message<Gone>,
) -> Result<Json<()>, Failure> {
    let process = Process { worker, incarnation: gone.incarnation };
    proof.of_process(&actor_handle.state(), &process)?;
    let Process { worker, incarnation } = process;
    actor_handle.decide(Event::WorkerGone { worker, incarnation: Some(incarnation) }).await?;
    Ok(Json(()))
}
