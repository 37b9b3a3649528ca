//! Clients: submitting, looking, pausing.

use std::sync::Arc;

use access::{Caller, Scope};
use axum::extract::{Path, Query, State};
use axum::http::{StatusCode, header};
use axum::response::IntoResponse;
use axum::{Extension, Json};
use protocol::message::{RunView, Submit};
use protocol::{Alias, ModelRef, RunId, StageName, limits};
use registry::LogRow;
use registry::cli::{Answer, Command};
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
    let storage = if actor_handle.storage().is_some() { "trouble" } else { "ok" };
    Json(serde_json::json!({"status": "ok", "storage": storage, "version": env!("CARGO_PKG_VERSION")}))
}

pub(crate) async fn workers(
    State(actor_handle): State<Arc<ActorHandle>>,
    Extension(caller): Extension<Arc<Caller>>,
) -> Json<Vec<WorkerView>> {
    Json(actor_handle.records_for(caller.sees()).workers())
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
    Extension(caller): Extension<Arc<Caller>>,
    Message(submit, _): Message<Submit>,
) -> Result<(Extension<Object>, Json<Submitted>), Failure> {
    let _place = place(&actor_handle)?;
    let run = actor_handle.submit(submit, caller.owner(), caller.sees()).await?;
    Ok((Extension(Object::Changed(run.to_string())), Json(Submitted { run })))
}

/// Runs by submission: the newest, or those before a run. Who wants more asks again with `before`.
pub(crate) async fn runs(
    State(actor_handle): State<Arc<ActorHandle>>,
    Extension(caller): Extension<Arc<Caller>>,
    Query(query): Query<RunsQuery>,
) -> Result<impl IntoResponse, Failure> {
    let _turn = turn(&actor_handle).await?;
    let records = actor_handle.records_for(caller.sees());
    let views = records.run_views(query.before.as_ref(), query.limit).await?;
    // Beside the threads that answer heartbeats: there may be many.
    let list = blocking(move || format!("[{}]", views.join(","))).await;
    Ok(([(header::CONTENT_TYPE, "application/json")], list))
}

pub(crate) async fn run(
    State(actor_handle): State<Arc<ActorHandle>>,
    Extension(caller): Extension<Arc<Caller>>,
    Path(run): Path<RunId>,
) -> Result<Json<RunView>, Failure> {
    let view = actor_handle.records_for(caller.sees()).run_view(&run).await?;
    // What is wrong matters to a run that is to go on.
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
            let message = format!("a run cannot be asked to `{other}`; expected `pause`, `resume` or `cancel`");
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
    Ok(Json(actor_handle.records_for(caller.sees()).logs(&run, query.stage.as_ref(), query.after, query.limit).await?))
}

pub(crate) async fn metrics(
    State(actor_handle): State<Arc<ActorHandle>>,
    Extension(caller): Extension<Arc<Caller>>,
    Path(run): Path<RunId>,
    Query(query): Query<MetricQuery>,
) -> Result<Json<StageMetrics>, Failure> {
    let _turn = turn(&actor_handle).await?;
    Ok(Json(actor_handle.records_for(caller.sees()).metrics(&run, query.stage.as_ref(), query.points).await?))
}

/// The registry's commands, on behalf of a client: this process holds the store.
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

/// Refuses the move of an alias that is not the caller's to move; of a model that it does not see, with the answer that there is none.
/// What does not parse is refused by the command.
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
            let message = format!("`{model}@{alias}` is not moved: {why}");
            let failure = Failure::new(StatusCode::FORBIDDEN, "forbidden", message);
            Err(failure
                .hint("a token of the model's project may, or one that the server's token file names in `protect`"))
        }
    }
}

/// The caller sees it, and does not control it.
fn foreign(caller: &Caller, what: &str) -> Failure {
    let message = format!("{what} belongs to another owner than the token of `{}`", caller.owner());
    Failure::new(StatusCode::FORBIDDEN, "forbidden", message)
        .hint("use a token of its project, or one with the scope `admin`")
}
