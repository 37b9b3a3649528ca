//! The three forms in which kinds run.

use protocol::Digest;

use crate::context::{AttemptContext, GangContext, Outcome, StageError};

/// A kind that one worker runs alone.
pub(super) trait Plain {
    /// Runs the stage.
    fn run(&self, cx: &mut dyn AttemptContext) -> Result<Outcome, StageError>;
}

/// A kind that is divided into shards.
pub(super) trait Map {
    /// Computes shard `index` of `of`.
    fn shard(&self, cx: &mut dyn AttemptContext, index: usize, of: usize) -> Result<Outcome, StageError>;
    /// Merges the artifacts of all shards, in order, into the stage's.
    fn merge(&self, cx: &mut dyn AttemptContext, shards: &[Digest]) -> Result<Outcome, StageError>;
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
