//! The three forms in which kinds run.

use protocol::Digest;
use protocol::stage::{Split, StageSettings};

use crate::context::{AttemptContext, GangContext, Outcome, StageError};

/// A kind that one worker runs alone.
pub(super) trait Plain {
    /// Runs the stage.
    fn run(&self, cx: &mut dyn AttemptContext) -> Result<Outcome, StageError>;

    /// Makes a placeholder of the output for an estimate, if the stage reads files.
    fn stand_in(&self, _cx: &mut dyn AttemptContext) -> Option<Result<Digest, StageError>> {
        None
    }
}

/// A kind that is divided into shards.
pub(super) trait Map {
    /// Computes shard `index` of `of`.
    fn shard(&self, cx: &mut dyn AttemptContext, index: usize, of: usize) -> Result<Outcome, StageError>;
    /// Merges the artifacts of all shards, in order, into the stage's.
    fn merge(&self, cx: &mut dyn AttemptContext, shards: &[Digest]) -> Result<Outcome, StageError>;

    /// As [`Plain::stand_in`].
    fn stand_in(&self, _cx: &mut dyn AttemptContext) -> Option<Result<Digest, StageError>> {
        None
    }

    /// The settings that an estimate runs untimed in place of these, if reading these inputs takes too long.
    fn cheaper(&self) -> Option<StageSettings> {
        None
    }

    /// The number of times that the stage repeats the work which an estimate times; `entries` counts those of a split.
    fn repetitions(&self, entries: &dyn Fn(Split) -> f64) -> f64 {
        entries(Split::All)
    }
}

/// A kind that trains.
pub(super) trait Gang {
    /// Runs one member's attempt.
    fn run(&self, cx: &mut dyn GangContext) -> Result<Outcome, StageError>;
}

/// A stage in the form that its kind is run in.
pub(super) enum Stage<'a> {
    Plain(&'a dyn Plain),
    Map(&'a dyn Map),
    Gang(&'a dyn Gang),
}
