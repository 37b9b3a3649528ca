//! The table of calls, and the router that is made of it.

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
use super::{bundles, polls, queries, uploads};

/// How long a call may take that waits for nothing but the disk.
const SHORT: Duration = Duration::from_secs(60);
/// How long a call may take that moves or reads much.
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

/// Every call but `GET /v1/health`, with the scopes of which its token needs one, its largest body and its time.
#[rustfmt::skip]
fn table() -> Vec<Entry> {
    const CALL: usize = limits::CALL_BYTES;
    vec![
        entry("POST", "/v1/workers",               &[Worker],       CALL,                     SHORT, polls::join),
        entry("GET",  "/v1/workers",               &[Read],         CALL,                     SHORT, queries::workers),
        entry("POST", "/v1/workers/{worker}/poll", &[Worker],       CALL,                     SHORT, polls::poll),
        entry("POST", "/v1/workers/{worker}/gone", &[Worker],       CALL,                     SHORT, polls::gone),
        entry("POST", "/v1/metrics",               &[Worker],       limits::BATCH_BYTES,      SHORT, uploads::metrics),
        entry("POST", "/v1/logs",                  &[Worker],       limits::BATCH_BYTES,      SHORT, uploads::logs),
        entry("POST", "/v1/checkpoints",           &[Worker],       CALL,                     SHORT, uploads::checkpoint),
        entry("POST", "/v1/outcomes",              &[Worker],       CALL,                     SHORT, uploads::outcome),
        entry("PUT",  "/v1/blobs/{digest}",        &[Worker],       limits::BLOB_BYTES,       LONG,  uploads::put_blob),
        entry("GET",  "/v1/blobs/{digest}/staged", &[Worker],       CALL,                     LONG,  uploads::staged),
        entry("GET",  "/v1/blobs/{digest}",        &[Read, Worker], CALL,                     LONG,  uploads::get_blob),
        entry("POST", "/v1/runs",                  &[Submit],       limits::SUBMISSION_BYTES, SHORT, queries::submit),
        entry("GET",  "/v1/runs",                  &[Read],         CALL,                     SHORT, queries::runs),
        entry("GET",  "/v1/runs/{run}",            &[Read],         CALL,                     SHORT, queries::run),
        entry("GET",  "/v1/runs/{run}/logs",       &[Read],         CALL,                     SHORT, queries::logs),
        entry("GET",  "/v1/runs/{run}/metrics",    &[Read],         CALL,                     SHORT, queries::metrics),
        entry("POST", "/v1/runs/{run}/{action}",   &[Submit],       CALL,                     SHORT, queries::control),
        entry("POST", "/v1/bundles",               &[Submit],       limits::BUNDLE_BYTES,     LONG,  bundles::import),
        entry("POST", "/v1/registry", &[Read, Promote, Admin],      CALL,                     LONG,  queries::registry),
    ]
}

/// Every call that needs a token.
pub fn routes() -> Vec<Route> {
    table().into_iter().map(|(route, _)| route).collect()
}

/// All routes behind `gate`.
pub(crate) fn router(actor_handle: Arc<ActorHandle>, gate: &Arc<Gate>) -> Router {
    let mut router = Router::new();
    for (route, handler) in table() {
        let admit = middleware::from_fn_with_state((Arc::clone(gate), route), auth::admit);
        router = router.route(route.path, handler.route_layer(DefaultBodyLimit::max(route.body)).route_layer(admit));
    }
    router
        // Says nothing but that somebody listens, so that it may be asked without a token.
        .route("/v1/health", get(queries::health))
        .fallback(|| async { Failure::new(StatusCode::NOT_FOUND, "not-found", "there is no such address".to_owned()) })
        .layer(middleware::from_fn_with_state(Arc::clone(&actor_handle), until_failed))
        .layer(middleware::from_fn_with_state(Arc::clone(gate), auth::check_host))
        .layer(middleware::from_fn_with_state(Arc::clone(&gate.audit), audit::note))
        .with_state(actor_handle)
}

/// Lets a request wait for its answer only as long as there is somebody to give it.
async fn until_failed(State(actor_handle): State<Arc<ActorHandle>>, request: Request, next: Next) -> Response {
    let mut stopped = actor_handle.stopped();
    tokio::select! {
        biased;
        // An error means that the actor's side is gone, which is a stop too.
        _ = stopped.wait_for(|stop| *stop) => Failure::from(actor_handle.over()).into_response(),
        response = next.run(request) => response,
    }
}
