//! Effects of a sweep on the pipeline: its inputs, its readers, and the stages of a trial.

use std::collections::BTreeMap;

use protocol::stage::{Placement, Shape, StageSettings, Target, WorkerRange};
use protocol::sweep::{Derived, STATE_OUTPUT, Values, evaluated_field, rung_name};
use protocol::{ArtifactKind, Digest, StageName, Steps};

use crate::definition::{IN_EVALUATION, PipelineStage, StageInput};
use crate::graph;
use crate::rules::{Problem, Problems};
use crate::trial_values::trial_settings;

/// Optional suffix of a swept stage's name; a reference to a swept stage always means its best trial.
const BEST: &str = "@best";

/// References of a swept stage through its trials' evaluations.
pub(crate) fn references(stage: &PipelineStage) -> Vec<StageInput> {
    let Some(sweep) = &stage.sweep else { return Vec::new() };
    let evaluated = evaluated_field(&sweep.evaluate, stage.settings.output().kind);
    let inputs =
        graph::references(&sweep.evaluate).into_iter().filter(|input| Some(&input.field) != evaluated.as_ref());
    inputs.map(|input| StageInput { field: format!("{IN_EVALUATION}{}", input.field), ..input }).collect()
}

/// Removes `@best` from references to swept stages, whose output is always their best trial. A name without a stage is
/// a model's.
pub(crate) fn resolve_best<'a>(
    stage: &mut PipelineStage,
    stages: impl Iterator<Item = (&'a StageName, bool)> + Clone,
) -> Vec<Problem> {
    let mut problems = Problems::default();
    let mut resolve = |settings: &mut StageSettings, prefix: &str| {
        for reference in settings.refs() {
            let Target::Stage(_) = reference.target else { continue };
            let Some(name) = reference.name.strip_suffix(BEST).map(str::to_owned) else { continue };
            let Some((_, swept)) = stages.clone().find(|(other, _)| other.as_str() == name) else { continue };
            if !swept {
                let field = format!("{prefix}{}", reference.field);
                let message = format!("`{field}` is `{name}{BEST}`, but `{name}` has no `sweep`; write `{name}`");
                problems.add(&field, message, &format!("write `{name}`"));
            }
            *reference.name = name;
        }
    };
    resolve(&mut stage.settings, "");
    if let Some(sweep) = &mut stage.sweep {
        resolve(&mut sweep.evaluate, IN_EVALUATION);
    }
    stage.inputs = graph::references(&stage.settings);
    stage.inputs.extend(references(stage));
    problems.0
}

/// Changes the reference `field`, such as `teacher` or `from[0]`, to another stage.
fn refer(settings: &mut StageSettings, field: &str, stage: &str) {
    if let Some(reference) = settings.refs().into_iter().find(|reference| reference.field == field) {
        stage.clone_into(reference.name);
    }
}

impl PipelineStage {
    /// The stages of one rung of a trial: the training up to step `stop` (to the end, if `None`), which continues the
    /// rung before, and the evaluation of its output.
    ///
    /// # Errors
    /// The reason that `values` cannot be tried, such as two values that conflict.
    pub fn rung(&self, trial: usize, rung: usize, stop: Option<Steps>, values: &Values) -> Result<[Self; 2], String> {
        let sweep = self.sweep.as_ref().ok_or("the stage has no sweep")?;
        let (mut settings, mut evaluation) = trial_settings(sweep, &self.settings, values)?;
        settings.training_mut().ok_or("the stage does not train")?.stop = stop;
        let name = rung_name(&self.name, trial, rung);
        let mut inputs = graph::references(&settings);
        if let Some(before) = rung.checked_sub(1) {
            let stage = rung_name(&self.name, trial, before);
            inputs.push(StageInput { field: STATE_OUTPUT.into(), stage, kind: ArtifactKind::Checkpoint });
        }
        if let Some(field) = evaluated_field(&evaluation, self.settings.output().kind) {
            refer(&mut evaluation, &field, name.as_str());
        }
        debug_assert!(settings.shape() == Shape::Gang, "only gangs train");
        let placement = beside(&self.placement);
        let derived = |keyed_as: StageName| Some(Derived { of: self.name.clone(), trial, rung, keyed_as });
        let eval = Self {
            name: StageName::new(format!("{name}.eval")),
            inputs: graph::references(&evaluation),
            settings: evaluation,
            placement: placement.clone(),
            external: self.external_of(true),
            sweep: None,
            derived: derived(StageName::new(format!("{}.eval", self.name))),
            copy_of: None,
        };
        let external = self.external_of(false);
        let train = Self {
            name,
            settings,
            placement,
            inputs,
            external,
            sweep: None,
            derived: derived(self.name.clone()),
            copy_of: None,
        };
        Ok([train, eval])
    }

    /// The training as it was after step `stop`: a stage that takes over `state`, a checkpoint of that step, and outputs
    /// its model without another step. `inputs` are the digests of the training's inputs, by field.
    ///
    /// # Errors
    /// If the stage does not train.
    pub fn at_checkpoint(
        &self,
        name: StageName,
        stop: Steps,
        state: Digest,
        inputs: BTreeMap<String, Digest>,
    ) -> Result<Self, String> {
        let mut settings = self.settings.clone();
        settings.training_mut().ok_or("the stage does not train")?.stop = Some(stop);
        let mut external = inputs;
        external.extend(self.external_of(false));
        external.insert(STATE_OUTPUT.to_owned(), state);
        let placement = Placement { workers: WorkerRange { min: 1, max: 1 }, ..Placement::default() };
        Ok(Self { name, settings, placement, inputs: Vec::new(), external, sweep: None, derived: None, copy_of: None })
    }
}

/// Placement of the stages of a trial: one worker each, so that trials run side by side.
fn beside(placement: &Placement) -> Placement {
    Placement { workers: WorkerRange { min: 1, max: 1 }, ..placement.clone() }
}
