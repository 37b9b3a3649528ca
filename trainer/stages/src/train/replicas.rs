//! Replicas: copies of the state that make updates on their own, and their average.

use std::ops::Range;

use protocol::stage::{Replicas, Training};

use super::group::Group;
use super::objective::Objective;
use super::state::TrainState;
use super::step::{Applied, Layout, apply};
use crate::context::StageError;
use crate::tree::tree_sum;

/// The replicas of a training.
#[derive(Debug, Clone, Copy)]
pub(super) struct Averaging {
    every: u64,
    replicas: usize,
    /// Slices of each replica's batch.
    slices: usize,
}

impl Averaging {
    /// The replicas that `training` asks for, if any.
    pub(super) fn of(training: &Training) -> Option<Self> {
        let Replicas { every, replicas } = training.replicas()?;
        Some(Self { every: every.0, replicas, slices: training.batch.slices / replicas })
    }

    /// The updates of the round that begins after `step` of `steps` updates. Rounds end at multiples of their length.
    pub(super) fn round(&self, step: u64, steps: u64) -> Range<u64> {
        let next = (step / self.every + 1) * self.every;
        step..next.min(steps)
    }

    /// Makes one replica's updates of `round` from `state`, and packs its values for an exchange. They are parameters,
    /// moments and average of each trained group, then means of the terms and of the gradient norm.
    pub(super) fn compute(
        &self,
        objective: &mut dyn Objective,
        state: &TrainState,
        round: &Range<u64>,
        replica: usize,
        mut done: impl FnMut(u64, f32),
    ) -> Result<Vec<f32>, StageError> {
        let slices: Vec<usize> = (replica * self.slices..(replica + 1) * self.slices).collect();
        let mut own = state.clone();
        let mut watched = vec![0.0; objective.terms().len() + 1];
        #[expect(clippy::cast_precision_loss, reason = "at most 4,096 replicas and 100,000 updates")]
        let (replicas, share) = (self.replicas as f32, 1.0 / (round.end - round.start) as f32);
        while own.step < round.end {
            objective.load(&own);
            let layout = Layout::of(&own, watched.len() - 1, &[]);
            let results = objective.slices(own.step, &slices)?;
            let packed = results.into_iter().map(|result| layout.pack(result)).collect::<Result<Vec<_>, _>>()?;
            let leaves = packed.into_iter().enumerate().map(|(slice, values)| (slice..slice + 1, values));
            let mut sum = tree_sum(self.slices, leaves);
            // Slices are shares of the global batch; a replica's update is that of its own.
            sum.iter_mut().for_each(|value| *value *= replicas);
            let applied = apply(&mut own, &layout, &sum)?;
            #[expect(clippy::cast_possible_truncation, reason = "a norm is recorded")]
            let values = layout.terms(&sum).iter().copied().chain([applied.norm as f32]);
            watched.iter_mut().zip(values).for_each(|(mean, value)| *mean += value * share);
            done(own.step, layout.terms(&sum)[0]);
        }
        own.fetch();
        let trained = own.groups.iter().filter(|group| group.is_trained()).flat_map(Group::flat);
        Ok(trained.flatten().copied().chain(watched).collect())
    }

    /// Replaces the values of `state` by the mean of the replicas; `sum` is their sum. Returns the means of the
    /// terms, and of the gradient norms with the rate of the last update.
    pub(super) fn apply(&self, state: &mut TrainState, round: &Range<u64>, mut sum: Vec<f32>) -> (Vec<f32>, Applied) {
        #[expect(clippy::cast_precision_loss, reason = "at most 4,096 replicas")]
        let replicas = self.replicas as f32;
        sum.iter_mut().for_each(|value| *value /= replicas);
        let mut rest = sum.as_slice();
        let groups = state.groups.iter_mut().filter(|group| group.is_trained());
        for values in groups.flat_map(Group::flat_mut) {
            let (now, later) = rest.split_at(values.len());
            values.copy_from_slice(now);
            rest = later;
        }
        state.step = round.end;
        let last = round.end - 1;
        let lr = state.groups.iter().find_map(|group| Some(group.lr.at(group.turn(last)?))).unwrap_or_default();
        let (norm, terms) = rest.split_last().expect("the gradient norm is the last value");
        (terms.to_vec(), Applied { norm: f64::from(*norm), lr })
    }
}

#[cfg(test)]
mod tests {
    use models::optim::{AdamW, LrSchedule};
    use protocol::Steps;
    use protocol::stage::{Batch, Decay, TrainVae};

    use super::*;
    use crate::train::{GroupPlan, SliceResult, Turns};

    /// The loss of slice `i` is half the squared distance of a number from `i`, over all slices.
    struct Distances {
        slices: usize,
        number: f32,
    }

    impl Objective for Distances {
        fn groups(&mut self) -> Vec<GroupPlan> {
            vec![GroupPlan {
                name: "number",
                entries: Vec::new(),
                params: vec![10.0],
                optimizer: AdamW { beta1: 0.0, beta2: 0.0, eps: 1e-3, weight_decay: 0.0 },
                lr: LrSchedule { peak: 0.5, warmup: 0, steps: 100, decay: Decay::Constant },
                clip: None,
                average: None,
                turns: Turns::ALWAYS,
            }]
        }
        fn terms(&self) -> Vec<&'static str> {
            vec!["loss"]
        }
        fn load(&mut self, state: &TrainState) {
            self.number = state.params(0)[0];
        }
        fn slice(&mut self, _: u64, slice: usize) -> Result<SliceResult, StageError> {
            let share = 1.0 / self.slices as f32;
            let gap = self.number - slice as f32;
            Ok(SliceResult { gradients: vec![vec![gap * share]], terms: vec![gap * gap / 2.0 * share], sums: vec![] })
        }
    }

    #[test]
    fn the_state_is_the_mean_of_replicas_that_see_their_own_slices() {
        let training = Training {
            batch: Batch { global: 4, slices: 4 },
            sync: Replicas { every: Steps(20), replicas: 2 },
            ..TrainVae::default().training
        };
        let averaging = Averaging::of(&training).expect("two replicas");
        let mut distances = Distances { slices: 4, number: 0.0 };
        let mut state = TrainState::new(distances.groups(), Vec::new());
        state.step = 40;
        let round = averaging.round(40, 1000);
        assert_eq!((round.clone(), averaging.round(47, 1000), averaging.round(40, 44)), (40..60, 47..60, 40..44));
        let mut compute =
            |replica| averaging.compute(&mut distances, &state, &round, replica, |_, _| {}).expect("computed");
        // Without memory, an update is a step of the learning rate against the gradient's sign: after twenty, a replica
        // is beside the mean of its slices, .5 or 2.5.
        let parts = [compute(0), compute(1)];
        assert!((parts[0][0] - 0.5).abs() <= 0.5 && (parts[1][0] - 2.5).abs() <= 0.5, "{parts:?}");
        let mean = (parts[0][0] + parts[1][0]) / 2.0;
        let (terms, applied) = averaging.apply(&mut state, &round, tree_sum(2, [0..1, 1..2].into_iter().zip(parts)));
        assert_eq!(state.params(0), [mean]);
        assert_eq!((state.step, applied.lr), (60, 0.5));
        assert!(terms.len() == 1 && (0.0..36.75).contains(&terms[0]) && applied.norm > 0.0, "{terms:?}");
        // The means of one update: losses of 45.25 and 28.25 of the replicas' own batches, gradients of 9.5 and 7.5.
        state = TrainState::new(distances.groups(), Vec::new());
        let parts = [0, 1]
            .map(|replica| averaging.compute(&mut distances, &state, &(0..1), replica, |_, _| {}).expect("computed"));
        let (terms, applied) = averaging.apply(&mut state, &(0..1), tree_sum(2, [0..1, 1..2].into_iter().zip(parts)));
        assert_eq!((terms, applied.norm, state.step), (vec![36.75], 8.5, 1));
    }
}
