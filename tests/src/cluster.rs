//! A coordinator and workers as separate processes, as on several machines: `trainer serve` and `trainer worker join`.

use std::collections::BTreeMap;
use std::fs;
use std::io::{self, Read, Write};
use std::net::{SocketAddr, TcpListener, TcpStream};
use std::os::unix::fs::PermissionsExt as _;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::time::{Duration, Instant};

use nix::sys::signal::Signal;
use serde_json::{Value, json};

use crate::bucket::Bucket;
use crate::{Bench, PATIENCE, Running, signal, wait_for, wait_within};

/// The coordinator's admin token.
pub const TOKEN: &str = "a-token-of-tests-only";
/// The token of all workers, which allows nothing else.
pub const WORKER_TOKEN: &str = "a-token-of-workers-of-tests-only";
/// The token of another user, who may submit and promote. Its runs are of another group.
pub const OTHER_TOKEN: &str = "a-token-of-another-of-tests-only";
/// Minimum time of a training step, in milliseconds. 400 steps take at least ten seconds, so a test can act in the
/// middle.
const PACE: &str = "25";

/// A response of the coordinator.
#[derive(Debug, Clone)]
pub struct Reply {
    /// HTTP status.
    pub status: u16,
    /// The body; a text if it is not JSON.
    pub body: Value,
}

/// A coordinator, its workers, and one store.
#[derive(Debug)]
pub struct Cluster {
    bench: Bench,
    address: SocketAddr,
    server: Option<Running>,
    /// Arguments of each server besides address and tokens.
    of_servers: Vec<String>,
    stand_by: Option<Running>,
    /// Address of the server that stands by.
    second: Option<SocketAddr>,
    workers: BTreeMap<String, Running>,
}

impl Cluster {
    /// Starts a coordinator on a free port of this machine, with an empty store.
    pub fn start(trainer: &str) -> Self {
        Self::listen(trainer, Self::free_address())
    }

    /// Finds a free port of this machine.
    pub fn free_address() -> SocketAddr {
        let free = TcpListener::bind("127.0.0.1:0").expect("a free port");
        free.local_addr().expect("bound")
    }

    /// Like [`start`](Self::start), at a chosen address.
    pub fn listen(trainer: &str, address: SocketAddr) -> Self {
        Self::listen_on(trainer, address, None)
    }

    /// Like [`listen`](Self::listen), with its store in a chosen folder.
    pub fn listen_on(trainer: &str, address: SocketAddr, store: Option<&Path>) -> Self {
        let bench = Bench::new(trainer).with_token(TOKEN);
        fs::create_dir_all(bench.path().join("logs")).expect("a folder for logs");
        if let Some(store) = store {
            std::os::unix::fs::symlink(store, bench.store()).expect("a link to the store");
        }
        Self::serving_with(bench, address, &[])
    }

    /// Like [`start`](Self::start), with more arguments for its servers.
    pub fn start_with(trainer: &str, arguments: &[&str]) -> Self {
        let bench = Bench::new(trainer).with_token(TOKEN);
        fs::create_dir_all(bench.path().join("logs")).expect("a folder for logs");
        Self::serving_with(bench, Self::free_address(), arguments)
    }

    /// Like [`start`](Self::start), with its blobs in a bucket. Workers get no credentials of the bucket.
    pub fn on_bucket(trainer: &str, bucket: &Bucket, prefix: &str) -> Self {
        Self::on_bucket_with(trainer, bucket, prefix, &[])
    }

    /// Like [`on_bucket`](Self::on_bucket), with more arguments for its servers.
    pub fn on_bucket_with(trainer: &str, bucket: &Bucket, prefix: &str, arguments: &[&str]) -> Self {
        let bench = Bench::new(trainer).with_token(TOKEN).with_environment(bucket.environment());
        fs::create_dir_all(bench.path().join("logs")).expect("a folder for logs");
        let blobs = Bucket::url(prefix);
        Self::serving_with(bench, Self::free_address(), &[&["--blobs", &blobs], arguments].concat())
    }

    fn serving_with(bench: Bench, address: SocketAddr, arguments: &[&str]) -> Self {
        let of_servers = arguments.iter().map(|argument| (*argument).to_owned()).collect();
        let (server, stand_by, second, workers) = (None, None, None, BTreeMap::new());
        let mut cluster = Self { bench, address, server, of_servers, stand_by, second, workers };
        cluster.serve();
        cluster
    }

    /// The folder and the command line.
    pub fn bench(&self) -> &Bench {
        &self.bench
    }

    /// Address of the coordinator.
    pub fn address(&self) -> SocketAddr {
        self.address
    }

    /// URL of the coordinator.
    pub fn url(&self) -> String {
        format!("http://{}", self.address)
    }

    fn log(&self, who: &str) -> PathBuf {
        self.bench.path().join("logs").join(format!("{who}.log"))
    }

    /// Everything that all processes of this name have written so far.
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
            Some(&"worker") => {
                for name in self.bench.environment() {
                    command.env_remove(name);
                }
                command.env("STRIDE_TOKEN", WORKER_TOKEN)
            }
            // The server has a file with both tokens.
            _ => command.env_remove("STRIDE_TOKEN"),
        };
        command.env("STRIDE_WORKER_PACE", PACE);
        Running::logged(&mut command, &self.log(who))
    }

    /// Starts or restarts the coordinator and waits until it answers.
    pub fn serve(&mut self) {
        let mut server = self.spawn_server("serve", self.address, &[]);
        wait_for("the coordinator to answer", || {
            assert!(server.alive(), "the coordinator ended:\n{}", self.said("serve"));
            self.get("/v1/health")
        });
        self.server = Some(server);
    }

    /// Starts a second server, which stands by at another address, and waits until it does. Workers that join later
    /// know both addresses.
    pub fn stand_by(&mut self, arguments: &[&str]) {
        let address = Self::free_address();
        self.second = Some(address);
        self.stand_by = Some(self.spawn_server("stand-by", address, &[&["--stand-by"], arguments].concat()));
        wait_for("the second server to stand by", || self.said("stand-by").contains("standing by").then_some(()));
    }

    /// Kills the coordinator with `kill -9` and returns the time until the second server answers.
    pub fn fail_over(&mut self) -> Duration {
        self.kill_server();
        let gone = Instant::now();
        self.server = self.stand_by.take();
        self.address = self.second.take().expect("a second server");
        wait_for("the second server to answer", || self.get("/v1/health"));
        gone.elapsed()
    }

    fn spawn_server(&self, who: &str, address: SocketAddr, more: &[&str]) -> Running {
        let address = address.to_string();
        let tokens = self.bench.path().join("tokens");
        let lines = format!("admin admin {TOKEN}\nworkers worker {WORKER_TOKEN}\nother submit,promote {OTHER_TOKEN}\n");
        fs::write(&tokens, lines).expect("a token file");
        fs::set_permissions(&tokens, fs::Permissions::from_mode(0o600)).expect("ours");
        let tokens = tokens.display().to_string();
        let mut arguments = vec!["serve", "--bind", &address, "--token-file", &tokens];
        if !self.address.ip().is_loopback() {
            arguments.push("--insecure");
        }
        arguments.extend(self.of_servers.iter().map(String::as_str));
        arguments.extend(more);
        self.spawn(who, &[], &arguments)
    }

    /// Kills the coordinator with `kill -9` and waits for its end.
    pub fn kill_server(&mut self) {
        if let Some(mut server) = self.server.take() {
            server.kill();
            server.wait();
        }
    }

    /// Returns true if the coordinator's process is running.
    pub fn serving(&mut self) -> bool {
        self.server.as_mut().is_some_and(Running::alive)
    }

    /// The coordinator's process id while it is running.
    pub fn server(&self) -> Option<u32> {
        self.server.as_ref().map(Running::pid)
    }

    /// Starts a worker; replaces one of that name that has ended.
    pub fn join(&mut self, name: &str) {
        self.join_by(name, &[], &[]);
    }

    /// Starts a worker with more arguments, by a wrapping command.
    pub fn join_by(&mut self, name: &str, wrap: &[String], more: &[&str]) {
        self.join_at(&self.urls(), name, wrap, more);
    }

    /// Starts a launcher of workers, by a wrapping command. It is signalled, killed and heard like a worker.
    pub fn launch(&mut self, name: &str, wrap: &[String], engine: &str, options: &[&str]) {
        let secret = |file: &str, token: &str| {
            let path = self.bench.path().join(file);
            fs::write(&path, token).expect("a token file");
            fs::set_permissions(&path, fs::Permissions::from_mode(0o600)).expect("ours");
            path.display().to_string()
        };
        let (own, workers) = (secret("launcher.token", TOKEN), secret("workers.token", WORKER_TOKEN));
        let urls = self.urls();
        let mut arguments = vec!["launch", engine, "--server", &urls, "--token-file", &own];
        arguments.extend(["--worker-token-file", &workers, "--name", name]);
        arguments.extend_from_slice(options);
        let launcher = self.spawn(name, wrap, &arguments);
        self.workers.insert(name.to_owned(), launcher);
    }

    /// The addresses of the server and of its stand-by, if it has one.
    fn urls(&self) -> String {
        self.second.iter().fold(self.url(), |urls, second| format!("{urls},http://{second}"))
    }

    /// Like [`join_by`](Self::join_by), with another URL of the coordinator.
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

    /// The process id of a worker.
    pub fn pid(&self, name: &str) -> u32 {
        self.workers[name].pid()
    }

    /// Returns true if a worker's process is running.
    pub fn alive(&mut self, name: &str) -> bool {
        self.workers.get_mut(name).is_some_and(Running::alive)
    }

    /// Sends a signal to a worker.
    pub fn signal(&self, name: &str, which: Signal) {
        signal(self.pid(name), which);
    }

    /// Kills a worker with `kill -9` and waits for its end.
    pub fn kill(&mut self, name: &str) {
        if let Some(mut worker) = self.workers.remove(name) {
            worker.kill();
            worker.wait();
        }
    }

    /// Waits for a worker to end by itself and returns its exit code.
    pub fn ended(&mut self, name: &str) -> Option<i32> {
        self.workers.remove(name).expect("a worker of that name").wait().code
    }

    /// Sends one call; an error if there is no answer.
    pub fn call(&self, method: &str, path: &str, headers: &[(&str, &str)], body: &[u8]) -> io::Result<Reply> {
        self.call_as(TOKEN, method, path, headers, body)
    }

    /// Like [`call`](Self::call), with another token.
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
        let text = || Value::String(String::from_utf8_lossy(&answer[end..]).into_owned());
        Ok(Reply { status, body: serde_json::from_slice(&answer[end..]).unwrap_or_else(|_| text()) })
    }

    /// Sends a call with a JSON body.
    pub fn post(&self, path: &str, body: &Value) -> io::Result<Reply> {
        self.call("POST", path, &[("content-type", "application/json")], body.to_string().as_bytes())
    }

    /// Gets the value at `path`; `None` if there is no answer or the call is refused.
    pub fn get(&self, path: &str) -> Option<Value> {
        self.call("GET", path, &[], b"").ok().filter(|reply| reply.status == 200).map(|reply| reply.body)
    }

    /// Submits a pipeline and returns the run's name.
    #[track_caller]
    pub fn submit(&self, config: &Path, more: &[&str]) -> String {
        self.submit_as(TOKEN, config, more)
    }

    /// Like [`submit`](Self::submit), with another token.
    #[track_caller]
    pub fn submit_as(&self, token: &str, config: &Path, more: &[&str]) -> String {
        let (config, url) = (config.display().to_string(), self.url());
        let mut arguments = vec!["submit", &config, "--server", &url, "-o", "json"];
        if !self.address.ip().is_loopback() {
            arguments.push("--insecure");
        }
        arguments.extend_from_slice(more);
        let mut command = self.bench.command(&arguments);
        command.env("STRIDE_TOKEN", token);
        let said = Running::start(command).wait().expect_code(0);
        said.json()["run"].as_str().expect("a run").to_owned()
    }

    /// The run as the API returns it, once the coordinator answers.
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

    /// Waits for the end of the run and returns it.
    #[track_caller]
    pub fn wait_end(&self, run: &str) -> Value {
        self.wait_end_within(PATIENCE, run)
    }

    /// Like [`wait_end`](Self::wait_end), for a machine that first compiles and tunes kernels.
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

    /// Cancels a run that has shown what it should.
    #[track_caller]
    pub fn cancel(&self, run: &str) {
        let reply = self.post(&format!("/v1/runs/{run}/cancel"), &json!({})).expect("answered");
        assert_eq!(reply.status, 200, "{:#}", reply.body);
        self.wait_end(run);
    }

    /// All current values of a stage: key -> (step, value).
    #[track_caller]
    pub fn metrics(&self, run: &str, stage: &str) -> BTreeMap<String, Vec<(u64, f64)>> {
        let path = format!("/v1/runs/{run}/metrics?stage={stage}&limit=10000");
        let all = self.get(&path).unwrap_or_else(|| panic!("no answer at {path}"));
        let curves = all[stage].as_object().cloned().unwrap_or_default();
        let point = |p: &Value| (p["step"].as_u64().expect("a step"), p["value"].as_f64().unwrap_or(f64::NAN));
        let points = |c: &Value| c["points"].as_array().expect("points").iter().map(point).collect();
        curves.iter().map(|(key, curve)| (key.clone(), points(curve))).collect()
    }

    /// All log rows of a run.
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
        // A stopped process handles no other signal.
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
