//! What must hold between stages: references exist and give the right kind, nothing waits for itself, shapes agree.

use std::collections::{BTreeMap, BTreeSet};

use super::rules::Problems;
use super::{PipelineStage, StageInput};
use crate::stage::{Neighbours, Register, StageSettings};
use crate::{ArtifactKind, StageName};

/// Problems by stage.
pub(super) type ByStage = BTreeMap<StageName, Problems>;

/// The edges of `settings`, references only.
pub(super) fn references(settings: &StageSettings) -> Vec<StageInput> {
    let input =
        |(field, stage, kind): (String, String, ArtifactKind)| StageInput { field, stage: StageName::new(stage), kind };
    settings.inputs().into_iter().map(input).collect()
}

/// Gives every `register` stage the evaluations of its candidates as inputs.
pub(super) fn add_evaluations(stages: &mut [PipelineStage]) {
    let evaluated_model: Vec<(StageName, StageName)> = stages
        .iter()
        .filter_map(|stage| Some((stage.name.clone(), StageName::new(stage.settings.evaluated_model()?))))
        .collect();
    for stage in stages {
        if let Some(settings) = stage.settings.get::<Register>() {
            for (evaluation, model) in &evaluated_model {
                if settings.from.iter().any(|from| from == model.as_str()) {
                    stage.inputs.push(StageInput {
                        field: format!("evaluations.{evaluation}"),
                        stage: evaluation.clone(),
                        kind: ArtifactKind::Report,
                    });
                }
            }
        }
    }
}

/// Sorts `stages` so that each comes after those it reads, keeping the given order where it is free.
///
/// # Errors
/// The names along a cycle, first and last the same.
pub(super) fn sort(stages: Vec<PipelineStage>) -> Result<Vec<PipelineStage>, Vec<StageName>> {
    let names: BTreeSet<&StageName> = stages.iter().map(|stage| &stage.name).collect();
    let known = |input: &&StageInput| names.contains(&input.stage);
    let mut order: Vec<usize> = Vec::new();
    let mut placed: BTreeSet<&StageName> = BTreeSet::new();
    while order.len() < stages.len() {
        let ready = stages.iter().position(|stage| {
            !placed.contains(&stage.name)
                && stage.inputs.iter().filter(known).all(|input| placed.contains(&input.stage))
        });
        let Some(ready) = ready else {
            return Err(cycle(&stages, &placed));
        };
        placed.insert(&stages[ready].name);
        order.push(ready);
    }
    let mut slots: Vec<Option<PipelineStage>> = stages.into_iter().map(Some).collect();
    Ok(order.into_iter().filter_map(|i| slots[i].take()).collect())
}

/// Follows unplaced inputs until a name comes again.
fn cycle(stages: &[PipelineStage], placed: &BTreeSet<&StageName>) -> Vec<StageName> {
    let blocked = |name: &StageName| stages.iter().find(|stage| &stage.name == name && !placed.contains(name));
    let mut path: Vec<StageName> = Vec::new();
    let mut current = stages.iter().find(|stage| !placed.contains(&stage.name));
    while let Some(stage) = current {
        if let Some(start) = path.iter().position(|name| name == &stage.name) {
            path.push(stage.name.clone());
            return path.split_off(start);
        }
        path.push(stage.name.clone());
        current = stage.inputs.iter().find_map(|input| blocked(&input.stage));
    }
    path
}

/// References that lead nowhere, or to another kind of thing.
pub(super) fn check_references(stages: &[PipelineStage], found: &mut ByStage) {
    for stage in stages {
        for input in &stage.inputs {
            let problems = found.entry(stage.name.clone()).or_default();
            let what = input.kind.noun();
            let giving: Vec<&str> = stages
                .iter()
                .filter(|other| other.settings.output().kind == input.kind && other.name != stage.name)
                .map(|other| other.name.as_str())
                .collect();
            let help = if giving.is_empty() {
                format!("no stage gives {what}; add one")
            } else {
                format!("stages that give {what}: {}", super::schema::list_keys(giving.iter().copied()))
            };
            match stages.iter().find(|other| other.name == input.stage) {
                None if input.stage.as_str().is_empty() => {
                    problems.add(
                        &input.field,
                        format!("`{}` is empty; expected a stage that gives {what}", input.field),
                        &help,
                    );
                }
                None => {
                    let near = super::diagnostic::nearest(input.stage.as_str(), giving.iter().copied());
                    let question = near.map(|near| format!("; did you mean `{near}`?")).unwrap_or_default();
                    let message =
                        format!("`{}` names the stage `{}`, which does not exist{question}", input.field, input.stage);
                    problems.add(&input.field, message, &help);
                }
                Some(other) if other.settings.output().kind != input.kind => {
                    let message = format!(
                        "`{}` gives {}, but `{}` needs {what}",
                        other.name,
                        other.settings.output().kind.noun(),
                        input.field
                    );
                    problems.add(&input.field, message, &help);
                }
                Some(_) => {}
            }
        }
    }
}

/// Shapes, samplers and data that must agree. Call when references are sound.
pub(super) fn check_agreement(stages: &[PipelineStage], found: &mut ByStage) {
    let neighbours = Neighbours::new(stages.iter().map(|stage| (&stage.name, &stage.settings)));
    for stage in stages {
        let problems = found.entry(stage.name.clone()).or_default();
        stage.settings.check_neighbours(&neighbours, problems);
    }
}
