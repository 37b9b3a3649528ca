//! The end of a training without an error.

use std::collections::BTreeMap;

use protocol::Digest;

use super::state::TrainState;
use crate::context::{Outcome, StageError};

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
