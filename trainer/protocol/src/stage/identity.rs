//! The identity of a stage, which decides its value.

use std::collections::BTreeMap;

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use super::StageSettings;
use crate::{Digest, Seed, StageName};

/// Backend that computes. Part of a stage's key: other backends give other bits.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "lowercase")]
pub enum Backend {
    /// Burn's pure-Rust CPU backend, with our fused kernels.
    #[default]
    Flex,
    /// Burn's older CPU backend.
    Ndarray,
    /// GPUs through WebGPU.
    Wgpu,
    /// NVIDIA GPUs through CUDA.
    Cuda,
}

impl Backend {
    /// Returns true if it computes on the processor, in the threads that call it.
    pub fn is_cpu(self) -> bool {
        match self {
            Self::Flex | Self::Ndarray => true,
            Self::Wgpu | Self::Cuda => false,
        }
    }

    /// Name in YAML and on the command line.
    pub fn name(self) -> &'static str {
        match self {
            Self::Flex => "flex",
            Self::Ndarray => "ndarray",
            Self::Wgpu => "wgpu",
            Self::Cuda => "cuda",
        }
    }
}

/// Everything that decides a stage's value; its digest is the stage's key.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct StageIdentity {
    /// Settings without references to other stages and without paths, whose digests are in `inputs`.
    pub settings: StageSettings,
    /// Code version of the kind.
    pub code_version: u32,
    /// Artifacts by the field that names them.
    pub inputs: BTreeMap<String, Digest>,
    /// The run's seed.
    pub seed: Seed,
    /// The stage's name keys its randomness, so that two PCM stages of one pipeline draw different noise.
    pub name: StageName,
    /// Backend that computes.
    pub backend: Backend,
}

impl StageIdentity {
    /// The stage's key.
    pub fn key(&self) -> Digest {
        crate::canonical::digest(self)
    }
}
