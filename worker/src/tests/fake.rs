//! A fake coordinator that can be made to misbehave.

use std::collections::{BTreeMap, BTreeSet, HashMap};
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use axum::Router;
use axum::body::Bytes;
use axum::extract::{DefaultBodyLimit, Json, Path, State};
use axum::http::{HeaderMap, Method, StatusCode};
use axum::response::{IntoResponse, Response};
use axum::routing::{any, get, post, put};
use protocol::message::{
    ApiError, Assignment, CommitCheckpoint, DesiredAssignments, Grant, Join, Joined, LogBatch, MetricBatch,
    PROTOCOL_VERSION, Poll, Prepare, ReportOutcome, TaskOutcome,
};
use protocol::proof::{DIRECT_HEADER, GRANT_HEADER, PROCESS_HEADER, SECRET_HEADER, SHORTEST_SECRET};
use protocol::{Digest, Incarnation};

use crate::event_count::lock;

/// Long enough that a poll does not time out on a busy machine.
pub(super) const LEASE_MS: u64 = 6000;

pub(super) type Metrics = BTreeMap<(u64, String), f64>;

const TOKEN: &str = "a-token-of-tests-only";

/// Options of a coordinator at `url` that requires [`TOKEN`].
pub(crate) fn server_at(url: &str) -> access::Server {
    let token = TOKEN.parse().expect("a token");
    access::Server::new(url, Some(token), None).expect("a server")
}

/// Everything that the coordinator has received, and its orders.
#[derive(Debug, Default)]
pub(super) struct FakeState {
    pub(super) assignments: Vec<Assignment>,
    pub(super) prepare: Vec<Prepare>,
    pub(super) version: u64,
    pub(super) leave: bool,
    pub(super) joins: u64,
    /// Does not know the worker until it joins again. The answer to a poll can be lost, so one such answer is not enough.
    pub(super) forget: bool,
    pub(super) polls: Vec<Instant>,
    pub(super) last_poll: Option<Poll>,
    pub(super) blobs: HashMap<Digest, Vec<u8>>,
    pub(super) staged: HashMap<Digest, Vec<u8>>,
    /// Blobs that signed requests have stored.
    pub(super) arrived: HashMap<Digest, Vec<u8>>,
    pub(super) metrics: Metrics,
    /// Places of values that are not finite.
    pub(super) odd: BTreeSet<(u64, String)>,
    pub(super) logs: BTreeMap<u64, String>,
    pub(super) checkpoints: Vec<CommitCheckpoint>,
    /// Steps that were committed before their values or their manifest had arrived.
    pub(super) early: Vec<u64>,
    pub(super) outcomes: Vec<ReportOutcome>,
    /// The store's fence; writes with another one are refused.
    pub(super) fence: u64,
    pub(super) calls: u64,
    /// Blobs that were requested.
    pub(super) fetched: Vec<Digest>,
    /// Refuses outcomes with an artifact.
    pub(super) refuses: bool,
    /// Refuses all blobs as too large.
    pub(super) unfit: bool,
}

/// Time that a busy coordinator asks for, in seconds: longer than any of our pauses between two tries.
pub(super) const BUSY_S: u64 = 2;

#[derive(Debug, Default)]
pub(super) struct Fake {
    pub(super) coordinator: Mutex<FakeState>,
    /// Number of coming joins that find the name held by another process.
    pub(super) name_held: AtomicU64,
    /// Answers 503 to everything.
    pub(super) away: AtomicBool,
    /// Answers that the disk is full.
    pub(super) full: AtomicBool,
    /// Uploads of blobs wait until it is false.
    pub(super) slow: AtomicBool,
    /// Number of calls refused for a full disk.
    pub(super) turned_down: AtomicU64,
    /// Answers "busy" to the next batch of metrics, and records the time of the answer.
    pub(super) busy: AtomicBool,
    pub(super) refused_at: Mutex<Option<Instant>>,
    /// Time until the batch came again.
    pub(super) waited: Mutex<Option<Duration>>,
    /// Every third write is done but its answer is lost.
    pub(super) lossy: AtomicBool,
    /// Number of coming polls that are never answered.
    pub(super) hang: AtomicU64,
    /// Downloads never end.
    pub(super) stuck: AtomicBool,
    /// Number of coming downloads that arrive with a flipped bit.
    pub(super) damage: AtomicU64,
    /// Number of coming blob transfers that break off in the middle.
    pub(super) cut: AtomicU64,
    /// Number of transferred bytes after which the next part of a blob is cut and its staged bytes are lost.
    pub(super) lose_at: AtomicU64,
    /// All blobs are damaged in the store.
    pub(super) rotten: AtomicBool,
    /// Offers signed requests to its own place of blobs.
    pub(super) offers_place: AtomicBool,
    /// The place answers 403 to all requests.
    pub(super) place_refuses: AtomicBool,
    /// The place stores and sends a flipped bit.
    pub(super) place_damages: AtomicBool,
    /// Requests that the place has answered.
    pub(super) placed: AtomicU64,
    /// Bytes of transferred blobs, or the number of requests for damaged ones.
    pub(super) received: AtomicU64,
}

fn refuse(status: StatusCode, code: &str) -> Response {
    (status, Json(ApiError { code: code.to_owned(), message: format!("refused: {code}"), hint: None })).into_response()
}

impl Fake {
    /// The refusal of a full disk, if the disk is full.
    fn no_room(&self) -> Option<Response> {
        let full = self.full.load(Ordering::SeqCst);
        full.then(|| {
            self.turned_down.fetch_add(1, Ordering::SeqCst);
            refuse(StatusCode::INSUFFICIENT_STORAGE, "storage")
        })
    }

    /// The refusal of a busy coordinator, if it is busy.
    fn too_much(&self) -> Option<Response> {
        if let Some(refused_at) = lock(&self.refused_at).take() {
            *lock(&self.waited) = Some(refused_at.elapsed());
        }
        self.busy.swap(false, Ordering::SeqCst).then(|| {
            *lock(&self.refused_at) = Some(Instant::now());
            ([("retry-after", BUSY_S.to_string())], refuse(StatusCode::TOO_MANY_REQUESTS, "busy")).into_response()
        })
    }

    /// Address of a blob at the place of the blobs, for a worker that asks for it.
    fn place(&self, digest: Digest, headers: &HeaderMap) -> Option<String> {
        let host = headers["host"].to_str().expect("a host");
        let asks = headers.contains_key(DIRECT_HEADER) && self.offers_place.load(Ordering::SeqCst);
        asks.then(|| format!("http://{host}/place/{digest}"))
    }

    pub(super) fn desired(&self, change: impl FnOnce(&mut FakeState)) {
        let mut coordinator = lock(&self.coordinator);
        change(&mut coordinator);
        coordinator.version += 1;
    }

    /// Checks and does a write. The answer may be lost on purpose.
    fn write(&self, grant: &Grant, work: impl FnOnce(&mut FakeState)) -> Response {
        if self.away.load(Ordering::SeqCst) {
            return refuse(StatusCode::SERVICE_UNAVAILABLE, "internal");
        }
        if let Some(response) = self.no_room() {
            return response;
        }
        let mut coordinator = lock(&self.coordinator);
        if grant.fence.0 != coordinator.fence {
            return refuse(StatusCode::CONFLICT, "stale-fence");
        }
        work(&mut coordinator);
        coordinator.calls += 1;
        if self.lossy.load(Ordering::SeqCst) && coordinator.calls.is_multiple_of(3) {
            return refuse(StatusCode::BAD_GATEWAY, "internal");
        }
        Json(()).into_response()
    }
}

async fn join(State(fake): State<Arc<Fake>>, headers: HeaderMap, Json(join): Json<Join>) -> Response {
    assert_eq!(join.protocol, PROTOCOL_VERSION);
    assert!(headers[SECRET_HEADER].len() >= SHORTEST_SECRET);
    if fake.name_held.fetch_update(Ordering::SeqCst, Ordering::SeqCst, |n| n.checked_sub(1)).is_ok() {
        return refuse(StatusCode::CONFLICT, "name-held");
    }
    if let Some(response) = fake.no_room() {
        return response;
    }
    let mut coordinator = lock(&fake.coordinator);
    coordinator.joins += 1;
    coordinator.forget = false;
    Json(Joined { incarnation: Incarnation(coordinator.joins), lease_ms: LEASE_MS, poll_ms: 100 }).into_response()
}

async fn poll(State(fake): State<Arc<Fake>>, Path(worker): Path<String>, Json(poll): Json<Poll>) -> Response {
    assert_eq!(worker, "w0");
    if fake.away.load(Ordering::SeqCst) {
        return refuse(StatusCode::SERVICE_UNAVAILABLE, "internal");
    }
    let version = poll.version;
    {
        let mut coordinator = lock(&fake.coordinator);
        if coordinator.forget {
            return refuse(StatusCode::NOT_FOUND, "not-found");
        }
        coordinator.polls.push(Instant::now());
        coordinator.last_poll = Some(poll);
    }
    if fake.hang.fetch_update(Ordering::SeqCst, Ordering::SeqCst, |n| n.checked_sub(1)).is_ok() {
        std::future::pending::<()>().await;
    }
    for _ in 0..20 {
        if lock(&fake.coordinator).version != version {
            break;
        }
        tokio::time::sleep(Duration::from_millis(5)).await;
    }
    let coordinator = lock(&fake.coordinator);
    Json(DesiredAssignments {
        version: coordinator.version,
        assignments: coordinator.assignments.clone(),
        prepare: coordinator.prepare.clone(),
        leave: coordinator.leave,
    })
    .into_response()
}

async fn metrics(State(fake): State<Arc<Fake>>, Json(batch): Json<MetricBatch>) -> Response {
    if let Some(response) = fake.too_much() {
        return response;
    }
    fake.write(&batch.grant, |coordinator| {
        for row in batch.rows {
            if row.value.is_nan() {
                coordinator.odd.insert((row.step, row.key));
                continue;
            }
            let before = coordinator.metrics.insert((row.step, row.key.clone()), row.value);
            assert!(before.is_none_or(|v| v == row.value), "a row changed its value");
        }
    })
}

async fn logs(State(fake): State<Arc<Fake>>, Json(batch): Json<LogBatch>) -> Response {
    fake.write(&batch.grant, |coordinator| {
        for (i, line) in batch.lines.into_iter().enumerate() {
            coordinator.logs.insert(batch.first + i as u64, line);
        }
    })
}

async fn checkpoint(State(fake): State<Arc<Fake>>, Json(commit): Json<CommitCheckpoint>) -> Response {
    fake.write(&commit.grant.clone(), |coordinator| {
        // An assertion here would only break the connection, and the worker would try again.
        let is_recorded = |step| coordinator.metrics.contains_key(&(step, "loss".to_owned()));
        let recorded = (1..=commit.step).all(is_recorded);
        if !recorded || !coordinator.blobs.contains_key(&commit.manifest) {
            coordinator.early.push(commit.step);
        }
        coordinator.checkpoints.push(commit);
    })
}

async fn outcome(State(fake): State<Arc<Fake>>, Json(report): Json<ReportOutcome>) -> Response {
    if lock(&fake.coordinator).refuses && matches!(report.outcome, TaskOutcome::Finished { .. }) {
        return refuse(StatusCode::NOT_FOUND, "not-found");
    }
    fake.write(&report.grant.clone(), |coordinator| {
        if !coordinator.outcomes.contains(&report) {
            coordinator.assignments.retain(|a| a.grant.task != report.grant.task);
            coordinator.version += 1;
            coordinator.outcomes.push(report);
        }
    })
}

/// Stores the next part of a blob; keeps only half of a part that is to be cut.
async fn put_blob(
    State(fake): State<Arc<Fake>>,
    Path(digest): Path<Digest>,
    headers: HeaderMap,
    body: Bytes,
) -> Response {
    let grant: Grant = serde_json::from_slice(headers[GRANT_HEADER].as_bytes()).expect("a grant");
    assert_eq!(headers[SECRET_HEADER], format!("the-secret-of-fence-{}", grant.fence));
    assert_eq!(headers["authorization"], format!("Bearer {TOKEN}"));
    while fake.slow.load(Ordering::SeqCst) {
        tokio::time::sleep(Duration::from_millis(5)).await;
    }
    let number =
        |name: &str| headers[name].to_str().ok().and_then(|text| text.parse::<usize>().ok()).expect("a number");
    let offset = number("x-stride-offset");
    let bytes = number("x-stride-bytes");
    if lock(&fake.coordinator).unfit {
        return refuse(StatusCode::PAYLOAD_TOO_LARGE, "too-large");
    }
    let received = fake.received.fetch_add(body.len() as u64, Ordering::SeqCst);
    let is_lost = |at: u64| (at > 0 && received >= at).then_some(0);
    let lost = fake.lose_at.fetch_update(Ordering::SeqCst, Ordering::SeqCst, is_lost).is_ok();
    let cut = lost || fake.cut.fetch_update(Ordering::SeqCst, Ordering::SeqCst, |n| n.checked_sub(1)).is_ok();
    let mut answer = serde_json::Value::Null;
    let response = fake.write(&grant, |coordinator| {
        let staged = coordinator.staged.entry(digest).or_default();
        if offset == 0 {
            staged.clear();
        }
        assert_eq!(staged.len(), offset, "it goes on where it was cut");
        staged.extend_from_slice(if cut { &body[..body.len() / 2] } else { &body });
        if lost {
            staged.clear();
        }
        let (staged, stored) = (staged.len(), staged.len() == bytes);
        if stored {
            let blob = coordinator.staged.remove(&digest).expect("it has arrived");
            assert_eq!(Digest::of(&blob), digest);
            coordinator.blobs.insert(digest, blob);
        }
        answer = serde_json::json!({ "digest": digest, "stored": stored, "staged": staged });
    });
    match (response.status().is_success(), cut) {
        (true, true) => refuse(StatusCode::REQUEST_TIMEOUT, "cut"),
        (true, false) => Json(answer).into_response(),
        (false, _) => response,
    }
}

async fn staged(State(fake): State<Arc<Fake>>, Path(digest): Path<Digest>, headers: HeaderMap) -> Response {
    let coordinator = lock(&fake.coordinator);
    let stored = coordinator.blobs.contains_key(&digest);
    let staged = coordinator.staged.get(&digest).map_or(0, Vec::len);
    let mut answer = serde_json::json!({ "digest": digest, "stored": stored, "staged": staged });
    if let Some(url) = fake.place(digest, &headers).filter(|_| !stored && staged == 0) {
        answer["direct"] = serde_json::json!({ "url": url, "headers": { "x-signed": digest } });
    }
    Json(answer).into_response()
}

/// A signed request to the place of the blobs. It carries no token and no secret.
async fn place(
    State(fake): State<Arc<Fake>>,
    method: Method,
    Path(digest): Path<Digest>,
    headers: HeaderMap,
    body: Bytes,
) -> Response {
    assert!(!headers.contains_key("authorization") && !headers.contains_key(SECRET_HEADER), "{headers:?}");
    if fake.place_refuses.load(Ordering::SeqCst) {
        return StatusCode::FORBIDDEN.into_response();
    }
    fake.placed.fetch_add(1, Ordering::SeqCst);
    let damages = fake.place_damages.load(Ordering::SeqCst);
    let mut coordinator = lock(&fake.coordinator);
    if method == Method::PUT {
        assert_eq!(headers["x-signed"], digest.to_string());
        let mut bytes = body.to_vec();
        bytes[0] ^= u8::from(damages);
        coordinator.arrived.insert(digest, bytes);
        return StatusCode::OK.into_response();
    }
    let mut bytes = coordinator.blobs[&digest].clone();
    bytes[0] ^= u8::from(damages);
    bytes.into_response()
}

/// Takes over a blob from its place if its bytes are right.
async fn sent(State(fake): State<Arc<Fake>>, Path(digest): Path<Digest>) -> Response {
    let mut coordinator = lock(&fake.coordinator);
    let arrived = coordinator.arrived.remove(&digest).filter(|bytes| Digest::of(bytes) == digest);
    let stored = arrived.is_some();
    coordinator.blobs.extend(arrived.map(|bytes| (digest, bytes)));
    Json(serde_json::json!({ "digest": digest, "stored": stored, "staged": 0 })).into_response()
}

/// Sends a blob from byte N on. An answer that is to be cut breaks off in the middle.
async fn get_blob(State(fake): State<Arc<Fake>>, Path(digest): Path<Digest>, headers: HeaderMap) -> Response {
    assert!(headers.contains_key(PROCESS_HEADER) && headers.contains_key(SECRET_HEADER), "{headers:?}");
    if fake.away.load(Ordering::SeqCst) {
        return refuse(StatusCode::SERVICE_UNAVAILABLE, "internal");
    }
    if fake.rotten.load(Ordering::SeqCst) {
        fake.received.fetch_add(1, Ordering::SeqCst);
        return refuse(StatusCode::CONFLICT, "damaged");
    }
    if let Some(url) = fake.place(digest, &headers) {
        return (StatusCode::TEMPORARY_REDIRECT, [("location", url)]).into_response();
    }
    lock(&fake.coordinator).fetched.push(digest);
    if fake.stuck.load(Ordering::SeqCst) {
        std::future::pending::<()>().await;
    }
    let Some(mut bytes) = lock(&fake.coordinator).blobs.get(&digest).cloned() else {
        return refuse(StatusCode::NOT_FOUND, "not-found");
    };
    if fake.damage.fetch_update(Ordering::SeqCst, Ordering::SeqCst, |n| n.checked_sub(1)).is_ok() {
        bytes[0] ^= 1;
    }
    let range = headers.get("range").and_then(|range| range.to_str().ok()?.strip_prefix("bytes=")?.strip_suffix('-'));
    let from: Option<usize> = range.map(|from| from.parse().expect("a number"));
    let rest = bytes.split_off(from.unwrap_or_default());
    let status = if from.is_some() { StatusCode::PARTIAL_CONTENT } else { StatusCode::OK };
    let length = rest.len();
    fake.received.fetch_add(length as u64, Ordering::SeqCst);
    let cut = fake.cut.fetch_update(Ordering::SeqCst, Ordering::SeqCst, |n| n.checked_sub(1)).is_ok();
    let body = if cut {
        let half = Bytes::from(rest).slice(..length / 2);
        let broken = std::io::Error::other("cut");
        axum::body::Body::from_stream(futures::stream::iter([Ok(half), Err(broken)]))
    } else {
        rest.into()
    };
    (status, [("content-length", length.to_string())], body).into_response()
}

/// Routes of the fake.
pub(super) fn router(fake: Arc<Fake>) -> Router {
    Router::new()
        .route("/v1/workers", post(join))
        .route("/v1/workers/{worker}/poll", post(poll))
        .route("/v1/metrics", post(metrics))
        .route("/v1/logs", post(logs))
        .route("/v1/checkpoints", post(checkpoint))
        .route("/v1/outcomes", post(outcome))
        .route("/v1/blobs/{digest}", put(put_blob).get(get_blob))
        .route("/v1/blobs/{digest}/staged", get(staged))
        .route("/v1/blobs/{digest}/sent", post(sent))
        .route("/place/{digest}", any(place))
        .layer(DefaultBodyLimit::disable())
        .with_state(fake)
}
