//! The manifest of an artifact or a checkpoint.
//!
//! A manifest is a small canonical JSON document that lists blobs by digest; its own digest names the artifact. Parts
//! that two artifacts share (a frozen VAE in every student) are stored once.

use std::borrow::Cow;
use std::collections::BTreeMap;
use std::fmt;

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use crate::{Digest, canonical};

/// Kind of an artifact. A stage refuses an input of another kind before anything runs.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "kebab-case")]
pub enum ArtifactKind {
    /// Clips, captions, splits and normalisation.
    Dataset,
    /// Caption embeddings with their encoder.
    Embeddings,
    /// A motion VAE.
    Vae,
    /// VAE posteriors of a dataset.
    Latents,
    /// Converts motion into tokens, and back.
    Tokenizer,
    /// Token ids of a dataset.
    Tokens,
    /// Converts tokens into motion along a flow.
    FlowDecoder,
    /// Draws token ids for captions.
    TokenGenerator,
    /// Converts captions into vectors.
    TextEncoder,
    /// A latent denoiser: teacher or student.
    Denoiser,
    /// Embeds captions and motions in one space.
    Evaluator,
    /// Estimates the length of a motion from its caption.
    Length,
    /// Steers a latent denoiser towards target positions.
    Control,
    /// Metrics of an evaluation.
    Report,
    /// A generator with all parts that generating a motion needs.
    Model,
    /// Everything that continuing a training stage bit for bit needs.
    Checkpoint,
    /// Result of one shard of a map stage; merged into the stage's artifact.
    Shard,
}

impl ArtifactKind {
    /// Returns true if a registered model is of this kind or has a part of it, so that a version may replace a stage.
    pub fn is_of_models(self) -> bool {
        match self {
            Self::Vae
            | Self::Tokenizer
            | Self::FlowDecoder
            | Self::TokenGenerator
            | Self::TextEncoder
            | Self::Denoiser
            | Self::Evaluator
            | Self::Length
            | Self::Control
            | Self::Model => true,
            Self::Dataset
            | Self::Embeddings
            | Self::Latents
            | Self::Tokens
            | Self::Report
            | Self::Checkpoint
            | Self::Shard => false,
        }
    }

    /// Name of the kind in messages.
    pub fn noun(self) -> &'static str {
        match self {
            Self::Dataset => "a dataset",
            Self::Embeddings => "caption embeddings",
            Self::Vae => "a VAE",
            Self::Latents => "latents",
            Self::Tokenizer => "a tokenizer",
            Self::Tokens => "tokens",
            Self::FlowDecoder => "a flow decoder",
            Self::TokenGenerator => "a token generator",
            Self::TextEncoder => "a text encoder",
            Self::Denoiser => "a denoiser",
            Self::Evaluator => "an evaluator",
            Self::Length => "a length estimator",
            Self::Control => "a control part",
            Self::Report => "a report",
            Self::Model => "a model",
            Self::Checkpoint => "a checkpoint",
            Self::Shard => "a shard",
        }
    }
}

/// Role of an artifact in a model: `denoiser`, `vae`, `text`, `length`, `control`.
///
/// A role is a text and not an enum, because storing, registering, exporting and showing models treat all roles alike.
/// A role is also the name of a folder of a model's files, so it consists of small letters, digits and `-`.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize, JsonSchema)]
#[serde(try_from = "String", into = "String")]
#[schemars(with = "String")]
pub struct Role(Cow<'static, str>);

impl Role {
    /// The network that removes noise.
    pub const DENOISER: Self = Self(Cow::Borrowed("denoiser"));
    /// Decodes latents to motion.
    pub const VAE: Self = Self(Cow::Borrowed("vae"));
    /// The network that draws tokens.
    pub const GENERATOR: Self = Self(Cow::Borrowed("generator"));
    /// Decodes tokens to motion instead of the tokenizer.
    pub const DECODER: Self = Self(Cow::Borrowed("decoder"));
    /// Decodes tokens to motion.
    pub const TOKENIZER: Self = Self(Cow::Borrowed("tokenizer"));
    /// Encodes captions as the condition of the generator.
    pub const TEXT: Self = Self(Cow::Borrowed("text"));
    /// Steers the denoiser towards target positions.
    pub const CONTROL: Self = Self(Cow::Borrowed("control"));
    /// Default length of a caption's motion.
    pub const LENGTH: Self = Self(Cow::Borrowed("length"));

    /// The role as text.
    pub fn as_str(&self) -> &str {
        &self.0
    }
}

impl TryFrom<String> for Role {
    type Error = String;

    fn try_from(name: String) -> Result<Self, String> {
        let known = |c: u8| c.is_ascii_lowercase() || c.is_ascii_digit() || c == b'-';
        match !name.is_empty() && name.len() <= 64 && name.bytes().all(known) {
            true => Ok(Self(Cow::Owned(name))),
            false => Err(format!(
                "{name:?} is not a valid role; expected lowercase letters, digits and `-`, at most 64 characters"
            )),
        }
    }
}

impl From<Role> for String {
    fn from(role: Role) -> Self {
        role.0.into_owned()
    }
}

impl fmt::Display for Role {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.0)
    }
}

/// One file of an artifact.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
pub struct FileEntry {
    /// Digest of the blob.
    pub digest: Digest,
    /// Length of the blob in bytes.
    pub bytes: u64,
}

/// Kind, meta and files of an artifact.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct Manifest {
    /// Version of this document, [`Manifest::FORMAT`].
    pub format: u32,
    pub kind: ArtifactKind,
    /// Data that a reader needs before it opens a file: shapes, settings, lineage. Never a clock, a host or a path.
    pub meta: serde_json::Value,
    /// Files by name.
    pub files: BTreeMap<String, FileEntry>,
}

impl Manifest {
    /// Format version that this build writes.
    pub const FORMAT: u32 = 1;

    /// Creates a manifest without files.
    pub fn new(kind: ArtifactKind, meta: serde_json::Value) -> Self {
        Self { format: Self::FORMAT, kind, meta, files: BTreeMap::new() }
    }

    /// Serialises the bytes that are stored and hashed.
    pub fn to_bytes(&self) -> Vec<u8> {
        canonical::to_bytes(self)
    }

    /// Digest of the bytes, the artifact's name.
    pub fn digest(&self) -> Digest {
        Digest::of(&self.to_bytes())
    }

    /// Digests in its own words, such as the teacher's in a student's.
    pub fn mentions(&self) -> Vec<Digest> {
        let mut found = Vec::new();
        mentioned(&self.meta, &mut found);
        found
    }
}

/// Adds all digests in `meta` to `found`.
pub fn mentioned(meta: &serde_json::Value, found: &mut Vec<Digest>) {
    use serde_json::Value;

    match meta {
        Value::String(text) => found.extend(text.parse::<Digest>()),
        Value::Array(items) => items.iter().for_each(|item| mentioned(item, found)),
        Value::Object(map) => map.values().for_each(|item| mentioned(item, found)),
        Value::Null | Value::Bool(_) | Value::Number(_) => {}
    }
}
