//! Processes on machines without an engine: this one, or others by ssh.
//!
//! The list of processes is the list of jobs: a worker is found by its name on its command line. So a restarted launcher
//! counts what an earlier one started, which lives on without it.

use std::collections::BTreeMap;
use std::sync::{Mutex, PoisonError};
use std::time::Duration;

use async_trait::async_trait;

use crate::command::{EngineCommand, quoted, split_options};
use crate::engine::{EngineError, Job, JobState, Launcher};
use crate::worker_command::{WITHOUT_TOKEN, WorkerCommand};

/// A machine on which workers run.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Host {
    /// Its name for ssh; `None` is this machine.
    pub name: Option<String>,
    /// Largest number of workers on it; `None` sets no limit.
    pub slots: Option<usize>,
}

impl Host {
    fn shown(&self) -> &str {
        self.name.as_deref().unwrap_or("localhost")
    }
}

/// Returns true if the value of an option of `ssh` is the next word.
fn takes_value(option: &str) -> bool {
    let with_value = |letter: char| "BbcDEeFIiJLlmOopQRSWw".contains(letter);
    // The rest of a word behind such a letter is the value.
    option.find(with_value).is_some_and(|at| at + 1 == option.len())
}

/// The processes of one launcher.
#[derive(Debug)]
pub struct Hosts {
    worker: WorkerCommand,
    /// Beginning of the names of its workers.
    prefix: String,
    hosts: Vec<Host>,
    /// Options of `ssh`.
    options: Vec<String>,
    limit: Duration,
    /// Workers on each host that answered lately.
    counts: Mutex<BTreeMap<usize, usize>>,
}

impl Hosts {
    /// The processes of this machine.
    pub fn local(worker: WorkerCommand, prefix: String, limit: Duration) -> Self {
        let hosts = vec![Host { name: None, slots: None }];
        Self { worker, prefix, hosts, options: Vec::new(), limit, counts: Mutex::default() }
    }

    /// The processes of the machines in `options`, each `HOST` or `HOST:WORKERS`. Words with a dash, and their values, are
    /// options of `ssh`.
    ///
    /// # Errors
    /// No machine is named, or a number is malformed.
    pub fn ssh(worker: WorkerCommand, prefix: String, options: Vec<String>, limit: Duration) -> Result<Self, String> {
        let (options, words) = split_options(options, takes_value);
        let host = |word: &String| {
            let (name, slots) = word.rsplit_once(':').unwrap_or((word, "1"));
            let slots =
                slots.parse().map_err(|_| format!("`{word}` is not a machine; expected HOST or HOST:WORKERS"))?;
            Ok(Host { name: Some(name.to_owned()), slots: Some(slots) })
        };
        let hosts: Vec<Host> = words.iter().map(host).collect::<Result<_, String>>()?;
        if hosts.is_empty() {
            return Err("no machine is named; expected `-- HOST:WORKERS HOST:WORKERS`".to_owned());
        }
        Ok(Self { worker, prefix, hosts, options, limit, counts: Mutex::default() })
    }

    fn shell(&self, host: &Host, script: &str) -> EngineCommand {
        match &host.name {
            None => EngineCommand::new("sh", ["-c", script]),
            Some(name) => {
                let own = ["-oBatchMode=yes", "-oConnectTimeout=5"].map(str::to_owned);
                let to = [name.clone(), script.to_owned()];
                EngineCommand::new("ssh", own.into_iter().chain(self.options.iter().cloned()).chain(to))
            }
        }
    }

    fn counts(&self) -> std::sync::MutexGuard<'_, BTreeMap<usize, usize>> {
        self.counts.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// Workers in a list of processes: lines of a process id and a command line.
fn workers(text: &str, prefix: &str) -> Vec<(String, u32)> {
    let worker = |line: &str| {
        let mut words = line.split_whitespace();
        let process = words.next()?.parse().ok()?;
        words.by_ref().find(|word| *word == "join")?;
        words.find(|word| *word == "--name")?;
        let name = words.next().filter(|name| name.starts_with(prefix))?;
        Some((name.to_owned(), process))
    };
    text.lines().filter_map(worker).collect()
}

#[async_trait]
impl Launcher for Hosts {
    /// A machine that does not answer is left out: the coordinator knows whether its workers live.
    async fn list(&self) -> Result<Vec<Job>, EngineError> {
        let mut jobs = Vec::new();
        let mut counts = BTreeMap::new();
        let mut last_error = None;
        for (i, host) in self.hosts.iter().enumerate() {
            match self.shell(host, "ps -ww -eo pid=,args=").run(self.limit).await {
                Ok(text) => {
                    let found = workers(&text, &self.prefix);
                    counts.insert(i, found.len());
                    let job = |(worker, process)| Job {
                        worker,
                        id: format!("{}/{process}", host.shown()),
                        state: JobState::Running,
                    };
                    jobs.extend(found.into_iter().map(job));
                }
                Err(error) => {
                    tracing::warn!(host = host.shown(), %error, "no list of workers");
                    last_error = Some(error);
                }
            }
        }
        let none_answers = counts.is_empty();
        *self.counts() = counts;
        match last_error {
            Some(error) if none_answers => Err(error),
            _ => Ok(jobs),
        }
    }

    async fn submit(&self, worker: &str) -> Result<(), EngineError> {
        let free = |(i, count): (&usize, &usize)| {
            let free = self.hosts[*i].slots.unwrap_or(usize::MAX).saturating_sub(*count);
            (free > 0).then_some((free, *i))
        };
        let most = self.counts().iter().filter_map(free).max_by_key(|(free, i)| (*free, std::cmp::Reverse(*i)));
        let Some((_, i)) = most else { return Err(EngineError::NoSlot(format!("{} hosts tried", self.hosts.len()))) };
        let log = format!("\"${{TMPDIR:-/tmp}}\"/{}.log", quoted(worker));
        let line = self.worker.line(worker);
        let program = quoted(&self.worker.program);
        let missing = quoted(&format!(
            "{} has no program `{}`; --program names another",
            self.hosts[i].shown(),
            self.worker.program
        ));
        let check = format!("command -v {program} >/dev/null || {{ echo {missing} >&2; exit 127; }}");
        let script = format!("{WITHOUT_TOKEN}; {check}; nohup setsid {line} </dev/null >>{log} 2>&1 &");
        self.shell(&self.hosts[i], &script).run(self.limit).await?;
        *self.counts().entry(i).or_default() += 1;
        Ok(())
    }

    async fn retire(&self, job: &Job) -> Result<(), EngineError> {
        let Some((name, process)) = job.id.rsplit_once('/') else { return Ok(()) };
        let Some(host) = self.hosts.iter().find(|host| host.shown() == name) else { return Ok(()) };
        // The number may belong to another process by now.
        let name = quoted(&format!("--name {}", job.worker));
        let script = format!("if ps -ww -o args= -p {process} | grep -qF -- {name}; then kill -TERM {process}; fi");
        self.shell(host, &script).run(self.limit).await.map(drop)
    }

    fn log(&self) -> &'static str {
        "NAME.log in the temporary folder of its machine"
    }

    fn capacity(&self) -> Option<usize> {
        self.hosts.iter().map(|host| host.slots).sum()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn workers_are_found_by_the_names_on_their_command_lines() {
        let text = "  7 trainer worker join http://h:1 --name stride-a-1 --backend flex\n\
                    8 sh -c nohup setsid trainer worker join u --name 'stride-a-2'\n\
                    9 trainer worker join u --name stride-b-1\n\
                    10 grep --name stride-a-3\nnoise\n";
        assert_eq!(workers(text, "stride-a-"), [("stride-a-1".to_owned(), 7)]);
    }

    #[test]
    fn machines_have_slots() {
        let worker = WorkerCommand {
            program: "trainer".into(),
            url: "u".into(),
            backend: protocol::stage::Backend::Flex,
            labels: protocol::Labels::default(),
            more: Vec::new(),
        };
        let hosts = |words: &[&str]| {
            let options = words.iter().map(|word| (*word).to_owned()).collect();
            Hosts::ssh(worker.clone(), "p".into(), options, Duration::from_secs(1))
                .map(|hosts| (hosts.capacity(), hosts.options))
        };
        assert_eq!(hosts(&["a:2", "-oPort=22", "b"]), Ok((Some(3), vec!["-oPort=22".to_owned()])));
        let options = ["-F", "ssh.conf", "a:2", "-vi", "key", "-p22", "-A", "b"];
        let words = ["-F", "ssh.conf", "-vi", "key", "-p22", "-A"].map(str::to_owned).to_vec();
        assert_eq!(hosts(&options), Ok((Some(3), words)), "an option may have its value in the next word");
        assert!(hosts(&[]).is_err_and(|why| why.contains("HOST:WORKERS")));
        assert!(hosts(&["a:many"]).is_err_and(|why| why.contains("`a:many`")));
    }
}
