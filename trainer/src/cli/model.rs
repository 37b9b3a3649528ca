//! Models to generate from: a registered version, or the output of a run's stage.

use std::collections::BTreeMap;
use std::fmt;
use std::sync::{Arc, Mutex, PoisonError};

use burn::tensor::Device;
use checkpoint::model::{Drawn, Model};
use checkpoint::{BlobError, Blobs};
use models::device::DeviceInfo;
use motion::Dataset;
use protocol::artifact::Chunk;
use protocol::message::RunView;
use protocol::stage::Sampler;
use protocol::{ArtifactKind, Digest, Manifest};
use registry::cli::{Command, Data};
use stages::context::StageError;
use stages::evaluation::REPORT_FILE;

use crate::reader::Reader;
use crate::report::problem::{Problem, Result, exit};

/// A model with its files.
#[derive(Debug)]
pub(super) struct Found {
    pub(super) manifest: Manifest,
    pub(super) blobs: Fetched,
    pub(super) label: Label,
    /// The model's manifest. If the model was trained here, the store has its lineage.
    pub(super) artifact: Digest,
    /// Captions with the words of its training, if the model came with some, as that of `trainer demo` does.
    pub(super) captions: Vec<String>,
    /// Evaluations of a stage's model and their samplers. A version has its own sampler.
    pub(super) measured: Vec<(String, Sampler)>,
}

/// Name of a model for messages.
#[derive(Debug)]
pub(super) enum Label {
    /// Name and version in the registry.
    Version(String, u64),
    /// Run and stage.
    Stage(String, String),
}

impl fmt::Display for Label {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Version(name, version) => write!(f, "{name} (version {version})"),
            Self::Stage(run, stage) => write!(f, "{stage} of {run}"),
        }
    }
}

/// A model's blobs, fetched once and verified.
#[derive(Debug, Default)]
pub(super) struct Fetched(Mutex<BTreeMap<Digest, Arc<[u8]>>>);

impl Blobs for Fetched {
    fn get(&self, digest: Digest) -> std::result::Result<Arc<[u8]>, BlobError> {
        let blobs = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        blobs.get(&digest).cloned().ok_or(BlobError::NotFound(digest))
    }

    fn put(&self, _: Vec<u8>) -> std::result::Result<Digest, BlobError> {
        Err(BlobError::Refused("a model is only read here".into()))
    }
}

impl Fetched {
    /// Adds the blobs of `other`.
    pub(super) fn add(&self, other: Self) {
        let others = other.0.into_inner().unwrap_or_else(PoisonError::into_inner);
        self.0.lock().unwrap_or_else(PoisonError::into_inner).extend(others);
    }

    /// Fetches the files of a manifest.
    async fn files(reader: &Reader, manifest: &Manifest) -> Result<Self> {
        let blobs = Self::default();
        for Chunk { digest, .. } in manifest.blobs() {
            let bytes = verified(reader, digest).await?;
            blobs.0.lock().unwrap_or_else(PoisonError::into_inner).insert(digest, bytes.into());
        }
        Ok(blobs)
    }
}

pub(super) async fn verified(reader: &Reader, name: Digest) -> Result<Vec<u8>> {
    let bytes = reader.blob(name).await?;
    let found = Digest::of(&bytes);
    if found != name {
        return Err(Problem::failed(BlobError::Corrupt { expected: name, found })
            .hint("`trainer registry fsck` checks the store"));
    }
    Ok(bytes)
}

/// Finds a version in the registry: MODEL@ALIAS, MODEL@best or MODEL:VERSION.
pub(super) async fn version(reader: &Reader, name: &str) -> Result<Found> {
    let answer = reader.registry(&Command::Show { reference: name.to_owned() }).await?;
    if let Some(error) = answer.error {
        let mut problem = Problem::new(answer.exit, anyhow::anyhow!("{}", error.message));
        problem.hint = error.hint;
        return Err(problem);
    }
    let (version, manifest) = match answer.data {
        Some(Data::Version { version, manifest, .. }) => (version, manifest),
        Some(Data::Model { model, .. }) => {
            let aliases: Vec<String> = model.aliases.keys().map(|alias| format!("{name}@{alias}")).collect();
            let problem =
                Problem::usage(format!("`{name}` is a model with {} versions; name one version", model.versions));
            return Err(problem.hint(format!("for example {name}@best {}", aliases.join(" "))));
        }
        _ => {
            return Err(Problem::new(exit::FAULT, anyhow::anyhow!("the registry's answer is not a model")));
        }
    };
    let blobs = Fetched::files(reader, &manifest).await?;
    let (artifact, label) = (version.artifact, Label::Version(name.to_owned(), version.version));
    let captions = &version.source["imported"]["source"][CAPTIONS];
    let captions = serde_json::from_value(captions.clone()).unwrap_or_default();
    Ok(Found { manifest, blobs, label, artifact, captions, measured: Vec::new() })
}

/// Finds the model of a stage of `run`, and the samplers of the run's evaluations of it.
pub(super) async fn stage(reader: &Reader, run: &RunView, name: &str) -> Result<Found> {
    let model = run.stages.iter().find(|stage| stage.name.as_str() == name).map(|stage| stage.outputs.get(MODEL));
    let Some(Some(model)) = model else {
        let have = stages(run);
        let why = if model.is_none() { "has no stage" } else { "has no model yet from stage" };
        let problem = Problem::new(exit::NOT_FOUND, anyhow::anyhow!("run `{}` {why} `{name}`", run.run));
        return Err(problem.hint(match have.as_slice() {
            [] => {
                "no stage of the run has a model yet; `trainer status --all` lists runs, --run selects one".to_owned()
            }
            have => format!("stages with a model: {}; --run selects another run", have.join(", ")),
        }));
    };
    let manifest = manifest(reader, *model).await?;
    let mut measured = Vec::new();
    if Model::read(&manifest).map_err(Problem::failed)?.sampler.is_none() {
        for stage in run.stages.iter().filter(|stage| stage.of.is_none()) {
            let Some(report) = stage.outputs.get(REPORT) else { continue };
            let report = self::manifest(reader, *report).await?;
            let drawn: Option<Drawn> = serde_json::from_value(report.meta["drawn"].clone()).ok();
            measured.extend(drawn.filter(|drawn| drawn.model == *model).map(|d| (stage.name.to_string(), d.sampler)));
        }
    }
    let blobs = Fetched::files(reader, &manifest).await?;
    let label = Label::Stage(run.run.to_string(), name.to_owned());
    Ok(Found { manifest, blobs, label, artifact: *model, captions: Vec::new(), measured })
}

/// Stages of a run that have a model so far, without the trials of sweeps.
pub(super) fn stages(run: &RunView) -> Vec<&str> {
    let have = run.stages.iter().filter(|stage| stage.of.is_none() && stage.outputs.contains_key(MODEL));
    have.map(|stage| stage.name.as_str()).collect()
}

/// Reads the report of an evaluation.
pub(super) async fn report(reader: &Reader, digest: Digest) -> Result<serde_json::Value> {
    let manifest = manifest(reader, digest).await?;
    let file = manifest.files.get(REPORT_FILE).ok_or_else(|| Problem::failed(format!("{digest} is not a report")))?;
    let bytes = verified(reader, file.digest).await?;
    serde_json::from_slice(&bytes)
        .map_err(|error| Problem::failed(format!("cannot parse the report {digest}: {error}")))
}

pub(super) async fn manifest(reader: &Reader, digest: Digest) -> Result<Manifest> {
    let manifest: Manifest = serde_json::from_slice(&verified(reader, digest).await?)
        .map_err(|error| Problem::failed(format!("cannot parse the manifest {digest}: {error}")))?;
    if !manifest.is_readable() {
        let (found, known) = (manifest.format, Manifest::FORMAT);
        return Err(Problem::failed(format!("the manifest {digest} has format {found}; this build reads {known}")));
    }
    Ok(manifest)
}

/// The sentences of a dataset's training entries; `None` if its index is too long to read for a hint.
///
/// # Errors
/// If the store does not answer, or the artifact is no dataset.
pub(super) async fn training_captions(reader: &Reader, dataset: Digest) -> Result<Option<Vec<String>>> {
    let manifest = manifest(reader, dataset).await?;
    let index =
        manifest.files.get(INDEX).filter(|file| manifest.kind == ArtifactKind::Dataset && file.bytes <= LONGEST_INDEX);
    let Some(index) = index else { return Ok(None) };
    let bytes = bytes::Bytes::from(verified(reader, index.digest).await?);
    let captions = Dataset::training_captions_from_files(&|_| Ok(bytes.clone())).map_err(Problem::failed)?;
    Ok(Some(captions.into_iter().map(|caption| caption.text).collect()))
}

/// The clips that a run learns from; `None` if it has none yet, or too many to fetch for a picture.
///
/// # Errors
/// If the store does not answer, or the artifact is no dataset.
pub(super) async fn dataset(reader: &Reader, run: &RunView) -> Result<Option<Dataset>> {
    let Some(digest) = run.stages.iter().find_map(|stage| stage.outputs.get(DATASET)) else { return Ok(None) };
    let manifest = manifest(reader, *digest).await?;
    let bytes: u64 = manifest.files.values().map(|file| file.bytes).sum();
    if manifest.kind != ArtifactKind::Dataset || bytes > LARGEST_DATASET {
        return Ok(None);
    }
    let blobs = Fetched::files(reader, &manifest).await?;
    let fetch = |name: &str| {
        let file = manifest.files.get(name).ok_or_else(|| format!("the dataset has no file `{name}`"))?;
        checkpoint::file::map(&blobs, file).map_err(|error| error.to_string())
    };
    Dataset::from_files(&fetch).map(Some).map_err(Problem::failed)
}

/// The file of a dataset with its captions, and its largest size to read.
const INDEX: &str = "dataset.json";
const LONGEST_INDEX: u64 = 64 << 20;
/// The output of stages that produce a dataset, and its largest size to fetch for pictures.
const DATASET: &str = "dataset";
const LARGEST_DATASET: u64 = 256 << 20;
/// The key of captions in the description of a model.
pub(super) const CAPTIONS: &str = "captions";
/// The output of stages that produce a model.
const MODEL: &str = "model";
/// The output of evaluations.
const REPORT: &str = "report";

/// Opens the first device of a backend.
pub(super) fn device(backend: Option<&str>) -> Result<(Device, DeviceInfo)> {
    let all = models::device::available();
    let names: Vec<&str> = all.iter().map(|device| device.backend.name()).collect();
    let none =
        || Problem::usage(format!("`--backend {}`: expected one of {}", backend.unwrap_or_default(), names.join(", ")));
    let found = all.iter().find(|device| match backend {
        None => device.index.is_some(),
        Some(name) => device.backend.name() == name,
    });
    let found = found.ok_or_else(none)?;
    let device = models::device::open(found.backend, 0).map_err(|error| Problem::new(exit::USAGE, error))?;
    Ok((device, found.clone()))
}

/// Reports a sampler or a length that the model does not support as wrong usage.
pub(super) fn refused(error: StageError) -> Problem {
    let exit = if matches!(error, StageError::Input(_)) { exit::USAGE } else { exit::FAILED };
    Problem::new(exit, error)
}
