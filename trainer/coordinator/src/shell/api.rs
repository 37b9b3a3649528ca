//! The table of calls and the router built from it.

use std::sync::{Arc, LazyLock};
use std::time::Duration;

use access::Scope::{self, Admin, Launch, Promote, Read, Submit, Worker};
use axum::extract::{DefaultBodyLimit, Request, State};
use axum::handler::Handler;
use axum::http::{Method, StatusCode};
use axum::middleware::Next;
use axum::response::{IntoResponse, Response};
use axum::routing::{MethodFilter, MethodRouter, get, on};
use axum::{Json, Router, middleware};
use protocol::demand::Demand;
use protocol::limits;
use protocol::message::{
    self, CommitCheckpoint, DesiredAssignments, Gone, Join, Joined, Listing, LogBatch, MetricBatch, Poll,
    ReportOutcome, RunSummary, RunView,
};
use protocol::proof::{
    BlobStored, DIRECT_HEADER, GRANT_HEADER, PROCESS_HEADER, RECEIPT_HEADER, SECRET_HEADER, Vouched,
};
use registry::cli::{Answer, Command};
use registry::{HistoryRow, LogRow};

use super::actor_handle::ActorHandle;
use super::audit;
use super::auth::{self, Gate};
use super::bundles::BundleQuery;
use super::checkpoints::KeptCheckpoint;
use super::curves::{Curves, CurvesAsked};
use super::demand::{self, DemandQuery};
use super::described::{Bytes, Described, EventStream, Exposition, Nothing, Packed, described};
use super::draws::{Draw, Drawing};
use super::events::EventsQuery;
use super::extract::Query;
use super::failure::Failure;
use super::openapi::document;
use super::queries::{HistoryCall, LogQuery, PointQuery, RunsQuery, Storage, Submitted};
use super::records::StageMetrics;
use super::route::Route;
use super::run_settings::RunSettings;
use super::session_calls::Who;
use super::tickets::Ticket;
use super::{
    bundles, checkpoints, curves, draws, events, page_files, polls, queries, scrape, session_calls, settings, spans,
    uploads,
};
use crate::view::WorkerView;

/// Time limit of a call that waits only for the disk.
const SHORT: Duration = Duration::from_secs(60);
/// Time limit of a call that transfers or reads much data.
const LONG: Duration = Duration::from_secs(3600);

type Entry = (Route, Described, MethodRouter<Arc<ActorHandle>>);

fn entry<H: Handler<T, Arc<ActorHandle>>, T: 'static>(
    method: &'static str,
    path: &'static str,
    scopes: &'static [Scope],
    body: usize,
    time: Duration,
    handler: H,
    described: Described,
) -> Entry {
    let filter = Method::from_bytes(method.as_bytes()).ok().and_then(|method| MethodFilter::try_from(method).ok());
    let filter = filter.expect("the table has methods of HTTP");
    (Route { method, path, scopes, body, time }, described, on(filter, handler))
}

type Headers = &'static [(&'static str, bool, &'static str)];

const PROCESS: Headers = &[(SECRET_HEADER, true, "Secret of the worker's process")];
const GRANT: Headers = &[(SECRET_HEADER, true, "Secret of the grant")];
const GRANTED: Headers = &[(SECRET_HEADER, true, "Secret of the grant"), (GRANT_HEADER, true, "The grant as JSON")];
const UPLOAD: Headers = &[
    (SECRET_HEADER, true, "Secret of the grant"),
    (GRANT_HEADER, true, "The grant as JSON"),
    (RECEIPT_HEADER, false, "Receipt of an earlier upload"),
    (DIRECT_HEADER, false, "Asks for a signed request that stores the blob"),
];
const DOWNLOAD: Headers = &[
    ("range", false, "The first byte: `bytes=N-`"),
    (PROCESS_HEADER, false, "The worker's process as JSON"),
    (SECRET_HEADER, false, "Secret of the worker's process"),
    (DIRECT_HEADER, false, "The caller follows a redirect (307) to the place of the blobs"),
];
const SUBMISSION: Headers =
    &[(queries::IDEMPOTENCY_KEY, false, "A submission that is sent twice with one key makes one run")];
const RESUME: Headers = &[(events::LAST_EVENT_ID, false, "The last event that the client has seen")];

/// All calls except `GET /v1/health` and the page's files. Each has its accepted scopes (a token needs one of them), its
/// largest body and its time limit.
#[rustfmt::skip]
fn table() -> Vec<Entry> {
    const CALL: usize = limits::CALL_BYTES;
    vec![
        entry("POST", "/v1/workers",               &[Worker],       CALL,                     SHORT, polls::join,
            described::<Nothing, Json<Join>, Json<Joined>>("Registers a process as a worker").with(PROCESS)),
        entry("GET",  "/v1/workers",               &[Read],         CALL,                     SHORT, queries::workers,
            described::<Nothing, Nothing, Json<Vec<WorkerView>>>("Lists workers")),
        entry("POST", "/v1/workers/{worker}/poll", &[Worker],       CALL,                     SHORT, polls::poll,
            described::<Nothing, Json<Poll>, Json<DesiredAssignments>>("Reports a worker's work and asks for assignments").with(PROCESS)),
        entry("POST", "/v1/workers/{worker}/gone", &[Worker],       CALL,                     SHORT, polls::gone,
            described::<Nothing, Json<Gone>, Json<()>>("Reports the end of a worker's process").with(PROCESS)),
        entry("POST", "/v1/metrics",               &[Worker],       limits::BATCH_BYTES,      SHORT, uploads::metrics,
            described::<Nothing, Json<MetricBatch>, Json<()>>("Stores values by step").with(GRANT)),
        entry("GET",  "/v1/metrics",               &[Read],         CALL,                     SHORT, curves::curves,
            described::<Query<CurvesAsked>, Nothing, Packed<Curves>>("Draws curves of runs in buckets")),
        entry("POST", "/v1/logs",                  &[Worker],       limits::BATCH_BYTES,      SHORT, uploads::logs,
            described::<Nothing, Json<LogBatch>, Json<()>>("Stores log lines").with(GRANT)),
        entry("POST", "/v1/checkpoints",           &[Worker],       CALL,                     SHORT, uploads::checkpoint,
            described::<Nothing, Json<Vouched<CommitCheckpoint>>, Json<()>>("Commits a checkpoint").with(GRANT)),
        entry("POST", "/v1/outcomes",              &[Worker],       CALL,                     SHORT, uploads::outcome,
            described::<Nothing, Json<Vouched<ReportOutcome>>, Json<()>>("Reports the end of an assignment").with(GRANT)),
        entry("PUT",  "/v1/blobs/{digest}",        &[Worker],       limits::BLOB_BYTES,       LONG,  uploads::put_blob,
            described::<Nothing, Bytes, Json<BlobStored>>("Uploads a blob, or a part of one").with(UPLOAD)),
        entry("GET",  "/v1/blobs/{digest}/staged", &[Worker],       CALL,                     LONG,  uploads::staged,
            described::<Nothing, Nothing, Json<BlobStored>>("Tells how much of a blob has arrived").with(UPLOAD)),
        entry("POST", "/v1/blobs/{digest}/sent",   &[Worker],       CALL,                     LONG,  uploads::sent,
            described::<Nothing, Nothing, Json<BlobStored>>("Takes over a blob that a signed request has stored").with(GRANTED)),
        entry("GET",  "/v1/blobs/{digest}",        &[Read, Worker], CALL,                     LONG,  uploads::get_blob,
            described::<Nothing, Nothing, Bytes>("Downloads a blob, or its rest").with(DOWNLOAD)),
        entry("GET",  "/v1/demand",                &[Launch],       CALL,                     SHORT, demand::demand,
            described::<Query<DemandQuery>, Nothing, Json<Demand>>("Shows the demand for workers, or waits for a change of it")),
        entry("POST", "/v1/runs",                  &[Submit],       limits::SUBMISSION_BYTES, SHORT, queries::submit,
            described::<Nothing, Json<message::Submit>, Json<Submitted>>("Submits a pipeline").with(SUBMISSION)),
        entry("POST", "/v1/draws",                 &[Submit],       CALL,                     SHORT, draws::draw,
            described::<Nothing, Json<Draw>, Json<Drawing>>("Draws motions of models for sentences").with(SUBMISSION)),
        entry("POST", "/v1/tickets",               &[Submit],       CALL,                     SHORT, session_calls::ticket,
            described::<Nothing, Nothing, Json<Ticket>>("Makes a ticket by which a browser enters a stream once")),
        entry("GET",  "/metrics",                  &[Read],         CALL,                     SHORT, scrape::metrics,
            described::<Nothing, Nothing, Exposition>("Shows the server's own numbers to Prometheus")),
        entry("GET",  "/v1/history",               &[Read],         CALL,                     SHORT, queries::history,
            described::<Query<HistoryCall>, Nothing, Json<Vec<HistoryRow>>>("Lists events, or waits for them")),
        entry("GET",  "/v1/events",                &[Read],         CALL,                     SHORT, events::events,
            described::<Query<EventsQuery>, Nothing, EventStream>("Streams events as they come").with(RESUME)),
        entry("GET",  "/v1/storage",               &[Admin],        CALL,                     SHORT, queries::storage,
            described::<Nothing, Nothing, Json<Storage>>("Shows the store's bytes by kind, and checks of its folder")),
        entry("GET",  "/v1/runs",                  &[Read],         CALL,                     SHORT, queries::runs,
            described::<Query<RunsQuery>, Nothing, Json<Listing<RunSummary>>>("Lists runs in short")),
        entry("GET",  "/v1/runs/{run}",            &[Read],         CALL,                     SHORT, queries::run,
            described::<Nothing, Nothing, Json<RunView>>("Shows a run with its stages")),
        entry("GET",  "/v1/runs/{run}/logs",       &[Read],         CALL,                     SHORT, queries::logs,
            described::<Query<LogQuery>, Nothing, Json<Vec<LogRow>>>("Lists log lines of a run")),
        entry("GET",  "/v1/runs/{run}/metrics",    &[Read],         CALL,                     SHORT, queries::points,
            described::<Query<PointQuery>, Nothing, Packed<StageMetrics>>("Lists every value of a run")),
        entry("GET",  "/v1/runs/{run}/checkpoints", &[Read],        CALL,                     SHORT, checkpoints::checkpoints,
            described::<Nothing, Nothing, Json<Vec<KeptCheckpoint>>>("Lists the checkpoints of a run that are kept")),
        entry("GET",  "/v1/runs/{run}/settings",   &[Read],         CALL,                     SHORT, settings::settings,
            described::<Nothing, Nothing, Json<RunSettings>>("Shows the settings of a run's stages")),
        entry("POST", "/v1/runs/{run}/{action}",   &[Submit],       CALL,                     SHORT, queries::control,
            described::<Nothing, Nothing, Json<RunView>>("Pauses, resumes or cancels a run")),
        entry("POST", "/v1/bundles",               &[Submit],       limits::BUNDLE_BYTES,     LONG,  bundles::import,
            described::<Query<BundleQuery>, Bytes, Json<Answer>>("Imports a bundle of another store")),
        entry("GET",  "/v1/session",               &[Read],         CALL,                     SHORT, session_calls::look,
            described::<Nothing, Nothing, Json<Who>>("Shows the caller")),
        entry("POST", "/v1/session",               &[Read],         CALL,                     SHORT, session_calls::begin,
            described::<Nothing, Nothing, Json<Who>>("Buys a session for a browser")),
        entry("DELETE", "/v1/session",             &[Read],         CALL,                     SHORT, session_calls::end,
            described::<Nothing, Nothing, Json<()>>("Ends a session")),
        entry("POST", "/v1/registry", &[Read, Promote, Admin],      CALL,                     LONG,  queries::registry,
            described::<Nothing, Json<Command>, Json<Answer>>("Runs a command of the registry")),
    ]
}

/// All calls that need a token.
pub fn routes() -> Vec<Route> {
    table().into_iter().map(|(route, ..)| route).collect()
}

/// The document of OpenAPI that describes all calls.
pub fn openapi() -> serde_json::Value {
    let calls: Vec<(Route, Described)> = table().into_iter().map(|(route, described, _)| (route, described)).collect();
    let open = [
        ("/v1/health", described::<Nothing, Nothing, Json<queries::Health>>("Tells whether the server runs")),
        ("/v1/openapi.json", described::<Nothing, Nothing, Json<serde_json::Value>>("Describes all calls")),
    ];
    document(&calls, &open)
}

async fn described_calls() -> Json<serde_json::Value> {
    static DOCUMENT: LazyLock<serde_json::Value> = LazyLock::new(openapi);
    Json(DOCUMENT.clone())
}

/// Builds the router with all routes behind `gate`.
pub(crate) fn router(actor_handle: Arc<ActorHandle>, gate: &Arc<Gate>) -> Router {
    let mut router = Router::new();
    for (route, _, handler) in table() {
        let admit = middleware::from_fn_with_state((Arc::clone(gate), route), auth::admit);
        router = router.route(route.path, handler.route_layer(DefaultBodyLimit::max(route.body)).route_layer(admit));
    }
    router
        // Reveals only that a server is running, so it needs no token.
        .route("/v1/health", get(queries::health))
        // As does the list of calls.
        .route("/v1/openapi.json", get(described_calls))
        .merge(page_files::router(gate.stream.as_ref()))
        .fallback(absent)
        .method_not_allowed_fallback(no_such_method)
        .layer(middleware::from_fn_with_state(Arc::clone(&actor_handle), until_failed))
        .layer(middleware::from_fn_with_state(Arc::clone(gate), auth::check_host))
        .layer(middleware::map_response(page_files::keep_from_pages))
        .layer(middleware::from_fn_with_state(Arc::clone(&gate.audit), audit::note))
        .layer(middleware::from_fn(spans::request))
        .with_state(actor_handle)
}

pub(super) async fn absent() -> Failure {
    Failure::new(StatusCode::NOT_FOUND, "not-found", "no such path".to_owned())
}

pub(super) async fn no_such_method(method: Method) -> Failure {
    let message = format!("this path has no method `{method}`; the header `allow` lists those that it has");
    Failure::new(StatusCode::METHOD_NOT_ALLOWED, "method", message)
}

/// Aborts a waiting request when the coordinator stops or fails, and answers nothing while another process may lead.
async fn until_failed(State(actor_handle): State<Arc<ActorHandle>>, request: Request, next: Next) -> Response {
    let mut stopped = actor_handle.stopped();
    if !actor_handle.leads() {
        return Failure::not_leading().into_response();
    }
    tokio::select! {
        biased;
        // An error means that the actor has ended, which counts as a stop.
        _ = stopped.wait_for(|stop| *stop) => Failure::from(actor_handle.over()).into_response(),
        response = next.run(request) => {
            actor_handle.meters.answered(response.status());
            // This process may have been stopped since.
            if actor_handle.leads() { response } else { Failure::not_leading().into_response() }
        }
    }
}
