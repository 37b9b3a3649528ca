//! The encoder that a stage's settings name.

use burn::tensor::Device;
use protocol::stage::{TextEmbed, TextEncoder as Choice};
use protocol::{Digest, Manifest};

use super::encoder::TextEncoder;
use super::hashed::Hashed;
use super::published::Source;
use super::table::built_in;
use super::{clip, t5};
use crate::context::{AttemptContext, StageError};
use crate::external::Given;

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
