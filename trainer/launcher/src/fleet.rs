//! Decisions of a launcher: from demand and jobs to jobs to submit and to retire. No clock, no engine, no network.
//!
//! A worker counts as alive if it polls or if the engine lists its job; it is on its way until it first polls. A job
//! that is neither listed nor polls has ended. If its worker never settled, that was a crash, unless the engine says that it
//! revoked the job. A worker settles when it gets work or stays for a while; it proves the template good. After a crash, one
//! job at a time is tried, with a growing pause; the limit of crashes ends the launcher.

use std::collections::BTreeMap;
use std::time::Duration;

use protocol::Labels;
use protocol::demand::{Demand, DemandGroup};
use protocol::stage::Backend;

use crate::engine::{Job, JobState};

/// Time after a submission in which an engine may not list the job yet.
const UNLISTED: Duration = Duration::from_secs(10);
/// Time after which a running job without a worker is taken for a crashed one.
const SILENT: Duration = Duration::from_secs(600);
/// Time after which a worker has settled.
const SETTLED: Duration = Duration::from_secs(30);
/// First pause after a crash; it doubles with each further one.
const PAUSE: Duration = Duration::from_secs(2);
const LONGEST_PAUSE: Duration = Duration::from_secs(300);

/// Settings of a launcher.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Plan {
    /// Beginning of the names of its workers.
    pub prefix: String,
    pub backend: Backend,
    /// Labels of its workers.
    pub labels: Labels,
    /// Workers that run without any demand.
    pub min: usize,
    /// Largest number of jobs.
    pub max: usize,
    /// Time without work after which a worker is retired.
    pub idle: Duration,
    /// Number of crashes in a row after which no job is submitted.
    pub crashes: u32,
}

impl Plan {
    fn is_ours(&self, worker: &str) -> bool {
        worker.strip_prefix(&self.prefix).is_some_and(|rest| rest.starts_with('-'))
    }
}

/// Everything that a decision depends on.
#[derive(Debug, Clone, Copy)]
pub struct Observation<'a> {
    /// Time since the launcher started.
    pub now: Duration,
    /// A number that grows between launchers, for new names: milliseconds since 1970.
    pub stamp: u64,
    pub demand: &'a Demand,
    pub jobs: &'a [Job],
}

/// A change requested from the engine.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Action {
    /// Submit a job for a new worker.
    Submit { worker: String },
    /// Ask a listed job to end. Asked again until it has ended.
    Retire { job: Job },
}

/// A job that may be alive.
#[derive(Debug, Clone)]
struct Known {
    since: Duration,
    /// The engine has listed it, or its worker has polled.
    seen: bool,
    /// Its submission failed, so it may not exist.
    doubtful: bool,
    /// First poll of its worker.
    joined: Option<Duration>,
    /// Its worker has had work or has stayed for a while.
    settled: bool,
    /// First time that the engine listed it as running.
    running: Option<Duration>,
    /// Since when it has nothing to do.
    surplus: Option<Duration>,
    retired: bool,
    /// The engine ended its job, so its end is no crash.
    revoked: bool,
}

impl Known {
    fn new(since: Duration) -> Self {
        Self {
            since,
            seen: false,
            doubtful: false,
            joined: None,
            settled: false,
            running: None,
            surplus: None,
            retired: false,
            revoked: false,
        }
    }
}

/// The jobs of a launcher.
#[derive(Debug)]
pub struct Fleet {
    plan: Plan,
    known: BTreeMap<String, Known>,
    /// Crashes since a worker last settled.
    crashes: u32,
    /// Workers whose jobs crashed and that [`Fleet::take_crashed`] has not returned yet.
    crashed: Vec<String>,
    /// End of the pause after a crash.
    resume: Duration,
    /// Number of submitted jobs, for their names.
    submitted: u64,
}

impl Fleet {
    pub fn new(plan: Plan) -> Self {
        Self { plan, known: BTreeMap::new(), crashes: 0, crashed: Vec::new(), resume: Duration::ZERO, submitted: 0 }
    }

    pub fn plan(&self) -> &Plan {
        &self.plan
    }

    /// Returns true if the limit of crashes is reached.
    pub fn has_given_up(&self) -> bool {
        self.crashes >= self.plan.crashes
    }

    /// Workers whose jobs crashed since the last call.
    pub fn take_crashed(&mut self) -> Vec<String> {
        std::mem::take(&mut self.crashed)
    }

    /// Returns true if something changes soon without a change of demand.
    pub fn is_busy(&self) -> bool {
        self.crashes > 0 || self.known.values().any(|job| job.joined.is_none() || job.surplus.is_some() || job.retired)
    }

    /// Decides what to ask of the engine.
    pub fn decide(&mut self, seen: Observation<'_>) -> Vec<Action> {
        self.learn(seen);
        let (ready, idle) = self.open_work(seen.demand);
        let need = ready.saturating_sub(idle);
        self.mark_surplus(seen, need, idle.saturating_sub(ready));
        let mut actions = self.retire(seen);
        actions.extend(self.submit(seen, need));
        actions
    }

    /// Notes that a submission failed. Transient errors say nothing against the template.
    pub fn submission_failed(&mut self, worker: &str, is_transient: bool, now: Duration) {
        if is_transient {
            if let Some(job) = self.known.get_mut(worker) {
                job.doubtful = true;
            }
            self.resume = self.resume.max(now + PAUSE);
        } else {
            self.known.remove(worker);
            self.crash(now);
        }
    }

    fn crash(&mut self, now: Duration) {
        let pause = PAUSE.saturating_mul(1 << self.crashes.min(16)).min(LONGEST_PAUSE);
        self.crashes += 1;
        self.resume = now + pause;
    }

    fn learn(&mut self, seen: Observation<'_>) {
        let now = seen.now;
        for job in seen.jobs.iter().filter(|job| self.plan.is_ours(&job.worker)) {
            if job.state.has_ended() {
                // Its worker may live on if a node was lost.
                if let Some(known) = self.known.get_mut(&job.worker) {
                    (known.seen, known.revoked) = (true, true);
                }
                continue;
            }
            let known = self.known.entry(job.worker.clone()).or_insert_with(|| Known::new(now));
            known.seen = true;
            known.retired |= job.state == JobState::Ending;
            if job.state == JobState::Running {
                known.running.get_or_insert(now);
            }
        }
        for worker in seen.demand.workers.iter().filter(|worker| self.plan.is_ours(worker.worker.as_str())) {
            let known = self.known.entry(worker.worker.to_string()).or_insert_with(|| Known::new(now));
            known.seen = true;
            let joined = *known.joined.get_or_insert(now);
            if !worker.idle || now >= joined + SETTLED {
                known.settled = true;
                self.crashes = 0;
            }
        }
        let is_alive = |name: &str| {
            seen.jobs.iter().any(|job| job.worker == name && !job.state.has_ended())
                || seen.demand.workers.iter().any(|worker| worker.worker.as_str() == name)
        };
        let before = self.crashed.len();
        self.known.retain(|name, job| {
            let waits = !job.seen && now < job.since + UNLISTED;
            let has_ended = !waits && !is_alive(name);
            if has_ended && !job.retired && !job.revoked && !job.doubtful && !job.settled {
                self.crashed.push(name.clone());
            }
            !has_ended
        });
        for (name, job) in &mut self.known {
            let is_silent = job.joined.is_none() && job.running.is_some_and(|running| now >= running + SILENT);
            if is_silent && !job.retired {
                job.retired = true;
                self.crashed.push(name.clone());
            }
        }
        // Jobs that end together are one crash: the first of them would have been enough.
        if self.crashed.len() > before {
            self.crash(now);
        }
    }

    /// Open slots for workers of this kind, and idle workers of any launcher that fit them. A slot that needs another
    /// instruction set than an idle worker of ours is not for this engine's machines.
    fn open_work(&self, demand: &Demand) -> (usize, usize) {
        let differs = |group: &DemandGroup| {
            let ours = demand.workers.iter().filter(|worker| worker.idle && self.plan.is_ours(worker.worker.as_str()));
            ours.filter(|worker| group.takes(worker.backend, &worker.labels)).any(|worker| !group.takes_worker(worker))
        };
        let ours = |group: &&DemandGroup| group.takes(self.plan.backend, &self.plan.labels) && !differs(group);
        let ready: u64 = demand.groups.iter().filter(ours).map(|group| group.ready).sum();
        let open = || demand.groups.iter().filter(ours).filter(|group| group.ready > 0);
        let idle = demand.workers.iter().filter(|worker| worker.idle && open().any(|group| group.takes_worker(worker)));
        (usize::try_from(ready).unwrap_or(usize::MAX), idle.count())
    }

    /// Marks jobs that have nothing to do: idle workers without open slots, and jobs on their way beyond the need.
    fn mark_surplus(&mut self, seen: Observation<'_>, need: usize, more_idle: usize) {
        let is_idle =
            |name: &str| seen.demand.workers.iter().any(|worker| worker.idle && worker.worker.as_str() == name);
        let fits = |name: &str| {
            let worker = seen.demand.workers.iter().find(|worker| worker.worker.as_str() == name);
            worker.is_some_and(|worker| {
                seen.demand.groups.iter().any(|group| group.ready > 0 && group.takes_worker(worker))
            })
        };
        let mut spare_idle = more_idle;
        let mut spare_coming = self.coming().saturating_sub(need);
        // The newest first.
        for (name, job) in self.known.iter_mut().rev() {
            let is_spare = match job.joined {
                None => take_one(&mut spare_coming),
                Some(_) => is_idle(name) && (!fits(name) || take_one(&mut spare_idle)),
            };
            job.surplus = is_spare.then(|| job.surplus.unwrap_or(seen.now));
        }
    }

    fn coming(&self) -> usize {
        self.known.values().filter(|job| job.joined.is_none() && !job.retired).count()
    }

    fn retire(&mut self, seen: Observation<'_>) -> Vec<Action> {
        let mut staying = self.known.values().filter(|job| !job.retired).count();
        for job in self.known.values_mut().rev() {
            let is_due = job.surplus.is_some_and(|since| seen.now >= since + self.plan.idle);
            if is_due && !job.retired && staying > self.plan.min {
                job.retired = true;
                staying -= 1;
            }
        }
        let is_due =
            |job: &&Job| !job.state.has_ended() && self.known.get(&job.worker).is_some_and(|known| known.retired);
        seen.jobs.iter().filter(is_due).map(|job| Action::Retire { job: job.clone() }).collect()
    }

    fn submit(&mut self, seen: Observation<'_>, need: usize) -> Vec<Action> {
        if self.has_given_up() || seen.now < self.resume {
            return Vec::new();
        }
        let coming = self.coming();
        let staying = self.known.values().filter(|job| !job.retired).count();
        let wanted = need.saturating_sub(coming).max(self.plan.min.saturating_sub(staying));
        // A retired job occupies its machine until it has ended.
        let room = self.plan.max.saturating_sub(self.known.len());
        let tries = if self.crashes > 0 { usize::from(coming == 0) } else { usize::MAX };
        let names: Vec<String> = (0..wanted.min(room).min(tries)).map(|_| self.next_name(seen.stamp)).collect();
        for name in &names {
            self.known.insert(name.clone(), Known::new(seen.now));
        }
        names.into_iter().map(|worker| Action::Submit { worker }).collect()
    }

    /// A name that no earlier job has had, in the order of submission.
    fn next_name(&mut self, stamp: u64) -> String {
        self.submitted += 1;
        format!("{}-{}-{:03}", self.plan.prefix, base36(stamp), self.submitted % 1000)
    }
}

fn take_one(count: &mut usize) -> bool {
    let is_left = *count > 0;
    *count = count.saturating_sub(1);
    is_left
}

fn base36(mut number: u64) -> String {
    let mut digits = Vec::new();
    while number > 0 || digits.is_empty() {
        digits.extend(char::from_digit((number % 36) as u32, 36));
        number /= 36;
    }
    digits.into_iter().rev().collect()
}
