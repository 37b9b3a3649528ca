//! A worker against a coordinator of a few lines that can be told to misbehave.

use std::collections::{BTreeMap, HashMap};
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::{Arc, Mutex};
use std::thread::{self, JoinHandle};
use std::time::{Duration, Instant};

use axum::Router;
use axum::body::Bytes;
use axum::extract::{DefaultBodyLimit, Json, Path, State};
use axum::http::StatusCode;
use axum::response::{IntoResponse, Response};
use axum::routing::{get, post, put};
use burn::tensor::Device;
use checkpoint::BlobError;
use protocol::message::{
    ApiError, Assignment, CommitCheckpoint, DesiredAssignments, FailureClass, Grant, Join, Joined, LogBatch, Member,
    MetricBatch, PROTOCOL_VERSION, Poll, Prepare, ReportOutcome, Role, StageTask, TaskOutcome,
};
use protocol::stage::{Backend, CheckpointPolicy, DataSynthetic, StageSettings};
use protocol::{
    ArtifactKind, Attempt, Digest, Fence, Generation, Incarnation, Manifest, RunId, Seed, StageName, TaskId, WorkerId,
};
use stages::context::{AttemptContext, ContextError, Exchange, GangContext, Outcome, Part, StageError};
use tokio::runtime::Runtime;

use crate::assignments::{self, End, Shared};
use crate::cache::{Bounds, Cache};
use crate::client::Client;
use crate::event_count::lock;
use crate::gang::endpoint::Endpoint;
use crate::gang::member::Timing;
use crate::stage_thread::{self, Bench, Kinds};

/// Long enough that no poll of a busy machine is given up in vain.
const LEASE_MS: u64 = 6000;

type Metrics = BTreeMap<(u64, String), f64>;

const TOKEN: &str = "a-token-of-tests-only";

/// A coordinator at `url`, who wants [`TOKEN`].
pub(crate) fn server_at(url: &str) -> access::Server {
    let token = TOKEN.parse().expect("a token");
    access::Server::new(url, Some(token), None).expect("a server")
}

#[derive(Debug, Default)]
struct ActorHandle {
    assignments: Vec<Assignment>,
    prepare: Vec<Prepare>,
    version: u64,
    leave: bool,
    joins: u64,
    forget: bool,
    polls: Vec<Instant>,
    last_poll: Option<Poll>,
    blobs: HashMap<Digest, Vec<u8>>,
    staged: HashMap<Digest, Vec<u8>>,
    metrics: Metrics,
    logs: BTreeMap<u64, String>,
    checkpoints: Vec<CommitCheckpoint>,
    outcomes: Vec<ReportOutcome>,
    /// The fence that the store has; writes with another are refused.
    fence: u64,
    calls: u64,
    /// Blobs that were asked for.
    fetched: Vec<Digest>,
    /// Ends with an artifact are refused.
    refuses: bool,
}

/// For how long a coordinator that has too much to do wants to be left alone: longer than any pause of ours between two tries.
const BUSY_S: u64 = 2;

/// The coordinator.
#[derive(Debug, Default)]
struct Fake {
    coordinator: Mutex<ActorHandle>,
    /// Answers 503 to everything.
    away: AtomicBool,
    /// Its disk is full: nothing can be stored.
    full: AtomicBool,
    /// How often it said so.
    turned_down: AtomicU64,
    /// Tells the next batch of values to come again, and when it did.
    busy: AtomicBool,
    told: Mutex<Option<Instant>>,
    /// How much later it came.
    waited: Mutex<Option<Duration>>,
    /// Every third write is done, and then its answer is lost.
    lossy: AtomicBool,
    /// The next so many polls are never answered.
    hang: AtomicU64,
    /// Downloads never end.
    stuck: AtomicBool,
    /// The next so many downloads arrive with a flipped bit.
    damage: AtomicU64,
    /// The next so many transfers of blobs break off in their middle.
    cut: AtomicU64,
    /// All blobs are damaged in the store.
    rotten: AtomicBool,
    /// Bytes of blobs that were transferred, or calls for damaged ones.
    received: AtomicU64,
}

fn refuse(status: StatusCode, code: &str) -> Response {
    (status, Json(ApiError { code: code.to_owned(), message: format!("refused: {code}"), hint: None })).into_response()
}

impl Fake {
    /// The answer of a full disk, if it is full.
    fn no_room(&self) -> Option<Response> {
        let full = self.full.load(Ordering::SeqCst);
        full.then(|| {
            self.turned_down.fetch_add(1, Ordering::SeqCst);
            refuse(StatusCode::INSUFFICIENT_STORAGE, "storage")
        })
    }

    /// The answer of one that has too much to do, if it has.
    fn too_much(&self) -> Option<Response> {
        if let Some(told) = lock(&self.told).take() {
            *lock(&self.waited) = Some(told.elapsed());
        }
        self.busy.swap(false, Ordering::SeqCst).then(|| {
            *lock(&self.told) = Some(Instant::now());
            ([("retry-after", BUSY_S.to_string())], refuse(StatusCode::TOO_MANY_REQUESTS, "busy")).into_response()
        })
    }

    fn desired(&self, change: impl FnOnce(&mut ActorHandle)) {
        let mut coordinator = lock(&self.coordinator);
        change(&mut coordinator);
        coordinator.version += 1;
    }

    /// A write: checked, done, and answered unless the answer is to be lost.
    fn write(&self, grant: &Grant, work: impl FnOnce(&mut ActorHandle)) -> Response {
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

async fn join(State(fake): State<Arc<Fake>>, Json(join): Json<Join>) -> Response {
    assert_eq!(join.protocol, PROTOCOL_VERSION);
    if let Some(response) = fake.no_room() {
        return response;
    }
    let mut coordinator = lock(&fake.coordinator);
    coordinator.joins += 1;
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
        if std::mem::take(&mut coordinator.forget) {
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
        assert!(coordinator.blobs.contains_key(&commit.manifest), "a manifest is uploaded before it is committed");
        // What was recorded up to here must have arrived before.
        assert!(
            (1..=commit.step).all(|s| coordinator.metrics.contains_key(&(s, "loss".to_owned()))),
            "{:?}",
            coordinator.metrics
        );
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

/// Takes the next part of a blob. Of a part that is to be cut it keeps half.
async fn put_blob(
    State(fake): State<Arc<Fake>>,
    Path(digest): Path<Digest>,
    headers: axum::http::HeaderMap,
    body: Bytes,
) -> Response {
    let grant: Grant = serde_json::from_slice(headers["x-stride-grant"].as_bytes()).expect("a grant");
    assert_eq!(headers["authorization"], format!("Bearer {TOKEN}"));
    let number =
        |name: &str| headers[name].to_str().ok().and_then(|text| text.parse::<usize>().ok()).expect("a number");
    let (offset, bytes) = (number("x-stride-offset"), number("x-stride-bytes"));
    fake.received.fetch_add(body.len() as u64, Ordering::SeqCst);
    let cut = fake.cut.fetch_update(Ordering::SeqCst, Ordering::SeqCst, |n| n.checked_sub(1)).is_ok();
    let mut answer = serde_json::Value::Null;
    let response = fake.write(&grant, |coordinator| {
        let staged = coordinator.staged.entry(digest).or_default();
        if offset == 0 {
            staged.clear();
        }
        assert_eq!(staged.len(), offset, "it goes on where it was cut");
        staged.extend_from_slice(if cut { &body[..body.len() / 2] } else { &body });
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

async fn staged(State(fake): State<Arc<Fake>>, Path(digest): Path<Digest>) -> Response {
    let coordinator = lock(&fake.coordinator);
    let stored = coordinator.blobs.contains_key(&digest);
    let staged = coordinator.staged.get(&digest).map_or(0, Vec::len);
    Json(serde_json::json!({ "digest": digest, "stored": stored, "staged": staged })).into_response()
}

/// Sends a blob, or what follows byte N of it. An answer that is to be cut breaks off in its middle.
async fn get_blob(
    State(fake): State<Arc<Fake>>,
    Path(digest): Path<Digest>,
    headers: axum::http::HeaderMap,
) -> Response {
    if fake.away.load(Ordering::SeqCst) {
        return refuse(StatusCode::SERVICE_UNAVAILABLE, "internal");
    }
    if fake.rotten.load(Ordering::SeqCst) {
        fake.received.fetch_add(1, Ordering::SeqCst);
        return refuse(StatusCode::CONFLICT, "damaged");
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

/// A stage of a test.
type Script = Box<dyn Fn(&mut dyn GangContext) -> Result<Outcome, StageError> + Send + Sync>;

struct Scripted(Script);

impl Kinds for Scripted {
    fn alone(&self, _context: &mut dyn AttemptContext) -> Result<Outcome, StageError> {
        panic!("these tests run gangs of one, which may ask for everything")
    }

    fn part(&self, _context: &mut dyn AttemptContext, _part: Part) -> Result<Outcome, StageError> {
        panic!("these tests run gangs of one, which may ask for everything")
    }

    fn gang(&self, context: &mut dyn GangContext) -> Result<Outcome, StageError> {
        (self.0)(context)
    }
}

/// A worker on threads of this process.
struct Worker {
    fake: Arc<Fake>,
    shared: Arc<Shared>,
    member: Member,
    stage: JoinHandle<()>,
    poll: JoinHandle<End>,
    preparer: JoinHandle<()>,
    _server: Runtime,
}

impl Worker {
    fn start(script: Script) -> Self {
        let fake: Arc<Fake> = Arc::default();
        let server = tokio::runtime::Builder::new_multi_thread().worker_threads(2).enable_all().build();
        let server = server.expect("a runtime");
        let router = Router::new()
            .route("/v1/workers", post(join))
            .route("/v1/workers/{worker}/poll", post(poll))
            .route("/v1/metrics", post(metrics))
            .route("/v1/logs", post(logs))
            .route("/v1/checkpoints", post(checkpoint))
            .route("/v1/outcomes", post(outcome))
            .route("/v1/blobs/{digest}", put(put_blob).get(get_blob))
            .route("/v1/blobs/{digest}/staged", get(staged))
            .layer(DefaultBodyLimit::disable())
            .with_state(fake.clone());
        let listener = server.block_on(tokio::net::TcpListener::bind("127.0.0.1:0")).expect("loopback");
        let url = format!("http://{}", listener.local_addr().expect("bound"));
        server.spawn(async move { axum::serve(listener, router).await });

        let client = Client::new(server_at(&url), server.handle().clone());
        let endpoint = Endpoint::open(([127, 0, 0, 1], 0).into(), Timing::default()).expect("loopback");
        let peer_address = endpoint.address().to_string();
        let member = Member { worker: "w0".into(), incarnation: Incarnation(1), peer_address: peer_address.clone() };
        let shared = Shared::new(endpoint);
        let cache = Arc::new(Cache::new(None, None, Bounds::default()).expect("memory"));
        let preparer = {
            let (shared, client, cache) = (shared.clone(), client.clone(), cache.clone());
            thread::spawn(move || shared.preparation.run(&client, &cache))
        };
        let bench =
            Bench { kinds: Arc::new(Scripted(script)), client: client.clone(), cache, device: Device::default() };
        let stage = {
            let shared = shared.clone();
            thread::spawn(move || stage_thread::run(&shared, &bench))
        };
        let offer = Join {
            protocol: PROTOCOL_VERSION,
            worker: "w0".into(),
            pid: 1,
            backend: Backend::Flex,
            instruction_set: "avx2".into(),
            peer_address,
        };
        let poll = {
            let (shared, handle) = (shared.clone(), server.handle().clone());
            thread::spawn(move || {
                let end = handle.block_on(assignments::follow(&client, &offer, &shared));
                shared.end("the worker leaves");
                end
            })
        };
        Self { fake, shared, member, stage, poll, preparer, _server: server }
    }

    /// Grants the task anew under the next fence.
    fn grant(&self, attempt: u64) {
        let member = self.member.clone();
        self.fake.desired(|coordinator| {
            coordinator.fence += 1;
            coordinator.assignments = vec![assignment(&member, attempt, coordinator.fence)];
        });
    }

    fn wait(&self, what: &str, mut holds: impl FnMut(&ActorHandle) -> bool) {
        let begun = Instant::now();
        while !holds(&lock(&self.fake.coordinator)) {
            assert!(begun.elapsed() < Duration::from_secs(30), "{what}: {:?}", lock(&self.fake.coordinator));
            thread::sleep(Duration::from_millis(5));
        }
    }

    /// Lets the worker go and returns all that the coordinator was told.
    fn leave(self) -> ActorHandle {
        self.fake.desired(|coordinator| coordinator.leave = true);
        assert_eq!(self.poll.join().expect("no panic"), End::Left);
        self.stage.join().expect("no panic");
        self.preparer.join().expect("no panic");
        std::mem::take(&mut *lock(&self.fake.coordinator))
    }
}

fn assignment(member: &Member, attempt: u64, fence: u64) -> Assignment {
    Assignment {
        grant: Grant {
            task: TaskId::from("run/stage"),
            attempt: Attempt(attempt),
            fence: Fence(fence),
            worker: WorkerId::from("w0"),
            incarnation: Incarnation(1),
        },
        stage: StageTask {
            run: RunId::from("run"),
            name: StageName::from("stage"),
            settings: StageSettings::DataSynthetic(DataSynthetic::default()),
            inputs: BTreeMap::new(),
            seed: Seed(1),
            checkpoint: CheckpointPolicy::default(),
        },
        role: Role::Member {
            generation: Generation(fence),
            members: vec![member.clone()],
            secret: "secret".to_owned(),
        },
        resume: None,
        drain: false,
    }
}

fn finished(context: &mut dyn GangContext) -> Result<Outcome, StageError> {
    let output = context.put_manifest(&Manifest::new(ArtifactKind::Report, serde_json::json!({"done": true})))?;
    Ok(Outcome::Finished { output, metrics: BTreeMap::from([("loss".to_owned(), 0.5)]) })
}

/// Trains `steps` steps as a gang of the workers that there are; a checkpoint every tenth.
fn train(context: &mut dyn GangContext, steps: u64, pause: Duration) -> Result<Outcome, StageError> {
    context.rendezvous(None, &[])?;
    let mut step = 0;
    while step < steps {
        let parts: Vec<_> = context.share(2).map(|slice| (slice, vec![1.0])).collect();
        match context.exchange(step, 2, &parts)? {
            Exchange::Regroup => {
                context.rendezvous(Some(step), &[])?;
            }
            Exchange::Sum { drain, .. } => {
                step += 1;
                context.record(step, &[("loss", 1.0 / step as f64), ("bad", f64::NAN)]);
                context.progress(step, steps, "steps", &[]);
                if step.is_multiple_of(10) || drain {
                    context.log(&format!("saving at {step}"));
                    let blob = context.blobs().put(step.to_le_bytes().to_vec()).expect("stored");
                    let manifest = Manifest::new(ArtifactKind::Checkpoint, serde_json::json!({"blob": blob}));
                    context.put_manifest(&manifest)?;
                    context.commit_checkpoint(step, &manifest, &BTreeMap::new())?;
                }
                if drain {
                    return Ok(Outcome::Yielded { at: step });
                }
                thread::sleep(pause);
            }
        }
    }
    finished(context)
}

/// Sampled: one stage of three saves; every third write is done and its answer lost.
#[test]
fn p9_everything_arrives_once_though_answers_are_lost() {
    let worker = Worker::start(Box::new(|context| train(context, 100, Duration::ZERO)));
    worker.fake.lossy.store(true, Ordering::SeqCst);
    worker.grant(1);
    worker.wait("an outcome", |coordinator| !coordinator.outcomes.is_empty());
    let coordinator = worker.leave();
    let steps: Vec<u64> = coordinator.metrics.keys().filter(|(_, key)| key == "loss").map(|(step, _)| *step).collect();
    assert_eq!(steps, (1..=100).collect::<Vec<_>>());
    assert_eq!(coordinator.metrics.len(), 100, "what is not a number is left out");
    assert_eq!(
        coordinator.logs.values().cloned().collect::<Vec<_>>(),
        (1..=10).map(|i| format!("saving at {}", i * 10)).collect::<Vec<_>>()
    );
    assert!(matches!(coordinator.outcomes[..], [ReportOutcome { outcome: TaskOutcome::Finished { .. }, .. }]));
    assert_eq!(coordinator.joins, 1);
}

#[test]
fn a_coordinator_that_goes_away_and_forgets_is_waited_for() {
    let worker = Worker::start(Box::new(|context| train(context, 200, Duration::from_millis(5))));
    worker.grant(1);
    worker.wait("some steps", |coordinator| coordinator.metrics.len() > 10);
    worker.fake.away.store(true, Ordering::SeqCst);
    thread::sleep(Duration::from_millis(2500));
    worker.fake.away.store(false, Ordering::SeqCst);
    worker.wait("an outcome", |coordinator| !coordinator.outcomes.is_empty());
    lock(&worker.fake.coordinator).forget = true;
    worker.wait("a second join", |coordinator| coordinator.joins == 2);
    let coordinator = worker.leave();
    assert_eq!(coordinator.metrics.len(), 200);
    assert!(matches!(coordinator.outcomes[..], [ReportOutcome { outcome: TaskOutcome::Finished { .. }, .. }]));
}

#[test]
fn a_coordinator_whose_disk_is_full_is_waited_for() {
    let worker = Worker::start(Box::new(|context| train(context, 200, Duration::from_millis(5))));
    worker.grant(1);
    worker.wait("some steps", |coordinator| coordinator.metrics.len() > 10);
    worker.fake.full.store(true, Ordering::SeqCst);
    worker.wait("refusals", |_| worker.fake.turned_down.load(Ordering::SeqCst) >= 3);
    worker.fake.full.store(false, Ordering::SeqCst);
    worker.wait("an outcome", |coordinator| !coordinator.outcomes.is_empty());
    let before = worker.fake.turned_down.load(Ordering::SeqCst);
    worker.fake.full.store(true, Ordering::SeqCst);
    lock(&worker.fake.coordinator).forget = true;
    worker.wait("joins that are refused", |coordinator| {
        !coordinator.forget && worker.fake.turned_down.load(Ordering::SeqCst) >= before + 3
    });
    worker.fake.full.store(false, Ordering::SeqCst);
    worker.wait("a second join", |coordinator| coordinator.joins == 2);
    let coordinator = worker.leave();
    assert_eq!(coordinator.metrics.len(), 200, "no row was lost");
    assert!(matches!(coordinator.outcomes[..], [ReportOutcome { outcome: TaskOutcome::Finished { .. }, .. }]));
}

#[test]
fn a_coordinator_that_has_too_much_to_do_is_left_alone_for_as_long_as_it_says() {
    let worker = Worker::start(Box::new(|context| train(context, 1000, Duration::from_millis(5))));
    worker.grant(1);
    worker.wait("some steps", |coordinator| coordinator.metrics.len() > 10);
    worker.fake.busy.store(true, Ordering::SeqCst);
    worker.wait("another try", |_| lock(&worker.fake.waited).is_some());
    let waited = lock(&worker.fake.waited).expect("waited");
    assert!(waited >= Duration::from_secs(BUSY_S), "came again after {waited:?}");
    worker.wait("an outcome", |coordinator| !coordinator.outcomes.is_empty());
    assert_eq!(worker.leave().metrics.len(), 1000, "no row was lost");
}

#[test]
fn work_that_is_taken_back_is_dropped_without_a_word() {
    let worker = Worker::start(Box::new(|context| train(context, u64::MAX, Duration::from_millis(1))));
    worker.grant(1);
    worker.wait("some steps", |coordinator| coordinator.metrics.len() > 3);
    worker.fake.desired(|coordinator| coordinator.assignments.clear());
    worker.wait("nothing is done", |coordinator| {
        coordinator.last_poll.as_ref().is_some_and(|poll| poll.doing.is_empty())
    });
    let coordinator = worker.leave();
    assert_eq!(coordinator.outcomes, []);
}

#[test]
fn a_newer_generation_is_taken_on_by_the_same_attempt() {
    let starts = Arc::new(AtomicU64::new(0));
    let counted = starts.clone();
    let worker = Worker::start(Box::new(move |context| {
        counted.fetch_add(1, Ordering::SeqCst);
        train(context, 150, Duration::from_millis(5))
    }));
    worker.grant(1);
    worker.wait("some steps", |coordinator| coordinator.metrics.len() > 3);
    // The fence moves first: writes under the old one are refused until the next orders say why.
    worker.grant(1);
    worker.wait("an outcome", |coordinator| !coordinator.outcomes.is_empty());
    let coordinator = worker.leave();
    assert_eq!(starts.load(Ordering::SeqCst), 1);
    assert_eq!(coordinator.outcomes[0].grant.fence, Fence(2));
    assert_eq!(coordinator.metrics.len(), 150);
}

#[test]
fn another_attempt_begins_anew() {
    let starts = Arc::new(AtomicU64::new(0));
    let counted = starts.clone();
    let worker = Worker::start(Box::new(move |context| {
        let first = counted.fetch_add(1, Ordering::SeqCst) == 0;
        train(context, if first { u64::MAX } else { 5 }, Duration::from_millis(1))
    }));
    worker.grant(1);
    worker.wait("some steps", |coordinator| coordinator.metrics.len() > 3);
    worker.grant(2);
    worker.wait("an outcome", |coordinator| !coordinator.outcomes.is_empty());
    let coordinator = worker.leave();
    assert_eq!(starts.load(Ordering::SeqCst), 2);
    assert_eq!((coordinator.outcomes.len(), coordinator.outcomes[0].grant.attempt), (1, Attempt(2)));
}

#[test]
fn a_write_under_an_old_fence_ends_the_attempt_once_orders_say_so() {
    let worker = Worker::start(Box::new(|context| train(context, u64::MAX, Duration::from_millis(1))));
    worker.grant(1);
    worker.wait("some steps", |coordinator| coordinator.metrics.len() > 3);
    // Somebody else holds the task now: the store knows, this worker does not yet.
    lock(&worker.fake.coordinator).fence = 9;
    thread::sleep(Duration::from_millis(700));
    let stored = lock(&worker.fake.coordinator).metrics.len();
    worker.fake.desired(|coordinator| coordinator.assignments.clear());
    let coordinator = worker.leave();
    assert_eq!(coordinator.metrics.len(), stored, "nothing is written under an old fence");
    assert_eq!(coordinator.outcomes, []);
}

#[test]
fn a_panic_is_a_fault_with_its_place() {
    stage_thread::log_panics();
    let worker = Worker::start(Box::new(|context| {
        context.log("about to fail");
        panic!("the tensor {} is upside down", 3)
    }));
    worker.grant(1);
    worker.wait("an outcome", |coordinator| !coordinator.outcomes.is_empty());
    let coordinator = worker.leave();
    let TaskOutcome::Failed { class, message } = &coordinator.outcomes[0].outcome else {
        panic!("{:?}", coordinator.outcomes)
    };
    assert_eq!(*class, FailureClass::Fault);
    assert!(message.contains("tests.rs") && message.ends_with("the tensor 3 is upside down"), "{message}");
    assert_eq!(coordinator.logs.values().collect::<Vec<_>>(), ["about to fail"]);
}

#[test]
fn leaving_saves_and_yields() {
    let worker = Worker::start(Box::new(|context| train(context, u64::MAX, Duration::from_millis(1))));
    worker.grant(1);
    worker.wait("some steps", |coordinator| coordinator.metrics.len() > 3);
    worker.shared.leave();
    let (poll, stage, fake) = (worker.poll, worker.stage, worker.fake);
    assert_eq!(poll.join().expect("no panic"), End::Left);
    stage.join().expect("no panic");
    let coordinator = lock(&fake.coordinator);
    let TaskOutcome::Yielded { at } = coordinator.outcomes[0].outcome else { panic!("{:?}", coordinator.outcomes) };
    assert_eq!(coordinator.checkpoints.last().map(|c| c.step), Some(at));
}

#[test]
fn blobs_are_verified() {
    let (good, absent) = (Digest::of(b"good"), Digest::of(b"absent"));
    let worker = Worker::start(Box::new(move |context| {
        let blobs = context.blobs();
        assert_eq!(&*blobs.get(good).expect("a damaged download is repeated"), b"good");
        assert!(matches!(blobs.get(absent), Err(BlobError::NotFound(d)) if d == absent));
        assert!(matches!(context.manifest(good), Err(ContextError::Corrupt(_))), "not a manifest");
        finished(context)
    }));
    lock(&worker.fake.coordinator).blobs.insert(good, b"good".to_vec());
    worker.fake.damage.store(2, Ordering::SeqCst);
    worker.grant(1);
    worker.wait("an outcome", |coordinator| !coordinator.outcomes.is_empty());
    let coordinator = worker.leave();
    assert!(matches!(coordinator.outcomes[0].outcome, TaskOutcome::Finished { .. }), "{:?}", coordinator.outcomes);
}

#[test]
fn a_blob_that_stays_damaged_is_an_error() {
    let good = Digest::of(b"good");
    let worker = Worker::start(Box::new(move |context| {
        assert!(matches!(context.blobs().get(good), Err(BlobError::Corrupt { expected, .. }) if expected == good));
        finished(context)
    }));
    lock(&worker.fake.coordinator).blobs.insert(good, b"good".to_vec());
    worker.fake.damage.store(100, Ordering::SeqCst);
    worker.grant(1);
    worker.wait("an outcome", |coordinator| !coordinator.outcomes.is_empty());
    assert!(matches!(worker.leave().outcomes[0].outcome, TaskOutcome::Finished { .. }));
}

#[test]
fn cut_transfers_go_on_where_they_were_cut() {
    const BYTES: usize = 30 << 20;
    let whole: Vec<u8> = (0..BYTES).map(|i| (i % 251) as u8).collect();
    let sent = whole.clone();
    let worker = Worker::start(Box::new(move |context| {
        let blobs = context.blobs();
        let digest = blobs.put_pieces(&[&sent[..1000], &sent[1000..]]).expect("stored");
        let read = blobs.open(digest).expect("fetched");
        assert_eq!(read.bytes(), BYTES as u64);
        let mut end = vec![0; 1000];
        read.read_at((BYTES - 1000) as u64, &mut end).expect("read");
        assert_eq!(end, sent[BYTES - 1000..]);
        finished(context)
    }));
    worker.fake.cut.store(2, Ordering::SeqCst);
    worker.grant(1);
    worker.wait("an upload", |coordinator| coordinator.blobs.contains_key(&Digest::of(&whole)));
    let uploaded = worker.fake.received.load(Ordering::SeqCst);
    // Two parts of 8 MiB of which half arrived; all again would be twice as much.
    assert!(uploaded < (BYTES + (10 << 20)) as u64, "{uploaded} bytes were sent");
    worker.wait("an outcome", |coordinator| !coordinator.outcomes.is_empty());
    let outcomes = worker.leave().outcomes.clone();
    assert!(matches!(outcomes[0].outcome, TaskOutcome::Finished { .. }), "{outcomes:?}");
}

#[test]
fn a_cut_download_goes_on() {
    const BYTES: usize = 20 << 20;
    let whole: Vec<u8> = (0..BYTES).map(|i| (i % 241) as u8).collect();
    let digest = Digest::of(&whole);
    let sent = whole.clone();
    let worker = Worker::start(Box::new(move |context| {
        assert_eq!(*context.blobs().get(digest).expect("fetched"), *sent);
        finished(context)
    }));
    lock(&worker.fake.coordinator).blobs.insert(digest, whole);
    worker.fake.cut.store(1, Ordering::SeqCst);
    worker.grant(1);
    worker.wait("an outcome", |coordinator| !coordinator.outcomes.is_empty());
    let received = worker.fake.received.load(Ordering::SeqCst);
    // What was in flight when it broke off may be lost, but not all that came before.
    assert!(received < (2 * BYTES) as u64, "{received} bytes were sent");
    assert!(matches!(worker.leave().outcomes[0].outcome, TaskOutcome::Finished { .. }));
}

/// A blob that is damaged in the store is no trouble of the network: said once, with its name, and not asked for again.
#[test]
fn a_blob_that_is_damaged_in_the_store_fails_the_attempt_at_once() {
    let digest = Digest::of(b"rotten");
    let worker = Worker::start(Box::new(move |context| {
        context.manifest(digest)?;
        finished(context)
    }));
    worker.fake.rotten.store(true, Ordering::SeqCst);
    worker.grant(1);
    worker.wait("an outcome", |coordinator| !coordinator.outcomes.is_empty());
    assert_eq!(worker.fake.received.load(Ordering::SeqCst), 1, "asked once");
    let outcomes = worker.leave().outcomes.clone();
    let TaskOutcome::Failed { class: FailureClass::Damaged, .. } = &outcomes[0].outcome else { panic!("{outcomes:?}") };
}

#[test]
fn a_poll_whose_connection_hangs_is_followed_by_another_within_the_lease() {
    let worker = Worker::start(Box::new(finished));
    worker.wait("some polls", |coordinator| coordinator.polls.len() > 2);
    worker.fake.hang.store(1, Ordering::SeqCst);
    worker.wait("the hanging one", |_| worker.fake.hang.load(Ordering::SeqCst) == 0);
    let before = lock(&worker.fake.coordinator).polls.len();
    worker.wait("the next ones", |coordinator| coordinator.polls.len() > before + 2);
    let coordinator = worker.leave();
    let longest = coordinator.polls.windows(2).map(|pair| pair[1] - pair[0]).max().expect("polls");
    assert!(longest < Duration::from_millis(LEASE_MS), "not heard of for {longest:?}");
    assert!(longest > Duration::from_millis(LEASE_MS / 3), "one poll did hang: {longest:?}");
}

/// An artifact of one file in the fake's store: its manifest's digest, and the file's.
fn artifact(fake: &Fake, bytes: &[u8]) -> (Digest, Digest) {
    let file = Digest::of(bytes);
    let mut manifest = Manifest::new(ArtifactKind::Dataset, serde_json::json!({}));
    let entry = protocol::artifact::FileEntry { digest: file, bytes: bytes.len() as u64 };
    manifest.files.insert("file".to_owned(), entry);
    let blobs = &mut lock(&fake.coordinator).blobs;
    blobs.insert(file, bytes.to_vec());
    blobs.insert(manifest.digest(), manifest.to_bytes());
    (manifest.digest(), file)
}

fn prepare(task: &str, input: Digest, resume: Option<Digest>) -> Prepare {
    Prepare { task: task.into(), inputs: BTreeMap::from([("dataset".to_owned(), input)]), resume }
}

fn says_ready(coordinator: &ActorHandle, tasks: &[&str]) -> bool {
    coordinator.last_poll.as_ref().is_some_and(|poll| poll.ready.iter().map(TaskId::as_str).eq(tasks.iter().copied()))
}

#[test]
fn what_a_task_needs_is_fetched_before_it_is_given() {
    let input = Arc::new(Mutex::new(None));
    let read = input.clone();
    let worker = Worker::start(Box::new(move |context| {
        let digest = lock(&read).expect("set before the grant");
        let manifest = context.manifest(digest)?;
        context.blobs().get(manifest.files["file"].digest).expect("there");
        finished(context)
    }));
    let (data, file) = artifact(&worker.fake, b"data");
    let (saved, state) = artifact(&worker.fake, b"state");
    *lock(&input) = Some(data);
    // Part of it is not there yet, and part arrives damaged.
    let held_back = lock(&worker.fake.coordinator).blobs.remove(&state).expect("stored");
    worker.fake.damage.store(1, Ordering::SeqCst);
    worker.fake.desired(|coordinator| coordinator.prepare = vec![prepare("run/stage", data, Some(saved))]);
    worker.wait("the file that is missing", |coordinator| coordinator.fetched.contains(&state));
    assert!(says_ready(&lock(&worker.fake.coordinator), &[]), "not before all is there");
    lock(&worker.fake.coordinator).blobs.insert(state, held_back);
    worker.wait("it to be ready", |coordinator| says_ready(coordinator, &["run/stage"]));
    let fetched = lock(&worker.fake.coordinator).fetched.len();
    assert!(lock(&worker.fake.coordinator).fetched.contains(&file));
    worker.grant(1);
    worker.wait("an outcome", |coordinator| !coordinator.outcomes.is_empty());
    worker.fake.desired(|coordinator| coordinator.prepare.clear());
    worker.wait("it to be forgotten", |coordinator| says_ready(coordinator, &[]));
    let coordinator = worker.leave();
    assert_eq!(coordinator.fetched.len(), fetched, "the stage fetches nothing");
    assert!(matches!(coordinator.outcomes[0].outcome, TaskOutcome::Finished { .. }), "{:?}", coordinator.outcomes);
}

/// A task whose input is damaged in the store is not waited for by everybody for ever: it is taken, and its attempt says so.
#[test]
fn a_damaged_input_does_not_keep_a_task_from_being_given() {
    let worker = Worker::start(Box::new(finished));
    worker.fake.rotten.store(true, Ordering::SeqCst);
    let (data, _) = artifact(&worker.fake, b"data");
    worker.fake.desired(|coordinator| coordinator.prepare = vec![prepare("run/stage", data, None)]);
    worker.wait("it to be taken as it is", |coordinator| says_ready(coordinator, &["run/stage"]));
    worker.leave();
}

#[test]
fn fetching_ahead_stops_when_the_task_is_another_s_and_when_the_worker_leaves() {
    let worker = Worker::start(Box::new(finished));
    let (first, _) = artifact(&worker.fake, b"first");
    let (second, _) = artifact(&worker.fake, b"second");
    worker.fake.stuck.store(true, Ordering::SeqCst);
    worker.fake.desired(|coordinator| coordinator.prepare = vec![prepare("run/a", first, None)]);
    worker.wait("a download that hangs", |coordinator| coordinator.fetched == [first]);
    worker.fake.stuck.store(false, Ordering::SeqCst);
    worker.fake.desired(|coordinator| coordinator.prepare = vec![prepare("run/b", second, None)]);
    worker.wait("the other one", |coordinator| says_ready(coordinator, &["run/b"]));
    worker.fake.stuck.store(true, Ordering::SeqCst);
    worker.fake.desired(|coordinator| coordinator.prepare = vec![prepare("run/a", first, None)]);
    worker.wait("the first one again", |coordinator| coordinator.fetched.iter().filter(|d| **d == first).count() == 2);
    let begun = Instant::now();
    worker.leave();
    assert!(begun.elapsed() < Duration::from_secs(5), "it waited for the download");
}

#[test]
fn an_outcome_that_is_refused_is_a_failure_and_not_silence() {
    let worker = Worker::start(Box::new(finished));
    lock(&worker.fake.coordinator).refuses = true;
    worker.grant(1);
    worker.wait("an outcome", |coordinator| !coordinator.outcomes.is_empty());
    let coordinator = worker.leave();
    let TaskOutcome::Failed { class, message } = &coordinator.outcomes[0].outcome else {
        panic!("{:?}", coordinator.outcomes)
    };
    assert_eq!(*class, FailureClass::Infrastructure);
    assert!(message.contains("not-found"), "{message}");
}

#[test]
fn a_member_that_runs_out_of_memory_says_so_itself() {
    let worker = Worker::start(Box::new(|_| panic!("CUDA_ERROR: out of memory")));
    let first = Member { worker: "other".into(), incarnation: Incarnation(1), peer_address: "127.0.0.1:9".into() };
    let members = vec![first, worker.member.clone()];
    worker.fake.desired(|coordinator| {
        coordinator.fence = 1;
        let mut desired = assignment(&members[1], 1, 1);
        desired.role =
            Role::Member { generation: Generation(1), members: members.clone(), secret: "secret".to_owned() };
        coordinator.assignments = vec![desired];
    });
    worker.wait("an outcome", |coordinator| !coordinator.outcomes.is_empty());
    let outcomes = worker.leave().outcomes;
    let TaskOutcome::Failed { class, .. } = &outcomes[0].outcome else { panic!("{outcomes:?}") };
    assert_eq!((*class, outcomes[0].grant.worker.as_str()), (FailureClass::OutOfMemory, "w0"));
}
