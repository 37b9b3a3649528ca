//! `evaluate.reconstruction`: what a VAE loses. Source: MLD's MPJPE, DisCoRD's sJPE, and our feature error.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use crate::ArtifactKind;
use crate::stage::{Output, Problems, Ref, Shape, Split, StageSpec};

/// `evaluate.reconstruction`: MPJPE in mm and feature error of a VAE.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
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

impl StageSpec for EvaluateReconstruction {
    const KIND: &'static str = "evaluate.reconstruction";
    // 2: PA-MPJPE, accelerations, sJPE, skating.
    const VERSION: u32 = 2;
    const SHAPE: Shape = Shape::Map;
    const OUTPUT: Output = Output { name: "report", kind: ArtifactKind::Report };

    fn refs(&mut self) -> Vec<Ref<'_>> {
        vec![
            Ref::stage("vae", &mut self.vae, ArtifactKind::Vae),
            Ref::stage("dataset", &mut self.dataset, ArtifactKind::Dataset),
        ]
    }

    fn check(&self, p: &mut Problems) {
        p.shards(self.shards);
    }

    fn shards(&self) -> usize {
        self.shards
    }
}
