//! Weights in files: safetensors, one file or several, and torch's pickles. They are read tensor by tensor, in their
//! stored type.
//!
//! No code of a pickle is executed. An archive that would grow beyond its own length is not unpacked.

use std::cell::RefCell;
use std::collections::BTreeMap;
use std::fs::File;
use std::io::{Read as _, Seek as _, SeekFrom};
use std::rc::Rc;

use motion::{DataPath, tensor_header};
use protocol::{excerpt, json_mistake, limits};
use pytorch_reader::{DType, PytorchReader};
use serde::Deserialize;

use crate::error::EncoderError;
use crate::network::TensorSpec;
use crate::tensor_file::{Element, ReadAt, TensorFile, WeightsFile, widen};

/// Largest number of files of sharded weights.
const SHARDS: usize = 256;
/// Largest size of the list of shards, in bytes.
const INDEX_BYTES: u64 = 16 << 20;
/// Largest number of names in an error.
const SHOWN: usize = 8;

/// An untrusted file.
#[derive(Debug)]
struct OnDisk {
    file: RefCell<File>,
    bytes: u64,
}

impl ReadAt for OnDisk {
    fn bytes(&self) -> u64 {
        self.bytes
    }

    fn read_at(&self, offset: u64, out: &mut [u8]) -> Result<(), String> {
        let mut file = self.file.borrow_mut();
        file.seek(SeekFrom::Start(offset)).and_then(|_| file.read_exact(out)).map_err(|e| e.to_string())
    }
}

/// Source of a tensor's bytes.
#[derive(Clone)]
enum Place {
    Safe(Rc<OnDisk>, u64),
    Torch(pytorch_reader::Tensor),
}

/// A tensor in a folder that is not read yet.
#[derive(Clone)]
pub struct StoredTensor {
    /// Stored type of its numbers.
    pub element: Element,
    /// Length of each axis.
    pub shape: Vec<usize>,
    place: Place,
}

impl std::fmt::Debug for StoredTensor {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "{:?} {:?}", self.element, self.shape)
    }
}

impl StoredTensor {
    /// Reads its numbers as f32, row by row.
    ///
    /// # Errors
    /// The reason that they cannot be read.
    pub fn values(&self) -> Result<Vec<f32>, String> {
        let bytes = self.read()?;
        let mut values = vec![0.0; bytes.len() / self.element.bytes()];
        if values.len() != self.shape.iter().product::<usize>() {
            return Err(format!("has {} numbers for the shape {:?}", values.len(), self.shape));
        }
        widen(self.element, &bytes, &mut values);
        Ok(values)
    }

    /// Reads its bytes, little-endian.
    fn read(&self) -> Result<Vec<u8>, String> {
        let length = self.shape.iter().product::<usize>() * self.element.bytes();
        match &self.place {
            Place::Safe(file, offset) => {
                let mut bytes = vec![0; length];
                file.read_at(*offset, &mut bytes)?;
                Ok(bytes)
            }
            Place::Torch(tensor) => {
                let mut bytes = tensor.read().map_err(|e| no_torch(&e))?;
                if cfg!(target_endian = "big") {
                    bytes.chunks_exact_mut(self.element.bytes()).for_each(<[u8]>::reverse);
                }
                Ok(bytes)
            }
        }
    }
}

/// Tensors by name, not read yet.
#[derive(Debug, Default)]
pub struct Weights {
    tensors: BTreeMap<String, StoredTensor>,
    /// Tensors that do not hold floats of at most 32 bits, with a description.
    others: BTreeMap<String, String>,
}

impl Weights {
    /// Opens the weights of a folder: `model.safetensors`, the shards of `model.safetensors.index.json`, or
    /// `pytorch_model.bin`.
    ///
    /// # Errors
    /// The invalid file.
    pub fn open(folder: &DataPath) -> Result<Self, EncoderError> {
        let is_there = |name: &str| folder.join(name).has_entry();
        let mut weights = Self::default();
        if is_there("model.safetensors") {
            weights.add_safetensors(&folder.join("model.safetensors"))?;
        } else if is_there("model.safetensors.index.json") {
            for shard in shards(&folder.join("model.safetensors.index.json"))? {
                weights.add_safetensors(&folder.join_quoted(&shard))?;
            }
        } else if is_there("pytorch_model.bin") {
            weights.add_torch(&folder.join("pytorch_model.bin"))?;
        } else {
            let what = "no `model.safetensors`, `model.safetensors.index.json` or `pytorch_model.bin`; download the model's weights too";
            return Err(EncoderError::at(folder, what));
        }
        Ok(weights)
    }

    /// Opens the tensors of one file, safetensors or torch's, under any file name. A tensor inside dicts of a torch
    /// file has the dicts' keys as prefix, joined by dots.
    ///
    /// # Errors
    /// If the file is neither, or declares more data than it holds.
    pub fn open_file(path: &DataPath) -> Result<Self, EncoderError> {
        let refuse = |what: String| EncoderError::at(path, what);
        let (file, bytes) = path.open().map_err(|e| refuse(e.to_string()))?;
        if bytes > limits::WEIGHTS_BYTES {
            return Err(refuse(format!("has {bytes} bytes; expected at most {}", limits::WEIGHTS_BYTES)));
        }
        let mut first = Vec::new();
        file.take(9).read_to_end(&mut first).map_err(|e| refuse(e.to_string()))?;
        let mut weights = Self::default();
        // A header follows its length, and is a JSON object.
        match first.get(8) {
            Some(b'{') => weights.add_safetensors(path)?,
            Some(_) => weights.add_torch(path)?,
            None => {
                return Err(refuse(format!("has {bytes} bytes; expected a torch checkpoint or a safetensors file")));
            }
        }
        Ok(weights)
    }

    /// All tensors by name.
    pub fn tensors(&self) -> &BTreeMap<String, StoredTensor> {
        &self.tensors
    }

    /// Tensors that do not hold floats of at most 32 bits, by name, with a description.
    pub fn others(&self) -> &BTreeMap<String, String> {
        &self.others
    }

    fn add_safetensors(&mut self, path: &DataPath) -> Result<(), EncoderError> {
        let refuse = |what: String| EncoderError::at(path, what);
        let (file, bytes) = path.open().map_err(|e| refuse(e.to_string()))?;
        let file = WeightsFile::open(OnDisk { file: file.into(), bytes }).map_err(refuse)?;
        let source = Rc::new(file.source);
        for (name, TensorFile { element, shape, offset }) in file.tensors {
            match element {
                Some(element) => {
                    let tensor = StoredTensor { element, shape, place: Place::Safe(Rc::clone(&source), offset) };
                    if self.tensors.insert(name.clone(), tensor).is_some() {
                        let name = excerpt(&name);
                        return Err(refuse(format!("the tensor `{name}` is also in another file")));
                    }
                }
                None => {
                    self.others.insert(name, "not a float of at most 32 bits".into());
                }
            }
        }
        Ok(())
    }

    fn add_torch(&mut self, path: &DataPath) -> Result<(), EncoderError> {
        let refuse = |what: String| EncoderError::at(path, what);
        let length = archive_length(path).map_err(refuse)?;
        let held = path.hold().map_err(|e| refuse(e.to_string()))?;
        let reader = PytorchReader::new(held.path()).map_err(|e| refuse(no_torch(&e)))?;
        let mut declared = 0_u64;
        for (name, tensor) in reader.into_tensors() {
            let element = match tensor.dtype() {
                DType::F32 => Element::F32,
                DType::F16 => Element::F16,
                DType::BF16 => Element::Bf16,
                other => {
                    self.others.insert(name, format!("{other:?}"));
                    continue;
                }
            };
            declared = declared.saturating_add(tensor.byte_len() as u64);
            self.tensors
                .insert(name, StoredTensor { element, shape: tensor.shape().to_vec(), place: Place::Torch(tensor) });
        }
        // A tensor may repeat one number, and several may share one storage.
        if declared > length.saturating_mul(2) {
            return Err(refuse(format!("its tensors declare {declared} bytes, but the file has {length}")));
        }
        Ok(())
    }

    /// Renames a tensor, if it exists and the other name is unused.
    pub(crate) fn alias(&mut self, from: &str, to: &str) {
        if !self.tensors.contains_key(to)
            && let Some(tensor) = self.tensors.remove(from)
        {
            self.tensors.insert(to.to_owned(), tensor);
        }
    }

    /// Takes the tensors of `specs`, and returns them with `prefix` before their names. The others stay.
    ///
    /// # Errors
    /// The missing names and shapes, and the file's shapes under those names.
    pub(crate) fn take(
        &mut self,
        place: &DataPath,
        specs: &[TensorSpec],
        prefix: &str,
    ) -> Result<BTreeMap<String, StoredTensor>, EncoderError> {
        let mut found = BTreeMap::new();
        let mut missing = Vec::new();
        for TensorSpec { name, shape } in specs {
            match self.tensors.remove(name) {
                Some(tensor) if tensor.shape == *shape => {
                    found.insert(format!("{prefix}{name}"), tensor);
                }
                Some(tensor) => missing.push(format!("`{name}` {shape:?} (it has shape {:?})", tensor.shape)),
                None => match self.others.get(name) {
                    Some(what) => missing.push(format!("`{name}` {shape:?} (it is {what})")),
                    None => missing.push(format!("`{name}` {shape:?}")),
                },
            }
        }
        if missing.is_empty() {
            return Ok(found);
        }
        let all = missing.len();
        missing.truncate(SHOWN);
        let more = if all > SHOWN { format!(" and {} more", all - SHOWN) } else { String::new() };
        let what = format!(
            "the weights do not match `config.json`; missing: {}{more}; number of other tensors: {}",
            missing.join(", "),
            self.tensors.len()
        );
        Err(EncoderError::at(place, what))
    }

    /// The names of all tensors that were not taken.
    pub(crate) fn left(&self) -> Vec<String> {
        self.tensors.keys().chain(self.others.keys()).cloned().collect()
    }
}

/// The reader's message about a pickle, as an excerpt, since it may quote the file.
pub fn no_torch(error: &dyn std::fmt::Display) -> String {
    format!("cannot read it as a torch file: {}", excerpt(&error.to_string()))
}

/// Reads the names of the files in a list of shards, each once.
fn shards(path: &DataPath) -> Result<Vec<String>, EncoderError> {
    #[derive(Deserialize)]
    struct Index {
        weight_map: BTreeMap<String, String>,
    }
    let refuse = |what: String| EncoderError::at(path, what);
    let bytes = path.read(INDEX_BYTES).map_err(|e| refuse(e.to_string()))?;
    let index: Index =
        serde_json::from_slice(&bytes).map_err(|e| refuse(format!("{}; expected `weight_map`", json_mistake(&e))))?;
    let mut names: Vec<String> = index.weight_map.into_values().collect();
    names.sort();
    names.dedup();
    // A list must not name files outside its folder.
    if let Some(name) =
        names.iter().find(|name| name.is_empty() || name.contains(['/', '\\', '\0']) || name.starts_with('.'))
    {
        return Err(refuse(format!("`{}` is not a file name in the same folder", excerpt(name))));
    }
    if names.is_empty() || names.len() > SHARDS {
        return Err(refuse(format!("names {} files; expected 1 to {SHARDS}", names.len())));
    }
    Ok(names)
}

/// The length of a file that a pickle reader may open: a regular file, not too large, and no archive that unpacks to
/// more than its own length. `torch.save` writes uncompressed archives.
///
/// # Errors
/// The reason for refusing it, without its path.
pub fn archive_length(path: &DataPath) -> Result<u64, String> {
    let (mut file, length) = path.open().map_err(|e| e.to_string())?;
    if length > limits::WEIGHTS_BYTES {
        return Err(format!("has {length} bytes; at most {} are read", limits::WEIGHTS_BYTES));
    }
    let mut magic = [0; 2];
    if file.read_exact(&mut magic).is_err() || &magic != b"PK" {
        return Ok(length);
    }
    let no_archive = |e: &dyn std::fmt::Display| format!("cannot read its archive: {}", excerpt(&e.to_string()));
    let mut archive = zip::ZipArchive::new(file).map_err(|e| no_archive(&e))?;
    let mut unpacked = 0_u64;
    for i in 0..archive.len() {
        unpacked = unpacked.saturating_add(archive.by_index_raw(i).map_err(|e| no_archive(&e))?.size());
    }
    if unpacked > length {
        return Err(format!(
            "unpacks to {unpacked} bytes, but has {length}; expected an uncompressed archive, as `torch.save` writes it"
        ));
    }
    Ok(length)
}

/// Serialises tensors as the pieces of one safetensors file, in the order of their names.
pub(crate) fn packed(place: &DataPath, tensors: &BTreeMap<String, StoredTensor>) -> Result<Vec<Vec<u8>>, EncoderError> {
    let refuse = |what: String| EncoderError::at(place, what);
    let info = |(name, tensor): (&String, &StoredTensor)| (name.clone(), tensor.element.dtype(), tensor.shape.clone());
    let mut pieces = vec![tensor_header::header(tensors.iter().map(info))];
    for (name, tensor) in tensors {
        pieces.push(tensor.read().map_err(|e| refuse(format!("`{name}`: {e}")))?);
    }
    Ok(pieces)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::tensor_file::tests::{Bytes, file};

    #[test]
    fn a_list_of_shards_names_files_beside_it() {
        protocol::show_excerpts();
        let folder = tempfile::tempdir().unwrap();
        let index = folder.path().join("model.safetensors.index.json");
        for (text, part) in [
            (r#"{"weight_map": {"a": "../x"}}"#, "`../x` is not a file name in the same folder"),
            (r#"{"weight_map": {"a": "..", "b": "x"}}"#, "`..` is not"),
            (r#"{"weight_map": {}}"#, "names 0 files"),
            (r#"{"weights": {}}"#, "expected `weight_map`"),
            ("", "expected `weight_map`"),
        ] {
            std::fs::write(&index, text).unwrap();
            let said = Weights::open(&DataPath::local(folder.path())).unwrap_err().to_string();
            assert!(said.contains(part), "{said}");
        }
        std::fs::write(&index, r#"{"weight_map": {"a": "one", "b": "two"}}"#).unwrap();
        for (name, tensor) in [("one", "a"), ("two", "a")] {
            let header = format!(r#"{{"{tensor}":{{"dtype":"BF16","shape":[1],"data_offsets":[0,2]}}}}"#);
            std::fs::write(folder.path().join(name), file(&header, &[0x80, 0x3f])).unwrap();
        }
        let said = Weights::open(&DataPath::local(folder.path())).unwrap_err().to_string();
        assert!(said.contains("`a` is also in another file"), "{said}");
        let header = r#"{"b":{"dtype":"I64","shape":[1],"data_offsets":[0,8]}}"#;
        std::fs::write(folder.path().join("two"), file(header, &[0; 8])).unwrap();
        let mut weights = Weights::open(&DataPath::local(folder.path())).unwrap();
        let spec = |name: &str| TensorSpec { name: name.into(), shape: vec![1] };
        let said = weights.take(&DataPath::local(folder.path()), &[spec("b")], "").unwrap_err().to_string();
        assert!(said.contains("missing: `b` [1] (it is not a float"), "{said}");
        let taken = weights.take(&DataPath::local(folder.path()), &[spec("a")], "x.").unwrap();
        assert_eq!(taken.keys().collect::<Vec<_>>(), ["x.a"]);
        let pieces = packed(&DataPath::local(folder.path()), &taken).unwrap().concat();
        let mut out = [0.0];
        WeightsFile::open(Bytes(pieces)).unwrap().read("x.a", &mut out).unwrap();
        assert_eq!(out, [1.0]);
        assert_eq!(weights.left(), ["b"]);
    }
}
