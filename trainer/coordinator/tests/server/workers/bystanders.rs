//! A server with a busy worker and with other valid tokens.

use std::collections::BTreeMap;
use std::os::unix::fs::PermissionsExt;
use std::path::Path;
use std::time::{Duration, Instant};

use access::tls::ServerTls;
use access::{Server, Tokens};
use coordinator::{Config, Coordinator, Handle, Policy};
use protocol::message::{
    Assignment, DesiredAssignments, Grant, Join, Joined, PROTOCOL_VERSION, Poll, ReportOutcome, RunView, Submit,
    TaskOutcome,
};
use protocol::proof::{BlobStored, GRANT_HEADER, PROCESS_HEADER, Process, SECRET_HEADER, Vouched};
use protocol::stage::Backend;
use protocol::{ArtifactKind, Digest, FileEntry, Manifest, RunId};
use registry::{Holder, Store};
use reqwest::{Method, RequestBuilder};
use serde::Serialize;
use serde_json::Value;

use crate::front::{self, Protocol};
use crate::tls::{Files, authority};

/// Long enough for a slow machine, short enough to wait for.
pub(crate) const LEASE_MS: u64 = 1500;

/// Longer than any call takes. The error of a call without an answer has its path.
pub(crate) const PATIENCE: Duration = Duration::from_secs(90);

/// Each token contains its name. `nodes` and `lab` belong to workers.
pub(crate) const TOKENS: [(&str, &str, &str); 6] = [
    ("nodes", "worker", "workers=nodes-*"),
    ("lab", "worker", ""),
    ("reader", "read", ""),
    ("submitter", "submit", ""),
    ("promoter", "promote", ""),
    ("admin", "admin", ""),
];

pub(crate) fn token(name: &str) -> String {
    format!("the-token-of-{name}-in-these-tests")
}

pub(crate) struct Site {
    pub(crate) handle: Handle,
    /// The address of calls.
    url: String,
    #[expect(dead_code, reason = "held so that the folder stays")]
    dir: Option<tempfile::TempDir>,
}

impl Site {
    pub(crate) async fn start(lease_ms: u64) -> Self {
        Self::over(Protocol::Http1, lease_ms).await
    }

    /// Like [`Site::start`], on the store in `dir`.
    pub(crate) async fn of(dir: &Path, lease_ms: u64) -> Self {
        let handle = open(dir, lease_ms, None).await;
        Self { url: handle.url(), handle, dir: None }
    }

    /// Like [`Site::start`], with calls over `protocol`.
    pub(crate) async fn over(protocol: Protocol, lease_ms: u64) -> Self {
        let dir = tempfile::tempdir().unwrap();
        let files = (protocol == Protocol::Http2).then(|| authority(dir.path(), "ours"));
        // A store's folder holds nothing else at first.
        let store = dir.path().join("store");
        let handle = open(&store, lease_ms, files.as_ref().map(Files::server)).await;
        let url = match &files {
            Some(files) => front::open(handle.address(), &files.ca).await,
            None => handle.url(),
        };
        Self { handle, url, dir: Some(dir) }
    }

    pub(crate) fn server(&self, token_of: &str) -> Server {
        Server::new(&self.url, Some(token(token_of).parse().unwrap()), None).unwrap()
    }

    /// Submits a pipeline with a dataset and a VAE. The seed makes its values new to the store.
    pub(crate) async fn submit(&self, seed: u64) -> RunId {
        let text =
            format!("name: p\nseed: {seed}\ndataset: {{format: synthetic}}\nstages: {{vae: {{kind: train.vae}}}}\n");
        let pipeline = pipeline::read("p.yaml", &text, &[]).map_err(|mistakes| mistakes.to_string()).unwrap();
        let pipeline = serde_json::to_value(pipeline).unwrap();
        let submit = Submit { pipeline, source: text, idempotency_key: None, until: None };
        self.handle.submit(submit).await.unwrap()
    }
}

impl Site {
    /// A run as clients see it, without its duration.
    pub(crate) async fn view(&self, run: &RunId) -> RunView {
        let mut view = self.handle.run_view(run).await.unwrap();
        view.stages.iter_mut().for_each(|stage| stage.wall_s = 0.0);
        view
    }
}

async fn open(dir: &Path, lease_ms: u64, tls: Option<ServerTls>) -> Handle {
    let store = Store::open(dir, Holder::this_process("a test")).await.unwrap();
    let path = dir.join("tokens");
    let lines: Vec<String> =
        TOKENS.iter().map(|(name, scope, more)| format!("{name} {scope} {} {more}\n", token(name))).collect();
    std::fs::write(&path, lines.concat()).unwrap();
    std::fs::set_permissions(&path, std::fs::Permissions::from_mode(0o600)).unwrap();
    let policy = Policy { poll_ms: 50, tick_ms: 50, lease_ms, ..Policy::default() };
    let tokens = Tokens::read(&path).unwrap();
    let config = Config { policy, tokens, tls, alone: false, park: false, ..Config::embedded() };
    Coordinator::start(store, config).await.unwrap()
}

/// A worker process that does not compute.
#[derive(Clone)]
pub(crate) struct Worker {
    pub(crate) server: Server,
    pub(crate) name: String,
    pub(crate) secret: String,
    pub(crate) process: Process,
}

pub(crate) fn join_of(name: &str) -> Join {
    Join {
        protocol: PROTOCOL_VERSION,
        worker: name.into(),
        pid: 1,
        backend: Backend::Flex,
        instruction_set: "avx2".into(),
        code_versions: protocol::stage::StageSettings::code_versions(),
        peer_address: "127.0.0.1:1".into(),
        labels: Default::default(),
    }
}

/// Sends a call with `secret`; returns its status and body.
pub(crate) async fn post(server: &Server, secret: &str, path: &str, body: &impl Serialize) -> (u16, Value) {
    answer(server.request(Method::POST, path).header(SECRET_HEADER, secret).json(body)).await
}

pub(crate) async fn answer(request: RequestBuilder) -> (u16, Value) {
    let answer = request.timeout(PATIENCE).send().await.unwrap();
    let status = answer.status().as_u16();
    let bytes = answer.bytes().await.unwrap();
    let text = || Value::String(String::from_utf8_lossy(&bytes).into_owned());
    (status, serde_json::from_slice(&bytes).unwrap_or_else(|_| text()))
}

pub(crate) fn code(answer: &(u16, Value)) -> (u16, &str) {
    (answer.0, answer.1["code"].as_str().unwrap_or_default())
}

impl Worker {
    pub(crate) async fn join(site: &Site, token_of: &str, name: &str) -> Self {
        let secret = format!("the-secret-of-a-process-of-{name}-{token_of}");
        let (status, answer) = post(&site.server(token_of), &secret, "/v1/workers", &join_of(name)).await;
        assert_eq!(status, 200, "{answer}");
        let joined: Joined = serde_json::from_value(answer).unwrap();
        let process = Process { worker: name.into(), incarnation: joined.incarnation };
        Self { server: site.server(token_of), name: name.to_owned(), secret, process }
    }

    pub(crate) fn poll_path(&self) -> String {
        format!("/v1/workers/{}/poll", self.name)
    }

    pub(crate) fn poll_of(&self, ready: Vec<protocol::TaskId>, version: u64) -> Poll {
        Poll { incarnation: self.process.incarnation, doing: vec![], ready, version, leaving: false }
    }

    pub(crate) async fn try_poll(&self) -> (u16, Value) {
        post(&self.server, &self.secret, &self.poll_path(), &self.poll_of(vec![], 0)).await
    }

    /// The current assignments.
    pub(crate) async fn holds(&self) -> Vec<Assignment> {
        let (status, answer) = self.try_poll().await;
        assert_eq!(status, 200, "{answer}");
        serde_json::from_value::<DesiredAssignments>(answer).unwrap().assignments
    }

    /// Polls until it gets a task of `stage`.
    pub(crate) async fn given(&self, stage: &str) -> Assignment {
        let (mut version, mut ready, asked) = (0, vec![], Instant::now());
        loop {
            assert!(asked.elapsed() < PATIENCE, "`{stage}` is not given");
            let poll = self.poll_of(ready, version);
            let (status, answer) = post(&self.server, &self.secret, &self.poll_path(), &poll).await;
            assert_eq!(status, 200, "{answer}");
            let desired: DesiredAssignments = serde_json::from_value(answer).unwrap();
            version = desired.version;
            ready = desired.prepare.into_iter().map(|prepare| prepare.task).collect();
            if let Some(found) = desired.assignments.into_iter().find(|found| found.stage.name.as_str() == stage) {
                return found;
            }
        }
    }

    /// Uploads a blob under a grant.
    pub(crate) async fn put(&self, assignment: &Assignment, bytes: &[u8]) -> BlobStored {
        let (status, answer) = answer(self.put_request(&assignment.grant, &assignment.secret, bytes)).await;
        assert_eq!(status, 200, "{answer}");
        serde_json::from_value(answer).unwrap()
    }

    pub(crate) fn put_request(&self, grant: &Grant, secret: &str, bytes: &[u8]) -> RequestBuilder {
        let request = self.server.request(Method::PUT, &format!("/v1/blobs/{}", Digest::of(bytes)));
        let request = request.header(GRANT_HEADER, serde_json::to_string(grant).unwrap());
        request.header(SECRET_HEADER, secret).header("x-stride-bytes", bytes.len()).body(bytes.to_vec())
    }

    /// Uploads a manifest with one file; returns the manifest's digest and both receipts.
    pub(crate) async fn artifact(
        &self,
        assignment: &Assignment,
        kind: ArtifactKind,
        file: &[u8],
    ) -> (Digest, BTreeMap<Digest, String>) {
        let stored = self.put(assignment, file).await;
        let mut manifest = Manifest::new(kind, serde_json::json!({}));
        manifest.files.insert("file".into(), FileEntry::of_blob(stored.digest, file.len() as u64));
        let whole = self.put(assignment, &manifest.to_bytes()).await;
        let receipts = [stored, whole.clone()].map(|stored| (stored.digest, stored.receipt.unwrap()));
        (whole.digest, receipts.into())
    }

    pub(crate) async fn finish(
        &self,
        assignment: &Assignment,
        output: Digest,
        receipts: BTreeMap<Digest, String>,
    ) -> (u16, Value) {
        let outcome = TaskOutcome::Finished { output, metrics: BTreeMap::new() };
        let report = ReportOutcome::new(assignment.grant.clone(), outcome);
        post(&self.server, &assignment.secret, "/v1/outcomes", &Vouched { what: report, receipts }).await
    }

    /// Reads a blob and returns the status.
    pub(crate) async fn read(&self, digest: Digest) -> u16 {
        answer(self.read_request(digest, &self.secret)).await.0
    }

    pub(crate) fn read_request(&self, digest: Digest, secret: &str) -> RequestBuilder {
        let request = self.server.request(Method::GET, &format!("/v1/blobs/{digest}")).header(SECRET_HEADER, secret);
        request.header(PROCESS_HEADER, serde_json::to_string(&self.process).unwrap())
    }
}
