//! A pipeline as data: its stages, the edges between them, and the identity of each.

use std::collections::BTreeMap;

use protocol::stage::{Backend, ExternalFolder, Placement, StageIdentity, StageSettings, Target, VersionInput};
use protocol::sweep::{Derived, Sweep};
use protocol::{ArtifactKind, Digest, Seed, StageName};
use serde::{Deserialize, Serialize};

/// An immutable DAG of stages, in an order in which each stage comes after its inputs.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Pipeline {
    /// Name for display and for run names: a letter or digit, then letters, digits, `.`, `_`, `-`.
    pub name: String,
    /// Seed that keys all randomness.
    pub seed: Seed,
    /// Backend that computes.
    pub backend: Backend,
    /// Order among the runs of a group: work of a higher priority comes first. Part of no key.
    #[serde(default, skip_serializing_if = "is_default")]
    pub priority: i32,
    /// Stages in topological order.
    pub stages: Vec<PipelineStage>,
    /// Code versions of its kinds when it was read, those above 1. They are stored so that a run that continues under a
    /// later program keeps its keys.
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    pub code_versions: BTreeMap<String, u32>,
}

/// A node of a pipeline.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct PipelineStage {
    /// Name, unique in the pipeline.
    pub name: StageName,
    /// Kind and settings of the stage.
    pub settings: StageSettings,
    /// Number of workers and cadence of checkpoints; not part of its key.
    pub placement: Placement,
    /// Stages that it reads.
    pub inputs: Vec<StageInput>,
    /// Digests of its inputs from outside the pipeline, by field: the contents of folders outside the store, and
    /// versions of the registry. They are resolved when the pipeline is submitted and stay fixed.
    pub external: BTreeMap<String, Digest>,
    /// Search over its settings, if there is one.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub sweep: Option<Sweep>,
    /// Origin of a stage that a sweep made during the run; never present in a submitted pipeline.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub derived: Option<Derived>,
    /// The stage of the file that this one is a copy of, if the file wants several.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub copy_of: Option<StageName>,
}

/// An edge of the DAG.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct StageInput {
    /// Field that names the stage, such as `vae` or `from[0]`. A `register` stage also reads the evaluations of its
    /// candidates; their fields are `evaluations.<stage>`.
    pub field: String,
    /// Stage that is read.
    pub stage: StageName,
    /// Kind of artifact that it must output.
    pub kind: ArtifactKind,
}

impl Pipeline {
    /// Finds the stage with this name.
    pub fn stage(&self, name: &StageName) -> Option<&PipelineStage> {
        self.stages.iter().find(|stage| &stage.name == name)
    }

    /// Stages that a user means by `name`: the stage with this name, or the copies of that stage of the file.
    pub fn named(&self, name: &StageName) -> impl Iterator<Item = &PipelineStage> {
        self.stages.iter().filter(move |stage| &stage.name == name || stage.copy_of.as_ref() == Some(name))
    }

    /// Digest that names the pipeline. It covers everything except the priority, and paths of folders outside the
    /// store, whose contents count.
    pub fn digest(&self) -> Digest {
        let mut pipeline = Self { priority: 0, ..self.clone() };
        for stage in &mut pipeline.stages {
            let folders = stage.settings.refs().into_iter().filter(|found| !matches!(found.target, Target::Stage(_)));
            folders.for_each(|folder| folder.name.clear());
        }
        protocol::canonical::digest(&pipeline)
    }

    /// Calls `digest` for the content of every folder outside the store that a stage reads, and stores the results by
    /// field.
    ///
    /// # Errors
    /// The first error of `digest`.
    pub fn fill_external<E>(
        &mut self,
        mut digest: impl FnMut(&StageName, &ExternalFolder) -> Result<Digest, E>,
    ) -> Result<(), E> {
        for stage in &mut self.stages {
            for folder in stage.settings.folders() {
                let content = digest(&stage.name, &folder)?;
                stage.external.insert(folder.field, content);
            }
        }
        Ok(())
    }

    /// Identity of `stage`, once its input artifacts are known: everything that its value depends on. `inputs` are
    /// artifacts by field; inputs from outside are added.
    pub fn identity(&self, stage: &PipelineStage, inputs: &BTreeMap<String, Digest>) -> StageIdentity {
        let mut all = stage.external.clone();
        all.extend(inputs.iter().map(|(field, digest)| (field.clone(), *digest)));
        StageIdentity {
            settings: stage.settings.without_references(),
            code_version: self.code_versions.get(stage.settings.kind()).copied().unwrap_or(FIRST_VERSION),
            inputs: all,
            seed: self.seed,
            name: keyed_as(stage).clone(),
            backend: self.backend,
        }
    }

    /// Records the code versions of its kinds, including the kinds that evaluate trials.
    pub fn note_code_versions(&mut self) {
        let evaluations = self.stages.iter().filter_map(|stage| stage.sweep.as_ref()).map(|sweep| &*sweep.evaluate);
        let kinds = self.stages.iter().map(|stage| &stage.settings).chain(evaluations);
        let beyond = kinds.filter(|settings| settings.code_version() > FIRST_VERSION);
        self.code_versions = beyond.map(|settings| (settings.kind().to_owned(), settings.code_version())).collect();
    }
}

/// Prefix of the fields of a sweep's evaluation among those of its stage.
pub(crate) const IN_EVALUATION: &str = "sweep.evaluate.";

impl PipelineStage {
    /// Versions of the registry that it reads, including those of a sweep's evaluation.
    pub fn versions(&self) -> Vec<VersionInput> {
        let mut all = self.settings.versions();
        let evaluation = self.sweep.iter().flat_map(|sweep| sweep.evaluate.versions());
        all.extend(evaluation.map(|input| VersionInput { field: format!("{IN_EVALUATION}{}", input.field), ..input }));
        all
    }

    /// Digests of [`external`](Self::external) for its settings or for its sweep's evaluation, by field.
    pub(crate) fn external_of(&self, evaluation: bool) -> BTreeMap<String, Digest> {
        let own = |(field, digest): (&String, &Digest)| match (field.strip_prefix(IN_EVALUATION), evaluation) {
            (Some(field), true) => Some((field.to_owned(), *digest)),
            (None, false) => Some((field.clone(), *digest)),
            _ => None,
        };
        self.external.iter().filter_map(own).collect()
    }
}

fn is_default(priority: &i32) -> bool {
    *priority == 0
}

/// Code version of every kind that has not changed yet.
const FIRST_VERSION: u32 = 1;

/// Name that keys a stage's randomness.
pub fn keyed_as(stage: &PipelineStage) -> &StageName {
    stage.derived.as_ref().map_or(&stage.name, |derived| &derived.keyed_as)
}
