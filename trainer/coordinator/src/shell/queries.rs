//! Clients: submitting, looking, pausing.

use std::sync::Arc;

use access::Caller;
use axum::extract::{Path, Query, State};
use axum::http::header;
use axum::response::IntoResponse;
use axum::{Extension, Json};
use protocol::message::{RunView, Submit};
use protocol::{Digest, RunId, StageName, limits};
use registry::LogRow;
use serde::{Deserialize, Serialize};
use tokio::sync::SemaphorePermit;

use super::actor_handle::ActorHandle;
use super::auth;
use super::blocking::blocking;
use super::body::Message;
use super::failure::Failure;
use super::records::StageMetrics;
use crate::rejected::Rejected;
use crate::state::run::Control;
use crate::view::WorkerView;

/// The answer to `PUT /v1/blobs/{digest}` and `GET /v1/blobs/{digest}/staged`.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct BlobStored {
    /// The blob's name.
    pub digest: Digest,
    /// Whether all of it has arrived and is stored.
    pub stored: bool,
    /// Bytes that have arrived, if it is not.
    pub staged: u64,
}

/// The answer to `POST /v1/runs`.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct Submitted {
    /// The run; the same for every submission with one idempotency key.
    pub run: RunId,
}

/// `?stage=&after=&limit=`.
#[derive(Debug, Deserialize)]
pub(crate) struct LogQuery {
    stage: Option<StageName>,
    #[serde(default)]
    after: i64,
    #[serde(default = "default_lines")]
    limit: u32,
}

fn default_lines() -> u32 {
    1000
}

/// `?before=&limit=`.
#[derive(Debug, Deserialize)]
pub(crate) struct RunsQuery {
    before: Option<RunId>,
    #[serde(default = "default_lines")]
    limit: u32,
}

/// `?stage=&points=`.
#[derive(Debug, Deserialize)]
pub(crate) struct MetricQuery {
    stage: Option<StageName>,
    #[serde(default = "default_points")]
    points: usize,
}

fn default_points() -> usize {
    500
}

pub(crate) async fn health(State(actor_handle): State<Arc<ActorHandle>>) -> Json<serde_json::Value> {
    let storage = if actor_handle.trouble().is_some() { "trouble" } else { "ok" };
    Json(serde_json::json!({"status": "ok", "storage": storage, "version": env!("CARGO_PKG_VERSION")}))
}

pub(crate) async fn workers(State(actor_handle): State<Arc<ActorHandle>>) -> Json<Vec<WorkerView>> {
    Json(actor_handle.state().worker_views())
}

/// A place among the clients whose calls wait to be decided.
fn place(actor_handle: &ActorHandle) -> Result<SemaphorePermit<'_>, Failure> {
    let full = |_| Failure::busy(format!("{} calls of clients wait to be decided already", limits::CLIENTS_WAITING));
    actor_handle.clients.try_acquire().map_err(full)
}

/// A turn among the questions that read much: few at a time, or they would fill memory and take the threads from heartbeats.
async fn turn(actor_handle: &ActorHandle) -> Result<(SemaphorePermit<'_>, SemaphorePermit<'_>), Failure> {
    let most = limits::READS_WAITING;
    let full = |_| Failure::busy(format!("{most} lists and curves wait to be read already"));
    let waiting = actor_handle.readers.try_acquire().map_err(full)?;
    // The semaphore is never closed.
    let closed = |_| Failure::busy("nothing is read any more".to_owned());
    Ok((waiting, actor_handle.reads.acquire().await.map_err(closed)?))
}

pub(crate) async fn submit(
    State(actor_handle): State<Arc<ActorHandle>>,
    Message(submit, _): Message<Submit>,
) -> Result<Json<Submitted>, Failure> {
    let _place = place(&actor_handle)?;
    Ok(Json(Submitted { run: actor_handle.submit(submit).await? }))
}

/// Runs by submission: the newest, or those before a run. Who wants more asks again with `before`.
pub(crate) async fn runs(
    State(actor_handle): State<Arc<ActorHandle>>,
    Query(query): Query<RunsQuery>,
) -> Result<impl IntoResponse, Failure> {
    let _turn = turn(&actor_handle).await?;
    let records = actor_handle.records();
    let views = records.run_views(query.before.as_ref(), query.limit).await?;
    // Beside the threads that answer heartbeats: there may be many.
    let list = blocking(move || format!("[{}]", views.join(","))).await;
    Ok(([(header::CONTENT_TYPE, "application/json")], list))
}

pub(crate) async fn run(
    State(actor_handle): State<Arc<ActorHandle>>,
    Path(run): Path<RunId>,
) -> Result<Json<RunView>, Failure> {
    Ok(Json(actor_handle.run_view(&run).await?))
}

pub(crate) async fn control(
    State(actor_handle): State<Arc<ActorHandle>>,
    Path((run, action)): Path<(RunId, String)>,
) -> Result<Json<RunView>, Failure> {
    let action = match action.as_str() {
        "pause" => Control::Pause,
        "resume" => Control::Resume,
        "cancel" => Control::Cancel,
        other => {
            let message = format!("a run cannot be asked to `{other}`; expected `pause`, `resume` or `cancel`");
            return Err(Rejected::NotFound(message).into());
        }
    };
    let place = place(&actor_handle)?;
    actor_handle.control(&run, action).await?;
    drop(place);
    Ok(Json(actor_handle.run_view(&run).await?))
}

pub(crate) async fn logs(
    State(actor_handle): State<Arc<ActorHandle>>,
    Path(run): Path<RunId>,
    Query(query): Query<LogQuery>,
) -> Result<Json<Vec<LogRow>>, Failure> {
    let _turn = turn(&actor_handle).await?;
    Ok(Json(actor_handle.records().logs(&run, query.stage.as_ref(), query.after, query.limit).await?))
}

pub(crate) async fn metrics(
    State(actor_handle): State<Arc<ActorHandle>>,
    Path(run): Path<RunId>,
    Query(query): Query<MetricQuery>,
) -> Result<Json<StageMetrics>, Failure> {
    let _turn = turn(&actor_handle).await?;
    Ok(Json(actor_handle.records().metrics(&run, query.stage.as_ref(), query.points).await?))
}

/// The registry's commands, on behalf of a client: this process holds the store.
pub(crate) async fn registry(
    State(actor_handle): State<Arc<ActorHandle>>,
    Extension(caller): Extension<Arc<Caller>>,
    Message(command, _): Message<registry::cli::Command>,
) -> Result<Json<registry::cli::Answer>, Failure> {
    let scope = command.scope();
    if !caller.scopes.allow(scope) {
        return Err(auth::forbidden(&caller, &[scope]));
    }
    Ok(Json(registry::cli::run(command, &actor_handle.store, &caller.name).await))
}
