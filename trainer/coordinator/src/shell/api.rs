//! Routes, and how refusals look on the wire.

use std::sync::Arc;
use std::time::Duration;

use access::Scope::{self, Admin, Promote, Read, Submit, Worker};
use axum::extract::{DefaultBodyLimit, Request, State};
use axum::handler::Handler;
use axum::http::{HeaderValue, Method, StatusCode, header};
use axum::middleware::Next;
use axum::response::{IntoResponse, Response};
use axum::routing::{MethodFilter, MethodRouter, get, on};
use axum::{Json, Router, middleware};
use checkpoint::BlobError;
use protocol::limits;
use protocol::message::ApiError;
use registry::{QueryError, WriteError};

use super::actor::ActorHandle;
use super::auth::{self, Gate};
use super::{polls, queries, uploads};
use crate::batch::Refused;
use crate::event::Rejected;

/// How long a call may take that waits for nothing but the disk.
const SHORT: Duration = Duration::from_secs(60);
/// How long a call may take that moves or reads much.
const LONG: Duration = Duration::from_secs(3600);

/// A call that can be made, and by whom.
#[derive(Debug, Clone, Copy)]
pub struct Route {
    /// `GET`, `POST` or `PUT`.
    pub method: &'static str,
    /// With `{names}` for what varies.
    pub path: &'static str,
    /// A token needs one of these. For commands of the registry, each command then asks for its own.
    pub scopes: &'static [Scope],
    pub(crate) body: usize,
    pub(crate) time: Duration,
}

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

/// A refused call.
#[derive(Debug)]
pub(crate) struct Failure {
    status: StatusCode,
    error: ApiError,
    /// After how many seconds the same call may succeed.
    retry_after: Option<u32>,
}

impl Failure {
    pub(crate) fn new(status: StatusCode, code: &str, message: String) -> Self {
        Self { status, error: ApiError { code: code.to_owned(), message, hint: None }, retry_after: None }
    }

    /// There is too much of this already; it may come again.
    pub(crate) fn busy(message: String) -> Self {
        let failure = Self::new(StatusCode::TOO_MANY_REQUESTS, "busy", message);
        Self { retry_after: Some(limits::COME_AGAIN_S), ..failure }
    }

    pub(crate) fn hint(mut self, hint: &str) -> Self {
        self.error.hint = Some(hint.to_owned());
        self
    }

    pub(crate) fn invalid(message: String) -> Self {
        Self::new(StatusCode::BAD_REQUEST, "invalid", message)
    }

    /// As the whole answer to a request that is not read.
    pub(crate) fn to_http(&self) -> Vec<u8> {
        let body = serde_json::json!(self.error).to_string();
        let (status, length) = (self.status, body.len());
        let head = format!(
            "HTTP/1.1 {status}\r\ncontent-type: application/json\r\nconnection: close\r\ncontent-length: {length}"
        );
        format!("{head}\r\n\r\n{body}").into_bytes()
    }
}

impl IntoResponse for Failure {
    fn into_response(self) -> Response {
        let mut response = (self.status, Json(self.error)).into_response();
        if let Some(seconds) = self.retry_after {
            response.headers_mut().insert(header::RETRY_AFTER, HeaderValue::from(seconds));
        }
        response
    }
}

impl From<Rejected> for Failure {
    fn from(rejected: Rejected) -> Self {
        let (status, code) = match rejected {
            Rejected::StaleFence { .. } => (StatusCode::CONFLICT, "stale-fence"),
            Rejected::NotFound(_) => (StatusCode::NOT_FOUND, "not-found"),
            Rejected::Conflict(_) => (StatusCode::CONFLICT, "conflict"),
            Rejected::Invalid(_) => (StatusCode::BAD_REQUEST, "invalid"),
        };
        Self::new(status, code, rejected.to_string())
    }
}

impl From<WriteError> for Failure {
    fn from(error: WriteError) -> Self {
        let message = error.to_string();
        match error {
            WriteError::StaleFence { .. } => Self::new(StatusCode::CONFLICT, "stale-fence", message),
            WriteError::Conflict(_) => Self::new(StatusCode::CONFLICT, "conflict", message),
            WriteError::Gate(_) => Self::new(StatusCode::CONFLICT, "gate", message),
            WriteError::NotFound(_) => Self::new(StatusCode::NOT_FOUND, "not-found", message),
            WriteError::Storage(_) => Self::new(StatusCode::INSUFFICIENT_STORAGE, "storage", message)
                .hint("free some space or make the store writable, then `trainer resume`"),
            WriteError::Superseded { .. } => Self::new(StatusCode::SERVICE_UNAVAILABLE, "storage", message),
            WriteError::Internal(_) => Self::new(StatusCode::INTERNAL_SERVER_ERROR, "internal", message),
        }
    }
}

impl From<Refused> for Failure {
    fn from(refused: Refused) -> Self {
        match refused {
            Refused::Rejected(rejected) => rejected.into(),
            Refused::Write(error) => error.into(),
            Refused::Stopped => Self::new(StatusCode::SERVICE_UNAVAILABLE, "internal", refused.to_string()),
            Refused::Failed(_) => Self::new(StatusCode::SERVICE_UNAVAILABLE, "failed", refused.to_string())
                .hint("start it again: what was acknowledged is stored; and report this, for it is a bug of Stride's"),
        }
    }
}

impl From<QueryError> for Failure {
    fn from(error: QueryError) -> Self {
        let message = error.to_string();
        match error {
            QueryError::NotFound(_) => Self::new(StatusCode::NOT_FOUND, "not-found", message),
            QueryError::Invalid(_) => Self::invalid(message),
            QueryError::Database(_) | QueryError::Blob(_) | QueryError::Storage(_) => {
                Self::new(StatusCode::INTERNAL_SERVER_ERROR, "internal", message)
            }
        }
    }
}

impl From<BlobError> for Failure {
    fn from(error: BlobError) -> Self {
        let message = error.to_string();
        match error {
            BlobError::NotFound(_) => Self::new(StatusCode::NOT_FOUND, "not-found", message),
            BlobError::Storage(_) => Self::new(StatusCode::INSUFFICIENT_STORAGE, "storage", message)
                .hint("free some space or make the store writable, then `trainer resume`"),
            // Not 5xx: the bytes on our disk are wrong, and asking again would not change them.
            BlobError::Corrupt { .. } | BlobError::Damaged(_) => Self::new(StatusCode::CONFLICT, "damaged", message)
                .hint("run the pipeline again: the stage that made it is computed anew, which mends it"),
            BlobError::Refused(_) => Self::new(StatusCode::CONFLICT, "stale-fence", message),
            BlobError::Unavailable(_) => Self::new(StatusCode::INTERNAL_SERVER_ERROR, "internal", message),
        }
    }
}
