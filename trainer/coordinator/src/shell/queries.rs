//! Clients: submitting, looking, pausing.

use std::collections::BTreeMap;
use std::sync::Arc;

use access::Caller;
use axum::extract::{Path, Query, State};
use axum::http::header;
use axum::response::IntoResponse;
use axum::{Extension, Json};
use protocol::message::{RunView, Submit};
use protocol::{Digest, RunId, StageName};
use registry::Curve;
use registry::LogRow;
use serde::{Deserialize, Serialize};

use super::actor::ActorHandle;
use super::api::Failure;
use super::auth;
use super::body::Message;
use crate::event::{Control, Rejected};
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

/// The answer to `GET /v1/runs/{run}/metrics`: values by step, by key, by stage.
pub type StageMetrics = BTreeMap<StageName, BTreeMap<String, Curve>>;

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

/// `?limit=`.
#[derive(Debug, Deserialize)]
pub(crate) struct RunsQuery {
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

pub(crate) async fn submit(
    State(actor_handle): State<Arc<ActorHandle>>,
    Message(submit): Message<Submit>,
) -> Result<Json<Submitted>, Failure> {
    Ok(Json(Submitted { run: actor_handle.submit(submit).await? }))
}

/// Runs by submission: those in memory, and of those that ended the newest `limit`.
pub(crate) async fn runs(
    State(actor_handle): State<Arc<ActorHandle>>,
    Query(query): Query<RunsQuery>,
) -> Result<impl IntoResponse, Failure> {
    // Read before the tables: a run that ends in between is in both, and not in neither.
    let (state, now) = (actor_handle.state(), actor_handle.now());
    let ended = actor_handle.store.ended_views(query.limit).await?;
    let mut views: Vec<(u64, String)> = Vec::new();
    for run in state.runs.values() {
        let view = serde_json::to_string(&state.view(run, now));
        views.push((run.number, view.map_err(|e| Failure::invalid(format!("run `{}`: {e}", run.id)))?));
    }
    for (run, view) in ended {
        let number = crate::state::run::number_of(&run).unwrap_or_default();
        if !state.runs.contains_key(&number) {
            views.push((number, view));
        }
    }
    views.sort_by_key(|(number, _)| *number);
    let views: Vec<String> = views.into_iter().map(|(_, view)| view).collect();
    Ok(([(header::CONTENT_TYPE, "application/json")], format!("[{}]", views.join(","))))
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
    actor_handle.control(&run, action).await?;
    Ok(Json(actor_handle.run_view(&run).await?))
}

/// By the name of a stage in this run: the run and the stage under whose names its logs and values are stored. A stage that another run
/// computes has them under that run's name.
async fn sources(
    actor_handle: &ActorHandle,
    run: &RunId,
    stage: Option<&StageName>,
) -> Result<Vec<(StageName, (RunId, StageName))>, Failure> {
    let view = actor_handle.run_view(run).await?;
    if let Some(stage) = stage
        && !view.stages.iter().any(|known| known.name == *stage)
    {
        return Err(Rejected::NotFound(format!("run `{run}` has no stage `{stage}`")).into());
    }
    let begun = view.stages.into_iter().filter(|known| stage.is_none_or(|stage| known.name == *stage));
    let begun: Vec<(StageName, Digest)> = begun.filter_map(|known| Some((known.name, known.key?))).collect();
    let state = actor_handle.state();
    let left: Vec<Digest> =
        begun.iter().map(|(_, key)| *key).filter(|key| !state.executions.contains_key(key)).collect();
    let stored = if left.is_empty() { BTreeMap::new() } else { actor_handle.store.sources(&left).await? };
    let source = |(name, key): (StageName, Digest)| {
        let known = state.executions.get(&key).map(|execution| (execution.run.clone(), execution.stage.clone()));
        let source = known.or_else(|| stored.get(&key).cloned()).unwrap_or_else(|| (run.clone(), name.clone()));
        (name, source)
    };
    Ok(begun.into_iter().map(source).collect())
}

pub(crate) async fn logs(
    State(actor_handle): State<Arc<ActorHandle>>,
    Path(run): Path<RunId>,
    Query(query): Query<LogQuery>,
) -> Result<Json<Vec<LogRow>>, Failure> {
    let mut rows = Vec::new();
    for (_, source) in sources(&actor_handle, &run, query.stage.as_ref()).await? {
        rows.extend(actor_handle.store.logs(&source.0, Some(&source.1), query.after, query.limit).await?);
    }
    rows.sort_by_key(|row| row.id);
    rows.truncate(query.limit as usize);
    Ok(Json(rows))
}

pub(crate) async fn metrics(
    State(actor_handle): State<Arc<ActorHandle>>,
    Path(run): Path<RunId>,
    Query(query): Query<MetricQuery>,
) -> Result<Json<StageMetrics>, Failure> {
    let mut stages = StageMetrics::new();
    for (name, source) in sources(&actor_handle, &run, query.stage.as_ref()).await? {
        stages.insert(name, actor_handle.store.metrics(&source.0, &source.1, None, query.points).await?);
    }
    Ok(Json(stages))
}

/// The registry's commands, on behalf of a client: this process holds the store.
pub(crate) async fn registry(
    State(actor_handle): State<Arc<ActorHandle>>,
    Extension(caller): Extension<Arc<Caller>>,
    Message(command): Message<registry::cli::Command>,
) -> Result<Json<registry::cli::Answer>, Failure> {
    let scope = command.scope();
    if !caller.scopes.allow(scope) {
        return Err(auth::forbidden(&caller, &[scope]));
    }
    Ok(Json(registry::cli::run(command, &actor_handle.store, &caller.name).await))
}
