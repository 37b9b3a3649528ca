//! Uploads of workers. Every grant is checked twice: here against the coordinator's state, which refuses most stale
//! writers before their bytes are read, and again in the transaction, which is decisive.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;
use std::time::Duration;

use access::Scope;
use axum::Json;
use axum::body::Body;
use axum::extract::State;
use axum::http::{HeaderMap, HeaderValue, StatusCode, header};
use axum::response::Response;
use checkpoint::BlobError;
use futures::{StreamExt as _, stream};
use protocol::message::{CommitCheckpoint, Grant, LogBatch, MetricBatch, ReportOutcome, TaskOutcome};
use protocol::proof::{BlobStored, DIRECT_HEADER, RECEIPT_HEADER, SignedRequest, Vouched};
use protocol::{Digest, RunId, limits};
use registry::blob::{Arriving, PART_BYTES, ResumeError};
use registry::{BlobStore, Store, Write, WriteError};

use super::actor_handle::ActorHandle;
use super::body::Message;
use super::extract::Path;
use super::failure::Failure;
use super::secrets::{self, Proof};
use super::storage::ask;
use crate::event::Event;

/// The header with a blob's length.
const BYTES_HEADER: &str = "x-stride-bytes";
/// The header with the body's offset in its blob; 0 if absent.
const OFFSET_HEADER: &str = "x-stride-offset";
/// The largest size of a blob.
const MAX_BLOB_BYTES: u64 = limits::BLOB_BYTES as u64;
/// Longest pause of a body before the upload counts as cut off.
const BODY_IDLE: Duration = Duration::from_secs(30);

/// Stores a batch of metric values or log lines, unless too many batches are already waiting.
async fn write(actor_handle: &ActorHandle, write: Write) -> Result<Json<()>, Failure> {
    let Ok(_place) = actor_handle.batches.try_acquire() else {
        let most = limits::BATCHES_WAITING;
        return Err(Failure::busy(format!("{most} batches of values and lines already wait for the disk")));
    };
    let written = actor_handle.store.write_proven(vec![write]).await;
    actor_handle.wrote(&written);
    written?;
    Ok(Json(()))
}

/// The run of the grant's task.
fn run_of(grant: &Grant) -> RunId {
    RunId::new(grant.task.as_str().split('/').next().unwrap_or_default())
}

/// The refusal of data beyond a run's limit.
fn used_up(message: String, option: &str) -> Failure {
    let failure = Failure::new(StatusCode::PAYLOAD_TOO_LARGE, "used-up", message);
    failure.hint(&format!("write less, or start the server with a larger `{option}`"))
}

pub(crate) async fn metrics(
    State(actor_handle): State<Arc<ActorHandle>>,
    proof: Proof,
    Message(batch, _): Message<MetricBatch>,
) -> Result<Json<()>, Failure> {
    proof.of_grant(&actor_handle.secrets, &batch.grant)?;
    actor_handle.state().check_telemetry(&batch.grant)?;
    let run = run_of(&batch.grant);
    let most = actor_handle.allowances.values;
    if actor_handle.store.usage(&run).await?.values + batch.rows.len() as u64 > most {
        return Err(used_up(format!("run `{run}` has recorded {most} values, which is its limit"), "--max-values"));
    }
    let values = batch.rows.len();
    let stored = write(&actor_handle, Write::Metrics { grant: batch.grant, rows: batch.rows }).await?;
    actor_handle.meters.recorded(values, 0);
    Ok(stored)
}

pub(crate) async fn logs(
    State(actor_handle): State<Arc<ActorHandle>>,
    proof: Proof,
    Message(batch, _): Message<LogBatch>,
) -> Result<Json<()>, Failure> {
    proof.of_grant(&actor_handle.secrets, &batch.grant)?;
    actor_handle.state().check_telemetry(&batch.grant)?;
    let run = run_of(&batch.grant);
    let most = actor_handle.allowances.log_bytes;
    let bytes: usize = batch.lines.iter().map(String::len).sum();
    if actor_handle.store.usage(&run).await?.log_bytes + bytes as u64 > most {
        let message = format!("run `{run}` has written {most} bytes of log lines, which is its limit");
        return Err(used_up(message, "--max-log-mib"));
    }
    let lines = batch.lines.len();
    let stored =
        write(&actor_handle, Write::Logs { grant: batch.grant, first: batch.first, lines: batch.lines }).await?;
    actor_handle.meters.recorded(0, lines);
    Ok(stored)
}

pub(crate) async fn checkpoint(
    State(actor_handle): State<Arc<ActorHandle>>,
    proof: Proof,
    Message(vouched, _): Message<Vouched<CommitCheckpoint>>,
) -> Result<Json<()>, Failure> {
    let Vouched { what: commit, receipts } = vouched;
    proof.of_grant(&actor_handle.secrets, &commit.grant)?;
    check_blobs(&actor_handle, &proof, &commit.grant, commit.manifest, &receipts).await?;
    actor_handle.decide(Event::Checkpoint { commit }).await?;
    Ok(Json(()))
}

pub(crate) async fn outcome(
    State(actor_handle): State<Arc<ActorHandle>>,
    proof: Proof,
    Message(vouched, _): Message<Vouched<ReportOutcome>>,
) -> Result<Json<()>, Failure> {
    let Vouched { what: report, receipts } = vouched;
    proof.of_grant(&actor_handle.secrets, &report.grant)?;
    if let TaskOutcome::Finished { output, .. } = report.outcome {
        check_blobs(&actor_handle, &proof, &report.grant, output, &receipts).await?;
    }
    actor_handle.decide(Event::Outcome { report }).await?;
    Ok(Json(()))
}

/// Checks that a manifest names only blobs that its worker uploaded for this task or may read.
async fn check_blobs(
    actor_handle: &ActorHandle,
    proof: &Proof,
    grant: &Grant,
    manifest: Digest,
    receipts: &BTreeMap<Digest, String>,
) -> Result<(), Failure> {
    let state = actor_handle.state();
    // An invalid grant is left to the decision. Fences only grow, so it cannot become valid meanwhile.
    let (Ok(()), Ok(roots)) = (state.check_write(grant), state.read_by(&grant.task)) else { return Ok(()) };
    let caller = &proof.caller.name;
    let is_own = |(digest, shown): &(&Digest, &String)| actor_handle.secrets.is_receipt(caller, grant, **digest, shown);
    let own: BTreeSet<Digest> = receipts.iter().filter(is_own).map(|(digest, _)| *digest).collect();
    let reach = Arc::clone(&actor_handle.reach);
    let looking = move |blobs: &BlobStore| reach.foreign(blobs, &roots, |digest| own.contains(&digest), manifest);
    match ask(&actor_handle.store, looking).await? {
        None => Ok(()),
        Some(digest) => Err(Failure::new(
            StatusCode::CONFLICT,
            "unvouched",
            format!(
                "manifest {manifest} names blob {digest}, which this worker neither uploaded for the task nor may read"
            ),
        )
        .hint("upload every blob under the task's grant and send the receipts")),
    }
}

/// The grant of an upload, checked before the body is read.
fn granted(actor_handle: &ActorHandle, proof: &Proof, headers: &HeaderMap) -> Result<Grant, Failure> {
    let grant = secrets::grant(headers)?;
    proof.of_grant(&actor_handle.secrets, &grant)?;
    actor_handle.state().check_write(&grant)?;
    Ok(grant)
}

/// The value of a numeric header.
fn number(headers: &HeaderMap, name: &str) -> Result<Option<u64>, Failure> {
    let Some(value) = headers.get(name) else { return Ok(None) };
    let number = value.to_str().ok().and_then(|text| text.parse().ok());
    number.map(Some).ok_or_else(|| Failure::invalid(format!("header `{name}` is not a number of bytes")))
}

fn named(digest: &str) -> Result<Digest, Failure> {
    digest.parse().map_err(|e| Failure::invalid(format!("{e}")))
}

/// Reports the progress of an upload under a grant. A cut-off upload continues from `staged`; bytes that are already
/// stored need no upload.
pub(crate) async fn staged(
    State(actor_handle): State<Arc<ActorHandle>>,
    Path(digest): Path<String>,
    proof: Proof,
    headers: HeaderMap,
) -> Result<Json<BlobStored>, Failure> {
    let grant = granted(&actor_handle, &proof, &headers)?;
    let digest = named(&digest)?;
    let receipt = headers.get(RECEIPT_HEADER).and_then(|shown| shown.to_str().ok()).map(str::to_owned);
    let receipt = receipt.filter(|shown| actor_handle.secrets.is_receipt(&proof.caller.name, &grant, digest, shown));
    let roots = actor_handle.state().read_by(&grant.task)?;
    let reach = Arc::clone(&actor_handle.reach);
    let has_receipt = receipt.is_some();
    let asks_direct = headers.contains_key(DIRECT_HEADER);
    let store = &actor_handle.store;
    // The existence of other blobs is not revealed: the worker either has their bytes or has no use for them.
    let is_known = has_receipt || ask(store, move |blobs| reach.includes(blobs, &roots, digest)).await?;
    if is_known {
        store.hold(&grant.task, digest).await?;
    }
    let looked = ask(store, move |blobs| -> Result<_, Failure> {
        let stored = is_known && blobs.reuse(digest)?;
        let receipt = receipt.filter(|_| stored);
        let staged = blobs.staged(&grant, digest)?;
        let direct = if asks_direct && !stored && staged == 0 { blobs.sign_write(&grant, digest) } else { None };
        Ok(Json(BlobStored { digest, stored, staged, receipt, direct }))
    });
    looked.await
}

/// Stores a blob that a worker has sent by a signed request, and returns its receipt. The place of the blobs attests the
/// bytes; the worker's word decides nothing.
pub(crate) async fn sent(
    State(actor_handle): State<Arc<ActorHandle>>,
    Path(digest): Path<String>,
    proof: Proof,
    headers: HeaderMap,
) -> Result<Json<BlobStored>, Failure> {
    let grant = granted(&actor_handle, &proof, &headers)?;
    let digest = named(&digest)?;
    let store = &actor_handle.store;
    let receipt = actor_handle.secrets.receipt(&proof.caller.name, &grant, digest);
    let asked = grant.clone();
    let stored = ask(store, move |blobs| Ok::<_, BlobError>(blobs.has_arrived(&asked, digest))).await?;
    if stored {
        store.hold(&grant.task, digest).await?;
        ask(store, move |blobs| blobs.take_over(&grant, digest)).await?;
    }
    Ok(Json(BlobStored { digest, stored, staged: 0, receipt: stored.then_some(receipt), direct: None }))
}

/// Stores a blob, or the next part of one, while it arrives.
pub(crate) async fn put_blob(
    State(actor_handle): State<Arc<ActorHandle>>,
    Path(digest): Path<String>,
    proof: Proof,
    headers: HeaderMap,
    body: Body,
) -> Result<Json<BlobStored>, Failure> {
    let grant = granted(&actor_handle, &proof, &headers)?;
    let digest = named(&digest)?;
    let missing = || Failure::invalid(format!("header `{BYTES_HEADER}` with the blob's length is missing"));
    let bytes = match number(&headers, BYTES_HEADER)? {
        Some(bytes) => bytes,
        // The body is the whole blob.
        None => number(&headers, header::CONTENT_LENGTH.as_str())?.ok_or_else(missing)?,
    };
    let offset = number(&headers, OFFSET_HEADER)?.unwrap_or_default();
    if bytes > MAX_BLOB_BYTES {
        let message = format!("a blob of {bytes} bytes is too large: expected at most {MAX_BLOB_BYTES}");
        let failure = Failure::new(StatusCode::PAYLOAD_TOO_LARGE, "too-large", message);
        return Err(failure.hint("update the worker: this build stores a longer file as several blobs"));
    }
    let store = &actor_handle.store;
    let receipt = actor_handle.secrets.receipt(&proof.caller.name, &grant, digest);
    let stored = async {
        let task = grant.task.clone();
        let arriving = ask(store, move |blobs| blobs.take_up(&grant, digest, offset, bytes)).await?;
        let arriving = receive(store, arriving, body).await?;
        let staged = arriving.written();
        actor_handle.meters.carried("in", bytes, staged.saturating_sub(offset));
        if arriving.is_complete() {
            store.hold(&task, digest).await.map_err(unheld)?;
        }
        let stored = ask(store, move |_| arriving.finish()).await.map_err(ResumeError::Blob)?;
        Ok(Json(BlobStored { digest, stored, staged, receipt: stored.then_some(receipt), direct: None }))
    };
    stored.await.map_err(|error: Unstored| {
        if let Unstored::Resume(ResumeError::Blob(BlobError::Storage(message))) = &error {
            actor_handle.wrote::<()>(&Err(WriteError::Storage(message.clone())));
        }
        error.into()
    })
}

/// The error of an upload that could not be recorded. Its bytes stay for the worker's next request.
fn unheld(error: WriteError) -> ResumeError {
    ResumeError::Blob(match error {
        WriteError::Storage(message) => BlobError::Storage(message),
        error => BlobError::Unavailable(error.to_string()),
    })
}

/// Appends a body to an upload.
async fn receive(store: &Store, mut arriving: Arriving, body: Body) -> Result<Arriving, Unstored> {
    let mut body = body.into_data_stream();
    let mut ended = false;
    while !ended {
        // A slow sender occupies no thread, and no more memory than one part.
        let mut parts = Vec::new();
        let mut length = 0;
        while length < PART_BYTES {
            match tokio::time::timeout(BODY_IDLE, body.next()).await {
                Ok(Some(Ok(part))) => {
                    length += part.len();
                    parts.push(part);
                }
                Ok(Some(Err(error))) => return Err(Unstored::Cut(error.to_string())),
                Ok(None) => {
                    ended = true;
                    break;
                }
                Err(_) => return Err(Unstored::Cut(format!("no data arrived for {} s", BODY_IDLE.as_secs()))),
            }
        }
        // If the request is dropped, `arriving` is dropped too, which keeps the bytes received.
        arriving = ask(store, move |_| -> Result<Arriving, BlobError> {
            for part in parts {
                arriving.write(&part)?;
            }
            Ok(arriving)
        })
        .await
        .map_err(ResumeError::Blob)?;
    }
    Ok(arriving)
}

/// The reason why a blob was not stored.
enum Unstored {
    /// The body ended early.
    Cut(String),
    /// The store refused it.
    Resume(ResumeError),
}

impl From<ResumeError> for Unstored {
    fn from(error: ResumeError) -> Self {
        Self::Resume(error)
    }
}

impl From<Unstored> for Failure {
    fn from(error: Unstored) -> Self {
        let message = match &error {
            Unstored::Cut(message) => format!("the blob was cut off: {message}"),
            Unstored::Resume(error) => error.to_string(),
        };
        match error {
            Unstored::Cut(_) => Self::new(StatusCode::REQUEST_TIMEOUT, "cut", message),
            Unstored::Resume(ResumeError::Offset { .. }) => {
                Self::new(StatusCode::RANGE_NOT_SATISFIABLE, "offset", message)
            }
            Unstored::Resume(ResumeError::Busy | ResumeError::TooMany(_)) => Self::busy(message),
            // The bytes were damaged in transit, which implies nothing about stored ones.
            Unstored::Resume(ResumeError::Blob(BlobError::Corrupt { .. } | BlobError::Refused(_))) => {
                Self::new(StatusCode::UNPROCESSABLE_ENTITY, "arrived-damaged", message)
            }
            Unstored::Resume(ResumeError::Blob(error)) => error.into(),
        }
    }
}

/// Sends a blob, or the rest of one from `range: bytes=N-`. The last bytes of a damaged blob are never sent; the answer
/// is aborted. A caller that follows a redirect reads from the place of the blobs, and verifies the bytes itself.
pub(crate) async fn get_blob(
    State(actor_handle): State<Arc<ActorHandle>>,
    Path(digest): Path<String>,
    proof: Proof,
    headers: HeaderMap,
) -> Result<Response, Failure> {
    let digest = named(&digest)?;
    let from = from(&headers)?;
    if !proof.caller.scopes.allow(Scope::Read) {
        check_read(&actor_handle, &proof, &headers, digest).await?;
    }
    if headers.contains_key(DIRECT_HEADER)
        && let Some(signed) = ask(&actor_handle.store, move |blobs| blobs.sign_read(digest)).await?
    {
        return redirect(signed);
    }
    let opened = ask(&actor_handle.store, move |blobs| -> Result<_, Failure> {
        let mut reader = match from {
            None => blobs.read(digest)?,
            Some(from) => {
                let bytes = blobs.verify(digest)?.bytes;
                if from > bytes {
                    return Err(past_the_end(digest, from, bytes));
                }
                blobs.read_from(digest, from)?
            }
        };
        // A small blob has been verified at this point.
        let first = reader.next_part()?;
        Ok((first, reader))
    });
    let (first, reader) = opened.await?;
    let bytes = reader.bytes();
    let length = bytes - from.unwrap_or_default();
    actor_handle.meters.carried("out", bytes, length);
    let rest = stream::try_unfold((reader, actor_handle.store.clone()), |(mut reader, store)| async {
        let (part, reader) = ask(&store, move |_| Ok::<_, BlobError>((reader.next_part()?, reader))).await?;
        Ok::<_, BlobError>(part.map(|part| (part, (reader, store))))
    });
    let body = Body::from_stream(stream::iter(first.map(Ok)).chain(rest));
    let mut response = Response::new(body);
    let headers = response.headers_mut();
    headers.insert(header::CONTENT_TYPE, HeaderValue::from_static("application/octet-stream"));
    headers.insert(header::CONTENT_LENGTH, HeaderValue::from(length));
    if let Some(from) = from {
        let range = format!("bytes {from}-{}/{bytes}", bytes.saturating_sub(1));
        if let Ok(range) = HeaderValue::try_from(range) {
            headers.insert(header::CONTENT_RANGE, range);
        }
        *response.status_mut() = StatusCode::PARTIAL_CONTENT;
    }
    Ok(response)
}

fn redirect(signed: SignedRequest) -> Result<Response, Failure> {
    let mut response = Response::new(Body::empty());
    *response.status_mut() = StatusCode::TEMPORARY_REDIRECT;
    let unfit = |_| Failure::invalid("the place of the blobs has an address that fits into no header".to_owned());
    response.headers_mut().insert(header::LOCATION, HeaderValue::try_from(signed.url).map_err(unfit)?);
    response.headers_mut().insert(header::CACHE_CONTROL, HeaderValue::from_static("no-store"));
    Ok(response)
}

/// Checks that a worker reads only blobs of its task's inputs, checkpoints and uploads, or of the tasks that it
/// prepares for.
async fn check_read(
    actor_handle: &ActorHandle,
    proof: &Proof,
    headers: &HeaderMap,
    digest: Digest,
) -> Result<(), Failure> {
    let process = secrets::process(headers)?;
    let state = actor_handle.state();
    // All errors look the same: a worker must not take them for information about the blob.
    proof
        .of_process(&state, &process)
        .map_err(|_| secrets::unproven("the call does not show the secret of its worker"))?;
    // A stage may read its own uploads, such as its last checkpoint.
    let task = state.held_by(&process.worker).map(|(_, task)| task.id.clone());
    if task.is_some_and(|task| actor_handle.store.blobs().has_stored(&task, digest)) {
        return Ok(());
    }
    let roots = state.readable_by(&process.worker);
    let reach = Arc::clone(&actor_handle.reach);
    if ask(&actor_handle.store, move |blobs| reach.includes(blobs, &roots, digest)).await? {
        return Ok(());
    }
    let message = format!("the tasks of worker `{}` do not read blob {digest}", process.worker);
    Err(Failure::new(StatusCode::FORBIDDEN, "forbidden", message))
}

fn past_the_end(digest: Digest, from: u64, bytes: u64) -> Failure {
    let message = format!("header `range`: blob {digest} has {bytes} bytes; byte {from} is past its end");
    Failure::new(StatusCode::RANGE_NOT_SATISFIABLE, "invalid", message)
}

/// The first byte of a continued download.
fn from(headers: &HeaderMap) -> Result<Option<u64>, Failure> {
    let Some(range) = headers.get(header::RANGE) else { return Ok(None) };
    let text = range.to_str().ok().and_then(|text| text.strip_prefix("bytes=")?.strip_suffix('-'));
    let from = text.and_then(|text| text.parse().ok());
    from.map(Some).ok_or_else(|| Failure::invalid("header `range`: expected `bytes=N-`".to_owned()))
}
