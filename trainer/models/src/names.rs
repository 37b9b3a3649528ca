//! Safetensors under the published names: what is exported, imported and kept in artifacts.

use burn::module::Module;
use safetensors::tensor::{Dtype, TensorView};
use safetensors::{SafeTensors, serialize};

use crate::flat::{Entry, layout, read, write};

/// Why weights do not fit a network.
#[derive(Debug, thiserror::Error)]
pub enum LoadError {
    /// Not a safetensors file.
    #[error("not a readable safetensors file: {0}")]
    Unreadable(#[from] safetensors::SafeTensorError),
    /// Other names or shapes than the network has.
    #[error("the weights do not fit the network; missing: [{}]; unused: [{}]", missing.join(", "), unused.join(", "))]
    Mismatch {
        /// Names with shapes that the network has and the file has not.
        missing: Vec<String>,
        /// Names with shapes that the file has and the network has not.
        unused: Vec<String>,
    },
}

/// Tensors named by `entries`, cut out of a flat buffer.
pub fn to_bytes(entries: &[Entry], flat: &[f32]) -> Vec<u8> {
    let bytes: Vec<u8> = flat.iter().flat_map(|v| v.to_le_bytes()).collect();
    let mut at = 0;
    let views = entries.iter().map(|entry| {
        let size = 4 * entry.len();
        let view = TensorView::new(Dtype::F32, entry.shape.clone(), &bytes[at..at + size]).expect("sizes agree");
        at += size;
        (entry.name.clone(), view)
    });
    let views: Vec<_> = views.collect();
    serialize(views, None).expect("f32 tensors serialise")
}

/// A flat buffer in the order of `entries`, out of the tensors of `bytes` whose names start with `prefix`.
///
/// # Errors
/// If the file is not safetensors, or its names or shapes are not those of `entries`.
pub fn from_bytes(entries: &[Entry], bytes: &[u8], prefix: &str) -> Result<Vec<f32>, LoadError> {
    let file = SafeTensors::deserialize(bytes)?;
    let mut unused: Vec<String> =
        file.names().into_iter().filter(|n| n.starts_with(prefix)).map(ToString::to_string).collect();
    let (mut flat, mut missing) = (Vec::new(), Vec::new());
    for entry in entries {
        let name = format!("{prefix}{}", entry.name);
        match file.tensor(&name) {
            Ok(view) if view.shape() == entry.shape && view.dtype() == Dtype::F32 => {
                unused.retain(|n| *n != name);
                flat.extend(view.data().chunks_exact(4).map(|b| f32::from_le_bytes([b[0], b[1], b[2], b[3]])));
            }
            _ => missing.push(format!("{name} {:?}", entry.shape)),
        }
    }
    if missing.is_empty() && unused.is_empty() {
        return Ok(flat);
    }
    unused.sort();
    let with_shape = |name: String| {
        let shape = file.tensor(&name).map_or_else(|_| Vec::new(), |view| view.shape().to_vec());
        format!("{name} {shape:?}")
    };
    Err(LoadError::Mismatch { missing, unused: unused.into_iter().map(with_shape).collect() })
}

/// The module's parameters under their published names.
pub fn save<M: Module>(module: &M) -> Vec<u8> {
    to_bytes(&layout(module), &read(module))
}

/// The module with the parameters of `bytes` whose names start with `prefix`.
///
/// # Errors
/// As [`from_bytes`].
pub fn load<M: Module>(module: M, bytes: &[u8], prefix: &str) -> Result<M, LoadError> {
    let flat = from_bytes(&layout(&module), bytes, prefix)?;
    Ok(write(module, &flat))
}
