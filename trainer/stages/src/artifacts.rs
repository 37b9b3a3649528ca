//! Reading and writing artifacts through an [`AttemptContext`], and the metas of our artifacts.
//!
//! An artifact is a manifest with files. The meta holds everything that a reader needs before it opens a file. The
//! structs here are its schema, one per artifact kind, shared by the stage that writes it and those that read it.
//! Tensors are safetensors in f32 or i64. Not its job: networks, and the contents of a checkpoint.

use std::cell::RefCell;
use std::collections::{BTreeMap, HashMap};
use std::sync::Arc;

use bytemuck::Pod;
use bytes::Bytes;
use checkpoint::model::{self, Parts};
use checkpoint::{Blob, BlobError, Blobs};
use motion::dataset::{Caption, Dataset, PackError, Split};
use motion::{Stream, Values, paths};
use protocol::artifact::Role;
use protocol::stage::{Augment, DataFormat, Diffusion, Family, LatentShape, Network};
use protocol::{ArtifactKind, Digest, FileEntry, Manifest, Seed, StageName};
use safetensors::tensor::TensorView;
use safetensors::{Dtype, SafeTensors};
use serde::de::DeserializeOwned;
use serde::{Deserialize, Serialize};

use crate::context::{AttemptContext, ContextError, StageError};

/// File of the weights of a VAE or a denoiser.
pub const MODEL_FILE: &str = "model.safetensors";
/// File of latents: `mu` and `sigma` `[rows, N, d]`, `entry` `[rows]`.
pub const LATENTS_FILE: &str = "latents.safetensors";
/// File of caption embeddings: `captions` `[n, dim]` in the dataset's caption order, `null` `[dim]`.
pub const EMBEDDINGS_FILE: &str = "embeddings.safetensors";

/// Meta of an artifact of kind `dataset`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct DatasetMeta {
    /// The skeleton and feature layout.
    pub format: DataFormat,
    /// Number of clips kept.
    pub clips: usize,
    /// Number of captions of all clips.
    pub captions: usize,
    /// Number of entries of the three splits together.
    pub entries: usize,
    /// Number of frames of all clips.
    pub frames: usize,
    /// Number of clips and captions left out; the file `report.txt` lists them with reasons.
    pub skipped: usize,
}

/// Meta of an artifact of kind `embeddings`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct EmbeddingsMeta {
    /// The encoder, which is also its part `text`.
    pub text: Digest,
    /// Width of an embedding.
    pub dim: usize,
    /// Number of captions embedded.
    pub captions: usize,
}

/// Meta of an artifact of kind `vae`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct VaeMeta {
    /// Format of the training data.
    pub format: DataFormat,
    /// Width of a feature vector.
    pub features: usize,
    pub latent: LatentShape,
    /// Size of encoder and decoder.
    pub network: Network,
    /// Mean of the training features, `[features]`.
    pub mean: Vec<f32>,
    /// Standard deviation of the training features, `[features]`.
    pub std: Vec<f32>,
    /// True if Linears surround the bottleneck. `None` means that they exist if its width differs from the
    /// transformer's.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub projection: Option<bool>,
}

/// Meta of an artifact of kind `latents`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct LatentsMeta {
    /// Format of the encoded data.
    pub format: DataFormat,
    /// The VAE that encoded the data.
    pub vae: Digest,
    pub latent: LatentShape,
    /// Crops per entry; row `e * crops + c` is crop `c` of entry `e`.
    pub crops: usize,
    /// Split of each entry.
    pub splits: Vec<Split>,
    /// Captions of each entry, as indices in the dataset and so as rows of the embeddings.
    pub captions: Vec<Vec<usize>>,
    /// Number of frames of each row.
    pub lengths: Vec<usize>,
    /// First frame of each row in its entry.
    pub starts: Vec<usize>,
    /// Number of times that an epoch draws each entry; empty for once each.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub draws: Vec<usize>,
    /// Changes to the paths of training crops, if there are any.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub augmented: Option<Augmented>,
}

/// Changed paths of crops; see [`motion::paths`].
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Augmented {
    /// The settings of the changes.
    pub augment: Augment,
    /// Seed of the draws.
    pub seed: Seed,
    /// The stage that made the draws.
    pub stage: StageName,
}

impl LatentsMeta {
    /// The feature rows `[length, D]`, not normalised, of the crop that was encoded as `row`.
    ///
    /// # Panics
    /// If `dataset` is not the one that was encoded.
    pub fn rows(&self, dataset: &Dataset, row: usize) -> Vec<f32> {
        let cut = (self.starts[row], self.lengths[row]);
        crop_rows(dataset, (row / self.crops, row % self.crops), cut, self.augmented.as_ref())
    }
}

/// The feature rows `[length, D]`, not normalised, of crop `c` of `entry`, with its first frame and length.
pub fn crop_rows(
    dataset: &Dataset,
    (entry, c): (usize, usize),
    (start, length): (usize, usize),
    augmented: Option<&Augmented>,
) -> Vec<f32> {
    let of = &dataset.entries[entry];
    let skeleton = dataset.skeleton();
    let width = skeleton.features;
    let mut rows = dataset.features(of)[start * width..(start + length) * width].to_vec();
    if let Some(by) = augmented.filter(|_| of.split == Split::Train) {
        let mut draw = Stream::new(by.seed, &format!("{}/path", by.stage), c as u64, entry as u64);
        paths::augment(&mut rows, skeleton, &by.augment, &mut draw);
    }
    rows
}

/// Meta of an artifact of kind `denoiser`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct DenoiserMeta {
    /// Family of the model, which decides its samplers.
    #[serde(flatten)]
    pub family: Family,
    /// Latent shape, equal to that of its VAE.
    pub latent: LatentShape,
    /// Size of the transformer.
    pub network: Network,
    /// Noise schedule and prediction.
    pub diffusion: Diffusion,
    /// True if a ReLU precedes the text projection (v1).
    pub text_relu: bool,
    /// Width of the guidance embedding; 0 for a teacher, which has none.
    pub guidance_dim: usize,
    /// Width of a caption embedding.
    pub text_dim: usize,
    /// The parts of its training: the VAE whose latents it generates, and the text encoder.
    pub fits: Parts,
    /// True if Linears surround the transformer. `None` means that they exist if its width differs from a latent
    /// token's.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub projection: Option<bool>,
    /// Width of the time sinusoid, if it differs from that of all published denoisers.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub time_dim: Option<usize>,
}

/// Reads a manifest's meta as `T`; `what` names the artifact in the error.
pub fn meta<T: DeserializeOwned>(manifest: &Manifest, what: &str) -> Result<T, StageError> {
    serde_json::from_value(manifest.meta.clone())
        .map_err(|e| StageError::Input(format!("{what}: this build cannot parse its manifest: {e}")))
}

/// Serialises a meta as JSON.
pub fn to_meta<T: Serialize>(meta: &T) -> serde_json::Value {
    serde_json::to_value(meta).expect("metas are plain data with string keys")
}

/// The stage's error for a failed blob.
pub fn blob_error(error: BlobError) -> StageError {
    let text = error.to_string();
    StageError::Context(match error {
        BlobError::NotFound(_) | BlobError::Corrupt { .. } | BlobError::Damaged(_) => ContextError::Damaged(text),
        BlobError::Refused(_) => ContextError::GrantEnded(text),
        BlobError::Storage(_) => ContextError::Storage(text),
        BlobError::Unfit(_) => ContextError::Refused(text),
        BlobError::Unreachable(_) | BlobError::Unavailable(_) => ContextError::Unavailable(text),
    })
}

/// The digest and manifest of the input that settings field `field` names. Refuses an artifact of another kind.
pub fn input(cx: &dyn AttemptContext, field: &str, kind: ArtifactKind) -> Result<(Digest, Manifest), StageError> {
    let digest = *cx
        .task()
        .inputs
        .get(field)
        .ok_or_else(|| StageError::Fault(format!("the stage was started without its input `{field}`")))?;
    let manifest = cx.manifest(digest)?;
    expect(&format!("`{field}`"), &manifest, kind)?;
    Ok((digest, manifest))
}

/// Refuses an artifact of another kind; `what` names it in the error.
pub fn expect(what: &str, manifest: &Manifest, kind: ArtifactKind) -> Result<(), StageError> {
    if manifest.kind == kind {
        return Ok(());
    }
    Err(StageError::Input(format!("{what} is {}; expected {}", manifest.kind.noun(), kind.noun())))
}

fn entry<'a>(manifest: &'a Manifest, name: &str) -> Result<&'a FileEntry, StageError> {
    manifest.files.get(name).ok_or_else(|| {
        let have: Vec<_> = manifest.files.keys().map(|file| format!("`{file}`")).collect();
        StageError::Input(format!("no file `{name}` in {}; it has {}", manifest.kind.noun(), have.join(", ")))
    })
}

/// Reads one file of an artifact into memory.
pub fn file(blobs: &dyn Blobs, manifest: &Manifest, name: &str) -> Result<Arc<[u8]>, StageError> {
    checkpoint::file::get(blobs, entry(manifest, name)?).map_err(blob_error)
}

/// Opens one file of an artifact for reading in pieces, for files too large to be in memory twice.
pub fn open(blobs: &dyn Blobs, manifest: &Manifest, name: &str) -> Result<Box<dyn Blob>, StageError> {
    checkpoint::file::open(blobs, entry(manifest, name)?).map_err(blob_error)
}

/// Maps one file of an artifact, which stays on disk if possible; for data that is read repeatedly.
pub fn mapped(blobs: &dyn Blobs, manifest: &Manifest, name: &str) -> Result<Bytes, StageError> {
    checkpoint::file::map(blobs, entry(manifest, name)?).map_err(blob_error)
}

/// Reads all files of an artifact into memory.
pub fn files(blobs: &dyn Blobs, manifest: &Manifest) -> Result<BTreeMap<String, Arc<[u8]>>, StageError> {
    manifest
        .files
        .iter()
        .map(|(name, entry)| Ok((name.clone(), checkpoint::file::get(blobs, entry).map_err(blob_error)?)))
        .collect()
}

/// An artifact in progress: files are uploaded one by one, so that only one is in memory at a time.
#[derive(Debug)]
pub struct Draft {
    manifest: Manifest,
    blobs: Arc<dyn Blobs>,
    chunk_bytes: u64,
}

impl Draft {
    /// Starts an artifact without files.
    pub fn new(cx: &dyn AttemptContext, kind: ArtifactKind, meta: serde_json::Value) -> Self {
        Self { manifest: Manifest::new(kind, meta), blobs: cx.blobs(), chunk_bytes: cx.chunk_bytes() }
    }

    /// Starts an artifact with the meta and the files of another one.
    pub fn again(cx: &dyn AttemptContext, manifest: &Manifest) -> Self {
        Self { manifest: manifest.clone(), ..Self::new(cx, manifest.kind, serde_json::Value::Null) }
    }

    /// Uploads one file, in place of one with this name.
    pub fn add(&mut self, name: &str, bytes: Vec<u8>) -> Result<(), StageError> {
        self.add_pieces(name, &[&bytes])
    }

    /// Uploads one file that consists of `pieces`.
    pub fn add_pieces(&mut self, name: &str, pieces: &[&[u8]]) -> Result<(), StageError> {
        let file = checkpoint::file::put(&*self.blobs, pieces, self.chunk_bytes).map_err(blob_error)?;
        self.manifest.list([(name.to_owned(), file)]);
        Ok(())
    }

    /// Returns the manifest without uploading it, for an artifact that becomes a part.
    pub fn into_manifest(self) -> Manifest {
        self.manifest
    }

    /// Adds another artifact as a part; its manifest must already be uploaded.
    pub fn part(&mut self, role: &Role, part: &Manifest) -> Digest {
        model::add_part(&mut self.manifest, role, part)
    }

    /// Uploads the manifest; its digest names the artifact.
    pub fn finish(self, cx: &mut dyn AttemptContext) -> Result<Digest, StageError> {
        Ok(cx.put_manifest(&self.manifest)?)
    }
}

/// Uploads one file and a manifest around it.
pub fn publish(
    cx: &mut dyn AttemptContext,
    kind: ArtifactKind,
    meta: serde_json::Value,
    name: &str,
    bytes: Vec<u8>,
) -> Result<Digest, StageError> {
    let mut draft = Draft::new(cx, kind, meta);
    draft.add(name, bytes)?;
    draft.finish(cx)
}

/// Reads the dataset of an artifact of kind `dataset`.
pub fn dataset(blobs: &dyn Blobs, manifest: &Manifest) -> Result<Dataset, StageError> {
    from_files(blobs, manifest, |fetch| Dataset::from_files(fetch))
}

/// Reads the input `dataset`.
pub fn input_dataset(cx: &dyn AttemptContext) -> Result<Dataset, StageError> {
    dataset(&*cx.blobs(), &input(cx, "dataset", ArtifactKind::Dataset)?.1)
}

/// Reads only the captions of a dataset.
pub fn captions(blobs: &dyn Blobs, manifest: &Manifest) -> Result<Vec<Caption>, StageError> {
    from_files(blobs, manifest, |fetch| Dataset::captions_from_files(fetch))
}

type Fetch<'a> = dyn Fn(&str) -> Result<Bytes, String> + 'a;

fn from_files<T>(
    blobs: &dyn Blobs,
    manifest: &Manifest,
    read: impl FnOnce(&Fetch<'_>) -> Result<T, PackError>,
) -> Result<T, StageError> {
    // The store's error is kept, so that a lost connection is not reported as a broken dataset.
    let refused = RefCell::new(None);
    let fetch = |name: &str| {
        mapped(blobs, manifest, name).map_err(|error| {
            let text = error.to_string();
            refused.replace(Some(error));
            text
        })
    };
    read(&fetch).map_err(|error| {
        let corrupt = || StageError::Context(ContextError::Corrupt(format!("the dataset: {error}")));
        refused.take().unwrap_or_else(corrupt)
    })
}

/// A row-major tensor in host memory.
#[derive(Debug, Clone, PartialEq)]
pub struct HostTensor<T: Pod> {
    /// Sizes of the axes.
    pub shape: Vec<usize>,
    pub values: Values<T>,
}

impl<T: Pod> HostTensor<T> {
    /// Wraps values with their shape.
    ///
    /// # Panics
    /// If the number of values does not match the shape.
    pub fn new(shape: impl Into<Vec<usize>>, values: impl Into<Values<T>>) -> Self {
        let shape = shape.into();
        let values = values.into();
        assert_eq!(shape.iter().product::<usize>(), values.len(), "values for shape {shape:?}");
        Self { shape, values }
    }

    /// Number of values in one row, that is in all axes but the first.
    pub fn row_len(&self) -> usize {
        self.shape.iter().skip(1).product()
    }

    /// Row `i`, all values at that index of the first axis.
    pub fn row(&self, i: usize) -> &[T] {
        let n = self.row_len();
        &self.values[i * n..(i + 1) * n]
    }
}

/// Named tensors to be written to or read from a safetensors file.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Tensors {
    floats: BTreeMap<String, HostTensor<f32>>,
    integers: BTreeMap<String, HostTensor<i64>>,
}

impl Tensors {
    /// Adds an f32 tensor.
    #[must_use]
    pub fn with(mut self, name: &str, shape: impl Into<Vec<usize>>, values: Vec<f32>) -> Self {
        self.floats.insert(name.to_owned(), HostTensor::new(shape, values));
        self
    }

    /// Adds an f32 tensor of rows of `width` values.
    #[must_use]
    pub fn with_rows(self, name: &str, width: usize, values: Vec<f32>) -> Self {
        self.with(name, [values.len() / width, width], values)
    }

    /// Adds an i64 tensor.
    #[must_use]
    pub fn with_integers(mut self, name: &str, shape: impl Into<Vec<usize>>, values: Vec<i64>) -> Self {
        self.integers.insert(name.to_owned(), HostTensor::new(shape, values));
        self
    }

    /// Serialises a safetensors file; the same tensors always give the same bytes.
    pub fn to_bytes(&self) -> Result<Vec<u8>, StageError> {
        let mut raw: BTreeMap<&str, (Dtype, &[usize], Vec<u8>)> = BTreeMap::new();
        for (name, tensor) in &self.floats {
            let bytes = tensor.values.iter().flat_map(|v| v.to_le_bytes()).collect();
            raw.insert(name, (Dtype::F32, &tensor.shape, bytes));
        }
        for (name, tensor) in &self.integers {
            let bytes = tensor.values.iter().flat_map(|v| v.to_le_bytes()).collect();
            raw.insert(name, (Dtype::I64, &tensor.shape, bytes));
        }
        let fault = |e: safetensors::SafeTensorError| StageError::Fault(format!("writing tensors: {e}"));
        let views: Vec<_> = raw
            .iter()
            .map(|(name, (dtype, shape, bytes))| Ok((*name, TensorView::new(*dtype, shape.to_vec(), bytes)?)))
            .collect::<Result<_, _>>()
            .map_err(fault)?;
        safetensors::serialize(views, None::<HashMap<String, String>>).map_err(fault)
    }

    /// Reads a safetensors file of f32 and i64 tensors without copying their values; `what` names it in errors.
    pub fn from_bytes(bytes: Bytes, what: &str) -> Result<Self, StageError> {
        let bad = |text: String| StageError::Context(ContextError::Corrupt(format!("{what}: {text}")));
        let parsed = SafeTensors::deserialize(&bytes).map_err(|e| bad(e.to_string()))?;
        let mut out = Self::default();
        for (name, view) in parsed.iter() {
            let shape = view.shape().to_vec();
            let name = name.to_owned();
            match view.dtype() {
                Dtype::F32 => {
                    let values = Values::view(bytes.slice_ref(view.data())).unwrap_or_else(|| Vec::new().into());
                    out.floats.insert(name, HostTensor::new(shape, values));
                }
                Dtype::I64 => {
                    let values = Values::view(bytes.slice_ref(view.data())).unwrap_or_else(|| Vec::new().into());
                    out.integers.insert(name, HostTensor::new(shape, values));
                }
                other => return Err(bad(format!("tensor `{name}` is {other:?}, expected F32 or I64"))),
            }
        }
        Ok(out)
    }

    /// Takes the f32 tensor `name`, which must have `rank` axes.
    pub fn take(&mut self, name: &str, rank: usize, what: &str) -> Result<HostTensor<f32>, StageError> {
        Self::checked(self.floats.remove(name), name, rank, what, self.floats.keys())
    }

    /// Takes the i64 tensor `name`, which must have `rank` axes.
    pub fn take_integers(&mut self, name: &str, rank: usize, what: &str) -> Result<HostTensor<i64>, StageError> {
        Self::checked(self.integers.remove(name), name, rank, what, self.integers.keys())
    }

    fn checked<'a, T: Pod>(
        found: Option<HostTensor<T>>,
        name: &str,
        rank: usize,
        what: &str,
        others: impl Iterator<Item = &'a String>,
    ) -> Result<HostTensor<T>, StageError> {
        let bad = |text: String| StageError::Context(ContextError::Corrupt(format!("{what}: {text}")));
        let tensor =
            found.ok_or_else(|| bad(format!("no tensor `{name}`; the file has {:?}", others.collect::<Vec<_>>())))?;
        if tensor.shape.len() != rank {
            return Err(bad(format!("tensor `{name}` has shape {:?}, expected {rank} axes", tensor.shape)));
        }
        Ok(tensor)
    }
}

/// Caption embeddings with their meta.
#[derive(Debug, Clone)]
pub struct Embeddings {
    /// Meta of the artifact.
    pub meta: EmbeddingsMeta,
    /// Embeddings of shape `[captions, dim]`.
    pub captions: HostTensor<f32>,
    /// Embedding of the empty caption, `[dim]`.
    pub null: Vec<f32>,
}

impl Embeddings {
    /// Reads an artifact of kind `embeddings`.
    pub fn read(blobs: &dyn Blobs, manifest: &Manifest) -> Result<Self, StageError> {
        let meta: EmbeddingsMeta = meta(manifest, "the caption embeddings")?;
        let mut tensors = Tensors::from_bytes(mapped(blobs, manifest, EMBEDDINGS_FILE)?, EMBEDDINGS_FILE)?;
        let captions = tensors.take("captions", 2, EMBEDDINGS_FILE)?;
        let null = tensors.take("null", 1, EMBEDDINGS_FILE)?.values.into_vec();
        if captions.shape != [meta.captions, meta.dim] || null.len() != meta.dim {
            return Err(StageError::Context(ContextError::Corrupt(format!(
                "{EMBEDDINGS_FILE}: `captions` has shape {:?} and `null` has {} numbers; the manifest declares {} x {}",
                captions.shape,
                null.len(),
                meta.captions,
                meta.dim
            ))));
        }
        Ok(Self { meta, captions, null })
    }
}

/// VAE posteriors with their meta.
#[derive(Debug, Clone)]
pub struct Latents {
    /// Meta of the artifact.
    pub meta: LatentsMeta,
    /// Posterior means, `[rows, N, d]`.
    pub mu: HostTensor<f32>,
    /// Posterior standard deviations, `[rows, N, d]`.
    pub sigma: HostTensor<f32>,
}

impl Latents {
    /// Reads an artifact of kind `latents`.
    pub fn read(blobs: &dyn Blobs, manifest: &Manifest) -> Result<Self, StageError> {
        let meta: LatentsMeta = meta(manifest, "the latents")?;
        let mut tensors = Tensors::from_bytes(mapped(blobs, manifest, LATENTS_FILE)?, LATENTS_FILE)?;
        let mu = tensors.take("mu", 3, LATENTS_FILE)?;
        let sigma = tensors.take("sigma", 3, LATENTS_FILE)?;
        let expected = [meta.splits.len() * meta.crops, meta.latent.tokens, meta.latent.dim];
        if mu.shape != expected || sigma.shape != expected {
            return Err(StageError::Context(ContextError::Corrupt(format!(
                "{LATENTS_FILE}: `mu` has shape {:?} and `sigma` has shape {:?}; the manifest declares {expected:?}",
                mu.shape, sigma.shape
            ))));
        }
        Ok(Self { meta, mu, sigma })
    }

    /// Number of dataset entries.
    pub fn entries(&self) -> usize {
        self.meta.splits.len()
    }
}

/// The name of a setting's value, such as `humanml3d` or `test`.
pub(crate) fn word(setting: &impl serde::Serialize) -> String {
    serde_json::to_value(setting).ok().and_then(|value| Some(value.as_str()?.to_owned())).unwrap_or_default()
}

#[cfg(test)]
mod tests {
    use protocol::stage::DataSynthetic;

    use super::*;

    #[test]
    fn tensors_survive_their_bytes() {
        let tensors = Tensors::default()
            .with("b", [2, 3], vec![1.0, -2.5, 3.0, 0.1, f32::MIN_POSITIVE, 6.0])
            .with("a", [0, 3], vec![])
            .with_integers("entry", [2], vec![-1, i64::MAX]);
        let bytes = tensors.to_bytes().unwrap();
        assert_eq!(bytes, tensors.to_bytes().unwrap());
        assert_eq!(Tensors::from_bytes(bytes.into(), "x").unwrap(), tensors);
    }

    #[test]
    fn a_missing_tensor_is_named_with_those_there_are() {
        let error = Tensors::default().with("b", [1], vec![0.0]).take("mu", 1, "latents.safetensors").unwrap_err();
        assert_eq!(error.to_string(), "latents.safetensors: no tensor `mu`; the file has [\"b\"]");
        assert!(Tensors::from_bytes(Bytes::from_static(&[1, 2, 3]), "x").is_err());
    }

    #[test]
    fn crops_of_the_training_split_follow_other_paths_and_each_its_own() {
        let settings = DataSynthetic { clips: 30, ..DataSynthetic::default() };
        let dataset = motion::synthetic::generate(&settings, Seed(2));
        let augment = Augment { bend: 0.5, stretch: 0.2 };
        let by = Augmented { augment, seed: Seed(3), stage: "latents".into() };
        let path = |entry: usize, c: usize, by: Option<&Augmented>| -> Vec<f32> {
            crop_rows(&dataset, (entry, c), (0, 40), by).chunks_exact(263).flat_map(|row| row[..3].to_vec()).collect()
        };
        let mut changed = 0;
        for (entry, of) in dataset.entries.iter().enumerate() {
            let recorded = path(entry, 0, None);
            assert_eq!(path(entry, 0, Some(&by)), path(entry, 0, Some(&by)));
            if of.split == Split::Train {
                changed += usize::from(path(entry, 0, Some(&by)) != recorded);
                assert!(path(entry, 0, Some(&by)) != path(entry, 1, Some(&by)), "{}", of.id);
            } else {
                assert_eq!(path(entry, 0, Some(&by)), recorded, "{}", of.id);
            }
        }
        assert_eq!(changed, dataset.entries_of(protocol::stage::Split::Train).len());
    }

    #[test]
    fn a_denoiser_meta_survives_json() {
        let meta = DenoiserMeta {
            family: Family::Pcm { skip: 100, guidance: (0.5, 5.0), phases: 4 },
            latent: LatentShape::default(),
            network: Network::default(),
            diffusion: Diffusion::default(),
            text_relu: false,
            guidance_dim: 256,
            text_dim: 768,
            fits: Parts::from([(Role::VAE, Digest::of(b"vae"))]),
            projection: None,
            time_dim: None,
        };
        let json = to_meta(&meta);
        assert_eq!(json["family"], "pcm");
        assert_eq!(serde_json::from_value::<DenoiserMeta>(json).unwrap(), meta);
    }
}
