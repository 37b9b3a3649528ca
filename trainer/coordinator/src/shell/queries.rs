//! Calls of clients: submission, queries and control of runs.

use std::sync::Arc;
use std::time::Duration;

use access::{Caller, Scope};
use axum::extract::State;
use axum::http::{HeaderMap, StatusCode, header};
use axum::response::{IntoResponse, Response};
use axum::{Extension, Json};
use protocol::message::{Listing, RunState, RunSummary, RunView, Submit};
use protocol::{Alias, Group, ModelRef, RunId, StageName, WorkerId, limits};
use registry::cli::{Answer, Command};
use registry::doctor::{self, Finding};
use registry::{HistoryQuery, HistoryRow, KindSize, LogRow, Page, RunListQuery, RunOrder};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use serde_json::json;
use tokio::sync::SemaphorePermit;

use super::actor_handle::ActorHandle;
use super::audit::Object;
use super::auth;
use super::blocking::blocking;
use super::body::Message;
use super::clock::wall_clock;
use super::events;
use super::extract::{Path, Query};
use super::failure::Failure;
use super::records::StageMetrics;
use super::turn::turn;
use crate::rejected::Rejected;
use crate::state::run::Control;
use crate::view::WorkerView;

/// The header that makes a submission the same as an earlier one of the same token or project.
pub(super) const IDEMPOTENCY_KEY: &str = "idempotency-key";

/// The answer to `POST /v1/runs`.
#[derive(Debug, Clone, Serialize, Deserialize, JsonSchema)]
pub struct Submitted {
    /// The run, identical for all submissions with the same idempotency key.
    pub run: RunId,
}

/// The media type of packed numbers.
pub(super) const PACKED: &str = "application/octet-stream";

/// Query parameters: `?stage=&after=&limit=`.
#[derive(Debug, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
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

/// Query parameters: `?state=&pipeline=&owner=&q=&sort=&after=&limit=`.
#[derive(Debug, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub(crate) struct RunsQuery {
    /// States of runs, separated by commas: `running`, `paused`, `finished`, `failed`, `cancelled`.
    #[serde(default)]
    state: String,
    /// Name of a pipeline.
    pipeline: Option<String>,
    /// The name of a token without a project, or `@` and the name of a project.
    owner: Option<String>,
    /// Words that the name, the pipeline, the owner or the note of a run contains, in any case.
    #[serde(default)]
    q: String,
    /// `newest` submission first, `oldest` first, or the newest `changed` state first.
    #[serde(default)]
    sort: RunOrder,
    /// `next` of an earlier answer to the same question.
    after: Option<String>,
    /// Number of runs.
    #[serde(default = "default_runs")]
    limit: u32,
}

fn default_runs() -> u32 {
    50
}

fn state_named(word: &str) -> Result<RunState, Failure> {
    let expected = "`running`, `paused`, `finished`, `failed` or `cancelled`";
    RunState::named(word).ok_or_else(|| Failure::invalid(format!("`state` names `{word}`; expected {expected}")))
}

impl RunsQuery {
    fn read(self) -> Result<RunListQuery, Failure> {
        let Self { state, pipeline, owner, q, sort, after, limit } = self;
        let words = state.split(',').filter(|word| !word.is_empty());
        let states = words.map(state_named).collect::<Result<_, _>>()?;
        if limit == 0 {
            return Err(Failure::invalid("`limit` is 0; expected at least 1".to_owned()));
        }
        if q.len() > limits::SEARCH_BYTES {
            let most = limits::SEARCH_BYTES;
            return Err(Failure::invalid(format!("`q` has {} bytes; expected at most {most}", q.len())));
        }
        Ok(RunListQuery { states, pipeline, owner: owner.map(Group::new), words: q, order: sort, after, limit })
    }
}

/// `?stage=&key=&after=&limit=`.
#[derive(Debug, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
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

/// `?run=&worker=&after=&since=&wait=&limit=`; `since` in milliseconds since 1970.
#[derive(Debug, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub(crate) struct HistoryCall {
    run: Option<RunId>,
    worker: Option<WorkerId>,
    #[serde(default)]
    after: i64,
    since: Option<i64>,
    /// Seconds to wait for rows, if there are none.
    #[serde(default)]
    wait: u32,
    #[serde(default = "default_lines")]
    limit: u32,
}

/// The answer to `GET /v1/health`.
#[derive(Debug, Serialize, JsonSchema)]
pub(crate) struct Health {
    status: &'static str,
    /// `ok`, or `trouble` if the store does not take or give what it should.
    storage: &'static str,
    version: &'static str,
}

pub(crate) async fn health(State(actor_handle): State<Arc<ActorHandle>>) -> Json<Health> {
    let storage = if actor_handle.storage().is_some() { "trouble" } else { "ok" };
    Json(Health { status: "ok", storage, version: env!("CARGO_PKG_VERSION") })
}

/// The answer to `GET /v1/storage`.
#[derive(Debug, Serialize, JsonSchema)]
pub(crate) struct Storage {
    /// Artifacts by kind, largest first.
    kinds: Vec<KindSize>,
    /// Bytes of the database, with what it has not written into its file yet.
    database_bytes: u64,
    /// Checks of the store's folder and of its blob storage.
    findings: Vec<Finding>,
}

pub(crate) async fn storage(State(actor_handle): State<Arc<ActorHandle>>) -> Result<Json<Storage>, Failure> {
    let dir = actor_handle.store.dir().to_owned();
    let kinds = actor_handle.store.kind_sizes().await?;
    let away = actor_handle.storage().map(|problem| {
        Finding::fail(
            "blobs",
            problem.what,
            "look whether the disk has space or the bucket answers; training continues meanwhile",
        )
    });
    let (database_bytes, mut findings) = blocking(move || {
        let size = |name: &str| std::fs::metadata(dir.join(name)).map_or(0, |found| found.len());
        let findings = [doctor::disk(&dir)].into_iter().chain(doctor::permissions(&dir, &dir.display().to_string()));
        (size("stride.db") + size("stride.db-wal"), findings.collect::<Vec<_>>())
    })
    .await;
    findings
        .push(away.unwrap_or_else(|| Finding::ok("blobs", "what is to be stored is, and what is stored can be read")));
    Ok(Json(Storage { kinds, database_bytes, findings }))
}

pub(crate) async fn workers(
    State(actor_handle): State<Arc<ActorHandle>>,
    Extension(caller): Extension<Arc<Caller>>,
) -> Json<Vec<WorkerView>> {
    let mut workers = actor_handle.records_for(caller.sees()).workers();
    actor_handle.lines.mark(&mut workers, actor_handle.now());
    Json(workers)
}

/// A permit for a client's call that waits for a decision.
pub(super) fn place(actor_handle: &ActorHandle) -> Result<SemaphorePermit<'_>, Failure> {
    let full = |_| Failure::busy(format!("{} calls of clients already wait for a decision", limits::CLIENTS_WAITING));
    actor_handle.clients.try_acquire().map_err(full)
}

/// The key of a call's header, if it has one.
pub(super) fn idempotency_key(headers: &HeaderMap) -> Result<Option<String>, Failure> {
    let Some(key) = headers.get(IDEMPOTENCY_KEY) else { return Ok(None) };
    let most = limits::TEXT_BYTES;
    let key = key.to_str().ok().filter(|key| !key.is_empty() && key.len() <= most);
    let wrong = || Failure::invalid(format!("`{IDEMPOTENCY_KEY}` has 1 to {most} characters of ASCII"));
    Ok(Some(key.ok_or_else(wrong)?.to_owned()))
}

pub(crate) async fn submit(
    State(actor_handle): State<Arc<ActorHandle>>,
    Extension(caller): Extension<Arc<Caller>>,
    headers: HeaderMap,
    Message(mut submit, _): Message<Submit>,
) -> Result<(Extension<Object>, Json<Submitted>), Failure> {
    if let Some(key) = idempotency_key(&headers)? {
        if submit.idempotency_key.as_ref().is_some_and(|other| *other != key) {
            let message = format!("`{IDEMPOTENCY_KEY}` and the body's `idempotency_key` differ; expected one of them");
            return Err(Failure::invalid(message));
        }
        submit.idempotency_key = Some(key);
    }
    let _place = place(&actor_handle)?;
    let run = actor_handle.submit(submit, caller.owner(), caller.sees()).await?;
    Ok((Extension(Object::Changed(run.to_string())), Json(Submitted { run })))
}

/// Runs in short, in pages.
pub(crate) async fn runs(
    State(actor_handle): State<Arc<ActorHandle>>,
    Extension(caller): Extension<Arc<Caller>>,
    Query(query): Query<RunsQuery>,
) -> Result<Json<Listing<RunSummary>>, Failure> {
    let asked = query.read()?;
    let _turn = turn(&actor_handle).await?;
    Ok(Json(actor_handle.records_for(caller.sees()).run_list(&asked).await?))
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
    let records = actor_handle.records_for(caller.sees());
    let stage = query.stage.as_ref();
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
    headers: HeaderMap,
    Query(query): Query<PointQuery>,
) -> Result<Response, Failure> {
    let _turn = turn(&actor_handle).await?;
    let keys = query.key.is_some().then_some(query.key.as_slice());
    let packed = accepts_packed(&headers);
    // Values of one name alone are as many as a client asks for.
    let most = if packed && query.key.is_some() { limits::PACKED_POINTS } else { limits::CURVE_POINTS };
    let page = Page { after: query.after, limit: query.limit.min(most) };
    let records = actor_handle.records_for(caller.sees());
    let metrics = records.points(&run, query.stage.as_ref(), keys, page).await?;
    // Beside the threads that answer heartbeats: there may be many numbers.
    Ok(blocking(move || match packed {
        true => ([(header::CONTENT_TYPE, PACKED), (header::VARY, "accept")], pack(&metrics)).into_response(),
        false => ([(header::VARY, "accept")], Json(metrics)).into_response(),
    })
    .await)
}

/// Returns true if a client asks for numbers as they are in memory.
pub(super) fn accepts_packed(headers: &HeaderMap) -> bool {
    accepts(headers, PACKED)
}

/// Returns true if a client asks for a media type by its name.
pub(super) fn accepts(headers: &HeaderMap, kind: &str) -> bool {
    headers.get(header::ACCEPT).and_then(|value| value.to_str().ok()).is_some_and(|accepts| accepts.contains(kind))
}

/// Packs values: the length of a head as `u32`, the head as JSON padded with blanks to a multiple of four bytes, then for
/// each series of the head its steps as `u64` and its values as `f64`. All numbers are little-endian.
fn pack(metrics: &StageMetrics) -> Vec<u8> {
    let series = || metrics.iter().flat_map(|(stage, keys)| keys.iter().map(move |(key, curve)| (stage, key, curve)));
    let heads: Vec<_> =
        series().map(|(stage, key, curve)| json!({"stage": stage, "key": key, "rows": curve.points.len()})).collect();
    let mut head = json!(heads).to_string();
    while head.len() % 4 != 0 {
        head.push(' ');
    }
    let mut packed = u32::try_from(head.len()).unwrap_or(u32::MAX).to_le_bytes().to_vec();
    packed.extend(head.into_bytes());
    for (_, _, curve) in series() {
        packed.reserve(16 * curve.points.len());
        packed.extend(curve.points.iter().flat_map(|point| point.step.to_le_bytes()));
        packed.extend(curve.points.iter().flat_map(|point| point.value.to_le_bytes()));
    }
    packed
}

/// Returns events in pages.
pub(crate) async fn history(
    State(actor_handle): State<Arc<ActorHandle>>,
    Extension(caller): Extension<Arc<Caller>>,
    Query(query): Query<HistoryCall>,
) -> Result<Json<Vec<HistoryRow>>, Failure> {
    let HistoryCall { run, worker, after, since, wait, limit } = query;
    let asked = HistoryQuery { run, worker, after, since_ms: since, limit: limit.min(limits::HISTORY_READ) };
    let wait = Duration::from_secs(wait.min(limits::HISTORY_WAIT_S).into());
    Ok(Json(events::wait_for_rows(&actor_handle, caller.sees(), &asked, wait).await?))
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
