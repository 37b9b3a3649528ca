//! Calls of clients: submission, queries and control of runs.

use std::sync::Arc;

use access::{Caller, Scope};
use axum::extract::rejection::QueryRejection;
use axum::extract::{Path, Query, State};
use axum::http::{StatusCode, header};
use axum::response::IntoResponse;
use axum::{Extension, Json};
use protocol::message::{RunView, Submit};
use protocol::{Alias, ModelRef, RunId, StageName, WorkerId, limits};
use registry::cli::{Answer, Command};
use registry::{HistoryQuery, HistoryRow, LogRow, Page};
use serde::{Deserialize, Serialize};
use tokio::sync::SemaphorePermit;

use super::actor_handle::ActorHandle;
use super::audit::Object;
use super::auth;
use super::blocking::blocking;
use super::body::Message;
use super::clock::wall_clock;
use super::failure::Failure;
use super::records::StageMetrics;
use crate::rejected::Rejected;
use crate::state::run::Control;
use crate::view::WorkerView;

/// The answer to `POST /v1/runs`.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct Submitted {
    /// The run, identical for all submissions with the same idempotency key.
    pub run: RunId,
}

/// Query parameters: `?stage=&after=&limit=`.
#[derive(Debug, Deserialize)]
pub(crate) struct LogQuery {
    stage: Option<StageName>,
    #[serde(default)]
    after: i64,
    /// The newest so many lines in the place of those after a line.
    last: Option<u32>,
    #[serde(default = "default_lines")]
    limit: u32,
}

fn default_lines() -> u32 {
    1000
}

/// Query parameters: `?before=&limit=`.
#[derive(Debug, Deserialize)]
pub(crate) struct RunsQuery {
    before: Option<RunId>,
    #[serde(default = "default_lines")]
    limit: u32,
}

/// `?stage=&key=&after=&limit=`.
#[derive(Debug, Deserialize)]
pub(crate) struct PointQuery {
    stage: Option<StageName>,
    key: Option<String>,
    after: Option<u64>,
    #[serde(default = "default_points")]
    limit: usize,
}

fn default_points() -> usize {
    limits::CURVE_POINTS
}

/// `?run=&worker=&after=&since=&limit=`; `since` in milliseconds since 1970.
#[derive(Debug, Deserialize)]
pub(crate) struct HistoryCall {
    run: Option<RunId>,
    worker: Option<WorkerId>,
    #[serde(default)]
    after: i64,
    since: Option<i64>,
    #[serde(default = "default_lines")]
    limit: u32,
}

pub(crate) async fn health(State(actor_handle): State<Arc<ActorHandle>>) -> Json<serde_json::Value> {
    let storage = if actor_handle.storage().is_some() { "trouble" } else { "ok" };
    Json(serde_json::json!({"status": "ok", "storage": storage, "version": env!("CARGO_PKG_VERSION")}))
}

pub(crate) async fn workers(
    State(actor_handle): State<Arc<ActorHandle>>,
    Extension(caller): Extension<Arc<Caller>>,
) -> Json<Vec<WorkerView>> {
    Json(actor_handle.records_for(caller.sees()).workers())
}

/// A permit for a client's call that waits for a decision.
fn place(actor_handle: &ActorHandle) -> Result<SemaphorePermit<'_>, Failure> {
    let full = |_| Failure::busy(format!("{} calls of clients already wait for a decision", limits::CLIENTS_WAITING));
    actor_handle.clients.try_acquire().map_err(full)
}

/// A turn among the questions that read much: few at a time, or they would fill memory and take the threads from heartbeats.
pub(super) async fn turn(actor_handle: &ActorHandle) -> Result<(SemaphorePermit<'_>, SemaphorePermit<'_>), Failure> {
    let most = limits::READS_WAITING;
    let full = |_| Failure::busy(format!("{most} calls for lists and curves already wait"));
    let waiting = actor_handle.readers.try_acquire().map_err(full)?;
    // The semaphore is never closed.
    let closed = |_| Failure::busy("the server is stopping".to_owned());
    Ok((waiting, actor_handle.reads.acquire().await.map_err(closed)?))
}

pub(crate) async fn submit(
    State(actor_handle): State<Arc<ActorHandle>>,
    Extension(caller): Extension<Arc<Caller>>,
    Message(submit, _): Message<Submit>,
) -> Result<(Extension<Object>, Json<Submitted>), Failure> {
    let _place = place(&actor_handle)?;
    let run = actor_handle.submit(submit, caller.owner(), caller.sees()).await?;
    Ok((Extension(Object::Changed(run.to_string())), Json(Submitted { run })))
}

/// Runs by submission: the newest ones, or those before a given run. Further calls with `before` return earlier runs.
pub(crate) async fn runs(
    State(actor_handle): State<Arc<ActorHandle>>,
    Extension(caller): Extension<Arc<Caller>>,
    Query(query): Query<RunsQuery>,
) -> Result<impl IntoResponse, Failure> {
    let _turn = turn(&actor_handle).await?;
    let records = actor_handle.records_for(caller.sees());
    let views = records.run_views(query.before.as_ref(), query.limit).await?;
    // The list may be long, so it is joined outside the threads that answer heartbeats.
    let list = blocking(move || format!("[{}]", views.join(","))).await;
    Ok(([(header::CONTENT_TYPE, "application/json")], list))
}

pub(crate) async fn run(
    State(actor_handle): State<Arc<ActorHandle>>,
    Extension(caller): Extension<Arc<Caller>>,
    Path(run): Path<RunId>,
) -> Result<Json<RunView>, Failure> {
    let view = actor_handle.records_for(caller.sees()).run_view(&run).await?;
    // Storage problems matter only to a run that has not ended.
    let storage = actor_handle.storage().filter(|_| !view.state.is_final());
    Ok(Json(RunView { storage, ..view }))
}

pub(crate) async fn control(
    State(actor_handle): State<Arc<ActorHandle>>,
    Extension(caller): Extension<Arc<Caller>>,
    Path((run, action)): Path<(RunId, String)>,
) -> Result<(Extension<Object>, Json<RunView>), Failure> {
    let action = match action.as_str() {
        "pause" => Control::Pause,
        "resume" => Control::Resume,
        "cancel" => Control::Cancel,
        other => {
            let message = format!("unknown action `{other}`; expected `pause`, `resume` or `cancel`");
            return Err(Rejected::NotFound(message).into());
        }
    };
    let owner = actor_handle.run_owner(&run).await?;
    if !caller.may_see(owner.as_ref()) {
        return Err(Rejected::unknown_run(&run).into());
    }
    if owner.is_some() && !caller.controls(owner.as_ref()) {
        return Err(foreign(&caller, &format!("run `{run}`")));
    }
    let place = place(&actor_handle)?;
    actor_handle.control(&run, action).await?;
    drop(place);
    let object = Object::Changed(format!("{run} {}", format!("{action:?}").to_lowercase()));
    Ok((Extension(object), Json(actor_handle.run_view(&run).await?)))
}

pub(crate) async fn logs(
    State(actor_handle): State<Arc<ActorHandle>>,
    Extension(caller): Extension<Arc<Caller>>,
    Path(run): Path<RunId>,
    Query(query): Query<LogQuery>,
) -> Result<Json<Vec<LogRow>>, Failure> {
    let _turn = turn(&actor_handle).await?;
    let (records, stage) = (actor_handle.records_for(caller.sees()), query.stage.as_ref());
    Ok(Json(match query.last {
        Some(limit) => records.last_logs(&run, stage, limit).await?,
        None => records.logs(&run, stage, query.after, query.limit).await?,
    }))
}

/// Every value, by pages: those of each key after a step.
pub(crate) async fn points(
    State(actor_handle): State<Arc<ActorHandle>>,
    Extension(caller): Extension<Arc<Caller>>,
    Path(run): Path<RunId>,
    Query(query): Query<PointQuery>,
) -> Result<Json<StageMetrics>, Failure> {
    let _turn = turn(&actor_handle).await?;
    let keys = query.key.is_some().then_some(query.key.as_slice());
    let page = Page { after: query.after, limit: query.limit.min(limits::CURVE_POINTS) };
    let records = actor_handle.records_for(caller.sees());
    Ok(Json(records.points(&run, query.stage.as_ref(), keys, page).await?))
}

/// Returns events in pages.
pub(crate) async fn history(
    State(actor_handle): State<Arc<ActorHandle>>,
    Extension(caller): Extension<Arc<Caller>>,
    query: Result<Query<HistoryCall>, QueryRejection>,
) -> Result<Json<Vec<HistoryRow>>, Failure> {
    let Query(HistoryCall { run, worker, after, since, limit }) =
        query.map_err(|error| Failure::invalid(error.body_text()))?;
    let _turn = turn(&actor_handle).await?;
    let asked = HistoryQuery { run, worker, after, since_ms: since, limit: limit.min(limits::HISTORY_READ) };
    Ok(Json(actor_handle.records_for(caller.sees()).history(&asked).await?))
}

/// Executes a registry command for a client, because this process holds the store.
pub(crate) async fn registry(
    State(actor_handle): State<Arc<ActorHandle>>,
    Extension(caller): Extension<Arc<Caller>>,
    Message(command, _): Message<Command>,
) -> Result<(Extension<Object>, Json<Answer>), Failure> {
    let scope = command.scope();
    if !caller.scopes.allow(scope) {
        return Err(auth::forbidden(&caller, &[scope]));
    }
    let object = Extension(if command.only_reads() { Object::Read } else { Object::Changed(command.in_short()) });
    if scope == Scope::Read {
        let seen = actor_handle.seen_store(caller.sees().as_ref());
        return Ok((object, Json(registry::cli::read(command, &seen).await)));
    }
    if let Some((model, alias)) = command.moves()
        && let Some(answer) = check_move(&actor_handle, &caller, model, alias).await?
    {
        return Ok((object, Json(answer)));
    }
    Ok((object, Json(registry::cli::run(command, &actor_handle.store, &caller.name).await)))
}

/// Refuses to move an alias without the caller's permission. If the model is invisible to the caller, the answer is
/// that it does not exist. Invalid names are left to the command, which refuses them.
async fn check_move(
    actor_handle: &ActorHandle,
    caller: &Caller,
    model: &str,
    alias: &str,
) -> Result<Option<Answer>, Failure> {
    let (Ok(reference), Ok(alias)) = (model.parse::<ModelRef>(), alias.parse::<Alias>()) else { return Ok(None) };
    let model = reference.model;
    let seen = actor_handle.seen_store(caller.sees().as_ref());
    if seen.model(&model).await?.is_none() {
        return Ok(Some(registry::cli::read(Command::Show { reference: model.to_string() }, &seen).await));
    }
    let group = actor_handle.model_owner(&model).await?;
    let tokens = actor_handle.tokens.current();
    match tokens.may_move(caller.into(), &alias, group.as_ref(), wall_clock().0) {
        Ok(()) => Ok(None),
        Err(why) => {
            let message = format!("cannot move `{model}@{alias}`: {why}");
            let failure = Failure::new(StatusCode::FORBIDDEN, "forbidden", message);
            Err(failure
                .hint("use a token of the model's project, or one named by `protect` in the server's token file"))
        }
    }
}

/// The refusal for an object that the caller sees but does not control.
fn foreign(caller: &Caller, what: &str) -> Failure {
    let message = format!("{what} belongs to another owner than the token of `{}`", caller.owner());
    Failure::new(StatusCode::FORBIDDEN, "forbidden", message)
        .hint("use a token of its project, or one with the scope `admin`")
}
