//! Saved states: their file, its largest size, and their meta.

use protocol::Digest;
use protocol::units::grouped;
use serde_json::json;

use super::group::GroupPlan;
use super::state::{RestoreError, TrainState};
use crate::context::{ContextError, GangContext, StageError};

/// File of a checkpoint.
pub(crate) const STATE_FILE: &str = "state.safetensors";

/// An upper estimate of the size of a saved state's header; ours have some hundred bytes.
const HEADER_BYTES: u64 = 1 << 20;

/// Tells the parameters by group, and the size of the whole state.
pub(super) fn parameters(groups: &[GroupPlan], bytes: u64) -> String {
    let count = |group: &GroupPlan| grouped(group.params.len() as u64);
    let each: Vec<String> = groups.iter().map(|group| format!("{} {}", group.name, count(group))).collect();
    let all = grouped(groups.iter().map(|group| group.params.len() as u64).sum());
    format!("trains {all} parameters ({}), with a state of {} bytes", each.join(", "), grouped(bytes))
}

/// Refuses a state that the store would not take at the first checkpoint.
pub(super) fn check_size(bytes: u64, most: u64) -> Result<(), StageError> {
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

/// Loads the state of a checkpoint.
pub(super) fn restore(
    state: &mut TrainState,
    manifest: &protocol::Manifest,
    cx: &dyn GangContext,
) -> Result<(), StageError> {
    let saved = crate::artifacts::open(&*cx.blobs(), manifest, STATE_FILE)?;
    state.restore(&*saved).map_err(|error| match error {
        RestoreError::Blob(error) => crate::artifacts::blob_error(error),
        RestoreError::Wrong(_) => StageError::Context(ContextError::Corrupt(format!("{STATE_FILE}: {error}"))),
    })
}

/// The meta of a checkpoint's manifest. Workers of two builds may save one step, so it names no build.
pub(super) fn meta(state: &TrainState, config: Digest, seed: protocol::Seed) -> serde_json::Value {
    json!({
        "step": state.step,
        "settings": config,
        "seed": seed,
        "groups": state.groups.iter().map(|g| json!({"name": g.name, "parameters": g.params.len()})).collect::<Vec<_>>(),
        "buffers": state.buffers.iter().map(|(name, v)| json!({"name": name, "values": v.len()})).collect::<Vec<_>>(),
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use protocol::limits;

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
