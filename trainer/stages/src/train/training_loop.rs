//! The loop: exchanges slices or replicas, updates the state, and saves it when a checkpoint is due.

use std::ops::Range;
use std::time::{Duration, Instant};

use burn::tensor::Device;
use models::flat::recycle;
use models::kernels::Work;
use protocol::stage::Training;
use protocol::{Digest, limits};

use super::buffers::SumPlan;
use super::objective::Objective;
use super::outcome::Trained;
use super::replicas::Averaging;
use super::save::{STATE_FILE, check_size, meta, parameters};
use super::start::{Met, begin, meet};
use super::state::TrainState;
use super::step::{Layout, apply, hook};
use super::values::{GRADIENT_NORM, LEARNING_RATE, Recent, due};
use crate::context::{Checkpoint, ContextError, Exchange, GangContext, StageError};
use crate::tree::Sums;

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
        let Some(sum) = run.sum_of_parts(&layout)? else { continue };
        run.update(&layout, sum)?;
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
    /// Number of parts that the members exchange at once: the slices of a step, or the replicas of a round.
    parts: usize,
    /// The replicas, if the training has any.
    averaging: Option<Averaging>,
    terms: Vec<&'static str>,
    sums: Vec<SumPlan>,
    /// The digest of the settings.
    config: Digest,
    /// The device that keeps the groups, if it is an accelerator.
    accelerator: Option<Device>,
    /// The packed results of this member's parts of the next exchange.
    done: Sums,
    /// The newest step in a committed checkpoint, if this member knows it.
    saved_at: Option<u64>,
    save_is_due: bool,
    stop: bool,
    recent: Recent,
    /// Time of slices and updates, without exchanges and saves.
    computing: Duration,
    /// The thread's matrix products when the training began.
    work: Work,
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
        let done = Sums::new(training.parts(), cx.large());
        let mut run = Self {
            steps: training.end().0,
            parts: training.parts(),
            averaging: Averaging::of(training),
            sums: objective.sums(),
            // It excludes names of other stages, which do not affect a state; the key of the next rung depends on it.
            config: cx.task().settings.digest(),
            accelerator: Some(cx.device()).filter(models::device::is_accelerator),
            objective,
            cx,
            state,
            terms,
            done,
            saved_at,
            save_is_due: false,
            stop: false,
            recent: Recent::default(),
            computing: Duration::ZERO,
            work: Work::so_far(),
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

    /// Meets the other members, and takes over the state of a peer that is ahead.
    fn meet(&mut self) -> Result<(), StageError> {
        let applied = Some(self.state.step);
        if meet(&mut self.state, applied, self.cx)? == Met::Adopted {
            // Computed slices belong to a finished step.
            self.done.clear();
            self.load();
        }
        Ok(())
    }

    /// Computes this member's parts of the next exchange, and exchanges them with the others. Returns the packed sum over
    /// all parts, or `None` if the gang was regrouped instead.
    fn sum_of_parts(&mut self, layout: &Layout) -> Result<Option<Vec<f32>>, StageError> {
        // A regroup may assign other parts of the same step; computed parts are kept.
        let missing = self.done.missing(&self.cx.share(self.parts));
        // Large results are added one by one: in memory there are few at once.
        let at_once = if layout.len() >= self.cx.large() { 1 } else { missing.len().max(1) };
        for parts in missing.chunks(at_once) {
            let begun = Instant::now();
            let results = self.compute(layout, parts)?;
            self.computing += begun.elapsed();
            parts.iter().zip(results).for_each(|(part, values)| self.done.insert(*part, values));
        }
        match self.cx.exchange(self.coming(), self.parts, self.done.parts())? {
            Exchange::Sum { sum, drain } => {
                self.done.clear();
                self.stop = drain;
                Ok(Some(sum))
            }
            Exchange::Regroup => {
                self.meet()?;
                Ok(None)
            }
        }
    }

    /// The updates of the next exchange: one, or those of a round.
    fn coming(&self) -> Range<u64> {
        let step = self.state.step;
        self.averaging.map_or(step..step + 1, |averaging| averaging.round(step, self.steps))
    }

    /// Computes slices of the next step, or replicas of the next round, and packs each.
    fn compute(&mut self, layout: &Layout, parts: &[usize]) -> Result<Vec<Vec<f32>>, StageError> {
        let Some(averaging) = self.averaging else {
            let results = self.objective.slices(self.state.step, parts)?;
            return results.into_iter().map(|result| layout.pack(result)).collect();
        };
        let round = self.coming();
        let Self { objective, state, cx, terms, steps, .. } = self;
        let count = parts.len() as u64;
        let replica = |(before, part): (u64, &usize)| {
            // A member's replicas follow each other, and all are of the same steps.
            let whole = round.end - round.start;
            let mut done = |step: u64, loss: f32| {
                let done = round.start + (before * whole + step - round.start) / count;
                cx.progress(done, *steps, "steps", &[(terms[0], f64::from(loss))]);
            };
            averaging.compute(*objective, state, &round, *part, &mut done)
        };
        (0..).zip(parts).map(replica).collect()
    }

    /// Applies the sum over all parts and records the values of the step, or the means of the round.
    fn update(&mut self, layout: &Layout, sum: Vec<f32>) -> Result<(), StageError> {
        let begun = Instant::now();
        let coming = self.coming();
        let (terms, applied) = if let Some(averaging) = self.averaging {
            let averaged = averaging.apply(&mut self.state, &coming, sum);
            self.load();
            averaged
        } else {
            let applied = apply(&mut self.state, layout, &sum)?;
            hook(self.objective, &mut self.state, layout.sums(&sum, &self.sums), self.cx.task())?;
            self.objective.load(&self.state);
            let terms = layout.terms(&sum).to_vec();
            recycle(sum);
            (terms, applied)
        };
        self.computing += begun.elapsed();

        let values = self.terms.iter().copied().zip(terms.into_iter().map(f64::from));
        let mut values: Vec<(&str, f64)> = values.collect();
        self.recent.push(&values);
        values.push((GRADIENT_NORM, applied.norm));
        values.push((LEARNING_RATE, applied.lr));
        let step = self.state.step;
        if (coming.start + 1..=step).any(|step| due(step, self.steps)) {
            self.cx.record(step, &values);
        }
        self.cx.progress(step, self.steps, "steps", &values[..1]);
        let every = self.cx.task().checkpoint.every.0;
        self.save_is_due |= every > 0 && coming.start / every < step / every;
        Ok(())
    }

    /// Begins to save a checkpoint if one is due and this member leads the gang. Waits for the save before it, so that
    /// the speed of the store does not decide which steps are saved.
    fn save_if_due(&mut self) -> Result<(), StageError> {
        let ends = self.stop || self.state.step >= self.steps;
        let is_due = self.save_is_due && !ends && self.cx.leads() && self.cx.can_save();
        self.end_save(is_due)?;
        if is_due && self.cx.can_save() {
            self.begin_save(true)?;
            self.save_is_due = false;
        }
        Ok(())
    }

    /// Saves the last step as rank 0, because publishing may fail or be interrupted. Returns false if another member
    /// leads the gang meanwhile; it makes this save from its own copy of the state.
    fn save_last(&mut self) -> Result<bool, StageError> {
        self.end_save(true)?;
        if self.saved_at == Some(self.state.step) {
            return Ok(true);
        }
        self.begin_save(false)?;
        match self.cx.saved(true) {
            Some(Ok(step)) => {
                self.saved_at = Some(step);
                Ok(true)
            }
            Some(Err(ContextError::NoLongerLeads(_))) => {
                self.meet()?;
                Ok(false)
            }
            Some(Err(error)) => Err(error.into()),
            None => Err(StageError::Fault("the last save was begun and has no end".to_owned())),
        }
    }

    fn begin_save(&mut self, may_wait: bool) -> Result<(), StageError> {
        self.state.fetch();
        let checkpoint = Checkpoint {
            step: self.state.step,
            meta: meta(&self.state, self.config, self.cx.task().seed),
            metrics: self.recent.means(),
            chunk_bytes: self.cx.chunk_bytes(),
            may_wait,
        };
        Ok(self.state.saved(|pieces| self.cx.save(checkpoint, &[(STATE_FILE, pieces)]))?)
    }

    /// Notes the end of a save, if it has ended or the caller waits for it. One that was not stored is due again.
    fn end_save(&mut self, waits: bool) -> Result<(), StageError> {
        match self.cx.saved(waits) {
            None => {}
            Some(Ok(step)) => self.saved_at = Some(step),
            Some(Err(ContextError::Unavailable(_))) if !self.cx.can_save() => self.save_is_due = true,
            // The next exchange meets the others, and the next leader saves.
            Some(Err(ContextError::NoLongerLeads(_))) => self.save_is_due = true,
            Some(Err(error)) => return Err(error.into()),
        }
        Ok(())
    }

    fn end(mut self) -> Trained {
        self.state.fetch();
        if let Some(line) = products(Work::so_far() - self.work, self.computing) {
            self.cx.log(&line);
        }
        if self.state.step < self.steps {
            return Trained::Yielded { at: self.state.step };
        }
        Trained::Finished { state: self.state, metrics: self.recent.means() }
    }
}

/// A line on the matrix products of the fused kernels in `computing`; other backends have none.
fn products(work: Work, computing: Duration) -> Option<String> {
    let share = 100.0 * work.time.as_secs_f64() / computing.as_secs_f64();
    let rate = work.operations as f64 / work.time.as_secs_f64() / 1e9;
    let known = work.operations > 0 && share.is_finite() && rate.is_finite();
    known.then(|| {
        format!("matrix products took {share:.0} % of its computation, at {rate:.0} billion operations a second")
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_share_of_products_is_of_computation() {
        let work = Work { operations: 260_000_000_000, time: Duration::from_secs(2) };
        let line = products(work, Duration::from_secs(4));
        let expected = "matrix products took 50 % of its computation, at 130 billion operations a second";
        assert_eq!(line.as_deref(), Some(expected));
        assert_eq!(products(Work::default(), Duration::from_secs(4)), None);
        assert_eq!(products(work, Duration::ZERO), None);
    }
}
