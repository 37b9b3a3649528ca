//! Common settings of training stages: batch, schedule, optimizer.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use super::Problems;
use crate::Steps;

/// The global batch and its fixed division into slices. Part of a stage's identity; the number of workers is not.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
pub struct Batch {
    /// Examples per optimizer update, over all workers.
    #[schemars(range(min = 1, max = 65_536), extend("x-unit" = "examples"))]
    pub global: usize,
    /// Number of forward/backward passes that compute the batch; divides `global`.
    #[schemars(range(min = 1, max = 4_096), extend("x-unit" = "slices"))]
    pub slices: usize,
}

impl Batch {
    /// Checks that all slices have equal size; `field` is the field of `global`.
    pub(super) fn check_division(self, p: &mut Problems, field: &str) {
        if self.slices > 0 && !self.global.is_multiple_of(self.slices) {
            let message =
                format!("`{field}` is {}, which is not a multiple of the {} slices", self.global, self.slices);
            p.add(field, message, "a slice is one forward and backward pass, and all slices have the same size");
        }
    }
}

/// Learning rate after the warm-up.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "lowercase")]
pub enum Decay {
    /// Half a cosine down to zero at the last step.
    Cosine,
    /// Constant at the peak rate.
    Constant,
    /// Factor 0.9 after every 5,000 updates. StableMoFusion.
    Staircase,
}

/// AdamW. Defaults are the papers' (betas 0.9/0.999, eps 1e-8, weight decay 0), not a library's.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default)]
pub struct Optimizer {
    /// Decay of the first moment.
    #[schemars(range(min = 0.0), extend("exclusiveMaximum" = 1.0))]
    pub beta1: f64,
    /// Decay of the second moment.
    #[schemars(range(min = 0.0), extend("exclusiveMaximum" = 1.0))]
    pub beta2: f64,
    /// Added to the root of the second moment.
    #[schemars(range(max = 1.0), extend("exclusiveMinimum" = 0.0))]
    pub eps: f64,
    /// Decoupled weight decay.
    #[schemars(range(min = 0.0, max = 1e3))]
    pub weight_decay: f64,
}

impl Default for Optimizer {
    fn default() -> Self {
        Self { beta1: 0.9, beta2: 0.999, eps: 1e-8, weight_decay: 0.0 }
    }
}

/// Replicas that make updates on their own and are averaged, for lines too slow for an exchange in every update.
///
/// Each replica has its own share of the slices, and so of the batch. After `every` updates, parameters, moments of the
/// optimizer and moving averages of all replicas are averaged. Source: Stich, "Local SGD Converges Fast and Communicates
/// Little" (2019), algorithm 1; averaging the moments of AdamW too is ours. Checkpoints are of averages, so a loss costs
/// the updates since the last one at most. Part of a stage's identity: the number of replicas does not follow the workers.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(default)]
pub struct Replicas {
    /// Updates between two averages.
    #[schemars(range(min = 1, max = 100_000))]
    pub every: Steps,
    /// Number of replicas; divides `batch.slices`. A worker computes whole replicas, so more workers have no work.
    #[schemars(range(min = 1, max = 4_096), extend("x-unit" = "replicas"))]
    pub replicas: usize,
}

impl Default for Replicas {
    fn default() -> Self {
        Self { every: Steps(1), replicas: 1 }
    }
}

/// Common settings of training stages.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct Training {
    /// Number of optimizer updates.
    #[schemars(range(min = 1, max = 1_000_000_000))]
    pub steps: Steps,
    /// Global batch and its slices.
    pub batch: Batch,
    /// Peak learning rate.
    #[schemars(range(max = 1e3), extend("exclusiveMinimum" = 0.0))]
    pub lr: f64,
    /// Linear warm-up; the first update has rate 0 when it is positive.
    #[schemars(range(min = 0, max = 1_000_000_000))]
    pub warmup: Steps,
    /// Decay of the rate after the warm-up.
    pub decay: Decay,
    /// Constants of AdamW.
    #[serde(default)]
    pub optimizer: Optimizer,
    /// Largest global norm of gradients, to which they are scaled down; 0 disables clipping.
    #[schemars(range(min = 0.0, max = 1e6))]
    pub max_grad_norm: f64,
    /// Averages of replicas; by default, every update has the gradients of all slices.
    #[serde(default)]
    pub sync: Replicas,
    /// Step at which a sweep's rung stops before the schedule's end, leaving its state for the next rung. Not for
    /// users: the reader accepts only keys of the default.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[schemars(range(min = 0, max = 1_000_000_000))]
    pub stop: Option<Steps>,
}

impl Training {
    pub(super) fn published(steps: u64, global: usize, lr: f64) -> Self {
        Self {
            steps: Steps(steps),
            batch: Batch { global, slices: 8 },
            lr,
            warmup: Steps(1000),
            decay: Decay::Cosine,
            optimizer: Optimizer::default(),
            max_grad_norm: 1.0,
            sync: Replicas::default(),
            stop: None,
        }
    }

    /// Last step of this stage.
    pub fn end(&self) -> Steps {
        self.stop.map_or(self.steps, |stop| stop.min(self.steps))
    }

    /// The replicas, unless every update has the gradients of all slices.
    pub fn replicas(&self) -> Option<Replicas> {
        Some(self.sync).filter(|sync| *sync != Replicas::default())
    }

    /// Number of parts of a step that different workers can compute: slices, or replicas.
    pub fn parts(&self) -> usize {
        self.replicas().map_or(self.batch.slices, |sync| sync.replicas)
    }

    pub(super) fn check(&self, p: &mut Problems) {
        self.batch.check_division(p, "batch.global");
        let Replicas { replicas, .. } = self.sync;
        if replicas > 0 && !self.batch.slices.is_multiple_of(replicas) {
            let slices = self.batch.slices;
            let message = format!("`sync.replicas` is {replicas}, which does not divide the {slices} slices");
            p.add("sync.replicas", message, "each replica computes as many of `batch.slices`");
        }
    }
}
