//! The worker processes of `trainer run`: started, watched, restarted when they die, and ended.

use std::path::{Path, PathBuf};
use std::process::Stdio;
use std::time::{Duration, Instant};

use access::Token;
use coordinator::Handle;
use protocol::stage::Backend;
use protocol::{WorkerId, labels};
use tokio::process::{Child, Command};

use crate::local::out_of_memory::Watch;
use crate::report::problem::{Problem, Result};

/// A shorter life counts as an early death.
const SHORT_LIFE: Duration = Duration::from_secs(5);
/// Bytes of a dead worker's log that are read; a backtrace may follow the relevant message.
const LAST_WORDS: usize = 256 << 10;
/// Consecutive early deaths after which the worker is given up.
const EARLY_DEATHS: u32 = 5;

/// A worker with its process, if one is running.
#[derive(Debug)]
struct Member {
    name: WorkerId,
    backend: Backend,
    device: usize,
    label: Option<&'static str>,
    child: Option<Child>,
    since: Instant,
    /// Offset of the current process in the log, which all processes of the worker share.
    log_from: u64,
    early_deaths: u32,
    next_start: Instant,
}

/// The workers of a run.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Crew {
    /// Number of workers for all stages.
    pub(crate) count: usize,
    pub(crate) backend: Backend,
    /// Keeps one more worker for draws, so that they are made while all others train.
    pub(crate) draws: bool,
}

/// All worker processes of a run.
#[derive(Debug)]
pub(crate) struct Fleet {
    members: Vec<Member>,
    url: String,
    token: Token,
    store: PathBuf,
    logs: PathBuf,
    memory: Watch,
}

/// The death of a worker process.
#[derive(Debug)]
pub(crate) struct Death {
    pub(crate) worker: WorkerId,
    /// Explanation if the process died for lack of memory.
    pub(crate) out_of_memory: Option<String>,
}

impl Fleet {
    /// Starts workers for `coordinator`, which holds `store`. Their logs are in its folder `workers`.
    pub(crate) fn start(crew: &Crew, coordinator: &Handle, store: &Path) -> Result<Self> {
        let logs = store.join("workers");
        // Logs are optional: without the folder, the workers' output is discarded.
        let _ = std::fs::create_dir_all(&logs);
        let now = Instant::now();
        let devices = device_count(crew.backend);
        let member = |name: String, backend: Backend, device: usize, label: Option<&'static str>| Member {
            name: WorkerId::new(name),
            backend,
            device,
            label,
            child: None,
            since: now,
            log_from: 0,
            early_deaths: 0,
            next_start: now,
        };
        let mut members: Vec<Member> =
            (0..crew.count).map(|i| member(format!("w{}", i + 1), crew.backend, i % devices.max(1), None)).collect();
        if crew.draws {
            // On the CPU, so that a training keeps the memory of its GPU.
            members.push(member("draws".to_owned(), Backend::default(), 0, Some(labels::ONLY_DRAWS)));
        }
        let (url, token) = (coordinator.local_url(), coordinator.worker_token().clone());
        let mut fleet = Self { members, url, token, store: store.to_owned(), logs, memory: Watch::new() };
        for i in 0..fleet.members.len() {
            fleet.spawn(i)?;
        }
        Ok(fleet)
    }

    fn spawn(&mut self, i: usize) -> Result<()> {
        let program = std::env::current_exe().map_err(|error| {
            Problem::failed(format!("cannot find the path of this program to start workers: {error}"))
        })?;
        let log = self.log(&self.members[i].name);
        let stderr =
            std::fs::OpenOptions::new().create(true).append(true).open(&log).map_or(Stdio::null(), Stdio::from);
        let member = &mut self.members[i];
        member.log_from = std::fs::metadata(&log).map_or(0, |log| log.len());
        let child = Command::new(program)
            .args(["worker", "join", &self.url, "--name", member.name.as_str(), "--die-with-parent", "--any-file"])
            .args(["--backend", member.backend.name(), "--device", &member.device.to_string(), "--store"])
            .arg(&self.store)
            .args(member.label.iter().flat_map(|label| ["--label", label]))
            // Not an argument, because every user of the machine can read arguments.
            .env("STRIDE_TOKEN", self.token.secret())
            // Our own settings are for another server.
            .env_remove("STRIDE_TOKEN_FILE")
            .env_remove("STRIDE_CA")
            .env_remove("STRIDE_DATA_ROOT")
            .stdin(Stdio::null())
            .stdout(Stdio::null())
            .stderr(stderr)
            // Ctrl-C in the terminal is for this process, which tells the workers.
            .process_group(0)
            .kill_on_drop(true)
            .spawn()
            .map_err(|error| Problem::failed(format!("cannot start worker `{}`: {error}", member.name)))?;
        member.child = Some(child);
        member.since = Instant::now();
        Ok(())
    }

    fn log(&self, worker: &WorkerId) -> PathBuf {
        self.logs.join(format!("{worker}.log"))
    }

    /// Collects dead workers and restarts them when their pause is over. Returns the deaths.
    pub(crate) fn reap(&mut self, restart: bool) -> Result<Vec<Death>> {
        let mut dead = Vec::new();
        self.memory.look();
        let now = Instant::now();
        for i in 0..self.members.len() {
            let member = &mut self.members[i];
            match &mut member.child {
                Some(child) => {
                    let Ok(Some(status)) = child.try_wait() else { continue };
                    member.child = None;
                    let said = last_words(&self.logs.join(format!("{}.log", member.name)), member.log_from);
                    let out_of_memory = self.memory.explain(status, &said);
                    dead.push(Death { worker: member.name.clone(), out_of_memory });
                    let early = now - member.since < SHORT_LIFE;
                    member.early_deaths = if early { member.early_deaths + 1 } else { 0 };
                    member.next_start = now + if early { Duration::from_millis(500) } else { Duration::ZERO };
                    tracing::info!(worker = %member.name, %status, "worker ended");
                    if restart && member.early_deaths >= EARLY_DEATHS {
                        let (name, log) = (member.name.clone(), self.log(&self.members[i].name));
                        let said = last_lines(&last_words(&log, 0), 5);
                        return Err(Problem::failed(format!(
                            "worker `{name}` died {EARLY_DEATHS} times right after its start ({status})\n{said}"
                        ))
                        .hint(format!("its log is `{}`", log.display())));
                    }
                }
                None if restart && member.next_start <= now => self.spawn(i)?,
                None => {}
            }
        }
        Ok(dead)
    }

    /// Returns true if a worker is running.
    pub(crate) fn is_alive(&self) -> bool {
        self.members.iter().any(|member| member.child.is_some())
    }

    /// Kills all workers and tells the coordinator. Only for the case that their results are no longer needed.
    pub(crate) async fn kill(&mut self, coordinator: &Handle) {
        for child in self.members.iter_mut().filter_map(|member| member.child.as_mut()) {
            // It may have ended already.
            let _ = child.start_kill();
        }
        for member in &mut self.members {
            if let Some(mut child) = member.child.take() {
                let _ = child.wait().await;
            }
        }
        for member in &self.members {
            // One that never joined is unknown. The store otherwise lists the others as idle until their leases end.
            let _ = coordinator.worker_gone(&member.name).await;
        }
    }
}

/// The end of a file's text after offset `from`.
pub(crate) fn last_words(path: &Path, from: u64) -> String {
    let bytes = std::fs::read(path).unwrap_or_default();
    let from = usize::try_from(from).unwrap_or(usize::MAX).clamp(bytes.len().saturating_sub(LAST_WORDS), bytes.len());
    String::from_utf8_lossy(&bytes[from..]).into_owned()
}

/// The last `count` lines of a text.
pub(crate) fn last_lines(text: &str, count: usize) -> String {
    let lines: Vec<&str> = text.lines().collect();
    lines[lines.len().saturating_sub(count)..].join("\n")
}

/// Default number of workers of a backend: one per core on CPU, one per device on GPU.
pub(crate) fn default_size(backend: Backend) -> usize {
    if backend.is_cpu() {
        return std::thread::available_parallelism().map_or(1, usize::from);
    }
    device_count(backend)
}

/// Devices of a backend, at least 1. A worker that opens a backend without devices reports the error.
fn device_count(backend: Backend) -> usize {
    let here = |device: &models::device::DeviceInfo| device.backend == backend && device.index.is_some();
    models::device::available().iter().filter(|device| here(device)).count().max(1)
}
