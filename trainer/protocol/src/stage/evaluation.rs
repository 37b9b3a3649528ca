//! Settings of the evaluations that need no evaluator, and what all evaluations share.

use serde::{Deserialize, Serialize};

/// Which clips an evaluation looks at.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Split {
    /// `train.txt`.
    Train,
    /// `val.txt`.
    Val,
    /// `test.txt`.
    Test,
    /// All three.
    All,
}

/// `evaluate.reconstruction`: MPJPE in mm and feature error of a VAE.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default)]
pub struct EvaluateReconstruction {
    /// Stage that gives the VAE.
    pub vae: String,
    /// Stage that gives the clips.
    pub dataset: String,
    /// Clips.
    pub split: Split,
    /// Shards.
    pub shards: usize,
}

impl Default for EvaluateReconstruction {
    fn default() -> Self {
        Self { vae: "vae".into(), dataset: "dataset".into(), split: Split::Test, shards: 4 }
    }
}

/// How motions are drawn from a denoiser.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default)]
pub struct Sampler {
    /// Network evaluations. A PCM student has as many as phases.
    pub steps: usize,
    /// Teacher: g in `uncond + g (cond - uncond)`. Student: the embedded w, which is g - 1.
    pub guidance: f64,
    /// LCM only: timesteps, first to last; empty takes evenly spaced points of the training grid from 999 down.
    pub timesteps: Vec<usize>,
}

impl Default for Sampler {
    fn default() -> Self {
        Self { steps: 1, guidance: 7.5, timesteps: Vec::new() }
    }
}

/// `evaluate.latent_fid`: Frechet distance between sampled and real latents, as a share of the real variance.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default)]
pub struct EvaluateLatentFid {
    /// Stage that gives the denoiser.
    pub model: String,
    /// Stage that gives the latents.
    pub latents: String,
    /// Stage that gives the caption embeddings.
    pub text: String,
    /// Stage that gives the teacher whose 50-step samples `match` compares with; empty leaves `match` out.
    pub teacher: String,
    /// Sampler.
    pub sampler: Sampler,
    /// Repeats with other noise.
    pub repeats: usize,
    /// Samples per entry and repeat.
    pub samples: usize,
    /// Principal components of the train latents in which distances are taken.
    pub components: usize,
    /// Real clips compared with. `all` on small sets: with few clips the distance of real to real is large.
    pub split: Split,
    /// Shards.
    pub shards: usize,
}

impl Default for EvaluateLatentFid {
    fn default() -> Self {
        Self {
            model: "mld".into(),
            latents: "latents".into(),
            text: "text".into(),
            teacher: String::new(),
            sampler: Sampler::default(),
            repeats: 5,
            samples: 2,
            components: 32,
            split: Split::All,
            shards: 5,
        }
    }
}
