//! The stage kinds of this build, as the stage thread calls them, and the device on which they compute.

use burn::tensor::Device;
use protocol::stage::Backend;
use stages::context::{AttemptContext, GangContext, Outcome, Part, StageError};

use crate::stage_thread::Kinds;

/// Opens a device. Devices of a CPU backend are one, whatever their index.
pub(crate) fn device(backend: Backend, index: usize) -> Result<Device, String> {
    match backend {
        #[cfg(feature = "flex")]
        Backend::Flex => Ok(Device::flex()),
        #[cfg(feature = "ndarray")]
        #[expect(deprecated, reason = "named by users and kept as a cross-check")]
        Backend::Ndarray => Ok(Device::ndarray()),
        #[cfg(feature = "wgpu")]
        Backend::Wgpu if index == 0 => Ok(Device::wgpu(burn::tensor::DeviceKind::DefaultDevice)),
        #[cfg(feature = "wgpu")]
        Backend::Wgpu => Ok(Device::wgpu(burn::tensor::DeviceKind::DiscreteGpu(index))),
        #[cfg(feature = "cuda")]
        Backend::Cuda => Ok(Device::cuda(index)),
        #[cfg(not(all(feature = "flex", feature = "ndarray", feature = "wgpu", feature = "cuda")))]
        other => Err(format!(
            "this build has no backend `{name}` (device {index} was asked for); build it with `--features {name}`",
            name = other.name()
        )),
    }
}

/// The kinds of the crate `stages`.
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
