//! A real Slurm on this machine, started by the scripts of the shared folder.

use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::time::{Duration, Instant};

/// A Slurm below a folder of its own. It ends with this value.
#[derive(Debug)]
pub struct Slurm {
    dir: tempfile::TempDir,
    scripts: PathBuf,
}

impl Slurm {
    /// Starts a cluster of `nodes` nodes; `None` with a notice where it cannot run. Nothing is installed.
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
        // Below the ports that the system gives to clients.
        let port = 20_000 + std::process::id() % 1_000 * 10;
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
