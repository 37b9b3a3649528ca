//! Starts, watches and kills real trainers.
//!
//! Every test gets its own folder with its own store. This crate never sleeps for a fixed time. It waits for a
//! condition with a time limit, after which the test fails and prints the trainer's output.

pub mod book;
pub mod bucket;
pub mod cable;
pub mod cluster;
pub mod disk;
pub mod documented;
pub mod imports;
pub mod mounted;
pub mod network;
pub mod postgres;
pub mod slurm;
pub mod supply;

use std::collections::BTreeMap;
use std::fs::{self, File};
use std::io::Read;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, ExitStatus, Stdio};
use std::thread::{self, JoinHandle};
use std::time::{Duration, Instant};

use serde_json::Value;

/// Time limit of a condition on a busy machine.
pub const PATIENCE: Duration = Duration::from_secs(300);

/// A user's environment: a folder with a store, and the trainer binary.
#[derive(Debug)]
pub struct Bench {
    trainer: PathBuf,
    dir: tempfile::TempDir,
    token: Option<&'static str>,
    environment: Vec<(&'static str, String)>,
}

/// Output of a finished command.
#[derive(Debug)]
pub struct Said {
    /// Exit code; `None` after a signal.
    pub code: Option<i32>,
    /// Text on stdout.
    pub stdout: String,
    /// Text on stderr.
    pub stderr: String,
    /// Duration of the command.
    pub took: Duration,
}

impl Said {
    /// Parses the only JSON object on stdout.
    pub fn json(&self) -> Value {
        serde_json::from_str(&self.stdout).unwrap_or_else(|e| {
            panic!("stdout is not one JSON object ({e}):\n{}\n--- stderr\n{}", self.stdout, self.stderr)
        })
    }

    /// Panics with all output unless the exit code is `code`.
    #[track_caller]
    pub fn expect_code(self, code: i32) -> Self {
        assert_eq!(self.code, Some(code), "exit code; stderr:\n{}\n--- stdout\n{}", self.stderr, self.stdout);
        self
    }
}

impl Bench {
    /// Creates an empty folder. `trainer` is `env!("CARGO_BIN_EXE_trainer")`.
    pub fn new(trainer: &str) -> Self {
        let dir = tempfile::tempdir().expect("a temporary folder");
        Self { trainer: trainer.into(), dir, token: None, environment: Vec::new() }
    }

    /// Sets environment variables for every command.
    #[must_use]
    pub fn with_environment(self, environment: impl IntoIterator<Item = (&'static str, String)>) -> Self {
        Self { environment: environment.into_iter().collect(), ..self }
    }

    /// Names of the environment variables of every command.
    pub fn environment(&self) -> impl Iterator<Item = &'static str> {
        self.environment.iter().map(|(name, _)| *name)
    }

    /// Sets the token of every command and server.
    #[must_use]
    pub fn with_token(self, token: &'static str) -> Self {
        Self { token: Some(token), ..self }
    }

    /// The folder of the user.
    pub fn path(&self) -> &Path {
        self.dir.path()
    }

    /// The store that [`run`](Self::run) uses.
    pub fn store(&self) -> PathBuf {
        self.path().join(".stride")
    }

    /// The repository's root.
    pub fn repository() -> PathBuf {
        Path::new(env!("CARGO_MANIFEST_DIR")).parent().expect("tests/ lies in the repository").to_owned()
    }

    /// Path of a shipped pipeline.
    pub fn config(name: &str) -> String {
        Self::repository().join("configs").join(name).display().to_string()
    }

    /// Creates a command without starting it.
    pub fn command(&self, arguments: &[&str]) -> Command {
        let mut command = Command::new(&self.trainer);
        command.args(arguments).current_dir(self.path()).stdin(Stdio::null());
        command.env_remove("RUST_LOG").env("NO_COLOR", "1");
        command.envs(self.environment.iter().map(|(name, value)| (name, value)));
        if let Some(token) = self.token {
            command.env("STRIDE_TOKEN", token);
        }
        command
    }

    /// Runs a command to its end.
    pub fn run(&self, arguments: &[&str]) -> Said {
        self.spawn(arguments).wait()
    }

    pub fn spawn(&self, arguments: &[&str]) -> Running {
        Running::start(self.command(arguments))
    }

    /// Runs a shipped pipeline with `trainer run` and returns the JSON result.
    #[track_caller]
    pub fn pipeline(&self, config: &str, more: &[&str]) -> Value {
        let config = Self::config(config);
        let mut arguments = vec!["run", config.as_str(), "-o", "json"];
        arguments.extend_from_slice(more);
        self.run(&arguments).expect_code(0).json()
    }
}

/// A command that is running.
#[derive(Debug)]
pub struct Running {
    child: Child,
    stdout: Option<JoinHandle<String>>,
    stderr: Option<JoinHandle<String>>,
    since: Instant,
}

impl Running {
    /// Starts `command` and collects its output.
    pub fn start(mut command: Command) -> Self {
        let mut child = command.stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().expect("the trainer starts");
        let stdout = collect(child.stdout.take().expect("piped"));
        let stderr = collect(child.stderr.take().expect("piped"));
        Self { child, stdout: Some(stdout), stderr: Some(stderr), since: Instant::now() }
    }

    /// Starts `command` and appends all its output to a file.
    pub fn logged(command: &mut Command, log: &Path) -> Self {
        let file = append(log);
        let both = file.try_clone().expect("one file twice");
        let child = command.stdout(file).stderr(both).spawn().unwrap_or_else(|e| panic!("{command:?}: {e}"));
        Self { child, stdout: None, stderr: None, since: Instant::now() }
    }

    pub fn pid(&self) -> u32 {
        self.child.id()
    }

    /// Waits for the end.
    pub fn wait(mut self) -> Said {
        let deadline = Instant::now() + PATIENCE * 4;
        let status = loop {
            if let Some(status) = self.child.try_wait().expect("the child can be waited for") {
                break status;
            }
            if Instant::now() > deadline {
                self.kill();
            }
            thread::sleep(Duration::from_millis(5));
        };
        self.said(status)
    }

    fn said(&mut self, status: ExitStatus) -> Said {
        let text = |handle: &mut Option<JoinHandle<String>>| {
            handle.take().map_or_else(String::new, |h| h.join().unwrap_or_default())
        };
        Said {
            code: status.code(),
            stdout: text(&mut self.stdout),
            stderr: text(&mut self.stderr),
            took: self.since.elapsed(),
        }
    }

    /// Sends SIGKILL.
    pub fn kill(&mut self) {
        signal(self.child.id(), nix::sys::signal::Signal::SIGKILL);
    }

    /// Sends a signal.
    pub fn signal(&self, signal_: nix::sys::signal::Signal) {
        signal(self.child.id(), signal_);
    }

    /// Returns true if the process is running.
    pub fn alive(&mut self) -> bool {
        self.child.try_wait().expect("the child can be waited for").is_none()
    }

    /// Its worker processes, by the names they were started with.
    pub fn workers(&self) -> BTreeMap<String, u32> {
        let mut found = BTreeMap::new();
        for entry in fs::read_dir("/proc").expect("/proc").flatten() {
            let Some(pid) = entry.file_name().to_str().and_then(|name| name.parse::<u32>().ok()) else { continue };
            let Ok(stat) = fs::read_to_string(entry.path().join("stat")) else { continue };
            let Some((_, rest)) = stat.rsplit_once(") ") else { continue };
            let mut fields = rest.split(' ');
            let (state, parent) = (fields.next(), fields.next().and_then(|p| p.parse::<u32>().ok()));
            if parent != Some(self.child.id()) || state == Some("Z") {
                continue;
            }
            let Ok(line) = fs::read(entry.path().join("cmdline")) else { continue };
            let words: Vec<_> = line.split(|b| *b == 0).map(|w| String::from_utf8_lossy(w).into_owned()).collect();
            if let Some(at) = words.iter().position(|w| w == "--name") {
                found.insert(words[at + 1].clone(), pid);
            }
        }
        found
    }
}

impl Drop for Running {
    fn drop(&mut self) {
        if matches!(self.child.try_wait(), Ok(None)) {
            self.kill();
            drop(self.child.wait());
        }
    }
}

fn collect(mut pipe: impl Read + Send + 'static) -> JoinHandle<String> {
    thread::spawn(move || {
        let mut bytes = Vec::new();
        // A killed process closes its pipe early; the text before that is its output.
        drop(pipe.read_to_end(&mut bytes));
        String::from_utf8_lossy(&bytes).into_owned()
    })
}

/// Opens a log for appending.
pub(crate) fn append(path: &Path) -> File {
    let file = fs::OpenOptions::new().create(true).append(true).open(path);
    file.unwrap_or_else(|e| panic!("{}: {e}", path.display()))
}

/// Sends a signal; ignores a process that has ended.
pub fn signal(pid: u32, signal: nix::sys::signal::Signal) {
    let pid = nix::unistd::Pid::from_raw(i32::try_from(pid).expect("a pid"));
    let _gone = nix::sys::signal::kill(pid, signal);
}

/// Waits until `condition` returns a value.
#[track_caller]
pub fn wait_for<T>(what: &str, condition: impl FnMut() -> Option<T>) -> T {
    wait_within(PATIENCE, what, condition)
}

/// Like [`wait_for`], with another time limit.
#[track_caller]
pub fn wait_within<T>(patience: Duration, what: &str, mut condition: impl FnMut() -> Option<T>) -> T {
    let deadline = Instant::now() + patience;
    loop {
        if let Some(found) = condition() {
            return found;
        }
        assert!(Instant::now() < deadline, "gave up waiting for {what}");
        thread::sleep(Duration::from_millis(10));
    }
}

/// The outputs of all stages: stage -> name -> digest.
pub fn digests(report: &Value) -> BTreeMap<String, Value> {
    let stages = report["stages"].as_array().expect("`stages` is a list");
    stages.iter().map(|stage| (stage["name"].as_str().expect("`name`").to_owned(), stage["outputs"].clone())).collect()
}

/// The states of all stages by name.
pub fn states(report: &Value) -> BTreeMap<String, String> {
    let stages = report["stages"].as_array().expect("`stages` is a list");
    let text = |v: &Value| v.as_str().expect("a text").to_owned();
    stages.iter().map(|stage| (text(&stage["name"]), text(&stage["state"]))).collect()
}
