//! `train.evaluator`: embeds captions and motions in one space, in which the papers' metrics are computed. Source:
//! text-to-motion (Guo et al., CVPR 2022).

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use super::import_evaluator::{VOCABULARY, WORDS_ORIGIN};
use crate::stage::{Batch, Decay, LossChange, Optimizer, Output, Problems, Ref, Replicas, Shape, StageSpec, Training};
use crate::{ArtifactKind, Steps};

/// Size of an evaluator. The published one: 512, 1024, 512, 512, dropout 0.2.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default)]
pub struct EvaluatorNetwork {
    /// Width of a movement, and between the two convolutions that compute it.
    #[schemars(range(min = 1, max = 4_096), extend("x-unit" = "channels"))]
    pub movement: usize,
    /// Width of the GRU over movements.
    #[schemars(range(min = 1, max = 4_096), extend("x-unit" = "channels"))]
    pub motion: usize,
    /// Width of the GRU over words.
    #[schemars(range(min = 1, max = 4_096), extend("x-unit" = "channels"))]
    pub text: usize,
    /// Width of an embedding.
    #[schemars(range(min = 1, max = 4_096), extend("x-unit" = "channels"))]
    pub embedding: usize,
    /// Probability of dropout in the movement encoder, first phase only.
    #[schemars(range(min = 0.0), extend("exclusiveMaximum" = 1.0))]
    pub dropout: f64,
}

impl Default for EvaluatorNetwork {
    fn default() -> Self {
        Self { movement: 512, motion: 1024, text: 512, embedding: 512, dropout: 0.2 }
    }
}

/// The first phase, which trains movements to reconstruct their frames.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default)]
pub struct MovementPhase {
    /// Share of the steps in this phase, which comes first.
    #[schemars(extend("exclusiveMinimum" = 0.0, "exclusiveMaximum" = 1.0, "x-unit" = "of the steps"))]
    pub until: f64,
    /// Frames of an example, at least two movements of four.
    #[schemars(range(min = 8, max = 10_000), extend("x-unit" = "frames"))]
    pub window: usize,
    /// Examples per update; 0 uses `batch.global`.
    #[schemars(range(min = 0, max = 65_536), extend("x-unit" = "examples"))]
    pub batch: usize,
    /// Weight of the mean absolute value of movements.
    #[schemars(range(min = 0.0, max = 1e6))]
    pub sparsity: f64,
    /// Weight of the mean difference of neighbouring movements.
    #[schemars(range(min = 0.0, max = 1e6))]
    pub smoothness: f64,
}

impl Default for MovementPhase {
    fn default() -> Self {
        Self { until: 0.3, window: 40, batch: 128, sparsity: 1e-3, smoothness: 1e-3 }
    }
}

/// `train.evaluator`: trains the text-motion evaluator. Source: text-to-motion (Guo et al., CVPR 2022).
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default)]
pub struct TrainEvaluator {
    /// Stage that gives the clips.
    pub dataset: String,
    /// Folder with the published word vectors (`our_vab_data.npy`, `our_vab_words.pkl`, `our_vab_idx.pkl`); empty uses
    /// the built-in hashed ones. The stage's key has the digest of its content, not its path.
    pub words: String,
    /// Size of the networks.
    pub network: EvaluatorNetwork,
    /// Settings of the first phase.
    pub movement: MovementPhase,
    /// Divisor of the deviations of root and contacts, which increases their weight. The published files have about 25.
    #[schemars(range(max = 1e6), extend("exclusiveMinimum" = 0.0))]
    pub emphasis: f64,
    /// Distance up to which captions and motions that do not match are separated.
    #[schemars(range(max = 1e6), extend("exclusiveMinimum" = 0.0))]
    pub margin: f64,
    /// Decay of the moving average of the weights, which is the result; 0 uses the weights themselves.
    #[schemars(range(min = 0.0), extend("exclusiveMaximum" = 1.0))]
    pub ema: f64,
    /// Stage or version, such as `motionlcm@prod`, whose evaluator supplies initial weights where shapes fit; empty
    /// starts from random ones.
    #[serde(skip_serializing_if = "String::is_empty")]
    pub init: String,
    /// Batch, schedule and optimizer. Gradients of each network are clipped separately.
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
            init: String::new(),
            training: Training {
                steps: Steps(300_000),
                batch: Batch { global: 32, slices: 1 },
                lr: 1e-4,
                warmup: Steps(0),
                decay: Decay::Constant,
                optimizer: Optimizer::default(),
                max_grad_norm: 0.5,
                sync: Replicas::default(),
                stop: None,
            },
        }
    }
}

impl StageSpec for TrainEvaluator {
    const KIND: &'static str = "train.evaluator";
    const VERSION: u32 = 4;
    const SHAPE: Shape = Shape::Gang;
    const OUTPUT: Output = Output { name: "evaluator", kind: ArtifactKind::Evaluator };

    fn refs(&mut self) -> Vec<Ref<'_>> {
        vec![
            Ref::stage("dataset", &mut self.dataset, ArtifactKind::Dataset),
            Ref::folder("words", &mut self.words).holding(&VOCABULARY, WORDS_ORIGIN),
            Ref::init(&mut self.init, ArtifactKind::Evaluator, ArtifactKind::Evaluator),
        ]
    }

    fn check(&self, p: &mut Problems) {
        self.movement.check(p, self.training.batch.slices);
        self.training.check(p);
        let batch = self.training.batch;
        if batch.slices > 0 && batch.global / batch.slices < 2 {
            let message =
                format!("a batch of {} in {} slices has fewer than two captions per slice", batch.global, batch.slices);
            p.add("batch.slices", message, "the loss compares captions within a slice; use fewer slices");
        }
    }

    fn training(&mut self) -> Option<&mut Training> {
        Some(&mut self.training)
    }

    fn recorded(&self) -> &'static [&'static str] {
        &["loss", "reconstruction", "positive", "negative"]
    }

    fn loss_changes(&self) -> Vec<LossChange> {
        let what = "the movement phase has ended; the loss now matches captions and motions";
        LossChange::behind(self.movement.until, self.training.steps, what, "movement.until").into_iter().collect()
    }
}

impl MovementPhase {
    fn check(&self, p: &mut Problems, slices: usize) {
        if self.batch != 0 {
            Batch { global: self.batch, slices }.check_division(p, "movement.batch");
        }
    }
}
