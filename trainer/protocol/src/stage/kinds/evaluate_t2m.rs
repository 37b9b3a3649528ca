//! `evaluate.t2m`: the papers' metrics, in an evaluator's space. Source: text-to-motion (Guo et al., CVPR 2022) and
//! later papers.

use std::collections::BTreeSet;

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use crate::stage::{Family, Neighbours, Output, PHYSICS, Problems, Ref, Sampler, Shape, Split, StageSpec};
use crate::{ArtifactKind, limits};

/// Variety of the motions of one caption. Published: 100 captions, 30 motions each, 10 pairs.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(default)]
pub struct MultiModality {
    /// Number of captions per repeat; 0 leaves the metric out.
    #[schemars(range(min = 0, max = 1_000), extend("x-unit" = "captions"))]
    pub captions: usize,
    /// Number of motions per caption.
    #[schemars(range(min = 0, max = 1_000), extend("x-unit" = "samples of a caption"))]
    pub samples: usize,
    /// Number of compared pairs per caption.
    #[schemars(range(min = 0, max = 1_000), extend("x-unit" = "pairs of a caption"))]
    pub pairs: usize,
}

impl Default for MultiModality {
    fn default() -> Self {
        Self { captions: 100, samples: 30, pairs: 10 }
    }
}

/// `evaluate.t2m`: the papers' metrics, in an evaluator's space.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default)]
pub struct EvaluateT2m {
    /// Stage that gives the model.
    pub model: String,
    /// Stage that gives a VAE whose reconstructions, of a sample of the posterior, are measured instead of a model's
    /// motions; empty for a model.
    pub vae: String,
    /// Stage that gives a tokenizer whose reconstructions are measured instead; empty for a model.
    pub tokenizer: String,
    /// Stage that gives the flow decoder for the tokenizer's tokens; empty uses the tokenizer's own decoder.
    pub decoder: String,
    /// Stage that gives the clips.
    pub dataset: String,
    /// Stage that gives the evaluator.
    pub evaluator: String,
    /// Stage that gives a length estimator, which draws the length of a motion for its caption. Empty uses the length
    /// of the caption's crop, as in the latent models' papers.
    pub length: String,
    /// Measures real motion against itself with other crops; no model is read.
    pub real: bool,
    /// Control experiment: assigns captions to motions at random, so that retrieval is at chance level.
    pub shuffled: bool,
    /// Probability that a word of the model's caption is replaced by another of the same meaning, from a table of ours;
    /// the evaluator reads the original caption. 0 changes nothing.
    #[schemars(range(min = 0.0, max = 1.0), extend("x-unit" = "of the words"))]
    pub perturbed: f64,
    /// Gives the model the fifth field of the caption's line in `texts/`, as in SATO's files; the evaluator reads the
    /// original caption. Each caption needs one.
    pub perturbed_texts: bool,
    /// Sampler for the model.
    pub sampler: Sampler,
    /// Number of repeats with other noise, captions, crops and pools.
    #[schemars(range(min = 1, max = 100), extend("x-unit" = "repeats"))]
    pub repeats: usize,
    /// Sizes of the pools in which a caption's own motion is ranked. R-precision and MM-Dist use the first; metrics of
    /// the others have the suffix `_poolN`.
    #[schemars(inner(range(min = 4, max = 4_096)), extend("x-unit" = "motions"))]
    pub pools: Vec<usize>,
    /// Leaves out of every metric but MultiModality the clips that do not fill a pool of the first size, as loaders
    /// that drop the last batch do. These clips are drawn again in each repeat. Otherwise only R-precision and MM-Dist
    /// leave them out.
    pub drop_last: bool,
    /// Numbers of captions, samples and pairs for the MultiModality metric.
    pub multimodality: MultiModality,
    /// Split of the clips. Choose on `val`; keep `test` for the final result.
    pub split: Split,
    /// Uses all clips if the split has fewer than the largest pool, and reports it; otherwise so small a split is
    /// refused.
    pub all_if_small: bool,
    /// Number of shards.
    #[schemars(range(min = 1, max = crate::limits::SHARDS), extend("x-unit" = "shards"))]
    pub shards: usize,
}

impl Default for EvaluateT2m {
    fn default() -> Self {
        Self {
            model: "mld".into(),
            vae: String::new(),
            tokenizer: String::new(),
            decoder: String::new(),
            dataset: "dataset".into(),
            evaluator: "evaluator".into(),
            length: String::new(),
            real: false,
            shuffled: false,
            perturbed: 0.0,
            perturbed_texts: false,
            sampler: Sampler::default(),
            repeats: 20,
            pools: vec![32],
            drop_last: false,
            multimodality: MultiModality::default(),
            split: Split::Val,
            all_if_small: false,
            shards: 8,
        }
    }
}

impl EvaluateT2m {
    /// Returns true if a model's motions are measured, not real ones or their reconstructions.
    pub fn generates(&self) -> bool {
        !self.real && !self.reconstructs()
    }

    /// Returns true if reconstructions of real motion by a VAE or a tokenizer are measured.
    pub fn reconstructs(&self) -> bool {
        !self.vae.is_empty() || !self.tokenizer.is_empty()
    }

    /// Size of the pool of the metrics without a suffix.
    pub fn first_pool(&self) -> usize {
        self.pools.first().copied().unwrap_or(1)
    }

    /// Size of the largest pool, which needs the most entries.
    pub fn largest_pool(&self) -> usize {
        self.pools.iter().copied().max().unwrap_or(1)
    }
}

impl StageSpec for EvaluateT2m {
    const KIND: &'static str = "evaluate.t2m";
    // Version 2 reports the measured model and its sampler. Version 3 adds pools, `drop_last`, drawn lengths,
    // reconstructions.
    const VERSION: u32 = 6;
    const SHAPE: Shape = Shape::Map;
    const OUTPUT: Output = Output { name: "report", kind: ArtifactKind::Report };

    fn refs(&mut self) -> Vec<Ref<'_>> {
        let generated = self.generates();
        let flows = !self.tokenizer.is_empty();
        vec![
            Ref::stage("dataset", &mut self.dataset, ArtifactKind::Dataset),
            Ref::stage("evaluator", &mut self.evaluator, ArtifactKind::Evaluator),
            Ref::stage("model", &mut self.model, ArtifactKind::Model)
                .only_if(generated)
                // Metrics with shuffled or perturbed captions do not describe the model, so it is not registered with
                // them.
                .measured_if(generated && !self.shuffled && self.perturbed == 0.0 && !self.perturbed_texts),
            Ref::stage("length", &mut self.length, ArtifactKind::Length).optional().only_if(generated),
            Ref::stage("vae", &mut self.vae, ArtifactKind::Vae).optional(),
            Ref::stage("tokenizer", &mut self.tokenizer, ArtifactKind::Tokenizer).optional(),
            Ref::stage("decoder", &mut self.decoder, ArtifactKind::FlowDecoder).optional().only_if(flows),
        ]
    }

    fn check(&self, p: &mut Problems) {
        if self.generates() {
            self.sampler.check(p);
        } else if !self.length.is_empty() {
            let message = "`length` sets the length of a model's motions, but no model is measured";
            p.add("length", message, "remove it");
        }
        self.check_subject(p);
        for (key, set) in [("perturbed", self.perturbed > 0.0), ("perturbed_texts", self.perturbed_texts)] {
            if set && !self.generates() {
                let message = format!("`{key}` changes the captions of a model, but no model is measured");
                p.add(key, message, "remove it");
            }
        }
        if self.perturbed > 0.0 && self.perturbed_texts {
            let message = "`perturbed` changes words of the captions, but `perturbed_texts` takes others";
            p.add("perturbed", message, "remove one of them");
        }
        if self.pools.is_empty() {
            p.add(
                "pools",
                "`pools` is empty; expected the number of motions that are ranked for a caption",
                "for example [32]",
            );
        }
        if let Some((i, pool)) = self.pools.iter().enumerate().find(|(i, pool)| self.pools[..*i].contains(pool)) {
            p.add("pools", format!("`pools` has {pool} twice; remove entry {}", i + 1), "");
        }
        let MultiModality { captions, samples, pairs } = self.multimodality;
        p.product(
            "multimodality.samples",
            &[("repeats", self.repeats), ("multimodality.captions", captions), ("multimodality.samples", samples)],
            limits::EVALUATED_MOTIONS,
        );
        if captions > 0 && !(1..=samples).contains(&pairs) {
            let message = format!("`multimodality.pairs` is {pairs}; expected 1 to {samples}, the value of `samples`");
            p.add("multimodality.pairs", message, "");
        }
    }

    fn check_neighbours(&self, stages: &Neighbours<'_>, p: &mut Problems) {
        let evaluator = &self.evaluator;
        let dataset = &self.dataset;
        if let (Some(ours), Some(theirs)) = (stages.format(dataset), stages.format(evaluator))
            && ours != theirs
        {
            let message = format!(
                "`{evaluator}` is an evaluator for skeletons of {}, but the clips of `{dataset}` have {}",
                theirs.skeleton(),
                ours.skeleton()
            );
            p.add("evaluator", message, &format!("add a `train.evaluator` stage with `dataset: {dataset}`"));
        }
        for (field, stage) in [("vae", &self.vae), ("tokenizer", &self.tokenizer), ("length", &self.length)] {
            stages.same_skeleton(p, (field, stage), dataset);
        }
        if !self.tokenizer.is_empty() && !self.decoder.is_empty() {
            stages.same_codes(p, ("decoder", &self.decoder), &self.tokenizer);
        }
        if !self.generates() {
            return;
        }
        let model = &self.model;
        if stages.evaluator_of_model(model) == Some(evaluator) {
            let message =
                format!("`{evaluator}` was part of the training loss of `{model}`, so its metrics would be biased");
            p.add("evaluator", message, "train a second evaluator and measure with that one");
        }
        if let (Some(ours), Some(theirs)) = (stages.format(dataset), stages.format(model))
            && ours != theirs
        {
            let message = format!(
                "`{model}` generates motions of {}, but the clips of `{dataset}` have {}",
                theirs.skeleton(),
                ours.skeleton()
            );
            p.add("model", message, "use a dataset in the model's format");
        }
        if !self.length.is_empty() && stages.family(model) == Some(Family::Autoregressive) {
            let message =
                format!("`{model}` decides the length of a motion itself, so `{}` has no effect", self.length);
            p.add("length", message, "remove it");
        }
        stages.check_sampler(p, model, &self.sampler);
    }

    fn sampler(&self) -> Option<&Sampler> {
        self.generates().then_some(&self.sampler)
    }

    fn shards(&self) -> usize {
        self.shards
    }

    fn metrics(&self) -> Option<BTreeSet<String>> {
        let mut names: Vec<String> = ["fid", "diversity"].into_iter().chain(PHYSICS).map(str::to_owned).collect();
        for (i, pool) in self.pools.iter().enumerate() {
            let suffix = if i == 0 { String::new() } else { format!("_pool{pool}") };
            let retrieval = ["r_precision_top1", "r_precision_top2", "r_precision_top3", "mm_dist"];
            names.extend(retrieval.map(|name| format!("{name}{suffix}")));
        }
        if self.real {
            names.push("fid_halves".into());
        }
        if self.generates() && self.multimodality.captions > 0 {
            names.push("multimodality".into());
        }
        let ends = |name: &String| [name.clone(), format!("{name}.lower"), format!("{name}.upper")];
        Some(names.iter().flat_map(ends).chain(["samples".to_owned()]).collect())
    }
}

impl EvaluateT2m {
    /// Checks that exactly one subject is measured.
    fn check_subject(&self, p: &mut Problems) {
        if self.real && self.reconstructs() {
            let field = if self.vae.is_empty() { "tokenizer" } else { "vae" };
            let message = format!(
                "`real` measures clips, but `{field}` measures reconstructions of clips; expected only one of the two"
            );
            p.add(field, message, "use one stage for each");
        }
        if !self.vae.is_empty() && !self.tokenizer.is_empty() {
            let message = "`vae` and `tokenizer` are both set; expected only one of them";
            p.add("tokenizer", message, "use one stage for each");
        }
        if self.tokenizer.is_empty() && !self.decoder.is_empty() {
            p.add("decoder", "`decoder` is set, but `tokenizer` is missing; expected both", "");
        }
    }
}
