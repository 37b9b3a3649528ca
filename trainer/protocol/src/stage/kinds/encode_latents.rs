//! `encode.latents`: VAE posteriors, computed once for all stages that train in the latent space. Source: ours.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use crate::ArtifactKind;
use crate::stage::{Augment, Output, Ref, Shape, StageSpec};

/// `encode.latents`: posteriors of random crops, computed once.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default)]
pub struct EncodeLatents {
    /// Stage that gives the clips.
    pub dataset: String,
    /// Stage that gives the VAE.
    pub vae: String,
    /// Number of random crops per entry.
    #[schemars(range(min = 1, max = 256), extend("x-unit" = "crops of an entry"))]
    pub crops: usize,
    /// Exponent by which trainings on these latents draw clips with rare words more often. An epoch draws a clip
    /// `(n / own)^balance` times, rounded, from 1 to 16: `own` clips have its rarest word, and n is that number for the
    /// median clip. 0 draws each clip once.
    #[schemars(range(min = 0.0, max = 2.0))]
    pub balance: f64,
    /// Changes the paths of the training split's crops, for a `train.control` on little data.
    pub augment: Augment,
    /// Number of shards.
    #[schemars(range(min = 1, max = crate::limits::SHARDS), extend("x-unit" = "shards"))]
    pub shards: usize,
}

impl Default for EncodeLatents {
    fn default() -> Self {
        Self {
            dataset: "dataset".into(),
            vae: "vae".into(),
            crops: 8,
            balance: 0.0,
            augment: Augment::default(),
            shards: 8,
        }
    }
}

impl StageSpec for EncodeLatents {
    const KIND: &'static str = "encode.latents";
    // Version 2 stores the start of each crop in its clip, version 3 also the change of its path.
    const VERSION: u32 = 5;
    const SHAPE: Shape = Shape::Map;
    const OUTPUT: Output = Output { name: "latents", kind: ArtifactKind::Latents };

    fn refs(&mut self) -> Vec<Ref<'_>> {
        vec![
            Ref::stage("dataset", &mut self.dataset, ArtifactKind::Dataset),
            Ref::stage("vae", &mut self.vae, ArtifactKind::Vae),
        ]
    }

    fn shards(&self) -> usize {
        self.shards
    }
}
