//! The tasks of one work, by place, and who of them is held or waits: with thousands of tasks one decision must not look at all.
//!
//! Read as a slice. `Tasks::change` is the only way to change a task, so that the index cannot be wrong; invariant C14.

use std::collections::BTreeSet;
use std::ops::Deref;

use serde::{Deserialize, Serialize};

use super::task::{Lease, Task};

/// The tasks of a work.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[serde(from = "Vec<Task>", into = "Vec<Task>")]
pub struct Tasks {
    all: Vec<Task>,
    index: Index,
}

#[derive(Debug, Clone, Default, PartialEq)]
struct Index {
    held: BTreeSet<usize>,
    waiting: BTreeSet<usize>,
    /// Of the held ones, how many are asked to drain.
    draining: usize,
}

impl Index {
    /// Puts the task at `i` in, or takes it out.
    fn note(&mut self, i: usize, lease: &Lease, there: bool) {
        let set = match lease {
            Lease::Held { drain_by, .. } => {
                match there {
                    true => self.draining += usize::from(drain_by.is_some()),
                    false => self.draining -= usize::from(drain_by.is_some()),
                }
                &mut self.held
            }
            Lease::Waiting { .. } => &mut self.waiting,
            Lease::Done { .. } => return,
        };
        if there {
            set.insert(i)
        } else {
            set.remove(&i)
        };
    }

    fn of(tasks: &[Task]) -> Self {
        let mut index = Self::default();
        tasks.iter().enumerate().for_each(|(i, task)| index.note(i, &task.lease, true));
        index
    }
}

impl From<Vec<Task>> for Tasks {
    fn from(all: Vec<Task>) -> Self {
        Self::new(all)
    }
}

impl From<Tasks> for Vec<Task> {
    fn from(tasks: Tasks) -> Self {
        tasks.all
    }
}

impl Tasks {
    /// These tasks.
    pub fn new(all: Vec<Task>) -> Self {
        let index = Index::of(&all);
        Self { all, index }
    }

    /// Places of those that somebody has.
    pub fn held(&self) -> impl Iterator<Item = usize> + '_ {
        self.index.held.iter().copied()
    }

    /// Places of those that nobody has and that are not done.
    pub fn waiting(&self) -> impl Iterator<Item = usize> + '_ {
        self.index.waiting.iter().copied()
    }

    /// Whether somebody has any of them.
    pub fn is_any_held(&self) -> bool {
        !self.index.held.is_empty()
    }

    /// How many are not done.
    pub fn open(&self) -> usize {
        self.index.held.len() + self.index.waiting.len()
    }

    /// Whether all (`asked`) or none of the held ones are asked to drain.
    pub fn all_draining(&self, asked: bool) -> bool {
        self.index.draining == if asked { self.index.held.len() } else { 0 }
    }

    /// Whether the index says what the tasks say.
    pub fn is_indexed(&self) -> bool {
        self.index == Index::of(&self.all)
    }

    pub(super) fn change<T>(&mut self, i: usize, change: impl FnOnce(&mut Task) -> T) -> T {
        self.index.note(i, &self.all[i].lease, false);
        let made = change(&mut self.all[i]);
        self.index.note(i, &self.all[i].lease, true);
        made
    }
}

impl Deref for Tasks {
    type Target = [Task];

    fn deref(&self) -> &[Task] {
        &self.all
    }
}

impl<'a> IntoIterator for &'a Tasks {
    type Item = &'a Task;
    type IntoIter = std::slice::Iter<'a, Task>;

    fn into_iter(self) -> Self::IntoIter {
        self.all.iter()
    }
}
