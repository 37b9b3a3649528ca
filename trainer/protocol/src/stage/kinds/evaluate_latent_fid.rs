//! `evaluate.latent_fid`: a model measured in its own latent space, without an evaluator. Source: ours.

use std::collections::BTreeSet;

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use crate::ArtifactKind;
use crate::stage::{Family, Neighbours, Output, Problems, Ref, Sampler, Shape, Split, StageSpec};

/// `evaluate.latent_fid`: Frechet distance between sampled and real latents, as a share of the real variance.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default)]
pub struct EvaluateLatentFid {
    /// Stage that gives the model, which must generate latents.
    pub model: String,
    /// Stage that gives the latents.
    pub latents: String,
    /// Stage that gives the clips of the latents; captions are drawn from them.
    pub dataset: String,
    /// Stage that gives the teacher for `match`, which compares with its 50-step samples; empty leaves `match` out.
    pub teacher: String,
    /// Sampler for the model.
    pub sampler: Sampler,
    /// Number of repeats with other noise.
    #[schemars(range(min = 1, max = 100), extend("x-unit" = "repeats"))]
    pub repeats: usize,
    /// Number of samples per entry and repeat.
    #[schemars(range(min = 1, max = 100), extend("x-unit" = "samples of an entry"))]
    pub samples: usize,
    /// Number of principal components of the train latents in which distances are computed.
    #[schemars(range(min = 1, max = 4_096), extend("x-unit" = "components"))]
    pub components: usize,
    /// Split of the real clips. With `all`, each split also has its own values (`latent_fid_val`), if it has enough
    /// entries. The distance of real latents to real ones accompanies each value: `_floor`, `_halves`. It is large on
    /// small sets.
    pub split: Split,
    /// Number of shards.
    #[schemars(range(min = 1, max = crate::limits::SHARDS), extend("x-unit" = "shards"))]
    pub shards: usize,
}

impl Default for EvaluateLatentFid {
    fn default() -> Self {
        Self {
            model: "mld".into(),
            latents: "latents".into(),
            dataset: "dataset".into(),
            teacher: String::new(),
            sampler: Sampler::default(),
            repeats: 5,
            samples: 2,
            components: 32,
            split: Split::Val,
            shards: 5,
        }
    }
}

impl StageSpec for EvaluateLatentFid {
    const KIND: &'static str = "evaluate.latent_fid";
    // Version 2 renames retrieval among latents. Version 3 compares captions by their words, not by their vectors.
    // Version 4 adds each split besides `all`, and halves.
    const VERSION: u32 = 6;
    const SHAPE: Shape = Shape::Map;
    const OUTPUT: Output = Output { name: "report", kind: ArtifactKind::Report };

    fn refs(&mut self) -> Vec<Ref<'_>> {
        vec![
            Ref::stage("model", &mut self.model, ArtifactKind::Model).measured_if(true),
            Ref::stage("latents", &mut self.latents, ArtifactKind::Latents),
            Ref::stage("dataset", &mut self.dataset, ArtifactKind::Dataset),
            Ref::stage("teacher", &mut self.teacher, ArtifactKind::Model).optional(),
        ]
    }

    fn check(&self, p: &mut Problems) {
        self.sampler.check(p);
        p.product("samples", &[("repeats", self.repeats), ("samples", self.samples)], 1_000);
    }

    fn check_neighbours(&self, stages: &Neighbours<'_>, p: &mut Problems) {
        stages.same_vae(p, ("model", stages.vae_of_model(&self.model)), &self.latents);
        stages.same_clips(p, &self.dataset, &self.latents);
        if !self.teacher.is_empty() {
            stages.same_vae(p, ("teacher", stages.vae_of_model(&self.teacher)), &self.latents);
            stages.is_teacher(p, &self.teacher);
        }
        if let Some(latent) = stages.vae_of_latents(&self.latents).and_then(|vae| stages.latent(vae)) {
            let size = latent.tokens.saturating_mul(latent.dim);
            if self.components > size {
                let message = format!("`components` is {}, but a latent has only {size} numbers", self.components);
                p.add("components", message, "");
            }
        }
        let without = match stages.family(&self.model) {
            Some(Family::Features { .. }) => Some("generates motion features"),
            Some(family) if family.draws_tokens() => Some("generates tokens"),
            _ => None,
        };
        if let Some(how) = without {
            let message = format!("`{}` {how} and has no latents", self.model);
            p.add("model", message, "use `evaluate.t2m`");
        }
        stages.check_sampler(p, &self.model, &self.sampler);
    }

    fn sampler(&self) -> Option<&Sampler> {
        Some(&self.sampler)
    }

    fn shards(&self) -> usize {
        self.shards
    }

    /// A split has its own values if it has enough entries.
    fn metrics(&self) -> Option<BTreeSet<String>> {
        let own = ["latent_std", "latent_std_real", "latent_r_precision_top1", "latent_r_precision_top3"];
        let mut names: BTreeSet<String> = own.map(str::to_owned).into();
        let splits: &[&str] = if self.split == Split::All { &["", "_train", "_val", "_test"] } else { &[""] };
        for split in splits {
            names.extend(["", "_floor", "_halves"].map(|suffix| format!("latent_fid{split}{suffix}")));
            names.insert(format!("latent_r_precision_top3{split}"));
            if self.repeats > 1 {
                names.insert(format!("latent_fid{split}_sd"));
            }
        }
        if !self.teacher.is_empty() {
            names.insert("match".into());
            names.extend((self.samples > 1).then(|| "match_other_noise".to_owned()));
        }
        Some(names)
    }
}
