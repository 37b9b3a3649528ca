//! Safetensors under the published names: what is exported, imported and kept in artifacts.

use std::collections::BTreeMap;
use std::convert::Infallible;

use burn::module::Module;
use bytemuck::{cast_slice, cast_slice_mut};
use safetensors::SafeTensorError;
use safetensors::tensor::{Dtype, Metadata, TensorInfo};

use crate::flat::{Entry, layout, read, replace};

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

/// Parameters as the safetensors file that they are kept as, in pieces that lie where they are: no second copy of large weights is made.
#[derive(Debug)]
pub struct Weights<'a> {
    header: Vec<u8>,
    /// In the order of the file.
    tensors: Vec<&'a [f32]>,
}

impl<'a> Weights<'a> {
    /// Tensors named by `entries`, cut out of a flat buffer.
    ///
    /// # Panics
    /// As [`of`](Self::of).
    pub fn new(entries: &[Entry], flat: &'a [f32]) -> Self {
        Self::of(&[(entries, flat)])
    }

    /// Tensors of several buffers, each with the entries that name its parts, in one file. The file is in the order and with the alignment of
    /// the `safetensors` crate.
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
        let mut end = 0;
        let info = |(name, (shape, tensor)): (&&str, &(&Vec<usize>, &[f32]))| {
            let begin = end;
            end += size_of_val(*tensor);
            let info = TensorInfo { dtype: Dtype::F32, shape: (*shape).clone(), data_offsets: (begin, end) };
            ((*name).to_owned(), info)
        };
        let metadata = Metadata::new(None, by_name.iter().map(info).collect()).expect("tensors one after the other");
        let mut json = serde_json::to_vec(&metadata).expect("names and numbers");
        json.resize(json.len().next_multiple_of(8), b' ');
        let header = [&(json.len() as u64).to_le_bytes()[..], &json].concat();
        Self { header, tensors: by_name.into_values().map(|(_, tensor)| tensor).collect() }
    }

    /// The bytes of the file, one piece after the other.
    pub fn pieces(&self) -> Vec<&[u8]> {
        std::iter::once(&self.header[..]).chain(self.tensors.iter().map(|tensor| cast_slice(tensor))).collect()
    }
}

/// Tensors named by `entries`, cut out of a flat buffer, as one file.
pub fn to_bytes(entries: &[Entry], flat: &[f32]) -> Vec<u8> {
    Weights::new(entries, flat).pieces().concat()
}

/// A safetensors file whose header was read.
#[derive(Debug)]
struct Header {
    metadata: Metadata,
    /// Where its tensors begin.
    data: u64,
}

impl Header {
    /// Of a file of `bytes` bytes, of which `read` fills a buffer with those at an offset.
    fn read<E>(bytes: u64, read: &mut ReadAt<'_, E>) -> Result<Result<Self, LoadError>, E> {
        let unreadable = |e: SafeTensorError| Ok(Err(LoadError::Unreadable(e)));
        let mut length = [0; 8];
        if bytes < 8 {
            return unreadable(SafeTensorError::HeaderTooSmall);
        }
        read(0, &mut length)?;
        let length = u64::from_le_bytes(length);
        if length > HEADER_BYTES {
            return unreadable(SafeTensorError::HeaderTooLarge);
        }
        if length > bytes - 8 {
            return unreadable(SafeTensorError::InvalidHeaderLength);
        }
        let mut json = vec![0; usize::try_from(length).unwrap_or_default()];
        read(8, &mut json)?;
        let metadata: Metadata = match serde_json::from_slice(&json) {
            Ok(metadata) => metadata,
            Err(e) => return unreadable(SafeTensorError::InvalidHeaderDeserialization(e)),
        };
        if metadata.data_len() as u64 != bytes - 8 - length {
            return unreadable(SafeTensorError::MetadataIncompleteBuffer);
        }
        Ok(Ok(Self { metadata, data: 8 + length }))
    }

    /// Where the tensors of `entries` are in the file, whose names begin with `prefix` there.
    fn places(&self, entries: &[Entry], prefix: &str) -> Result<Vec<u64>, LoadError> {
        let mut unused: BTreeMap<String, &TensorInfo> = self.metadata.tensors().into_iter().collect();
        unused.retain(|name, _| name.starts_with(prefix));
        let (mut places, mut missing) = (Vec::with_capacity(entries.len()), Vec::new());
        for entry in entries {
            let name = format!("{prefix}{}", entry.name);
            match unused.remove(&name) {
                Some(info) if info.shape == entry.shape && info.dtype == Dtype::F32 => {
                    places.push(self.data + info.data_offsets.0 as u64);
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
}

/// What of a file fitted a network.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Fitted {
    /// Values by tensor of the network, in its order; none of a tensor that the file has not, or has in another shape or type.
    pub values: Vec<Option<Vec<f32>>>,
    /// Those without values: name and shape, and what the file has under the name.
    pub fresh: Vec<String>,
}

/// The tensors of a file that fit `entries` by name, behind `prefix`, and by shape. `read` is as in [`load_from`].
///
/// # Errors
/// What `read` says; inside, that the file is not safetensors. That nothing fits is none.
pub fn fitting<E>(
    entries: &[Entry],
    bytes: u64,
    read: &mut ReadAt<'_, E>,
    prefix: &str,
) -> Result<Result<Fitted, LoadError>, E> {
    let header = match Header::read(bytes, read)? {
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
                read_values(header.data + info.data_offsets.0 as u64, &mut values, read)?;
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

/// The names and shapes of a file's tensors. `read` is as in [`load_from`].
///
/// # Errors
/// As [`fitting`].
pub fn tensors<E>(bytes: u64, read: &mut ReadAt<'_, E>) -> Result<Result<Vec<Entry>, LoadError>, E> {
    let entry = |(name, info): (String, &TensorInfo)| Entry { name, shape: info.shape.clone() };
    let entries = |header: Header| header.metadata.tensors().into_iter().map(entry).collect();
    Ok(Header::read(bytes, read)?.map(entries))
}

/// The largest header that is read; that of a thousand tensors has a hundred kilobytes.
const HEADER_BYTES: u64 = 16 << 20;

/// Fills a buffer with what begins at an offset of a file.
pub type ReadAt<'a, E> = dyn FnMut(u64, &mut [u8]) -> Result<(), E> + 'a;

/// Reads a file that is in memory.
fn in_memory(bytes: &[u8]) -> impl FnMut(u64, &mut [u8]) -> Result<(), Infallible> {
    |offset, out| {
        // The header was held against the length.
        let from = usize::try_from(offset).unwrap_or(usize::MAX);
        out.copy_from_slice(&bytes[from..from + out.len()]);
        Ok(())
    }
}

/// A flat buffer in the order of `entries`, out of the tensors of `bytes` whose names start with `prefix`.
///
/// # Errors
/// If the file is not safetensors, or its names or shapes are not those of `entries`.
pub fn from_bytes(entries: &[Entry], bytes: &[u8], prefix: &str) -> Result<Vec<f32>, LoadError> {
    let mut read = in_memory(bytes);
    let Ok(header) = Header::read(bytes.len() as u64, &mut read);
    let places = header?.places(entries, prefix)?;
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

/// The module's parameters under their published names.
pub fn save<M: Module>(module: &M) -> Vec<u8> {
    to_bytes(&layout(module), &read(module))
}

/// The module with the parameters of `bytes` whose names start with `prefix`.
///
/// # Errors
/// As [`from_bytes`].
pub fn load<M: Module>(module: M, bytes: &[u8], prefix: &str) -> Result<M, LoadError> {
    let Ok(loaded) = load_from(module, bytes.len() as u64, &mut in_memory(bytes), prefix);
    loaded
}

/// As [`load`], from a file of `bytes` bytes of which `read` fills a buffer with those at an offset, tensor by tensor.
///
/// # Errors
/// What `read` says; inside, as [`from_bytes`].
pub fn load_from<M: Module, E>(
    module: M,
    bytes: u64,
    read: &mut ReadAt<'_, E>,
    prefix: &str,
) -> Result<Result<M, LoadError>, E> {
    let places = Header::read(bytes, read)?.and_then(|header| header.places(&layout(&module), prefix));
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
