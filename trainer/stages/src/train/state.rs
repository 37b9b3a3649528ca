//! What training changes, and its bytes.

use std::ops::Range;

use bytemuck::{cast_slice, cast_slice_mut};
use models::flat::Entry;
use models::optim::{AdamW, LrSchedule, ema};

use crate::artifacts::Tensors;

/// One set of parameters with an optimizer of its own.
#[derive(Debug, Clone)]
pub struct GroupPlan {
    /// Short name: `model`, `heads`.
    pub name: &'static str,
    /// Tensors in the buffer.
    pub entries: Vec<Entry>,
    /// First values.
    pub params: Vec<f32>,
    /// Optimizer.
    pub optimizer: AdamW,
    /// Learning rate by step.
    pub lr: LrSchedule,
    /// Decay of a moving average that is kept beside the parameters.
    pub ema: Option<f64>,
    /// Steps that train it, where that is not all; its optimizer and its schedule count from the first of them.
    pub active: Option<Range<u64>>,
}

/// A group in training: flat buffers of one length.
#[derive(Debug, Clone, PartialEq)]
pub struct Group {
    /// Short name.
    pub name: &'static str,
    /// Tensors in the buffer.
    pub entries: Vec<Entry>,
    /// Parameters.
    pub params: Vec<f32>,
    /// AdamW's first moments.
    pub m: Vec<f32>,
    /// AdamW's second moments.
    pub v: Vec<f32>,
    /// Moving average of the parameters, if the plan asks for one.
    pub average: Option<Vec<f32>>,
    /// Learning rate by step.
    pub lr: LrSchedule,
    optimizer: AdamW,
    ema: f64,
    active: Option<Range<u64>>,
}

impl Group {
    /// The number of the update that step `step` is to this group, from 0; `None` outside the steps that train it.
    pub(super) fn turn(&self, step: u64) -> Option<u64> {
        match &self.active {
            None => Some(step),
            Some(active) => active.contains(&step).then(|| step - active.start),
        }
    }

    /// Applies update number `step` (from 0) with `factor` times the gradient, then moves the average.
    pub(super) fn update(&mut self, step: u64, gradient: &[f32], factor: f64) {
        let Some(step) = self.turn(step) else { return };
        #[expect(clippy::cast_possible_truncation, reason = "a factor in (0, 1]")]
        let scaled: Vec<f32> = gradient.iter().map(|g| g * factor as f32).collect();
        self.optimizer.step(step + 1, self.lr.at(step), &mut self.params, &scaled, &mut self.m, &mut self.v);
        if let Some(average) = &mut self.average {
            ema(average, &self.params, self.ema);
        }
    }
}

/// All that a training stage carries from step to step.
#[derive(Debug, Clone, PartialEq)]
pub struct TrainState {
    /// Updates applied.
    pub step: u64,
    /// Groups in the objective's order.
    pub groups: Vec<Group>,
}

impl TrainState {
    /// The state before the first step.
    pub fn new(plans: &[GroupPlan]) -> Self {
        let group = |plan: &GroupPlan| Group {
            name: plan.name,
            entries: plan.entries.clone(),
            params: plan.params.clone(),
            m: vec![0.0; plan.params.len()],
            v: vec![0.0; plan.params.len()],
            average: plan.ema.map(|_| plan.params.clone()),
            lr: plan.lr,
            optimizer: plan.optimizer,
            ema: plan.ema.unwrap_or(0.0),
            active: plan.active.clone(),
        };
        Self { step: 0, groups: plans.iter().map(group).collect() }
    }

    /// Safetensors: `step`, and per group `NAME.params`, `NAME.m`, `NAME.v`, `NAME.average`.
    ///
    /// # Panics
    /// Never: flat f32 buffers always serialise.
    pub fn to_bytes(&self) -> Vec<u8> {
        let step = i64::try_from(self.step).expect("a step fits");
        let mut tensors = Tensors::default().with_integers("step", [1], vec![step]);
        for group in &self.groups {
            let len = group.params.len();
            let buffers = [
                ("params", Some(&group.params)),
                ("m", Some(&group.m)),
                ("v", Some(&group.v)),
                ("average", group.average.as_ref()),
            ];
            for (what, values) in buffers {
                if let Some(values) = values {
                    tensors = tensors.with(&format!("{}.{what}", group.name), [len], values.clone());
                }
            }
        }
        tensors.to_bytes().expect("flat buffers serialise")
    }

    /// Takes over the bytes of another state of the same plan.
    ///
    /// # Errors
    /// If a buffer is missing or has another length; nothing is changed then.
    pub fn restore(&mut self, bytes: &[u8]) -> Result<(), String> {
        let text = |e: crate::context::StageError| e.to_string();
        let mut tensors = Tensors::from_bytes(bytes, "the state").map_err(text)?;
        let step = tensors.take_integers("step", 1, "the state").map_err(text)?.values;
        let step = step.first().and_then(|s| u64::try_from(*s).ok()).ok_or("no step")?;
        let mut groups = self.groups.clone();
        for group in &mut groups {
            let (name, len) = (group.name, group.params.len());
            let mut take = |what: &str| {
                let values = tensors.take(&format!("{name}.{what}"), 1, "the state").map_err(text)?.values;
                if values.len() == len {
                    Ok(values)
                } else {
                    Err(format!("`{name}.{what}` has {} values, expected {len}", values.len()))
                }
            };
            group.params = take("params")?;
            group.m = take("m")?;
            group.v = take("v")?;
            if group.average.is_some() {
                group.average = Some(take("average")?);
            }
        }
        self.step = step;
        self.groups = groups;
        Ok(())
    }

    /// The state as it travels between members of a gang, who have the same plan: `step` (as little-endian bytes), then the buffers as they
    /// lie in memory. Nothing is copied: with large models that is what takes the time.
    pub fn pieces<'a>(&'a self, step: &'a [u8; 8]) -> Vec<&'a [u8]> {
        let buffers = self.groups.iter().flat_map(|group| {
            [&group.params, &group.m, &group.v].into_iter().chain(&group.average).map(|values| cast_slice(values))
        });
        std::iter::once(step.as_slice()).chain(buffers).collect()
    }

    /// Takes over what [`Self::pieces`] of another member gave, however it was cut on the way.
    ///
    /// # Errors
    /// If it has another length; nothing is changed then.
    pub fn adopt(&mut self, pieces: &[Vec<u8>]) -> Result<(), String> {
        let mut step = self.step.to_le_bytes();
        let expected: usize = self.pieces(&step).iter().map(|piece| piece.len()).sum();
        let found: usize = pieces.iter().map(Vec::len).sum();
        if found != expected {
            return Err(format!("a peer's state has {found} bytes, expected {expected}"));
        }
        let mut pieces = pieces.iter().map(Vec::as_slice);
        let mut piece: &[u8] = &[];
        let mut fill = |mut into: &mut [u8]| {
            while !into.is_empty() {
                if piece.is_empty() {
                    piece = pieces.next().expect("as many bytes as there is room for");
                    continue;
                }
                let (now, later) = into.split_at_mut(piece.len().min(into.len()));
                now.copy_from_slice(&piece[..now.len()]);
                (piece, into) = (&piece[now.len()..], later);
            }
        };
        fill(&mut step);
        self.step = u64::from_le_bytes(step);
        for group in &mut self.groups {
            for values in [&mut group.params, &mut group.m, &mut group.v].into_iter().chain(&mut group.average) {
                fill(cast_slice_mut(values));
            }
        }
        Ok(())
    }

    /// The parameters of group `index` as they should be used: their average where one is kept.
    pub fn result(&self, index: usize) -> &[f32] {
        let group = &self.groups[index];
        group.average.as_ref().unwrap_or(&group.params)
    }
}

#[cfg(test)]
mod tests {
    use protocol::stage::Decay;

    use super::*;

    #[test]
    fn a_member_takes_over_a_peers_state_bit_for_bit_or_not_at_all() {
        let plan = |name, ema| GroupPlan {
            name,
            entries: Vec::new(),
            params: vec![1.0, -2.0, 0.5],
            optimizer: AdamW { beta1: 0.9, beta2: 0.999, eps: 1e-8, weight_decay: 0.0 },
            lr: LrSchedule { peak: 1e-2, warmup: 0, steps: 10, decay: Decay::Constant },
            ema,
            active: None,
        };
        let plans = [plan("model", Some(0.9)), plan("heads", None)];
        let mut donor = TrainState::new(&plans);
        for step in 0..3 {
            donor.groups.iter_mut().for_each(|group| group.update(step, &[0.1, 0.2, -0.3], 1.0));
            donor.step = step + 1;
        }
        let step = donor.step.to_le_bytes();
        let mut joiner = TrainState::new(&plans);
        let before = joiner.clone();
        let bytes = donor.pieces(&step).concat();
        for wrong in [&bytes[..bytes.len() - 4], &[bytes.clone(), vec![0; 4]].concat(), &[]] {
            assert!(joiner.adopt(&[wrong.to_vec()]).unwrap_err().contains("expected 92"), "{}", wrong.len());
            assert_eq!(joiner, before);
        }
        for cut in [3, 8, 50, bytes.len()] {
            joiner.clone_from(&before);
            joiner.adopt(&bytes.chunks(cut).map(<[u8]>::to_vec).collect::<Vec<_>>()).unwrap();
            assert_eq!(joiner, donor, "in pieces of {cut} bytes");
        }
        // What is saved says the same.
        let mut saved = before;
        saved.restore(&donor.to_bytes()).unwrap();
        assert_eq!(saved, donor);
    }
}
