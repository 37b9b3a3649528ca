//! A server with two projects and a token of every kind.

use std::collections::BTreeMap;
use std::os::unix::fs::PermissionsExt as _;

use access::{Server, Tokens};
use coordinator::{Config, Coordinator, Handle};
use protocol::message::{Assignment, DesiredAssignments, Joined, LogBatch, Poll, Submit};
use protocol::proof::SECRET_HEADER;
use protocol::{ArtifactKind, Digest, Manifest, Owner, RunId};
use registry::{Holder, Store, Write};
use reqwest::{Method, StatusCode};
use serde_json::{Value, json};

use crate::front::{self, Protocol};
use crate::shell::{SECRET, offer};
use crate::tls::{Files, authority};
use crate::workers::bystanders::PATIENCE;

pub(crate) type TestResult<T = ()> = Result<T, Box<dyn std::error::Error + Send + Sync>>;

/// Text to search for in answers to other owners. Names, settings, logs and metrics of the project `motion` contain it.
pub(crate) const CANARY: &str = "zq4711";

/// A line of the token file, with its expected permissions.
pub(crate) struct Kind {
    pub(crate) name: &'static str,
    scopes: &'static str,
    more: &'static str,
    pub(crate) sees: &'static [Project],
    pub(crate) controls: &'static [Project],
    /// Projects whose protected alias it may move.
    pub(crate) moves_prod: &'static [Project],
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) enum Project {
    Motion,
    Speech,
}
use Project::{Motion, Speech};

impl Project {
    pub(crate) const ALL: [Self; 2] = [Motion, Speech];

    pub(crate) fn model(self) -> String {
        match self {
            Motion => format!("{CANARY}-walks"),
            Speech => "talks".to_owned(),
        }
    }
}

/// All kinds of tokens. The expected permissions are listed here and compared with the server's behaviour.
#[rustfmt::skip]
pub(crate) const KINDS: [Kind; 11] = [
    Kind { name: "root",  scopes: "admin",          more: "",               sees: &[Motion, Speech], controls: &[Motion, Speech], moves_prod: &[Motion, Speech] },
    Kind { name: "alice", scopes: "submit,promote", more: "project=motion", sees: &[Motion],         controls: &[Motion],         moves_prod: &[] },
    Kind { name: "anna",  scopes: "submit",         more: "project=motion", sees: &[Motion],         controls: &[Motion],         moves_prod: &[] },
    Kind { name: "bob",   scopes: "submit,promote", more: "project=speech", sees: &[Speech],         controls: &[Speech],         moves_prod: &[] },
    Kind { name: "ben",   scopes: "submit,promote", more: "project=speech", sees: &[Speech],         controls: &[Speech],         moves_prod: &[Speech] },
    Kind { name: "rita",  scopes: "read",           more: "project=speech", sees: &[Speech],         controls: &[],               moves_prod: &[] },
    Kind { name: "carol", scopes: "read,submit",    more: "",               sees: &[Motion, Speech], controls: &[],               moves_prod: &[] },
    Kind { name: "paul",  scopes: "read,promote",   more: "",               sees: &[Motion, Speech], controls: &[],               moves_prod: &[Motion, Speech] },
    Kind { name: "mona",  scopes: "submit,promote", more: "",               sees: &[],               controls: &[],               moves_prod: &[] },
    Kind { name: "node",  scopes: "worker",         more: "",               sees: &[],               controls: &[],               moves_prod: &[] },
    Kind { name: "lena",  scopes: "launch",         more: "",               sees: &[],               controls: &[],               moves_prod: &[] },
];

impl Kind {
    pub(crate) fn of(name: &str) -> &'static Self {
        KINDS.iter().find(|kind| kind.name == name).unwrap_or_else(|| panic!("no token `{name}`"))
    }

    /// The words of its line after the token.
    pub(crate) fn more(&self) -> &'static str {
        self.more
    }

    pub(crate) fn has(&self, scope: &str) -> bool {
        let implied = match scope {
            "read" => !matches!(self.scopes, "worker" | "launch"),
            _ => self.scopes == "admin",
        };
        implied || self.scopes.split(',').any(|word| word == scope)
    }
}

fn secret(name: &str) -> String {
    format!("token-of-{name}-0123456789")
}

/// The server with a run and a model of each project.
pub(crate) struct Lab {
    _dir: tempfile::TempDir,
    pub(crate) store: Store,
    pub(crate) handle: Handle,
    clients: BTreeMap<String, Server>,
    pub(crate) runs: BTreeMap<Project, RunId>,
    /// An artifact of each project.
    pub(crate) artifacts: BTreeMap<Project, Digest>,
}

/// Parses lines of a token file.
pub(crate) fn tokens(lines: &str) -> TestResult<Tokens> {
    let dir = tempfile::tempdir()?;
    let path = dir.path().join("tokens");
    std::fs::write(&path, lines)?;
    std::fs::set_permissions(&path, std::fs::Permissions::from_mode(0o600))?;
    Ok(Tokens::read(&path)?)
}

/// The lines of all kinds, some of which `change` modifies or removes.
pub(crate) fn lines(change: impl Fn(&Kind) -> Option<String>) -> String {
    let mut lines = "protect prod=paul,ben\n".to_owned();
    for kind in &KINDS {
        if let Some(more) = change(kind) {
            lines += &format!("{} {} {} {more}\n", kind.name, kind.scopes, secret(kind.name));
        }
    }
    lines
}

pub(crate) fn as_they_are(kind: &Kind) -> Option<String> {
    Some(kind.more.to_owned())
}

pub(crate) fn submission(text: &str) -> TestResult<Submit> {
    let pipeline = pipeline::read("p.yaml", text, &[]).map_err(|mistakes| mistakes.to_string())?;
    Ok(Submit { pipeline: serde_json::to_value(pipeline)?, source: text.into(), idempotency_key: None, until: None })
}

/// The pipeline of a project.
pub(crate) fn pipeline(project: Project) -> String {
    let (name, stage, seed) = match project {
        Motion => (format!("{CANARY}-pipeline"), format!("{CANARY}-vae"), 1),
        Speech => ("speech".to_owned(), "vae".to_owned(), 2),
    };
    format!("name: {name}\nseed: {seed}\ndataset: {{format: synthetic}}\nstages:\n  {stage}: {{kind: train.vae}}\n")
}

impl Lab {
    pub(crate) async fn new() -> TestResult<Self> {
        Self::over(Protocol::Http1).await
    }

    /// Like [`Lab::new`], with calls over `protocol`.
    pub(crate) async fn over(protocol: Protocol) -> TestResult<Self> {
        Self::start(50, protocol).await
    }

    /// Like [`Lab::new`], with polls that wait `poll_ms` for work.
    pub(crate) async fn waiting(poll_ms: u64) -> TestResult<Self> {
        Self::start(poll_ms, Protocol::Http1).await
    }

    async fn start(poll_ms: u64, protocol: Protocol) -> TestResult<Self> {
        let dir = tempfile::tempdir()?;
        let store = Store::open(dir.path(), Holder::this_process("a test")).await?;
        let mut config = Config { alone: false, park: false, ..Config::embedded() };
        config.tokens = tokens(&lines(as_they_are))?;
        config.policy.poll_ms = poll_ms;
        // The worker of this test is silent for long periods. It keeps its task after a pause or cancellation by the
        // owner too. Otherwise it would take the other project's task when the grace period ends, or the same stage of
        // another run of equal inputs, which even a paused run shows as running.
        config.policy.lease_ms = 3_600_000;
        config.policy.grace_ms = 3_600_000;
        let files = (protocol == Protocol::Http2).then(|| authority(dir.path(), "ours"));
        config.tls = files.as_ref().map(Files::server);
        let handle = Coordinator::start(store.clone(), config).await?;
        let url = match &files {
            Some(files) => front::open(handle.address(), &files.ca).await,
            None => handle.url(),
        };
        let client = |kind: &Kind| -> TestResult<(String, Server)> {
            let token = secret(kind.name).parse()?;
            Ok((kind.name.to_owned(), Server::new(&url, Some(token), None)?))
        };
        let clients = KINDS.iter().map(client).collect::<TestResult<_>>()?;
        let (runs, artifacts) = (BTreeMap::new(), BTreeMap::new());
        let mut lab = Self { _dir: dir, store, handle, clients, runs, artifacts };
        for (project, name) in [(Motion, "alice"), (Speech, "bob")] {
            let run = lab.submit(name, &submission(&pipeline(project))?).await?;
            lab.runs.insert(project, run.map_err(|(status, body)| format!("{status} {body}"))?);
            lab.register(project, name).await?;
        }
        lab.work().await?;
        Ok(lab)
    }

    /// Registers two versions of a project's model and moves both aliases to the first.
    async fn register(&mut self, project: Project, name: &str) -> TestResult {
        let kind = Kind::of(name);
        let owner = Owner {
            name: name.into(),
            project: kind.more.strip_prefix("project=").map(str::to_owned),
            ..Owner::default()
        };
        let (model, run) = (project.model(), self.runs[&project].clone());
        for version in [1, 2] {
            let meta = json!({"name": model, "version": version});
            let artifact = self.store.blobs().put(&Manifest::new(ArtifactKind::Model, meta).to_bytes())?;
            let metrics = BTreeMap::from([("fid".to_owned(), 1.0), (format!("{}fid", model), 2.0)]);
            let source = json!({"run": run, "stage": "release", "metric": "fid", "mode": "min"});
            let own = Write::ModelOwner { model: model.as_str().into(), owner: owner.clone() };
            let version = Write::Version { model: model.as_str().into(), artifact, metrics, source };
            self.store.write(vec![own, version]).await?;
            self.artifacts.entry(project).or_insert(artifact);
        }
        for alias in ["staging", "prod"] {
            let (status, answer) = self.registry("root", &promote(&model, 1, alias)).await?;
            assert!(status.is_success(), "{answer}");
        }
        Ok(())
    }

    /// Joins a worker that takes the first task, which belongs to `motion`, and sends a log line.
    async fn work(&mut self) -> TestResult {
        let joined: Joined =
            serde_json::from_value(self.call("node", "POST", "/v1/workers", &serde_json::to_value(offer())?).await?.1)?;
        let poll = Poll { incarnation: joined.incarnation, doing: vec![], ready: vec![], version: 0, leaving: false };
        let Assignment { grant, secret, .. } = loop {
            let answer = self.call("node", "POST", "/v1/workers/a/poll", &serde_json::to_value(&poll)?).await?;
            let desired: DesiredAssignments = serde_json::from_value(answer.1)?;
            if let Some(assignment) = desired.assignments.into_iter().next() {
                break assignment;
            }
        };
        assert!(grant.task.as_str().contains(CANARY), "the oldest run is served first: {}", grant.task);
        let lines = vec![format!("the log of {CANARY}")];
        let logs = serde_json::to_value(LogBatch { grant, first: 0, lines })?;
        assert_eq!(self.call_with(&secret, "node", "POST", "/v1/logs", &logs).await?.0, StatusCode::OK);
        Ok(())
    }

    /// Sends a call with the token of `name`.
    pub(crate) async fn call(
        &self,
        name: &str,
        method: &str,
        path: &str,
        body: &Value,
    ) -> TestResult<(StatusCode, Value)> {
        self.call_with(SECRET, name, method, path, body).await
    }

    /// Sends a worker's call with `secret`.
    async fn call_with(
        &self,
        secret: &str,
        name: &str,
        method: &str,
        path: &str,
        body: &Value,
    ) -> TestResult<(StatusCode, Value)> {
        let (status, text) = self.send_with(secret, name, method, path, &body.to_string()).await?;
        Ok((status, serde_json::from_str(&text).unwrap_or(Value::String(text))))
    }

    /// Like [`Lab::call`], with any body; returns the answer as text.
    pub(crate) async fn send(
        &self,
        name: &str,
        method: &str,
        path: &str,
        body: &str,
    ) -> TestResult<(StatusCode, String)> {
        self.send_with(SECRET, name, method, path, body).await
    }

    async fn send_with(
        &self,
        secret: &str,
        name: &str,
        method: &str,
        path: &str,
        body: &str,
    ) -> TestResult<(StatusCode, String)> {
        let request = self.clients[name].request(Method::from_bytes(method.as_bytes())?, path);
        let request = request.header("content-type", "application/json").header(SECRET_HEADER, secret);
        let request = if method == "GET" { request } else { request.body(body.to_owned()) };
        let answer = request.timeout(PATIENCE).send().await?;
        let status = answer.status();
        Ok((status, String::from_utf8_lossy(&answer.bytes().await?).into_owned()))
    }

    pub(crate) async fn submit(&self, name: &str, submit: &Submit) -> TestResult<Result<RunId, (StatusCode, String)>> {
        let (status, answer) = self.call(name, "POST", "/v1/runs", &serde_json::to_value(submit)?).await?;
        Ok(match answer["run"].as_str() {
            Some(run) if status.is_success() => Ok(run.into()),
            _ => Err((status, answer.to_string())),
        })
    }

    pub(crate) async fn registry(&self, name: &str, command: &Value) -> TestResult<(StatusCode, Value)> {
        self.call(name, "POST", "/v1/registry", command).await
    }

    pub(crate) fn client(&self, name: &str) -> &Server {
        &self.clients[name]
    }

    /// Like [`Lab::standing`], once grants that follow from earlier calls have been made: a resumed run is `ready` until
    /// the next decision gives its task to the worker.
    pub(crate) async fn settled(&self, project: Project) -> TestResult<String> {
        let mut last = self.standing(project).await?;
        for _ in 0..100 {
            tokio::time::sleep(std::time::Duration::from_millis(200)).await;
            let now = self.standing(project).await?;
            if now == last {
                return Ok(now);
            }
            last = now;
        }
        Err(format!("the view of {project:?} keeps changing: {last}").into())
    }

    /// All data of a project that others may not change.
    pub(crate) async fn standing(&self, project: Project) -> TestResult<String> {
        let run = &self.runs[&project];
        let mut view = self.call("root", "GET", &format!("/v1/runs/{run}"), &Value::Null).await?.1;
        for stage in view["stages"].as_array_mut().ok_or("stages")? {
            // Grows with time.
            stage["wall_s"] = Value::Null;
        }
        let history = self.registry("root", &json!({"command": "history", "model": project.model()})).await?.1;
        let shown = self.registry("root", &json!({"command": "show", "reference": project.model()})).await?.1;
        let logs = self.call("root", "GET", &format!("/v1/runs/{run}/logs"), &Value::Null).await?.1;
        Ok(format!("{view}\n{history}\n{shown}\n{logs}"))
    }
}

pub(crate) fn promote(model: &str, version: u64, alias: &str) -> Value {
    json!({
        "command": "promote", "reference": format!("{model}:{version}"), "to": alias, "expect": null, "require": [],
        "reason": "a test",
    })
}

pub(crate) fn rollback(model: &str, to: u64, alias: &str) -> Value {
    json!({"command": "rollback", "model": model, "alias": alias, "to": to, "expect": null, "reason": "a test"})
}
