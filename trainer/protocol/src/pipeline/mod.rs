//! A pipeline: stages, what each reads from which other, and what all of them share.
//!
//! [`read`] makes one from YAML and reports every mistake of the file at once; [`Pipeline::check`] repeats the rules that
//! do not need the text, for pipelines that arrive as JSON. Not its job: touching the file system. The content digests of
//! folders are put in by the caller ([`Pipeline::fill_external`]).

mod diagnostic;
mod graph;
mod overrides;
mod ranges;
mod read;
mod reference;
mod rules;
mod schema;
mod sweep;
mod trial;
mod yaml;

use std::collections::{BTreeMap, BTreeSet};

use serde::{Deserialize, Serialize};

use crate::stage::{Backend, ExternalFolder, Placement, Register, StageIdentity, StageSettings, Target};
use crate::sweep::{Derived, Sweep};
use crate::{ArtifactKind, Digest, Seed, StageName, limits};

pub use diagnostic::{Diagnostic, Diagnostics};
pub use read::read;
pub use reference::{json_schema, markdown};

#[cfg(test)]
mod range_tests;
#[cfg(test)]
mod sweep_tests;
#[cfg(test)]
mod tests;

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
    /// Digests of the folders outside the store that it reads, by the field that names each.
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

    /// Repeats the rules that need no text, for a pipeline that came as JSON.
    ///
    /// # Errors
    /// What does not hold, a line for each.
    pub fn check(&self) -> Result<(), String> {
        self.check_size()?;
        let mut wrong = Vec::new();
        let computed = StageSettings::all();
        for (kind, version) in &self.code_versions {
            match computed.iter().find(|settings| settings.kind() == kind).map(StageSettings::code_version) {
                Some(known) if *version <= known => {}
                Some(known) => wrong.push(format!(
                    "it has `{kind}` at code version {version}, this program computes {known}; use one build for both"
                )),
                None => wrong.push(format!("there is no kind `{}`", kind.escape_debug())),
            }
        }
        let mut found = graph::ByStage::new();
        let mut before: BTreeSet<&StageName> = BTreeSet::new();
        for stage in &self.stages {
            for input in stage.inputs.iter().filter(|input| !before.contains(&input.stage)) {
                let read = shown(input.stage.as_str());
                wrong.push(format!("stage `{}` reads `{read}`, which does not come before it", stage.name));
            }
            if !before.insert(&stage.name) {
                wrong.push(format!("two stages are called `{}`", stage.name));
            }
            wrong.extend(stage.unfit_for_submission());
            let problems = &mut found.entry(stage.name.clone()).or_default().0;
            problems.extend(rules::stage(&stage.settings, &stage.placement));
            problems.extend(sweep::rules(stage));
        }
        if wrong.is_empty() {
            graph::check_references(&self.stages, &mut found);
        }
        if wrong.is_empty() && found.values().all(|problems| problems.0.is_empty()) {
            graph::check_agreement(&self.stages, &mut found);
            sweep::check_agreement(&self.stages, &mut found);
        }
        for (stage, problems) in &found {
            wrong.extend(problems.0.iter().map(|problem| format!("stage `{stage}`: {}", problem.message)));
        }
        wrong.truncate(limits::MISTAKES);
        if wrong.is_empty() { Ok(()) } else { Err(wrong.join("\n")) }
    }

    /// Names and counts, before anything is done that takes longer the more there is.
    fn check_size(&self) -> Result<(), String> {
        if !crate::id::is_name(&self.name) {
            return Err(format!("`{}` is not a pipeline name", shown(&self.name)));
        }
        if !(1..=limits::STAGES).contains(&self.stages.len()) {
            return Err(format!("it has {} stages; expected 1 to {}", self.stages.len(), limits::STAGES));
        }
        for stage in &self.stages {
            if !crate::id::is_stage_name(stage.name.as_str()) {
                return Err(format!(
                    "`{}` is not a stage name; expected a small letter, then small letters, digits, `_`, `-`, at most 64",
                    shown(stage.name.as_str())
                ));
            }
            if stage.inputs.len() > 2 * limits::LIST {
                return Err(format!("stage `{}` has {} inputs", stage.name, stage.inputs.len()));
            }
        }
        let mut found = graph::ByStage::new();
        graph::check_totals(&self.stages, &mut found);
        match found.values().flat_map(|problems| &problems.0).next() {
            Some(problem) => Err(problem.message.clone()),
            None => Ok(()),
        }
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

    /// Notes the code versions of its kinds, those that judge trials included.
    pub(crate) fn note_code_versions(&mut self) {
        let judges = self.stages.iter().filter_map(|stage| stage.sweep.as_ref()).map(|sweep| &*sweep.evaluate);
        let kinds = self.stages.iter().map(|stage| &stage.settings).chain(judges);
        let beyond = kinds.filter(|settings| settings.code_version() > FIRST_VERSION);
        self.code_versions = beyond.map(|settings| (settings.kind().to_owned(), settings.code_version())).collect();
    }
}

impl PipelineStage {
    /// What a stage that was not read from a file may have wrong besides its settings.
    fn unfit_for_submission(&self) -> Vec<String> {
        let mut wrong = Vec::new();
        let name = &self.name;
        if self.derived.is_some() || self.settings.training().is_some_and(|training| training.stop.is_some()) {
            wrong.push(format!("stage `{name}` says that a sweep made it; sweeps are unfolded while a run goes on"));
        }
        let (own, swept) = (graph::references(&self.settings), trial::references(self));
        if own.iter().any(|reference| !self.inputs.contains(reference)) {
            wrong.push(format!("the inputs of stage `{name}` are not those of its settings"));
        }
        if swept.iter().any(|reference| !self.inputs.contains(reference)) {
            wrong.push(format!("the inputs of stage `{name}` are not those of its sweep"));
        }
        let added = |input: &StageInput| {
            self.settings.get::<Register>().is_some() && input.field == format!("evaluations.{}", input.stage)
        };
        for input in self.inputs.iter().filter(|input| !own.contains(input) && !swept.contains(input) && !added(input))
        {
            let (field, stage) = (shown(&input.field), shown(input.stage.as_str()));
            wrong.push(format!("stage `{name}` reads `{stage}` as `{field}`, of which its settings know nothing"));
        }
        let folders = self.settings.folders();
        for field in self.external.keys().filter(|field| folders.iter().all(|folder| folder.field != **field)) {
            let field = shown(field);
            wrong.push(format!("stage `{name}` has a digest of `{field}`, which it does not read"));
        }
        wrong
    }
}

/// A text from outside, for a message: its beginning, without control characters.
fn shown(text: &str) -> String {
    yaml::shortened(text).escape_debug().to_string()
}

/// The code version of every kind that has not changed yet.
const FIRST_VERSION: u32 = 1;

/// The name that keys a stage's randomness.
pub fn keyed_as(stage: &PipelineStage) -> &StageName {
    stage.derived.as_ref().map_or(&stage.name, |derived| &derived.keyed_as)
}

/// What does not hold of one stage's settings, a line for each.
pub fn broken_rules(settings: &StageSettings, placement: &Placement) -> Vec<String> {
    rules::stage(settings, placement).into_iter().map(|problem| problem.message).collect()
}
