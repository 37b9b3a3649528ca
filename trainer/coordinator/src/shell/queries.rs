//! Clients: submitting, looking, pausing.

use std::collections::BTreeMap;
use std::sync::Arc;

use access::Caller;
use axum::extract::{Path, Query, State};
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
use crate::event::{Control, Event, Rejected};
use crate::state::execution::StageExecution;
use crate::view::WorkerView;

/// The answer to `PUT /v1/blobs`.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct BlobStored {
    /// The blob's name.
    pub digest: Digest,
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

pub(crate) async fn runs(State(actor_handle): State<Arc<ActorHandle>>) -> Json<Vec<RunView>> {
    let (state, now) = (actor_handle.state(), actor_handle.now());
    Json(state.runs.iter().map(|run| state.view(run, now)).collect())
}

pub(crate) async fn run(
    State(actor_handle): State<Arc<ActorHandle>>,
    Path(run): Path<RunId>,
) -> Result<Json<RunView>, Failure> {
    let state = actor_handle.state();
    Ok(Json(state.view(state.run(&run)?, actor_handle.now())))
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
    actor_handle.decide(Event::Control { run: run.clone(), action }).await?;
    let state = actor_handle.state();
    Ok(Json(state.view(state.run(&run)?, actor_handle.now())))
}

/// The works behind the stages of a run that have begun, with the stages' names in this run: a stage that another run
/// computes has its logs and values under that run's name.
fn executions(
    actor_handle: &ActorHandle,
    run: &RunId,
    stage: Option<&StageName>,
) -> Result<Vec<(StageName, Arc<StageExecution>)>, Failure> {
    let state = actor_handle.state();
    let run = state.run(run)?;
    if let Some(stage) = stage
        && run.position(stage).is_none()
    {
        return Err(Rejected::NotFound(format!("run `{}` has no stage `{stage}`", run.id)).into());
    }
    let stages = run.pipeline.stages.iter().filter(|s| stage.is_none_or(|stage| s.name == *stage));
    Ok(stages.filter_map(|s| Some((s.name.clone(), Arc::clone(state.execution_of(run, &s.name)?)))).collect())
}

pub(crate) async fn logs(
    State(actor_handle): State<Arc<ActorHandle>>,
    Path(run): Path<RunId>,
    Query(query): Query<LogQuery>,
) -> Result<Json<Vec<LogRow>>, Failure> {
    let mut rows = Vec::new();
    for (_, execution) in executions(&actor_handle, &run, query.stage.as_ref())? {
        rows.extend(actor_handle.store.logs(&execution.run, Some(&execution.stage), query.after, query.limit).await?);
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
    for (name, execution) in executions(&actor_handle, &run, query.stage.as_ref())? {
        stages.insert(name, actor_handle.store.metrics(&execution.run, &execution.stage, None, query.points).await?);
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
