//! Text encoders: they embed captions as conditions for a generator.
//!
//! An encoder is an artifact of kind `text-encoder`. Caption embeddings have their encoder as the part `text`, and so
//! has a model trained on them. So a model always generates with the encoder of its training, including its weights. To
//! add one: an implementation of [`TextEncoder`], a line in the table of [`open`], and its name in
//! [`protocol::stage::TextEncoder`].

mod clip;
mod encoder;
mod hashed;
mod published;
mod remembered;
mod t5;

use burn::tensor::Device;
use checkpoint::Blobs;
use protocol::stage::{TextEmbed, TextEncoder as Choice};
use protocol::{ArtifactKind, Digest, Manifest};
use serde_json::json;

use crate::artifacts;
use crate::context::{AttemptContext, StageError};
use crate::external::Given;

pub use encoder::{TextEncoder, TextEncoderMeta};
use hashed::Hashed;
use published::{Published, Source};
pub use remembered::forget;

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

/// The encoder of a stage's settings, before it is an artifact.
#[derive(Debug)]
pub struct Named(Option<Source>);

impl Named {
    /// Reads the encoder's folder, if it has one.
    ///
    /// # Errors
    /// If a file is missing or invalid.
    pub fn open(settings: &TextEmbed, given: &Given) -> Result<Self, StageError> {
        Ok(Self(Source::open(settings, given)?))
    }

    /// Digest of everything that captions' vectors depend on.
    pub fn digest(&self) -> Digest {
        self.0.as_ref().map_or_else(|| built_in().digest(), Source::digest)
    }

    /// Summary of the tensors in the folder that are not read.
    pub fn skipped(&self) -> Option<String> {
        self.0.as_ref().and_then(Source::skipped)
    }

    /// Uploads the encoder as an artifact.
    ///
    /// # Errors
    /// If the store refuses it.
    pub fn upload(&self, cx: &mut dyn AttemptContext) -> Result<Manifest, StageError> {
        if let Some(source) = &self.0 {
            return source.upload(cx);
        }
        let manifest = built_in();
        cx.put_manifest(&manifest)?;
        Ok(manifest)
    }

    /// Loads the encoder so that it can embed.
    ///
    /// # Errors
    /// If its files are broken.
    pub fn ready(self, settings: &TextEmbed, device: &Device) -> Result<Box<dyn TextEncoder>, StageError> {
        let Some(source) = self.0 else { return Ok(Box::new(Hashed)) };
        let published = source.into_published()?;
        match settings.encoder {
            Choice::Clip => clip::open(published, device),
            _ => t5::open(published, device),
        }
    }
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
