//! `distill.pcm`: phased consistency distillation with a discriminator. Source: MotionPCM, Algorithm 1.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use crate::ArtifactKind;
use crate::stage::{Distillation, Family, Neighbours, Optimizer, Output, Problems, Ref, Shape, StageSpec, Training};

/// `distill.pcm`: phased consistency distillation. Source: MotionPCM, Algorithm 1.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default)]
pub struct DistillPcm {
    /// M, the number of phases and of sampling steps.
    #[schemars(range(min = 1, max = 1_000), extend("x-unit" = "phases"))]
    pub phases: usize,
    /// Weight of the adversarial term; 0 trains without a discriminator.
    #[schemars(range(min = 0.0, max = 1e6))]
    pub adversarial: f64,
    /// Learning rate of the discriminator; 0 uses `lr`.
    #[schemars(range(min = 0.0, max = 1e3))]
    pub discriminator_lr: f64,
    /// AdamW constants of the discriminator.
    pub discriminator_optimizer: Optimizer,
    /// Slope below zero of the discriminator's leaky ReLUs, 0.01 in the image repository.
    #[schemars(range(min = 0.0), extend("exclusiveMaximum" = 1.0))]
    pub discriminator_slope: f64,
    /// Updates student and discriminator in alternate steps, as in the image repository; otherwise both in every step.
    /// The learning rate of each counts its own updates.
    pub alternate: bool,
    /// Common settings of both distillations.
    #[serde(flatten)]
    pub distillation: Distillation,
}

impl Default for DistillPcm {
    fn default() -> Self {
        Self {
            phases: 1,
            adversarial: 0.1,
            discriminator_lr: 0.0,
            discriminator_optimizer: Optimizer::default(),
            discriminator_slope: 0.01,
            alternate: false,
            distillation: Distillation::published(384_000, 128),
        }
    }
}

impl StageSpec for DistillPcm {
    const KIND: &'static str = "distill.pcm";
    // Version 2 outputs a whole model, with its VAE and text encoder.
    const VERSION: u32 = 4;
    const SHAPE: Shape = Shape::Gang;
    const OUTPUT: Output = Output { name: "model", kind: ArtifactKind::Model };

    fn refs(&mut self) -> Vec<Ref<'_>> {
        self.distillation.refs()
    }

    fn check(&self, p: &mut Problems) {
        self.distillation.check(p);
        if let Some(grid) = self.distillation.grid()
            && self.phases > grid
        {
            let phases = self.phases;
            let skip = self.distillation.skip;
            let message = format!("`phases` is {phases}, but the grid of `skip` {skip} has only {grid} points");
            p.add("phases", message, "use fewer phases or a smaller `skip`");
        }
        if self.alternate && self.adversarial == 0.0 {
            let message = "`alternate` is true, but without `adversarial` there is no discriminator to alternate with";
            p.add("alternate", message, "remove `alternate`, or set `adversarial`");
        }
    }

    fn check_neighbours(&self, stages: &Neighbours<'_>, p: &mut Problems) {
        self.distillation.check_neighbours(stages, p);
    }

    fn training(&mut self) -> Option<&mut Training> {
        Some(&mut self.distillation.training)
    }

    fn recorded(&self) -> &'static [&'static str] {
        if self.adversarial > 0.0 { &["loss", "consistency", "adversarial", "discriminator"] } else { &["loss"] }
    }

    fn family(&self) -> Option<Family> {
        let Distillation { skip, guidance, .. } = self.distillation;
        Some(Family::Pcm { skip, guidance, phases: self.phases })
    }
}
