//! Routes, and how refusals look on the wire.

use std::sync::Arc;

use axum::extract::DefaultBodyLimit;
use axum::http::StatusCode;
use axum::response::{IntoResponse, Response};
use axum::routing::{get, post, put};
use axum::{Json, Router, middleware};
use checkpoint::BlobError;
use protocol::Digest;
use protocol::message::ApiError;
use registry::{QueryError, WriteError};

use super::actor::{ActorHandle, Refused};
use super::{auth, polls, queries, uploads};
use crate::event::Rejected;

/// The largest message that is no blob.
const MESSAGE_BYTES: usize = 64 << 20;
/// The largest blob.
const BLOB_BYTES: usize = 8 << 30;

/// All routes.
pub(crate) fn router(actor_handle: Arc<ActorHandle>, token: Option<&str>) -> Router {
    let token = token.filter(|token| !token.is_empty()).map(|token| Digest::of(token.trim().as_bytes()));
    let blobs = Router::new()
        .route("/v1/blobs", put(uploads::put_blob))
        .route("/v1/blobs/{digest}", get(uploads::get_blob))
        .layer(DefaultBodyLimit::max(BLOB_BYTES));
    Router::new()
        .route("/v1/workers", post(polls::join).get(queries::workers))
        .route("/v1/workers/{worker}/poll", post(polls::poll))
        .route("/v1/workers/{worker}/gone", post(polls::gone))
        .route("/v1/metrics", post(uploads::metrics))
        .route("/v1/logs", post(uploads::logs))
        .route("/v1/checkpoints", post(uploads::checkpoint))
        .route("/v1/outcomes", post(uploads::outcome))
        .route("/v1/runs", post(queries::submit).get(queries::runs))
        .route("/v1/runs/{run}", get(queries::run))
        .route("/v1/runs/{run}/logs", get(queries::logs))
        .route("/v1/runs/{run}/metrics", get(queries::metrics))
        .route("/v1/runs/{run}/{action}", post(queries::control))
        .route("/v1/registry", post(queries::registry))
        .layer(DefaultBodyLimit::max(MESSAGE_BYTES))
        .merge(blobs)
        .layer(middleware::from_fn_with_state(token, auth::require_token))
        // Says nothing but that somebody listens, so that it may be asked without a token.
        .route("/v1/health", get(queries::health))
        .fallback(|| async { Failure::new(StatusCode::NOT_FOUND, "not-found", "there is no such address".to_owned()) })
        .with_state(actor_handle)
}

/// A refused call.
#[derive(Debug)]
pub(crate) struct Failure {
    status: StatusCode,
    error: ApiError,
}

impl Failure {
    pub(crate) fn new(status: StatusCode, code: &str, message: String) -> Self {
        Self { status, error: ApiError { code: code.to_owned(), message, hint: None } }
    }

    pub(crate) fn hint(mut self, hint: &str) -> Self {
        self.error.hint = Some(hint.to_owned());
        self
    }

    pub(crate) fn invalid(message: String) -> Self {
        Self::new(StatusCode::BAD_REQUEST, "invalid", message)
    }
}

impl IntoResponse for Failure {
    fn into_response(self) -> Response {
        (self.status, Json(self.error)).into_response()
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
        }
    }
}

impl From<QueryError> for Failure {
    fn from(error: QueryError) -> Self {
        let message = error.to_string();
        match error {
            QueryError::NotFound(_) => Self::new(StatusCode::NOT_FOUND, "not-found", message),
            QueryError::Invalid(_) => Self::invalid(message),
            QueryError::Database(_) | QueryError::Blob(_) => {
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
            BlobError::Corrupt { .. } => Self::new(StatusCode::CONFLICT, "conflict", message)
                .hint("the blob is damaged on disk; remove it and run the stage that made it again"),
            BlobError::Refused(_) => Self::new(StatusCode::CONFLICT, "stale-fence", message),
            BlobError::Unavailable(_) => Self::new(StatusCode::INTERNAL_SERVER_ERROR, "internal", message),
        }
    }
}
