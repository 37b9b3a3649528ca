//! A coordinator and workers as processes of their own, as on several machines: `trainer serve` and `trainer worker join`.

use std::collections::BTreeMap;
use std::fs;
use std::io::{self, Read, Write};
use std::net::{SocketAddr, TcpListener, TcpStream};
use std::os::unix::fs::PermissionsExt as _;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::time::Duration;

use nix::sys::signal::Signal;
use serde_json::Value;

use crate::{Bench, PATIENCE, Running, signal, wait_for, wait_within};

/// What the coordinator wants to be shown.
pub const TOKEN: &str = "a-token-of-tests-only";
/// The token of all workers, which allows nothing else.
pub const WORKER_TOKEN: &str = "a-token-of-workers-of-tests-only";
/// The least time of a training step, in milliseconds: 400 steps take ten seconds on the fastest machine, and a test finds a middle.
const PACE: &str = "25";

/// An answer of the coordinator.
#[derive(Debug, Clone)]
pub struct Reply {
    /// HTTP status.
    pub status: u16,
    /// The body; `null` if it is not JSON.
    pub body: Value,
}

/// A coordinator, its workers, and one store.
#[derive(Debug)]
pub struct Cluster {
    bench: Bench,
    address: SocketAddr,
    server: Option<Running>,
    workers: BTreeMap<String, Running>,
}

impl Cluster {
    /// A coordinator on a free port of this machine, with an empty store.
    pub fn start(trainer: &str) -> Self {
        Self::listen(trainer, Self::free_address())
    }

    /// A port of this machine that nobody uses.
    pub fn free_address() -> SocketAddr {
        let free = TcpListener::bind("127.0.0.1:0").expect("a free port");
        free.local_addr().expect("bound")
    }

    /// The same at a chosen address.
    pub fn listen(trainer: &str, address: SocketAddr) -> Self {
        Self::listen_on(trainer, address, None)
    }

    /// The same with its store in a chosen folder.
    pub fn listen_on(trainer: &str, address: SocketAddr, store: Option<&Path>) -> Self {
        let bench = Bench::new(trainer).with_token(TOKEN);
        fs::create_dir_all(bench.path().join("logs")).expect("a folder for logs");
        if let Some(store) = store {
            std::os::unix::fs::symlink(store, bench.store()).expect("a link to the store");
        }
        let mut cluster = Self { bench, address, server: None, workers: BTreeMap::new() };
        cluster.serve();
        cluster
    }

    /// The folder and the command line.
    pub fn bench(&self) -> &Bench {
        &self.bench
    }

    /// Where the coordinator listens.
    pub fn address(&self) -> SocketAddr {
        self.address
    }

    /// The same as a URL.
    pub fn url(&self) -> String {
        format!("http://{}", self.address)
    }

    fn log(&self, who: &str) -> PathBuf {
        self.bench.path().join("logs").join(format!("{who}.log"))
    }

    /// All that a process wrote so far, over all its lives.
    pub fn said(&self, who: &str) -> String {
        fs::read(self.log(who)).map_or_else(|_| String::new(), |bytes| String::from_utf8_lossy(&bytes).into_owned())
    }

    fn spawn(&self, who: &str, wrap: &[String], arguments: &[&str]) -> Running {
        let trainer = self.bench.command(arguments);
        let mut command = match wrap.split_first() {
            None => trainer,
            Some((first, rest)) => {
                let mut command = Command::new(first);
                command.args(rest).arg(trainer.get_program()).args(trainer.get_args());
                command.current_dir(self.bench.path()).stdin(Stdio::null()).env("NO_COLOR", "1");
                command
            }
        };
        match arguments.first() {
            Some(&"worker") => command.env("STRIDE_TOKEN", WORKER_TOKEN),
            // The server has a file of both.
            _ => command.env_remove("STRIDE_TOKEN"),
        };
        command.env("STRIDE_WORKER_PACE", PACE);
        Running::logged(&mut command, &self.log(who))
    }

    /// Starts the coordinator, again if it was there before, and waits until it answers.
    pub fn serve(&mut self) {
        let address = self.address.to_string();
        let tokens = self.bench.path().join("tokens");
        fs::write(&tokens, format!("admin admin {TOKEN}\nworkers worker {WORKER_TOKEN}\n")).expect("a token file");
        fs::set_permissions(&tokens, fs::Permissions::from_mode(0o600)).expect("ours");
        let tokens = tokens.display().to_string();
        let mut arguments = vec!["serve", "--bind", &address, "--token-file", &tokens];
        if !self.address.ip().is_loopback() {
            arguments.push("--insecure");
        }
        let mut server = self.spawn("serve", &[], &arguments);
        wait_for("the coordinator to answer", || {
            assert!(server.alive(), "the coordinator ended:\n{}", self.said("serve"));
            self.get("/v1/health")
        });
        self.server = Some(server);
    }

    /// `kill -9` of the coordinator; it is gone when this returns.
    pub fn kill_server(&mut self) {
        if let Some(mut server) = self.server.take() {
            server.kill();
            server.wait();
        }
    }

    /// Whether the coordinator's process runs.
    pub fn serving(&mut self) -> bool {
        self.server.as_mut().is_some_and(Running::alive)
    }

    /// The coordinator's process id, while it is there.
    pub fn server(&self) -> Option<u32> {
        self.server.as_ref().map(Running::pid)
    }

    /// Starts a worker; one of that name that has ended is replaced.
    pub fn join(&mut self, name: &str) {
        self.join_by(name, &[], &[]);
    }

    /// Starts a worker with more arguments, and something before its command.
    pub fn join_by(&mut self, name: &str, wrap: &[String], more: &[&str]) {
        self.join_at(&self.url(), name, wrap, more);
    }

    /// The same by another way to the coordinator.
    pub fn join_at(&mut self, url: &str, name: &str, wrap: &[String], more: &[&str]) {
        let mut arguments = vec!["worker", "join", url, "--name", name];
        arguments.extend_from_slice(more);
        if !self.address.ip().is_loopback() {
            arguments.push("--insecure");
        }
        let folder = self.bench.path().display().to_string();
        if !more.contains(&"--data-root") {
            arguments.extend(["--data-root", &folder]);
        }
        let worker = self.spawn(name, wrap, &arguments);
        if let Some(mut old) = self.workers.insert(name.to_owned(), worker) {
            assert!(!old.alive(), "worker {name} was replaced while it ran");
        }
    }

    /// A worker's process id.
    pub fn pid(&self, name: &str) -> u32 {
        self.workers[name].pid()
    }

    /// Whether a worker's process runs.
    pub fn alive(&mut self, name: &str) -> bool {
        self.workers.get_mut(name).is_some_and(Running::alive)
    }

    /// A signal to a worker.
    pub fn signal(&self, name: &str, which: Signal) {
        signal(self.pid(name), which);
    }

    /// `kill -9` of a worker; it is gone when this returns.
    pub fn kill(&mut self, name: &str) {
        if let Some(mut worker) = self.workers.remove(name) {
            worker.kill();
            worker.wait();
        }
    }

    /// Waits for a worker to end by itself and gives its exit code.
    pub fn ended(&mut self, name: &str) -> Option<i32> {
        self.workers.remove(name).expect("a worker of that name").wait().code
    }

    /// One call; an error if nobody answers.
    pub fn call(&self, method: &str, path: &str, headers: &[(&str, &str)], body: &[u8]) -> io::Result<Reply> {
        self.call_as(TOKEN, method, path, headers, body)
    }

    /// The same with another token.
    pub fn call_as(
        &self,
        token: &str,
        method: &str,
        path: &str,
        headers: &[(&str, &str)],
        body: &[u8],
    ) -> io::Result<Reply> {
        let mut stream = TcpStream::connect_timeout(&self.address, Duration::from_secs(5))?;
        stream.set_read_timeout(Some(Duration::from_secs(30)))?;
        let mut head = format!("{method} {path} HTTP/1.1\r\nhost: localhost\r\nconnection: close\r\n");
        head += &format!("authorization: Bearer {token}\r\n");
        for (name, value) in headers {
            head += &format!("{name}: {value}\r\n");
        }
        head += &format!("content-length: {}\r\n\r\n", body.len());
        stream.write_all(head.as_bytes())?;
        stream.write_all(body)?;
        let mut answer = Vec::new();
        stream.read_to_end(&mut answer)?;
        let end = answer.windows(4).position(|w| w == b"\r\n\r\n");
        let end = end.ok_or_else(|| io::Error::new(io::ErrorKind::UnexpectedEof, "no head"))? + 4;
        let status = String::from_utf8_lossy(&answer[9..12]).parse().map_err(io::Error::other)?;
        Ok(Reply { status, body: serde_json::from_slice(&answer[end..]).unwrap_or(Value::Null) })
    }

    /// A call with a JSON body.
    pub fn post(&self, path: &str, body: &Value) -> io::Result<Reply> {
        self.call("POST", path, &[("content-type", "application/json")], body.to_string().as_bytes())
    }

    /// What is at `path`; `None` if nobody answers or it is refused.
    pub fn get(&self, path: &str) -> Option<Value> {
        self.call("GET", path, &[], b"").ok().filter(|reply| reply.status == 200).map(|reply| reply.body)
    }

    /// Submits a pipeline and gives the run's name.
    #[track_caller]
    pub fn submit(&self, config: &Path, more: &[&str]) -> String {
        let (config, url) = (config.display().to_string(), self.url());
        let mut arguments = vec!["submit", &config, "--server", &url, "-o", "json"];
        if !self.address.ip().is_loopback() {
            arguments.push("--insecure");
        }
        arguments.extend_from_slice(more);
        let said = self.bench.run(&arguments).expect_code(0);
        said.json()["run"].as_str().expect("a run").to_owned()
    }

    /// The run as the API shows it, once the coordinator answers.
    #[track_caller]
    pub fn view(&self, run: &str) -> Value {
        wait_for("the coordinator to show the run", || self.get(&format!("/v1/runs/{run}")))
    }

    /// One stage of the run.
    #[track_caller]
    pub fn stage(&self, run: &str, stage: &str) -> Value {
        stage_of(&self.view(run), stage)
    }

    /// Waits until `stage` has done at least `steps`.
    #[track_caller]
    pub fn wait_step(&self, run: &str, stage: &str, steps: u64) {
        wait_for(&format!("stage {stage} to reach step {steps}"), || {
            let view = self.stage(run, stage);
            assert!(view["state"] != "failed", "{view:#}\n{}", self.everything());
            let over = matches!(view["state"].as_str(), Some("ran" | "resumed" | "cached"));
            (over || view["progress"]["done"].as_u64() >= Some(steps)).then_some(())
        });
    }

    /// Waits for the end of the run and gives it.
    #[track_caller]
    pub fn wait_end(&self, run: &str) -> Value {
        self.wait_end_within(PATIENCE, run)
    }

    /// The same on a machine that may take longer: one that compiles and tunes kernels first.
    #[track_caller]
    pub fn wait_end_within(&self, patience: Duration, run: &str) -> Value {
        let view = wait_within(patience, "the run to end", || {
            let view = self.view(run);
            let over = matches!(view["state"].as_str(), Some("finished" | "failed" | "cancelled"));
            over.then_some(view)
        });
        assert!(view["state"] != "failed", "{view:#}\n{}", self.everything());
        view
    }

    /// A stage's current values: key -> (step, value), every one of them.
    #[track_caller]
    pub fn metrics(&self, run: &str, stage: &str) -> BTreeMap<String, Vec<(u64, f64)>> {
        let path = format!("/v1/runs/{run}/metrics?stage={stage}&points=0");
        let all = self.get(&path).unwrap_or_else(|| panic!("no answer at {path}"));
        let curves = all[stage].as_object().cloned().unwrap_or_default();
        let point = |p: &Value| (p["step"].as_u64().expect("a step"), p["value"].as_f64().unwrap_or(f64::NAN));
        let points = |c: &Value| c["points"].as_array().expect("points").iter().map(point).collect();
        curves.iter().map(|(key, curve)| (key.clone(), points(curve))).collect()
    }

    /// A run's log rows.
    #[track_caller]
    pub fn logs(&self, run: &str) -> Vec<Value> {
        let (mut rows, mut after) = (Vec::new(), 0);
        loop {
            let page = self.get(&format!("/v1/runs/{run}/logs?after={after}&limit=1000")).expect("logs");
            let page = page.as_array().expect("rows").clone();
            let Some(last) = page.last() else { return rows };
            after = last["id"].as_i64().expect("an id");
            rows.extend(page);
        }
    }

    /// The ends of all logs, for a failed test.
    pub fn everything(&self) -> String {
        let mut text = String::new();
        for who in self.workers.keys().map(String::as_str).chain(["serve"]) {
            let said = self.said(who);
            let lines: Vec<&str> = said.lines().collect();
            text += &format!("--- {who}\n{}\n", lines[lines.len().saturating_sub(25)..].join("\n"));
        }
        text
    }

    /// Stops the coordinator and checks every blob and reference of its store.
    #[track_caller]
    pub fn fsck(&mut self) {
        self.kill_server();
        self.bench.run(&["registry", "fsck"]).expect_code(0);
    }
}

impl Drop for Cluster {
    fn drop(&mut self) {
        // A stopped process takes no other signal but this.
        for worker in self.workers.values_mut() {
            worker.kill();
        }
        if std::thread::panicking() {
            eprintln!("{}", self.everything());
        }
    }
}

/// One stage of a run's view.
#[track_caller]
pub fn stage_of(view: &Value, stage: &str) -> Value {
    let stages = view["stages"].as_array().expect("`stages` is a list");
    stages.iter().find(|s| s["name"] == stage).unwrap_or_else(|| panic!("no stage {stage} in {view:#}")).clone()
}
