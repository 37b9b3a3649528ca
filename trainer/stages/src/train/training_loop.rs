//! The loop: exchanges slices, updates the state, and saves it when a checkpoint is due.

use std::collections::BTreeMap;

use burn::tensor::Device;
use protocol::stage::Training;
use protocol::{ArtifactKind, Digest, limits};

use super::buffers::SumPlan;
use super::objective::Objective;
use super::outcome::Trained;
use super::save::{STATE_FILE, check_size, meta, parameters};
use super::start::{Met, begin, meet};
use super::state::TrainState;
use super::step::{Layout, apply, hook};
use super::values::{GRADIENT_NORM, LEARNING_RATE, Recent, due};
use crate::artifacts::Draft;
use crate::context::{ContextError, Exchange, GangContext, StageError};

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
