//! Published text encoders without tensors: what lies in their folders, and captions as their token ids.
//!
//! [`EncoderFolder::open`] reads a folder in the layout of Hugging Face or of sentence-transformers: sizes, tokenizer, where each weight is. Everything
//! is held against everything before memory is asked for: shapes against sizes, ids against the token table. [`Description`] and the bytes
//! of [`EncoderFolder::tokenizer_json`] and [`EncoderFolder::weights`] are all that is needed to use the encoder where its folder is not.
//!
//! Not its job: networks; what an artifact is.

mod error;
mod folder;
mod network;
mod repair;
mod rules;
mod tensor_file;
mod tokenizer;
mod weights;

pub use error::EncoderError;
pub use folder::{DENSE, Description, EncoderFolder, Head, Kind, Request, TokenIds};
pub use network::{ClipSizes, Network, T5Sizes, TensorSpec};
pub use repair::repaired;
pub use rules::Rules;
pub use tensor_file::{Element, ReadAt, TensorFile, WeightsFile, widen};
pub use tokenizer::Tokenizer;
pub use weights::{StoredTensor, Weights, archive_length};
