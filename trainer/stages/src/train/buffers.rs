//! State of a stage besides parameters, and results of its slices besides gradients.
//!
//! A slice's sums follow its gradients in one vector and are added along the same tree. So they too have the same bits
//! for any number of members. The change of the buffers in a step depends only on the sums, the step and keyed draws:
//! every member computes it itself with the same result.

use motion::Stream;
use protocol::{Seed, StageName};

/// A buffer and its initial values.
#[derive(Debug, Clone, PartialEq)]
pub struct BufferPlan {
    /// Name in a saved state, after `buffer.`.
    pub name: String,
    /// Initial values; their number never changes.
    pub values: Vec<f32>,
}

/// Codebooks, running statistics, counters: f32 values that no optimizer changes.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Buffers {
    all: Vec<BufferPlan>,
}

impl Buffers {
    /// # Panics
    /// If two buffers have one name.
    pub(super) fn new(plans: Vec<BufferPlan>) -> Self {
        for (i, plan) in plans.iter().enumerate() {
            assert!(plans[..i].iter().all(|other| other.name != plan.name), "two buffers `{}`", plan.name);
        }
        Self { all: plans }
    }

    /// The values of a buffer.
    ///
    /// # Panics
    /// If the objective has not planned a buffer of this name.
    pub fn get(&self, name: &str) -> &[f32] {
        &self.all.iter().find(|buffer| buffer.name == name).unwrap_or_else(|| panic!("no buffer `{name}`")).values
    }

    /// The values of a buffer, mutable.
    ///
    /// # Panics
    /// As [`get`](Self::get).
    pub fn get_mut(&mut self, name: &str) -> &mut [f32] {
        let found = self.all.iter_mut().find(|buffer| buffer.name == name);
        &mut found.unwrap_or_else(|| panic!("no buffer `{name}`")).values
    }

    /// Names and values, as planned.
    pub fn iter(&self) -> impl Iterator<Item = (&str, &[f32])> {
        self.all.iter().map(|buffer| (buffer.name.as_str(), buffer.values.as_slice()))
    }

    pub(super) fn values(&self) -> impl Iterator<Item = (String, &Vec<f32>)> {
        self.all.iter().map(|buffer| (format!("buffer.{}", buffer.name), &buffer.values))
    }

    pub(super) fn values_mut(&mut self) -> impl Iterator<Item = (String, &mut Vec<f32>)> {
        self.all.iter_mut().map(|buffer| (format!("buffer.{}", buffer.name), &mut buffer.values))
    }
}

/// A tensor that every slice returns, and its number of values.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct SumPlan {
    /// Name by which [`AfterStep`] finds it.
    pub name: String,
    /// Number of values.
    pub len: usize,
}

/// Inputs of the hook after a step.
#[derive(Debug)]
pub struct AfterStep<'a> {
    /// The step, from 0.
    pub step: u64,
    /// Buffers that the hook may change.
    pub buffers: &'a mut Buffers,
    pub(super) sums: Vec<(&'a str, &'a [f32])>,
    pub(super) seed: Seed,
    pub(super) stage: &'a StageName,
}

impl<'a> AfterStep<'a> {
    /// The sum over all slices of the step.
    ///
    /// # Panics
    /// If the objective has not planned a sum of this name.
    pub fn sum(&self, name: &str) -> &'a [f32] {
        self.sums.iter().find(|(known, _)| *known == name).unwrap_or_else(|| panic!("no sum `{name}`")).1
    }

    /// A generator with the same draws on every member: keyed by the run's seed, the stage, the step, `what` and
    /// `index`.
    pub fn stream(&self, what: &str, index: u64) -> Stream {
        Stream::new(self.seed, &format!("{}/{what}", self.stage), index, self.step)
    }
}
