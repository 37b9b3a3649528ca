//! `distill.lcm`: latent consistency distillation. Source: MotionLCM.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use crate::ArtifactKind;
use crate::stage::{Distillation, Family, Neighbours, Output, Problems, Ref, Shape, StageSpec, Training};

/// `distill.lcm`: latent consistency distillation. Source: MotionLCM.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default)]
pub struct DistillLcm {
    /// Common settings of both distillations.
    #[serde(flatten)]
    pub distillation: Distillation,
}

impl Default for DistillLcm {
    fn default() -> Self {
        Self { distillation: Distillation::motion_lcm() }
    }
}

impl StageSpec for DistillLcm {
    const KIND: &'static str = "distill.lcm";
    // Version 2 outputs a whole model, with its VAE and text encoder.
    const VERSION: u32 = 4;
    const SHAPE: Shape = Shape::Gang;
    const OUTPUT: Output = Output { name: "model", kind: ArtifactKind::Model };

    fn refs(&mut self) -> Vec<Ref<'_>> {
        self.distillation.refs()
    }

    fn check(&self, p: &mut Problems) {
        self.distillation.check(p);
    }

    fn check_neighbours(&self, stages: &Neighbours<'_>, p: &mut Problems) {
        self.distillation.check_neighbours(stages, p);
    }

    fn training(&mut self) -> Option<&mut Training> {
        Some(&mut self.distillation.training)
    }

    fn recorded(&self) -> &'static [&'static str] {
        &["loss"]
    }

    fn family(&self) -> Option<Family> {
        let Distillation { skip, guidance, .. } = self.distillation;
        Some(Family::Lcm { skip, guidance })
    }
}
