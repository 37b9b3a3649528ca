//! `train.mld`: the latent-diffusion teacher. Source: MLD, MotionLCM v1/v2.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use crate::ArtifactKind;
use crate::stage::{
    Diffusion, Family, FrequencyLosses, Neighbours, Network, Output, Problems, Ref, Shape, StageSpec, TextEmbed,
    Training,
};

/// `train.mld`: the latent-diffusion teacher. Source: MLD, MotionLCM v1/v2.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default)]
pub struct TrainMld {
    /// Stage that gives the VAE; its latent shape must be that of `latents`.
    pub vae: String,
    /// Stage that gives the latents.
    pub latents: String,
    /// Stage that gives the caption embeddings.
    pub text: String,
    /// Stage or version, such as `motionlcm@prod`, whose denoiser supplies initial weights where shapes fit; empty
    /// starts from random ones.
    pub init: String,
    /// Size of the transformer.
    pub network: Network,
    /// Noise schedule and prediction; students use the teacher's.
    pub diffusion: Diffusion,
    /// Applies a ReLU to the text embedding (v1); v2 removed it.
    pub text_relu: bool,
    /// Probability that a caption is replaced by the empty one.
    #[schemars(range(min = 0.0, max = 1.0), extend("x-unit" = "of the captions"))]
    pub guidance_dropout: f64,
    /// Decay of the moving average of the weights, which is the result; 0 uses the weights themselves.
    #[schemars(range(min = 0.0), extend("exclusiveMaximum" = 1.0))]
    pub ema: f64,
    /// Losses of Free-T2M, on motions from the frozen decoder.
    pub losses: FrequencyLosses,
    /// Share of the batch whose latents are decoded for `losses`: decoding costs more than denoising.
    #[schemars(range(min = 0.0, max = 1.0), extend("x-unit" = "of the batch"))]
    pub decoded: f64,
    /// Batch, schedule and optimizer.
    #[serde(flatten)]
    pub training: Training,
}

impl Default for TrainMld {
    fn default() -> Self {
        Self {
            vae: "vae".into(),
            latents: "latents".into(),
            text: "text".into(),
            init: String::new(),
            network: Network::default(),
            diffusion: Diffusion::default(),
            text_relu: false,
            guidance_dropout: 0.1,
            ema: 0.0,
            losses: FrequencyLosses::default(),
            decoded: 0.25,
            training: Training::published(1_150_000, 64, 1e-4),
        }
    }
}

impl StageSpec for TrainMld {
    const KIND: &'static str = "train.mld";
    // Version 2 outputs a whole model, with its VAE and text encoder.
    const VERSION: u32 = 4;
    const SHAPE: Shape = Shape::Gang;
    const OUTPUT: Output = Output { name: "model", kind: ArtifactKind::Model };

    fn refs(&mut self) -> Vec<Ref<'_>> {
        vec![
            Ref::stage("vae", &mut self.vae, ArtifactKind::Vae),
            Ref::stage("latents", &mut self.latents, ArtifactKind::Latents),
            Ref::stage("text", &mut self.text, ArtifactKind::Embeddings),
            Ref::init(&mut self.init, ArtifactKind::Model, ArtifactKind::Denoiser),
            self.losses.reference(),
        ]
    }

    fn check(&self, p: &mut Problems) {
        self.network.check(p);
        self.diffusion.check(p);
        self.losses.check(p);
        if self.losses.any() && self.decoded == 0.0 {
            p.add("decoded", "`decoded` is 0, so `losses` have no effect", "set it above 0");
        }
        self.training.check(p);
    }

    fn check_neighbours(&self, stages: &Neighbours<'_>, p: &mut Problems) {
        stages.same_vae(p, ("vae", Some(&self.vae)), &self.latents);
        stages.same_data(p, &self.latents, &self.text);
        let embed = stages.stage(&self.text).and_then(|settings| settings.get::<TextEmbed>());
        if let Some(encoder) = embed.map(|embed| embed.encoder)
            && self.text_relu
            && !encoder.survives_relu()
        {
            let message = format!(
                "`text_relu` sets negative coordinates to 0, and half of the words of `{}` have a single, negative \
                 coordinate",
                encoder.name()
            );
            p.add("text_relu", message, "remove it, as MotionLCM v2 does, or embed with another encoder");
        }
    }

    fn training(&mut self) -> Option<&mut Training> {
        Some(&mut self.training)
    }

    fn recorded(&self) -> &'static [&'static str] {
        if self.losses.any() { &["loss", "denoising", "low_frequency", "semantic"] } else { &["loss"] }
    }

    fn family(&self) -> Option<Family> {
        Some(Family::Mld)
    }
}
