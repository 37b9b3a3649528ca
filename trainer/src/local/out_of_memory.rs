//! Detects that a worker died for lack of memory.
//!
//! Such a death is final, because the next try would need as much. It is detected in two cases:
//! - The worker was aborted because an allocation failed, which its log shows.
//! - The worker was killed, and the kernel's count of out-of-memory kills has just risen.
//!
//! Only the parent of a process can detect this. A worker on another machine that dies this way is a lost worker like
//! any other.

use std::fs;
use std::os::unix::process::ExitStatusExt;
use std::path::PathBuf;
use std::process::ExitStatus;
use std::time::{Duration, Instant};

use nix::sys::signal::Signal;

/// Longest time for a killed process to free its memory and end.
const RECENT: Duration = Duration::from_secs(10);

/// The kernel's count of out-of-memory kills.
#[derive(Debug)]
pub(crate) struct Watch {
    source: Option<PathBuf>,
    seen: u64,
    risen: Option<Instant>,
}

impl Watch {
    /// Starts with the current count.
    pub(crate) fn new() -> Self {
        let source = sources().into_iter().find(|path| count(path).is_some());
        let seen = source.as_ref().and_then(count).unwrap_or_default();
        Self { source, seen, risen: None }
    }

    /// Reads the count. Call it more often than processes die.
    pub(crate) fn look(&mut self) {
        let now = self.source.as_ref().and_then(count).unwrap_or(self.seen);
        if now > self.seen {
            self.risen = Some(Instant::now());
        }
        self.seen = now;
    }

    /// Explains a death for lack of memory, from a process's exit status and its output. `None` if it died otherwise or
    /// the cause is unknown.
    pub(crate) fn explain(&self, status: ExitStatus, said: &str) -> Option<String> {
        explain(status, said, self.risen.is_some_and(|risen| risen.elapsed() < RECENT))
    }
}

fn explain(status: ExitStatus, said: &str, kernel_killed: bool) -> Option<String> {
    const ADVICE: &str = "use more `batch.slices`, a smaller `batch.global` or `network`, fewer workers (`--workers`), or a machine with more memory";
    let signal = Signal::try_from(status.signal()?).ok()?;
    match signal {
        Signal::SIGABRT => {
            // The message of Rust's runtime, the last output of such a process.
            let refused = said.lines().rev().find_map(|line| line.split_once("memory allocation of "))?.1;
            let (bytes, _) = refused.split_once(" bytes failed")?;
            Some(format!("is out of memory: an allocation of {bytes} bytes was refused; {ADVICE}"))
        }
        Signal::SIGKILL if kernel_killed => Some(format!("is out of memory: the kernel killed it; {ADVICE}")),
        _ => None,
    }
}

/// Possible files of the count, nearest first: our own control group's, which the workers share, then the machine's.
fn sources() -> Vec<PathBuf> {
    let groups = fs::read_to_string("/proc/self/cgroup").unwrap_or_default();
    let mut paths = Vec::new();
    for line in groups.lines() {
        let mut parts = line.splitn(3, ':').skip(1);
        let (controllers, group) = (parts.next().unwrap_or_default(), parts.next().unwrap_or_default());
        if controllers.is_empty() {
            paths.push(format!("/sys/fs/cgroup{group}/memory.events"));
        } else if controllers.split(',').any(|controller| controller == "memory") {
            paths.push(format!("/sys/fs/cgroup/memory{group}/memory.oom_control"));
        }
    }
    paths.push("/proc/vmstat".to_owned());
    paths.into_iter().map(PathBuf::from).collect()
}

fn count(path: &PathBuf) -> Option<u64> {
    let text = fs::read_to_string(path).ok()?;
    text.lines().find_map(|line| line.strip_prefix("oom_kill ")?.trim().parse().ok())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_what_can_be_known_is_said() {
        let by = |signal: Signal| ExitStatus::from_raw(signal as i32);
        let refused = "one line\nmemory allocation of 4096 bytes failed\n";
        let said = explain(by(Signal::SIGABRT), refused, false).expect("an allocation was refused");
        assert!(said.contains("4096 bytes"), "{said}");
        assert!(explain(by(Signal::SIGKILL), "", true).is_some());
        // Killed by another process; aborted for another reason; crashed; exited by itself with that output.
        assert_eq!(explain(by(Signal::SIGKILL), refused, false), None);
        assert_eq!(explain(by(Signal::SIGABRT), "stack overflow", true), None);
        assert_eq!(explain(by(Signal::SIGSEGV), refused, true), None);
        assert_eq!(explain(ExitStatus::from_raw(1 << 8), refused, true), None);
    }

    #[test]
    fn a_rise_of_the_count_is_noticed_and_remembered() {
        let dir = tempfile::tempdir().expect("a folder");
        let path = dir.path().join("memory.events");
        let write = |kills: u64| fs::write(&path, format!("low 0\noom 3\noom_kill {kills}\noom_group_kill 0\n"));
        write(2).expect("written");
        let mut watch = Watch { source: Some(path.clone()), seen: 2, risen: None };
        watch.look();
        assert_eq!(watch.risen, None);
        write(3).expect("written");
        watch.look();
        watch.look();
        assert!(watch.risen.is_some_and(|risen| risen.elapsed() < RECENT));
        assert!(watch.explain(ExitStatus::from_raw(Signal::SIGKILL as i32), "").is_some());
    }

    #[test]
    fn a_linux_machine_has_a_count() {
        assert!(!cfg!(target_os = "linux") || Watch::new().source.is_some());
    }
}
