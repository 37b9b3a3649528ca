//! The position that a training starts from: the task's last checkpoint, the rung before, or a peer's state.

use protocol::ArtifactKind;

use super::objective::Objective;
use super::save::restore;
use super::state::TrainState;
use crate::context::{Adopted, GangContext, Rendezvous, StageError};

/// The input of a sweep's rung: the checkpoint of the rung before.
const STATE_INPUT: &str = protocol::sweep::STATE_OUTPUT;

/// Brings `state` to the gang's position or the task's last one. Only rank 0 reads the checkpoint, or the state of the
/// rung before; the others adopt it. Returns the step that is already committed, if this member read it.
pub(super) fn begin(
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

/// Result of a rendezvous.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Met {
    /// This member's state is unchanged.
    Kept,
    /// The state is a peer's.
    Adopted,
    /// The member had only initialised itself. A part of a peer's state overwrote that before the peer was lost, and no
    /// member is ahead any more.
    Spoiled,
}

/// Meets the others, and adopts a peer's state if one is ahead or this member has none (`applied` is `None`).
pub(super) fn meet(state: &mut TrainState, applied: Option<u64>, cx: &mut dyn GangContext) -> Result<Met, StageError> {
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
