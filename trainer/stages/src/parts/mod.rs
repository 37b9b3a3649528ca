//! Reads the parts of models, and assembles models; [`checkpoint::model`] defines a model.

pub mod control;
pub mod evaluator;
pub(crate) mod feedback;
pub mod flow_decoder;
pub mod hint;
pub mod latent_networks;
pub mod length;
mod model;
pub mod motion_networks;
pub mod steering;
pub mod text;
pub mod tokenizer;
pub(crate) mod warm_start;
pub mod weights;
pub mod word_vectors;

pub use model::{manifest, model_error, part, publish_model};
