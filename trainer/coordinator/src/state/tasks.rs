//! The tasks of one execution, with an index of the held and waiting ones. A decision must neither inspect nor copy
//! thousands of tasks.
//!
//! `Tasks::change` is the only way to change a task, which keeps the index correct. Invariant C14 checks it.

use std::ops::Index as Place;

use serde::{Deserialize, Serialize};

use super::shared::{List, Set};
use super::task::{Lease, Part, Task};
use crate::time::Millis;

/// The tasks of an execution.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[serde(from = "Vec<Task>", into = "Vec<Task>")]
pub struct Tasks {
    all: List<Task>,
    index: Index,
}

#[derive(Debug, Clone, Default, PartialEq)]
struct Index {
    held: Set<usize>,
    waiting: Set<usize>,
    /// Waiting tasks without a back-off.
    free: Set<usize>,
    /// Ends of back-offs and of grace periods.
    deadlines: Set<(Millis, usize)>,
    /// Number of held tasks that are asked to drain.
    draining: usize,
}

impl Index {
    /// Adds the task at `i` to the index, or removes it.
    fn note(&mut self, i: usize, lease: &Lease, there: bool) {
        let deadline = match lease {
            Lease::Held { drain_by, .. } => {
                put(&mut self.held, i, there);
                match there {
                    true => self.draining += usize::from(drain_by.is_some()),
                    false => self.draining -= usize::from(drain_by.is_some()),
                }
                *drain_by
            }
            Lease::Waiting { not_before } => {
                put(&mut self.waiting, i, there);
                if not_before.is_none() {
                    put(&mut self.free, i, there);
                }
                *not_before
            }
            Lease::Done { .. } => None,
        };
        if let Some(time) = deadline {
            put(&mut self.deadlines, (time, i), there);
        }
    }

    fn of<'a>(tasks: impl Iterator<Item = &'a Task>) -> Self {
        let mut index = Self::default();
        tasks.enumerate().for_each(|(i, task)| index.note(i, &task.lease, true));
        index
    }
}

fn put<T: Ord>(set: &mut Set<T>, value: T, there: bool) {
    if there {
        set.insert_mut(value);
    } else {
        set.remove_mut(&value);
    }
}

impl From<Vec<Task>> for Tasks {
    fn from(all: Vec<Task>) -> Self {
        Self::new(all)
    }
}

impl From<Tasks> for Vec<Task> {
    fn from(tasks: Tasks) -> Self {
        tasks.all.iter().cloned().collect()
    }
}

impl Tasks {
    /// Builds the index of these tasks.
    pub fn new(all: Vec<Task>) -> Self {
        let index = Index::of(all.iter());
        Self { all: all.into_iter().collect(), index }
    }

    pub fn len(&self) -> usize {
        self.all.len()
    }

    pub fn is_empty(&self) -> bool {
        self.all.is_empty()
    }

    /// All tasks in order.
    pub fn iter(&self) -> Iter<'_> {
        self.all.iter()
    }

    /// The first task.
    pub fn first(&self) -> Option<&Task> {
        self.all.first()
    }

    /// The task at an index.
    pub fn get(&self, i: usize) -> Option<&Task> {
        self.all.get(i)
    }

    /// Indexes of held tasks.
    pub fn held(&self) -> impl Iterator<Item = usize> + '_ {
        self.index.held.iter().copied()
    }

    /// The first task that waits without a back-off and can be done now: a merge needs its shards.
    pub fn first_ready(&self) -> Option<usize> {
        let first = *self.index.free.first()?;
        // The merge is the last task.
        (self.all[first].part != Part::Merge || self.open() == 1).then_some(first)
    }

    /// Number of tasks that wait without a back-off and can be done now.
    pub fn ready(&self) -> usize {
        let is_merge = |i: &usize| self.all[*i].part == Part::Merge;
        let waiting_merge = self.open() > 1 && self.index.free.last().is_some_and(is_merge);
        self.index.free.size() - usize::from(waiting_merge)
    }

    /// The end of the first back-off or grace period.
    pub fn first_deadline(&self) -> Option<Millis> {
        self.index.deadlines.first().map(|(time, _)| *time)
    }

    /// Indexes of tasks whose back-off or grace period ends at `now` or before.
    pub fn due(&self, now: Millis) -> impl Iterator<Item = usize> + '_ {
        self.index.deadlines.iter().take_while(move |(time, _)| *time <= now).map(|(_, i)| *i)
    }

    /// Returns true if a worker holds a shard.
    pub fn is_any_shard_held(&self) -> bool {
        self.held().next().is_some_and(|i| matches!(self.all[i].part, Part::Shard { .. }))
    }

    /// Returns true if a worker holds a task.
    pub fn is_any_held(&self) -> bool {
        !self.index.held.is_empty()
    }

    /// Number of tasks that are not done.
    pub fn open(&self) -> usize {
        self.index.held.size() + self.index.waiting.size()
    }

    /// Returns true if all held tasks (`asked`), or none of them, are asked to drain.
    pub fn all_draining(&self, asked: bool) -> bool {
        self.index.draining == if asked { self.index.held.size() } else { 0 }
    }

    /// Returns true if the index matches the tasks.
    pub fn is_indexed(&self) -> bool {
        self.index == Index::of(self.all.iter())
    }

    pub(super) fn change(&mut self, i: usize, change: impl FnOnce(&mut Task)) {
        let Some(task) = self.all.get_mut(i) else { return };
        self.index.note(i, &task.lease, false);
        change(task);
        self.index.note(i, &task.lease, true);
    }
}

impl Place<usize> for Tasks {
    type Output = Task;

    fn index(&self, i: usize) -> &Task {
        &self.all[i]
    }
}

/// An iterator over tasks in order.
pub type Iter<'a> = <&'a List<Task> as IntoIterator>::IntoIter;

impl<'a> IntoIterator for &'a Tasks {
    type Item = &'a Task;
    type IntoIter = Iter<'a>;

    fn into_iter(self) -> Self::IntoIter {
        self.iter()
    }
}
