//! Common settings of both distillations. Source: MotionLCM, MotionPCM.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use super::{Neighbours, Problems, Ref, Training};
use crate::ArtifactKind;

/// Distance d in consistency losses.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "lowercase")]
pub enum Distance {
    /// Pseudo-Huber distance, `sqrt(d^2 + c^2) - c`.
    Huber,
    /// Mean squared error.
    L2,
}

/// Common settings of both distillations.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default = "Distillation::motion_lcm")]
pub struct Distillation {
    /// Stage that gives the teacher.
    pub teacher: String,
    /// Stage that gives the latents.
    pub latents: String,
    /// Stage that gives the caption embeddings.
    pub text: String,
    /// Range of the guidance scale w, which is drawn from it, in the form `cond + w (cond - uncond)`.
    #[schemars(extend("minimum" = 0.0, "maximum" = 1e3))]
    pub guidance: (f64, f64),
    /// Width of the guidance embedding.
    #[schemars(range(min = 4, max = 16_384), extend("x-unit" = "channels"))]
    pub guidance_dim: usize,
    /// Solver step k; the grid has 1000/k points.
    #[schemars(range(min = 1, max = 1_000), extend("x-unit" = "timesteps"))]
    pub skip: usize,
    /// Distance of the consistency loss.
    pub distance: Distance,
    /// Pseudo-Huber constant c.
    #[schemars(range(min = 0.0, max = 1e6))]
    pub huber_c: f64,
    /// Decay of the target network.
    #[schemars(range(min = 0.0), extend("exclusiveMaximum" = 1.0))]
    pub ema: f64,
    /// Applies dropout in the frozen networks, as the original script does by mistake.
    pub upstream_dropout: bool,
    /// Stage or version, such as `motionlcm@prod`, whose denoiser supplies initial weights where shapes fit; empty
    /// starts from the teacher's weights.
    #[serde(skip_serializing_if = "String::is_empty")]
    pub init: String,
    /// Batch, schedule and optimizer.
    #[serde(flatten)]
    pub training: Training,
}

impl Distillation {
    pub(super) fn motion_lcm() -> Self {
        Self::published(192_000, 128)
    }

    pub(super) fn published(steps: u64, global: usize) -> Self {
        Self {
            teacher: "mld".into(),
            latents: "latents".into(),
            text: "text".into(),
            guidance: (5.0, 15.0),
            guidance_dim: 256,
            skip: 100,
            distance: Distance::Huber,
            huber_c: 0.5,
            ema: 0.95,
            upstream_dropout: false,
            init: String::new(),
            training: Training::published(steps, global, 2e-4),
        }
    }

    pub(super) fn refs(&mut self) -> Vec<Ref<'_>> {
        vec![
            Ref::stage("teacher", &mut self.teacher, ArtifactKind::Model),
            Ref::stage("latents", &mut self.latents, ArtifactKind::Latents),
            Ref::stage("text", &mut self.text, ArtifactKind::Embeddings),
            Ref::init(&mut self.init, ArtifactKind::Model, ArtifactKind::Denoiser),
        ]
    }

    /// Number of points of the solver grid; `None` if `skip` is invalid.
    pub(super) fn grid(&self) -> Option<usize> {
        (self.skip > 0 && 1000usize.is_multiple_of(self.skip)).then(|| 1000 / self.skip)
    }

    pub(super) fn check(&self, p: &mut Problems) {
        p.ascending("guidance", self.guidance);
        if !self.guidance_dim.is_multiple_of(2) {
            let message = format!("`guidance_dim` is {}; expected an even number", self.guidance_dim);
            p.add("guidance_dim", message, "one half are sines, the other half cosines");
        }
        let help = "published: 100 (MotionLCM v2, MotionPCM) and 20 (MotionLCM v1)";
        p.divides_timesteps("skip", self.skip, help);
        if self.distance == Distance::Huber {
            p.above_zero("huber_c", self.huber_c);
        }
        self.training.check(p);
    }

    pub(super) fn check_neighbours(&self, stages: &Neighbours<'_>, p: &mut Problems) {
        stages.is_teacher(p, &self.teacher);
        stages.same_vae(p, ("teacher", stages.vae_of_model(&self.teacher)), &self.latents);
        stages.same_data(p, &self.latents, &self.text);
    }
}
