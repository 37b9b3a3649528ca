//! A task: its lease, its attempts and its newest checkpoints.
//!
//! | hold \ event | grant | regroup | release | finish | back-off over | drain |
//! |---|---|---|---|---|---|---|
//! | Waiting | Held | - | - | - | Waiting | - |
//! | Held | - | Held | Waiting | Done | - | Held |
//! | Done | - | - | - | - | - | - |
//!
//! `-` panics; `decide` never requests it. The fence grows with each grant, regroup and release. The store therefore
//! refuses a writer as soon as it loses the task, even before another worker gets it. The attempt number grows with
//! each grant: a grant starts from a checkpoint or from nothing, a regroup from live state.

use std::collections::BTreeMap;

use protocol::message::{Grant, Member, ReportOutcome};
use protocol::stage::Keep;
use protocol::{Attempt, Digest, Fence, Incarnation, TaskId, WorkerId};
use registry::Write;
use serde::{Deserialize, Serialize};

use crate::rejected::Rejected;
use crate::time::Millis;

/// The part of a stage that a task computes.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Part {
    /// All of a plain stage.
    Alone,
    /// All of a training stage, by several workers.
    Gang,
    /// One shard of a map stage.
    Shard {
        /// Number of the shard, from 0.
        index: u32,
        /// Number of shards.
        of: u32,
    },
    /// The merge of a map stage's shards.
    Merge,
    /// Digesting the files that a stage's settings name outside the store.
    Resolve,
}

/// The right to a task.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Lease {
    /// No worker holds the task.
    Waiting {
        /// The end of the back-off.
        not_before: Option<Millis>,
    },
    /// These workers hold the task; more than one only for a gang.
    Held {
        /// The members by rank.
        holders: Vec<Member>,
        /// The secret by which peers of this generation authenticate each other.
        secret: String,
        /// The time at which the task is released by force, if it is asked to drain.
        drain_by: Option<Millis>,
        /// Set if it is asked to drain because work of a higher priority gets its workers.
        #[serde(default, skip_serializing_if = "std::ops::Not::not")]
        preempted: bool,
    },
    /// The task is done.
    Done {
        /// The resulting artifact.
        output: Digest,
    },
}

/// A committed checkpoint.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Saved {
    /// Number of training steps applied.
    pub step: u64,
    pub manifest: Digest,
    /// Values that retention may rank by.
    pub metrics: BTreeMap<String, f64>,
}

/// A unit of work for one worker or one gang.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Task {
    pub id: TaskId,
    pub part: Part,
    pub lease: Lease,
    /// The number of the newest attempt; 0 before the first.
    pub attempt: Attempt,
    /// The newest fence; 0 before the first.
    pub fence: Fence,
    /// Number of faults since it was last opened.
    pub faults: u32,
    /// Number of losses since the last progress: a task that makes progress may lose any number of workers.
    pub losses: u32,
    /// Number of failures since the last progress.
    pub streak: u32,
    /// Workers without enough memory for it; they do not get it again.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub too_small: Vec<WorkerId>,
    /// Workers of the newest failed attempts, in order, at most [`Task::REMEMBERED`]. Each counts against them when the
    /// task is granted again. Empty for gangs, which have rules of their own.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub failed_on: Vec<WorkerId>,
    /// Kept checkpoints, oldest first.
    pub checkpoints: Vec<Saved>,
    /// The last accepted report. A repeated report gets the same answer.
    pub reported: Option<ReportOutcome>,
}

impl Task {
    /// Number of failed attempts whose workers are known.
    pub const REMEMBERED: usize = 8;

    /// Creates a task without attempts.
    pub fn new(id: TaskId, part: Part) -> Self {
        Self {
            id,
            part,
            lease: Lease::Waiting { not_before: None },
            attempt: Attempt(0),
            fence: Fence(0),
            faults: 0,
            losses: 0,
            streak: 0,
            too_small: Vec::new(),
            failed_on: Vec::new(),
            checkpoints: Vec::new(),
            reported: None,
        }
    }

    /// The members that hold it, by rank; empty unless it is held.
    pub fn holders(&self) -> &[Member] {
        match &self.lease {
            Lease::Held { holders, .. } => holders,
            Lease::Waiting { .. } | Lease::Done { .. } => &[],
        }
    }

    /// Returns true if a worker holds it.
    pub fn is_held(&self) -> bool {
        matches!(self.lease, Lease::Held { .. })
    }

    /// The resulting artifact, if done.
    pub fn output(&self) -> Option<Digest> {
        match self.lease {
            Lease::Done { output } => Some(output),
            Lease::Waiting { .. } | Lease::Held { .. } => None,
        }
    }

    /// Returns true if it may be granted now.
    pub fn is_free(&self, now: Millis) -> bool {
        match self.lease {
            Lease::Waiting { not_before } => not_before.is_none_or(|time| time <= now),
            Lease::Held { .. } | Lease::Done { .. } => false,
        }
    }

    /// The newest committed checkpoint.
    pub fn newest(&self) -> Option<&Saved> {
        self.checkpoints.last()
    }

    /// The grant of one holder.
    pub fn grant_of(&self, worker: &WorkerId, incarnation: Incarnation) -> Grant {
        Grant { task: self.id.clone(), attempt: self.attempt, fence: self.fence, worker: worker.clone(), incarnation }
    }

    /// Remembers that an attempt of its holders failed.
    pub fn remember_failure(&mut self) {
        if self.part != Part::Gang {
            let holders: Vec<WorkerId> = self.holders().iter().map(|holder| holder.worker.clone()).collect();
            self.failed_on.extend(holders);
            self.failed_on.drain(..self.failed_on.len().saturating_sub(Self::REMEMBERED));
        }
    }

    /// Number of remembered attempts that failed on `worker`.
    pub fn failures_on(&self, worker: &WorkerId) -> usize {
        self.failed_on.iter().filter(|failed| *failed == worker).count()
    }

    /// Starts a new attempt with these holders.
    pub fn grant(&mut self, holders: Vec<Member>, secret: impl FnOnce(Fence) -> String) -> Write {
        assert!(matches!(self.lease, Lease::Waiting { .. }) && !holders.is_empty(), "grant of {self:?}");
        self.attempt = self.attempt.next();
        self.lease_to(holders, secret)
    }

    /// Changes the holders within the same attempt.
    pub fn regroup(&mut self, holders: Vec<Member>, secret: impl FnOnce(Fence) -> String) -> Write {
        assert!(self.is_held() && self.part == Part::Gang && !holders.is_empty(), "regroup of {self:?}");
        self.lease_to(holders, secret)
    }

    fn lease_to(&mut self, holders: Vec<Member>, secret: impl FnOnce(Fence) -> String) -> Write {
        let (drain_by, preempted) = match self.lease {
            Lease::Held { drain_by, preempted, .. } => (drain_by, preempted),
            Lease::Waiting { .. } | Lease::Done { .. } => (None, false),
        };
        let fence = self.raise();
        self.lease = Lease::Held { holders, secret: secret(self.fence), drain_by, preempted };
        fence
    }

    /// Ends the back-off if it is over at `now`; returns true if so.
    pub fn end_backoff(&mut self, now: Millis) -> bool {
        match &mut self.lease {
            Lease::Waiting { not_before } if not_before.is_some_and(|time| time <= now) => {
                *not_before = None;
                true
            }
            Lease::Waiting { .. } | Lease::Held { .. } | Lease::Done { .. } => false,
        }
    }

    /// Takes the task from its holders, which can no longer write.
    pub fn release(&mut self, not_before: Option<Millis>) -> Write {
        assert!(self.is_held(), "release of {self:?}");
        self.lease = Lease::Waiting { not_before };
        self.raise()
    }

    /// Records that the holders returned the task themselves. Their fence stays valid, so that they can still report on
    /// it.
    pub fn give_back(&mut self, not_before: Option<Millis>) {
        assert!(self.is_held(), "giving back of {self:?}");
        self.lease = Lease::Waiting { not_before };
    }

    /// Records the resulting artifact.
    pub fn finish(&mut self, output: Digest) {
        assert!(self.is_held(), "finish of {self:?}");
        self.lease = Lease::Done { output };
        self.streak = 0;
    }

    /// Resets everything except the fence and the attempt number, which only grow.
    pub fn reopen(&mut self) {
        self.reset_budgets();
        self.checkpoints.clear();
        self.lease = Lease::Waiting { not_before: None };
    }

    /// Resets the budgets for restarts.
    pub fn reset_budgets(&mut self) {
        (self.faults, self.losses, self.streak) = (0, 0, 0);
        self.too_small.clear();
        self.failed_on.clear();
        if let Lease::Waiting { not_before } = &mut self.lease {
            *not_before = None;
        }
    }

    /// Asks the holders to drain until `deadline`, or to continue if it is `None`. A preempted task keeps draining.
    pub fn drain(&mut self, deadline: Option<Millis>) {
        if let Lease::Held { drain_by, preempted, .. } = &mut self.lease {
            *drain_by = match (*drain_by, deadline) {
                (Some(already), Some(_)) => Some(already),
                (Some(already), None) if *preempted => Some(already),
                (_, deadline) => deadline,
            };
        }
    }

    /// Asks the holders to drain until `deadline`, because work of a higher priority gets them.
    pub fn preempt(&mut self, deadline: Millis) {
        self.drain(Some(deadline));
        if let Lease::Held { preempted, .. } = &mut self.lease {
            *preempted = true;
        }
    }

    /// Returns true if it is asked to drain for work of a higher priority.
    pub fn is_preempted(&self) -> bool {
        matches!(self.lease, Lease::Held { preempted: true, .. })
    }

    fn raise(&mut self) -> Write {
        self.fence = self.fence.next();
        Write::Fence { task: self.id.clone(), fence: self.fence }
    }

    /// Checks that a grant is current and that its sender holds the task. Returns the sender's rank.
    pub fn check(&self, grant: &Grant) -> Result<usize, Rejected> {
        self.check_fence(grant)?;
        self.holders()
            .iter()
            .position(|member| member.worker == grant.worker && member.incarnation == grant.incarnation)
            .ok_or_else(|| {
                Rejected::Conflict(format!(
                    "worker `{}` (incarnation {}) does not hold task `{}`",
                    grant.worker, grant.incarnation, self.id
                ))
            })
    }

    /// Checks only that a grant has not been superseded; reports on work that has just ended still count.
    pub fn check_fence(&self, grant: &Grant) -> Result<(), Rejected> {
        if grant.fence != self.fence || grant.attempt != self.attempt {
            return Err(Rejected::StaleFence { task: self.id.clone(), carried: grant.fence });
        }
        Ok(())
    }

    /// Adds a checkpoint and removes the ones that `keep` does not retain; returns the removed ones.
    pub fn save(&mut self, saved: Saved, keep: &Keep) -> Vec<Saved> {
        (self.streak, self.losses) = (0, 0);
        self.checkpoints.retain(|old| old.step < saved.step);
        self.checkpoints.push(saved);
        let stay = keep.kept(&self.checkpoints.iter().map(|saved| &saved.metrics).collect::<Vec<_>>());
        let mut kept = Vec::new();
        let mut dropped = Vec::new();
        for (saved, stays) in std::mem::take(&mut self.checkpoints).into_iter().zip(stay) {
            if stays { kept.push(saved) } else { dropped.push(saved) }
        }
        self.checkpoints = kept;
        dropped
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn saved(step: u64, loss: f64) -> Saved {
        Saved { step, manifest: Digest::of(&step.to_le_bytes()), metrics: BTreeMap::from([("loss".to_owned(), loss)]) }
    }

    #[test]
    fn the_newest_and_the_best_checkpoints_are_kept() {
        let mut task = Task::new("r/s".into(), Part::Gang);
        let keep = Keep { latest: 2, best: 1, ..Keep::default() };
        let dropped: Vec<u64> = [(1, 0.5), (2, 0.1), (3, 0.9), (4, 0.3), (5, 0.2)]
            .into_iter()
            .flat_map(|(step, loss)| task.save(saved(step, loss), &keep))
            .map(|saved| saved.step)
            .collect();
        assert_eq!(task.checkpoints.iter().map(|s| s.step).collect::<Vec<_>>(), [2, 4, 5]);
        assert_eq!(dropped, [1, 3]);
        assert!(
            task.save(saved(6, f64::NAN), &Keep { latest: 0, ..Keep::default() }).len() == 3,
            "the newest always stays"
        );
    }

    #[test]
    fn a_grant_counts_only_as_a_whole() {
        let member =
            |name: &str| Member { worker: name.into(), incarnation: Incarnation(4), peer_address: String::new() };
        let mut task = Task::new("r/s".into(), Part::Gang);
        task.grant(vec![member("a"), member("b")], |_| String::new());
        task.regroup(vec![member("b"), member("a")], |_| String::new());
        let grant = task.grant_of(&"a".into(), Incarnation(4));
        assert_eq!(task.check(&grant), Ok(1), "its rank");
        let superseded = [
            Grant { fence: Fence(grant.fence.0 - 1), ..grant.clone() },
            Grant { fence: grant.fence.next(), ..grant.clone() },
            Grant { attempt: Attempt(0), ..grant.clone() },
            Grant { attempt: grant.attempt.next(), ..grant.clone() },
        ];
        for other in superseded {
            assert!(matches!(task.check(&other), Err(Rejected::StaleFence { .. })), "{other:?}");
            assert!(task.check_fence(&other).is_err(), "{other:?}");
        }
        let another_s = [
            Grant { worker: "c".into(), ..grant.clone() },
            Grant { incarnation: Incarnation(3), ..grant.clone() },
            Grant { incarnation: Incarnation(5), ..grant.clone() },
        ];
        for other in another_s {
            assert!(matches!(task.check(&other), Err(Rejected::Conflict(_))), "{other:?}");
        }
        task.release(None);
        assert!(matches!(task.check(&grant), Err(Rejected::StaleFence { .. })), "from the moment it is lost");
    }

    #[test]
    fn the_table_in_the_header_is_what_the_code_does() {
        let holder = Member { worker: "w".into(), incarnation: Incarnation(1), peer_address: String::new() };
        let waiting = Task::new("r/s".into(), Part::Gang);
        let mut held = waiting.clone();
        held.grant(vec![holder.clone()], |_| String::new());
        let mut done = held.clone();
        done.finish(Digest::of(b""));
        type Event = Box<dyn Fn(&mut Task)>;
        let by = holder.clone();
        let events: [Event; 6] = [
            Box::new(move |task| drop(task.grant(vec![holder.clone()], |_| String::new()))),
            Box::new(move |task| drop(task.regroup(vec![by.clone()], |_| String::new()))),
            Box::new(|task| drop(task.release(None))),
            Box::new(|task| task.finish(Digest::of(b"x"))),
            Box::new(|task| {
                assert!(!task.is_held() && task.output().is_none());
                task.reset_budgets();
            }),
            Box::new(|task| {
                assert!(task.is_held());
                task.drain(Some(Millis(1)));
            }),
        ];
        let name = |task: &Task| match task.lease {
            Lease::Waiting { .. } => "Waiting",
            Lease::Held { .. } => "Held",
            Lease::Done { .. } => "Done",
        };
        for task in [waiting, held, done] {
            let cells: Vec<&str> = events
                .iter()
                .map(|event| {
                    let mut task = task.clone();
                    let fence = task.fence;
                    let run = std::panic::AssertUnwindSafe(|| event(&mut task));
                    let panicked = std::panic::catch_unwind(run).is_err();
                    assert!(task.fence >= fence);
                    if panicked { "-" } else { name(&task) }
                })
                .collect();
            let row = format!("//! | {} | {} |", name(&task), cells.join(" | "));
            assert!(include_str!("task.rs").lines().any(|line| line == row), "{row}");
        }
    }
}
