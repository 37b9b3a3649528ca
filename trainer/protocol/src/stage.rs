//! The settings of each stage kind: plain structs whose `Default` is the published recipe where there is one.
//!
//! A settings struct is the schema too: the pipeline reader learns the closed set of keys and their types from the
//! serialised default, so a field is declared once. Fields that cannot change a stage's value (worker counts,
//! checkpoint cadence) live in [`Placement`] and stay out of the stage's key.
//!
//! A store outlives the build that wrote it. Every struct that has a `Default` fills in what an older build did not write; a field that
//! joins one that has none ([`Training`], [`Batch`]) brings `#[serde(default)]` along. What that means for keys stands in `later`.

mod data;
mod diffusion;
mod evaluation;
mod evaluator;
mod identity;
pub(crate) mod later;
mod network;
mod placement;
mod register;
mod training;
mod vae;

use serde::{Deserialize, Serialize};

use crate::{ArtifactKind, Digest, Steps};

pub use data::{DataFormat, DataOpen, DataSynthetic, TextEmbed, TextEncoder};
pub use diffusion::{Distance, DistillLcm, DistillPcm, Distillation, TrainMld};
pub use evaluation::{EvaluateLatentFid, EvaluateReconstruction, Sampler, Split};
pub use evaluator::{EvaluateT2m, EvaluatorNetwork, ImportEvaluator, MovementPhase, MultiModality, TrainEvaluator};
pub use identity::{Backend, StageIdentity};
pub use network::{LatentShape, Network, Positions};
pub use placement::{CheckpointPolicy, Keep, Placement, WorkerRange};
pub use register::{Mode, Promote, Register};
pub use training::{Batch, Decay, Optimizer, Training};
pub use vae::{EncodeLatents, TrainVae, VaeLoss, Windows};

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

    /// The digest of all that decides a value, references left out.
    pub fn digest(&self) -> Digest {
        crate::canonical::digest(&later::settings(&self.without_references()))
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
        match self {
            // 2: PA-MPJPE, accelerations, sJPE, skating.
            Self::EvaluateReconstruction(_) => 2,
            // 2: retrieval among latents has names of its own.
            Self::EvaluateLatentFid(_) => 2,
            _ => 1,
        }
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
    pub fn evaluated_model(&self) -> Option<&str> {
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
