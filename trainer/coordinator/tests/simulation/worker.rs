//! A worker that does not compute. It joins, polls, steps, saves and reports over a network that delays, loses and
//! duplicates messages.

use std::collections::{BTreeMap, BTreeSet};

use coordinator::Millis;
use protocol::message::{
    Assignment, CommitCheckpoint, DesiredAssignments, Doing, FailureClass, Grant, Join, LossCause, LostPeer, Member,
    PROTOCOL_VERSION, Poll, Prepare, Progress, ReportOutcome, Role, TaskOutcome,
};
use protocol::stage::Backend;
use protocol::{Attempt, Digest, Incarnation, TaskId, WorkerId};

use crate::random::Random;

/// Number of steps of a training stage.
pub(crate) const STEPS: u64 = 10;

/// A message to the coordinator.
#[derive(Debug, Clone)]
pub(crate) enum Call {
    Join(Join),
    Poll(Poll),
    Commit(CommitCheckpoint),
    Report(ReportOutcome),
}

impl Call {
    /// The blob that was uploaded before the call.
    pub(crate) fn uploaded(&self) -> Option<Digest> {
        match self {
            Self::Join(_) | Self::Poll(_) => None,
            Self::Commit(commit) => Some(commit.manifest),
            Self::Report(report) => match report.outcome {
                TaskOutcome::Finished { output, .. } => Some(output),
                TaskOutcome::Resolved { .. } | TaskOutcome::Yielded { .. } | TaskOutcome::Failed { .. } => None,
            },
        }
    }
}

/// A message from the coordinator.
#[derive(Debug, Clone)]
pub(crate) enum Answer {
    Joined(Incarnation),
    /// The desired assignments after this number of decisions.
    DesiredAssignments(DesiredAssignments, u64),
    /// The commit or report is stored.
    Done(Saving),
    /// The commit or report is refused for good.
    Refused(Saving),
    /// Any call may be repeated later.
    Later,
}

#[derive(Debug, Clone, PartialEq)]
pub(crate) enum Saving {
    No,
    /// The worker waits for the answer.
    Commit(CommitCheckpoint),
    Report(ReportOutcome),
    Over,
}

#[derive(Debug, Clone)]
pub(crate) struct FakeWorker {
    pub(crate) name: WorkerId,
    /// Set while the process exists.
    pub(crate) alive: bool,
    /// The time at which the process was asked to end.
    pub(crate) leaving: Option<Millis>,
    /// The process is stopped by a signal until this time.
    pub(crate) hung_until: Millis,
    /// The stage hangs until this time, while the process still polls.
    pub(crate) stuck_until: Millis,
    /// The peer port refuses connections until this time.
    pub(crate) refuses_until: Millis,
    /// Complains of all peers, although it reaches them.
    pub(crate) lies: bool,
    pub(crate) process: u32,
    incarnation: Option<Incarnation>,
    desired: Option<DesiredAssignments>,
    /// The number of decisions behind the newest received answer.
    newest: u64,
    /// The steps of the state in memory, with its task and attempt.
    live: Option<(TaskId, Attempt, u64)>,
    /// The state that it discarded because of an answer that a newer one had overtaken. Real workers never receive such
    /// an answer: they have one poll in progress and ignore answers to abandoned polls.
    misled: Option<(TaskId, Attempt, u64)>,
    saved_at: u64,
    saving: Saving,
    next_call: Millis,
    silent_peers_since: Option<Millis>,
    /// Time for this process to fetch a task's inputs. Milliseconds.
    fetches_ms: u64,
    /// Completion times of requested inputs.
    fetching: BTreeMap<TaskId, Millis>,
    /// Tasks whose inputs it has reported as fetched.
    said_ready: BTreeSet<TaskId>,
}

impl FakeWorker {
    pub(crate) fn new(name: &str) -> Self {
        Self {
            name: name.into(),
            alive: false,
            leaving: None,
            hung_until: Millis(0),
            stuck_until: Millis(0),
            refuses_until: Millis(0),
            lies: false,
            process: 0,
            incarnation: None,
            desired: None,
            newest: 0,
            live: None,
            misled: None,
            saved_at: 0,
            saving: Saving::No,
            next_call: Millis(0),
            silent_peers_since: None,
            fetches_ms: 0,
            fetching: BTreeMap::new(),
            said_ready: BTreeSet::new(),
        }
    }

    /// The instruction set of its host; there are two kinds of hosts.
    fn instruction_set(&self) -> String {
        let is_odd = self.name.as_str().ends_with(['1', '3']);
        if is_odd { "avx512".to_owned() } else { "avx2".to_owned() }
    }

    /// Starts a new process; returns `true` if it fetches inputs slowly.
    pub(crate) fn launch(&mut self) -> bool {
        // Half of the processes have a slow connection.
        let fetches_ms = match lot(&format!("{} {}", self.name, self.process)) {
            quick @ 0..128 => u64::from(quick),
            slow => u64::from(slow) * 100,
        };
        let lies = lot(&format!("lies {} {}", self.name, self.process)) < 26;
        *self = Self { process: self.process + 1, alive: true, fetches_ms, lies, ..Self::new(self.name.as_str()) };
        fetches_ms >= 10_000
    }

    pub(crate) fn runs(&self, now: Millis) -> bool {
        self.alive && self.hung_until <= now
    }

    /// Returns true if the process ends: it was asked to, and has no work or no more time.
    pub(crate) fn has_left(&self, now: Millis) -> bool {
        self.alive && self.leaving.is_some_and(|since| self.grant().is_none() || now.since(since) > 5_000)
    }

    /// Returns true if it is the process of this member.
    pub(crate) fn is(&self, member: &Member) -> bool {
        self.alive && self.name == member.worker && self.incarnation == Some(member.incarnation)
    }

    /// Returns true if the stage hangs while the process still polls.
    pub(crate) fn is_stuck(&self, now: Millis) -> bool {
        self.stuck_until > now
    }

    /// Returns true if it has reported the end of its task, so that its gang cannot step with it.
    pub(crate) fn has_reported(&self) -> bool {
        matches!(self.saving, Saving::Report(_) | Saving::Over)
    }

    fn assignment(&self) -> Option<&Assignment> {
        self.desired.as_ref()?.assignments.first()
    }

    pub(crate) fn grant(&self) -> Option<&Grant> {
        self.assignment().map(|assignment| &assignment.grant)
    }

    /// Steps in memory, if they belong to this attempt.
    pub(crate) fn live(&self, grant: &Grant) -> Option<u64> {
        self.live_of(&grant.task, grant.attempt)
    }

    pub(crate) fn live_of(&self, task: &TaskId, attempt: Attempt) -> Option<u64> {
        self.live.as_ref().filter(|(of, at, _)| (of, *at) == (task, attempt)).map(|live| live.2)
    }

    /// Steps in memory, including steps discarded because of an overtaken answer.
    pub(crate) fn has_or_was_misled_out_of(&self, task: &TaskId, attempt: Attempt) -> Option<u64> {
        let misled = self.misled.as_ref().filter(|(of, at, _)| (of, *at) == (task, attempt));
        self.live_of(task, attempt).max(misled.map(|misled| misled.2))
    }

    pub(crate) fn hear(&mut self, process: u32, answer: Answer) {
        if !self.alive || process != self.process {
            return;
        }
        match answer {
            Answer::Joined(incarnation) => {
                self.incarnation.get_or_insert(incarnation);
            }
            Answer::DesiredAssignments(desired, decisions) => {
                let is_overtaken = decisions < self.newest;
                self.newest = self.newest.max(decisions);
                let held = self.grant().cloned();
                self.desired = Some(desired);
                if self.grant().is_none_or(|grant| held.as_ref().is_some_and(|held| held.task != grant.task)) {
                    let dropped = self.live.take();
                    if !is_overtaken {
                        self.misled = None;
                    } else if dropped.is_some() {
                        self.misled = dropped;
                    }
                }
                if let Some(Assignment { grant, role: Role::Member { .. }, .. }) = self.assignment() {
                    assert!(self.said_ready.contains(&grant.task), "`{}` got {grant:?} without its inputs", self.name);
                }
                if self.grant() != held.as_ref() {
                    self.saving = Saving::No;
                    self.silent_peers_since = None;
                }
            }
            Answer::Done(what) if what == self.saving => match what {
                Saving::Commit(commit) => {
                    self.saved_at = commit.step;
                    self.saving = Saving::No;
                }
                Saving::Report(_) | Saving::Over | Saving::No => self.saving = Saving::Over,
            },
            // The worker no longer holds its task.
            Answer::Refused(what) if what == self.saving => self.saving = Saving::Over,
            // An answer to an earlier call.
            Answer::Done(_) | Answer::Refused(_) | Answer::Later => {}
        }
    }

    /// Resets the worker so that it joins again, after its process was replaced or forgotten.
    pub(crate) fn forget(&mut self) {
        self.incarnation = None;
        self.desired = None;
        self.live = None;
        self.misled = None;
        self.saving = Saving::No;
    }

    /// The calls that it sends now, given unreachable and hung peers.
    pub(crate) fn speak(&mut self, now: Millis, unreachable: &[WorkerId], stuck: &[WorkerId], lies: bool) -> Vec<Call> {
        if !self.runs(now) || now < self.next_call {
            return Vec::new();
        }
        self.next_call = now.after(800);
        let Some(incarnation) = self.incarnation else {
            return vec![Call::Join(Join {
                protocol: PROTOCOL_VERSION,
                worker: self.name.clone(),
                pid: self.process,
                backend: Backend::Flex,
                instruction_set: self.instruction_set(),
                code_versions: protocol::stage::StageSettings::code_versions(),
                peer_address: format!("{}:{}", self.name, self.process),
                labels: Default::default(),
            })];
        };
        let doing = self.assignment().map(|assignment| {
            let members = match &assignment.role {
                Role::Member { members, .. } => members.as_slice(),
                Role::Alone | Role::Shard { .. } | Role::Merge { .. } | Role::Resolve => &[],
            };
            let peers = members.iter().map(|member| &member.worker).filter(|worker| **worker != self.name);
            let misses = self.silent_peers_since.is_some_and(|since| now.since(since) > 2500);
            let lost = peers.clone().filter(|worker| lies || (misses && unreachable.contains(worker)));
            let lost = lost.map(|worker| LostPeer { worker: worker.clone(), cause: LossCause::Unreachable });
            let waits_for = peers.clone().find(|worker| stuck.contains(worker) && !self.is_stuck(now)).cloned();
            let progress = Progress { done: self.live.as_ref().map_or(0, |l| l.2), total: STEPS, ..Default::default() };
            let grant = assignment.grant.clone();
            Doing { holds: self.live(&grant), waits_for, lost: lost.collect(), ..Doing::new(grant, progress) }
        });
        let reaches = |prepare: &&Prepare| !prepare.peers.iter().any(|peer| unreachable.contains(&peer.worker));
        let asked = self.desired.iter().flat_map(|desired| &desired.prepare).filter(reaches);
        let asked: BTreeSet<TaskId> = asked.map(|prepare| prepare.task.clone()).collect();
        self.fetching.retain(|task, _| asked.contains(task));
        for task in asked {
            self.fetching.entry(task).or_insert(now.after(self.fetches_ms));
        }
        let ready = self.fetching.iter().filter(|(_, at)| **at <= now).map(|(task, _)| task.clone());
        let ready: Vec<TaskId> = ready.collect();
        self.said_ready.extend(ready.iter().cloned());
        let version = self.desired.as_ref().map_or(0, |desired| desired.version);
        let mut calls = vec![Call::Poll(Poll {
            incarnation,
            doing: doing.into_iter().collect(),
            ready,
            version,
            leaving: self.leaving.is_some(),
        })];
        match &self.saving {
            Saving::Commit(commit) => calls.push(Call::Commit(commit.clone())),
            Saving::Report(report) => calls.push(Call::Report(report.clone())),
            Saving::No | Saving::Over => {}
        }
        calls
    }

    fn report(&mut self, grant: Grant, outcome: TaskOutcome) {
        self.saving = Saving::Report(ReportOutcome::new(grant, outcome));
    }

    /// Reports the first input for which `can_be` holds as damaged, and returns it.
    pub(crate) fn finds_damage(&mut self, now: Millis, can_be: impl Fn(Digest) -> bool) -> Option<Digest> {
        if !self.runs(now) || self.saving != Saving::No {
            return None;
        }
        let assignment = self.assignment()?.clone();
        let input = assignment.stage.inputs.values().copied().find(|input| can_be(*input))?;
        let message = format!("blob {input} is damaged");
        self.report(assignment.grant, TaskOutcome::Failed { class: FailureClass::Damaged, message });
        Some(input)
    }

    /// Does one unit of work. For a gang, `peers` has the steps of the most advanced member, or `None` if some are
    /// absent.
    pub(crate) fn work(
        &mut self,
        now: Millis,
        peers: Option<Option<u64>>,
        saved: u64,
        random: &mut Random,
        chaos: bool,
    ) {
        if !self.runs(now) || self.saving != Saving::No {
            return;
        }
        let Some(assignment) = self.assignment().cloned() else { return };
        let grant = assignment.grant.clone();
        if self.is_stuck(now) && matches!(assignment.role, Role::Member { .. }) {
            return;
        }
        if chaos && random.chance(1) {
            let class = if random.chance(50) { FailureClass::Fault } else { FailureClass::Infrastructure };
            return self.report(grant, TaskOutcome::Failed { class, message: "made up".into() });
        }
        let rank = match &assignment.role {
            Role::Member { members, .. } => members.iter().position(|member| member.worker == self.name),
            Role::Resolve => {
                let folders = assignment.stage.settings.folders().into_iter();
                let digests = folders.map(|folder| (folder.field, Digest::of(folder.path.as_bytes()))).collect();
                return self.report(grant, TaskOutcome::Resolved { digests });
            }
            Role::Alone | Role::Shard { .. } | Role::Merge { .. } => {
                if random.chance(40) {
                    self.report(grant.clone(), finished(&assignment));
                }
                return;
            }
        };
        if diverges(&grant.task) {
            let class = FailureClass::Diverged;
            return self.report(grant, TaskOutcome::Failed { class, message: "the loss is not a number".into() });
        }
        // A rung of a sweep stops earlier, with a checkpoint of its last step.
        let stop = assignment.stage.settings.training().and_then(|training| training.stop);
        let steps = stop.map_or(STEPS, |stop| stop.0);
        let Some(furthest) = peers else {
            self.silent_peers_since.get_or_insert(now);
            return;
        };
        self.silent_peers_since = None;
        let before = furthest.or(self.live(&grant)).unwrap_or(saved);
        let leads = rank == Some(0);
        if assignment.drain && leads {
            if self.saved_at != before {
                return self.commit(grant, before);
            }
            return self.report(grant, TaskOutcome::Yielded { at: before });
        }
        if before >= steps {
            if leads && stop.is_some() && saved != before {
                return self.commit(grant, before);
            }
            if leads {
                self.report(grant.clone(), finished(&assignment));
            }
            return;
        }
        self.live = Some((grant.task.clone(), grant.attempt, before + u64::from(leads)));
        if leads && (before + 1) % 3 == 0 {
            self.commit(grant, before + 1);
        }
    }

    fn commit(&mut self, grant: Grant, step: u64) {
        let manifest = Digest::of(format!("{} {step}", grant.task).as_bytes());
        let metrics = BTreeMap::from([("loss".to_owned(), 1.0 / (1.0 + step as f64))]);
        self.saving = Saving::Commit(CommitCheckpoint { grant, step, manifest, metrics });
    }
}

/// A stage is a function: all workers compute the same result.
fn finished(assignment: &Assignment) -> TaskOutcome {
    let path = within_run(&assignment.grant.task);
    // The name of a trial determines its metric.
    let fid = if path.contains(".t") { lot(path) as f64 / 256.0 } else { 0.1 };
    let metrics = BTreeMap::from([("latent_fid".to_owned(), fid)]);
    TaskOutcome::Finished { output: Digest::of(path.as_bytes()), metrics }
}

/// Returns true for some rungs of some trials of a sweep.
fn diverges(task: &TaskId) -> bool {
    let path = within_run(task);
    path.contains(".t") && lot(path).is_multiple_of(9)
}

fn lot(text: &str) -> u8 {
    Digest::of(text.as_bytes()).as_bytes()[0]
}

fn within_run(task: &TaskId) -> &str {
    task.as_str().split_once('/').map_or("", |(_, path)| path)
}
