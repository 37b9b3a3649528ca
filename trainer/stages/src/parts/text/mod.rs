//! Text encoders: they embed captions as conditions for a generator.
//!
//! An encoder is an artifact of kind `text-encoder`. Caption embeddings have their encoder as the part `text`, and so
//! has a model trained on them. So a model always generates with the encoder of its training, including its weights. To
//! add one: an implementation of [`TextEncoder`], a line in the table of [`open`], and its name in
//! [`protocol::stage::TextEncoder`].

mod clip;
mod encoder;
mod hashed;
mod named;
mod published;
mod remembered;
mod t5;
mod table;

pub use encoder::{TextEncoder, TextEncoderMeta};
pub use named::Named;
pub use remembered::forget;
pub use table::{built_in, expect_one_width, open};
