//! `train.length`: predicts the length of a caption's motion. Source: MoMask's length estimator (Guo et al., CVPR
//! 2024).

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use crate::stage::{Batch, Decay, Neighbours, Optimizer, Output, Problems, Ref, Replicas, Shape, StageSpec, Training};
use crate::{ArtifactKind, Steps};

/// `train.length`: estimates the length of a motion from its caption.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default)]
pub struct TrainLength {
    /// Stage that gives the clips, whose lengths are learned.
    pub dataset: String,
    /// Stage that gives the caption embeddings.
    pub text: String,
    /// Probability of dropout before the second and the third layer.
    #[schemars(range(min = 0.0), extend("exclusiveMaximum" = 1.0))]
    pub dropout: f64,
    /// Stage or version, such as `motionlcm@prod`, whose length estimator supplies initial weights where shapes fit;
    /// empty starts from random ones.
    #[serde(skip_serializing_if = "String::is_empty")]
    pub init: String,
    /// Batch, schedule and optimizer. Published: 300 epochs of HumanML3D with batches of 64.
    #[serde(flatten)]
    pub training: Training,
}

impl Default for TrainLength {
    fn default() -> Self {
        Self {
            dataset: "dataset".into(),
            text: "text".into(),
            dropout: 0.2,
            init: String::new(),
            training: Training {
                steps: Steps(110_000),
                batch: Batch { global: 64, slices: 1 },
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

impl StageSpec for TrainLength {
    const KIND: &'static str = "train.length";
    // Version 2 stores the encoder that it reads.
    const VERSION: u32 = 3;
    const SHAPE: Shape = Shape::Gang;
    const OUTPUT: Output = Output { name: "length", kind: ArtifactKind::Length };

    fn refs(&mut self) -> Vec<Ref<'_>> {
        vec![
            Ref::stage("dataset", &mut self.dataset, ArtifactKind::Dataset),
            Ref::stage("text", &mut self.text, ArtifactKind::Embeddings),
            Ref::init(&mut self.init, ArtifactKind::Length, ArtifactKind::Length),
        ]
    }

    fn check(&self, p: &mut Problems) {
        self.training.check(p);
    }

    fn check_neighbours(&self, stages: &Neighbours<'_>, p: &mut Problems) {
        stages.same_captions(p, &self.text, &self.dataset);
    }

    fn training(&mut self) -> Option<&mut Training> {
        Some(&mut self.training)
    }

    fn recorded(&self) -> &'static [&'static str] {
        &["loss", "frames_off"]
    }
}
