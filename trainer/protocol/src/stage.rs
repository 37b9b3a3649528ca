//! The settings of each stage kind: plain structs whose `Default` is the published recipe, if there is one.
//!
//! A kind is one file in `kinds/` and one line of the list there; [`StageSpec`] is its description.
//!
//! A settings struct is also the schema. The pipeline reader derives the closed set of keys and their types from the
//! serialised default, so a field is declared once. Fields that cannot change a stage's value (worker counts,
//! checkpoint cadence) are in [`Placement`] and not part of the stage's key.
//!
//! A store outlives the build that wrote it. Every struct with a `Default` fills in values that an older build did not
//! write. A new field of a struct without one ([`Training`], [`Batch`]) needs `#[serde(default)]`.

mod augment;
mod control;
mod data;
mod diffusion;
mod distillation;
mod evaluation;
mod flow;
mod frequency;
mod identity;
mod kinds;
mod neighbours;
mod network;
mod placement;
mod problems;
mod sampler;
mod spec;
mod training;

use std::collections::{BTreeMap, BTreeSet};

use crate::model_ref::names_version;
use crate::{ArtifactKind, Digest, Steps};

pub use augment::Augment;
pub use control::{ControlHints, ControlSetting};
pub use data::DataFormat;
pub use diffusion::{Diffusion, NoiseSchedule, Prediction};
pub use distillation::{Distance, Distillation};
pub use evaluation::{Mode, PHYSICS, Split};
pub use flow::FlowSolver;
pub use frequency::{Band, FrequencyLosses, LowFrequency, Norm, Over, Semantic};
pub use identity::{Backend, StageIdentity};
pub use kinds::*;
pub use neighbours::{Neighbour, Neighbours};
pub use network::{LatentShape, Network, Positions};
pub use placement::{CheckpointPolicy, Keep, Placement, WorkerRange};
pub use problems::{Problem, Problems};
pub use sampler::{Family, Sampler, Solver, measured_with};
pub use spec::{LossChange, Output, Ref, Shape, StageSpec, Target};
pub use training::{Batch, Decay, Optimizer, Replicas, Training};

/// A folder or file outside the store that a stage reads.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct ExternalFolder {
    /// Field that names it.
    pub field: String,
    /// Path of the folder or file.
    pub path: String,
    /// Dataset format that selects the files that count; `None` counts all files.
    pub format: Option<DataFormat>,
    /// Files that it must have; `|` separates alternatives.
    pub files: &'static [&'static str],
    /// Description of the folder, and its source.
    pub origin: &'static str,
}

/// A version of the registry as an input in place of a stage.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct VersionInput {
    /// Field that names it, such as `init` or `teacher`.
    pub field: String,
    /// Version as written, such as `motionlcm@prod`.
    pub version: String,
    /// Kind of the artifact that is read: the whole model, or its part of this kind.
    pub kind: ArtifactKind,
    /// Part that the model must have, if the whole model is read for it.
    pub part: Option<ArtifactKind>,
}

/// Properties of every kind, from the kind's [`StageSpec`].
impl StageSettings {
    /// Name in YAML, such as `train.vae`.
    pub fn kind(&self) -> &'static str {
        self.spec().kind()
    }

    /// Returns the settings of kind `S`, if these are of that kind.
    pub fn get<S: StageSpec>(&self) -> Option<&S> {
        (self.spec() as &dyn std::any::Any).downcast_ref()
    }

    /// The kind's [`StageSpec::VERSION`].
    pub fn code_version(&self) -> u32 {
        self.spec().version()
    }

    /// Code versions of all kinds of this build, those above 1.
    pub fn code_versions() -> BTreeMap<String, u32> {
        let all = Self::all().into_iter().map(|settings| (settings.kind().to_owned(), settings.code_version()));
        all.filter(|(_, version)| *version > 1).collect()
    }

    /// Distribution of its work over workers.
    pub fn shape(&self) -> Shape {
        self.spec().shape()
    }

    /// Kind and name of its only output.
    pub fn output(&self) -> Output {
        self.spec().output()
    }

    /// Number of shards of a map stage, 1 otherwise.
    pub fn shards(&self) -> u32 {
        u32::try_from(self.spec().shards().max(1)).unwrap_or(u32::MAX)
    }

    /// Number of optimizer updates of a training stage.
    pub fn steps(&self) -> Option<Steps> {
        self.training().map(|training| training.steps)
    }

    /// Common settings of a training stage; `None` for kinds that cannot be swept.
    pub fn training(&self) -> Option<Training> {
        self.clone().spec_mut().training().cloned()
    }

    /// Like [`training`](Self::training), mutable.
    pub fn training_mut(&mut self) -> Option<&mut Training> {
        self.spec_mut().training()
    }

    /// References of the settings, with the places that hold the names.
    pub fn refs(&mut self) -> Vec<Ref<'_>> {
        self.spec_mut().refs()
    }

    /// The settings as part of a stage's key: references to other stages and paths are blank, because the key has the
    /// digests of their artifacts.
    #[must_use]
    pub fn without_references(&self) -> Self {
        let mut settings = self.clone();
        settings.refs().into_iter().for_each(|reference| reference.name.clear());
        settings
    }

    /// Digest of everything that decides a value, without references.
    pub fn digest(&self) -> Digest {
        crate::canonical::digest(&self.without_references())
    }

    /// Stages that it reads, and versions of the registry in their place: field name, stage name, kind that the stage
    /// must output. `register` reads more (the evaluations of its candidates), which the pipeline adds.
    pub fn inputs(&self) -> Vec<(String, String, ArtifactKind)> {
        let mut settings = self.clone();
        let read = settings.refs().into_iter().filter(|reference| reference.read);
        read.filter_map(|Ref { field, name, target, .. }| match target {
            Target::Stage(kind) => Some((field.into_owned(), name.clone(), kind)),
            Target::Dataset(_) | Target::Folder | Target::File => None,
        })
        .collect()
    }

    /// Versions of the registry among its [`inputs`](Self::inputs).
    pub fn versions(&self) -> Vec<VersionInput> {
        let mut settings = self.clone();
        let read = settings.refs().into_iter().filter(|reference| reference.read && names_version(reference.name));
        read.filter_map(|Ref { field, name, target, part, .. }| match target {
            Target::Stage(kind) => Some(VersionInput { field: field.into_owned(), version: name.clone(), kind, part }),
            Target::Dataset(_) | Target::Folder | Target::File => None,
        })
        .collect()
    }

    /// The settings for the reader of pipelines and the reference of keys. They include references that are not
    /// serialised while empty; those are left out so that they do not change the keys of older stages.
    pub fn example(&self) -> serde_json::Value {
        let mut json = serde_json::to_value(self).expect("settings are JSON");
        for reference in self.clone().refs() {
            if let Some(json) = json.as_object_mut()
                && !reference.field.contains(['.', '['])
                && !json.contains_key(&*reference.field)
            {
                json.insert(reference.field.into_owned(), "".into());
            }
        }
        json
    }

    /// Folders outside the store that it reads. Their contents are part of its key, not their paths.
    pub fn folders(&self) -> Vec<ExternalFolder> {
        let mut settings = self.clone();
        let read = settings.refs().into_iter().filter(|reference| reference.read);
        read.filter_map(|Ref { field, name, target, files, origin, .. }| {
            let format = match target {
                Target::Stage(_) => return None,
                Target::Dataset(format) => Some(format),
                Target::Folder | Target::File => None,
            };
            Some(ExternalFolder { field: field.into_owned(), path: name.clone(), format, files, origin })
        })
        .collect()
    }

    /// Stage that an evaluation measures.
    pub fn evaluated_model(&self) -> Option<String> {
        let mut settings = self.clone();
        settings.refs().into_iter().find(|reference| reference.measured).map(|reference| reference.name.clone())
    }

    /// Sampler of an evaluation for the measured model.
    pub fn sampler(&self) -> Option<&Sampler> {
        self.spec().sampler()
    }

    /// Returns the family of the model that a training gives.
    pub fn family(&self) -> Option<Family> {
        self.spec().family()
    }

    /// Names of the values that an evaluation may return; `None` if unknown.
    pub fn metrics(&self) -> Option<BTreeSet<String>> {
        self.spec().metrics()
    }

    /// Names of the values that a training saves with its checkpoints; empty if unknown.
    pub fn recorded(&self) -> Vec<&'static str> {
        let own = self.spec().recorded();
        if own.is_empty() { Vec::new() } else { own.iter().copied().chain(["gradient_norm", "lr"]).collect() }
    }

    /// Steps at which a training's loss becomes another sum, in order.
    pub fn loss_changes(&self) -> Vec<LossChange> {
        let mut changes = self.spec().loss_changes();
        changes.sort_by_key(|change| change.at);
        changes
    }

    /// Schema of the kind's keys.
    pub fn schema(&self, generator: &mut schemars::SchemaGenerator) -> schemars::Schema {
        self.spec().schema(generator)
    }

    pub fn check(&self, problems: &mut Problems) {
        self.spec().check(problems);
    }

    pub fn check_neighbours(&self, stages: &Neighbours<'_>, problems: &mut Problems) {
        self.spec().check_neighbours(stages, problems);
    }
}

impl Neighbour for StageSettings {
    fn kind(&self) -> &'static str {
        self.kind()
    }

    fn inputs(&self) -> Vec<(String, String, ArtifactKind)> {
        self.inputs()
    }

    fn evaluated_model(&self) -> Option<String> {
        self.evaluated_model()
    }

    fn sampler(&self) -> Option<&Sampler> {
        self.sampler()
    }

    fn family(&self) -> Option<Family> {
        self.spec().family()
    }

    fn metrics(&self) -> Option<BTreeSet<String>> {
        self.spec().metrics()
    }

    fn format(&self) -> Option<DataFormat> {
        self.spec().format()
    }

    fn latent(&self) -> Option<LatentShape> {
        self.spec().latent()
    }

    fn settings(&self) -> &dyn std::any::Any {
        self.spec()
    }
}
