//! Motions of any generator, checked before and after they are drawn.

use std::rc::Rc;

use motion::{Skeleton, footing};
use protocol::stage::Sampler;

use super::interface::{Batch, Edit, Infilling, Lap, MotionGenerator, Seeds, Text};
use crate::context::StageError;
use crate::parts::hint::Hint;

/// Refuses a sampler that the model does not have.
pub fn check_sampler(generator: &dyn MotionGenerator, sampler: &Sampler) -> Result<(), StageError> {
    generator.family().accepts(sampler).map_err(StageError::Input)
}

/// Generates feature rows `[frames, features]` in the data's own scale for each motion of the batch.
///
/// # Errors
/// If the model lacks the sampler, the length or the control part, or a motion is not finite.
pub fn motions(
    generator: &dyn MotionGenerator,
    batch: Batch<'_>,
    sampler: &Sampler,
    lap: &mut dyn FnMut(Lap),
) -> Result<Vec<Vec<f32>>, StageError> {
    check_sampler(generator, sampler)?;
    let longest = generator.longest();
    if let Some(frames) = batch.lengths.iter().find(|frames| !(1..=longest).contains(*frames)) {
        return Err(StageError::Input(format!(
            "a motion of {frames} frames was requested; the model generates 1 to {longest} frames"
        )));
    }
    if let Some(control) = batch.control {
        let Some(meta) = generator.control() else {
            return Err(StageError::Input("the model has no control part, so it cannot follow a path".into()));
        };
        let joints = meta.mean.len() / 3;
        let fits = |(hint, frames): (&Hint, &usize)| (hint.frames(), hint.joints()) == (*frames, joints);
        if control.hints.len() != batch.lengths.len() || !control.hints.iter().zip(batch.lengths).all(fits) {
            return Err(StageError::Fault("the hints do not match the requested motions".into()));
        }
    }
    let mut motions = generator.draw(batch, sampler, lap)?;
    finite(motions.iter().flatten())?;
    if sampler.footing && batch.control.is_none() {
        motions.iter_mut().for_each(|motion| footing::hold(motion, Skeleton::of(generator.format())));
        lap(Lap::Decoded);
    }
    Ok(motions)
}

fn finite<'v>(mut values: impl Iterator<Item = &'v f32>) -> Result<(), StageError> {
    match values.all(|v| v.is_finite()) {
        true => Ok(()),
        false => Err(StageError::Input(
            "the motion has numbers that are not finite; the model is not trained well enough".into(),
        )),
    }
}

/// The in-filling of a model.
///
/// # Errors
/// If the model does not support it.
pub fn infilling(generator: &dyn MotionGenerator) -> Result<&dyn Infilling, StageError> {
    generator.infilling().ok_or_else(|| {
        StageError::Input(
            "the model cannot regenerate part of a motion; only masked token generators (MoMask, MMM) can".into(),
        )
    })
}

/// Regenerates the units of a motion that are not kept.
///
/// # Errors
/// If the model does not support in-filling, the sampler or the length, or the motion is not finite.
pub fn edited(
    generator: &dyn MotionGenerator,
    edit: Edit<'_>,
    text: &Rc<Text>,
    seeds: &Seeds<'_>,
    sampler: &Sampler,
    lap: &mut dyn FnMut(Lap),
) -> Result<Vec<f32>, StageError> {
    check_sampler(generator, sampler)?;
    let model = infilling(generator)?;
    let frames = edit.kept.len() * model.unit();
    let longest = generator.longest();
    if !(1..=longest).contains(&frames) {
        return Err(StageError::Input(format!(
            "a motion of {frames} frames was requested; the model generates 1 to {longest} frames"
        )));
    }
    let motion = model.fill_in(edit, text, seeds, sampler, lap);
    finite(motion.iter())?;
    Ok(motion)
}
