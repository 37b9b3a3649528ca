//! The list of stage kinds. A kind is its file here, its file in `stages::kinds` that runs it, and a line in each of
//! the two lists.

mod data_features;
mod data_open;
mod data_synthetic;
mod distill_discord;
mod distill_lcm;
mod distill_pcm;
mod encode_latents;
mod encode_tokens;
mod evaluate_control;
mod evaluate_latent_fid;
mod evaluate_recognition;
mod evaluate_reconstruction;
mod evaluate_spectrum;
mod evaluate_t2m;
mod import_evaluator;
mod import_model;
mod model_decoder;
mod register;
mod text_embed;
mod train_control;
mod train_discord;
mod train_evaluator;
mod train_length;
mod train_mdm;
mod train_mld;
mod train_stablemofusion;
mod train_tokenizer;
mod train_tokens;
mod train_vae;

pub use data_features::{DataFeatures, Splits, UpAxis};
pub use data_open::DataOpen;
pub use data_synthetic::DataSynthetic;
pub use distill_discord::DistillDiscord;
pub use distill_lcm::DistillLcm;
pub use distill_pcm::DistillPcm;
pub use encode_latents::EncodeLatents;
pub use encode_tokens::EncodeTokens;
pub use evaluate_control::EvaluateControl;
pub use evaluate_latent_fid::EvaluateLatentFid;
pub use evaluate_recognition::{Activity, EvaluateRecognition};
pub use evaluate_reconstruction::EvaluateReconstruction;
pub use evaluate_spectrum::EvaluateSpectrum;
pub use evaluate_t2m::{EvaluateT2m, MultiModality};
pub use import_evaluator::ImportEvaluator;
pub use import_model::{ImportModel, ImportedPart, TextActivation};
pub use model_decoder::ModelDecoder;
pub use register::{Promote, Register};
pub use text_embed::{ClipIds, ClipOutput, TextEmbed, TextEncoder};
pub use train_control::{ControlDistance, ControlFeedback, ControlLoss, ControlMean, TrainControl};
pub use train_discord::{FlowBackbone, FlowNetwork, FlowPrediction, FlowProjection, TrainDiscord};
pub use train_evaluator::{EvaluatorNetwork, MovementPhase, TrainEvaluator};
pub use train_length::TrainLength;
pub use train_mdm::{MdmNetwork, TrainMdm};
pub use train_mld::TrainMld;
pub use train_stablemofusion::{StableMoFusionNetwork, TrainStableMoFusion};
pub use train_tokenizer::{Resets, TokenizerLoss, TokenizerNetwork, TrainTokenizer, WindowsOf};
pub use train_tokens::{TokenGenerator, TokenNetwork, TrainTokens};
pub use train_vae::{TrainVae, VaeLoss, Windows};

use super::StageSpec;

super::spec::stage_kinds! {
    DataOpen,
    DataSynthetic,
    DataFeatures,
    TextEmbed,
    TrainVae,
    EncodeLatents,
    TrainMld,
    DistillLcm,
    DistillPcm,
    EvaluateReconstruction,
    EvaluateLatentFid,
    TrainEvaluator,
    TrainLength,
    TrainTokenizer,
    EncodeTokens,
    TrainTokens,
    TrainDiscord,
    DistillDiscord,
    ModelDecoder,
    TrainMdm,
    TrainStableMoFusion,
    TrainControl,
    EvaluateControl,
    EvaluateSpectrum,
    EvaluateRecognition,
    ImportEvaluator,
    ImportModel,
    EvaluateT2m,
    Register,
}
