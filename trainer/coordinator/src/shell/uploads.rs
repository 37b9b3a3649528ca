//! What workers write. Every grant is checked twice: here against what the coordinator knows, which refuses most stale
//! writers before their bytes are read, and again inside the transaction, which is what counts.

use std::sync::Arc;

use axum::Json;
use axum::body::Bytes;
use axum::extract::{Path, State};
use axum::http::{HeaderMap, header};
use axum::response::IntoResponse;
use protocol::Digest;
use protocol::message::{CommitCheckpoint, Grant, LogBatch, MetricBatch, ReportOutcome};
use registry::{Write, WriteError};

use super::actor::ActorHandle;
use super::api::Failure;
use super::body::Message;
use super::effects::blocking;
use super::queries::BlobStored;
use crate::event::Event;

/// The header that carries a blob's grant, as JSON.
const GRANT_HEADER: &str = "x-stride-grant";

async fn write(actor_handle: &ActorHandle, write: Write) -> Result<Json<()>, Failure> {
    let written = actor_handle.store.write(vec![write]).await;
    actor_handle.wrote(&written);
    written?;
    Ok(Json(()))
}

pub(crate) async fn metrics(
    State(actor_handle): State<Arc<ActorHandle>>,
    Message(batch): Message<MetricBatch>,
) -> Result<Json<()>, Failure> {
    actor_handle.state().check_telemetry(&batch.grant)?;
    write(&actor_handle, Write::Metrics { grant: batch.grant, rows: batch.rows }).await
}

pub(crate) async fn logs(
    State(actor_handle): State<Arc<ActorHandle>>,
    Message(batch): Message<LogBatch>,
) -> Result<Json<()>, Failure> {
    actor_handle.state().check_telemetry(&batch.grant)?;
    write(&actor_handle, Write::Logs { grant: batch.grant, first: batch.first, lines: batch.lines }).await
}

pub(crate) async fn checkpoint(
    State(actor_handle): State<Arc<ActorHandle>>,
    Message(commit): Message<CommitCheckpoint>,
) -> Result<Json<()>, Failure> {
    actor_handle.decide(Event::Checkpoint { commit }).await?;
    Ok(Json(()))
}

pub(crate) async fn outcome(
    State(actor_handle): State<Arc<ActorHandle>>,
    Message(report): Message<ReportOutcome>,
) -> Result<Json<()>, Failure> {
    actor_handle.decide(Event::Outcome { report }).await?;
    Ok(Json(()))
}

pub(crate) async fn put_blob(
    State(actor_handle): State<Arc<ActorHandle>>,
    headers: HeaderMap,
    body: Bytes,
) -> Result<Json<BlobStored>, Failure> {
    let grant =
        headers.get(GRANT_HEADER).ok_or_else(|| Failure::invalid(format!("header `{GRANT_HEADER}` is missing")))?;
    let grant: Grant = serde_json::from_slice(grant.as_bytes())
        .map_err(|e| Failure::invalid(format!("header `{GRANT_HEADER}` is no grant: {e}")))?;
    actor_handle.state().check_write(&grant)?;
    let blobs = actor_handle.store.blobs().clone();
    let put = blocking(move || blobs.put(&body)).await;
    if let Err(checkpoint::BlobError::Storage(message)) = &put {
        actor_handle.wrote::<()>(&Err(WriteError::Storage(message.clone())));
    }
    Ok(Json(BlobStored { digest: put? }))
}

pub(crate) async fn get_blob(
    State(actor_handle): State<Arc<ActorHandle>>,
    Path(digest): Path<String>,
) -> Result<impl IntoResponse, Failure> {
    let digest: Digest = digest.parse().map_err(|e| Failure::invalid(format!("{e}")))?;
    let blobs = actor_handle.store.blobs().clone();
    let bytes = blocking(move || blobs.get(digest)).await?;
    Ok(([(header::CONTENT_TYPE, "application/octet-stream")], bytes))
}
