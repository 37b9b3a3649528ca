//! Refused calls as HTTP answers.

use axum::http::{HeaderValue, StatusCode, header};
use axum::response::{IntoResponse, Response};
use checkpoint::BlobError;
use protocol::limits;
use protocol::message::{ApiError, CODES, Problem};
use registry::{QueryError, WriteError};

use crate::batch::Refused;
use crate::rejected::Rejected;

/// A refused call.
#[derive(Debug)]
pub(crate) struct Failure {
    status: StatusCode,
    error: ApiError,
    /// Seconds after which the same call may succeed.
    retry_after: Option<u32>,
}

impl Failure {
    /// A refusal with one of [`CODES`].
    pub(crate) fn new(status: StatusCode, code: &str, message: String) -> Self {
        debug_assert!(CODES.iter().any(|(known, _)| *known == code), "`{code}` is not in the list of codes");
        Self { status, error: ApiError { code: code.to_owned(), message, hint: None }, retry_after: None }
    }

    /// The refusal of a call that exceeds a temporary limit.
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

    pub(crate) fn too_large(limit: usize) -> Self {
        Self::new(StatusCode::PAYLOAD_TOO_LARGE, "invalid", format!("the body is larger than {limit} bytes"))
    }

    fn body(&self) -> String {
        serde_json::json!(Problem::new(self.status.as_u16(), self.error.clone())).to_string()
    }

    /// Formats the refusal as a whole HTTP answer, for a request that is not read.
    pub(crate) fn to_http(&self) -> Vec<u8> {
        let body = self.body();
        let status = self.status;
        let length = body.len();
        let kind = Problem::CONTENT_TYPE;
        let head =
            format!("HTTP/1.1 {status}\r\ncontent-type: {kind}\r\nconnection: close\r\ncontent-length: {length}");
        format!("{head}\r\n\r\n{body}").into_bytes()
    }

    /// An answer while another process may lead the catalog.
    pub(crate) fn not_leading() -> Self {
        let message = "another process may lead the catalog of this store; ask the other servers".to_owned();
        Self { retry_after: Some(1), ..Self::new(StatusCode::SERVICE_UNAVAILABLE, "unreachable", message) }
    }
}

impl IntoResponse for Failure {
    fn into_response(self) -> Response {
        let kind = [(header::CONTENT_TYPE, Problem::CONTENT_TYPE)];
        let mut response = (self.status, kind, self.body()).into_response();
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
            Rejected::NameHeld(_) => (StatusCode::CONFLICT, "name-held"),
            Rejected::Forbidden(_) => (StatusCode::FORBIDDEN, "forbidden"),
            Rejected::NotFound(_) => (StatusCode::NOT_FOUND, "not-found"),
            Rejected::Conflict(_) => (StatusCode::CONFLICT, "conflict"),
            Rejected::Invalid(_) => (StatusCode::BAD_REQUEST, "invalid"),
            Rejected::UsedUp(_) => {
                let hint = "`registry forget --ended-before 30d` removes the data of ended runs; the limit is `max_gib=` in the server's token file";
                return Self::new(StatusCode::PAYLOAD_TOO_LARGE, "used-up", rejected.to_string()).hint(hint);
            }
            Rejected::Full(_) => {
                let hint = "wait until some have ended, cancel some, or start the server with a larger `--max-runs`";
                return Self::busy(rejected.to_string()).hint(hint);
            }
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
            WriteError::Unreachable(_) => Self::new(StatusCode::SERVICE_UNAVAILABLE, "unreachable", message),
            WriteError::Superseded { .. } => Self::new(StatusCode::SERVICE_UNAVAILABLE, "storage", message),
            WriteError::Unproven { .. } | WriteError::Internal(_) => {
                Self::new(StatusCode::INTERNAL_SERVER_ERROR, "internal", message)
            }
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
                .hint("start it again: acknowledged work is stored; report this bug in Stride"),
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
            // Not a 5xx status: a retry cannot repair the bytes on our disk.
            BlobError::Corrupt { .. } | BlobError::Damaged(_) => Self::new(StatusCode::CONFLICT, "damaged", message)
                .hint("run the pipeline again: it recomputes the stage and repairs the blob"),
            BlobError::Refused(_) => Self::new(StatusCode::CONFLICT, "stale-fence", message),
            BlobError::Unfit(_) => Self::new(StatusCode::PAYLOAD_TOO_LARGE, "too-large", message),
            BlobError::Unreachable(_) => Self::new(StatusCode::SERVICE_UNAVAILABLE, "unreachable", message),
            BlobError::Unavailable(_) => Self::new(StatusCode::INTERNAL_SERVER_ERROR, "internal", message),
        }
    }
}
