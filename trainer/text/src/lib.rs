//! Published text encoders without tensors: the contents of their folders, and captions as token ids.
//!
//! [`EncoderFolder::open`] reads a folder in the layout of Hugging Face or of sentence-transformers: sizes, tokenizer,
//! and the place of each weight. All parts are checked against each other before memory is allocated: shapes against
//! sizes, ids against the token table. [`Description`] and the bytes of [`EncoderFolder::tokenizer_json`] and
//! [`EncoderFolder::weights`] are sufficient to use the encoder without its folder.
//!
//! Not its job: networks, and the definition of an artifact.

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
pub use weights::{StoredTensor, Weights, archive_length, no_torch};
