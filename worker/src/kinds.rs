//! The stage kinds of this build, as the stage thread calls them.

use stages::context::{AttemptContext, GangContext, Outcome, Part, StageError};

use crate::stage_thread::Kinds;

/// The stage kinds of the crate `stages`.
#[derive(Debug)]
pub(crate) struct Stages;

impl Kinds for Stages {
    fn alone(&self, context: &mut dyn AttemptContext) -> Result<Outcome, StageError> {
        stages::kinds::run_alone(context)
    }

    fn part(&self, context: &mut dyn AttemptContext, part: Part) -> Result<Outcome, StageError> {
        stages::kinds::run_part(context, part)
    }

    fn gang(&self, context: &mut dyn GangContext) -> Result<Outcome, StageError> {
        stages::kinds::run_gang(context)
    }
}
