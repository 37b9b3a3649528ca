//! The settings of each stage kind: plain structs whose `Default` is the published recipe where there is one.
//!
//! A settings struct is the schema too: the pipeline reader learns the closed set of keys and their types from the
//! serialised default, so a field is declared once. Fields that cannot change a stage's value (worker counts,
//! checkpoint cadence) live in [`Placement`] and stay out of the stage's key.

mod evaluator;

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};

use crate::{ArtifactKind, Digest, Seed, StageName, Steps};

pub use evaluator::{EvaluateT2m, EvaluatorNetwork, ImportEvaluator, MovementPhase, MultiModality, TrainEvaluator};

/// How a stage's work is laid over workers.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Shape {
    /// Data parallel: all members step together.
    Gang,
    /// Cut into shards, each done once by anybody, then merged.
    Map,
    /// Done once by one worker.
    Plain,
    /// Done by the coordinator, because it changes the registry.
    Registry,
}

/// Length-dependent rules of the two data formats.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum DataFormat {
    /// 263 features, 22 joints, 20 fps, metres.
    Humanml3d,
    /// 251 features, 21 joints, 12.5 fps, millimetres.
    Kit,
}

/// A model's size. The published networks: width 256, 9 layers, 4 heads, feed-forward 1024, dropout 0.1.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Network {
    /// Width H of the tokens.
    pub width: usize,
    /// Transformer blocks in the skip stack; odd.
    pub layers: usize,
    /// Attention heads; divides `width`.
    pub heads: usize,
    /// Width of the feed-forward layer.
    pub feed_forward: usize,
    /// Dropout probability.
    pub dropout: f64,
    /// What the learned position tables start from.
    pub positions: Positions,
}

impl Default for Network {
    fn default() -> Self {
        Self { width: 256, layers: 9, heads: 4, feed_forward: 1024, dropout: 0.1, positions: Positions::Uniform }
    }
}

/// What learned position tables start from. The tables are trained either way and import and export alike.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Positions {
    /// Uniform on [0, 1), as published: frames start out almost alike.
    #[default]
    Uniform,
    /// `[sin | cos]` of the position at frequencies `10000^(-2i/width)`. Measured on the mini HumanML3D set with a 5+5-layer
    /// VAE of width 128, one core: feature loss .136 after 1,500 updates, where the published start has .188.
    Sinusoid,
}

/// Shape of a latent: `tokens` x `dim`. 1x256 is v1, 16x32 is v2.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct LatentShape {
    /// N latent tokens.
    pub tokens: usize,
    /// Width d of a latent token.
    pub dim: usize,
}

impl Default for LatentShape {
    fn default() -> Self {
        Self { tokens: 16, dim: 32 }
    }
}

/// The global batch and the fixed slices it is cut into. Part of a stage's identity; the number of workers is not.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct Batch {
    /// Examples per optimizer update, over all workers.
    pub global: usize,
    /// Forward/backward passes that the batch is cut into; divides `global`.
    pub slices: usize,
}

/// Learning rate after the warm-up.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Decay {
    /// Half a cosine down to zero at the last step.
    Cosine,
    /// Stays.
    Constant,
}

/// AdamW. Defaults are the papers' (betas 0.9/0.999, eps 1e-8, weight decay 0), not a library's.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Optimizer {
    /// First moment's decay.
    pub beta1: f64,
    /// Second moment's decay.
    pub beta2: f64,
    /// Added to the root of the second moment.
    pub eps: f64,
    /// Decoupled weight decay.
    pub weight_decay: f64,
}

impl Default for Optimizer {
    fn default() -> Self {
        Self { beta1: 0.9, beta2: 0.999, eps: 1e-8, weight_decay: 0.0 }
    }
}

/// What every training stage shares.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Training {
    /// Optimizer updates.
    pub steps: Steps,
    /// Global batch and slices.
    pub batch: Batch,
    /// Peak learning rate.
    pub lr: f64,
    /// Linear warm-up; the first update has rate 0 when it is positive.
    pub warmup: Steps,
    /// What follows the warm-up.
    pub decay: Decay,
    /// AdamW's constants.
    pub optimizer: Optimizer,
    /// Gradients are scaled down to this global norm; 0 leaves them alone.
    pub max_grad_norm: f64,
    /// Stops after so many steps, before the schedule's end, and leaves its state to go on from: a rung of a sweep. Not for users: the
    /// reader knows only keys that the default has.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub stop: Option<Steps>,
}

impl Training {
    fn published(steps: u64, global: usize, lr: f64) -> Self {
        Self {
            steps: Steps(steps),
            batch: Batch { global, slices: 8 },
            lr,
            warmup: Steps(1000),
            decay: Decay::Cosine,
            optimizer: Optimizer::default(),
            max_grad_norm: 1.0,
            stop: None,
        }
    }

    /// The last step of this stage.
    pub fn end(&self) -> Steps {
        self.stop.map_or(self.steps, |stop| stop.min(self.steps))
    }
}

/// `dataset: {format: humanml3d, path: ...}`: a folder in the published layout.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct DataOpen {
    /// Which of the two formats.
    pub format: DataFormat,
    /// The folder, relative to the working directory. Not part of the key: the content's digest is.
    pub path: String,
}

impl Default for DataOpen {
    fn default() -> Self {
        Self { format: DataFormat::Humanml3d, path: String::new() }
    }
}

/// `dataset: {format: synthetic, clips: 400}`: procedural motion with captions, in the HumanML3D layout.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct DataSynthetic {
    /// Clips to make, before mirroring.
    pub clips: usize,
    /// Shares of the clips for validation and test.
    pub val: f64,
    /// See `val`.
    pub test: f64,
    /// Adds the left/right mirrored twin of every clip.
    pub mirror: bool,
}

impl Default for DataSynthetic {
    fn default() -> Self {
        Self { clips: 400, val: 0.05, test: 0.15, mirror: false }
    }
}

/// `text: {encoder: hashed}`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct TextEmbed {
    /// `hashed`: n-grams hashed to signed coordinates, unit norm; needs no weights.
    pub encoder: TextEncoder,
    /// Stage whose captions are embedded.
    pub dataset: String,
}

impl Default for TextEmbed {
    fn default() -> Self {
        Self { encoder: TextEncoder::Hashed, dataset: "dataset".into() }
    }
}

/// How a caption becomes a vector.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum TextEncoder {
    /// Words and word pairs hashed into 768 signed coordinates, L2-normalised.
    Hashed,
}

/// Weights of the VAE loss. Source: MotionLCM v2 (feature 1, joint 1, velocity 0, KL 1e-4).
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct VaeLoss {
    /// Smooth-L1 on normalised features.
    pub feature: f64,
    /// Smooth-L1 on recovered joints, in metres.
    pub joint: f64,
    /// Smooth-L1 on local positions ("velocity" upstream).
    pub velocity: f64,
    /// KL to the standard normal, a mean over all elements.
    pub kl: f64,
    /// Padded frames are left out (v2); off is v1's plain mean.
    pub masked: bool,
    /// Share of the steps before the joint term joins; early, its root drift drowns the posture.
    pub joint_from: f64,
}

impl Default for VaeLoss {
    fn default() -> Self {
        Self { feature: 1.0, joint: 1.0, velocity: 0.0, kl: 1e-4, masked: true, joint_from: 0.0 }
    }
}

/// Short crops for the first part of the training: most steps per second, best result per hour on small budgets.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Windows {
    /// Shortest crop in frames.
    pub min: usize,
    /// Longest crop in frames.
    pub max: usize,
    /// Share of the steps that train on windows; 0 turns them off.
    pub until: f64,
    /// Examples per update while windows last; 0 keeps `batch.global`.
    pub batch: usize,
}

impl Default for Windows {
    fn default() -> Self {
        Self { min: 40, max: 64, until: 0.0, batch: 0 }
    }
}

/// `train.vae`. Source: MLD (v1, 1x256), MotionLCM v2 (16x32).
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct TrainVae {
    /// Stage that gives the clips.
    pub dataset: String,
    /// Latent shape.
    pub latent: LatentShape,
    /// Size.
    pub network: Network,
    /// Loss weights.
    pub loss: VaeLoss,
    /// Curriculum.
    pub windows: Windows,
    /// Exponential moving average of the weights that is kept as the result; 0 keeps the weights themselves.
    pub ema: f64,
    /// The rest.
    #[serde(flatten)]
    pub training: Training,
}

impl Default for TrainVae {
    fn default() -> Self {
        Self {
            dataset: "dataset".into(),
            latent: LatentShape::default(),
            network: Network::default(),
            loss: VaeLoss::default(),
            windows: Windows::default(),
            ema: 0.0,
            training: Training::published(1_150_000, 128, 2e-4),
        }
    }
}

/// `encode.latents`: posteriors of random crops, computed once.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct EncodeLatents {
    /// Stage that gives the clips.
    pub dataset: String,
    /// Stage that gives the VAE.
    pub vae: String,
    /// Random crops per entry.
    pub crops: usize,
    /// Shards.
    pub shards: usize,
}

impl Default for EncodeLatents {
    fn default() -> Self {
        Self { dataset: "dataset".into(), vae: "vae".into(), crops: 8, shards: 8 }
    }
}

/// `train.mld`: the latent-diffusion teacher. Source: MLD, MotionLCM v1/v2.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct TrainMld {
    /// Stage that gives the VAE; its latent shape must be that of `latents`.
    pub vae: String,
    /// Stage that gives the latents.
    pub latents: String,
    /// Stage that gives the caption embeddings.
    pub text: String,
    /// Size.
    pub network: Network,
    /// A ReLU on the text embedding (v1); v2 removed it.
    pub text_relu: bool,
    /// Probability that a caption is replaced by the empty one.
    pub guidance_dropout: f64,
    /// EMA of the weights that is kept as the result; 0 keeps the weights themselves.
    pub ema: f64,
    /// The rest.
    #[serde(flatten)]
    pub training: Training,
}

impl Default for TrainMld {
    fn default() -> Self {
        Self {
            vae: "vae".into(),
            latents: "latents".into(),
            text: "text".into(),
            network: Network::default(),
            text_relu: false,
            guidance_dropout: 0.1,
            ema: 0.0,
            training: Training::published(1_150_000, 64, 1e-4),
        }
    }
}

/// Which distance consistency losses use.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Distance {
    /// `sqrt(d^2 + c^2) - c`.
    Huber,
    /// Mean squared error.
    L2,
}

/// What both distillations share.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Distillation {
    /// Stage that gives the teacher.
    pub teacher: String,
    /// Stage that gives the latents.
    pub latents: String,
    /// Stage that gives the caption embeddings.
    pub text: String,
    /// Guidance scale w is drawn from this range, in the form `cond + w (cond - uncond)`.
    pub guidance: (f64, f64),
    /// Width of the guidance embedding.
    pub guidance_dim: usize,
    /// Solver step k; the grid has 1000/k points.
    pub skip: usize,
    /// Distance.
    pub distance: Distance,
    /// Pseudo-Huber constant c.
    pub huber_c: f64,
    /// Decay of the target network.
    pub ema: f64,
    /// Dropout in the frozen networks, as the original script has it by accident.
    pub upstream_dropout: bool,
    /// The rest.
    #[serde(flatten)]
    pub training: Training,
}

impl Distillation {
    fn published(steps: u64, global: usize) -> Self {
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
            training: Training::published(steps, global, 2e-4),
        }
    }
}

/// `distill.lcm`. Source: MotionLCM.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct DistillLcm {
    /// Everything.
    #[serde(flatten)]
    pub distillation: Distillation,
}

impl Default for DistillLcm {
    fn default() -> Self {
        Self { distillation: Distillation::published(192_000, 128) }
    }
}

/// `distill.pcm`. Source: MotionPCM, Algorithm 1.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct DistillPcm {
    /// M: phases, and sampling steps.
    pub phases: usize,
    /// Weight of the adversarial term; 0 trains without a discriminator.
    pub adversarial: f64,
    /// The discriminator's learning rate; 0 takes `lr`.
    pub discriminator_lr: f64,
    /// The discriminator's AdamW.
    pub discriminator_optimizer: Optimizer,
    /// Everything else.
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
            distillation: Distillation::published(384_000, 128),
        }
    }
}

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

/// Whether a smaller or a larger value is better.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Mode {
    /// Smaller is better.
    Min,
    /// Larger is better.
    Max,
}

/// `register`: model versions, and the best of them promoted.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Register {
    /// Model name.
    pub model: String,
    /// Training stages whose denoisers become versions. The metrics of every `evaluate.*` stage of the pipeline that
    /// looks at one of them go with it.
    pub from: Vec<String>,
    /// Metric that decides which is best.
    pub metric: String,
    /// Its direction.
    pub mode: Mode,
    /// What is promoted; without it nothing is.
    pub promote: Promote,
}

impl Default for Register {
    fn default() -> Self {
        Self {
            model: String::new(),
            from: Vec::new(),
            metric: "latent_fid".into(),
            mode: Mode::Min,
            promote: Promote::default(),
        }
    }
}

/// The promotion at the end of a `register` stage.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct Promote {
    /// Alias; empty promotes nothing.
    pub to: String,
    /// Gates, such as `latent_fid <= 0.3`.
    pub require: Vec<String>,
}

/// A stage's settings, resolved. `kind` in YAML is the serde tag.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(tag = "kind")]
pub enum StageSettings {
    /// Opens a folder.
    #[serde(rename = "data.open")]
    DataOpen(DataOpen),
    /// Makes clips.
    #[serde(rename = "data.synthetic")]
    DataSynthetic(DataSynthetic),
    /// Embeds captions.
    #[serde(rename = "text.embed")]
    TextEmbed(TextEmbed),
    /// Trains a VAE.
    #[serde(rename = "train.vae")]
    TrainVae(TrainVae),
    /// Encodes clips.
    #[serde(rename = "encode.latents")]
    EncodeLatents(EncodeLatents),
    /// Trains a teacher.
    #[serde(rename = "train.mld")]
    TrainMld(TrainMld),
    /// Distils an LCM.
    #[serde(rename = "distill.lcm")]
    DistillLcm(DistillLcm),
    /// Distils a PCM.
    #[serde(rename = "distill.pcm")]
    DistillPcm(DistillPcm),
    /// Measures a VAE.
    #[serde(rename = "evaluate.reconstruction")]
    EvaluateReconstruction(EvaluateReconstruction),
    /// Measures a denoiser.
    #[serde(rename = "evaluate.latent_fid")]
    EvaluateLatentFid(EvaluateLatentFid),
    /// Trains an evaluator.
    #[serde(rename = "train.evaluator")]
    TrainEvaluator(TrainEvaluator),
    /// Reads a published evaluator.
    #[serde(rename = "import.evaluator")]
    ImportEvaluator(ImportEvaluator),
    /// Measures motions in an evaluator's space.
    #[serde(rename = "evaluate.t2m")]
    EvaluateT2m(EvaluateT2m),
    /// Registers and promotes.
    #[serde(rename = "register")]
    Register(Register),
}

impl StageSettings {
    /// Every kind, with default settings: the table from which the pipeline reader learns kinds, keys and types.
    pub fn all() -> Vec<Self> {
        vec![
            Self::DataOpen(DataOpen::default()),
            Self::DataSynthetic(DataSynthetic::default()),
            Self::TextEmbed(TextEmbed::default()),
            Self::TrainVae(TrainVae::default()),
            Self::EncodeLatents(EncodeLatents::default()),
            Self::TrainMld(TrainMld::default()),
            Self::DistillLcm(DistillLcm::default()),
            Self::DistillPcm(DistillPcm::default()),
            Self::EvaluateReconstruction(EvaluateReconstruction::default()),
            Self::EvaluateLatentFid(EvaluateLatentFid::default()),
            Self::TrainEvaluator(TrainEvaluator::default()),
            Self::ImportEvaluator(ImportEvaluator::default()),
            Self::EvaluateT2m(EvaluateT2m::default()),
            Self::Register(Register::default()),
        ]
    }

    /// The settings as they enter a stage's key: references to other stages and paths are blank, because the digests of
    /// what they name stand beside them.
    #[must_use]
    pub fn without_references(&self) -> Self {
        let mut settings = self.clone();
        match &mut settings {
            Self::DataOpen(s) => s.path.clear(),
            Self::DataSynthetic(_) => {}
            Self::TextEmbed(s) => s.dataset.clear(),
            Self::TrainVae(s) => s.dataset.clear(),
            Self::EncodeLatents(s) => {
                s.dataset.clear();
                s.vae.clear();
            }
            Self::TrainMld(s) => {
                s.vae.clear();
                s.latents.clear();
                s.text.clear();
            }
            Self::DistillLcm(DistillLcm { distillation: s }) | Self::DistillPcm(DistillPcm { distillation: s, .. }) => {
                s.teacher.clear();
                s.latents.clear();
                s.text.clear();
            }
            Self::EvaluateReconstruction(s) => {
                s.vae.clear();
                s.dataset.clear();
            }
            Self::EvaluateLatentFid(s) => {
                s.model.clear();
                s.latents.clear();
                s.text.clear();
                s.teacher.clear();
            }
            Self::TrainEvaluator(s) => {
                s.dataset.clear();
                s.words.clear();
            }
            Self::ImportEvaluator(s) => {
                s.path.clear();
                s.words.clear();
            }
            Self::EvaluateT2m(s) => {
                s.model.clear();
                s.vae.clear();
                s.dataset.clear();
                s.text.clear();
                s.evaluator.clear();
            }
            Self::Register(s) => s.from.clear(),
        }
        settings
    }

    /// The name in YAML, such as `train.vae`.
    pub fn kind(&self) -> &'static str {
        match self {
            Self::DataOpen(_) => "data.open",
            Self::DataSynthetic(_) => "data.synthetic",
            Self::TextEmbed(_) => "text.embed",
            Self::TrainVae(_) => "train.vae",
            Self::EncodeLatents(_) => "encode.latents",
            Self::TrainMld(_) => "train.mld",
            Self::DistillLcm(_) => "distill.lcm",
            Self::DistillPcm(_) => "distill.pcm",
            Self::EvaluateReconstruction(_) => "evaluate.reconstruction",
            Self::EvaluateLatentFid(_) => "evaluate.latent_fid",
            Self::TrainEvaluator(_) => "train.evaluator",
            Self::ImportEvaluator(_) => "import.evaluator",
            Self::EvaluateT2m(_) => "evaluate.t2m",
            Self::Register(_) => "register",
        }
    }

    /// Grows when a change of ours changes what the kind computes, so that an old result is not mistaken for a new one.
    pub fn code_version(&self) -> u32 {
        1
    }

    /// How its work is laid over workers.
    pub fn shape(&self) -> Shape {
        match self {
            Self::DataOpen(_) | Self::DataSynthetic(_) | Self::TextEmbed(_) | Self::ImportEvaluator(_) => Shape::Plain,
            Self::TrainVae(_)
            | Self::TrainMld(_)
            | Self::DistillLcm(_)
            | Self::DistillPcm(_)
            | Self::TrainEvaluator(_) => Shape::Gang,
            Self::EncodeLatents(_)
            | Self::EvaluateReconstruction(_)
            | Self::EvaluateLatentFid(_)
            | Self::EvaluateT2m(_) => Shape::Map,
            Self::Register(_) => Shape::Registry,
        }
    }

    /// Shards of a map stage, 1 otherwise.
    pub fn shards(&self) -> u32 {
        let shards = match self {
            Self::EncodeLatents(s) => s.shards,
            Self::EvaluateReconstruction(s) => s.shards,
            Self::EvaluateLatentFid(s) => s.shards,
            Self::EvaluateT2m(s) => s.shards,
            _ => 1,
        };
        u32::try_from(shards.max(1)).unwrap_or(u32::MAX)
    }

    /// Optimizer updates of a training stage.
    pub fn steps(&self) -> Option<Steps> {
        match self {
            Self::TrainVae(s) => Some(s.training.steps),
            Self::TrainMld(s) => Some(s.training.steps),
            Self::DistillLcm(s) => Some(s.distillation.training.steps),
            Self::DistillPcm(s) => Some(s.distillation.training.steps),
            Self::TrainEvaluator(s) => Some(s.training.steps),
            _ => None,
        }
    }

    /// Folders and files outside the store that it reads besides a dataset's, by the field that names them. Their contents
    /// count for its key, not their paths.
    pub fn files(&self) -> Vec<(&'static str, &str)> {
        let fields: &[(&'static str, &String)] = match self {
            Self::TrainEvaluator(s) => &[("words", &s.words)],
            Self::ImportEvaluator(s) => &[("path", &s.path), ("words", &s.words)],
            _ => &[],
        };
        fields.iter().filter(|(_, path)| !path.is_empty()).map(|(field, path)| (*field, path.as_str())).collect()
    }

    /// The model that an evaluation measures.
    pub fn looks_at(&self) -> Option<&str> {
        match self {
            Self::EvaluateLatentFid(s) => Some(&s.model),
            // Shuffled captions say nothing of the model.
            Self::EvaluateT2m(s) if !s.real && !s.shuffled => Some(&s.model),
            _ => None,
        }
    }

    /// What every training stage shares, of one that can be swept.
    pub fn training(&self) -> Option<&Training> {
        match self {
            Self::TrainVae(s) => Some(&s.training),
            Self::TrainMld(s) => Some(&s.training),
            Self::DistillLcm(s) => Some(&s.distillation.training),
            Self::DistillPcm(s) => Some(&s.distillation.training),
            Self::TrainEvaluator(s) => Some(&s.training),
            _ => None,
        }
    }

    /// As [`training`](Self::training), to change it.
    pub fn training_mut(&mut self) -> Option<&mut Training> {
        match self {
            Self::TrainVae(s) => Some(&mut s.training),
            Self::TrainMld(s) => Some(&mut s.training),
            Self::DistillLcm(s) => Some(&mut s.distillation.training),
            Self::DistillPcm(s) => Some(&mut s.distillation.training),
            Self::TrainEvaluator(s) => Some(&mut s.training),
            _ => None,
        }
    }

    /// What its one output is, and what it is called.
    pub fn output(&self) -> (&'static str, ArtifactKind) {
        match self {
            Self::DataOpen(_) | Self::DataSynthetic(_) => ("dataset", ArtifactKind::Dataset),
            Self::TextEmbed(_) => ("embeddings", ArtifactKind::Embeddings),
            Self::TrainVae(_) => ("vae", ArtifactKind::Vae),
            Self::EncodeLatents(_) => ("latents", ArtifactKind::Latents),
            Self::TrainMld(_) | Self::DistillLcm(_) | Self::DistillPcm(_) => ("denoiser", ArtifactKind::Denoiser),
            Self::EvaluateReconstruction(_) | Self::EvaluateLatentFid(_) | Self::EvaluateT2m(_) => {
                ("report", ArtifactKind::Report)
            }
            Self::TrainEvaluator(_) | Self::ImportEvaluator(_) => ("evaluator", ArtifactKind::Evaluator),
            Self::Register(_) => ("model", ArtifactKind::Model),
        }
    }

    /// The stages it reads: field name, stage name, what that stage must give. `register` reads more (the evaluations
    /// of its candidates), which the pipeline adds.
    pub fn inputs(&self) -> Vec<(String, String, ArtifactKind)> {
        let one = |field: &str, stage: &String, kind| (field.to_owned(), stage.clone(), kind);
        match self {
            Self::DataOpen(_) | Self::DataSynthetic(_) | Self::ImportEvaluator(_) => vec![],
            Self::TrainEvaluator(s) => vec![one("dataset", &s.dataset, ArtifactKind::Dataset)],
            Self::EvaluateT2m(s) => {
                let mut inputs = vec![
                    one("dataset", &s.dataset, ArtifactKind::Dataset),
                    one("evaluator", &s.evaluator, ArtifactKind::Evaluator),
                ];
                if !s.real {
                    inputs.push(one("model", &s.model, ArtifactKind::Denoiser));
                    inputs.push(one("vae", &s.vae, ArtifactKind::Vae));
                    inputs.push(one("text", &s.text, ArtifactKind::Embeddings));
                }
                inputs
            }
            Self::TextEmbed(s) => vec![one("dataset", &s.dataset, ArtifactKind::Dataset)],
            Self::TrainVae(s) => vec![one("dataset", &s.dataset, ArtifactKind::Dataset)],
            Self::EncodeLatents(s) => {
                vec![one("dataset", &s.dataset, ArtifactKind::Dataset), one("vae", &s.vae, ArtifactKind::Vae)]
            }
            Self::TrainMld(s) => vec![
                one("vae", &s.vae, ArtifactKind::Vae),
                one("latents", &s.latents, ArtifactKind::Latents),
                one("text", &s.text, ArtifactKind::Embeddings),
            ],
            Self::DistillLcm(DistillLcm { distillation: s }) | Self::DistillPcm(DistillPcm { distillation: s, .. }) => {
                vec![
                    one("teacher", &s.teacher, ArtifactKind::Denoiser),
                    one("latents", &s.latents, ArtifactKind::Latents),
                    one("text", &s.text, ArtifactKind::Embeddings),
                ]
            }
            Self::EvaluateReconstruction(s) => {
                vec![one("vae", &s.vae, ArtifactKind::Vae), one("dataset", &s.dataset, ArtifactKind::Dataset)]
            }
            Self::EvaluateLatentFid(s) => {
                let mut inputs = vec![
                    one("model", &s.model, ArtifactKind::Denoiser),
                    one("latents", &s.latents, ArtifactKind::Latents),
                    one("text", &s.text, ArtifactKind::Embeddings),
                ];
                if !s.teacher.is_empty() {
                    inputs.push(one("teacher", &s.teacher, ArtifactKind::Denoiser));
                }
                inputs
            }
            Self::Register(s) => s
                .from
                .iter()
                .enumerate()
                .map(|(i, stage)| (format!("from[{i}]"), stage.clone(), ArtifactKind::Denoiser))
                .collect(),
        }
    }
}

/// What cannot change a stage's value: where it runs and how often it saves.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, Default)]
pub struct Placement {
    /// How many workers a gang takes.
    pub workers: WorkerRange,
    /// Checkpoint cadence and retention.
    pub checkpoint: CheckpointPolicy,
}

/// How many workers a gang takes.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct WorkerRange {
    /// Below this many it yields and waits.
    pub min: usize,
    /// Above this many it takes no more; 0 is no bound.
    pub max: usize,
}

impl Default for WorkerRange {
    fn default() -> Self {
        Self { min: 1, max: 0 }
    }
}

/// When checkpoints are saved and which are kept.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct CheckpointPolicy {
    /// Saved after every so many steps; 0 saves only when the stage yields.
    pub every: Steps,
    /// Kept.
    pub keep: Keep,
}

impl Default for CheckpointPolicy {
    fn default() -> Self {
        Self { every: Steps(2000), keep: Keep::default() }
    }
}

/// Which checkpoints of a task are kept; the union.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct Keep {
    /// Newest.
    pub latest: usize,
    /// Best by the stage's loss.
    pub best: usize,
}

impl Default for Keep {
    fn default() -> Self {
        Self { latest: 2, best: 0 }
    }
}

/// Which backend computes. Part of a stage's key: other backends give other bits.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Backend {
    /// Burn's pure-Rust CPU backend, with our fused kernels.
    #[default]
    Flex,
    /// Burn's older CPU backend.
    Ndarray,
    /// WebGPU.
    Wgpu,
    /// CUDA.
    Cuda,
}

impl Backend {
    /// The name in YAML and on the command line.
    pub fn name(self) -> &'static str {
        match self {
            Self::Flex => "flex",
            Self::Ndarray => "ndarray",
            Self::Wgpu => "wgpu",
            Self::Cuda => "cuda",
        }
    }
}

/// All that decides a stage's value; its digest is the stage's key.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct StageIdentity {
    /// Settings, without references to other stages and without paths: their digests stand in `inputs`.
    pub settings: StageSettings,
    /// The kind's code version.
    pub code_version: u32,
    /// Artifacts by the field that names them.
    pub inputs: BTreeMap<String, Digest>,
    /// The run's seed.
    pub seed: Seed,
    /// The stage's name keys its randomness, so that two PCM stages of one pipeline draw different noise.
    pub name: StageName,
    /// Which backend computes.
    pub backend: Backend,
}

impl StageIdentity {
    /// The stage's key.
    pub fn key(&self) -> Digest {
        crate::canonical::digest(self)
    }
}
