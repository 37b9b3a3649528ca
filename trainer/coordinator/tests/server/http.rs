//! The server over a real socket with a real store, and a worker that does not compute.

use std::collections::BTreeMap;
use std::time::{Duration, Instant};

use axum::body::Body;
use axum::http::{Request, StatusCode};
use coordinator::{Config, Control, Coordinator, Handle, Policy, Records};
use pipeline::{Pipeline, PipelineStage, StageInput};
use protocol::message::{
    ApiError, Assignment, CommitCheckpoint, DesiredAssignments, Doing, Grant, Join, Joined, LogBatch, MetricBatch,
    MetricRow, PROTOCOL_VERSION, Poll, Progress, ReportOutcome, RunState, StageState, Submit, TaskOutcome,
};
use protocol::proof::{BlobStored, GRANT_HEADER, RECEIPT_HEADER, SECRET_HEADER, Vouched};
use protocol::stage::{Backend, DataSynthetic, Placement, StageSettings, TrainVae};
use protocol::{ArtifactKind, Digest, Manifest, RunId, Seed};
use registry::{Holder, RunListQuery, Store};
use serde::Serialize;
use serde::de::DeserializeOwned;
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::TcpStream;

use super::exposition;

type TestResult<T = ()> = Result<T, Box<dyn std::error::Error>>;

/// A minimal HTTP client with one connection per request.
struct Client {
    address: std::net::SocketAddr,
    token: Option<String>,
    /// The secret of a process or of a grant, which its calls show.
    secret: String,
}

/// The secret of every process in these tests.
const SECRET: &str = "the-secret-of-each-process-of-these-tests";

impl Client {
    fn of(handle: &Handle) -> Self {
        let token = Some(handle.token().secret().to_owned());
        Self { address: handle.address(), token, secret: SECRET.to_owned() }
    }

    /// The same client, using the secret of a grant.
    fn under(&self, assignment: &Assignment) -> Self {
        Self { secret: assignment.secret.clone(), token: self.token.clone(), ..*self }
    }

    async fn send(&self, request: Request<Body>) -> TestResult<(StatusCode, Vec<u8>)> {
        let (parts, body) = request.into_parts();
        let body = axum::body::to_bytes(body, usize::MAX).await?;
        let mut stream = TcpStream::connect(self.address).await?;
        let mut head = format!("{} {} HTTP/1.1\r\nhost: localhost\r\nconnection: close\r\n", parts.method, parts.uri);
        if let Some(token) = &self.token {
            head += &format!("authorization: Bearer {token}\r\n");
        }
        head += &format!("{SECRET_HEADER}: {}\r\n", self.secret);
        for (name, value) in &parts.headers {
            head += &format!("{name}: {}\r\n", value.to_str()?);
        }
        head += &format!("content-length: {}\r\n\r\n", body.len());
        stream.write_all(head.as_bytes()).await?;
        stream.write_all(&body).await?;
        let mut answer = Vec::new();
        stream.read_to_end(&mut answer).await?;
        let end = answer.windows(4).position(|w| w == b"\r\n\r\n").ok_or("no head")? + 4;
        let status = std::str::from_utf8(&answer[9..12])?.parse()?;
        Ok((status, answer[end..].to_vec()))
    }

    async fn call<T: DeserializeOwned>(&self, method: &str, path: &str, body: impl Serialize) -> TestResult<T> {
        let (status, bytes) = self.try_call(method, path, body).await?;
        assert!(status.is_success(), "{method} {path}: {status} {}", String::from_utf8_lossy(&bytes));
        Ok(serde_json::from_slice(&bytes)?)
    }

    async fn try_call(&self, method: &str, path: &str, body: impl Serialize) -> TestResult<(StatusCode, Vec<u8>)> {
        let body = Body::from(serde_json::to_vec(&body)?);
        self.send(Request::builder().method(method).uri(path).header("content-type", "application/json").body(body)?)
            .await
    }

    async fn refused(&self, path: &str, body: impl Serialize) -> TestResult<(u16, ApiError)> {
        let (status, bytes) = self.try_call("POST", path, body).await?;
        Ok((status.as_u16(), serde_json::from_slice(&bytes)?))
    }

    /// Uploads a blob and returns its receipt.
    async fn put_blob(&self, grant: &Grant, bytes: &[u8]) -> TestResult<Receipt> {
        let request = Request::builder().method("PUT").uri(format!("/v1/blobs/{}", Digest::of(bytes)));
        let request = request.header(GRANT_HEADER, serde_json::to_string(grant)?);
        let request = request.header("x-stride-bytes", bytes.len());
        let (status, answer) = self.send(request.body(Body::from(bytes.to_vec()))?).await?;
        assert!(status.is_success(), "{status} {}", String::from_utf8_lossy(&answer));
        let stored: BlobStored = serde_json::from_slice(&answer)?;
        Ok((stored.digest, stored.receipt.ok_or("a stored blob has a receipt")?))
    }

    async fn put_manifest(&self, grant: &Grant, kind: ArtifactKind, name: &str) -> TestResult<Receipt> {
        self.put_blob(grant, &Manifest::new(kind, serde_json::json!({"name": name})).to_bytes()).await
    }
}

/// A blob and the proof of its upload.
type Receipt = (Digest, String);

fn vouched<T>(what: T, receipt: &Receipt) -> Vouched<T> {
    Vouched { what, receipts: BTreeMap::from([receipt.clone()]) }
}

fn pipeline() -> Pipeline {
    let stage = |name: &str, settings: StageSettings| {
        let inputs = settings.inputs().into_iter();
        let inputs =
            inputs.map(|(field, stage, kind)| StageInput { field, stage: stage.as_str().into(), kind }).collect();
        PipelineStage {
            name: name.into(),
            settings,
            placement: Placement::default(),
            inputs,
            external: BTreeMap::new(),
            sweep: None,
            derived: None,
            copy_of: None,
        }
    };
    Pipeline {
        name: "small".into(),
        seed: Seed(1),
        backend: Backend::Flex,
        priority: 0,
        stages: vec![
            stage("dataset", StageSettings::DataSynthetic(DataSynthetic::default())),
            stage("vae", StageSettings::TrainVae(TrainVae::default())),
        ],
        code_versions: BTreeMap::new(),
    }
}

fn submission(key: Option<&str>) -> TestResult<Submit> {
    Ok(Submit {
        pipeline: serde_json::to_value(pipeline())?,
        source: "name: small".into(),
        idempotency_key: key.map(str::to_owned),
        until: None,
    })
}

async fn start(dir: &std::path::Path) -> TestResult<(Handle, Client)> {
    let store = Store::open(dir, Holder::this_process("a test")).await?;
    let policy = Policy { poll_ms: 300, tick_ms: 50, lease_ms: 1000, ..Policy::default() };
    let config = Config { policy, alone: false, park: false, ..Config::embedded() };
    let handle = Coordinator::start(store, config).await?;
    let client = Client::of(&handle);
    Ok((handle, client))
}

async fn join(client: &Client, name: &str) -> TestResult<Joined> {
    let join = Join {
        protocol: PROTOCOL_VERSION,
        worker: name.into(),
        pid: 7,
        backend: Backend::Flex,
        instruction_set: "avx2".into(),
        code_versions: protocol::stage::StageSettings::code_versions(),
        peer_address: "127.0.0.1:1".into(),
        labels: Default::default(),
    };
    client.call("POST", "/v1/workers", join).await
}

/// Polls until it gets a task of `stage`.
async fn assignment(client: &Client, name: &str, joined: &Joined, stage: &str) -> TestResult<Assignment> {
    let (mut version, mut ready) = (0, Vec::new());
    loop {
        let poll = Poll { incarnation: joined.incarnation, doing: vec![], ready, version, leaving: false };
        let desired: DesiredAssignments = client.call("POST", &format!("/v1/workers/{name}/poll"), poll).await?;
        version = desired.version;
        ready = desired.prepare.into_iter().map(|prepare| prepare.task).collect();
        if let Some(assignment) = desired.assignments.into_iter().find(|a| a.stage.name.as_str() == stage) {
            return Ok(assignment);
        }
    }
}

async fn until_over(handle: &Handle, run: &RunId) -> TestResult<protocol::message::RunView> {
    let mut changes = handle.changes();
    loop {
        changes.mark_unchanged();
        let view = handle.run_view(run).await?;
        if view.state.is_final() {
            return Ok(view);
        }
        tokio::time::timeout(Duration::from_secs(20), changes.changed()).await??;
    }
}

/// Polls of workers without work are the most frequent calls of a large fleet.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_worker_without_work_is_answered_later_than_one_with_work() -> TestResult {
    let dir = tempfile::tempdir()?;
    let store = Store::open(dir.path(), Holder::this_process("a test")).await?;
    let policy = Policy { poll_ms: 300, ..Policy::default() };
    let idle = Duration::from_millis(policy.idle_poll_ms());
    let handle = Coordinator::start(store, Config { policy, alone: false, park: false, ..Config::embedded() }).await?;
    let client = Client::of(&handle);
    let joined = join(&client, "w").await?;
    assert_eq!(Duration::from_millis(joined.poll_ms), idle);
    let poll = |doing: Vec<Doing>, version| {
        let poll = Poll { incarnation: joined.incarnation, doing, ready: vec![], version, leaving: false };
        client.call::<DesiredAssignments>("POST", "/v1/workers/w/poll", poll)
    };
    let version = poll(vec![], u64::MAX).await?.version;
    let begun = Instant::now();
    assert_eq!(poll(vec![], version).await?.version, version);
    assert!(begun.elapsed() >= idle, "{:?}", begun.elapsed());

    handle.submit(submission(None)?).await?;
    let grant = assignment(&client, "w", &joined, "dataset").await?.grant;
    let doing = || vec![Doing::new(grant.clone(), Default::default())];
    let version = poll(doing(), u64::MAX).await?.version;
    let mut fastest = Duration::MAX;
    for _ in 0..3 {
        let begun = Instant::now();
        assert_eq!(poll(doing(), version).await?.version, version);
        fastest = fastest.min(begun.elapsed());
    }
    assert!(fastest >= Duration::from_millis(300) && fastest < idle, "{fastest:?}");
    handle.shutdown().await;
    Ok(())
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_run_goes_through_over_http_and_survives_a_restart() -> TestResult {
    let dir = tempfile::tempdir()?;
    let (handle, client) = start(dir.path()).await?;
    let run = handle.submit(submission(Some("once"))?).await?;
    let again: coordinator::shell::Submitted = client.call("POST", "/v1/runs", submission(Some("once"))?).await?;
    assert_eq!(again.run, run);
    let body = serde_json::to_vec(&submission(None)?)?;
    let by_header = |key: &str| {
        let request = Request::builder().method("POST").uri("/v1/runs").header("content-type", "application/json");
        request.header("idempotency-key", key).body(Body::from(body.clone()))
    };
    let (status, answer) = client.send(by_header("once")?).await?;
    assert_eq!(
        (status.as_u16(), serde_json::from_slice::<coordinator::shell::Submitted>(&answer)?.run),
        (200, run.clone())
    );
    let other = Submit { source: "name: other".into(), ..submission(Some("once"))? };
    let (status, error) = client.refused("/v1/runs", other).await?;
    assert_eq!((status, error.code.as_str()), (409, "conflict"), "{error:?}");
    assert_eq!(client.send(by_header("")?).await?.0.as_u16(), 400);

    let joined = join(&client, "w").await?;
    let data = assignment(&client, "w", &joined, "dataset").await?;
    let (under, data) = (client.under(&data), data.grant);
    let receipt = under.put_manifest(&data, ArtifactKind::Dataset, "clips").await?;
    let output = receipt.0;
    let rows = vec![MetricRow { step: 1, key: "clips".into(), value: 400.0 }];
    under.call::<()>("POST", "/v1/metrics", MetricBatch { grant: data.clone(), rows }).await?;
    let logs = LogBatch { grant: data.clone(), first: 0, lines: vec!["hello".into()] };
    under.call::<()>("POST", "/v1/logs", logs.clone()).await?;
    under.call::<()>("POST", "/v1/logs", logs).await?;
    let finished = TaskOutcome::Finished { output, metrics: BTreeMap::from([("clips".into(), 400.0)]) };
    let report = vouched(ReportOutcome::new(data.clone(), finished), &receipt);
    under.call::<()>("POST", "/v1/outcomes", report.clone()).await?;
    // The first answer may have been lost.
    under.call::<()>("POST", "/v1/outcomes", report).await?;

    let vae = assignment(&client, "w", &joined, "vae").await?;
    let under = client.under(&vae);
    assert_eq!(vae.stage.inputs["dataset"], output);
    let receipt = under.put_manifest(&vae.grant, ArtifactKind::Checkpoint, "step 5").await?;
    let checkpoint = receipt.0;
    let commit = CommitCheckpoint { grant: vae.grant.clone(), step: 5, manifest: checkpoint, metrics: BTreeMap::new() };
    under.call::<()>("POST", "/v1/checkpoints", vouched(commit.clone(), &receipt)).await?;
    let receipt = under.put_manifest(&vae.grant, ArtifactKind::Checkpoint, "step 6").await?;
    std::fs::remove_file(checkpoint::blob_path(dir.path(), receipt.0))?;
    let missing = CommitCheckpoint { step: 6, manifest: receipt.0, ..commit };
    let refused = under.refused("/v1/checkpoints", vouched(missing, &receipt)).await?;
    assert_eq!(refused.0, 404, "a manifest that is not there");
    // The attempt has failed; the next one continues from the existing checkpoint.
    let failed = vae;
    let vae = assignment(&client, "w", &joined, "vae").await?;
    assert_eq!((vae.grant.attempt, vae.resume), (failed.grant.attempt.next(), Some(checkpoint)));
    let metrics = MetricBatch { grant: failed.grant.clone(), rows: vec![] };
    let logs = LogBatch { grant: failed.grant.clone(), first: 0, lines: vec![] };
    let request = Request::builder().method("PUT").uri(format!("/v1/blobs/{}", Digest::of(b"late")));
    let request = request.header(GRANT_HEADER, serde_json::to_string(&failed.grant)?).body(Body::from("late"))?;
    let (status, error) = under.refused("/v1/metrics", metrics).await?;
    assert_eq!((status, error.code.as_str()), (409, "stale-fence"));
    let carried = format!("with fence {} has been superseded", failed.grant.fence);
    assert!(error.message.ends_with(&carried), "the fence of now is not told: {}", error.message);
    let refused = [under.try_call("POST", "/v1/logs", logs).await?.0, under.send(request).await?.0];
    assert_eq!(refused, [StatusCode::CONFLICT; 2], "logs, blob");

    // The worker survives the restart and reconnects with the same incarnation, grant and secret.
    handle.shutdown().await;
    let (handle, client) = start(dir.path()).await?;
    let same = assignment(&client, "w", &joined, "vae").await?;
    assert_eq!((&same.grant, &same.secret, same.resume), (&vae.grant, &vae.secret, Some(checkpoint)));
    let under = client.under(&vae);
    let receipt = under.put_manifest(&vae.grant, ArtifactKind::Vae, "vae").await?;
    let finished = TaskOutcome::Finished { output: receipt.0, metrics: BTreeMap::from([("mpjpe".into(), 40.0)]) };
    let report = ReportOutcome { peak_memory: Some(7 << 20), ..ReportOutcome::new(vae.grant.clone(), finished) };
    under.call::<()>("POST", "/v1/outcomes", vouched(report, &receipt)).await?;
    let view = until_over(&handle, &run).await?;
    assert_eq!(view.state, RunState::Finished);
    assert_eq!((view.stages[1].metrics["mpjpe"], view.stages[1].peak_memory), (40.0, Some(7 << 20)));
    let view: protocol::message::RunView = client.call("GET", &format!("/v1/runs/{run}"), ()).await?;
    let (whole, vae) = (view.times, view.stages[1].times);
    assert!(whole.created_ms <= whole.started_ms && whole.started_ms <= vae.started_ms, "{view:?}");
    assert!(whole.created_ms.is_some() && vae.started_ms <= vae.ended_ms && vae.ended_ms <= whole.ended_ms, "{view:?}");
    let rows: Vec<registry::HistoryRow> = client.call("GET", &format!("/v1/history?run={run}"), ()).await?;
    let kinds: Vec<&str> = rows.iter().map(|row| row.entry.kind.name()).collect();
    let expected =
        ["submitted", "granted", "finished", "granted", "checkpoint", "retried", "granted", "finished", "ended"];
    assert_eq!(kinds, expected);
    assert!(rows[5].entry.why.is_some() && rows[8].entry.why.as_deref() == Some("finished"));
    let after = format!("/v1/history?worker=w&after={}&limit=1", rows[3].id - 1);
    let of_worker: Vec<registry::HistoryRow> = client.call("GET", &after, ()).await?;
    assert_eq!(of_worker, rows[3..4]);
    assert_eq!(client.try_call("GET", "/v1/history?run=none", ()).await?.0, StatusCode::NOT_FOUND);
    let (_, text) = client.try_call("GET", "/metrics", ()).await?;
    let text = String::from_utf8(text)?;
    for line in ["stride_workers{state=\"idle\"} 1", "stride_values_total 0", "stride_storage_trouble 0"] {
        assert!(text.lines().any(|it| it == line), "{line}\n{text}");
    }
    assert!(text.contains("stride_commit_seconds_bucket") && !text.contains(run.as_str()), "{text}");
    assert!(exposition::check(&text) > 5, "{text}");
    exposition::check_with_promtool(&text);
    let request =
        Request::builder().method("GET").uri("/metrics").header("accept", "application/openmetrics-text;q=0.5");
    let (_, open) = client.send(request.body(Body::empty())?).await?;
    let open = String::from_utf8(open.to_vec())?;
    assert!(open.ends_with("\n# EOF\n") && open.contains("# TYPE stride_values counter\n"), "{open}");
    let lines: Vec<registry::LogRow> = client.call("GET", &format!("/v1/runs/{run}/logs?stage=dataset"), ()).await?;
    assert_eq!(lines.iter().map(|line| line.text.as_str()).collect::<Vec<_>>(), ["hello"]);
    let curves: coordinator::shell::StageMetrics = client.call("GET", &format!("/v1/runs/{run}/metrics"), ()).await?;
    assert_eq!(curves[&"dataset".into()]["clips"].points[0].value, 400.0);

    // All values are known, so no stage is computed twice.
    let second = handle.submit(submission(None)?).await?;
    let view = until_over(&handle, &second).await?;
    assert!(view.stages.iter().all(|stage| stage.state == StageState::Cached), "{view:#?}");
    assert!(handle.control(&second, Control::Pause).await.is_err());
    reasons_are_said(&handle, &client, [&run, &second]).await?;
    handle.shutdown().await;
    Ok(())
}

/// Checks why the stages of two equal runs were computed, and those of a third with another setting.
async fn reasons_are_said(handle: &Handle, client: &Client, [first, second]: [&RunId; 2]) -> TestResult {
    async fn settings(client: &Client, run: &RunId) -> TestResult<coordinator::shell::RunSettings> {
        client.call("GET", &format!("/v1/runs/{run}/settings"), ()).await
    }
    fn texts(settings: &coordinator::shell::RunSettings) -> Vec<&str> {
        settings.stages.iter().filter_map(|stage| Some(stage.why.as_ref()?.text.as_str())).collect()
    }
    let found = settings(client, first).await?;
    assert_eq!((found.previous.as_ref(), texts(&found)), (None, vec!["new", "new"]));
    let found = settings(client, second).await?;
    let cached = format!("cached from {first}");
    assert_eq!((found.previous.as_ref(), texts(&found)), (Some(first), vec![&*cached; 2]));
    let mut changed = pipeline();
    changed.stages[1].settings = StageSettings::TrainVae(TrainVae { ema: 2e-4, ..TrainVae::default() });
    let ema = TrainVae::default().ema;
    let third = handle.submit(Submit { pipeline: serde_json::to_value(changed)?, ..submission(None)? }).await?;
    let found = settings(client, &third).await?;
    assert_eq!((found.previous.as_ref(), found.missing.as_slice()), (Some(second), &[][..]));
    assert_eq!(texts(&found)[1], format!("ema {ema} -> 2e-4"));
    assert_eq!(found.stages[1].why.as_ref().map(|why| why.changes.len()), Some(1));
    Ok(())
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn curves_come_in_buckets_as_json_and_packed() -> TestResult {
    let dir = tempfile::tempdir()?;
    let (handle, client) = start(dir.path()).await?;
    let run = handle.submit(submission(None)?).await?;
    let joined = join(&client, "w").await?;
    let data = assignment(&client, "w", &joined, "dataset").await?;
    let value = |step: u64| if step == 1_234 { f64::NAN } else { step as f64 };
    let rows = (1..=5_000).map(|step| MetricRow { step, key: "clips & more".into(), value: value(step) }).collect();
    client.under(&data).call::<()>("POST", "/v1/metrics", MetricBatch { grant: data.grant, rows }).await?;

    let path = format!("/v1/metrics?run={run}&run={run}&key=clips%20%26%20more&key=none&buckets=50");
    let curves: coordinator::shell::Curves = client.call("GET", &path, ()).await?;
    let [series] = curves.series.as_slice() else { panic!("{curves:?}") };
    assert_eq!((&series.run, series.stage.as_str(), series.key.as_str()), (&run, "dataset", "clips & more"));
    assert_eq!((series.total, series.columns.nan.iter().sum::<u64>()), (5_000, 1));
    let rows = series.columns.x.len();
    assert!((40..=50).contains(&rows), "{rows}");
    assert_eq!((series.columns.last.last(), series.columns.max.last()), (Some(&5_000.0), Some(&5_000.0)));

    let request = Request::builder().method("GET").uri(&path).header("accept", "application/octet-stream");
    let (status, packed) = client.send(request.body(Body::empty())?).await?;
    assert_eq!(status, StatusCode::OK);
    let length = u32::from_le_bytes(packed[..4].try_into()?) as usize;
    let head: serde_json::Value = serde_json::from_slice(&packed[4..4 + length])?;
    assert_eq!((&head["series"][0]["rows"], &head["series"][0]["x0"]), (&rows.into(), &series.columns.x[0].into()));
    assert_eq!(packed.len(), 4 + length + rows * 7 * 4);

    let points: coordinator::shell::StageMetrics =
        client.call("GET", &format!("/v1/runs/{run}/metrics?stage=dataset&after=1232&limit=3"), ()).await?;
    let points: Vec<_> = points[&"dataset".into()]["clips & more"].points.iter().map(|p| (p.step, p.value)).collect();
    assert_eq!((points.len(), points[0], points[1].0), (3, (1_233, 1_233.0), 1_234));
    assert!(points[1].1.is_nan());

    for (query, expected, says) in [
        (String::new(), 400, "the query names no run"),
        ("?run=none".to_owned(), 404, "is not known"),
        (format!("?run={run}&run=none"), 404, "is not known"),
        (format!("?run={run}&stage=none"), 404, "has no stage `none`"),
        (format!("?run={run}&buckets=many"), 400, "`buckets` is `many`"),
        (format!("?run={run}&limit=5"), 400, "unknown parameter `limit`"),
    ] {
        let (status, answer) = client.try_call("GET", &format!("/v1/metrics{query}"), ()).await?;
        let error: ApiError = serde_json::from_slice(&answer)?;
        assert!(status.as_u16() == expected && error.message.contains(says), "{query}: {status} {error:?}");
    }
    handle.shutdown().await;
    Ok(())
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn p2_a_silent_worker_loses_its_task_and_its_writes_are_refused() -> TestResult {
    let dir = tempfile::tempdir()?;
    let (handle, client) = start(dir.path()).await?;
    handle.submit(submission(None)?).await?;
    let first = join(&client, "a").await?;
    let lost = assignment(&client, "a", &first, "dataset").await?;
    let (under, lost) = (client.under(&lost), lost.grant);
    let begun = std::time::Instant::now();
    let second = join(&client, "b").await?;
    let taken = assignment(&client, "b", &second, "dataset").await?.grant;
    let waited = begun.elapsed();
    assert!(waited > Duration::from_millis(500) && waited < Duration::from_secs(10), "{waited:?}");
    assert!(taken.fence > lost.fence && taken.attempt > lost.attempt);
    let report = ReportOutcome::new(lost.clone(), TaskOutcome::Yielded { at: 0 });
    let (status, error) = under.refused("/v1/outcomes", report).await?;
    assert_eq!((status, error.code.as_str()), (409, "stale-fence"));
    let request = Request::builder().method("PUT").uri(format!("/v1/blobs/{}", Digest::of(b"late")));
    let request = request.header(GRANT_HEADER, serde_json::to_string(&lost)?).body(Body::from("late"))?;
    assert_eq!(under.send(request).await?.0, StatusCode::CONFLICT);

    // A worker of another build is refused and does not join.
    let other = Join {
        protocol: PROTOCOL_VERSION + 1,
        worker: "c".into(),
        pid: 8,
        backend: Backend::Flex,
        instruction_set: "avx2".into(),
        code_versions: protocol::stage::StageSettings::code_versions(),
        peer_address: "127.0.0.1:1".into(),
        labels: Default::default(),
    };
    let (status, error) = client.refused("/v1/workers", other.clone()).await?;
    assert_eq!((status, error.code.as_str()), (400, "invalid"));
    assert!(error.message.contains("use one build for both"), "{}", error.message);
    // So is one whose numbers would differ.
    let mut older = Join { protocol: PROTOCOL_VERSION, ..other };
    let own = older.code_versions["train.vae"];
    older.code_versions.insert("train.vae".into(), own - 1);
    let (status, error) = client.refused("/v1/workers", older).await?;
    assert_eq!((status, error.code.as_str()), (400, "invalid"));
    let expected = format!("`train.vae` {} instead of {own}", own - 1);
    assert!(error.message.contains(&expected), "{}", error.message);

    // A process that joins with the same name replaces the old one, whose polls are refused.
    join(&client, "b").await?;
    let poll = Poll { incarnation: second.incarnation, doing: vec![], ready: vec![], version: 0, leaving: false };
    assert_eq!(client.refused("/v1/workers/b/poll", poll.clone()).await?.0, 409);
    assert_eq!(client.refused("/v1/workers/c/poll", poll).await?.0, 404);
    handle.shutdown().await;
    Ok(())
}

/// Two workers and one task for three leases: polls alone keep the lease, without any other event.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn polls_alone_keep_a_lease_and_show_progress() -> TestResult {
    let dir = tempfile::tempdir()?;
    let (handle, client) = start(dir.path()).await?;
    let run = handle.submit(submission(None)?).await?;
    let first = join(&client, "a").await?;
    let held = assignment(&client, "a", &first, "dataset").await?.grant;
    let second = join(&client, "b").await?;
    let begun = std::time::Instant::now();
    let (mut version, mut done) = ([0, 0], 0);
    while begun.elapsed() < Duration::from_secs(3) {
        for (i, (name, joined)) in [("a", &first), ("b", &second)].into_iter().enumerate() {
            done += 1;
            let progress = Progress { done, total: 100, ..Progress::default() };
            let doing = Doing::new(held.clone(), progress);
            let doing = if name == "a" { vec![doing] } else { vec![] };
            let poll =
                Poll { incarnation: joined.incarnation, doing, ready: vec![], version: version[i], leaving: false };
            let desired: DesiredAssignments = client.call("POST", &format!("/v1/workers/{name}/poll"), poll).await?;
            version[i] = desired.version;
            let grants: Vec<&Grant> = desired.assignments.iter().map(|assignment| &assignment.grant).collect();
            assert_eq!(grants, if name == "a" { vec![&held] } else { vec![] }, "worker {name}");
        }
    }
    let view = handle.run_view(&run).await?;
    assert!(view.stages[0].progress.done > done / 4, "{:?} of {done}", view.stages[0].progress);
    handle.shutdown().await;
    Ok(())
}

/// Simulates a loss of power during a write by cutting the database's log at 24 places, 7 of them within its last
/// frames. The rest is always a prefix of the facts from which recovery is possible.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn p1_a_torn_log_is_a_whole_beginning_of_itself() -> TestResult {
    let dir = tempfile::tempdir()?;
    let (handle, client) = start(dir.path()).await?;
    for i in 0..6 {
        handle.submit(submission(Some(&format!("run {i}")))?).await?;
        join(&client, "w").await?;
    }
    // Copied while open, like a disk after a loss of power.
    let wal = std::fs::read_dir(dir.path())?
        .flatten()
        .map(|entry| entry.path())
        .find(|path| path.extension().is_some_and(|e| e.to_string_lossy().ends_with("-wal")))
        .ok_or("no write-ahead log")?;
    let main = wal.with_extension(wal.extension().unwrap_or_default().to_string_lossy().trim_end_matches("-wal"));
    let (database, log) = (std::fs::read(&main)?, std::fs::read(&wal)?);
    handle.shutdown().await;
    let open = async |log: &[u8]| -> TestResult<(tempfile::TempDir, registry::Recovery)> {
        let torn = tempfile::tempdir()?;
        std::fs::write(torn.path().join(main.file_name().ok_or("a name")?), &database)?;
        std::fs::write(torn.path().join(wal.file_name().ok_or("a name")?), log)?;
        // Adopts the store, which is the user's decision to continue with the remaining data. A normal open would
        // refuse it.
        let store = Store::adopt(torn.path(), None, Holder::this_process("a test")).await?;
        let recovery = store.recovery().await?;
        Ok((torn, recovery))
    };
    let whole = open(&log).await?.1.facts;

    let mut lengths = Vec::new();
    let end = log.len();
    let cuts = (0..=16).map(|i| end * i / 16).chain([1, 31, 32, 500, 4000, 4119, 4121].map(|back| end - back));
    for cut in cuts {
        // A log cut before the creation of the tables is an empty store, not a damaged one.
        let (_, recovery) = open(&log[..cut]).await.map_err(|error| format!("cut at {cut} of {end}: {error}"))?;
        let left = &recovery.facts;
        assert_eq!(left[..], whole[..left.len()], "cut at {cut} of {end}");
        coordinator::journal::recover(Policy::default(), &recovery)?;
        lengths.push(left.len());
    }
    assert!(lengths.contains(&0) && lengths.contains(&whole.len()), "{lengths:?} of {}", whole.len());
    assert!(lengths.iter().any(|l| (1..whole.len()).contains(l)), "some entries were cut off: {lengths:?}");
    Ok(())
}

/// A blob that is generated while it is sent.
const LARGE_PARTS: u64 = 256;
const LARGE_BYTES: u64 = LARGE_PARTS << 20;

fn part(i: u64) -> Vec<u8> {
    let mut part = vec![7; 1 << 20];
    part[..8].copy_from_slice(&i.to_le_bytes());
    part
}

/// Peak memory of this process in bytes.
fn peak() -> TestResult<u64> {
    let status = std::fs::read_to_string("/proc/self/status")?;
    let line = status.lines().find_map(|line| line.strip_prefix("VmHWM:")).ok_or("no VmHWM")?;
    Ok(line.trim().trim_end_matches(" kB").parse::<u64>()? << 10)
}

impl Client {
    /// Sends the head of a request, before its body.
    async fn begin(&self, head: &str, headers: &[(&str, String)], length: u64) -> TestResult<TcpStream> {
        let mut text =
            format!("{head} HTTP/1.1\r\nhost: localhost\r\nconnection: close\r\ncontent-length: {length}\r\n");
        if let Some(token) = &self.token {
            text += &format!("authorization: Bearer {token}\r\n");
        }
        text += &format!("{SECRET_HEADER}: {}\r\n", self.secret);
        for (name, value) in headers {
            text += &format!("{name}: {value}\r\n");
        }
        let mut stream = TcpStream::connect(self.address).await?;
        stream.write_all(format!("{text}\r\n").as_bytes()).await?;
        Ok(stream)
    }

    async fn staged(&self, grant: &Grant, digest: Digest, receipt: &str) -> TestResult<BlobStored> {
        let request = Request::builder().method("GET").uri(format!("/v1/blobs/{digest}/staged"));
        let request = request.header(GRANT_HEADER, serde_json::to_string(grant)?).header(RECEIPT_HEADER, receipt);
        let request = request.body(Body::empty())?;
        let (status, answer) = self.send(request).await?;
        assert!(status.is_success(), "{status} {}", String::from_utf8_lossy(&answer));
        Ok(serde_json::from_slice(&answer)?)
    }

    /// Downloads a blob: status, expected length, received length, and digest of the received bytes.
    async fn fetch(&self, digest: Digest) -> TestResult<(u16, u64, u64, Digest)> {
        let mut stream = self.begin(&format!("GET /v1/blobs/{digest}"), &[], 0).await?;
        let (mut head, mut buffer) = (Vec::new(), vec![0; 1 << 16]);
        while !head.ends_with(b"\r\n\r\n") {
            head.push(stream.read_u8().await?);
        }
        let head = String::from_utf8(head)?.to_ascii_lowercase();
        let length = head.lines().find_map(|line| line.strip_prefix("content-length: ")).ok_or("no length")?.parse()?;
        let (mut hasher, mut came) = (protocol::digest::Hasher::default(), 0);
        // A reset also ends the body.
        while let Ok(read @ 1..) = stream.read(&mut buffer).await {
            hasher.update(&buffer[..read]);
            came += read as u64;
        }
        Ok((head[9..12].parse()?, length, came, hasher.finish()))
    }
}

/// Blobs held in memory would exceed the limit of this test several times.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_large_blob_passes_in_little_memory_and_a_cut_upload_goes_on() -> TestResult {
    let dir = tempfile::tempdir()?;
    let store = Store::open(dir.path(), Holder::this_process("a test")).await?;
    let handle = Coordinator::start(store.clone(), Config { park: false, ..Config::embedded() }).await?;
    let client = Client::of(&handle);
    handle.submit(submission(None)?).await?;
    let joined = join(&client, "w").await?;
    let assignment = assignment(&client, "w", &joined, "dataset").await?;
    let (client, grant) = (client.under(&assignment), assignment.grant);
    let mut hasher = protocol::digest::Hasher::default();
    (0..LARGE_PARTS).for_each(|i| hasher.update(&part(i)));
    let digest = hasher.finish();
    let before = peak()?;

    // Without a grant no body is read: only the sockets' buffers fill up.
    let stale = Grant { fence: protocol::Fence(0), ..grant.clone() };
    let header = |grant: &Grant| -> TestResult<_> { Ok((GRANT_HEADER, serde_json::to_string(grant)?)) };
    let put = format!("PUT /v1/blobs/{digest}");
    for headers in [vec![], vec![header(&stale)?]] {
        let mut stream = client.begin(&put, &headers, 10 << 30).await?;
        let mut sent = 0;
        while sent < LARGE_PARTS && stream.write_all(&part(sent)).await.is_ok() {
            sent += 1;
        }
        assert!(sent < LARGE_PARTS / 4, "{sent} MiB were taken without a grant");
    }

    // Cuts off the upload in the middle.
    let headers = vec![header(&grant)?];
    let mut stream = client.begin(&put, &headers, LARGE_BYTES).await?;
    for i in 0..LARGE_PARTS / 2 {
        stream.write_all(&part(i)).await?;
    }
    drop(stream);
    let staged = loop {
        let there = client.staged(&grant, digest, "").await?;
        assert!(!there.stored);
        if there.staged > 0 {
            break there.staged;
        }
        tokio::time::sleep(Duration::from_millis(20)).await;
    };
    assert!(staged > LARGE_BYTES / 4 && staged <= LARGE_BYTES / 2, "{staged} bytes were kept");

    let mut headers = headers;
    headers.extend([("x-stride-bytes", LARGE_BYTES.to_string()), ("x-stride-offset", staged.to_string())]);
    let mut stream = client.begin(&put, &headers, LARGE_BYTES - staged).await?;
    stream.write_all(&part(staged >> 20)[usize::try_from(staged % (1 << 20))?..]).await?;
    for i in (staged >> 20) + 1..LARGE_PARTS {
        stream.write_all(&part(i)).await?;
    }
    let mut answer = String::new();
    stream.read_to_string(&mut answer).await?;
    assert!(answer.starts_with("HTTP/1.1 200"), "{answer}");
    let stored: BlobStored = serde_json::from_str(answer.split_once("\r\n\r\n").ok_or("no body")?.1)?;
    let receipt = stored.receipt.filter(|_| stored.stored).ok_or("all of it has arrived")?;
    assert!(client.staged(&grant, digest, &receipt).await?.stored, "it need not be sent again");
    assert!(!client.staged(&grant, digest, "").await?.stored, "without a receipt it might be another's");

    assert_eq!(client.fetch(digest).await?, (200, LARGE_BYTES, LARGE_BYTES, digest));
    let grown = peak()?.saturating_sub(before);
    assert!(grown < 100 << 20, "{} MiB of memory for a blob of {LARGE_PARTS} MiB", grown >> 20);

    // A damaged blob is never sent completely, and is refused once the damage is known.
    let path = dir.path().join("blobs/sha256").join(&digest.hex()[..2]).join(&digest.hex()[2..]);
    let file = std::fs::OpenOptions::new().write(true).open(path)?;
    std::os::unix::fs::FileExt::write_all_at(&file, b"x", LARGE_BYTES / 2)?;
    drop(file);
    let (_, length, came, found) = client.fetch(digest).await?;
    assert!(length == LARGE_BYTES && came < LARGE_BYTES && found != digest, "{came} bytes were sent");
    assert_eq!(client.fetch(digest).await?.0, 409);
    handle.shutdown().await;
    Ok(())
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_run_that_is_younger_than_the_records_is_not_in_their_list() -> TestResult {
    let dir = tempfile::tempdir()?;
    let (handle, _) = start(dir.path()).await?;
    let first = handle.submit(submission(Some("first"))?).await?;
    let records = Records::open(dir.path()).await?;
    handle.submit(submission(Some("second"))?).await?;
    let listed = records.run_list(&RunListQuery { limit: 10, ..RunListQuery::default() }).await?.items;
    assert_eq!(listed.iter().map(|row| &row.run).collect::<Vec<_>>(), [&first]);
    // As `@last` asks: the younger run must not use up the limit.
    let newest = records.run_list(&RunListQuery { limit: 1, ..RunListQuery::default() }).await?.items;
    assert_eq!(newest.iter().map(|row| &row.run).collect::<Vec<_>>(), [&first]);
    records.run_view(&listed[0].run).await?;
    records.close().await;
    handle.shutdown().await;
    Ok(())
}
