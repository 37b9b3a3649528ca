//! A group: parameters that share an optimizer, and the steps that train them.

use std::ops::Range;

use burn::tensor::Device;
use models::flat::{Entry, Values};
use models::optim::{AdamW, LrSchedule, clip_factor, ema, global_norm};
use models::resident::{Host, Resident};

/// The steps that train a group.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Turns {
    during: Range<u64>,
    every: u64,
    at: u64,
}

impl Turns {
    /// All steps.
    pub const ALWAYS: Self = Self { during: 0..u64::MAX, every: 1, at: 0 };
    /// No steps: the group is a frozen part of the model, without moments.
    pub const NEVER: Self = Self { during: 0..0, every: 1, at: 0 };

    /// The steps of one phase.
    pub fn during(steps: Range<u64>) -> Self {
        Self { during: steps, ..Self::ALWAYS }
    }

    /// Restricts the steps to one in `every`, starting `at` steps after the first. Groups with the same `every` and
    /// different `at` take turns.
    ///
    /// # Panics
    /// If `at` is not below `every`.
    #[must_use]
    pub fn one_in(self, every: u64, at: u64) -> Self {
        assert!(at < every, "turn {at} of {every}");
        Self { every, at, ..self }
    }

    /// The number of the group's update in step `step`, from 0; `None` if the step does not train the group.
    pub fn turn(&self, step: u64) -> Option<u64> {
        let local = step.checked_sub(self.during.start).filter(|_| step < self.during.end)?;
        (local % self.every == self.at).then_some(local / self.every)
    }

    /// Number of updates among the first `steps` steps.
    pub fn count(&self, steps: u64) -> u64 {
        let local = steps.min(self.during.end).saturating_sub(self.during.start);
        (local + self.every - 1 - self.at) / self.every
    }
}

/// Limit of a gradient's norm.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Clip {
    /// The largest norm that is not scaled down.
    pub norm: f64,
    /// Groups with the same name here are clipped together, by the norm of those that the step trains.
    pub together: &'static str,
}

/// A moving average of a group's parameters.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Average {
    /// Decay of the average in each of its updates.
    pub decay: f64,
    /// Number of parameter updates per update of the average.
    pub every: u64,
    /// The first update copies the parameters.
    pub starts_as_copy: bool,
}

impl Average {
    /// An average that is updated after every step and starts from the initial parameters.
    pub fn of(decay: f64) -> Self {
        Self { decay, every: 1, starts_as_copy: false }
    }

    /// The change of the average after update number `turn` (from 0).
    fn at(&self, turn: u64) -> Follow {
        let done = turn + 1;
        if self.starts_as_copy && done == self.every {
            Follow::Copy
        } else if done.is_multiple_of(self.every) {
            Follow::Move(self.decay)
        } else {
            Follow::Stay
        }
    }
}

/// One set of parameters with an optimizer of its own.
#[derive(Debug, Clone)]
pub struct GroupPlan {
    /// Short name, such as `model` or `heads`.
    pub name: &'static str,
    /// Names and shapes of the tensors in the buffer.
    pub entries: Vec<Entry>,
    /// Initial values.
    pub params: Vec<f32>,
    pub optimizer: AdamW,
    /// Learning rate as a function of the group's own updates.
    pub lr: LrSchedule,
    /// Clipping, if any.
    pub clip: Option<Clip>,
    /// Moving average of the parameters, if one is kept.
    pub average: Option<Average>,
    /// Steps that train the group.
    pub turns: Turns,
}

impl GroupPlan {
    /// Restricts the group's training to `turns`; its schedule spans those among the first `steps` steps.
    #[must_use]
    pub fn taking(self, turns: Turns, steps: u64) -> Self {
        Self { lr: LrSchedule { steps: turns.count(steps), ..self.lr }, turns, ..self }
    }
}

/// Location of the newest values.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Newer {
    /// Host and accelerator have equal values.
    Nowhere,
    /// The accelerator has newer values.
    There,
}

/// Change of an average in an update.
enum Follow {
    Copy,
    Move(f64),
    Stay,
}

/// A group in training, as flat buffers. While it trains on an accelerator its newest values are there, and those of
/// the host are older.
#[derive(Debug, Clone)]
pub struct Group {
    pub name: &'static str,
    /// Names and shapes of the tensors in the buffer.
    pub entries: Vec<Entry>,
    pub(super) params: Vec<f32>,
    /// First moments of AdamW; empty for a frozen group.
    pub(super) m: Vec<f32>,
    /// Second moments of AdamW; empty for a frozen group.
    pub(super) v: Vec<f32>,
    /// Moving average of the parameters, if the plan has one.
    pub(super) average: Option<Vec<f32>>,
    /// The same buffers on an accelerator, if training runs on one, and the location of the newest values.
    resident: Option<(Resident, Newer)>,
    /// Learning rate by the group's own updates.
    pub lr: LrSchedule,
    optimizer: AdamW,
    clip: Option<Clip>,
    averaging: Option<Average>,
    turns: Turns,
}

/// Compares the host's values.
impl PartialEq for Group {
    fn eq(&self, other: &Self) -> bool {
        let plan = |group: &Self| (group.name, group.lr, group.optimizer, group.clip, group.averaging);
        let rest = |a: &Self, b: &Self| a.entries == b.entries && a.turns == b.turns;
        let values = |a: &Self, b: &Self| (&a.params, &a.m, &a.v, &a.average) == (&b.params, &b.m, &b.v, &b.average);
        plan(self) == plan(other) && rest(self, other) && values(self, other)
    }
}

impl Group {
    pub(super) fn new(plan: GroupPlan) -> Self {
        let moments = if plan.turns == Turns::NEVER { 0 } else { plan.params.len() };
        Self {
            name: plan.name,
            entries: plan.entries,
            m: vec![0.0; moments],
            v: vec![0.0; moments],
            average: plan.average.map(|_| plan.params.clone()),
            params: plan.params,
            resident: None,
            lr: plan.lr,
            optimizer: plan.optimizer,
            clip: plan.clip,
            averaging: plan.average,
            turns: plan.turns,
        }
    }

    /// The number of this group's update in step `step`, from 0; `None` if the step does not train it.
    pub fn turn(&self, step: u64) -> Option<u64> {
        self.turns.turn(step)
    }

    /// Applies update number `turn` (from 0) with `factor` times the gradient, then moves the average.
    pub(super) fn update(&mut self, turn: u64, gradient: &[f32], factor: f64) {
        #[expect(clippy::cast_possible_truncation, reason = "a factor in (0, 1]")]
        let factor = factor as f32;
        if let Some((resident, newer)) = &mut self.resident {
            resident.step(&self.optimizer, turn + 1, self.lr.at(turn), gradient, factor);
            match self.averaging.map(|averaging| averaging.at(turn)) {
                Some(Follow::Copy) => resident.copy(),
                Some(Follow::Move(decay)) => resident.follow(decay),
                Some(Follow::Stay) | None => {}
            }
            *newer = Newer::There;
            return;
        }
        let lr = self.lr.at(turn);
        self.optimizer.step_by(factor, turn + 1, lr, &mut self.params, gradient, &mut self.m, &mut self.v);
        if let (Some(averaging), Some(average)) = (self.averaging, &mut self.average) {
            match averaging.at(turn) {
                Follow::Copy => average.copy_from_slice(&self.params),
                Follow::Move(decay) => ema(average, &self.params, decay),
                Follow::Stay => {}
            }
        }
    }

    /// The parameters, on the device that holds them.
    pub fn trained(&self) -> Values<'_> {
        match &self.resident {
            Some((resident, _)) => Values::Device(resident.params()),
            None => Values::Host(&self.params),
        }
    }

    /// The result of the training, on the device that holds it: the average if one is kept, else the parameters.
    pub fn averaged(&self) -> Values<'_> {
        match &self.resident {
            Some((resident, _)) => Values::Device(resident.average().unwrap_or(resident.params())),
            None => Values::Host(self.average.as_ref().unwrap_or(&self.params)),
        }
    }

    /// Copies the host's values to `device`, and trains there from now on.
    pub(super) fn send(&mut self, device: &Device) {
        let resident = Resident::send(&self.host(), device);
        self.resident = Some((resident, Newer::Nowhere));
    }

    /// Copies newer values of the accelerator to the host.
    pub(super) fn fetch(&mut self) {
        if let Some((resident, _)) = self.resident.take_if(|(_, newer)| *newer == Newer::There) {
            resident.fetch(self.host());
            self.resident = Some((resident, Newer::Nowhere));
        }
    }

    /// Returns true if the host has the newest values.
    pub(super) fn is_fetched(&self) -> bool {
        self.resident.as_ref().is_none_or(|(_, newer)| *newer == Newer::Nowhere)
    }

    /// Returns true unless it is frozen.
    pub(super) fn is_trained(&self) -> bool {
        self.turns != Turns::NEVER
    }

    /// The host's values: parameters, moments and the average.
    pub(super) fn flat(&self) -> impl Iterator<Item = &Vec<f32>> {
        [&self.params, &self.m, &self.v].into_iter().chain(&self.average)
    }

    /// Like [`flat`](Self::flat), mutable.
    pub(super) fn flat_mut(&mut self) -> impl Iterator<Item = &mut Vec<f32>> {
        let Self { params, m, v, average, .. } = self;
        [params, m, v].into_iter().chain(average)
    }

    fn host(&mut self) -> Host<'_> {
        let Self { params, m, v, average, .. } = self;
        Host { params, m, v, average: average.as_deref_mut() }
    }
}

/// The gradients of a step for the groups that it trains.
pub(super) struct Gradients<'a> {
    /// For each group its update's number, gradient and gradient norm; `None` if the step does not train it.
    parts: Vec<Option<(u64, &'a [f32], f64)>>,
}

impl<'a> Gradients<'a> {
    /// Collects one gradient for each group that step `step` trains, and `None` for the others.
    pub(super) fn of(groups: &[Group], step: u64, gradients: Vec<Option<&'a [f32]>>) -> Self {
        let part = |(group, gradient): (&Group, Option<&'a [f32]>)| {
            let gradient = gradient?;
            Some((group.turn(step)?, gradient, global_norm(gradient)))
        };
        Self { parts: groups.iter().zip(gradients).map(part).collect() }
    }

    /// Returns a norm that is not finite, if there is one.
    pub(super) fn unbounded(&self) -> Option<f64> {
        self.parts.iter().flatten().map(|(_, _, norm)| *norm).find(|norm| !norm.is_finite())
    }

    /// Norm and learning rate of the first group that the step trains, which represent the step.
    pub(super) fn watched(&self, groups: &[Group]) -> Option<(f64, f64)> {
        groups.iter().zip(&self.parts).find_map(|(group, part)| part.map(|(turn, _, norm)| (norm, group.lr.at(turn))))
    }

    /// The factor of each group's gradient, 1 without clipping.
    fn factors(&self, groups: &[Group]) -> Vec<f64> {
        let norm_of = |name: &str| {
            let same = groups.iter().zip(&self.parts).filter(|(g, _)| g.clip.is_some_and(|c| c.together == name));
            let norms: Vec<f64> = same.filter_map(|(_, part)| part.map(|(_, _, norm)| norm)).collect();
            // A single group uses the norm itself: the root of its square may differ.
            if let [only] = norms[..] { only } else { norms.iter().map(|n| n * n).sum::<f64>().sqrt() }
        };
        groups.iter().map(|g| g.clip.map_or(1.0, |clip| clip_factor(norm_of(clip.together), clip.norm))).collect()
    }

    /// Applies the update of every group.
    pub(super) fn apply(self, groups: &mut [Group]) {
        let factors = self.factors(groups);
        for ((group, part), factor) in groups.iter_mut().zip(self.parts).zip(factors) {
            if let Some((turn, gradient, _)) = part {
                group.update(turn, gradient, factor);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use protocol::stage::Decay;

    use super::*;

    #[test]
    fn turns_count_their_own_updates() {
        let taken = |turns: &Turns| (0..10).map(|step| turns.turn(step)).collect::<Vec<_>>();
        let first = Turns::ALWAYS.one_in(2, 0);
        assert_eq!(taken(&first)[..4], [Some(0), None, Some(1), None]);
        let second = Turns::during(3..9).one_in(3, 1);
        assert_eq!(taken(&second), [None, None, None, None, Some(0), None, None, Some(1), None, None]);
        for turns in [Turns::ALWAYS, Turns::NEVER, first, second, Turns::during(4..7), Turns::ALWAYS.one_in(3, 2)] {
            for steps in 0..10 {
                let counted = taken(&turns)[..steps].iter().flatten().count() as u64;
                assert_eq!(turns.count(steps as u64), counted, "{turns:?} of {steps}");
            }
        }
    }

    fn plan(name: &'static str, turns: Turns) -> GroupPlan {
        GroupPlan {
            name,
            entries: Vec::new(),
            params: vec![1.0, -2.0],
            optimizer: AdamW { beta1: 0.9, beta2: 0.999, eps: 1e-8, weight_decay: 0.0 },
            lr: LrSchedule { peak: 1e-2, warmup: 0, steps: 10, decay: Decay::Constant },
            clip: None,
            average: None,
            turns,
        }
    }

    #[test]
    fn groups_are_clipped_alone_or_together() {
        let clip = |norm, together| Some(Clip { norm, together });
        let plans = [
            GroupPlan { clip: clip(1.0, "net"), ..plan("a", Turns::ALWAYS) },
            GroupPlan { clip: clip(1.0, "net"), ..plan("b", Turns::ALWAYS.one_in(2, 0)) },
            GroupPlan { clip: clip(2.0, "c"), ..plan("c", Turns::ALWAYS) },
            plan("d", Turns::ALWAYS),
        ];
        let groups: Vec<Group> = plans.into_iter().map(Group::new).collect();
        let (a, b): (&[f32], &[f32]) = (&[3.0, 0.0], &[0.0, 4.0]);
        let factors = |step, b| Gradients::of(&groups, step, vec![Some(a), b, Some(a), Some(a)]).factors(&groups);
        let near = |found: Vec<f64>, expected: [f64; 4]| {
            assert!(found.iter().zip(expected).all(|(f, e)| (f - e).abs() < 1e-6), "{found:?}");
        };
        near(factors(0, Some(b)), [0.2, 0.2, 2.0 / 3.0, 1.0]);
        // The second group does not take part in step 1.
        near(factors(1, None), [1.0 / 3.0, 1.0 / 3.0, 2.0 / 3.0, 1.0]);
    }

    #[test]
    fn a_frozen_group_has_no_moments_and_an_average_its_own_pace() {
        let frozen = Group::new(plan("frozen", Turns::NEVER));
        assert!(frozen.m.is_empty() && frozen.v.is_empty() && frozen.turn(0).is_none());
        let average = Average { decay: 0.5, every: 2, starts_as_copy: true };
        let mut group = Group::new(GroupPlan { average: Some(average), ..plan("model", Turns::ALWAYS) });
        let mut seen = Vec::new();
        for turn in 0..4 {
            group.update(turn, &[1.0, -1.0], 1.0);
            seen.push((group.params[0], group.average.as_ref().unwrap()[0]));
        }
        assert_eq!((seen[0].1, seen[1].1, seen[2].1), (1.0, seen[1].0, seen[1].0));
        assert_eq!(seen[3].1, 0.5 * seen[1].0 + 0.5 * seen[3].0);
    }
}
