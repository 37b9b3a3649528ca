//! The stage kinds of this build, as the stage thread calls them.

use burn::tensor::Device;
use protocol::stage::Backend;
use stages::context::{AttemptContext, GangContext, Outcome, Part, StageError};

use crate::stage_thread::Kinds;

/// Opens the device on which this process computes.
pub(crate) fn device(_backend: Backend, _index: usize) -> Result<Device, String> {
    Ok(Device::default())
}

/// The kinds of the crate `stages`.
#[derive(Debug)]
pub(crate) struct Stages;

fn unwired() -> StageError {
    StageError::Fault("this build has no stage kinds yet".to_owned())
}

impl Kinds for Stages {
    fn alone(&self, _context: &mut dyn AttemptContext) -> Result<Outcome, StageError> {
        Err(unwired())
    }

    fn part(&self, _context: &mut dyn AttemptContext, _part: Part) -> Result<Outcome, StageError> {
        Err(unwired())
    }

    fn gang(&self, _context: &mut dyn GangContext) -> Result<Outcome, StageError> {
        Err(unwired())
    }
}
