//! Rules between stages: references exist and have the right kind, there is no cycle, and shapes agree.

use std::collections::{BTreeMap, BTreeSet};

use protocol::model_ref::{ModelRef, names_version};
use protocol::stage::{Neighbour, Neighbours, Register, Shape, StageSettings, VersionInput};
use protocol::sweep::Domain;
use protocol::{ArtifactKind, StageName, limits};

use crate::definition::{PipelineStage, StageInput};
use crate::rules::Problems;

/// Largest number of stages that a message lists.
const LISTED: usize = 20;

/// Problems by stage.
pub(crate) type ByStage = BTreeMap<StageName, Problems>;

/// Edges of `settings`: references to stages, without versions of the registry.
pub(crate) fn references(settings: &StageSettings) -> Vec<StageInput> {
    let input =
        |(field, stage, kind): (String, String, ArtifactKind)| StageInput { field, stage: StageName::new(stage), kind };
    settings.inputs().into_iter().filter(|(_, name, _)| !names_version(name)).map(input).collect()
}

/// Adds the evaluations of its candidates to the inputs of every `register` stage.
pub(crate) fn add_evaluations(stages: &mut [PipelineStage]) {
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

/// Sorts `stages` so that each comes after its inputs, and keeps the given order where possible.
///
/// # Errors
/// The names along a cycle; the first equals the last.
pub(crate) fn sort(stages: Vec<PipelineStage>) -> Result<Vec<PipelineStage>, Vec<StageName>> {
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

/// Follows unplaced inputs until a name repeats.
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

/// Checks the limits on all stages together. The problem is reported at the stage that exceeds a limit.
pub(crate) fn check_totals(stages: &[PipelineStage], found: &mut ByStage) {
    let mut shards = 0_u64;
    let mut trials = 0_usize;
    let mut values = 0_usize;
    let most_values = limits::SWEPT_VALUES.min(limits::SWEPT_CHECKS / stages.len().max(1));
    for stage in stages {
        let before = (shards, trials, values);
        shards += u64::from(stage.settings.shards());
        if let Some(sweep) = &stage.sweep {
            trials += sweep.trials();
            values += sweep.space.values().map(Domain::choices).sum::<usize>();
        }
        let p = found.entry(stage.name.clone()).or_default();
        if before.0 <= limits::PIPELINE_SHARDS && shards > limits::PIPELINE_SHARDS {
            let message = format!("the pipeline has more than {} shards up to this stage", limits::PIPELINE_SHARDS);
            p.add("shards", message, "use fewer, larger shards");
        }
        if before.1 <= limits::TRIALS && trials > limits::TRIALS {
            let message = format!("the pipeline's sweeps have more than {} trials up to this stage", limits::TRIALS);
            p.add("sweep.trials", message, "distribute the sweeps over several pipelines");
        }
        if before.2 <= most_values && values > most_values {
            let message = format!("the pipeline's sweeps list more than {most_values} values up to this stage");
            p.add(
                "sweep.space",
                message,
                "search a range with `uniform`, or distribute the sweeps over several pipelines",
            );
        }
    }
}

/// Checks for references that do not exist, or have another kind.
pub(crate) fn check_references(stages: &[PipelineStage], found: &mut ByStage) {
    let by_name: BTreeMap<&StageName, &PipelineStage> = stages.iter().map(|stage| (&stage.name, stage)).collect();
    for stage in stages {
        for version in stage.versions() {
            check_version(stage, &version, found.entry(stage.name.clone()).or_default());
        }
        for input in &stage.inputs {
            let problems = found.entry(stage.name.clone()).or_default();
            let what = input.kind.noun();
            let giving = || {
                let other = stages.iter().filter(|other| other.settings.output().kind == input.kind);
                other.map(|other| other.name.as_str()).filter(|name| *name != stage.name.as_str())
            };
            let help = || {
                let names: Vec<&str> = giving().take(LISTED).collect();
                match giving().count() {
                    0 => format!("no stage outputs {what}; add one"),
                    more if more > LISTED => {
                        let names = crate::schema::list_keys(names);
                        format!("stages that output {what}: {names} and {} more", more - LISTED)
                    }
                    _ => format!("stages that output {what}: {}", crate::schema::list_keys(names)),
                }
            };
            match by_name.get(&input.stage).copied() {
                None if input.stage.as_str().is_empty() => {
                    problems.add(
                        &input.field,
                        format!("`{}` is empty; expected a stage that outputs {what}", input.field),
                        &help(),
                    );
                }
                None => {
                    let near = protocol::spelling::nearest(input.stage.as_str(), giving().take(10 * LISTED));
                    let question = near.map(|near| format!("; did you mean `{near}`?")).unwrap_or_default();
                    let message =
                        format!("`{}` names the stage `{}`, which does not exist{question}", input.field, input.stage);
                    problems.add(&input.field, message, &help());
                }
                Some(other) if other.settings.output().kind != input.kind => {
                    let message = format!(
                        "`{}` outputs {}, but `{}` needs {what}",
                        other.name,
                        other.settings.output().kind.noun(),
                        input.field
                    );
                    problems.add(&input.field, message, &help());
                }
                Some(_) => {}
            }
        }
    }
}

/// Applies the rules for a version reference that need no registry.
fn check_version(stage: &PipelineStage, input: &VersionInput, problems: &mut Problems) {
    let VersionInput { field, version, kind, .. } = input;
    let what = kind.noun();
    if stage.settings.shape() == Shape::Registry {
        let message =
            format!("`{field}` is `{version}`, a version of the registry; expected a stage that outputs {what}");
        problems.add(field, message, "a registered version cannot be registered again; name a stage");
    } else if !kind.is_of_models() {
        let message = format!("`{field}` is `{version}`, but versions of the registry do not contain {what}");
        problems.add(field, message, "name a stage");
    } else if let Err(why) = version.parse::<ModelRef>() {
        problems.add(
            field,
            format!("`{field}`: {why}"),
            "for example `motionlcm@prod`, `motionlcm@best` or `motionlcm@3`",
        );
    }
}

/// Checks that shapes, samplers and data agree. Called once references are valid.
pub(crate) fn check_agreement(stages: &[PipelineStage], found: &mut ByStage) {
    let neighbours = Neighbours::new(stages.iter().map(|stage| (&stage.name, &stage.settings as &dyn Neighbour)));
    for stage in stages {
        let problems = found.entry(stage.name.clone()).or_default();
        stage.settings.check_neighbours(&neighbours, problems);
    }
}
