//! A launcher with a real coordinator and real processes: on this machine, and on a real Slurm.
#![allow(clippy::unwrap_used, reason = "a test may panic")]

use std::fs;
use std::os::unix::fs::PermissionsExt as _;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::time::{Duration, Instant};

use access::{Scopes, Server, Token, Tokens};
use coordinator::{Config, Coordinator, Handle};
use launcher::hosts::Hosts;
use launcher::slurm::Slurm;
use launcher::worker_command::WorkerCommand;
use launcher::{EngineError, FollowError, Launcher, Plan, follow};
use protocol::message::{DesiredAssignments, Doing, Gone, Join, Joined, PROTOCOL_VERSION, Poll, Submit};
use protocol::proof::SECRET_HEADER;
use protocol::stage::Backend;
use protocol::{Labels, RunId};
use registry::{Holder, Store};
use reqwest::Method;
use tokio::signal::unix::{SignalKind, signal};
use tokio::task::JoinHandle;

const LAUNCHER: &str = "token-of-the-launcher-0123456789";
const WORKERS: &str = "token-of-the-workers-0123456789";
/// Longer than any wait of these tests should take.
const PATIENCE: Duration = Duration::from_secs(60);

/// A coordinator, and a program that acts as a worker.
struct Site {
    dir: tempfile::TempDir,
    handle: Handle,
    admin: Server,
}

impl Site {
    async fn start() -> Self {
        let dir = tempfile::tempdir().unwrap();
        let store = Store::open(&dir.path().join("store"), Holder::this_process("a test")).await.unwrap();
        let mut tokens = Tokens::default();
        tokens.add("launcher", "launch".parse::<Scopes>().unwrap(), &LAUNCHER.parse().unwrap());
        tokens.add("nodes", "worker".parse::<Scopes>().unwrap(), &WORKERS.parse().unwrap());
        let mut config = Config { tokens, alone: false, park: false, ..Config::embedded() };
        (config.policy.poll_ms, config.policy.lease_ms, config.policy.tick_ms) = (300, 3_000, 200);
        let handle = Coordinator::start(store, config).await.unwrap();
        let admin = Server::new(&handle.url(), Some(handle.token().clone()), None).unwrap();
        let site = Self { dir, handle, admin };
        site.write("nodes.token", WORKERS, 0o600);
        let this = std::env::current_exe().unwrap();
        let script = format!("#!/bin/sh\nexec '{}' --exact --nocapture -- acts_as_a_worker \"$@\"\n", this.display());
        site.write("trainer", &script, 0o755);
        site
    }

    fn path(&self, name: &str) -> PathBuf {
        self.dir.path().join(name)
    }

    fn write(&self, name: &str, text: &str, mode: u32) {
        fs::write(self.path(name), text).unwrap();
        fs::set_permissions(self.path(name), fs::Permissions::from_mode(mode)).unwrap();
    }

    fn worker_command(&self) -> WorkerCommand {
        WorkerCommand {
            program: self.path("trainer").display().to_string(),
            url: self.handle.url(),
            backend: Backend::Flex,
            labels: "gpu=none".parse().unwrap(),
            more: vec!["--token-file".into(), self.path("nodes.token").display().to_string()],
        }
    }

    /// Starts a launcher; dropping the handle does not end it.
    fn launch(&self, plan: Plan, engine: impl Launcher + 'static) -> JoinHandle<Result<(), FollowError>> {
        let server = Server::new(&self.handle.url(), Some(LAUNCHER.parse::<Token>().unwrap()), None).unwrap();
        tokio::spawn(async move { follow(&server, plan, &engine).await })
    }

    /// Submits a run with a task for one worker.
    async fn submit(&self, seed: usize) -> RunId {
        let text = format!(
            "name: p\nseed: {seed}\ndataset: {{format: synthetic}}\nstages: {{vae: {{kind: train.vae, requires: gpu=none}}}}\n"
        );
        let pipeline = pipeline::read("p.yaml", &text, &[]).unwrap();
        let pipeline = serde_json::to_value(pipeline).unwrap();
        let submit = Submit { pipeline, source: text, idempotency_key: None, until: Some("dataset".into()) };
        let sent = self.admin.request(Method::POST, "/v1/runs").json(&submit).send().await.unwrap();
        sent.error_for_status().unwrap().json::<coordinator::shell::Submitted>().await.unwrap().run
    }

    async fn cancel(&self, run: &RunId) {
        let sent = self.admin.request(Method::POST, &format!("/v1/runs/{run}/cancel")).json(&()).send().await.unwrap();
        assert!(sent.status().is_success());
    }

    /// Names of workers at work.
    fn working(&self) -> Vec<String> {
        let workers = self.handle.workers().into_iter().filter(|worker| worker.state == "working");
        workers.map(|worker| worker.worker.to_string()).collect()
    }

    fn joined(&self) -> usize {
        self.handle.workers().len()
    }

    async fn wait_for(&self, what: &str, mut condition: impl FnMut() -> bool) {
        let begun = Instant::now();
        while !condition() {
            assert!(begun.elapsed() < PATIENCE, "waited for {what}; workers: {:#?}", self.handle.workers());
            tokio::time::sleep(Duration::from_millis(50)).await;
        }
    }
}

fn plan(prefix: &str, max: usize) -> Plan {
    let labels = "gpu=none".parse().unwrap();
    let (idle, prefix) = (Duration::from_secs(1), prefix.to_owned());
    Plan { prefix, backend: Backend::Flex, labels, min: 0, max, idle, crashes: 3 }
}

async fn wait_for_no_jobs(engine: &impl Launcher) {
    let begun = Instant::now();
    loop {
        let jobs = engine.list().await;
        if jobs.as_ref().is_ok_and(|jobs| jobs.iter().all(|job| job.state.has_ended())) {
            return;
        }
        assert!(begun.elapsed() < PATIENCE, "{jobs:?}");
        tokio::time::sleep(Duration::from_millis(200)).await;
    }
}

/// A worker that joins, holds its tasks without computing, and leaves at SIGTERM. It acts only if the arguments of
/// `worker join` follow its name; the test itself passes.
#[tokio::test]
async fn acts_as_a_worker() {
    let words: Vec<String> = std::env::args().skip_while(|word| word != "join").collect();
    let Some(url) = words.get(1) else { return };
    let option = |name: &str| words.windows(2).find(|pair| pair[0] == name).map(|pair| pair[1].clone());
    let token = Token::from_file(Path::new(&option("--token-file").unwrap())).unwrap();
    let server = Server::new(url, Some(token), None).unwrap();
    let name = option("--name").unwrap();
    let labels: Labels = option("--label").into_iter().collect();
    let secret = format!("secret-of-{name}-{}", std::process::id());
    let post = |path: String| server.request(Method::POST, &path).header(SECRET_HEADER, &secret);
    let join = Join {
        protocol: PROTOCOL_VERSION,
        worker: name.as_str().into(),
        pid: std::process::id(),
        backend: Backend::Flex,
        instruction_set: "avx2".into(),
        code_versions: protocol::stage::StageSettings::code_versions(),
        peer_address: "127.0.0.1:1".into(),
        labels,
    };
    let answer = post("/v1/workers".into()).json(&join).send().await.unwrap();
    let joined: Joined = answer.error_for_status().unwrap().json().await.unwrap();
    let mut terminate = signal(SignalKind::terminate()).unwrap();
    let (mut doing, mut version) = (Vec::new(), 0);
    loop {
        let poll = Poll { incarnation: joined.incarnation, doing, ready: Vec::new(), version, leaving: false };
        let request = post(format!("/v1/workers/{name}/poll")).json(&poll).send();
        let answer = tokio::select! {
            answer = request => answer,
            _ = terminate.recv() => break,
        };
        // The test has ended without this worker.
        let Ok(answer) = answer else { return };
        let desired: DesiredAssignments = answer.error_for_status().unwrap().json().await.unwrap();
        version = desired.version;
        doing = desired.assignments.into_iter().map(|one| Doing::new(one.grant, Default::default())).collect();
    }
    let gone = Gone { incarnation: joined.incarnation };
    post(format!("/v1/workers/{name}/gone")).json(&gone).send().await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn processes_of_this_machine_follow_the_demand_and_outlive_their_launcher() {
    let site = Site::start().await;
    let prefix = format!("local-{}", std::process::id());
    let engine = || Hosts::local(site.worker_command(), format!("{prefix}-"), Duration::from_secs(20));
    let launcher = site.launch(plan(&prefix, 3), engine());
    let mut runs = vec![site.submit(1).await, site.submit(2).await];
    site.wait_for("two workers", || site.working().len() == 2).await;

    // Another one with the same labels only watches; both have room for more than is wanted.
    let second = site.launch(plan(&format!("{prefix}b"), 3), engine());
    tokio::time::sleep(Duration::from_secs(2)).await;
    assert_eq!(site.joined(), 2);
    second.abort();

    launcher.abort();
    let _ = launcher.await;
    let before = site.working();
    let launcher = site.launch(plan(&prefix, 3), engine());
    for seed in 3..6 {
        runs.push(site.submit(seed).await);
    }
    site.wait_for("a third worker, for the launcher counts two of an earlier one", || site.working().len() == 3).await;
    assert!(before.iter().all(|name| site.working().contains(name)), "{before:?}");
    tokio::time::sleep(Duration::from_secs(1)).await;
    assert_eq!(site.joined(), 3, "at most three, for five slots");

    for run in &runs {
        site.cancel(run).await;
    }
    wait_for_no_jobs(&engine()).await;
    site.wait_for("all to leave", || site.handle.workers().iter().all(|worker| worker.state == "gone")).await;
    launcher.abort();
    site.handle.shutdown().await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_launcher_without_its_scope_ends_with_the_reason() {
    let site = Site::start().await;
    let server = Server::new(&site.handle.url(), Some(WORKERS.parse::<Token>().unwrap()), None).unwrap();
    let engine = Hosts::local(site.worker_command(), "none-".into(), Duration::from_secs(20));
    let error = follow(&server, plan("none", 1), &engine).await.unwrap_err();
    assert!(error.to_string().contains("launch"), "{error}");
    site.handle.shutdown().await;
}

/// Runs the next test in a process whose commands find the cluster.
#[test]
fn jobs_of_a_real_slurm_follow_the_demand() {
    let Some(cluster) = cluster_tests::slurm::Slurm::start(3) else { return };
    let output = Command::new(std::env::current_exe().unwrap())
        .args(["--exact", "--nocapture", "on_the_slurm_of_the_environment"])
        .env("SLURM_CONF", cluster.configuration())
        .env("STRIDE_TEST_SLURM", cluster.configuration())
        .output()
        .unwrap();
    let said = String::from_utf8_lossy(&output.stdout).into_owned() + &String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success(), "{said}");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn on_the_slurm_of_the_environment() {
    let Some(cluster) = std::env::var_os("STRIDE_TEST_SLURM").map(PathBuf::from) else { return };
    let site = Site::start().await;
    let engine = |limit: u64| Slurm {
        worker: site.worker_command(),
        options: vec![format!("--output={}/%j.log", site.dir.path().display()), "--mem=100".into()],
        limit: Duration::from_secs(limit),
    };
    let launcher = site.launch(plan("slurm", 3), engine(20));
    let runs = [site.submit(1).await, site.submit(2).await];
    site.wait_for("two jobs at work", || site.working().len() == 2).await;
    let jobs = engine(20).list().await.unwrap();
    assert_eq!(jobs.len(), 2, "{jobs:?}");

    // A job that its user or a preemption ends is replaced, and its worker leaves in good order.
    let lost = jobs[0].clone();
    assert!(Command::new("scancel").arg(&lost.id).status().unwrap().success());
    let left = |site: &Site| {
        let workers = site.handle.workers();
        workers.iter().any(|worker| worker.worker.as_str() == lost.worker && worker.state == "gone")
    };
    site.wait_for("the cancelled worker to leave", || left(&site)).await;
    site.wait_for("another job in its place", || site.working().len() == 2).await;

    // A controller that hangs, as it does for a while after a crash, delays one call by its limit and no more.
    let controller = fs::read_to_string(cluster.with_file_name("slurmctld.pid")).unwrap().trim().to_owned();
    let signal = |which: &str| assert!(Command::new("kill").args([which, &controller]).status().unwrap().success());
    signal("-STOP");
    let begun = Instant::now();
    let error = engine(1).list().await.unwrap_err();
    let refused = engine(1).submit("slurm-x-001").await.unwrap_err();
    signal("-CONT");
    assert!(matches!(error, EngineError::Hangs { .. }) && matches!(refused, EngineError::Hangs { .. }), "{error}");
    assert!(begun.elapsed() < Duration::from_secs(20), "{:?}", begun.elapsed());
    assert_eq!(site.working().len(), 2, "workers go on without the controller");

    for run in &runs {
        site.cancel(run).await;
    }
    wait_for_no_jobs(&engine(20)).await;
    launcher.abort();
    site.handle.shutdown().await;
}
