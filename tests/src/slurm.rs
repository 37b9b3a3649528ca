//! A real Slurm on this machine, started by the scripts of the shared folder.

use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::sync::atomic::{AtomicU32, Ordering};
use std::time::{Duration, Instant};

/// A Slurm below a folder of its own. It ends with this value.
#[derive(Debug)]
pub struct Slurm {
    dir: tempfile::TempDir,
    scripts: PathBuf,
}

impl Slurm {
    /// Starts a cluster of up to three nodes; `None` with a notice where it cannot run. Nothing is installed.
    ///
    /// # Panics
    /// Under CI if the scripts are missing.
    pub fn start(nodes: u32) -> Option<Self> {
        let shared = std::env::var_os("STRIDE_SHARED")
            .map_or_else(|| Path::new(env!("CARGO_MANIFEST_DIR")).join("../../shared"), PathBuf::from);
        let scripts = shared.join("engines");
        if !scripts.join("slurm-up.sh").is_file() {
            let missing = format!("no slurm-up.sh in {}; set STRIDE_SHARED", scripts.display());
            assert!(std::env::var_os("CI").is_none(), "{missing}");
            fixtures::skip(&missing);
            return None;
        }
        let is_missing = |program: &&&str| {
            let search = format!("command -v {program}");
            let found = Command::new("sh").args(["-c", &search]).stdout(Stdio::null()).status();
            !found.is_ok_and(|status| status.success())
        };
        let programs = ["munged", "slurmctld", "slurmd", "sbatch", "squeue", "scancel"];
        let missing: Vec<_> = programs.iter().filter(is_missing).collect();
        if !missing.is_empty() || !nix::unistd::geteuid().is_root() {
            fixtures::skip(&format!(
                "no Slurm here: it needs root and the Debian packages slurm-wlm and munge (missing programs: {missing:?})"
            ));
            return None;
        }
        let slurm = Self { dir: tempfile::tempdir().expect("a folder"), scripts };
        // Below the ports that the system gives to clients. Two clusters of a process may run at once.
        static STARTED: AtomicU32 = AtomicU32::new(0);
        let port = 20_000 + std::process::id() % 1_000 * 10 + STARTED.fetch_add(1, Ordering::SeqCst) % 2 * 5;
        let mut up = slurm.script("slurm-up.sh");
        up.env("N", nodes.to_string()).env("CTLD", port.to_string()).env("BASE", (port + 1).to_string());
        // Its daemons keep the output open, so it goes to a file.
        let log = std::fs::File::create(slurm.dir.path().join("up.log")).expect("a file");
        up.stderr(log.try_clone().expect("a handle")).stdout(log);
        let status = up.status().expect("bash runs");
        let said = std::fs::read_to_string(slurm.dir.path().join("up.log")).unwrap_or_default();
        if !status.success() {
            fixtures::skip(&format!("Slurm does not start on this machine:\n{said}"));
            return None;
        }
        Some(slurm)
    }

    /// The value of `SLURM_CONF` with which commands find the cluster.
    pub fn configuration(&self) -> PathBuf {
        self.dir.path().join("slurm.conf")
    }

    /// Runs one of Slurm's commands and returns its output, without the last line break.
    ///
    /// # Errors
    /// What it says if it fails.
    pub fn ask(&self, program: &str, arguments: &[&str]) -> Result<String, String> {
        let mut command = Command::new(program);
        command.args(arguments).env("SLURM_CONF", self.configuration()).stdin(Stdio::null());
        let output = command.output().map_err(|error| format!("{program}: {error}"))?;
        let text = |bytes: &[u8]| String::from_utf8_lossy(bytes).trim_end().to_owned();
        if output.status.success() { Ok(text(&output.stdout)) } else { Err(text(&output.stderr)) }
    }

    /// The process of a daemon: `slurmctld`, or `slurmd.n1` of a node.
    ///
    /// # Panics
    /// If it was not started.
    pub fn pid(&self, daemon: &str) -> u32 {
        let file = self.dir.path().join(format!("{daemon}.pid"));
        let number = std::fs::read_to_string(&file).expect("a daemon writes its number");
        number.trim().parse().expect("a number")
    }

    /// Starts the controller again after its end.
    ///
    /// # Panics
    /// If it does not start.
    pub fn start_controller(&self) {
        let configuration = self.configuration();
        let status = Command::new("slurmctld").arg("-f").arg(configuration).stdin(Stdio::null()).status();
        assert!(status.expect("slurmctld runs").success(), "the controller starts again");
    }

    /// Entries of the running daemons in `/proc`.
    fn daemons(&self) -> Vec<PathBuf> {
        let dir = self.dir.path();
        let files = std::fs::read_dir(dir).into_iter().flatten().flatten().map(|entry| entry.path());
        let files = files.filter(|path| path.extension().is_some_and(|end| end == "pid"));
        let numbers = files.chain([dir.join("munge/pid")]).filter_map(|file| std::fs::read_to_string(file).ok());
        numbers.map(|number| Path::new("/proc").join(number.trim())).collect()
    }

    fn script(&self, name: &str) -> Command {
        let mut command = Command::new("bash");
        command.arg(self.scripts.join(name)).env("D", self.dir.path()).env_remove("SLURM_CONF").stdin(Stdio::null());
        command
    }
}

impl Drop for Slurm {
    fn drop(&mut self) {
        // The daemons need the folder until they have ended.
        let daemons = self.daemons();
        let _ = self.script("slurm-down.sh").status();
        let begun = Instant::now();
        while daemons.iter().any(|process| process.exists()) && begun.elapsed() < Duration::from_secs(20) {
            std::thread::sleep(Duration::from_millis(50));
        }
    }
}
