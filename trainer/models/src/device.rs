//! Lists the devices of the compiled backends and opens one.
//!
//! A Cargo feature decides which backends are compiled in. The pipeline's setting selects one of them here, in one
//! place; neither an environment variable nor a "best available" guess takes part.

use burn::tensor::{Device, Tensor};
use protocol::stage::Backend;

/// A device cannot be opened.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum DeviceError {
    /// The program was built without the backend.
    #[error("this program has no backend `{}`; build it with `--features {}`", .0.name(), .0.name())]
    NotBuilt(Backend),
    /// The machine has fewer devices.
    #[error("device {index} was requested, but the number of devices of backend `{}` is {found}; see `trainer devices`", .backend.name())]
    NotFound {
        backend: Backend,
        /// The requested index.
        index: usize,
        /// Devices of the backend on this machine.
        found: usize,
    },
}

/// A device of this machine, or a backend that could have some.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct DeviceInfo {
    pub backend: Backend,
    /// Index among the backend's devices, as [`open`] takes it; `None` if the backend has none on this machine.
    pub index: Option<usize>,
    /// The backend's name for the device.
    pub name: String,
    /// Description for the user, or the reason that the backend has no device.
    pub note: String,
}

const BACKENDS: [Backend; 4] = [Backend::Flex, Backend::Ndarray, Backend::Wgpu, Backend::Cuda];

/// Returns the devices of a backend, or the reason that there are none.
fn devices(backend: Backend) -> Result<Vec<Device>, DeviceError> {
    match backend {
        #[cfg(feature = "flex")]
        Backend::Flex => Ok(vec![Device::flex()]),
        #[cfg(feature = "ndarray")]
        Backend::Ndarray => {
            #[expect(deprecated, reason = "kept selectable as a cross-check as long as Burn has it")]
            let device = Device::ndarray();
            Ok(vec![device])
        }
        #[cfg(feature = "wgpu")]
        Backend::Wgpu => Ok(Device::enumerate(burn::tensor::DeviceType::Wgpu).into_iter().collect()),
        #[cfg(feature = "cuda")]
        Backend::Cuda => Ok(Device::enumerate(burn::tensor::DeviceType::Cuda).into_iter().collect()),
        #[allow(unreachable_patterns, reason = "every backend is built in with all features on")]
        other => Err(DeviceError::NotBuilt(other)),
    }
}

/// Opens device number `index` of a backend, without autodiff.
///
/// # Errors
/// If the program was built without the backend, or the machine has fewer such devices.
pub fn open(backend: Backend, index: usize) -> Result<Device, DeviceError> {
    let mut found = devices(backend)?;
    if index >= found.len() {
        return Err(DeviceError::NotFound { backend, index, found: found.len() });
    }
    Ok(found.swap_remove(index))
}

/// Copies the values of a network's output to the host.
///
/// # Panics
/// If they are not f32, in which all networks compute.
pub fn host<const D: usize>(tensor: Tensor<D>) -> Vec<f32> {
    tensor.into_data().try_into_vec::<f32>().expect("networks compute in f32")
}

/// Returns true if `device` has memory of its own. Training then keeps its state there from step to step.
pub fn is_accelerator(device: &Device) -> bool {
    identity(device).is_some()
}

/// Returns the accelerator's own name, and true if it is hardware rather than an emulation on the CPU.
#[cfg(any(feature = "wgpu", feature = "cuda"))]
fn identity(device: &Device) -> Option<(String, bool)> {
    device.identity().map(|identity| (identity.name, identity.physical.is_some()))
}

#[cfg(not(any(feature = "wgpu", feature = "cuda")))]
fn identity(_: &Device) -> Option<(String, bool)> {
    None
}

/// Lists every device of every backend, and one line for each backend that has none or is not built in.
pub fn available() -> Vec<DeviceInfo> {
    BACKENDS.into_iter().flat_map(list).collect()
}

fn list(backend: Backend) -> Vec<DeviceInfo> {
    let absent = |note: String| vec![DeviceInfo { backend, index: None, name: "-".to_owned(), note }];
    match devices(backend) {
        Err(reason) => absent(reason.to_string()),
        Ok(found) if found.is_empty() => absent("built in, but this machine has no such device".to_owned()),
        Ok(found) => found
            .iter()
            .enumerate()
            .map(|(index, device)| {
                let (name, note) = match identity(device) {
                    Some((name, true)) => (name, note(backend)),
                    Some((name, false)) => (name, "an emulated GPU on the CPU: for checks, slow"),
                    // The bits of a result depend on the instruction set.
                    None => (format!("CPU, {}", crate::instruction_set()), note(backend)),
                };
                DeviceInfo { backend, index: Some(index), name, note: note.to_owned() }
            })
            .collect(),
    }
}

fn note(backend: Backend) -> &'static str {
    match backend {
        Backend::Flex => "pure Rust, fused kernels; the same bits on every run",
        Backend::Ndarray => "kept as a cross-check; slower than flex",
        Backend::Wgpu => "GPU through Vulkan, Metal or DirectX",
        Backend::Cuda => "NVIDIA GPU",
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[cfg(feature = "flex")]
    #[test]
    fn flex_opens_and_has_one_device() {
        assert!(open(Backend::Flex, 0).is_ok());
        let error = open(Backend::Flex, 3).unwrap_err();
        assert_eq!(error, DeviceError::NotFound { backend: Backend::Flex, index: 3, found: 1 });
    }

    #[cfg(not(feature = "cuda"))]
    #[test]
    fn a_missing_backend_names_its_feature() {
        let error = open(Backend::Cuda, 0).unwrap_err();
        assert!(error.to_string().contains("--features cuda"), "{error}");
        assert!(available().iter().any(|d| d.backend == Backend::Cuda && d.index.is_none()));
    }
}
