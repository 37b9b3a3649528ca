//! Safetensors under the published names, for export, import and artifacts.

use std::collections::BTreeMap;
use std::convert::Infallible;

use burn::module::Module;
use bytemuck::{cast_slice, cast_slice_mut};
pub use motion::tensor_header::ReadAt;
use motion::tensor_header::{self, Header};
use safetensors::tensor::{Dtype, TensorInfo};

use crate::flat::{Entry, layout, read, replace};

/// Weights do not fit a network.
#[derive(Debug, thiserror::Error)]
pub enum LoadError {
    /// The bytes are not a safetensors file.
    #[error("the file {0}")]
    Unreadable(String),
    /// Names or shapes differ from the network's.
    #[error("the weights do not fit the network; missing: [{}]; unused: [{}]", missing.join(", "), unused.join(", "))]
    Mismatch {
        /// Names with shapes that the network has and the file lacks.
        missing: Vec<String>,
        /// Names with shapes that the file has and the network lacks.
        unused: Vec<String>,
    },
}

/// Parameters as the pieces of their safetensors file. The pieces borrow the values: large weights are not copied.
#[derive(Debug)]
pub struct Weights<'a> {
    header: Vec<u8>,
    /// Tensors in the order of the file.
    tensors: Vec<&'a [f32]>,
}

impl<'a> Weights<'a> {
    /// Names the tensors of a flat buffer by `entries`.
    ///
    /// # Panics
    /// As [`of`](Self::of).
    pub fn new(entries: &[Entry], flat: &'a [f32]) -> Self {
        Self::of(&[(entries, flat)])
    }

    /// Names tensors of several buffers, each with the entries of its parts, for one file. The file has the order and
    /// alignment of the `safetensors` crate.
    ///
    /// # Panics
    /// If a buffer has another length than its entries have elements, or two entries have one name.
    pub fn of(buffers: &[(&[Entry], &'a [f32])]) -> Self {
        let mut by_name = BTreeMap::new();
        for (entries, flat) in buffers {
            let mut flat = *flat;
            for entry in *entries {
                let (tensor, rest) = flat.split_at(entry.len());
                flat = rest;
                let other = by_name.insert(entry.name.as_str(), (&entry.shape, tensor));
                assert!(other.is_none(), "two tensors are called `{}`", entry.name);
            }
            assert!(flat.is_empty(), "every value has a name");
        }
        let infos = by_name.iter().map(|(name, (shape, _))| ((*name).to_owned(), Dtype::F32, (*shape).clone()));
        let header = tensor_header::header(infos);
        Self { header, tensors: by_name.into_values().map(|(_, tensor)| tensor).collect() }
    }

    /// Returns the bytes of the file, one piece after the other.
    pub fn pieces(&self) -> Vec<&[u8]> {
        std::iter::once(&self.header[..]).chain(self.tensors.iter().map(|tensor| cast_slice(tensor))).collect()
    }
}

/// Serialises the tensors that `entries` cuts from a flat buffer as one file.
pub fn to_bytes(entries: &[Entry], flat: &[f32]) -> Vec<u8> {
    Weights::new(entries, flat).pieces().concat()
}

/// Reads the header of a file of `bytes` bytes.
fn header<E>(bytes: u64, read: &mut ReadAt<'_, E>) -> Result<Result<Header, LoadError>, E> {
    Ok(Header::read(bytes, read)?.map_err(LoadError::Unreadable))
}

/// Finds the offsets in a file of the tensors of `entries`, whose names there start with `prefix`.
fn places(header: &Header, entries: &[Entry], prefix: &str) -> Result<Vec<u64>, LoadError> {
    let mut unused: BTreeMap<String, &TensorInfo> = header.metadata.tensors().into_iter().collect();
    unused.retain(|name, _| name.starts_with(prefix));
    let mut places = Vec::with_capacity(entries.len());
    let mut missing = Vec::new();
    for entry in entries {
        let name = format!("{prefix}{}", entry.name);
        match unused.remove(&name) {
            Some(info) if info.shape == entry.shape && info.dtype == Dtype::F32 => {
                places.push(header.place(info));
            }
            other => {
                missing.push(format!("{name} {:?}", entry.shape));
                unused.extend(other.map(|info| (name, info)));
            }
        }
    }
    if missing.is_empty() && unused.is_empty() {
        return Ok(places);
    }
    let unused = unused.into_iter().map(|(name, info)| format!("{name} {:?}", info.shape)).collect();
    Err(LoadError::Mismatch { missing, unused })
}

/// The tensors of a file that fit a network.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Fitted {
    /// Values by tensor of the network, in its order; `None` if the file lacks the tensor or has another shape or type.
    pub values: Vec<Option<Vec<f32>>>,
    /// Names and shapes of the tensors without values, and the file's shape under the same name.
    pub fresh: Vec<String>,
}

/// Reads the tensors of a file that fit `entries` by name, after `prefix`, and by shape. `read` is as in [`load_from`].
///
/// # Errors
/// The error of `read`; the inner error if the file is not safetensors. A file in which nothing fits is no error.
pub fn fitting<E>(
    entries: &[Entry],
    bytes: u64,
    read: &mut ReadAt<'_, E>,
    prefix: &str,
) -> Result<Result<Fitted, LoadError>, E> {
    let header = match header(bytes, read)? {
        Ok(header) => header,
        Err(error) => return Ok(Err(error)),
    };
    let tensors = header.metadata.tensors();
    let mut fitted = Fitted::default();
    for entry in entries {
        let name = format!("{prefix}{}", entry.name);
        let found = tensors.get(&name);
        match found.filter(|info| info.shape == entry.shape && info.dtype == Dtype::F32) {
            Some(info) => {
                let mut values = vec![0.0; entry.len()];
                read_values(header.place(info), &mut values, read)?;
                fitted.values.push(Some(values));
            }
            None => {
                let there = match found {
                    Some(info) if info.dtype != Dtype::F32 => format!("{:?} there", info.dtype),
                    Some(info) => format!("{:?} there", info.shape),
                    None => "not there".to_owned(),
                };
                fitted.fresh.push(format!("{name} {:?} ({there})", entry.shape));
                fitted.values.push(None);
            }
        }
    }
    Ok(Ok(fitted))
}

/// Reads the names and shapes of a file's tensors. `read` is as in [`load_from`].
///
/// # Errors
/// As [`fitting`].
pub fn tensors<E>(bytes: u64, read: &mut ReadAt<'_, E>) -> Result<Result<Vec<Entry>, LoadError>, E> {
    let entry = |(name, info): (String, &TensorInfo)| Entry { name, shape: info.shape.clone() };
    let entries = |header: Header| header.metadata.tensors().into_iter().map(entry).collect();
    Ok(header(bytes, read)?.map(entries))
}

/// Adapts bytes in memory to [`ReadAt`].
fn in_memory(bytes: &[u8]) -> impl FnMut(u64, &mut [u8]) -> Result<(), Infallible> {
    |offset, out| {
        // The header was checked against the length.
        let from = usize::try_from(offset).unwrap_or(usize::MAX);
        out.copy_from_slice(&bytes[from..from + out.len()]);
        Ok(())
    }
}

/// Reads a flat buffer in the order of `entries` from the tensors of `bytes` whose names start with `prefix`.
///
/// # Errors
/// If the file is not safetensors, or its names or shapes are not those of `entries`.
pub fn from_bytes(entries: &[Entry], bytes: &[u8], prefix: &str) -> Result<Vec<f32>, LoadError> {
    let mut read = in_memory(bytes);
    let Ok(header) = header(bytes.len() as u64, &mut read);
    let places = places(&header?, entries, prefix)?;
    let mut flat = vec![0.0; entries.iter().map(Entry::len).sum()];
    let mut rest = flat.as_mut_slice();
    for (entry, place) in entries.iter().zip(places) {
        let (tensor, later) = rest.split_at_mut(entry.len());
        let Ok(()) = read_values(place, tensor, &mut read);
        rest = later;
    }
    Ok(flat)
}

fn read_values<E>(place: u64, values: &mut [f32], read: &mut ReadAt<'_, E>) -> Result<(), E> {
    read(place, cast_slice_mut(values))?;
    if cfg!(target_endian = "big") {
        values.iter_mut().for_each(|value| *value = f32::from_bits(value.to_bits().swap_bytes()));
    }
    Ok(())
}

/// Serialises the module's parameters under their published names.
pub fn save<M: Module>(module: &M) -> Vec<u8> {
    to_bytes(&layout(module), &read(module))
}

/// Loads into the module the parameters of `bytes` whose names start with `prefix`.
///
/// # Errors
/// As [`from_bytes`].
pub fn load<M: Module>(module: M, bytes: &[u8], prefix: &str) -> Result<M, LoadError> {
    let Ok(loaded) = load_from(module, bytes.len() as u64, &mut in_memory(bytes), prefix);
    loaded
}

/// Loads like [`load`] from a file of `bytes` bytes, tensor by tensor; `read` fills a buffer with the bytes at an
/// offset.
///
/// # Errors
/// The error of `read`; the inner error as [`from_bytes`].
pub fn load_from<M: Module, E>(
    module: M,
    bytes: u64,
    read: &mut ReadAt<'_, E>,
    prefix: &str,
) -> Result<Result<M, LoadError>, E> {
    let places = header(bytes, read)?.and_then(|header| places(&header, &layout(&module), prefix));
    let places = match places {
        Ok(places) => places,
        Err(error) => return Ok(Err(error)),
    };
    let mut places = places.into_iter();
    let module = replace(module, |values| {
        let place = places.next().expect("a place for each parameter");
        read_values(place, values, read)
    })?;
    Ok(Ok(module))
}
