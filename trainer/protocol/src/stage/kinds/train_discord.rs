//! `train.discord`: a rectified flow that turns frozen tokens, or the latents of a frozen VAE, into motion. Source: DisCoRD (Cho et al.,
//! arXiv:2411.19527).

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use crate::stage::{
    Batch, Decay, FlowSolver, ImportModel, ImportedPart, Neighbours, Optimizer, Output, Problems, Ref, Shape,
    StageSpec, Training, WindowsOf,
};
use crate::{ArtifactKind, Steps, limits};

/// Frames that one token stands for.
const UNIT: usize = 4;

/// What the velocity is predicted by.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "lowercase")]
pub enum FlowBackbone {
    /// A U-Net over time, as published.
    #[default]
    Unet,
    /// A transformer, which the code base has and no released weights.
    Dit,
}

/// What the network gives.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "lowercase")]
pub enum FlowPrediction {
    /// The velocity, data less noise, as published. The network must then carry noise of the features' full width, so it wants to be wider than a frame.
    #[default]
    Velocity,
    /// The data, of which the velocity is computed: narrow networks can give that (Li and He, arXiv:2511.13720). The loss is on the data.
    Data,
}

impl FlowPrediction {
    /// The word in YAML.
    pub fn name(self) -> &'static str {
        match self {
            Self::Velocity => "velocity",
            Self::Data => "data",
        }
    }

    /// What the network of the flow decoder that stage `name` gives predicts, as far as the pipeline says it.
    pub(super) fn of_stage(stages: &Neighbours<'_>, name: &str) -> Option<Self> {
        let stage = stages.stage(name)?;
        if let Some(trained) = stage.get::<TrainDiscord>() {
            return Some(trained.prediction);
        }
        if stage.get::<ImportModel>().is_some_and(|import| import.part == ImportedPart::Discord) {
            return Some(Self::Velocity);
        }
        // A student's is its teacher's; what only passes a decoder on says nothing of its own.
        Self::of_stage(stages, stages.read_by(name, ArtifactKind::FlowDecoder)?)
    }

    /// Refuses to begin with a network of another prediction than `ours`.
    pub(super) fn check_init(stages: &Neighbours<'_>, p: &mut Problems, init: &str, ours: Option<Self>) {
        if let (Some(ours), Some(theirs)) = (ours, Self::of_stage(stages, init))
            && ours != theirs
        {
            let message = format!(
                "`init` is `{init}`, whose network gives the {}, but the one that is trained here gives the {}",
                theirs.name(),
                ours.name()
            );
            p.add(
                "init",
                message,
                "what the one learned says nothing to the other; name a decoder of the same `prediction`",
            );
        }
    }
}

/// How tokens become a condition on each frame, of a U-Net.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "lowercase")]
pub enum FlowProjection {
    /// Repeat, stack, a linear layer, unstack, another: as published.
    #[default]
    Stack,
    /// Repeat and a linear layer.
    Repeat,
    /// Two transposed convolutions.
    Transposed,
}

/// Size of the network. The default is the published U-Net; the transformer in the code base has 512, 384, 4 and 4.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default)]
pub struct FlowNetwork {
    /// Width of the U-Net's first level, of which the second has twice as much; width of the transformer.
    pub width: usize,
    /// Width of the condition on a frame.
    pub condition: usize,
    /// Residual blocks of a level, or blocks of the transformer.
    pub layers: usize,
    /// Heads of the attention, if there is one.
    pub heads: usize,
    /// Attention in the U-Net, which the paper found to be worse.
    pub attention: bool,
    /// Tokens to condition, of a U-Net.
    pub projection: FlowProjection,
    /// Dropout probability.
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

/// `train.discord`: a decoder of tokens, or of a VAE's latents, that draws smooth motion.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default)]
pub struct TrainDiscord {
    /// Stage that gives the clips.
    pub dataset: String,
    /// Stage that gives the tokenizer, which stays as it is; not read if there is a VAE.
    pub tokenizer: String,
    /// Stage that gives the VAE whose latents are decoded instead of tokens; none if empty. What its own decoder makes of a latent, four frames a
    /// token, is what the flow is conditioned on, our choice: the paper compares with MLD, and has no decoder of its latents.
    pub vae: String,
    /// What the velocity is predicted by.
    pub backbone: FlowBackbone,
    /// What the network gives.
    pub prediction: FlowPrediction,
    /// Size.
    pub network: FlowNetwork,
    /// Frames of an example; a multiple of 4. Shorter clips are left out.
    pub window: usize,
    /// Which windows make an epoch.
    pub windows_of: WindowsOf,
    /// How the flow is followed when motion is decoded.
    pub solver: FlowSolver,
    /// Steps of the solver.
    pub solver_steps: usize,
    /// Exponential moving average of the weights that is kept as the result; 0 keeps the weights themselves.
    pub ema: f64,
    /// Stage that gives a flow decoder whose weights training begins with where their shapes fit, or a version such as `discord@prod`; empty
    /// begins with random ones.
    #[serde(skip_serializing_if = "String::is_empty")]
    pub init: String,
    /// The rest. Published: 200 epochs of all windows with batches of 768, a cosine down to a fiftieth of the rate; here it ends at zero.
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
                stop: None,
            },
        }
    }
}

impl StageSpec for TrainDiscord {
    const KIND: &'static str = "train.discord";
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
        let FlowNetwork { width, condition, layers, heads, dropout, .. } = self.network;
        for (field, value) in [
            ("network.width", width),
            ("network.condition", condition),
            ("network.layers", layers),
            ("network.heads", heads),
            ("solver_steps", self.solver_steps),
        ] {
            p.positive(field, value);
        }
        // The second level is twice as wide, and blocks on the way up see as much again.
        let parameters = width.saturating_mul(width).saturating_mul(100).saturating_mul(layers);
        if parameters > limits::PARAMETERS {
            let message =
                format!("its layers have up to {parameters} parameters; expected at most {}", limits::PARAMETERS);
            p.add("network", message, "take fewer layers, or narrower ones");
        }
        if width < 4 || !width.is_multiple_of(2) {
            p.add("network.width", format!("`network.width` is {width}; expected an even number of at least 4"), "");
        }
        if self.backbone == FlowBackbone::Dit && heads > 0 && !width.is_multiple_of(heads) {
            let message = format!("`network.heads` is {heads}, which does not divide `network.width`, {width}");
            p.add("network.heads", message, "");
        }
        p.fraction("network.dropout", dropout, true);
        if self.window < UNIT || !self.window.is_multiple_of(UNIT) {
            let message = format!("`window` is {}; expected a multiple of {UNIT}", self.window);
            p.add("window", message, "a token stands for 4 frames");
        }
        p.fraction("ema", self.ema, true);
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
