//! Limits of runs and tokens: calls beyond them are refused, without effect on other callers.

use std::io::{Read, Write};
use std::net::{SocketAddr, TcpStream};
use std::path::Path;
use std::time::{Duration, Instant};

use access::{Scope, Scopes, Tokens};
use coordinator::{Allowances, Config, Connections, Coordinator, Handle};
use protocol::message::{
    ApiError, Assignment, DesiredAssignments, Joined, Listing, LogBatch, MetricBatch, MetricRow, Poll, RunSummary,
};
use protocol::proof::SECRET_HEADER;
use registry::{Holder, Store};
use serde::Serialize;
use serde::de::DeserializeOwned;

use crate::shell::{SECRET, offer, submission};

const READER: &str = "token-of-one-who-may-read";
const WORKER: &str = "token-of-one-who-may-work";
const SUBMITTER: &str = "token-of-one-who-may-submit";

async fn start(dir: &Path, connections: Connections, allowances: Allowances) -> Handle {
    let store = Store::open(dir, Holder::this_process("a test")).await.unwrap();
    let mut tokens = Tokens::default();
    for (token, scope) in [(READER, Scope::Read), (WORKER, Scope::Worker), (SUBMITTER, Scope::Submit)] {
        assert!(tokens.add(token, Scopes::of(&[scope]), &token.parse().unwrap()));
    }
    let mut config = Config { tokens, connections, allowances, alone: false, park: false, ..Config::embedded() };
    config.policy.poll_ms = 1;
    Coordinator::start(store, config).await.unwrap()
}

/// A persistent connection.
struct Caller {
    stream: TcpStream,
    token: &'static str,
    /// The secret of the process or of a grant.
    secret: String,
}

impl Caller {
    fn connect(address: SocketAddr, token: &'static str) -> Self {
        let stream = TcpStream::connect(address).unwrap();
        stream.set_read_timeout(Some(Duration::from_secs(30))).unwrap();
        Self { stream, token, secret: SECRET.to_owned() }
    }

    fn call(&mut self, method: &str, path: &str, body: &[u8]) -> (u16, Vec<u8>) {
        let (token, secret) = (self.token, &self.secret);
        let head = format!("authorization: Bearer {token}\r\n{SECRET_HEADER}: {secret}\r\n");
        let head = format!("{head}content-type: application/json\r\n");
        let length = body.len();
        let head = format!("{method} {path} HTTP/1.1\r\nhost: localhost\r\n{head}content-length: {length}\r\n\r\n");
        self.stream.write_all(&[head.as_bytes(), body].concat()).unwrap();
        let (mut answer, mut part) = (Vec::new(), [0; 4096]);
        loop {
            if let Some(end) = answer.windows(4).position(|bytes| bytes == b"\r\n\r\n") {
                let head = String::from_utf8_lossy(&answer[..end]).to_lowercase();
                let length: usize =
                    head.lines().find_map(|line| line.strip_prefix("content-length: ")).unwrap().parse().unwrap();
                if answer.len() >= end + 4 + length {
                    return (head[9..12].parse().unwrap(), answer[end + 4..].to_vec());
                }
            }
            let n = self.stream.read(&mut part).unwrap();
            assert!(n > 0, "the server hung up on {method} {path}");
            answer.extend_from_slice(&part[..n]);
        }
    }

    fn post<T: DeserializeOwned>(&mut self, path: &str, body: &impl Serialize) -> T {
        let (status, answer) = self.call("POST", path, &serde_json::to_vec(body).unwrap());
        assert_eq!(status, 200, "{path}: {}", String::from_utf8_lossy(&answer));
        serde_json::from_slice(&answer).unwrap()
    }

    fn refused(&mut self, path: &str, body: &impl Serialize) -> (u16, ApiError) {
        let (status, answer) = self.call("POST", path, &serde_json::to_vec(body).unwrap());
        (status, serde_json::from_slice(&answer).unwrap())
    }
}

/// Starts a worker that holds the first task of a run.
fn working(handle: &Handle) -> (Caller, Assignment) {
    let mut worker = Caller::connect(handle.address(), WORKER);
    Caller::connect(handle.address(), SUBMITTER).post::<serde_json::Value>("/v1/runs", &submission().unwrap());
    let joined: Joined = worker.post("/v1/workers", &offer());
    let poll = Poll { incarnation: joined.incarnation, doing: vec![], ready: vec![], version: 0, leaving: false };
    let begun = Instant::now();
    loop {
        let desired: DesiredAssignments = worker.post("/v1/workers/a/poll", &poll);
        if let Some(assignment) = desired.assignments.into_iter().next() {
            return (worker, assignment);
        }
        assert!(begun.elapsed() < Duration::from_secs(30), "no task came");
        std::thread::sleep(Duration::from_millis(5));
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn readers_hold_no_connection_that_workers_need() {
    let dir = tempfile::tempdir().unwrap();
    let connections = Connections { most: 32, anonymous: 8, clients: 16, of_token: 6, ..Connections::default() };
    let handle = start(dir.path(), connections, Allowances::default()).await;
    let address = handle.address();
    let read = |_| {
        let mut reader = Caller::connect(address, READER);
        let answer = reader.call("GET", "/v1/runs", b"");
        (reader, answer)
    };
    let (mut readers, answers): (Vec<_>, Vec<_>) = (0..6).map(read).unzip();
    assert!(answers.iter().all(|(status, _)| *status == 200));
    for (_, (status, answer)) in (0..30).map(read) {
        let error: ApiError = serde_json::from_slice(&answer).unwrap();
        let hint = error.hint.unwrap_or_default();
        assert_eq!(status, 429, "{}", error.message);
        assert!(error.message.contains("6 connections") && hint.contains("--max-connections-per-token"), "{hint}");
    }
    // All remaining connections are used by workers.
    let come = |_| {
        let mut worker = Caller::connect(address, WORKER);
        worker.post::<Joined>("/v1/workers", &offer());
        worker
    };
    let workers: Vec<Caller> = (0..20).map(come).collect();
    // A closed connection can be replaced.
    readers.pop();
    let again = (0..100).any(|_| {
        std::thread::sleep(Duration::from_millis(20));
        read(0).1.0 == 200
    });
    assert_eq!(workers.len(), 20);
    assert!(again, "a place that was given up is taken");
    handle.shutdown().await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_token_that_calls_too_often_waits_and_workers_do_not() {
    let dir = tempfile::tempdir().unwrap();
    let handle = start(dir.path(), Connections::default(), Allowances { calls: 2, ..Allowances::default() }).await;
    let mut reader = Caller::connect(handle.address(), READER);
    let told = (0..200).map(|_| reader.call("GET", "/v1/workers", b"")).find(|(status, _)| *status == 429).unwrap();
    let error: ApiError = serde_json::from_slice(&told.1).unwrap();
    assert!(error.hint.unwrap_or_default().contains("--max-calls-per-second"), "{}", error.message);
    let (mut worker, _) = working(&handle);
    for _ in 0..200 {
        worker.post::<Joined>("/v1/workers", &offer());
    }
    handle.shutdown().await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn one_live_run_too_many_is_told_to_come_again() {
    let dir = tempfile::tempdir().unwrap();
    let handle = start(dir.path(), Connections::default(), Allowances { runs: 3, ..Allowances::default() }).await;
    let mut submitter = Caller::connect(handle.address(), SUBMITTER);
    let submit = submission().unwrap();
    let runs: Vec<coordinator::shell::Submitted> = (0..3).map(|_| submitter.post("/v1/runs", &submit)).collect();
    let (status, error) = submitter.refused("/v1/runs", &submit);
    assert!(status == 429 && error.message.contains("at most 3"), "{status} {}", error.message);
    assert!(error.hint.unwrap_or_default().contains("--max-runs"));
    submitter.post::<serde_json::Value>(&format!("/v1/runs/{}/cancel", runs[0].run), &());
    submitter.post::<serde_json::Value>("/v1/runs", &submit);
    handle.shutdown().await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn runs_are_listed_in_parts() {
    let dir = tempfile::tempdir().unwrap();
    let handle = start(dir.path(), Connections::default(), Allowances::default()).await;
    let mut submitter = Caller::connect(handle.address(), SUBMITTER);
    let submit = submission().unwrap();
    let runs: Vec<String> = (0..7)
        .map(|i| {
            let submitted: coordinator::shell::Submitted = submitter.post("/v1/runs", &submit);
            if i % 2 == 0 {
                submitter.post::<serde_json::Value>(&format!("/v1/runs/{}/cancel", submitted.run), &());
            }
            submitted.run.to_string()
        })
        .collect();
    let mut reader = Caller::connect(handle.address(), READER);
    let mut list = |query: &str| {
        let (status, answer) = reader.call("GET", &format!("/v1/runs?{query}"), b"");
        assert_eq!(status, 200, "{query}");
        let list: Listing<RunSummary> = serde_json::from_slice(&answer).unwrap();
        let rows = list.items.iter().map(|row| serde_json::to_vec(row).unwrap().len());
        assert!(rows.max().unwrap_or_default() <= RunSummary::BYTES);
        (list.items.iter().map(|row| row.run.to_string()).collect::<Vec<_>>(), list.next)
    };
    let (newest, none) = list("limit=1000000");
    assert_eq!((newest.iter().rev().cloned().collect::<Vec<_>>(), none), (runs.clone(), None));
    for (query, expected) in [
        ("limit=3", newest.clone()),
        ("limit=2&sort=oldest", runs.clone()),
        ("limit=1&state=cancelled", newest.iter().step_by(2).cloned().collect()),
        ("limit=2&state=running,cancelled&pipeline=p", newest.clone()),
        (
            "limit=5&state=running&owner=token-of-one-who-may-submit",
            newest.iter().skip(1).step_by(2).cloned().collect(),
        ),
        ("limit=2&sort=changed&state=cancelled", newest.iter().step_by(2).cloned().collect()),
        ("limit=3&q=CANCEL+p-", Vec::new()),
        ("limit=3&q=submit+p-", newest.clone()),
        ("pipeline=q", Vec::new()),
        ("owner=@p", Vec::new()),
    ] {
        let (mut all, mut next) = list(query);
        while let Some(after) = next {
            let (more, further) = list(&format!("{query}&after={after}"));
            all.extend(more);
            next = further;
        }
        assert_eq!(all, expected, "{query}");
    }
    handle.shutdown().await;
}

fn bytes_of(dir: &Path) -> u64 {
    let files = std::fs::read_dir(dir).unwrap().map(|entry| entry.unwrap());
    files.filter(|file| file.path().is_file()).map(|file| file.metadata().unwrap().len()).sum()
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn short_log_lines_take_no_more_of_the_store_than_they_say() {
    let dir = tempfile::tempdir().unwrap();
    let allowances = Allowances { log_bytes: 4 << 20, values: 15_000, ..Allowances::default() };
    let handle = start(dir.path(), Connections::default(), allowances).await;
    let (mut worker, Assignment { grant, secret, .. }) = working(&handle);
    worker.secret = secret;
    let run = grant.task.as_str().split('/').next().unwrap().to_owned();
    let before = bytes_of(dir.path());
    // A megabyte of messages with lines of one byte.
    let mut sent = 0;
    for first in 0..26 {
        let batch = LogBatch { grant: grant.clone(), first: first * 10_000, lines: vec!["x".to_owned(); 10_000] };
        sent += serde_json::to_vec(&batch).unwrap().len() as u64;
        worker.post::<()>("/v1/logs", &batch);
    }
    let stored = bytes_of(dir.path()) - before;
    println!("{sent} bytes of lines sent, {stored} bytes stored, the log of the database included");
    assert!(stored < 5 * sent, "{sent} bytes became {stored}");
    let mut reader = Caller::connect(handle.address(), READER);
    let (status, answer) = reader.call("GET", &format!("/v1/runs/{run}/logs?after=259990&limit=1000000"), b"");
    let rows: Vec<registry::LogRow> = serde_json::from_slice(&answer).unwrap();
    assert_eq!((status, rows.len(), rows[9].line), (200, 10, 259_999));
    let (_, answer) = reader.call("GET", &format!("/v1/runs/{run}/logs?limit=1000000"), b"");
    let rows: Vec<registry::LogRow> = serde_json::from_slice(&answer).unwrap();
    assert_eq!(rows.len(), 10_000, "an answer has an end");

    // More than the limits of the run and of a batch.
    let long = LogBatch { grant: grant.clone(), first: 1_000_000, lines: vec!["y".repeat(1 << 20); 3] };
    let (status, error) = worker.refused("/v1/logs", &long);
    assert_eq!((status, error.code.as_str()), (413, "used-up"), "{}", error.message);
    assert!(error.hint.unwrap_or_default().contains("--max-log-mib"));
    let short = LogBatch { grant: grant.clone(), first: 2_000_000, lines: vec![String::new(); 10_001] };
    let (status, error) = worker.refused("/v1/logs", &short);
    assert!(status == 400 && error.message.contains("more than 10000 entries"), "{status} {}", error.message);
    let row = |step| MetricRow { step, key: "loss".into(), value: 0.5 };
    let values = |from: u64| MetricBatch { grant: grant.clone(), rows: (from..from + 10_000).map(row).collect() };
    worker.post::<()>("/v1/metrics", &values(0));
    let (status, error) = worker.refused("/v1/metrics", &values(10_000));
    assert_eq!((status, error.code.as_str()), (413, "used-up"), "{}", error.message);
    assert!(error.hint.unwrap_or_default().contains("--max-values"));
    handle.shutdown().await;
}
