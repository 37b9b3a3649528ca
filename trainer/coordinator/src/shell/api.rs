//! The table of calls and the router built from it.

use std::sync::Arc;
use std::time::Duration;

use access::Scope::{self, Admin, Promote, Read, Submit, Worker};
use axum::extract::{DefaultBodyLimit, Request, State};
use axum::handler::Handler;
use axum::http::{Method, StatusCode};
use axum::middleware::Next;
use axum::response::{IntoResponse, Response};
use axum::routing::{MethodFilter, MethodRouter, get, on};
use axum::{Router, middleware};
use protocol::limits;

use super::actor_handle::ActorHandle;
use super::audit;
use super::auth::{self, Gate};
use super::failure::Failure;
use super::route::Route;
use super::{bundles, curves, page_files, polls, queries, scrape, session_calls, settings, uploads};

/// Time limit of a call that waits only for the disk.
const SHORT: Duration = Duration::from_secs(60);
/// Time limit of a call that transfers or reads much data.
const LONG: Duration = Duration::from_secs(3600);

type Entry = (Route, MethodRouter<Arc<ActorHandle>>);

fn entry<H: Handler<T, Arc<ActorHandle>>, T: 'static>(
    method: &'static str,
    path: &'static str,
    scopes: &'static [Scope],
    body: usize,
    time: Duration,
    handler: H,
) -> Entry {
    let filter = Method::from_bytes(method.as_bytes()).ok().and_then(|method| MethodFilter::try_from(method).ok());
    let filter = filter.expect("the table has methods of HTTP");
    (Route { method, path, scopes, body, time }, on(filter, handler))
}

/// All calls except `GET /v1/health` and the page's files. Each has its accepted scopes (a token needs one of them), its
/// largest body and its time limit.
#[rustfmt::skip]
fn table() -> Vec<Entry> {
    const CALL: usize = limits::CALL_BYTES;
    vec![
        entry("POST", "/v1/workers",               &[Worker],       CALL,                     SHORT, polls::join),
        entry("GET",  "/v1/workers",               &[Read],         CALL,                     SHORT, queries::workers),
        entry("POST", "/v1/workers/{worker}/poll", &[Worker],       CALL,                     SHORT, polls::poll),
        entry("POST", "/v1/workers/{worker}/gone", &[Worker],       CALL,                     SHORT, polls::gone),
        entry("POST", "/v1/metrics",               &[Worker],       limits::BATCH_BYTES,      SHORT, uploads::metrics),
        entry("GET",  "/v1/metrics",               &[Read],         CALL,                     SHORT, curves::curves),
        entry("POST", "/v1/logs",                  &[Worker],       limits::BATCH_BYTES,      SHORT, uploads::logs),
        entry("POST", "/v1/checkpoints",           &[Worker],       CALL,                     SHORT, uploads::checkpoint),
        entry("POST", "/v1/outcomes",              &[Worker],       CALL,                     SHORT, uploads::outcome),
        entry("PUT",  "/v1/blobs/{digest}",        &[Worker],       limits::BLOB_BYTES,       LONG,  uploads::put_blob),
        entry("GET",  "/v1/blobs/{digest}/staged", &[Worker],       CALL,                     LONG,  uploads::staged),
        entry("GET",  "/v1/blobs/{digest}",        &[Read, Worker], CALL,                     LONG,  uploads::get_blob),
        entry("POST", "/v1/runs",                  &[Submit],       limits::SUBMISSION_BYTES, SHORT, queries::submit),
        entry("GET",  "/metrics",                  &[Read],         CALL,                     SHORT, scrape::metrics),
        entry("GET",  "/v1/history",               &[Read],         CALL,                     SHORT, queries::history),
        entry("GET",  "/v1/runs",                  &[Read],         CALL,                     SHORT, queries::runs),
        entry("GET",  "/v1/runs/{run}",            &[Read],         CALL,                     SHORT, queries::run),
        entry("GET",  "/v1/runs/{run}/logs",       &[Read],         CALL,                     SHORT, queries::logs),
        entry("GET",  "/v1/runs/{run}/metrics",    &[Read],         CALL,                     SHORT, queries::points),
        entry("GET",  "/v1/runs/{run}/settings",   &[Read],         CALL,                     SHORT, settings::settings),
        entry("POST", "/v1/runs/{run}/{action}",   &[Submit],       CALL,                     SHORT, queries::control),
        entry("POST", "/v1/bundles",               &[Submit],       limits::BUNDLE_BYTES,     LONG,  bundles::import),
        entry("GET",  "/v1/session",               &[Read],         CALL,                     SHORT, session_calls::look),
        entry("POST", "/v1/session",               &[Read],         CALL,                     SHORT, session_calls::begin),
        entry("DELETE", "/v1/session",             &[Read],         CALL,                     SHORT, session_calls::end),
        entry("POST", "/v1/registry", &[Read, Promote, Admin],      CALL,                     LONG,  queries::registry),
    ]
}

/// All calls that need a token.
pub fn routes() -> Vec<Route> {
    table().into_iter().map(|(route, _)| route).collect()
}

/// Builds the router with all routes behind `gate`.
pub(crate) fn router(actor_handle: Arc<ActorHandle>, gate: &Arc<Gate>) -> Router {
    let mut router = Router::new();
    for (route, handler) in table() {
        let admit = middleware::from_fn_with_state((Arc::clone(gate), route), auth::admit);
        router = router.route(route.path, handler.route_layer(DefaultBodyLimit::max(route.body)).route_layer(admit));
    }
    router
        // Reveals only that a server is running, so it needs no token.
        .route("/v1/health", get(queries::health))
        .merge(page_files::router())
        .fallback(|| async { Failure::new(StatusCode::NOT_FOUND, "not-found", "no such path".to_owned()) })
        .layer(middleware::from_fn_with_state(Arc::clone(&actor_handle), until_failed))
        .layer(middleware::from_fn_with_state(Arc::clone(gate), auth::check_host))
        .layer(middleware::map_response(page_files::keep_from_pages))
        .layer(middleware::from_fn_with_state(Arc::clone(&gate.audit), audit::note))
        .with_state(actor_handle)
}

/// Aborts a waiting request when the coordinator stops or fails.
async fn until_failed(State(actor_handle): State<Arc<ActorHandle>>, request: Request, next: Next) -> Response {
    let mut stopped = actor_handle.stopped();
    tokio::select! {
        biased;
        // An error means that the actor has ended, which counts as a stop.
        _ = stopped.wait_for(|stop| *stop) => Failure::from(actor_handle.over()).into_response(),
        response = next.run(request) => {
            actor_handle.meters.answered(response.status());
            response
        }
    }
}
