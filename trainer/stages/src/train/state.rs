//! The state that training changes, and its serialisation.

use std::collections::BTreeMap;

use burn::tensor::Device;
use bytemuck::{cast_slice, cast_slice_mut};
use checkpoint::{Blob, BlobError};
use models::flat::Entry;
use motion::tensor_header::{self, Header};
use safetensors::Dtype;

use super::buffers::{BufferPlan, Buffers};
use super::group::{Group, GroupPlan};

/// A saved state was not loaded.
#[derive(Debug, thiserror::Error)]
pub enum RestoreError {
    /// It is not a state of this plan.
    #[error("{0}")]
    Wrong(String),
    /// It could not be read.
    #[error(transparent)]
    Blob(#[from] BlobError),
}

/// The complete state of a training stage between steps. Groups may be on an accelerator ([`keep_on`](Self::keep_on)).
/// Saved, sent and published values are the host's, which [`fetch`](Self::fetch) updates.
#[derive(Debug, Clone, PartialEq)]
pub struct TrainState {
    /// Number of updates applied.
    pub step: u64,
    /// Groups in the objective's order.
    pub groups: Vec<Group>,
    /// Values that no optimizer changes.
    pub buffers: Buffers,
}

impl TrainState {
    /// Creates the state before the first step.
    ///
    /// # Panics
    /// If two groups or two buffers have one name.
    pub fn new(groups: Vec<GroupPlan>, buffers: Vec<BufferPlan>) -> Self {
        let groups = groups.into_iter().map(Group::new).collect();
        let state = Self { step: 0, groups, buffers: Buffers::new(buffers) };
        let names: usize = state.groups.iter().map(|group| 3 + usize::from(group.average.is_some())).sum();
        assert_eq!(state.values().len(), names + state.buffers.iter().count(), "every name stands for one buffer");
        state
    }

    /// Bytes of the values that a state of these plans saves, before any of it is in memory.
    pub fn bytes_of(groups: &[GroupPlan], buffers: &[BufferPlan]) -> u64 {
        let copies = |group: &GroupPlan| 3 + usize::from(group.average.is_some());
        let values = groups.iter().map(|group| copies(group) * group.params.len()).sum::<usize>()
            + buffers.iter().map(|buffer| buffer.values.len()).sum::<usize>();
        (size_of::<f32>() * values) as u64
    }

    /// Copies the groups to `device` and trains there from now on.
    pub fn keep_on(&mut self, device: &Device) {
        self.groups.iter_mut().for_each(|group| group.send(device));
    }

    /// Copies newer values of the accelerator to the host. Costs nothing if groups are on the host anyway.
    pub fn fetch(&mut self) {
        self.groups.iter_mut().for_each(Group::fetch);
    }

    fn is_fetched(&self) -> bool {
        self.groups.iter().all(Group::is_fetched)
    }

    /// All saved values besides the step, by name.
    fn values(&self) -> BTreeMap<String, &Vec<f32>> {
        fn of(group: &Group) -> Vec<(String, &Vec<f32>)> {
            let all = [("params", Some(&group.params)), ("m", Some(&group.m)), ("v", Some(&group.v))];
            let all = all.into_iter().chain([("average", group.average.as_ref())]);
            all.filter_map(|(what, values)| Some((format!("{}.{what}", group.name), values?))).collect()
        }
        self.groups.iter().flat_map(of).chain(self.buffers.values()).collect()
    }

    fn values_mut(&mut self) -> impl Iterator<Item = (String, &mut Vec<f32>)> {
        let groups = self.groups.iter_mut().flat_map(|group| {
            let Group { name, params, m, v, average, .. } = group;
            let all = [("params", Some(params)), ("m", Some(m)), ("v", Some(v)), ("average", average.as_mut())];
            all.into_iter().filter_map(move |(what, values)| Some((format!("{name}.{what}"), values?)))
        });
        groups.chain(self.buffers.values_mut())
    }

    /// Serialises the header of a saved state: safetensors with `step`, and per group `NAME.params`, `NAME.m`,
    /// `NAME.v`, `NAME.average`, and `buffer.NAME`, in the order and with the alignment of the `safetensors` crate.
    /// [`Self::saved`] writes the values after it.
    fn header(&self) -> Vec<u8> {
        let step = ("step".to_owned(), Dtype::I64, vec![1]);
        let all = self.values();
        let values = all.iter().map(|(name, values)| (name.clone(), Dtype::F32, vec![values.len()]));
        tensor_header::header(std::iter::once(step).chain(values))
    }

    /// Calls `save` with the bytes of a saved state in pieces. Nearly all pieces borrow the buffers: a large state is
    /// not copied.
    pub fn saved<T>(&self, save: impl FnOnce(&[&[u8]]) -> T) -> T {
        debug_assert!(self.is_fetched());
        let header = self.header();
        let step = self.step.to_le_bytes();
        let all = self.values();
        let mut pieces: Vec<&[u8]> = vec![&header, &step];
        pieces.extend(all.values().map(|values| cast_slice::<f32, u8>(values)));
        save(&pieces)
    }

    /// Loads a saved state of the same plan, buffer by buffer.
    ///
    /// # Errors
    /// If a buffer is missing or has another length; the state is then unchanged. If the bytes cannot be read; the
    /// state is then unusable.
    pub fn restore(&mut self, saved: &dyn Blob) -> Result<(), RestoreError> {
        let wrong = |text: String| RestoreError::Wrong(text);
        let header = Header::read(saved.bytes(), &mut |offset, out| saved.read_at(offset, out))?;
        let header = header.map_err(|what| wrong(format!("the file {what}")))?;
        let metadata = &header.metadata;
        let place = |name: &str, dtype: Dtype, values: usize| {
            let info = metadata.info(name).ok_or_else(|| {
                let mut there: Vec<String> = metadata.tensors().into_keys().collect();
                there.sort();
                wrong(format!("no tensor `{name}`; the file has {there:?}"))
            })?;
            if info.dtype != dtype || info.shape != [values] {
                return Err(wrong(format!(
                    "`{name}` is {:?} {:?}; expected {dtype:?} [{values}]",
                    info.dtype, info.shape
                )));
            }
            Ok(header.place(info))
        };

        let mut step = [0; 8];
        saved.read_at(place("step", Dtype::I64, 1)?, &mut step)?;
        let step = u64::try_from(i64::from_le_bytes(step)).map_err(|_| wrong("a step below 0".to_owned()))?;
        let mut places: BTreeMap<String, u64> = BTreeMap::new();
        for (name, values) in self.values() {
            let at = place(&name, Dtype::F32, values.len())?;
            places.insert(name, at);
        }
        // A state of a plan with more buffers would otherwise silently lose them here.
        if metadata.tensors().len() != places.len() + 1 {
            let strange = |name: &String| name != "step" && !places.contains_key(name);
            let mut strange: Vec<String> = metadata.tensors().into_keys().filter(strange).collect();
            strange.sort();
            return Err(wrong(format!("this plan does not have the tensors {strange:?}")));
        }
        for (name, values) in self.values_mut() {
            saved.read_at(places[&name], cast_slice_mut(values))?;
        }
        self.step = step;
        Ok(())
    }

    /// The state as sent between members of a gang, who have the same plan: `step` (as little-endian bytes), then the
    /// buffers in memory. Nothing is copied, because copying large models dominates the time.
    pub fn pieces<'a>(&'a self, step: &'a [u8; 8]) -> Vec<&'a [u8]> {
        debug_assert!(self.is_fetched());
        let groups = self.groups.iter().flat_map(Group::flat).map(|values| cast_slice(values));
        let buffers = self.buffers.iter().map(|(_, values)| cast_slice(values));
        std::iter::once(step.as_slice()).chain(groups).chain(buffers).collect()
    }

    /// The buffers that receive another member's [`Self::pieces`]; `step` receives the step.
    pub fn room<'a>(&'a mut self, step: &'a mut [u8; 8]) -> Vec<&'a mut [u8]> {
        let groups = self.groups.iter_mut().flat_map(Group::flat_mut).map(|values| cast_slice_mut(values));
        let buffers = self.buffers.values_mut().map(|(_, values)| cast_slice_mut(values));
        std::iter::once(step.as_mut_slice()).chain(groups).chain(buffers).collect()
    }

    /// The parameters of group `index`.
    pub fn params(&self, index: usize) -> &[f32] {
        debug_assert!(self.is_fetched());
        &self.groups[index].params
    }

    /// The result of the training of group `index`: the average if one is kept, else the parameters.
    pub fn result(&self, index: usize) -> &[f32] {
        debug_assert!(self.is_fetched());
        let group = &self.groups[index];
        group.average.as_ref().unwrap_or(&group.params)
    }

    /// Names and shapes of group `index`, and the result of its training.
    pub fn trained(&self, index: usize) -> (&[Entry], &[f32]) {
        (&self.groups[index].entries, self.result(index))
    }

    /// Like [`trained`](Self::trained), with the parameters although an average is kept.
    pub fn online(&self, index: usize) -> (&[Entry], &[f32]) {
        (&self.groups[index].entries, self.params(index))
    }
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use models::optim::{AdamW, LrSchedule};
    use protocol::stage::Decay;

    use super::*;
    use crate::artifacts::Tensors;
    use crate::train::{Average, Turns};

    fn plan(name: &'static str, average: Option<Average>, turns: Turns) -> GroupPlan {
        GroupPlan {
            name,
            entries: Vec::new(),
            params: vec![1.0, -2.0, 0.5],
            optimizer: AdamW { beta1: 0.9, beta2: 0.999, eps: 1e-8, weight_decay: 0.01 },
            lr: LrSchedule { peak: 1e-2, warmup: 0, steps: 10, decay: Decay::Constant },
            clip: None,
            average,
            turns,
        }
    }

    /// Flex replaces an accelerator: the test checks the location of the newest values.
    #[test]
    fn groups_on_a_device_train_as_on_the_host_and_come_back_for_a_checkpoint() {
        let device = models::device::open(protocol::stage::Backend::Flex, 0).unwrap();
        let late = Average { decay: 0.5, every: 2, starts_as_copy: true };
        let plans = [
            plan("model", Some(Average::of(0.9)), Turns::ALWAYS),
            plan("late", Some(late), Turns::ALWAYS),
            plan("frozen", None, Turns::NEVER),
        ];
        let mut host = TrainState::new(plans.to_vec(), Vec::new());
        let mut there = host.clone();
        there.keep_on(&device);
        let train = |state: &mut TrainState| {
            for step in state.step..state.step + 3 {
                state.groups[..2].iter_mut().for_each(|group| group.update(step, &[0.1, 0.2, -0.3], 0.5));
                state.step = step + 1;
            }
        };
        let near = |a: &TrainState, b: &TrainState| {
            a.values().into_iter().zip(b.values()).all(|((name, a), (other, b))| {
                name == other && a.len() == b.len() && a.iter().zip(b).all(|(a, b)| (a - b).abs() <= 1e-6)
            })
        };
        train(&mut host);
        train(&mut there);
        assert!(!there.is_fetched() && !near(&host, &there), "the host's are older");
        there.fetch();
        assert!(there.is_fetched() && near(&host, &there), "{host:#?}\n{there:#?}");
        // Training continues from the saved state, on the host and on the device.
        let bytes: Arc<[u8]> = there.saved(|pieces| pieces.concat()).into();
        let header = bytes.len() as u64 - TrainState::bytes_of(&plans, &[]);
        assert!((8..1000).contains(&header), "{header}: the step, names and lengths");
        let mut other = TrainState::new(plans.to_vec(), Vec::new());
        other.restore(&bytes).unwrap();
        other.keep_on(&device);
        [&mut host, &mut there, &mut other].into_iter().for_each(train);
        there.fetch();
        other.fetch();
        assert!(other == there && near(&host, &there));
    }

    #[test]
    fn a_state_is_taken_over_bit_for_bit_from_a_peer_and_from_a_checkpoint() {
        let plans = [
            plan("model", Some(Average::of(0.9)), Turns::ALWAYS),
            plan("heads", None, Turns::ALWAYS),
            plan("frozen", None, Turns::NEVER),
        ];
        let buffers = || {
            let buffer = |name: &str, values| BufferPlan { name: name.into(), values };
            vec![buffer("codebook", vec![0.25; 4]), buffer("count", vec![0.0])]
        };
        let mut donor = TrainState::new(plans.to_vec(), buffers());
        for step in 0..3 {
            donor.groups[..2].iter_mut().for_each(|group| group.update(step, &[0.1, 0.2, -0.3], 1.0));
            donor.buffers.get_mut("codebook")[1] += 0.5;
            donor.buffers.get_mut("count")[0] += 1.0;
            donor.step = step + 1;
        }
        let mut step = donor.step.to_le_bytes();
        let mut joiner = TrainState::new(plans.to_vec(), buffers());
        let before = joiner.clone();
        let bytes = donor.pieces(&step).concat();
        step = [0; 8];
        let mut rest = bytes.as_slice();
        for room in joiner.room(&mut step) {
            let (now, later) = rest.split_at(room.len());
            room.copy_from_slice(now);
            rest = later;
        }
        joiner.step = u64::from_le_bytes(step);
        assert_eq!((joiner, rest), (donor.clone(), &[][..]));
        // The saved bytes are the same, and nothing is copied.
        let bytes: Arc<[u8]> = donor.saved(|pieces| pieces.concat()).into();
        let lies = |piece: &&&[u8]| donor.values().values().any(|values| values.as_ptr().cast() == piece.as_ptr());
        assert_eq!(donor.saved(|pieces| pieces.iter().filter(lies).count()), donor.values().len());
        let mut saved = before.clone();
        saved.restore(&bytes).unwrap();
        assert_eq!(saved, donor);

        // They are the bytes that the crate would write, and fewer bytes are refused.
        let mut tensors = Tensors::default().with_integers("step", [1], vec![3]);
        for (name, values) in donor.values() {
            tensors = tensors.with(&name, [values.len()], values.clone());
        }
        assert_eq!(*bytes, tensors.to_bytes().unwrap());
        for end in [0, 7, 8, 100, bytes.len() - 4] {
            let mut cut = before.clone();
            let error = cut.restore(&Arc::<[u8]>::from(&bytes[..end])).unwrap_err();
            assert!(matches!(error, RestoreError::Wrong(_)), "{end}: {error}");
            assert_eq!(cut, before);
        }
        let mut other = TrainState::new(plans.to_vec(), buffers());
        other.groups[0].params.push(0.0);
        assert!(matches!(other.restore(&bytes), Err(RestoreError::Wrong(_))));
        let error = TrainState::new(plans.to_vec(), Vec::new()).restore(&bytes).unwrap_err();
        assert!(error.to_string().contains("buffer.codebook"), "{error}");
    }
}
