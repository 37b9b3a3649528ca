//! The table of text encoders, by their names in manifests.

use burn::tensor::Device;
use checkpoint::Blobs;
use protocol::stage::TextEncoder as Choice;
use protocol::{ArtifactKind, Manifest};
use serde_json::json;

use super::encoder::{TextEncoder, TextEncoderMeta};
use super::hashed::Hashed;
use super::published::Published;
use super::{clip, t5};
use crate::artifacts;
use crate::context::StageError;

/// Opens an encoder from its manifest.
type Open = fn(&Manifest, &dyn Blobs, &Device) -> Result<Box<dyn TextEncoder>, StageError>;

/// Every encoder by its name in manifests.
const ENCODERS: [(&str, Open); 4] = [
    ("hashed", |_, _, _| Ok(Box::new(Hashed))),
    ("clip", |manifest, blobs, device| clip::open(Published::of_artifact(manifest, blobs)?, device)),
    ("t5", |manifest, blobs, device| t5::open(Published::of_artifact(manifest, blobs)?, device)),
    ("sentence-t5", |manifest, blobs, device| t5::open(Published::of_artifact(manifest, blobs)?, device)),
];

/// Opens the encoder of an artifact of kind `text-encoder`.
pub fn open(manifest: &Manifest, blobs: &dyn Blobs, device: &Device) -> Result<Box<dyn TextEncoder>, StageError> {
    artifacts::expect("the text encoder", manifest, ArtifactKind::TextEncoder)?;
    let meta: TextEncoderMeta = artifacts::meta(manifest, "the text encoder")?;
    let Some((_, open)) = ENCODERS.iter().find(|(name, _)| *name == meta.encoder) else {
        let have: Vec<&str> = ENCODERS.iter().map(|(name, _)| *name).collect();
        let wanted = meta.encoder;
        return Err(StageError::Input(format!(
            "this build has no text encoder `{wanted}`; it has {}",
            have.join(", ")
        )));
    };
    let encoder = open(manifest, blobs, device)?;
    if encoder.dim() != meta.dim {
        let found = encoder.dim();
        let said = meta.dim;
        return Err(StageError::Input(format!(
            "text encoder `{}` returns {found} numbers; its manifest declares {said}",
            meta.encoder
        )));
    }
    Ok(encoder)
}

/// Refuses an encoder with different widths of captions' and tokens' vectors, for a network that has one width for
/// both.
///
/// # Errors
/// If the widths differ; the message has both.
pub fn expect_one_width(encoder: &dyn TextEncoder) -> Result<(), StageError> {
    let pooled = encoder.dim();
    let tokens = encoder.token_dim();
    if pooled == tokens {
        return Ok(());
    }
    Err(StageError::Input(format!(
        "the text encoder returns {pooled} numbers per caption and {tokens} per token, but this network needs the same \
         width for both; use an encoder such as `clip-vit-base-patch32`, or set `output: pooled`"
    )))
}

/// The manifest of the built-in encoder.
pub fn built_in() -> Manifest {
    let meta = json!({"encoder": Choice::Hashed.name(), "dim": Hashed.dim()});
    Manifest::new(ArtifactKind::TextEncoder, meta)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Every encoder that settings can name is in the table.
    #[test]
    fn every_choice_is_in_the_table() {
        for choice in [Choice::Hashed, Choice::Clip, Choice::T5, Choice::SentenceT5] {
            assert!(ENCODERS.iter().any(|(name, _)| *name == choice.name()), "{choice:?}");
        }
    }
}
