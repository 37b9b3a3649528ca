//! The other stages of a pipeline, as a kind's checks see them: found by following references, not by kind.

use std::any::Any;
use std::collections::{BTreeMap, BTreeSet};

use super::{DataFormat, Family, LatentShape, Problems, Sampler};
use crate::{ArtifactKind, StageName};

/// What other stages may ask of a stage; all its settings, if they know its kind.
pub trait Neighbour: std::fmt::Debug {
    /// Its kind's name in YAML.
    fn kind(&self) -> &'static str;
    /// The stages that it reads: field, stage, what that stage must give.
    fn inputs(&self) -> Vec<(String, String, ArtifactKind)>;
    /// The stage that it measures.
    fn evaluated_model(&self) -> Option<String>;
    /// How it draws from what it measures.
    fn sampler(&self) -> Option<&Sampler>;
    /// The values that it may give, if it is an evaluation that says so.
    fn metrics(&self) -> Option<BTreeSet<String>>;
    /// What the model that it trains can do.
    fn family(&self) -> Option<Family>;
    /// The skeleton of what it gives, if it decides that.
    fn format(&self) -> Option<DataFormat>;
    /// The shape of the latents that it gives or works on, if it decides that.
    fn latent(&self) -> Option<LatentShape>;
    /// Its settings.
    fn settings(&self) -> &dyn Any;
}

impl dyn Neighbour + '_ {
    /// The settings of kind `S`, if it is of that kind.
    pub fn get<S: 'static>(&self) -> Option<&S> {
        self.settings().downcast_ref()
    }
}

/// The stages of a pipeline by name. References are sound: they lead to stages that give the right kind, and nowhere in a circle.
#[derive(Debug)]
pub struct Neighbours<'a> {
    stages: BTreeMap<&'a str, &'a dyn Neighbour>,
    /// For each stage, the stages that it reads by what they give.
    reads: BTreeMap<&'a str, Vec<(ArtifactKind, String)>>,
    /// For each measured stage, the evaluations of it and how they draw.
    measured: BTreeMap<String, Vec<(&'a str, Option<&'a Sampler>)>>,
}

impl<'a> Neighbours<'a> {
    pub(crate) fn new(stages: impl Iterator<Item = (&'a StageName, &'a dyn Neighbour)>) -> Self {
        let stages: BTreeMap<&str, &dyn Neighbour> = stages.map(|(name, settings)| (name.as_str(), settings)).collect();
        let read = |settings: &dyn Neighbour| -> Vec<(ArtifactKind, String)> {
            // What a training begins with says nothing of what it gives.
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

    /// The stage of that name.
    pub fn stage(&self, name: &str) -> Option<&'a dyn Neighbour> {
        self.stages.get(name).copied()
    }

    /// The first stage giving `kind` that stage `name` reads.
    pub fn read_by(&self, name: &str, kind: ArtifactKind) -> Option<&str> {
        self.reads.get(name)?.iter().find(|(found, _)| *found == kind).map(|(_, stage)| stage.as_str())
    }

    /// Which VAE the latents were encoded with.
    pub fn vae_of_latents(&self, latents: &str) -> Option<&str> {
        self.read_by(latents, ArtifactKind::Vae)
    }

    /// Which VAE made the latents that a model was trained on.
    pub fn vae_of_model(&self, model: &str) -> Option<&str> {
        let of_latents = |name: &str| self.vae_of_latents(self.read_by(name, ArtifactKind::Latents)?);
        // What is imported reads no latents.
        self.of_model(model, &|name| of_latents(name).or_else(|| self.read_by(name, ArtifactKind::Vae)))
    }

    /// What a model can do.
    pub fn family(&self, model: &str) -> Option<Family> {
        self.of_model(model, &|name| self.stage(name)?.family())
    }

    /// What `own` says of the stage that trained `model`. A stage that only passes models on, such as `register`, is asked for what all of
    /// those have in common.
    fn of_model<T: PartialEq>(&self, model: &str, own: &dyn Fn(&str) -> Option<T>) -> Option<T> {
        if let Some(found) = own(model) {
            return Some(found);
        }
        let models = self.reads.get(model)?.iter().filter(|(kind, _)| *kind == ArtifactKind::Model);
        let mut all = models.map(|(_, stage)| self.of_model(stage, own));
        let first = all.next()??;
        all.all(|other| other.as_ref() == Some(&first)).then_some(first)
    }

    /// The clips behind latents or caption embeddings.
    pub fn dataset_of(&self, name: &str) -> Option<&str> {
        self.read_by(name, ArtifactKind::Dataset)
    }

    /// The skeleton of a dataset, of a model's motions, or the one that an evaluator is for.
    pub fn format(&self, name: &str) -> Option<DataFormat> {
        self.stage(name)?.format().or_else(|| {
            let of = |kind| self.read_by(name, kind);
            let tokens = || of(ArtifactKind::Tokens).or_else(|| of(ArtifactKind::Model));
            let tokenizer = || of(ArtifactKind::Tokenizer);
            let from = self.dataset_of(name).or_else(|| self.vae_of_model(name)).or_else(tokens).or_else(tokenizer)?;
            if from == name { None } else { self.format(from) }
        })
    }

    /// The shape of a VAE's latents.
    pub fn latent(&self, vae: &str) -> Option<LatentShape> {
        self.stage(vae)?.latent()
    }

    /// Whether an evaluation measures stage `name`.
    pub fn measures(&self, name: &str) -> bool {
        self.measured.contains_key(name)
    }

    /// The evaluations of the pipeline that draw from stage `name`, and how. What evaluates a sweep's trials is none of them: it has a dot
    /// in its name, which no name of a user's has.
    pub fn samplers_of(&self, name: &str) -> impl Iterator<Item = (&'a str, &'a Sampler)> {
        let all = self.measured.get(name).into_iter().flatten().filter(|(evaluation, _)| !evaluation.contains('.'));
        all.filter_map(|(evaluation, sampler)| Some((*evaluation, (*sampler)?)))
    }

    /// The metrics that a version of stage `name` may have: those of the evaluations that measure it, each also behind its evaluation's name
    /// where there are several. `None` if nothing measures it, or an evaluation does not say what it gives.
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

    /// Refuses latents of another VAE than `vae`, which `field` stands for.
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
                    "`{field}` works on latents of `{vae}`{shape}, but `{latents}` was encoded with `{other}`{other_shape}"
                )
            };
            p.add(field, message, "latents of another VAE mean other motions; name the same VAE in both places");
        }
    }

    /// Refuses captions of other clips than those of `latents`.
    pub(crate) fn same_data(&self, p: &mut Problems, latents: &str, text: &str) {
        if let (Some(data), Some(other)) = (self.dataset_of(latents), self.dataset_of(text))
            && data != other
        {
            let message = format!("`{text}` embeds the captions of `{other}`, but `{latents}` are of `{data}`");
            p.add("text", message, &format!("add a `text.embed` stage with `dataset: {data}`"));
        }
    }

    /// Refuses clips other than those that `latents` were encoded from.
    pub(crate) fn same_clips(&self, p: &mut Problems, dataset: &str, latents: &str) {
        if let Some(data) = self.dataset_of(latents)
            && data != dataset
        {
            let message = format!("`{latents}` are of the clips of `{data}`, but `dataset` is `{dataset}`");
            p.add("dataset", message, &format!("write `dataset: {data}`"));
        }
    }

    /// Refuses clips of another skeleton than what stage `name`, which `field` names, is for.
    pub(crate) fn same_skeleton(&self, p: &mut Problems, (field, name): (&str, &str), dataset: &str) {
        if let (Some(ours), Some(theirs)) = (self.format(dataset), self.format(name))
            && ours != theirs
        {
            let message = format!(
                "`{name}` is for skeletons of {}, but the clips of `{dataset}` have {}",
                theirs.skeleton(),
                ours.skeleton()
            );
            p.add(field, message, "features of one skeleton mean nothing on another; name stages of one data set");
        }
    }

    /// Refuses a flow decoder of other tokens than those of `encoder`, or of other latents; `field` names the stage `name` that gives it.
    pub(crate) fn same_codes(&self, p: &mut Problems, (field, name): (&str, &str), encoder: &str) {
        let decoded = |kind| self.read_by(name, kind).filter(|other| *other != encoder);
        if let Some(other) = decoded(ArtifactKind::Tokenizer) {
            let message = format!("`{name}` reads the codes of `{other}`, but what it is to decode is of `{encoder}`");
            p.add(field, message, "tokens of another codebook mean other motions; train both on one tokenizer");
        } else if let Some(other) = decoded(ArtifactKind::Vae) {
            let message =
                format!("`{name}` reads the latents of `{other}`, but what it is to decode is of `{encoder}`");
            p.add(field, message, "latents of another VAE mean other motions; train both on one VAE");
        }
    }

    /// Refuses captions of other clips than those of `dataset`.
    pub(crate) fn same_captions(&self, p: &mut Problems, text: &str, dataset: &str) {
        if let Some(data) = self.dataset_of(text)
            && data != dataset
        {
            let message = format!("`{text}` embeds the captions of `{data}`, but the clips are of `{dataset}`");
            p.add("text", message, &format!("add a `text.embed` stage with `dataset: {dataset}`"));
        }
    }

    /// The evaluator against whose embeddings a model was trained, if there is one.
    pub(crate) fn evaluator_of_model(&self, model: &str) -> Option<&str> {
        self.of_model(model, &|name| self.read_by(name, ArtifactKind::Evaluator))
    }

    /// Which tokenizer's codes a model draws.
    pub(crate) fn tokenizer_of_model(&self, model: &str) -> Option<&str> {
        self.of_model(model, &|name| self.read_by(name, ArtifactKind::Tokenizer))
    }

    /// Refuses anything but a latent teacher where one is needed.
    pub(crate) fn is_teacher(&self, p: &mut Problems, teacher: &str) {
        let (Some(settings), Some(family)) = (self.stage(teacher), self.family(teacher)) else { return };
        let (what, why) = match family {
            Family::Mld => return,
            Family::Lcm { .. } | Family::Pcm { .. } => {
                ("a student", "a student has guidance built in, and cannot be asked without it")
            }
            Family::Autoregressive | Family::Masked | Family::Mmm | Family::Features { .. } => {
                ("no latent diffusion", "only such a model gives latents to learn from")
            }
        };
        let kind = settings.kind();
        let message = format!("`{teacher}` is {what} ({kind}), but `teacher` needs a `train.mld` stage");
        p.add("teacher", message, why);
    }

    /// Refuses steps and timesteps that the model does not have.
    pub(crate) fn check_sampler(&self, p: &mut Problems, model: &str, sampler: &Sampler) {
        if let Some(family) = self.family(model) {
            family.check(&format!("`{model}`"), sampler, p);
        }
    }
}
