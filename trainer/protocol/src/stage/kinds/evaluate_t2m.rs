//! `evaluate.t2m`: the papers' metrics, in an evaluator's space. Source: text-to-motion (Guo et al., CVPR 2022) and all after it.

use std::collections::BTreeSet;

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use crate::stage::{Family, Neighbours, Output, Problems, Ref, Sampler, Shape, Split, StageSpec};
use crate::{ArtifactKind, limits};

/// How different the motions of one caption are. Published: 100 captions, 30 motions each, 10 pairs.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(default)]
pub struct MultiModality {
    /// Captions per repeat; 0 leaves the metric out.
    pub captions: usize,
    /// Motions per caption.
    pub samples: usize,
    /// Pairs compared per caption.
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
    /// Stage that gives a VAE whose reconstructions, of a sample of the posterior, are measured instead of a model's motions; none if empty.
    pub vae: String,
    /// Stage that gives a tokenizer whose reconstructions are measured instead; none if empty.
    pub tokenizer: String,
    /// Stage that gives the flow decoder that decodes the tokenizer's tokens; the tokenizer's own if empty.
    pub decoder: String,
    /// Stage that gives the clips.
    pub dataset: String,
    /// Stage that gives the evaluator.
    pub evaluator: String,
    /// Stage that gives a length estimator: a motion is as long as it draws for the caption. Without one it is as long as the caption's crop, as
    /// in the latent models' papers.
    pub length: String,
    /// Measures real motion, against itself with other crops; no model is read.
    pub real: bool,
    /// The control: captions are dealt to motions at random, so that retrieval is left to chance.
    pub shuffled: bool,
    /// Probability that a word of what the model is told is exchanged for another of its meaning, of a table of ours; the evaluator reads the
    /// caption itself. 0 tells it the caption.
    pub perturbed: f64,
    /// Sampler.
    pub sampler: Sampler,
    /// Repeats with other noise, captions, crops and pools.
    pub repeats: usize,
    /// Motions that a caption's own is ranked among. R-precision and MM-Dist are of the first; those of the others have `_poolN` behind
    /// their names.
    pub pools: Vec<usize>,
    /// Leaves out of every metric but MultiModality what does not fill a pool of the first size, as loaders that drop the last batch do:
    /// which clips these are is drawn anew in each repeat. Otherwise R-precision and MM-Dist alone leave them out.
    pub drop_last: bool,
    /// MultiModality.
    pub multimodality: MultiModality,
    /// Clips. Choose on `val`; `test` is for the last look.
    pub split: Split,
    /// Takes all clips where the split has fewer than the largest pool, and says so in the report; otherwise so small a split is refused.
    pub all_if_small: bool,
    /// Shards.
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
    /// Whether a model's motions are measured, not real ones or reconstructions of such.
    pub fn generates(&self) -> bool {
        !self.real && !self.reconstructs()
    }

    /// Whether what a VAE or a tokenizer makes of real motion is measured.
    pub fn reconstructs(&self) -> bool {
        !self.vae.is_empty() || !self.tokenizer.is_empty()
    }

    /// The pool of the metrics without a suffix.
    pub fn first_pool(&self) -> usize {
        self.pools.first().copied().unwrap_or(1)
    }

    /// The pool that needs the most entries.
    pub fn largest_pool(&self) -> usize {
        self.pools.iter().copied().max().unwrap_or(1)
    }
}

impl StageSpec for EvaluateT2m {
    const KIND: &'static str = "evaluate.t2m";
    // 2: says which model it measured, and how that was drawn. 3: pools, `drop_last`, drawn lengths, reconstructions.
    const VERSION: u32 = 3;
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
                // Shuffled captions say nothing of the model, and others than its own not what it is registered with.
                .measured_if(generated && !self.shuffled && self.perturbed == 0.0),
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
            let message = "`length` says how long a model's motions are, but no model is measured";
            p.add("length", message, "leave it out");
        }
        self.check_subject(p);
        if self.perturbed > 0.0 && !self.generates() {
            let message = "`perturbed` changes what a model is told, but no model is measured";
            p.add("perturbed", message, "leave it out");
        }
        p.positive("repeats", self.repeats);
        if self.pools.is_empty() {
            p.add(
                "pools",
                "`pools` is empty; expected how many motions a caption's own is ranked among",
                "such as [32]",
            );
        }
        if let Some((i, pool)) = self.pools.iter().enumerate().find(|(i, pool)| self.pools[..*i].contains(pool)) {
            p.add("pools", format!("`pools` has {pool} twice, the second time at place {}", i + 1), "");
        }
        p.shards(self.shards);
        let MultiModality { captions, samples, pairs } = self.multimodality;
        p.product(
            "multimodality.samples",
            &[("repeats", self.repeats), ("multimodality.captions", captions), ("multimodality.samples", samples)],
            limits::EVALUATED_MOTIONS,
        );
        if captions > 0 && !(1..=samples).contains(&pairs) {
            let message = format!("`multimodality.pairs` is {pairs}; expected 1 to `samples`, {samples}");
            p.add("multimodality.pairs", message, "");
        }
    }

    fn check_neighbours(&self, stages: &Neighbours<'_>, p: &mut Problems) {
        let (evaluator, dataset) = (&self.evaluator, &self.dataset);
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
                format!("`{model}` was trained to agree with `{evaluator}`, so that its metrics would flatter it");
            p.add("evaluator", message, "train another evaluator, under another name, to measure with");
        }
        if let (Some(ours), Some(theirs)) = (stages.format(dataset), stages.format(model))
            && ours != theirs
        {
            let message = format!(
                "`{model}` makes motions of {}, but the clips of `{dataset}` have {}",
                theirs.skeleton(),
                ours.skeleton()
            );
            p.add("model", message, "measure a model on the format that it was trained on");
        }
        if !self.length.is_empty() && stages.family(model) == Some(Family::Autoregressive) {
            let message = format!("`{model}` decides itself how long a motion is, so `{}` is not asked", self.length);
            p.add("length", message, "leave it out");
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
        let mut names: Vec<String> = ["fid", "diversity", "skating_ratio"].map(str::to_owned).into();
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
    /// One thing is measured.
    fn check_subject(&self, p: &mut Problems) {
        if self.real && self.reconstructs() {
            let field = if self.vae.is_empty() { "tokenizer" } else { "vae" };
            let message = format!(
                "`real` measures the clips themselves, `{field}` what it makes of them; expected one of the two"
            );
            p.add(field, message, "make a stage of each");
        }
        if !self.vae.is_empty() && !self.tokenizer.is_empty() {
            let message = "`vae` and `tokenizer` both reconstruct; expected one of them";
            p.add("tokenizer", message, "make a stage of each");
        }
        if self.tokenizer.is_empty() && !self.decoder.is_empty() {
            p.add("decoder", "`decoder` decodes tokens, but there is no `tokenizer`; expected both", "");
        }
    }
}
