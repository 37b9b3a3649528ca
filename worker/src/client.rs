//! Calls to the coordinator. An error tells what the answer means; the caller decides about retries.
//!
//! One runtime with one thread drives all connections. Stages and uploads are synchronous and block on it.

use std::sync::{Arc, Mutex};
use std::time::Duration;

use access::{Server, Token, explain};
use bytes::Bytes;
use protocol::message::{ApiError, DesiredAssignments, Gone, Grant, Join, Joined, Poll};
use protocol::proof::{
    BlobStored, DIRECT_HEADER, GRANT_HEADER, PROCESS_HEADER, Process, RECEIPT_HEADER, SECRET_HEADER,
};
use protocol::{Digest, WorkerId};
use reqwest::{RequestBuilder, Response, StatusCode};
use serde::Serialize;
use serde::de::DeserializeOwned;
use tokio::runtime::Handle;

use crate::direct::Direct;
use crate::event_count::lock;
use crate::failpoints;

/// Failure of a call.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub(crate) enum CallError {
    /// The coordinator is unreachable or overloaded. The same call may succeed later.
    #[error("{0}")]
    Away(String),
    /// The coordinator is busy. The same call may succeed after this time.
    #[error("{0}")]
    Busy(String, Duration),
    /// The coordinator reports an internal error.
    #[error("{0}")]
    Fault(String),
    /// The grant is not the task's newest, or the coordinator does not recognise its secret.
    #[error("{0}")]
    Stale(String),
    /// Another process holds the worker's name, for at most the time of its lease.
    #[error("{0}")]
    NameHeld(String),
    /// The coordinator's store is full or not writable. The same call may succeed once there is room.
    #[error("{0}")]
    Full(String),
    /// The fetched data cannot be stored on this machine.
    #[error("{0}")]
    Storage(String),
    /// The object does not exist.
    #[error("{0}")]
    NotFound(String),
    /// The store has the blob, but its bytes are damaged.
    #[error("{0}")]
    Damaged(String),
    /// The run has reached its limit of this resource.
    #[error("{0}")]
    UsedUp(String),
    /// Another member leads the gang by the newest orders, so the call was not made.
    #[error("{0}")]
    NoLongerLeads(String),
    /// The token is missing, unknown or lacks the scope.
    #[error("{0}")]
    Unauthorized(String),
    /// The call is invalid; the same call never succeeds.
    #[error("{0}")]
    Refused(String),
}

impl CallError {
    /// Returns true if the same call may succeed later without any action of the caller.
    pub(crate) fn may_pass(&self) -> bool {
        matches!(self, Self::Away(_) | Self::Busy(..) | Self::Full(_) | Self::Fault(_))
    }
}

/// A connection to the coordinator, with the thread that drives it.
#[derive(Debug, Clone)]
pub(crate) struct Client {
    server: Server,
    /// Requests to the place of the blobs itself.
    pub(crate) direct: Arc<Direct>,
    runtime: Handle,
    /// The secret of this process. Drawn at its start, and held in memory only.
    secret: Token,
    /// Identity of this process, as assigned by the coordinator.
    process: Arc<Mutex<Option<Process>>>,
}

/// A grant with its secret.
#[derive(Clone, PartialEq, Eq)]
pub(crate) struct Credential {
    pub(crate) grant: Grant,
    pub(crate) secret: String,
}

impl std::fmt::Debug for Credential {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Credential").field("grant", &self.grant).finish_non_exhaustive()
    }
}

/// Timeout of calls with small bodies.
const SHORT: Duration = Duration::from_secs(30);
/// Timeout of blob transfers; the coordinator writes a blob to disk before it answers.
const LONG: Duration = Duration::from_secs(600);

impl Client {
    pub(crate) fn new(server: Server, runtime: Handle) -> Self {
        let secret = failpoints::secret().unwrap_or_else(Token::random);
        Self { server, direct: Arc::default(), runtime, secret, process: Arc::default() }
    }

    /// The coordinator's address.
    pub(crate) fn url(&self) -> &str {
        self.server.url()
    }

    fn request(&self, method: reqwest::Method, path: &str, timeout: Duration) -> RequestBuilder {
        self.server.request(method, path).timeout(timeout)
    }

    async fn send(&self, request: RequestBuilder) -> Result<Response, CallError> {
        check(self.server.send(request).await).await
    }

    /// Blocks on a call. The calling thread must not be the runtime's.
    pub(crate) fn wait<T>(&self, call: impl Future<Output = T>) -> T {
        self.runtime.block_on(call)
    }

    /// Joins as this process. A repeated join, after a lost answer, shows the same secret.
    pub(crate) async fn join(&self, join: &Join) -> Result<Joined, CallError> {
        let joined: Joined = answer(self.post("/v1/workers", self.secret.secret(), join, SHORT).await?).await?;
        let process = Process { worker: join.worker.clone(), incarnation: joined.incarnation };
        *lock(&self.process) = Some(process);
        Ok(joined)
    }

    pub(crate) async fn poll(
        &self,
        path: &str,
        poll: &Poll,
        patience: Duration,
    ) -> Result<DesiredAssignments, CallError> {
        answer(self.post(path, self.secret.secret(), poll, patience).await?).await
    }

    /// Reports that this process ends, so that its name and its work are free before its lease ends.
    pub(crate) async fn leave(&self, worker: &WorkerId) -> Result<(), CallError> {
        let Some(Process { incarnation, .. }) = lock(&self.process).clone() else { return Ok(()) };
        let path = format!("/v1/workers/{worker}/gone");
        self.post(&path, self.secret.secret(), &Gone { incarnation }, SHORT).await.map(drop)
    }

    /// Sends a write under a grant; a successful answer carries no data.
    pub(crate) async fn tell<T: Serialize + Sync>(
        &self,
        path: &str,
        credential: &Credential,
        what: &T,
    ) -> Result<(), CallError> {
        self.post(path, &credential.secret, what, SHORT).await.map(drop)
    }

    /// Asks how much of a blob the coordinator has, and for a signed request that sends it. Shows the receipt of an earlier
    /// upload, if there is one.
    pub(crate) async fn staged(
        &self,
        credential: &Credential,
        digest: Digest,
        receipt: Option<String>,
    ) -> Result<BlobStored, CallError> {
        let request = self.request(reqwest::Method::GET, &format!("/v1/blobs/{digest}/staged"), LONG);
        let mut request = in_the_name_of(request, credential)?;
        if let Some(receipt) = receipt {
            request = request.header(RECEIPT_HEADER, receipt);
        }
        if self.direct.is_used() {
            request = request.header(DIRECT_HEADER, "1");
        }
        answer(self.send(request).await?).await
    }

    /// Reports that a blob was sent by a signed request.
    pub(crate) async fn sent(&self, credential: &Credential, digest: Digest) -> Result<BlobStored, CallError> {
        let request = self.request(reqwest::Method::POST, &format!("/v1/blobs/{digest}/sent"), LONG);
        answer(self.send(in_the_name_of(request, credential)?).await?).await
    }

    /// Sends a part that begins at `offset` of a blob of `bytes` bytes.
    pub(crate) async fn put_part(
        &self,
        credential: &Credential,
        digest: Digest,
        bytes: u64,
        offset: u64,
        part: Bytes,
    ) -> Result<BlobStored, CallError> {
        let request = self.request(reqwest::Method::PUT, &format!("/v1/blobs/{digest}"), LONG);
        let request = in_the_name_of(request, credential)?.header("content-type", "application/octet-stream");
        let request = request.header("x-stride-bytes", bytes).header("x-stride-offset", offset);
        answer(self.send(request.body(part)).await?).await
    }

    /// Requests a blob from `offset` to its end, from the place of the blobs if the coordinator redirects there.
    /// `through_server` forbids that.
    pub(crate) async fn get_blob(
        &self,
        digest: Digest,
        offset: u64,
        through_server: bool,
    ) -> Result<Download, CallError> {
        let mut request = self.request(reqwest::Method::GET, &format!("/v1/blobs/{digest}"), LONG);
        if offset > 0 {
            request = request.header("range", format!("bytes={offset}-"));
        }
        if let Some(process) = &*lock(&self.process) {
            request = request.header(PROCESS_HEADER, header(process)?).header(SECRET_HEADER, self.secret.secret());
        }
        if !through_server && self.direct.is_used() {
            request = request.header(DIRECT_HEADER, "1");
        }
        let sent = self.server.send(request).await;
        if let Ok(answer) = &sent
            && answer.status() == StatusCode::TEMPORARY_REDIRECT
        {
            let place = answer.headers().get("location").and_then(|place| place.to_str().ok()).unwrap_or_default();
            let response = self.direct.get(place, offset).await.map_err(CallError::Away)?;
            return Ok(Download { response, direct: Some(Arc::clone(&self.direct)) });
        }
        let response = check(sent).await?;
        match (offset, response.status()) {
            (0, _) | (_, StatusCode::PARTIAL_CONTENT) => Ok(Download { response, direct: None }),
            (_, status) => {
                Err(CallError::Refused(format!("the coordinator answered {status} to a part of blob {digest}")))
            }
        }
    }

    async fn post<T: Serialize + Sync>(
        &self,
        path: &str,
        secret: &str,
        what: &T,
        timeout: Duration,
    ) -> Result<Response, CallError> {
        let request = self.request(reqwest::Method::POST, path, timeout).header(SECRET_HEADER, secret);
        self.send(request.json(what)).await
    }
}

/// A blob that is being downloaded.
#[derive(Debug)]
pub(crate) struct Download {
    response: Response,
    /// Present if the bytes come from the place of the blobs.
    direct: Option<Arc<Direct>>,
}

impl Download {
    /// The number of bytes to come, if it is known.
    pub(crate) fn length(&self) -> Option<u64> {
        self.response.content_length()
    }

    /// The next bytes; `None` after the last.
    pub(crate) async fn next(&mut self) -> Result<Option<Bytes>, CallError> {
        match &self.direct {
            Some(direct) => direct.next(&mut self.response).await.map_err(CallError::Away),
            None => self.response.chunk().await.map_err(|error| CallError::Away(explain(&error))),
        }
    }
}

fn in_the_name_of(request: RequestBuilder, credential: &Credential) -> Result<RequestBuilder, CallError> {
    Ok(request.header(GRANT_HEADER, header(&credential.grant)?).header(SECRET_HEADER, &credential.secret))
}

/// Serialises a header value as JSON.
fn header(value: &impl Serialize) -> Result<String, CallError> {
    serde_json::to_string(value).map_err(|e| CallError::Refused(e.to_string()))
}

async fn answer<T: DeserializeOwned>(response: Response) -> Result<T, CallError> {
    let bytes = response.bytes().await.map_err(|e| CallError::Away(explain(&e)))?;
    serde_json::from_slice(&bytes).map_err(|e| {
        CallError::Refused(format!("cannot parse the coordinator's answer: {e}; use the same build for both"))
    })
}

async fn check(sent: Result<Response, reqwest::Error>) -> Result<Response, CallError> {
    let response =
        sent.map_err(|e| if e.is_builder() { CallError::Refused(explain(&e)) } else { CallError::Away(explain(&e)) })?;
    let status = response.status();
    if status.is_success() {
        return Ok(response);
    }
    let after = access::retry_after(&response);
    let body = response.bytes().await.unwrap_or_default();
    let error = serde_json::from_slice::<ApiError>(&body).unwrap_or_else(|_| ApiError {
        code: String::new(),
        message: format!("{status}: {}", String::from_utf8_lossy(&body).chars().take(200).collect::<String>()),
        hint: None,
    });
    let message = match error.hint {
        Some(hint) => format!("{}; {hint}", error.message),
        None => error.message,
    };
    Err(match (status, error.code.as_str()) {
        (_, "stale-fence" | "unproven") => CallError::Stale(message),
        (_, "name-held") => CallError::NameHeld(message),
        (_, "storage") | (StatusCode::INSUFFICIENT_STORAGE, _) => CallError::Full(message),
        (_, "not-found") | (StatusCode::NOT_FOUND, _) => CallError::NotFound(message),
        (_, "damaged") => CallError::Damaged(message),
        (_, "arrived-damaged") => CallError::Fault(message),
        (_, "used-up") => CallError::UsedUp(message),
        // The next call asks again how much has arrived.
        (StatusCode::RANGE_NOT_SATISFIABLE, "offset") => CallError::Away(message),
        (StatusCode::TOO_MANY_REQUESTS, _) => CallError::Busy(message, after),
        (StatusCode::REQUEST_TIMEOUT, _) => CallError::Away(message),
        (StatusCode::INTERNAL_SERVER_ERROR, _) => CallError::Fault(message),
        (status, _) if status.is_server_error() => CallError::Away(message),
        (StatusCode::UNAUTHORIZED, _) | (_, "forbidden") => CallError::Unauthorized(message),
        _ => CallError::Refused(message),
    })
}
