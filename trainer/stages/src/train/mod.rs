//! The one training loop. A kind that trains brings an [`Objective`] (batch to gradients) and gets back the trained state.
//!
//! Not its job: what a loss is, where examples come from, who the other members are.
//!
//! The non-obvious idea: everything that training changes is a few flat f32 buffers and a step number ([`TrainState`]). A step reads
//! them, and applies one sum over all slices of the step; nothing else survives from step to step, so a checkpoint, a peer's copy and
//! a fresh start are the same thing at different steps.

mod order;
mod state;
mod tree;

use std::collections::BTreeMap;
use std::collections::btree_map::Entry;

use models::optim::{clip_factor, global_norm};
use protocol::stage::Training;

use crate::artifacts::Draft;
use crate::context::{ContextError, Exchange, GangContext, Rendezvous, StageError};
use protocol::ArtifactKind;
use serde_json::json;

pub use order::{Order, Pick};
pub use state::{Group, GroupPlan, RestoreError, TrainState};
pub use tree::tree_sum;

/// The input that a rung of a sweep goes on from: the checkpoint that the rung before left.
const STATE_INPUT: &str = protocol::sweep::STATE_OUTPUT;
/// What every training records besides its own terms.
const GRADIENT_NORM: &str = "gradient_norm";
const LEARNING_RATE: &str = "lr";
/// File of a checkpoint.
pub(crate) const STATE_FILE: &str = "state.safetensors";

/// What one slice of a step gave.
#[derive(Debug, Clone, PartialEq)]
pub struct SliceResult {
    /// For each group the gradient of `sum over the slice's examples of the example's loss, divided by the global batch`.
    pub gradients: Vec<Vec<f32>>,
    /// For each term its sum over the slice's examples, divided by the global batch.
    pub terms: Vec<f32>,
}

/// The mathematics of one stage: parameters and examples to gradients.
pub trait Objective {
    /// What is trained, with its first values.
    fn groups(&mut self) -> Vec<GroupPlan>;
    /// Names of the values that every slice gives besides gradients; the first is the loss that is watched.
    fn terms(&self) -> &'static [&'static str];
    /// Takes over the parameters of `state` before the slices of a step.
    fn load(&mut self, state: &TrainState);
    /// Computes slice `slice` of step `step`.
    fn slice(&mut self, step: u64, slice: usize) -> Result<SliceResult, StageError>;
}

/// How training ended, short of an error.
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
        /// Steps applied.
        at: u64,
    },
}

/// Trains to the last step (of the schedule, or of a rung that stops before), or until told to stop.
///
/// Every member of the gang runs this same loop. What may end the attempt happens between steps, where the state is whole. Rank 0 alone
/// returns: the others hold their state until what it saved and reported is acknowledged, so that one of them can do the same if it is lost.
///
/// # Errors
/// [`StageError::Diverged`] before the weights change if the loss or the gradient norm is not finite; whatever the context says no
/// with otherwise.
pub fn train(
    objective: &mut dyn Objective,
    training: &Training,
    cx: &mut dyn GangContext,
) -> Result<Trained, StageError> {
    let (steps, slices) = (training.end().0, training.batch.slices);
    // Before anything is computed: what is saved is known from the start.
    let saved = objective.terms().iter().copied().chain([GRADIENT_NORM, LEARNING_RATE]);
    cx.task().checkpoint.keep.check(saved).map_err(StageError::Input)?;
    // Names of other stages say nothing about a state, which the key of the next rung rests on.
    let config = cx.task().settings.digest();
    let mut state = TrainState::new(&objective.groups());
    let mut saved_at = begin(&mut state, cx)?;
    let mut save_is_due = false;
    let mut stop = false;
    let mut recent = Recent::default();
    objective.load(&state);
    let mut done: BTreeMap<usize, Vec<f32>> = BTreeMap::new();
    loop {
        if stop || state.step >= steps {
            if cx.leads() {
                if saved_at != Some(state.step) {
                    // Publishing may fail or be cut off; the last step should not have to be found again.
                    save(&state, config, &recent, cx)?;
                }
                return Ok(if state.step < steps {
                    Trained::Yielded { at: state.step }
                } else {
                    Trained::Finished { state, metrics: recent.means() }
                });
            }
            // Until rank 0 has stored the last step, it lives in the members' memory alone.
            cx.hold()?;
            stop = false;
            let applied = Some(state.step);
            if meet(&mut state, applied, cx)? {
                objective.load(&state);
            }
            continue;
        }
        // A regroup may hand us other slices of the same step; what was computed is not computed again.
        let share = cx.share(slices);
        for slice in share.clone() {
            if let Entry::Vacant(place) = done.entry(slice) {
                place.insert(flatten(objective.slice(state.step, slice)?));
            }
        }
        let parts: Vec<_> = share.map(|slice| (slice, done.remove(&slice).expect("just computed"))).collect();
        let (sum, drain) = match cx.exchange(state.step, slices, &parts)? {
            Exchange::Sum { sum, drain } => (sum, drain),
            Exchange::Regroup => {
                let applied = Some(state.step);
                if meet(&mut state, applied, cx)? {
                    // A peer was ahead: these slices are of a step that is over.
                    done.clear();
                    objective.load(&state);
                } else {
                    done.extend(parts);
                }
                continue;
            }
        };
        done.clear();
        let (gradients, terms) = split(&sum, &state, objective.terms().len());
        let report = apply(&mut state, gradients, terms[0], training)?;
        objective.load(&state);

        let mut values: Vec<(&str, f64)> =
            objective.terms().iter().copied().zip(terms.iter().map(|t| f64::from(*t))).collect();
        recent.push(&values);
        values.push((GRADIENT_NORM, report.norm));
        values.push((LEARNING_RATE, report.lr));
        if due(state.step, steps) {
            cx.record(state.step, &values);
        }
        cx.progress(state.step, steps, "steps", &values[..1]);
        let every = cx.task().checkpoint.every.0;
        save_is_due |= every > 0 && state.step.is_multiple_of(every);
        stop = drain;
        if cx.leads() && state.step < steps && save_is_due && !stop && cx.can_save() {
            save(&state, config, &recent, cx)?;
            (saved_at, save_is_due) = (Some(state.step), false);
        }
    }
}

/// Brings `state` to where the gang is, or to where the task was left: rank 0 alone reads the checkpoint, or the state that the rung
/// before left, and the others take it from there. Gives the step that is committed already, if this member read it.
fn begin(state: &mut TrainState, cx: &mut dyn GangContext) -> Result<Option<u64>, StageError> {
    let (mut applied, mut saved_at) = (None, None);
    loop {
        let checkpoint = cx.latest_checkpoint()?;
        let continues = checkpoint.is_some() || cx.task().inputs.contains_key(STATE_INPUT);
        if applied.is_none() && cx.leads() {
            if let Some(manifest) = checkpoint {
                restore(state, &manifest, cx)?;
                (applied, saved_at) = (Some(state.step), Some(state.step));
                cx.log(&format!("goes on from the checkpoint after step {}", state.step));
            } else if continues {
                let (_, manifest) = crate::artifacts::input(cx, STATE_INPUT, ArtifactKind::Checkpoint)?;
                restore(state, &manifest, cx)?;
                applied = Some(state.step);
                cx.log(&format!("goes on from the rung that ended after step {}", state.step));
            }
        }
        let adopted = meet(state, applied, cx)?;
        // Nobody has a state if rank 0 was lost before it met the others. Then the next one reads it.
        if applied.is_some() || adopted || !continues {
            return Ok(saved_at);
        }
    }
}

/// Takes over the state of a checkpoint.
fn restore(state: &mut TrainState, manifest: &protocol::Manifest, cx: &dyn GangContext) -> Result<(), StageError> {
    let saved = crate::artifacts::open(&*cx.blobs(), manifest, STATE_FILE)?;
    state.restore(&*saved).map_err(|error| match error {
        RestoreError::Blob(error) => crate::artifacts::blob_error(error),
        RestoreError::Wrong(_) => StageError::Context(ContextError::Corrupt(format!("{STATE_FILE}: {error}"))),
    })
}

/// Meets the others, and takes over a peer's state where one is ahead or this member has none (`applied` is `None`); true if so.
fn meet(state: &mut TrainState, applied: Option<u64>, cx: &mut dyn GangContext) -> Result<bool, StageError> {
    let step = state.step.to_le_bytes();
    let Rendezvous::Adopt(pieces) = cx.rendezvous(applied, &state.pieces(&step))? else { return Ok(false) };
    state.adopt(&pieces).map_err(StageError::Fault)?;
    cx.log(&format!("took over the state after step {} from a peer", state.step));
    Ok(true)
}

/// Values are recorded for every one of the first 2,000 steps of a stage, then for every tenth, and for the last.
fn due(step: u64, steps: u64) -> bool {
    step <= 2000 || step.is_multiple_of(10) || step == steps
}

fn flatten(result: SliceResult) -> Vec<f32> {
    let mut flat = Vec::with_capacity(result.gradients.iter().map(Vec::len).sum::<usize>() + result.terms.len());
    for gradient in result.gradients {
        flat.extend(gradient);
    }
    flat.extend(result.terms);
    flat
}

fn split<'a>(sum: &'a [f32], state: &TrainState, terms: usize) -> (Vec<&'a [f32]>, &'a [f32]) {
    let (mut rest, mut gradients) = (sum, Vec::new());
    for group in &state.groups {
        let (head, tail) = rest.split_at(group.params.len());
        gradients.push(head);
        rest = tail;
    }
    assert_eq!(rest.len(), terms, "an exchange carries gradients and terms");
    (gradients, rest)
}

struct Applied {
    norm: f64,
    lr: f64,
}

/// One optimizer update of every group: clip by the group's global norm, AdamW, EMA.
fn apply(
    state: &mut TrainState,
    gradients: Vec<&[f32]>,
    loss: f32,
    training: &Training,
) -> Result<Applied, StageError> {
    let norms: Vec<f64> = gradients.iter().map(|g| global_norm(g)).collect();
    if !loss.is_finite() || norms.iter().any(|n| !n.is_finite()) {
        let norm = norms.iter().copied().find(|n| !n.is_finite()).unwrap_or(norms[0]);
        return Err(StageError::Diverged { step: state.step, loss: f64::from(loss), norm });
    }
    let step = state.step;
    for ((group, gradient), norm) in state.groups.iter_mut().zip(gradients).zip(&norms) {
        let factor = if training.max_grad_norm > 0.0 { clip_factor(*norm, training.max_grad_norm) } else { 1.0 };
        group.update(step, gradient, factor);
    }
    state.step += 1;
    // The first group that the step trains stands for the step.
    let watched = state.groups.iter().zip(&norms).find_map(|(group, norm)| Some((group.turn(step)?, group, *norm)));
    let (turn, group, norm) = watched.unwrap_or((step, &state.groups[0], norms[0]));
    Ok(Applied { norm, lr: group.lr.at(turn) })
}

fn save(
    state: &TrainState,
    config: protocol::Digest,
    recent: &Recent,
    cx: &mut dyn GangContext,
) -> Result<(), StageError> {
    let meta = json!({
        "step": state.step,
        "settings": config,
        "seed": cx.task().seed,
        "groups": state.groups.iter().map(|g| json!({"name": g.name, "parameters": g.params.len()})).collect::<Vec<_>>(),
        "build": env!("CARGO_PKG_VERSION"),
    });
    let mut draft = Draft::new(cx, ArtifactKind::Checkpoint, meta);
    state.saved(|pieces| draft.add_pieces(STATE_FILE, pieces))?;
    let digest = draft.finish(cx)?;
    let manifest = cx.manifest(digest)?;
    cx.commit_checkpoint(state.step, &manifest, &recent.means())?;
    Ok(())
}

/// Means of the newest values.
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
