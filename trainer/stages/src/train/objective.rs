//! The interface between the loop and a training kind.

use super::buffers::{AfterStep, BufferPlan, SumPlan};
use super::group::GroupPlan;
use super::state::TrainState;
use crate::context::StageError;

/// Result of one slice of a step.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct SliceResult {
    /// For each group the gradient of
    /// `sum over the slice's examples of the example's loss, divided by the global batch`. Empty for a group that the
    /// step does not train.
    pub gradients: Vec<Vec<f32>>,
    /// For each term its sum over the slice's examples, divided by the global batch.
    pub terms: Vec<f32>,
    /// For each planned sum the slice's share of it.
    pub sums: Vec<Vec<f32>>,
}

/// The mathematics of one stage: parameters and examples to gradients.
pub trait Objective {
    /// The groups with their initial values. Called before the first [`load`](Self::load), and possibly once more then.
    fn groups(&mut self) -> Vec<GroupPlan>;

    /// The buffers, which only [`after`](Self::after) changes.
    fn buffers(&mut self) -> Vec<BufferPlan> {
        Vec::new()
    }

    /// Names of the values that every slice returns besides gradients. The first is the loss; training stops if it is
    /// not finite.
    fn terms(&self) -> Vec<&'static str>;

    /// Sums that every slice returns for [`after`](Self::after).
    fn sums(&self) -> Vec<SumPlan> {
        Vec::new()
    }

    /// Loads the parameters and buffers of `state` before the slices of a step.
    fn load(&mut self, state: &TrainState);

    /// Computes slice `slice` of step `step`.
    fn slice(&mut self, step: u64, slice: usize) -> Result<SliceResult, StageError>;

    /// Computes this member's slices of step `step`, in the order of `slices`. Rows of a batch do not depend on each
    /// other, so one pass may compute several slices. Each result must have the bits of [`slice`](Self::slice), because
    /// gangs differ in the slices that a member computes together.
    fn slices(&mut self, step: u64, slices: &[usize]) -> Result<Vec<SliceResult>, StageError> {
        slices.iter().map(|slice| self.slice(step, *slice)).collect()
    }

    /// Changes the buffers after the update of the groups. Every member does so itself and must get the same bits, so
    /// the result may depend only on `_step`.
    fn after(&mut self, _step: &mut AfterStep<'_>) -> Result<(), StageError> {
        Ok(())
    }
}
