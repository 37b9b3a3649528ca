//! What must hold between stages: references exist and give the right kind, nothing waits for itself, shapes agree.

use std::collections::{BTreeMap, BTreeSet};

use super::rules::Problems;
use super::{PipelineStage, StageInput};
use crate::stage::{DataFormat, Sampler, StageSettings, TrainVae};
use crate::{ArtifactKind, StageName};

/// Problems by stage.
pub(super) type ByStage = BTreeMap<StageName, Problems>;

/// What a kind is called in a message.
pub(super) fn noun(kind: ArtifactKind) -> &'static str {
    match kind {
        ArtifactKind::Dataset => "a dataset",
        ArtifactKind::Embeddings => "caption embeddings",
        ArtifactKind::Vae => "a VAE",
        ArtifactKind::Latents => "latents",
        ArtifactKind::Denoiser => "a denoiser",
        ArtifactKind::Evaluator => "an evaluator",
        ArtifactKind::Report => "a report",
        ArtifactKind::Model => "a model",
        ArtifactKind::Checkpoint => "a checkpoint",
        ArtifactKind::Shard => "a shard",
    }
}

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
        if let StageSettings::Register(settings) = &stage.settings {
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
            let what = noun(input.kind);
            let giving: Vec<&str> = stages
                .iter()
                .filter(|other| other.settings.output().1 == input.kind && other.name != stage.name)
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
                Some(other) if other.settings.output().1 != input.kind => {
                    let message = format!(
                        "`{}` gives {}, but `{}` needs {what}",
                        other.name,
                        noun(other.settings.output().1),
                        input.field
                    );
                    problems.add(&input.field, message, &help);
                }
                Some(_) => {}
            }
        }
    }
}

/// Stages by name, for following references.
struct Lookup<'a>(BTreeMap<&'a str, &'a StageSettings>);

impl<'a> Lookup<'a> {
    fn vae(&self, name: &str) -> Option<&'a TrainVae> {
        match self.0.get(name)? {
            StageSettings::TrainVae(s) => Some(s),
            _ => None,
        }
    }

    /// Which VAE a latents stage encodes with.
    fn vae_of_latents(&self, latents: &str) -> Option<&'a str> {
        match self.0.get(latents)? {
            StageSettings::EncodeLatents(s) => Some(&s.vae),
            _ => None,
        }
    }

    /// Which VAE made the latents that a denoiser was trained on.
    fn vae_of_denoiser(&self, denoiser: &str) -> Option<&'a str> {
        match self.0.get(denoiser)? {
            StageSettings::TrainMld(s) => self.vae_of_latents(&s.latents),
            StageSettings::DistillLcm(s) => self.vae_of_latents(&s.distillation.latents),
            StageSettings::DistillPcm(s) => self.vae_of_latents(&s.distillation.latents),
            _ => None,
        }
    }

    fn dataset_of_latents(&self, latents: &str) -> Option<&'a str> {
        match self.0.get(latents)? {
            StageSettings::EncodeLatents(s) => Some(&s.dataset),
            _ => None,
        }
    }

    fn dataset_of_text(&self, text: &str) -> Option<&'a str> {
        match self.0.get(text)? {
            StageSettings::TextEmbed(s) => Some(&s.dataset),
            _ => None,
        }
    }

    /// The skeleton of a dataset, or the one that an evaluator is for.
    fn format(&self, stage: &str) -> Option<DataFormat> {
        match self.0.get(stage)? {
            StageSettings::DataOpen(s) => Some(s.format),
            StageSettings::DataSynthetic(_) => Some(DataFormat::Humanml3d),
            StageSettings::ImportEvaluator(s) => Some(s.format),
            StageSettings::TrainEvaluator(s) if s.dataset != stage => self.format(&s.dataset),
            _ => None,
        }
    }

    fn shape(&self, vae: &str) -> String {
        self.vae(vae).map_or_else(String::new, |s| format!(" ({}x{})", s.latent.tokens, s.latent.dim))
    }
}

/// Shapes, samplers and data that must agree. Call when references are sound.
pub(super) fn check_agreement(stages: &[PipelineStage], found: &mut ByStage) {
    let lookup = Lookup(stages.iter().map(|stage| (stage.name.as_str(), &stage.settings)).collect());
    for stage in stages {
        let p = found.entry(stage.name.clone()).or_default();
        match &stage.settings {
            StageSettings::TrainMld(s) => {
                same_vae(p, &lookup, ("vae", Some(&s.vae)), &s.latents);
                same_data(p, &lookup, &s.latents, &s.text);
            }
            StageSettings::DistillLcm(s) => distillation(p, &lookup, &s.distillation),
            StageSettings::DistillPcm(s) => distillation(p, &lookup, &s.distillation),
            StageSettings::EvaluateReconstruction(_)
            | StageSettings::DataOpen(_)
            | StageSettings::DataSynthetic(_)
            | StageSettings::TextEmbed(_)
            | StageSettings::TrainVae(_)
            | StageSettings::TrainEvaluator(_)
            | StageSettings::ImportEvaluator(_)
            | StageSettings::EncodeLatents(_) => {}
            StageSettings::EvaluateT2m(s) => {
                if let (Some(ours), Some(theirs)) = (lookup.format(&s.dataset), lookup.format(&s.evaluator))
                    && ours != theirs
                {
                    let message = format!(
                        "`{}` is an evaluator for skeletons of {}, but the clips of `{}` have {}",
                        s.evaluator,
                        skeleton(theirs),
                        s.dataset,
                        skeleton(ours)
                    );
                    let help = format!("add a `train.evaluator` stage with `dataset: {}`", s.dataset);
                    p.add("evaluator", message, &help);
                }
                if s.real {
                    continue;
                }
                if let Some(vae) = lookup.vae_of_denoiser(&s.model)
                    && vae != s.vae
                {
                    let message = format!("`{}` makes latents of `{vae}`, but `vae` is `{}`", s.model, s.vae);
                    p.add("vae", message, "another VAE makes other motions of them; name the same one");
                }
                if let Some(data) = lookup.dataset_of_text(&s.text)
                    && data != s.dataset
                {
                    let message =
                        format!("`{}` embeds the captions of `{data}`, but the clips are of `{}`", s.text, s.dataset);
                    p.add("text", message, &format!("add a `text.embed` stage with `dataset: {}`", s.dataset));
                }
                steps_of(p, &lookup, &s.model, &s.sampler);
            }
            StageSettings::EvaluateLatentFid(s) => {
                same_vae(p, &lookup, ("model", lookup.vae_of_denoiser(&s.model)), &s.latents);
                same_data(p, &lookup, &s.latents, &s.text);
                if !s.teacher.is_empty() {
                    same_vae(p, &lookup, ("teacher", lookup.vae_of_denoiser(&s.teacher)), &s.latents);
                    is_teacher(p, &lookup, &s.teacher);
                }
                if let Some(vae) = lookup.vae_of_latents(&s.latents).and_then(|vae| lookup.vae(vae)) {
                    let size = vae.latent.tokens * vae.latent.dim;
                    if s.components > size {
                        let message = format!("`components` is {}, but a latent has only {size} numbers", s.components);
                        p.add("components", message, "");
                    }
                }
                steps_of(p, &lookup, &s.model, &s.sampler);
            }
            StageSettings::Register(s) => {
                for (i, from) in s.from.iter().enumerate() {
                    let judged = stages.iter().any(|other| other.settings.evaluated_model() == Some(from.as_str()));
                    if !judged && (s.from.len() > 1 || !s.promote.to.is_empty()) {
                        let message =
                            format!("no `evaluate.*` stage looks at `{from}`, so `{}` cannot judge it", s.metric);
                        let help = format!("add a stage such as `{{kind: evaluate.latent_fid, model: {from}}}`");
                        p.add(&format!("from[{i}]"), message, &help);
                    }
                }
            }
        }
    }
}

/// A skeleton in words.
fn skeleton(format: DataFormat) -> &'static str {
    match format {
        DataFormat::Humanml3d => "22 joints (humanml3d)",
        DataFormat::Kit => "21 joints (kit)",
    }
}

/// Steps and timesteps that the model has.
fn steps_of(p: &mut Problems, lookup: &Lookup<'_>, model: &str, sampler: &Sampler) {
    match lookup.0.get(model) {
        Some(StageSettings::DistillPcm(pcm)) if pcm.phases != sampler.steps => {
            let message = format!(
                "`sampler.steps` is {}, but `{}` has {} phase(s); a PCM student makes one step a phase",
                sampler.steps, model, pcm.phases
            );
            p.add("sampler.steps", message, &format!("write `steps: {}`", pcm.phases));
        }
        Some(StageSettings::DistillPcm(_) | StageSettings::TrainMld(_)) if !sampler.timesteps.is_empty() => {
            let message = format!("`sampler.timesteps` are for LCM students, and `{}` is none", model);
            p.add("sampler.timesteps", message, "leave them out");
        }
        Some(StageSettings::DistillLcm(lcm)) if sampler.steps > 1000 / lcm.distillation.skip.max(1) => {
            let points = 1000 / lcm.distillation.skip.max(1);
            let message =
                format!("`sampler.steps` is {}, but the grid of `{}` has {points} points", sampler.steps, model);
            p.add("sampler.steps", message, "");
        }
        _ => {}
    }
}

fn distillation(p: &mut Problems, lookup: &Lookup<'_>, s: &crate::stage::Distillation) {
    is_teacher(p, lookup, &s.teacher);
    same_vae(p, lookup, ("teacher", lookup.vae_of_denoiser(&s.teacher)), &s.latents);
    same_data(p, lookup, &s.latents, &s.text);
}

fn is_teacher(p: &mut Problems, lookup: &Lookup<'_>, teacher: &str) {
    if let Some(settings @ (StageSettings::DistillLcm(_) | StageSettings::DistillPcm(_))) = lookup.0.get(teacher) {
        let message =
            format!("`{teacher}` is a student ({}), but `teacher` needs a `train.mld` stage", settings.kind());
        p.add("teacher", message, "a student has guidance built in, and cannot be asked without it");
    }
}

fn same_vae(p: &mut Problems, lookup: &Lookup<'_>, (field, vae): (&str, Option<&str>), latents: &str) {
    if let (Some(vae), Some(other)) = (vae, lookup.vae_of_latents(latents))
        && vae != other
    {
        let (shape, other_shape) = (lookup.shape(vae), lookup.shape(other));
        let message = if field == "vae" {
            format!("`vae` is `{vae}`{shape}, but `{latents}` was encoded with `{other}`{other_shape}")
        } else {
            format!(
                "`{field}` works on latents of `{vae}`{shape}, but `{latents}` was encoded with `{other}`{other_shape}"
            )
        };
        p.add(field, message, "latents of another VAE mean other motions; name the same VAE in both places");
    }
}

fn same_data(p: &mut Problems, lookup: &Lookup<'_>, latents: &str, text: &str) {
    if let (Some(data), Some(other)) = (lookup.dataset_of_latents(latents), lookup.dataset_of_text(text))
        && data != other
    {
        let message = format!("`{text}` embeds the captions of `{other}`, but `{latents}` are of `{data}`");
        p.add("text", message, &format!("add a `text.embed` stage with `dataset: {data}`"));
    }
}
