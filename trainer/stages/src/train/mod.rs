//! The only training loop. A training kind supplies an [`Objective`] (batch to gradients) and receives the trained
//! state.
//!
//! Not its job: defining a loss, finding examples, choosing the other members.
//!
//! The non-obvious idea: training changes only a few flat f32 buffers and a step number ([`TrainState`]). A step reads
//! them and applies one sum over all slices of the step. Nothing else survives from step to step. So a checkpoint, a
//! peer's copy and a fresh start are the same thing at different steps.
//!
//! A [`Group`] is parameters with an optimizer. Its [`Turns`] select the steps that train it, so phases, alternating
//! updates and frozen parts are plans, not loops. [`Buffers`] are values that no optimizer changes;
//! [`Objective::after`] changes them from sums over the slices.

mod buffers;
pub(crate) mod consistency;
pub(crate) mod data;
pub(crate) mod feature_diffusion;
pub(crate) mod frequency;
mod group;
mod losses;
pub(crate) mod network;
mod order;
mod state;
mod tree;

use std::collections::BTreeMap;

use burn::tensor::Device;
use protocol::message::StageTask;
use protocol::stage::Training;
use protocol::units::grouped;
use protocol::{ArtifactKind, Digest, limits};
use serde_json::json;

use crate::artifacts::Draft;
use crate::context::{Adopted, ContextError, Exchange, GangContext, Outcome, Rendezvous, StageError};

use group::Gradients;

pub use buffers::{AfterStep, BufferPlan, Buffers, SumPlan};
pub use group::{Average, Clip, Group, GroupPlan, Turns};
pub use losses::Losses;
pub use order::{Order, Pick};
pub use state::{RestoreError, TrainState};
pub use tree::tree_sum;

/// The input of a sweep's rung: the checkpoint of the rung before.
const STATE_INPUT: &str = protocol::sweep::STATE_OUTPUT;
/// A value that every training records besides its own terms.
const GRADIENT_NORM: &str = "gradient_norm";
const LEARNING_RATE: &str = "lr";
/// File of a checkpoint.
pub(crate) const STATE_FILE: &str = "state.safetensors";

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

/// End of a training without an error.
#[derive(Debug)]
pub enum Trained {
    /// All steps are applied.
    Finished {
        /// The state after the last step.
        state: TrainState,
        /// The terms, averaged over the last hundred steps that this attempt applied.
        metrics: BTreeMap<String, f64>,
    },
    /// Stopped between steps, with a checkpoint committed.
    Yielded {
        /// Number of steps applied.
        at: u64,
    },
}

impl Trained {
    /// The outcome of the stage. `publish` uploads the artifact that is made of the last state.
    ///
    /// # Errors
    /// The error of `publish`.
    pub fn publish(
        self,
        publish: impl FnOnce(&TrainState) -> Result<Digest, StageError>,
    ) -> Result<Outcome, StageError> {
        match self {
            Self::Yielded { at } => Ok(Outcome::Yielded { at }),
            Self::Finished { state, metrics } => Ok(Outcome::Finished { output: publish(&state)?, metrics }),
        }
    }
}

/// Trains to the last step (of the schedule, or of a rung that stops earlier), or until a stop is requested.
///
/// Every member of the gang runs this same loop. An attempt can end only between steps, where the state is complete.
/// Only rank 0 returns. The others hold their state until its save and report are acknowledged, so that one of them can
/// repeat both if rank 0 is lost.
///
/// # Errors
/// [`StageError::Diverged`] before the weights change if the loss or the gradient norm is not finite; otherwise any
/// error from the context.
pub fn train(
    objective: &mut dyn Objective,
    training: &Training,
    cx: &mut dyn GangContext,
) -> Result<Trained, StageError> {
    let mut run = TrainingLoop::begin(objective, training, cx)?;
    loop {
        if run.stop || run.state.step >= run.steps {
            if !run.cx.leads() {
                // Until rank 0 has stored the last step, it exists only in the members' memory.
                run.cx.hold()?;
                run.stop = false;
                run.meet()?;
            } else if run.save_last()? {
                return Ok(run.end());
            }
            continue;
        }
        let layout = Layout::of(&run.state, run.terms.len(), &run.sums);
        let Some(sum) = run.sum_of_slices(&layout)? else { continue };
        run.update(&layout, &sum)?;
        run.save_if_due()?;
    }
}

/// A member's training between two steps.
struct TrainingLoop<'a> {
    objective: &'a mut dyn Objective,
    cx: &'a mut dyn GangContext,
    state: TrainState,
    /// The step that ends the training.
    steps: u64,
    /// Slices of a step.
    slices: usize,
    terms: Vec<&'static str>,
    sums: Vec<SumPlan>,
    /// The digest of the settings.
    config: Digest,
    /// The device that keeps the groups, if it is an accelerator.
    accelerator: Option<Device>,
    /// The packed results of this member's slices of the next step.
    done: BTreeMap<usize, Vec<f32>>,
    /// The newest step in a committed checkpoint, if this member knows it.
    saved_at: Option<u64>,
    save_is_due: bool,
    stop: bool,
    recent: Recent,
}

impl<'a> TrainingLoop<'a> {
    /// Initialises the state, or continues from the gang's position or the task's last checkpoint.
    fn begin(
        objective: &'a mut dyn Objective,
        training: &Training,
        cx: &'a mut dyn GangContext,
    ) -> Result<Self, StageError> {
        // Checked before anything is computed: the content of a save is known from the start.
        let terms = objective.terms();
        cx.task()
            .checkpoint
            .keep
            .check(terms.iter().copied().chain([GRADIENT_NORM, LEARNING_RATE]))
            .map_err(StageError::Input)?;
        let groups = objective.groups();
        let buffers = objective.buffers();
        let bytes = TrainState::bytes_of(&groups, &buffers);
        check_size(bytes, limits::FILE_BYTES)?;
        if cx.leads() {
            cx.log(&parameters(&groups, bytes));
        }
        let mut state = TrainState::new(groups, buffers);
        let saved_at = begin(objective, &mut state, cx)?;
        let mut run = Self {
            steps: training.end().0,
            slices: training.batch.slices,
            sums: objective.sums(),
            // It excludes names of other stages, which do not affect a state; the key of the next rung depends on it.
            config: cx.task().settings.digest(),
            accelerator: Some(cx.device()).filter(models::device::is_accelerator),
            objective,
            cx,
            state,
            terms,
            done: BTreeMap::new(),
            saved_at,
            save_is_due: false,
            stop: false,
            recent: Recent::default(),
        };
        run.load();
        Ok(run)
    }

    /// Copies a state that came from elsewhere to the accelerator, if there is one, and gives it to the objective.
    /// Parameters, moments and averages return from the accelerator only for a checkpoint, a peer or the end.
    fn load(&mut self) {
        if let Some(device) = &self.accelerator {
            self.state.keep_on(device);
        }
        self.objective.load(&self.state);
    }

    /// Meets the other members. Returns true if a peer was ahead and this member took over its state.
    fn meet(&mut self) -> Result<bool, StageError> {
        let applied = Some(self.state.step);
        let adopted = meet(&mut self.state, applied, self.cx)? == Met::Adopted;
        if adopted {
            // Computed slices belong to a finished step.
            self.done.clear();
            self.load();
        }
        Ok(adopted)
    }

    /// Computes this member's slices of the next step and exchanges them with the others. Returns the packed sum over
    /// all slices, or `None` if the gang was regrouped instead.
    fn sum_of_slices(&mut self, layout: &Layout) -> Result<Option<Vec<f32>>, StageError> {
        // A regroup may assign other slices of the same step; computed slices are kept.
        let share = self.cx.share(self.slices);
        let missing: Vec<usize> = share.clone().filter(|slice| !self.done.contains_key(slice)).collect();
        let results = self.objective.slices(self.state.step, &missing)?;
        for (slice, result) in missing.iter().zip(results) {
            self.done.insert(*slice, layout.pack(result)?);
        }
        let parts: Vec<_> =
            share.map(|slice| (slice, self.done.remove(&slice).expect("a result for each slice"))).collect();
        match self.cx.exchange(self.state.step, self.slices, &parts)? {
            Exchange::Sum { sum, drain } => {
                self.done.clear();
                self.stop = drain;
                Ok(Some(sum))
            }
            Exchange::Regroup => {
                if !self.meet()? {
                    self.done.extend(parts);
                }
                Ok(None)
            }
        }
    }

    /// Applies the sum over all slices and records the step's values.
    fn update(&mut self, layout: &Layout, sum: &[f32]) -> Result<(), StageError> {
        let report = apply(&mut self.state, layout, sum)?;
        hook(self.objective, &mut self.state, layout.sums(sum, &self.sums), self.cx.task())?;
        self.objective.load(&self.state);

        let values = self.terms.iter().copied().zip(layout.terms(sum).iter().map(|t| f64::from(*t)));
        let mut values: Vec<(&str, f64)> = values.collect();
        self.recent.push(&values);
        values.push((GRADIENT_NORM, report.norm));
        values.push((LEARNING_RATE, report.lr));
        let step = self.state.step;
        if due(step, self.steps) {
            self.cx.record(step, &values);
        }
        self.cx.progress(step, self.steps, "steps", &values[..1]);
        let every = self.cx.task().checkpoint.every.0;
        self.save_is_due |= every > 0 && step.is_multiple_of(every);
        Ok(())
    }

    /// Saves a checkpoint if one is due and this member leads the gang.
    fn save_if_due(&mut self) -> Result<(), StageError> {
        let ends = self.stop || self.state.step >= self.steps;
        if ends || !self.save_is_due || !self.cx.leads() || !self.cx.can_save() {
            return Ok(());
        }
        self.cx.may_postpone(true);
        let saved = self.save();
        self.cx.may_postpone(false);
        match saved {
            Ok(()) => self.save_is_due = false,
            Err(StageError::Context(ContextError::Unavailable(why))) if !self.cx.can_save() => {
                let step = self.state.step;
                self.cx.log(&format!("the checkpoint after step {step} is delayed: {why}"));
            }
            // The next exchange meets the others, and the next leader saves.
            Err(StageError::Context(ContextError::NoLongerLeads(_))) => {}
            Err(error) => return Err(error),
        }
        Ok(())
    }

    /// Saves the last step as rank 0, because publishing may fail or be interrupted. Returns false if another member
    /// leads the gang meanwhile; it makes this save from its own copy of the state.
    fn save_last(&mut self) -> Result<bool, StageError> {
        if self.saved_at == Some(self.state.step) {
            return Ok(true);
        }
        match self.save() {
            Ok(()) => Ok(true),
            Err(StageError::Context(ContextError::NoLongerLeads(_))) => {
                self.meet()?;
                Ok(false)
            }
            Err(error) => Err(error),
        }
    }

    fn save(&mut self) -> Result<(), StageError> {
        self.state.fetch();
        let meta = meta(&self.state, self.config, self.cx.task().seed);
        let mut draft = Draft::new(self.cx, ArtifactKind::Checkpoint, meta);
        self.state.saved(|pieces| draft.add_pieces(STATE_FILE, pieces))?;
        let digest = draft.finish(self.cx)?;
        let manifest = self.cx.manifest(digest)?;
        self.cx.commit_checkpoint(self.state.step, &manifest, &self.recent.means())?;
        self.saved_at = Some(self.state.step);
        Ok(())
    }

    fn end(mut self) -> Trained {
        self.state.fetch();
        if self.state.step < self.steps {
            return Trained::Yielded { at: self.state.step };
        }
        Trained::Finished { state: self.state, metrics: self.recent.means() }
    }
}

/// An upper estimate of the size of a saved state's header; ours have some hundred bytes.
const HEADER_BYTES: u64 = 1 << 20;

/// Tells the parameters by group, and the size of the whole state.
fn parameters(groups: &[GroupPlan], bytes: u64) -> String {
    let count = |group: &GroupPlan| grouped(group.params.len() as u64);
    let each: Vec<String> = groups.iter().map(|group| format!("{} {}", group.name, count(group))).collect();
    let all = grouped(groups.iter().map(|group| group.params.len() as u64).sum());
    format!("trains {all} parameters ({}), with a state of {} bytes", each.join(", "), grouped(bytes))
}

/// Refuses a state that the store would not take at the first checkpoint.
fn check_size(bytes: u64, most: u64) -> Result<(), StageError> {
    let file = bytes + HEADER_BYTES;
    if file <= most {
        return Ok(());
    }
    let gib = |bytes: u64| bytes as f64 / f64::from(1 << 30);
    Err(StageError::Input(format!(
        "the training state is a file of {:.1} GiB; expected at most {:.1} GiB; use a smaller `network`, or no `ema`",
        gib(file),
        gib(most)
    )))
}

/// Brings `state` to the gang's position or the task's last one. Only rank 0 reads the checkpoint, or the state of the
/// rung before; the others adopt it. Returns the step that is already committed, if this member read it.
fn begin(
    objective: &mut dyn Objective,
    state: &mut TrainState,
    cx: &mut dyn GangContext,
) -> Result<Option<u64>, StageError> {
    let mut applied = None;
    let mut saved_at = None;
    loop {
        let checkpoint = cx.latest_checkpoint()?;
        let continues = checkpoint.is_some() || cx.task().inputs.contains_key(STATE_INPUT);
        if applied.is_none() && cx.leads() {
            if let Some(manifest) = checkpoint {
                restore(state, &manifest, cx)?;
                (applied, saved_at) = (Some(state.step), Some(state.step));
                cx.log(&format!("continues from the checkpoint after step {}", state.step));
            } else if continues {
                let (_, manifest) = crate::artifacts::input(cx, STATE_INPUT, ArtifactKind::Checkpoint)?;
                restore(state, &manifest, cx)?;
                applied = Some(state.step);
                cx.log(&format!("continues from the rung that ended after step {}", state.step));
            }
        }
        let met = meet(state, applied, cx)?;
        if met == Met::Spoiled {
            *state = TrainState::new(objective.groups(), objective.buffers());
        }
        // No member has a state if rank 0 was lost before the rendezvous. Then the next rank 0 reads it.
        if applied.is_some() || met == Met::Adopted || !continues {
            return Ok(saved_at);
        }
    }
}

/// Loads the state of a checkpoint.
fn restore(state: &mut TrainState, manifest: &protocol::Manifest, cx: &dyn GangContext) -> Result<(), StageError> {
    let saved = crate::artifacts::open(&*cx.blobs(), manifest, STATE_FILE)?;
    state.restore(&*saved).map_err(|error| match error {
        RestoreError::Blob(error) => crate::artifacts::blob_error(error),
        RestoreError::Wrong(_) => StageError::Context(ContextError::Corrupt(format!("{STATE_FILE}: {error}"))),
    })
}

/// Result of a rendezvous.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Met {
    /// This member's state is unchanged.
    Kept,
    /// The state is a peer's.
    Adopted,
    /// The member had only initialised itself. A part of a peer's state overwrote that before the peer was lost, and no
    /// member is ahead any more.
    Spoiled,
}

/// Meets the others, and adopts a peer's state if one is ahead or this member has none (`applied` is `None`).
fn meet(state: &mut TrainState, applied: Option<u64>, cx: &mut dyn GangContext) -> Result<Met, StageError> {
    let mut kept = Met::Kept;
    state.fetch();
    loop {
        let mut step = state.step.to_le_bytes();
        if cx.rendezvous(applied, &state.pieces(&step))? == Rendezvous::Keep {
            return Ok(kept);
        }
        match cx.adopt(&mut state.room(&mut step))? {
            Adopted::Whole => {
                state.step = u64::from_le_bytes(step);
                cx.log(&format!("took over the state after step {} from a peer", state.step));
                return Ok(Met::Adopted);
            }
            Adopted::Cut if applied.is_none() => kept = Met::Spoiled,
            Adopted::Cut => {}
        }
    }
}

/// True for steps whose values are recorded: the first 2,000 steps of a stage, then every tenth, and the last.
fn due(step: u64, steps: u64) -> bool {
    step <= 2000 || step.is_multiple_of(10) || step == steps
}

/// Order of the values in a slice's vector: the gradients of the groups that the step trains, the terms, the sums.
struct Layout {
    /// For each group its gradient's length; `None` if the step does not train it.
    gradients: Vec<Option<usize>>,
    terms: usize,
    sums: Vec<usize>,
}

impl Layout {
    fn of(state: &TrainState, terms: usize, sums: &[SumPlan]) -> Self {
        let trained = |group: &Group| group.turn(state.step).map(|_| group.params.len());
        Self {
            gradients: state.groups.iter().map(trained).collect(),
            terms,
            sums: sums.iter().map(|sum| sum.len).collect(),
        }
    }

    /// Packs a slice's result into one vector.
    fn pack(&self, result: SliceResult) -> Result<Vec<f32>, StageError> {
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
        let mut flat =
            Vec::with_capacity(self.gradients.iter().flatten().chain(&self.sums).sum::<usize>() + self.terms);
        result.gradients.into_iter().for_each(|gradient| flat.extend(gradient));
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

    fn terms<'a>(&self, packed: &'a [f32]) -> &'a [f32] {
        let start: usize = self.gradients.iter().flatten().sum();
        &packed[start..start + self.terms]
    }

    fn sums<'a>(&self, packed: &'a [f32], plans: &'a [SumPlan]) -> Vec<(&'a str, &'a [f32])> {
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

struct Applied {
    norm: f64,
    lr: f64,
}

/// Makes one optimizer update of every group that the step trains. A step that only gathers sums has norm and rate 0.
fn apply(state: &mut TrainState, layout: &Layout, sum: &[f32]) -> Result<Applied, StageError> {
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
fn hook(
    objective: &mut dyn Objective,
    state: &mut TrainState,
    sums: Vec<(&str, &[f32])>,
    task: &StageTask,
) -> Result<(), StageError> {
    let step = state.step - 1;
    let buffers = &mut state.buffers;
    objective.after(&mut AfterStep { step, buffers, sums, seed: task.seed, stage: &task.name })
}

/// The meta of a checkpoint's manifest. Workers of two builds may save one step, so it names no build.
fn meta(state: &TrainState, config: Digest, seed: protocol::Seed) -> serde_json::Value {
    json!({
        "step": state.step,
        "settings": config,
        "seed": seed,
        "groups": state.groups.iter().map(|g| json!({"name": g.name, "parameters": g.params.len()})).collect::<Vec<_>>(),
        "buffers": state.buffers.iter().map(|(name, v)| json!({"name": name, "values": v.len()})).collect::<Vec<_>>(),
    })
}

/// Running means of the newest values.
#[derive(Debug, Default)]
struct Recent {
    rows: std::collections::VecDeque<Vec<(String, f64)>>,
}

impl Recent {
    const LEN: usize = 100;

    fn push(&mut self, values: &[(&str, f64)]) {
        if self.rows.len() == Self::LEN {
            self.rows.pop_front();
        }
        self.rows.push_back(values.iter().map(|(k, v)| ((*k).to_owned(), *v)).collect());
    }

    #[expect(clippy::cast_precision_loss, reason = "at most a hundred rows")]
    fn means(&self) -> BTreeMap<String, f64> {
        let mut sums: BTreeMap<String, f64> = BTreeMap::new();
        for (key, value) in self.rows.iter().flatten() {
            *sums.entry(key.clone()).or_default() += value;
        }
        let count = self.rows.len().max(1) as f64;
        sums.into_iter().map(|(key, sum)| (key, sum / count)).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_state_larger_than_a_file_may_be_is_refused_in_words() {
        let refused = check_size(600 << 30, limits::FILE_BYTES).map_err(|error| (error.class(), error.to_string()));
        let Err((class, message)) = refused else { panic!("600 GiB are taken") };
        assert_eq!(class, protocol::message::FailureClass::Input);
        assert!(message.contains("600.0 GiB") && message.contains("at most 512.0 GiB"), "{message}");
        assert!(check_size(500 << 30, limits::FILE_BYTES).is_ok());
    }

    /// In a rolling upgrade, members of two builds may save one step; both saves are the same state.
    #[test]
    fn a_checkpoint_says_nothing_of_the_build_that_saved_it() {
        let state = TrainState::new(Vec::new(), Vec::new());
        let meta = meta(&state, Digest::of(b"settings"), protocol::Seed(1));
        let keys: Vec<&str> = meta.as_object().expect("an object").keys().map(String::as_str).collect();
        assert_eq!(keys, ["buffers", "groups", "seed", "settings", "step"]);
        assert!(!meta.to_string().contains(env!("CARGO_PKG_VERSION")), "{meta}");
    }
}
