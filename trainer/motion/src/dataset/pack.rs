//! A dataset as the files of an artifact.
//!
//! `dataset.json` holds everything but the features: format, statistics, captions, entries, and for each clip its id,
//! frames and shard. The features are in `clips-0000.safetensors`, `clips-0001.safetensors`, ... with at most 64 MiB of
//! data (or one clip) each. A tensor's name is `c` and the clip's index in seven digits, its values f32 `[L, D]`. Equal
//! datasets give equal bytes: clips keep their order, and neither file has a map with an order of its own.

use std::borrow::Cow;
use std::collections::BTreeSet;

use bytes::Bytes;
use protocol::stage::DataFormat;
use safetensors::tensor::{Dtype, SafeTensors, View};
use serde::{Deserialize, Serialize};

use super::{Clip, Dataset, Entry};
use crate::Floats;
use crate::skeleton::Skeleton;
use crate::text::Caption;

/// The file with everything but the features.
pub const INDEX: &str = "dataset.json";
const SHARD_BYTES: usize = 64 << 20;

/// The files of an artifact are not a dataset.
#[derive(Debug, thiserror::Error)]
pub enum PackError {
    /// A file could not be fetched.
    #[error("{file}: {why}")]
    Fetch {
        file: String,
        /// Message of the store.
        why: String,
    },
    /// A file's content differs from `dataset.json`.
    #[error("{file}: {what}")]
    Content {
        file: String,
        /// Difference between the two.
        what: String,
    },
    /// A file could not be written.
    #[error("{file}: cannot be encoded: {what}")]
    Encode {
        file: String,
        /// Message of the encoder.
        what: String,
    },
}

#[derive(Serialize, Deserialize)]
pub(super) struct Index {
    pub(super) version: u32,
    pub(super) format: DataFormat,
    pub(super) mean: Vec<f64>,
    pub(super) std: Vec<f64>,
    pub(super) clips: Vec<ClipRow>,
    pub(super) captions: Vec<Caption>,
    pub(super) entries: Vec<Entry>,
}

impl Index {
    fn fetched(fetch: &dyn Fn(&str) -> Result<Bytes, String>) -> Result<Self, PackError> {
        let bytes = fetch(INDEX).map_err(|why| PackError::Fetch { file: INDEX.into(), why })?;
        serde_json::from_slice(&bytes).map_err(|e| PackError::Content { file: INDEX.into(), what: e.to_string() })
    }
}

#[derive(Serialize, Deserialize)]
pub(super) struct ClipRow {
    pub(super) id: String,
    pub(super) frames: usize,
    pub(super) shard: usize,
}

struct Rows<'a> {
    shape: [usize; 2],
    data: &'a [f32],
}

impl View for Rows<'_> {
    fn dtype(&self) -> Dtype {
        Dtype::F32
    }

    fn shape(&self) -> &[usize] {
        &self.shape
    }

    fn data(&self) -> Cow<'_, [u8]> {
        Cow::Owned(self.data.iter().flat_map(|v| v.to_le_bytes()).collect())
    }

    fn data_len(&self) -> usize {
        4 * self.data.len()
    }
}

fn shard_name(shard: usize) -> String {
    format!("clips-{shard:04}.safetensors")
}

fn tensor_name(clip: usize) -> String {
    format!("c{clip:07}")
}

impl Dataset {
    /// Passes the artifact's files to `sink` one after the other, so that only one shard is in memory at a time.
    pub fn write_files<E: From<PackError>>(
        &self,
        mut sink: impl FnMut(String, Vec<u8>) -> Result<(), E>,
    ) -> Result<(), E> {
        let mut clips = vec![];
        let mut first = 0;
        while first < self.clips.len() {
            let mut bytes = 0;
            let fits = |clip: &&Clip| {
                bytes += 4 * clip.features.len();
                bytes <= SHARD_BYTES
            };
            let count = self.clips[first..].iter().take_while(fits).count().max(1);
            let shard = clips.last().map_or(0, |row: &ClipRow| row.shard + 1);
            let members = &self.clips[first..first + count];
            clips.extend(members.iter().map(|c| ClipRow { id: c.id.clone(), frames: c.frames, shard }));
            let width = self.skeleton().features;
            let tensors = members
                .iter()
                .enumerate()
                .map(|(i, c)| (tensor_name(first + i), Rows { shape: [c.frames, width], data: &c.features }));
            let name = shard_name(shard);
            let file = safetensors::serialize(tensors, None)
                .map_err(|e| PackError::Encode { file: name.clone(), what: e.to_string() })?;
            sink(name, file)?;
            first += count;
        }
        let wide = |values: &[f32]| values.iter().map(|v| f64::from(*v)).collect();
        let index = Index {
            version: 1,
            format: self.format,
            mean: wide(&self.mean),
            std: wide(&self.std),
            clips,
            captions: self.captions.clone(),
            entries: self.entries.clone(),
        };
        let bytes =
            serde_json::to_vec(&index).map_err(|e| PackError::Encode { file: INDEX.into(), what: e.to_string() })?;
        sink(INDEX.into(), bytes)
    }

    /// Returns the artifact's files as name and content. Needs the dataset's size in memory again; see
    /// [`Dataset::write_files`].
    pub fn to_files(&self) -> Result<Vec<(String, Vec<u8>)>, PackError> {
        let mut files = vec![];
        self.write_files::<PackError>(|name, bytes| {
            files.push((name, bytes));
            Ok(())
        })?;
        Ok(files)
    }

    /// Reads only the captions, without fetching a clip.
    pub fn captions_from_files(fetch: &dyn Fn(&str) -> Result<Bytes, String>) -> Result<Vec<Caption>, PackError> {
        Ok(Index::fetched(fetch)?.captions)
    }

    /// The captions of training entries alone, without fetching a clip.
    ///
    /// # Errors
    /// If the index cannot be fetched or does not read.
    pub fn training_captions_from_files(
        fetch: &dyn Fn(&str) -> Result<Bytes, String>,
    ) -> Result<Vec<Caption>, PackError> {
        let index = Index::fetched(fetch)?;
        let training = index.entries.iter().filter(|entry| entry.split == super::Split::Train);
        let numbers: BTreeSet<usize> = training.flat_map(|entry| entry.captions.iter().copied()).collect();
        Ok(numbers.into_iter().filter_map(|number| index.captions.get(number).cloned()).collect())
    }

    /// Reads the files of [`Dataset::write_files`]; `fetch` returns a file's content by its name. Features borrow that
    /// content without a copy.
    pub fn from_files(fetch: &dyn Fn(&str) -> Result<Bytes, String>) -> Result<Self, PackError> {
        let get = |file: &str| fetch(file).map_err(|why| PackError::Fetch { file: file.into(), why });
        let bad = |file: &str, what: String| PackError::Content { file: file.into(), what };
        let index = Index::fetched(fetch)?;
        if index.version != 1 {
            return Err(bad(INDEX, format!("has format version {}; expected 1; use a newer build", index.version)));
        }
        let width = Skeleton::of(index.format).features;
        let mut clips: Vec<Clip> = Vec::with_capacity(index.clips.len());
        for rows in index.clips.chunk_by(|a, b| a.shard == b.shard) {
            let name = shard_name(rows[0].shard);
            let bytes = get(&name)?;
            let tensors = SafeTensors::deserialize(&bytes).map_err(|e| bad(&name, e.to_string()))?;
            for row in rows {
                let tensor = tensors.tensor(&tensor_name(clips.len())).map_err(|e| bad(&name, e.to_string()))?;
                if tensor.dtype() != Dtype::F32 || tensor.shape() != [row.frames, width] {
                    let found = format!("clip {}: {:?} {:?}", row.id, tensor.dtype(), tensor.shape());
                    return Err(bad(&name, format!("is {found}; expected F32 [{}, {width}]", row.frames)));
                }
                let features = Floats::view(bytes.slice_ref(tensor.data()));
                let features = features.ok_or_else(|| bad(&name, format!("clip {}: invalid number", row.id)))?;
                clips.push(Clip { id: row.id.clone(), frames: row.frames, features });
            }
        }
        let narrow = |values: &[f64]| values.iter().map(|v| *v as f32).collect::<Vec<_>>();
        let mean = narrow(&index.mean);
        let std = narrow(&index.std);
        if mean.len() != width || std.len() != width {
            return Err(bad(
                INDEX,
                format!("the mean has {} values and the deviation {}; expected {width} each", mean.len(), std.len()),
            ));
        }
        for entry in &index.entries {
            let inside = clips.get(entry.clip).is_some_and(|c| entry.start + entry.len <= c.frames);
            if !inside || entry.captions.is_empty() || entry.captions.iter().any(|c| *c >= index.captions.len()) {
                return Err(bad(
                    INDEX,
                    format!("entry {} refers to frames outside its clip, or to missing captions", entry.id),
                ));
            }
        }
        Ok(Self { format: index.format, mean, std, clips, captions: index.captions, entries: index.entries })
    }
}
