//! Workers: joining, polling, and what their launcher saw.

use std::sync::Arc;
use std::time::Duration;

use axum::Json;
use axum::extract::{Path, State};
use protocol::WorkerId;
use protocol::message::{Join, Joined, Orders, PROTOCOL_VERSION, Poll};

use super::actor::{Desk, Refused};
use super::api::Failure;
use crate::event::{Effect, Event, Rejected};

pub(crate) async fn join(State(desk): State<Arc<Desk>>, Json(join): Json<Join>) -> Result<Json<Joined>, Failure> {
    // Here and not in `decide`: the journal keeps the joins of earlier versions, and must replay.
    if join.protocol != PROTOCOL_VERSION {
        let message = format!(
            "worker `{}` speaks version {} of the protocol, this coordinator speaks {PROTOCOL_VERSION}; use one build for both",
            join.worker, join.protocol
        );
        return Err(Rejected::Invalid(message).into());
    }
    let effects = desk.decide(Event::Join { join }).await?;
    let incarnation = effects.into_iter().find_map(|effect| match effect {
        Effect::Joined(incarnation) => Some(incarnation),
        _ => None,
    });
    let policy = desk.state().policy.clone();
    let incarnation = incarnation.expect("a join gives an incarnation");
    Ok(Json(Joined { incarnation, lease_ms: policy.lease_ms, poll_ms: policy.poll_ms }))
}

/// Answers at once when the worker's orders are not those it knows, else within `poll_ms`.
pub(crate) async fn poll(
    State(desk): State<Arc<Desk>>,
    Path(worker): Path<WorkerId>,
    Json(poll): Json<Poll>,
) -> Result<Json<Orders>, Failure> {
    let (incarnation, version) = (poll.incarnation, poll.version);
    let mut changes = desk.changes();
    let mut stopped = desk.stopped();
    let deadline = tokio::time::Instant::now() + Duration::from_millis(desk.state().policy.poll_ms);
    desk.poll(worker.clone(), poll).await?;
    loop {
        changes.mark_unchanged();
        let orders = desk.state().orders(&worker, incarnation)?;
        if orders.version != version {
            return Ok(Json(orders));
        }
        tokio::select! {
            changed = tokio::time::timeout_at(deadline, changes.changed()) => {
                if !matches!(changed, Ok(Ok(()))) {
                    return Ok(Json(orders));
                }
            }
            _ = stopped.wait_for(|stop| *stop) => return Err(Refused::Stopped.into()),
        }
    }
}

pub(crate) async fn gone(State(desk): State<Arc<Desk>>, Path(worker): Path<WorkerId>) -> Result<Json<()>, Failure> {
    desk.decide(Event::WorkerGone { worker }).await?;
    Ok(Json(()))
}
