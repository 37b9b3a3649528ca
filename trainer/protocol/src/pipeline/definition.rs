//! A pipeline as data: its stages, the edges between them, and what identifies each.

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};

use crate::stage::{Backend, ExternalFolder, Placement, StageIdentity, StageSettings, Target, VersionInput};
use crate::sweep::{Derived, Sweep};
use crate::{ArtifactKind, Digest, Seed, StageName};

/// An immutable DAG of stages, in an order in which each stage comes after those it reads.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Pipeline {
    /// For people and for run names: a letter or digit, then letters, digits, `.`, `_`, `-`.
    pub name: String,
    /// What all randomness is keyed by.
    pub seed: Seed,
    /// Where tensors live.
    pub backend: Backend,
    /// Stages in topological order.
    pub stages: Vec<PipelineStage>,
    /// Code versions of its kinds at the time it was read, those beyond 1. They stand here so that a run that goes on under a later
    /// program keeps the keys that it has.
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    pub code_versions: BTreeMap<String, u32>,
}

/// A node of a pipeline.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct PipelineStage {
    /// Its name, unique in the pipeline.
    pub name: StageName,
    /// What it does.
    pub settings: StageSettings,
    /// Where it runs and how often it saves; not part of its key.
    pub placement: Placement,
    /// The stages it reads.
    pub inputs: Vec<StageInput>,
    /// Digests of what it reads that no stage of the pipeline gives, by the field that names each: the contents of folders outside the
    /// store, and versions of the registry, which are resolved when the pipeline is submitted and stay what they were then.
    pub external: BTreeMap<String, Digest>,
    /// A search over its settings.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub sweep: Option<Sweep>,
    /// Set on a stage that a sweep made while the run went on; never in a pipeline that is submitted.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub derived: Option<Derived>,
}

/// An edge of the DAG.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct StageInput {
    /// The field that names the stage, such as `vae` or `from[0]`. A `register` stage also reads the evaluations of its
    /// candidates; their fields are `evaluations.<stage>`.
    pub field: String,
    /// The stage that is read.
    pub stage: StageName,
    /// What it must give.
    pub kind: ArtifactKind,
}

impl Pipeline {
    /// The stage of that name.
    pub fn stage(&self, name: &StageName) -> Option<&PipelineStage> {
        self.stages.iter().find(|stage| &stage.name == name)
    }

    /// The digest that names the pipeline: everything but the paths of folders outside the store, whose contents count instead.
    pub fn digest(&self) -> Digest {
        let mut pipeline = self.clone();
        for stage in &mut pipeline.stages {
            let folders = stage.settings.refs().into_iter().filter(|found| !matches!(found.target, Target::Stage(_)));
            folders.for_each(|folder| folder.name.clear());
        }
        crate::canonical::digest(&pipeline)
    }

    /// Asks `digest` for the content of every folder outside the store that a stage reads, and keeps the answers by field.
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

    /// The identity of `stage`, once the artifacts it reads are known: all that decides its value. `inputs` are artifacts by field; what the
    /// stage reads from outside is added.
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

    /// Notes the code versions of its kinds, those that evaluate trials included.
    pub(crate) fn note_code_versions(&mut self) {
        let evaluations = self.stages.iter().filter_map(|stage| stage.sweep.as_ref()).map(|sweep| &*sweep.evaluate);
        let kinds = self.stages.iter().map(|stage| &stage.settings).chain(evaluations);
        let beyond = kinds.filter(|settings| settings.code_version() > FIRST_VERSION);
        self.code_versions = beyond.map(|settings| (settings.kind().to_owned(), settings.code_version())).collect();
    }
}

/// What stands before the fields of a sweep's evaluation among those of its stage.
pub(super) const IN_EVALUATION: &str = "sweep.evaluate.";

impl PipelineStage {
    /// The versions of the registry that it reads, those of a sweep's evaluation included.
    pub fn versions(&self) -> Vec<VersionInput> {
        let mut all = self.settings.versions();
        let evaluation = self.sweep.iter().flat_map(|sweep| sweep.evaluate.versions());
        all.extend(evaluation.map(|input| VersionInput { field: format!("{IN_EVALUATION}{}", input.field), ..input }));
        all
    }

    /// The digests among [`external`](Self::external) that its settings name, or its sweep's evaluation, by the fields there.
    pub(super) fn external_of(&self, evaluation: bool) -> BTreeMap<String, Digest> {
        let own = |(field, digest): (&String, &Digest)| match (field.strip_prefix(IN_EVALUATION), evaluation) {
            (Some(field), true) => Some((field.to_owned(), *digest)),
            (None, false) => Some((field.clone(), *digest)),
            _ => None,
        };
        self.external.iter().filter_map(own).collect()
    }
}

/// The code version of every kind that has not changed yet.
const FIRST_VERSION: u32 = 1;

/// The name that keys a stage's randomness.
pub fn keyed_as(stage: &PipelineStage) -> &StageName {
    stage.derived.as_ref().map_or(&stage.name, |derived| &derived.keyed_as)
}
