//! The manifest: what an artifact or a checkpoint is made of.
//!
//! A manifest is a small canonical JSON document that lists blobs by digest; its own digest names the artifact. Parts
//! that two artifacts share (a frozen VAE in every student) are stored once.

use std::borrow::Cow;
use std::collections::BTreeMap;
use std::fmt;

use serde::{Deserialize, Serialize};

use crate::{Digest, canonical};

/// What kind of thing an artifact is. A stage that is handed another kind is refused before anything runs.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum ArtifactKind {
    /// Clips, captions, splits and normalisation.
    Dataset,
    /// Caption embeddings.
    Embeddings,
    /// A motion VAE.
    Vae,
    /// VAE posteriors of a dataset.
    Latents,
    /// Turns motion into tokens, and back.
    Tokenizer,
    /// Token ids of a dataset.
    Tokens,
    /// Turns tokens into motion along a flow.
    FlowDecoder,
    /// Draws token ids for captions.
    TokenGenerator,
    /// Turns captions into vectors.
    TextEncoder,
    /// A latent denoiser: teacher or student.
    Denoiser,
    /// Embeds captions and motions in one space.
    Evaluator,
    /// Estimates the length of a motion from its caption.
    Length,
    /// Tells a latent denoiser which positions to pass.
    Control,
    /// Metrics of an evaluation.
    Report,
    /// A generator and its parts: everything that drawing a motion needs.
    Model,
    /// All that continuing a training stage bit for bit needs.
    Checkpoint,
    /// What one shard of a map stage made; merged into the stage's artifact.
    Shard,
}

impl ArtifactKind {
    /// Whether a registered model is one or has one as a part, so that a version may stand where a stage gives it.
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

    /// What it is called in a message.
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

/// What an artifact is for in a model: `denoiser`, `vae`, `text`, `length`, `control`.
///
/// A role is a text, not a list of those there are: storing, registering, exporting and showing models handle each alike. Files of a
/// model bear it as a folder's name, so it consists of small letters, digits and `-`.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(try_from = "String", into = "String")]
pub struct Role(Cow<'static, str>);

impl Role {
    /// The network that removes noise.
    pub const DENOISER: Self = Self(Cow::Borrowed("denoiser"));
    /// Turns latents into motion.
    pub const VAE: Self = Self(Cow::Borrowed("vae"));
    /// The network that draws tokens.
    pub const GENERATOR: Self = Self(Cow::Borrowed("generator"));
    /// Turns tokens into motion instead of the tokenizer.
    pub const DECODER: Self = Self(Cow::Borrowed("decoder"));
    /// Turns tokens into motion.
    pub const TOKENIZER: Self = Self(Cow::Borrowed("tokenizer"));
    /// Turns captions into what the generator is conditioned on.
    pub const TEXT: Self = Self(Cow::Borrowed("text"));
    /// Tells the denoiser which positions to pass.
    pub const CONTROL: Self = Self(Cow::Borrowed("control"));
    /// Says how long a caption's motion is when nobody else does.
    pub const LENGTH: Self = Self(Cow::Borrowed("length"));

    /// Its name.
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
            false => Err(format!("{name:?} is not a part's role; expected small letters, digits and `-`, at most 64")),
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
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct FileEntry {
    /// The blob.
    pub digest: Digest,
    /// Its length.
    pub bytes: u64,
}

/// What an artifact is made of.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Manifest {
    /// The version of this document, [`Manifest::FORMAT`].
    pub format: u32,
    /// What it is.
    pub kind: ArtifactKind,
    /// What a reader must know before it opens a file: shapes, settings, lineage. Never a clock, a host or a path.
    pub meta: serde_json::Value,
    /// Files by name.
    pub files: BTreeMap<String, FileEntry>,
}

impl Manifest {
    /// The version that this build writes.
    pub const FORMAT: u32 = 1;

    /// An artifact without files yet.
    pub fn new(kind: ArtifactKind, meta: serde_json::Value) -> Self {
        Self { format: Self::FORMAT, kind, meta, files: BTreeMap::new() }
    }

    /// The bytes that are stored and hashed.
    pub fn to_bytes(&self) -> Vec<u8> {
        canonical::to_bytes(self)
    }

    /// The artifact's name.
    pub fn digest(&self) -> Digest {
        Digest::of(&self.to_bytes())
    }
}
