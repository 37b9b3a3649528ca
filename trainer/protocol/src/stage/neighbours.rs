//! The other stages of a pipeline for a kind's checks, found by following references, not by kind.

use std::any::Any;
use std::collections::{BTreeMap, BTreeSet};

use super::{DataFormat, Family, LatentShape, Problems, Sampler};
use crate::{ArtifactKind, StageName};

/// Properties of a stage for the checks of other stages; all its settings, if they know its kind.
pub trait Neighbour: std::fmt::Debug {
    /// Name of its kind in YAML.
    fn kind(&self) -> &'static str;
    /// Stages that it reads: field, stage, kind that the stage must output.
    fn inputs(&self) -> Vec<(String, String, ArtifactKind)>;
    /// Stage that it measures.
    fn evaluated_model(&self) -> Option<String>;
    /// Sampler for the model that it measures.
    fn sampler(&self) -> Option<&Sampler>;
    /// Names of the values that it may return, if it is an evaluation with known values.
    fn metrics(&self) -> Option<BTreeSet<String>>;
    /// Family of the model that it trains.
    fn family(&self) -> Option<Family>;
    /// Skeleton of its output, if it decides that.
    fn format(&self) -> Option<DataFormat>;
    /// Shape of the latents that it outputs or uses, if it decides that.
    fn latent(&self) -> Option<LatentShape>;
    fn settings(&self) -> &dyn Any;
}

impl dyn Neighbour + '_ {
    /// Returns the settings of kind `S`, if it is of that kind.
    pub fn get<S: 'static>(&self) -> Option<&S> {
        self.settings().downcast_ref()
    }
}

/// The stages of a pipeline by name. References are valid: they lead to stages of the right kind, without a cycle.
#[derive(Debug)]
pub struct Neighbours<'a> {
    stages: BTreeMap<&'a str, &'a dyn Neighbour>,
    /// For each stage, the stages that it reads, with the kind of their output.
    reads: BTreeMap<&'a str, Vec<(ArtifactKind, String)>>,
    /// For each measured stage, its evaluations and their samplers.
    measured: BTreeMap<String, Vec<(&'a str, Option<&'a Sampler>)>>,
}

impl<'a> Neighbours<'a> {
    pub fn new(stages: impl Iterator<Item = (&'a StageName, &'a dyn Neighbour)>) -> Self {
        let stages: BTreeMap<&str, &dyn Neighbour> = stages.map(|(name, settings)| (name.as_str(), settings)).collect();
        let read = |settings: &dyn Neighbour| -> Vec<(ArtifactKind, String)> {
            // The source of a training's initial weights does not determine its output.
            let read = settings.inputs().into_iter().filter(|(field, ..)| field != "init");
            read.map(|(_, stage, kind)| (kind, stage)).collect()
        };
        let reads = stages.iter().map(|(name, settings)| (*name, read(*settings))).collect();
        let mut measured: BTreeMap<String, Vec<_>> = BTreeMap::new();
        for (name, settings) in &stages {
            if let Some(model) = settings.evaluated_model() {
                measured.entry(model).or_default().push((*name, settings.sampler()));
            }
        }
        Self { stages, reads, measured }
    }

    /// Finds the stage with this name.
    pub fn stage(&self, name: &str) -> Option<&'a dyn Neighbour> {
        self.stages.get(name).copied()
    }

    /// The first stage with output `kind` that stage `name` reads.
    pub fn read_by(&self, name: &str, kind: ArtifactKind) -> Option<&str> {
        self.reads.get(name)?.iter().find(|(found, _)| *found == kind).map(|(_, stage)| stage.as_str())
    }

    /// The VAE that encoded the latents.
    pub fn vae_of_latents(&self, latents: &str) -> Option<&str> {
        self.read_by(latents, ArtifactKind::Vae)
    }

    /// The VAE of the latents that a model was trained on.
    pub fn vae_of_model(&self, model: &str) -> Option<&str> {
        let of_latents = |name: &str| self.vae_of_latents(self.read_by(name, ArtifactKind::Latents)?);
        // An imported model reads no latents.
        self.of_model(model, &|name| of_latents(name).or_else(|| self.read_by(name, ArtifactKind::Vae)))
    }

    /// Family of a model.
    pub fn family(&self, model: &str) -> Option<Family> {
        self.of_model(model, &|name| self.stage(name)?.family())
    }

    /// Property `own` of the stage that trained `model`. A stage that only passes models on, such as `register`, has it
    /// if all its models agree.
    fn of_model<T: PartialEq>(&self, model: &str, own: &dyn Fn(&str) -> Option<T>) -> Option<T> {
        if let Some(found) = own(model) {
            return Some(found);
        }
        let models = self.reads.get(model)?.iter().filter(|(kind, _)| *kind == ArtifactKind::Model);
        let mut all = models.map(|(_, stage)| self.of_model(stage, own));
        let first = all.next()??;
        all.all(|other| other.as_ref() == Some(&first)).then_some(first)
    }

    /// The clips of latents or caption embeddings.
    pub fn dataset_of(&self, name: &str) -> Option<&str> {
        self.read_by(name, ArtifactKind::Dataset)
    }

    /// Skeleton of a dataset, of a model's motions, or of an evaluator.
    pub fn format(&self, name: &str) -> Option<DataFormat> {
        self.stage(name)?.format().or_else(|| {
            let of = |kind| self.read_by(name, kind);
            let tokens = || of(ArtifactKind::Tokens).or_else(|| of(ArtifactKind::Model));
            let tokenizer = || of(ArtifactKind::Tokenizer);
            let from = self.dataset_of(name).or_else(|| self.vae_of_model(name)).or_else(tokens).or_else(tokenizer)?;
            if from == name { None } else { self.format(from) }
        })
    }

    /// Shape of a VAE's latents.
    pub fn latent(&self, vae: &str) -> Option<LatentShape> {
        self.stage(vae)?.latent()
    }

    /// Returns true if an evaluation measures stage `name`.
    pub fn measures(&self, name: &str) -> bool {
        self.measured.contains_key(name)
    }

    /// Evaluations of the pipeline that sample from stage `name`, and their samplers. The evaluation of a sweep's
    /// trials is not included: its name contains a dot, unlike users' names.
    pub fn samplers_of(&self, name: &str) -> impl Iterator<Item = (&'a str, &'a Sampler)> {
        let all = self.measured.get(name).into_iter().flatten().filter(|(evaluation, _)| !evaluation.contains('.'));
        all.filter_map(|(evaluation, sampler)| Some((*evaluation, (*sampler)?)))
    }

    /// Metrics that a version of stage `name` may have: those of the evaluations that measure it. If there are several,
    /// each also has its evaluation's name as prefix. `None` if no evaluation measures it, or one has unknown values.
    pub fn metrics_of(&self, name: &str) -> Option<BTreeSet<String>> {
        let looking = self.measured.get(name)?.iter().map(|(evaluation, _)| *evaluation);
        let looking: Vec<&str> = looking.filter(|evaluation| !evaluation.contains('.')).collect();
        let mut all = BTreeSet::new();
        for evaluation in &looking {
            let metrics = self.stage(evaluation)?.metrics()?;
            if looking.len() > 1 {
                all.extend(metrics.iter().map(|metric| format!("{evaluation}.{metric}")));
            }
            all.extend(metrics);
        }
        (!all.is_empty()).then_some(all)
    }

    /// Refuses latents of another VAE than `vae`, the value of `field`.
    pub(crate) fn same_vae(&self, p: &mut Problems, (field, vae): (&str, Option<&str>), latents: &str) {
        if let (Some(vae), Some(other)) = (vae, self.vae_of_latents(latents))
            && vae != other
        {
            let shape = |vae| self.latent(vae).map_or_else(String::new, |l| format!(" ({}x{})", l.tokens, l.dim));
            let (shape, other_shape) = (shape(vae), shape(other));
            let message = if field == "vae" {
                format!("`vae` is `{vae}`{shape}, but `{latents}` was encoded with `{other}`{other_shape}")
            } else {
                format!(
                    "`{field}` uses latents of `{vae}`{shape}, but `{latents}` was encoded with `{other}`{other_shape}"
                )
            };
            p.add(field, message, "latents have a meaning only with their own VAE; use the same VAE in both places");
        }
    }

    /// Refuses captions of other clips than those of `latents`.
    pub(crate) fn same_data(&self, p: &mut Problems, latents: &str, text: &str) {
        if let (Some(data), Some(other)) = (self.dataset_of(latents), self.dataset_of(text))
            && data != other
        {
            let message = format!("`{text}` embeds the captions of `{other}`, but `{latents}` encodes `{data}`");
            p.add("text", message, &format!("add a `text.embed` stage with `dataset: {data}`"));
        }
    }

    /// Refuses clips other than those of `latents`.
    pub(crate) fn same_clips(&self, p: &mut Problems, dataset: &str, latents: &str) {
        if let Some(data) = self.dataset_of(latents)
            && data != dataset
        {
            let message = format!("`{latents}` encodes the clips of `{data}`, but `dataset` is `{dataset}`");
            p.add("dataset", message, &format!("write `dataset: {data}`"));
        }
    }

    /// Refuses clips of another skeleton than that of stage `name`, the value of `field`.
    pub(crate) fn same_skeleton(&self, p: &mut Problems, (field, name): (&str, &str), dataset: &str) {
        if let (Some(ours), Some(theirs)) = (self.format(dataset), self.format(name))
            && ours != theirs
        {
            let message = format!(
                "`{name}` has skeletons of {}, but the clips of `{dataset}` have {}",
                theirs.skeleton(),
                ours.skeleton()
            );
            p.add(field, message, "features depend on the skeleton; use stages of the same dataset");
        }
    }

    /// Refuses a flow decoder of other tokens or latents than those of `encoder`; stage `name`, the value of `field`,
    /// outputs it.
    pub(crate) fn same_codes(&self, p: &mut Problems, (field, name): (&str, &str), encoder: &str) {
        let decoded = |kind| self.read_by(name, kind).filter(|other| *other != encoder);
        if let Some(other) = decoded(ArtifactKind::Tokenizer) {
            let message =
                format!("`{name}` decodes the codes of `{other}`, but its input has the codes of `{encoder}`");
            p.add(
                field,
                message,
                "tokens have a meaning only with their own tokenizer; train both with the same tokenizer",
            );
        } else if let Some(other) = decoded(ArtifactKind::Vae) {
            let message =
                format!("`{name}` decodes the latents of `{other}`, but its input has the latents of `{encoder}`");
            p.add(field, message, "latents have a meaning only with their own VAE; train both with the same VAE");
        }
    }

    /// Refuses captions of other clips than those of `dataset`.
    pub(crate) fn same_captions(&self, p: &mut Problems, text: &str, dataset: &str) {
        if let Some(data) = self.dataset_of(text)
            && data != dataset
        {
            let message = format!("`{text}` embeds the captions of `{data}`, but the clips are those of `{dataset}`");
            p.add("text", message, &format!("add a `text.embed` stage with `dataset: {dataset}`"));
        }
    }

    /// The evaluator in the losses of a model's training, if there is one.
    pub(crate) fn evaluator_of_model(&self, model: &str) -> Option<&str> {
        self.of_model(model, &|name| self.read_by(name, ArtifactKind::Evaluator))
    }

    /// The tokenizer whose codes a model generates.
    pub(crate) fn tokenizer_of_model(&self, model: &str) -> Option<&str> {
        self.of_model(model, &|name| self.read_by(name, ArtifactKind::Tokenizer))
    }

    /// Refuses any model but a latent teacher.
    pub(crate) fn is_teacher(&self, p: &mut Problems, teacher: &str) {
        let (Some(settings), Some(family)) = (self.stage(teacher), self.family(teacher)) else { return };
        let (what, why) = match family {
            Family::Mld => return,
            Family::Lcm { .. } | Family::Pcm { .. } => {
                ("a student", "a student has guidance built in and cannot predict without it")
            }
            Family::Autoregressive | Family::Masked | Family::Mmm | Family::Features { .. } => {
                ("not a latent diffusion model", "distillation needs the latents of such a model")
            }
        };
        let kind = settings.kind();
        let message = format!("`{teacher}` is {what} ({kind}), but `teacher` needs a `train.mld` stage");
        p.add("teacher", message, why);
    }

    /// Refuses steps and timesteps that the model does not support.
    pub(crate) fn check_sampler(&self, p: &mut Problems, model: &str, sampler: &Sampler) {
        if let Some(family) = self.family(model) {
            family.check(&format!("`{model}`"), sampler, p);
        }
    }
}
