//! One step on the state: the layout of a slice's results, and the update by their sum.

use protocol::message::StageTask;

use super::buffers::{AfterStep, SumPlan};
use super::group::{Gradients, Group};
use super::objective::{Objective, SliceResult};
use super::state::TrainState;
use crate::context::StageError;

/// Order of the values in a slice's vector: the gradients of the groups that the step trains, the terms, the sums.
pub(super) struct Layout {
    /// For each group its gradient's length; `None` if the step does not train it.
    gradients: Vec<Option<usize>>,
    pub(super) terms: usize,
    pub(super) sums: Vec<usize>,
}

impl Layout {
    pub(super) fn of(state: &TrainState, terms: usize, sums: &[SumPlan]) -> Self {
        let trained = |group: &Group| group.turn(state.step).map(|_| group.params.len());
        Self {
            gradients: state.groups.iter().map(trained).collect(),
            terms,
            sums: sums.iter().map(|sum| sum.len).collect(),
        }
    }

    /// Number of values.
    pub(super) fn len(&self) -> usize {
        self.gradients.iter().flatten().chain(&self.sums).sum::<usize>() + self.terms
    }

    /// Packs a slice's result into one vector.
    pub(super) fn pack(&self, result: SliceResult) -> Result<Vec<f32>, StageError> {
        let wanted: Vec<usize> = self.gradients.iter().map(|len| len.unwrap_or(0)).collect();
        let lengths = |parts: &[Vec<f32>]| parts.iter().map(Vec::len).collect::<Vec<_>>();
        let found = (lengths(&result.gradients), result.terms.len(), lengths(&result.sums));
        if found != (wanted, self.terms, self.sums.clone()) {
            let (gradients, terms, sums) = found;
            return Err(StageError::Fault(format!(
                "a slice has gradients of {gradients:?} values, {terms} terms and sums of {sums:?}; the plan has {:?}, \
                 {} and {:?}",
                self.gradients, self.terms, self.sums
            )));
        }
        // The first gradient may be gigabytes. It is not copied if the rest fits behind it. A network that is not trained has
        // an empty one.
        let mut gradients = result.gradients.into_iter().filter(|gradient| !gradient.is_empty());
        let mut flat = gradients.next().unwrap_or_default();
        gradients.for_each(|gradient| flat.extend(gradient));
        flat.extend(result.terms);
        result.sums.into_iter().for_each(|sum| flat.extend(sum));
        Ok(flat)
    }

    fn gradients<'a>(&self, mut packed: &'a [f32]) -> Vec<Option<&'a [f32]>> {
        let cut = |len: &Option<usize>| {
            let (head, tail) = packed.split_at((*len)?);
            packed = tail;
            Some(head)
        };
        self.gradients.iter().map(cut).collect()
    }

    pub(super) fn terms<'a>(&self, packed: &'a [f32]) -> &'a [f32] {
        let start: usize = self.gradients.iter().flatten().sum();
        &packed[start..start + self.terms]
    }

    pub(super) fn sums<'a>(&self, packed: &'a [f32], plans: &'a [SumPlan]) -> Vec<(&'a str, &'a [f32])> {
        let start = self.gradients.iter().flatten().sum::<usize>() + self.terms;
        let mut rest = &packed[start..];
        let cut = |plan: &'a SumPlan| {
            let (head, tail) = rest.split_at(plan.len);
            rest = tail;
            (plan.name.as_str(), head)
        };
        plans.iter().map(cut).collect()
    }
}

pub(super) struct Applied {
    pub(super) norm: f64,
    pub(super) lr: f64,
}

/// Makes one optimizer update of every group that the step trains. A step that only gathers sums has norm and rate 0.
pub(super) fn apply(state: &mut TrainState, layout: &Layout, sum: &[f32]) -> Result<Applied, StageError> {
    let gradients = Gradients::of(&state.groups, state.step, layout.gradients(sum));
    let (norm, lr) = gradients.watched(&state.groups).unwrap_or_default();
    let loss = layout.terms(sum)[0];
    if let Some(norm) = gradients.unbounded().or((!loss.is_finite()).then_some(norm)) {
        return Err(StageError::Diverged { step: state.step, loss: f64::from(loss), norm });
    }
    gradients.apply(&mut state.groups);
    state.step += 1;
    Ok(Applied { norm, lr })
}

/// Calls the objective's hook on the buffers for the step before `state.step`.
pub(super) fn hook(
    objective: &mut dyn Objective,
    state: &mut TrainState,
    sums: Vec<(&str, &[f32])>,
    task: &StageTask,
) -> Result<(), StageError> {
    let step = state.step - 1;
    let buffers = &mut state.buffers;
    objective.after(&mut AfterStep { step, buffers, sums, seed: task.seed, stage: &task.name })
}
