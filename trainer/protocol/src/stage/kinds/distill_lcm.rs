//! `distill.lcm`: latent consistency distillation. Source: MotionLCM.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use crate::ArtifactKind;
use crate::stage::{Distillation, Neighbours, Output, Problems, Ref, Sampler, Shape, StageSpec, Training};

/// `distill.lcm`. Source: MotionLCM.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default)]
pub struct DistillLcm {
    /// Everything.
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
    const SHAPE: Shape = Shape::Gang;
    const OUTPUT: Output = Output { name: "denoiser", kind: ArtifactKind::Denoiser };

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

    fn is_student(&self) -> bool {
        true
    }

    fn check_sampler(&self, model: &str, sampler: &Sampler, p: &mut Problems) {
        let points = 1000 / self.distillation.skip.max(1);
        if sampler.steps > points {
            let message =
                format!("`sampler.steps` is {}, but the grid of `{model}` has {points} points", sampler.steps);
            p.add("sampler.steps", message, "");
        }
    }
}
