//! Settings of the stages around the text-motion evaluator.

use serde::{Deserialize, Serialize};

use super::{Batch, DataFormat, Decay, Optimizer, Sampler, Split, Training};
use crate::Steps;

/// An evaluator's size. The published one: 512, 1024, 512, 512, dropout 0.2.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default)]
pub struct EvaluatorNetwork {
    /// Width of a movement, and between the two convolutions that make it.
    pub movement: usize,
    /// Width of the GRU over movements.
    pub motion: usize,
    /// Width of the GRU over words.
    pub text: usize,
    /// Width of an embedding.
    pub embedding: usize,
    /// Dropout probability in the movement encoder, first phase only.
    pub dropout: f64,
}

impl Default for EvaluatorNetwork {
    fn default() -> Self {
        Self { movement: 512, motion: 1024, text: 512, embedding: 512, dropout: 0.2 }
    }
}

/// The first phase: movements learn to hold their frames.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default)]
pub struct MovementPhase {
    /// Share of the steps that it takes.
    pub until: f64,
    /// Frames of an example.
    pub window: usize,
    /// Examples per update; 0 keeps `batch.global`.
    pub batch: usize,
    /// Weight of the mean size of movements.
    pub sparsity: f64,
    /// Weight of the mean difference of neighbouring movements.
    pub smoothness: f64,
}

impl Default for MovementPhase {
    fn default() -> Self {
        Self { until: 0.3, window: 40, batch: 128, sparsity: 1e-3, smoothness: 1e-3 }
    }
}

/// `train.evaluator`. Source: text-to-motion (Guo et al., CVPR 2022).
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default)]
pub struct TrainEvaluator {
    /// Stage that gives the clips.
    pub dataset: String,
    /// Folder with the published word vectors (`our_vab_data.npy`, `our_vab_words.pkl`, `our_vab_idx.pkl`); empty takes the built-in
    /// hashed ones. Not part of the key: the content's digest is.
    pub words: String,
    /// Size.
    pub network: EvaluatorNetwork,
    /// The first phase.
    pub movement: MovementPhase,
    /// The deviations of root and contacts are divided by this, so that the evaluator looks at them more closely. The published
    /// files come to 25.
    pub emphasis: f64,
    /// Captions and motions that do not belong together are pushed this far apart.
    pub margin: f64,
    /// Moving average of the weights that is kept as the result; 0 keeps the weights themselves.
    pub ema: f64,
    /// The rest. Gradients are clipped for each of the networks by itself.
    #[serde(flatten)]
    pub training: Training,
}

impl Default for TrainEvaluator {
    fn default() -> Self {
        Self {
            dataset: "dataset".into(),
            words: String::new(),
            network: EvaluatorNetwork::default(),
            movement: MovementPhase::default(),
            emphasis: 25.0,
            margin: 10.0,
            ema: 0.0,
            training: Training {
                steps: Steps(300_000),
                batch: Batch { global: 32, slices: 1 },
                lr: 1e-4,
                warmup: Steps(0),
                decay: Decay::Constant,
                optimizer: Optimizer::default(),
                max_grad_norm: 0.5,
                stop: None,
            },
        }
    }
}

/// `import.evaluator`: the published files.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default)]
pub struct ImportEvaluator {
    /// Folder in the published layout: `text_mot_match/model/finest.tar` (or `finest.safetensors`) and, where there are several, the one
    /// folder `Comp_*/meta` with `mean.npy` and `std.npy`. Not part of the key: the content's digest is.
    pub path: String,
    /// What it was trained on.
    pub format: DataFormat,
    /// Folder with the word vectors that it was trained with; empty takes the built-in ones, for an evaluator of our own.
    pub words: String,
}

impl Default for ImportEvaluator {
    fn default() -> Self {
        Self { path: String::new(), format: DataFormat::Humanml3d, words: String::new() }
    }
}

/// How different the motions of one caption are.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
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
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default)]
pub struct EvaluateT2m {
    /// Stage that gives the denoiser.
    pub model: String,
    /// Stage that gives its VAE.
    pub vae: String,
    /// Stage that gives the clips.
    pub dataset: String,
    /// Stage that gives the caption embeddings.
    pub text: String,
    /// Stage that gives the evaluator.
    pub evaluator: String,
    /// Measures real motion, against itself with other crops; no model is read.
    pub real: bool,
    /// The control: captions are dealt to motions at random, so that retrieval is left to chance.
    pub shuffled: bool,
    /// Sampler.
    pub sampler: Sampler,
    /// Repeats with other noise, captions, crops and pools.
    pub repeats: usize,
    /// MultiModality.
    pub multimodality: MultiModality,
    /// Clips. Choose on `val`; `test` is for the last look.
    pub split: Split,
    /// Takes all clips where the split has fewer than a pool of 32, and says so in the report; otherwise that is refused.
    pub widen: bool,
    /// Shards.
    pub shards: usize,
}

impl Default for EvaluateT2m {
    fn default() -> Self {
        Self {
            model: "mld".into(),
            vae: "vae".into(),
            dataset: "dataset".into(),
            text: "text".into(),
            evaluator: "evaluator".into(),
            real: false,
            shuffled: false,
            sampler: Sampler::default(),
            repeats: 20,
            multimodality: MultiModality::default(),
            split: Split::Val,
            widen: false,
            shards: 8,
        }
    }
}
