//! `train.discord`: a rectified flow that decodes frozen tokens, or the latents of a frozen VAE, to motion. Source:
//! DisCoRD (Cho et al., arXiv:2411.19527).

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use crate::stage::{
    Batch, Decay, FlowSolver, ImportModel, ImportedPart, Neighbours, Optimizer, Output, Problems, Ref, Replicas, Shape,
    StageSpec, Training, WindowsOf,
};
use crate::{ArtifactKind, Steps};

/// Network that predicts the velocity.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "lowercase")]
pub enum FlowBackbone {
    /// A U-Net over time, as published.
    #[default]
    Unet,
    /// A transformer, which the published code has without released weights.
    Dit,
}

/// Quantity that the network predicts.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "lowercase")]
pub enum FlowPrediction {
    /// The velocity, data less noise, as published. The network must then pass noise of the features' full width, so it
    /// should be wider than a frame.
    #[default]
    Velocity,
    /// The data, from which the velocity is computed: narrow networks can predict that (Li and He, arXiv:2511.13720).
    /// The loss is on the data.
    Data,
}

impl FlowPrediction {
    /// Name in YAML.
    pub fn name(self) -> &'static str {
        match self {
            Self::Velocity => "velocity",
            Self::Data => "data",
        }
    }

    /// Prediction of the flow decoder of stage `name`, if the pipeline defines it.
    pub(super) fn of_stage(stages: &Neighbours<'_>, name: &str) -> Option<Self> {
        let stage = stages.stage(name)?;
        if let Some(trained) = stage.get::<TrainDiscord>() {
            return Some(trained.prediction);
        }
        if stage.get::<ImportModel>().is_some_and(|import| import.part == ImportedPart::Discord) {
            return Some(Self::Velocity);
        }
        // A student has its teacher's prediction; a stage that passes a decoder on has none of its own.
        Self::of_stage(stages, stages.read_by(name, ArtifactKind::FlowDecoder)?)
    }

    /// Refuses initial weights of a network with another prediction than `ours`.
    pub(super) fn check_init(stages: &Neighbours<'_>, p: &mut Problems, init: &str, ours: Option<Self>) {
        if let (Some(ours), Some(theirs)) = (ours, Self::of_stage(stages, init))
            && ours != theirs
        {
            let message = format!(
                "`init` is `{init}`, whose network predicts the {}, but this stage trains one that predicts the {}",
                theirs.name(),
                ours.name()
            );
            p.add("init", message, "use a decoder with the same `prediction`");
        }
    }
}

/// Conversion of tokens into a condition on each frame, for a U-Net.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "lowercase")]
pub enum FlowProjection {
    /// Repeat, stack, a linear layer, unstack, a second linear layer, as published.
    #[default]
    Stack,
    /// Repeat and a linear layer.
    Repeat,
    /// Two transposed convolutions.
    Transposed,
}

/// Size of the network. The default is the published U-Net; the transformer in the published code has 512, 384, 4 and
/// 4.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default)]
pub struct FlowNetwork {
    /// Width of the U-Net's first level (the second has twice as much), or of the transformer.
    #[schemars(range(min = 1, max = 16_384), extend("x-unit" = "channels"))]
    pub width: usize,
    /// Width of the condition on a frame.
    #[schemars(range(min = 1, max = 16_384), extend("x-unit" = "channels"))]
    pub condition: usize,
    /// Residual blocks per level, or blocks of the transformer.
    #[schemars(range(min = 1, max = 255), extend("x-unit" = "layers"))]
    pub layers: usize,
    /// Number of attention heads.
    #[schemars(range(min = 1, max = 1_024), extend("x-unit" = "heads"))]
    pub heads: usize,
    /// Adds attention to the U-Net, which the paper found to be worse.
    pub attention: bool,
    /// Conversion of tokens into the condition, for a U-Net.
    pub projection: FlowProjection,
    /// Probability of dropout.
    #[schemars(range(min = 0.0), extend("exclusiveMaximum" = 1.0))]
    pub dropout: f64,
}

impl Default for FlowNetwork {
    fn default() -> Self {
        Self {
            width: 512,
            condition: 256,
            layers: 1,
            heads: 4,
            attention: false,
            projection: FlowProjection::Stack,
            dropout: 0.0,
        }
    }
}

/// `train.discord`: trains a decoder of tokens, or of a VAE's latents, that generates smooth motion.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default)]
pub struct TrainDiscord {
    /// Stage that gives the clips.
    pub dataset: String,
    /// Stage that gives the tokenizer, which is not trained; not read if there is a VAE.
    pub tokenizer: String,
    /// Stage that gives the VAE whose latents are decoded instead of tokens; empty for tokens. The condition is the
    /// output of the VAE's own decoder, four frames per token. This is our choice: the paper compares with MLD, and has
    /// no decoder of its latents.
    pub vae: String,
    /// Network that predicts the velocity.
    pub backbone: FlowBackbone,
    /// Quantity that the network predicts.
    pub prediction: FlowPrediction,
    /// Size of the network.
    pub network: FlowNetwork,
    /// Frames of an example; a multiple of 4. Shorter clips are left out.
    #[schemars(range(min = 4, max = 10_000), extend("x-unit" = "frames"))]
    pub window: usize,
    /// Windows that make an epoch.
    pub windows_of: WindowsOf,
    /// Solver of the flow for decoding motion.
    pub solver: FlowSolver,
    /// Number of steps of the solver.
    #[schemars(range(min = 1, max = 1_000), extend("x-unit" = "steps"))]
    pub solver_steps: usize,
    /// Decay of the moving average of the weights, which is the result; 0 uses the weights themselves.
    #[schemars(range(min = 0.0), extend("exclusiveMaximum" = 1.0))]
    pub ema: f64,
    /// Stage or version, such as `discord@prod`, whose flow decoder supplies initial weights where shapes fit; empty
    /// starts from random ones.
    #[serde(skip_serializing_if = "String::is_empty")]
    pub init: String,
    /// Batch, schedule and optimizer. Published: 200 epochs of all windows with batches of 768, a cosine down to a
    /// fiftieth of the rate; here it ends at zero.
    #[serde(flatten)]
    pub training: Training,
}

impl Default for TrainDiscord {
    fn default() -> Self {
        Self {
            dataset: "dataset".into(),
            tokenizer: "tokenizer".into(),
            vae: String::new(),
            backbone: FlowBackbone::Unet,
            prediction: FlowPrediction::Velocity,
            network: FlowNetwork::default(),
            window: 64,
            windows_of: WindowsOf::Frames,
            solver: FlowSolver::Midpoint,
            solver_steps: 15,
            ema: 0.999,
            init: String::new(),
            training: Training {
                steps: Steps(481_896),
                batch: Batch { global: 768, slices: 16 },
                lr: 5e-4,
                warmup: Steps(48_000),
                decay: Decay::Cosine,
                optimizer: Optimizer { weight_decay: 0.01, ..Optimizer::default() },
                max_grad_norm: 1.0,
                sync: Replicas::default(),
                stop: None,
            },
        }
    }
}

impl StageSpec for TrainDiscord {
    const KIND: &'static str = "train.discord";
    const VERSION: u32 = 4;
    const SHAPE: Shape = Shape::Gang;
    const OUTPUT: Output = Output { name: "decoder", kind: ArtifactKind::FlowDecoder };

    fn refs(&mut self) -> Vec<Ref<'_>> {
        let of_tokens = self.vae.is_empty();
        vec![
            Ref::stage("dataset", &mut self.dataset, ArtifactKind::Dataset),
            Ref::stage("tokenizer", &mut self.tokenizer, ArtifactKind::Tokenizer).only_if(of_tokens),
            Ref::stage("vae", &mut self.vae, ArtifactKind::Vae).optional(),
            Ref::init(&mut self.init, ArtifactKind::FlowDecoder, ArtifactKind::FlowDecoder),
        ]
    }

    fn check(&self, p: &mut Problems) {
        let FlowNetwork { width, layers, heads, .. } = self.network;
        // The second level has twice the width, and blocks on the way up read the same again.
        p.parameters(width.saturating_mul(width).saturating_mul(100).saturating_mul(layers));
        if width < 4 || !width.is_multiple_of(2) {
            p.add("network.width", format!("`network.width` is {width}; expected an even number of at least 4"), "");
        }
        if self.backbone == FlowBackbone::Dit {
            p.equal_heads("network.heads", heads, "network.width", width);
        }
        p.whole_tokens("window", self.window);
        self.training.check(p);
    }

    fn check_neighbours(&self, stages: &Neighbours<'_>, p: &mut Problems) {
        let decoded = match self.vae.is_empty() {
            true => ("tokenizer", &self.tokenizer[..]),
            false => ("vae", &self.vae[..]),
        };
        stages.same_skeleton(p, decoded, &self.dataset);
        FlowPrediction::check_init(stages, p, &self.init, Some(self.prediction));
    }

    fn training(&mut self) -> Option<&mut Training> {
        Some(&mut self.training)
    }

    fn recorded(&self) -> &'static [&'static str] {
        &["loss"]
    }
}
