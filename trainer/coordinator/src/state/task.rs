//! One task: the right to do it, its tries, its newest checkpoints.
//!
//! | hold \ event | grant | regroup | release | finish | back-off over | drain |
//! |---|---|---|---|---|---|---|
//! | Waiting | Held | - | - | - | Waiting | - |
//! | Held | - | Held | Waiting | Done | - | Held |
//! | Done | - | - | - | - | - | - |
//!
//! `-` is never asked for by `decide`, and panics. The fence grows with each grant and regroup, and again with each
//! release, so that the store refuses a writer from the moment it lost the task and not only once another has it. The
//! attempt grows with each grant: a grant starts from a checkpoint or from nothing, a regroup from live state.

use std::collections::BTreeMap;

use protocol::message::{Grant, Member, ReportOutcome};
use protocol::stage::Keep;
use protocol::{Attempt, Digest, Fence, Incarnation, TaskId, WorkerId};
use registry::Write;
use serde::{Deserialize, Serialize};

use crate::rejected::Rejected;
use crate::time::Millis;

/// What part of a stage a task is.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Part {
    /// All of a plain stage.
    Alone,
    /// All of a training stage, by several workers.
    Gang,
    /// One shard of a map stage.
    Shard {
        /// Which, from 0.
        index: u32,
        /// Of how many.
        of: u32,
    },
    /// The merge of a map stage's shards.
    Merge,
    /// Digesting what a stage's settings name outside the store.
    Resolve,
}

/// Who has the right to a task.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Lease {
    /// Nobody.
    Waiting {
        /// Not to be granted before this.
        not_before: Option<Millis>,
    },
    /// These workers; one unless the task is a gang's.
    Held {
        /// Rank by rank.
        holders: Vec<Member>,
        /// Proves to a peer that one is of this generation.
        secret: String,
        /// Asked to drain; released by force at this time.
        drain_by: Option<Millis>,
    },
    /// Done.
    Done {
        /// The artifact.
        output: Digest,
    },
}

/// A committed checkpoint.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Saved {
    /// Steps applied.
    pub step: u64,
    pub manifest: Digest,
    /// What retention may rank by.
    pub metrics: BTreeMap<String, f64>,
}

/// A task.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Task {
    /// Its name.
    pub id: TaskId,
    /// What part of the stage it is.
    pub part: Part,
    /// Who has it.
    pub lease: Lease,
    /// The newest try; 0 before the first.
    pub attempt: Attempt,
    /// The newest fence; 0 before the first.
    pub fence: Fence,
    /// Faults since it was last opened.
    pub faults: u32,
    /// Losses since something was last achieved: a task that makes progress may lose any number of workers.
    pub losses: u32,
    /// Failures since something was last achieved.
    pub streak: u32,
    /// Workers that have not enough memory for it; they are not given it again.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub too_small: Vec<WorkerId>,
    /// Kept checkpoints, oldest first.
    pub checkpoints: Vec<Saved>,
    /// The report that was last accepted: a report that is sent twice is answered twice.
    pub reported: Option<ReportOutcome>,
}

impl Task {
    /// A task that nobody has tried.
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

    /// Whether somebody has it.
    pub fn is_held(&self) -> bool {
        matches!(self.lease, Lease::Held { .. })
    }

    /// Its artifact, once done.
    pub fn output(&self) -> Option<Digest> {
        match self.lease {
            Lease::Done { output } => Some(output),
            Lease::Waiting { .. } | Lease::Held { .. } => None,
        }
    }

    /// Whether it may be granted now.
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

    /// Gives it away: a new try.
    pub fn grant(&mut self, holders: Vec<Member>, secret: impl FnOnce(Fence) -> String) -> Write {
        assert!(matches!(self.lease, Lease::Waiting { .. }) && !holders.is_empty(), "grant of {self:?}");
        self.attempt = self.attempt.next();
        self.lease_to(holders, secret)
    }

    /// Changes who has it without a new try.
    pub fn regroup(&mut self, holders: Vec<Member>, secret: impl FnOnce(Fence) -> String) -> Write {
        assert!(self.is_held() && self.part == Part::Gang && !holders.is_empty(), "regroup of {self:?}");
        self.lease_to(holders, secret)
    }

    fn lease_to(&mut self, holders: Vec<Member>, secret: impl FnOnce(Fence) -> String) -> Write {
        let drain_by = match self.lease {
            Lease::Held { drain_by, .. } => drain_by,
            Lease::Waiting { .. } | Lease::Done { .. } => None,
        };
        let fence = self.raise();
        self.lease = Lease::Held { holders, secret: secret(self.fence), drain_by };
        fence
    }

    /// Waits no longer if its back-off is over at `now`; whether it was.
    pub fn end_backoff(&mut self, now: Millis) -> bool {
        match &mut self.lease {
            Lease::Waiting { not_before } if not_before.is_some_and(|time| time <= now) => {
                *not_before = None;
                true
            }
            Lease::Waiting { .. } | Lease::Held { .. } | Lease::Done { .. } => false,
        }
    }

    /// Takes it away: its holders can write no more.
    pub fn release(&mut self, not_before: Option<Millis>) -> Write {
        assert!(self.is_held(), "release of {self:?}");
        self.lease = Lease::Waiting { not_before };
        self.raise()
    }

    /// Takes note that its holders gave it back themselves. What they still have to say about it they may.
    pub fn give_back(&mut self, not_before: Option<Millis>) {
        assert!(self.is_held(), "giving back of {self:?}");
        self.lease = Lease::Waiting { not_before };
    }

    /// Takes note of its artifact.
    pub fn finish(&mut self, output: Digest) {
        assert!(self.is_held(), "finish of {self:?}");
        self.lease = Lease::Done { output };
        self.streak = 0;
    }

    /// Forgets everything but its numbers, which only grow.
    pub fn reopen(&mut self) {
        self.reset_budgets();
        self.checkpoints.clear();
        self.lease = Lease::Waiting { not_before: None };
    }

    /// Gives it its restart budgets back.
    pub fn reset_budgets(&mut self) {
        (self.faults, self.losses, self.streak) = (0, 0, 0);
        self.too_small.clear();
        if let Lease::Waiting { not_before } = &mut self.lease {
            *not_before = None;
        }
    }

    /// Asks its holders to drain until `deadline`, or (`None`) to carry on.
    pub fn drain(&mut self, deadline: Option<Millis>) {
        if let Lease::Held { drain_by, .. } = &mut self.lease {
            *drain_by = match (*drain_by, deadline) {
                (Some(already), Some(_)) => Some(already),
                (_, deadline) => deadline,
            };
        }
    }

    fn raise(&mut self) -> Write {
        self.fence = self.fence.next();
        Write::Fence { task: self.id.clone(), fence: self.fence }
    }

    /// Checks a grant: current, and its bearer's. Returns the bearer's rank.
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

    /// Checks only that a grant has not been superseded: what a worker says about work that it has just ended still counts.
    pub fn check_fence(&self, grant: &Grant) -> Result<(), Rejected> {
        if grant.fence != self.fence || grant.attempt != self.attempt {
            return Err(Rejected::StaleFence { task: self.id.clone(), carried: grant.fence });
        }
        Ok(())
    }

    /// Adds a checkpoint and drops those that `keep` does not keep; returns the dropped ones.
    pub fn save(&mut self, saved: Saved, keep: &Keep) -> Vec<Saved> {
        (self.streak, self.losses) = (0, 0);
        self.checkpoints.retain(|old| old.step < saved.step);
        self.checkpoints.push(saved);
        let stay = keep.kept(&self.checkpoints.iter().map(|saved| &saved.metrics).collect::<Vec<_>>());
        let (mut kept, mut dropped) = (Vec::new(), Vec::new());
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
