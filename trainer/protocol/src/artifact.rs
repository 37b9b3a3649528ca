//! The manifest of an artifact or a checkpoint.
//!
//! A manifest is a small canonical JSON document that lists blobs by digest; its own digest names the artifact. Parts
//! that two artifacts share (a frozen VAE in every student) are stored once.

use std::borrow::Cow;
use std::collections::BTreeMap;
use std::fmt;

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use crate::{Digest, canonical, limits, printable};

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
    /// Digest of the file.
    pub digest: Digest,
    /// Length of the file in bytes.
    pub bytes: u64,
    /// The blobs whose concatenation is the file. Empty if the file is one blob, named by `digest`.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub chunks: Vec<Chunk>,
}

/// A blob that holds a file or a part of one.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
pub struct Chunk {
    /// Digest of the blob.
    pub digest: Digest,
    /// Length of the blob in bytes.
    pub bytes: u64,
}

impl FileEntry {
    /// Creates the entry of a file that is one blob.
    pub fn of_blob(digest: Digest, bytes: u64) -> Self {
        Self { digest, bytes, chunks: Vec::new() }
    }

    /// The blobs that hold the file, in order. Everything that walks the blobs of a manifest uses this.
    pub fn blobs(&self) -> impl Iterator<Item = Chunk> + '_ {
        let whole = self.chunks.is_empty().then_some(Chunk { digest: self.digest, bytes: self.bytes });
        whole.into_iter().chain(self.chunks.iter().copied())
    }

    /// Checks the lengths of an untrusted entry.
    ///
    /// # Errors
    /// The reason why no file can have this entry.
    pub fn check(&self) -> Result<(), String> {
        if self.bytes > limits::FILE_BYTES {
            return Err(format!("it has {} bytes; expected at most {}", self.bytes, limits::FILE_BYTES));
        }
        if self.chunks.len() > limits::FILE_CHUNKS {
            return Err(format!("it has {} chunks; expected at most {}", self.chunks.len(), limits::FILE_CHUNKS));
        }
        let most = limits::BLOB_BYTES as u64;
        let mut total = 0u64;
        for blob in self.blobs() {
            if blob.bytes > most {
                return Err(format!("its blob {} has {} bytes; expected at most {most}", blob.digest, blob.bytes));
            }
            total = total.saturating_add(blob.bytes);
        }
        if total != self.bytes {
            return Err(format!("its chunks have {total} bytes together, and the file has {}", self.bytes));
        }
        Ok(())
    }
}

/// Kind, meta and files of an artifact.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct Manifest {
    /// Version of this document; see [`Manifest::list`].
    pub format: u32,
    pub kind: ArtifactKind,
    /// Data that a reader needs before it opens a file: shapes, settings, lineage. Never a clock, a host or a path.
    pub meta: serde_json::Value,
    /// Files by name; [`Manifest::list`] adds to them.
    pub files: BTreeMap<String, FileEntry>,
}

impl Manifest {
    /// Newest format that this build reads.
    pub const FORMAT: u32 = 2;
    /// Format of a manifest whose files are one blob each. Its digest is the same in every build.
    const WITHOUT_CHUNKS: u32 = 1;

    /// Creates a manifest without files.
    pub fn new(kind: ArtifactKind, meta: serde_json::Value) -> Self {
        Self { format: Self::WITHOUT_CHUNKS, kind, meta, files: BTreeMap::new() }
    }

    /// Adds files. A manifest with chunks has format 2, because a build that reads format 1 would delete the chunks as
    /// unneeded.
    pub fn list(&mut self, files: impl IntoIterator<Item = (String, FileEntry)>) {
        self.files.extend(files);
        self.format = self.expected_format();
    }

    fn expected_format(&self) -> u32 {
        if self.files.values().any(|file| !file.chunks.is_empty()) { Self::FORMAT } else { Self::WITHOUT_CHUNKS }
    }

    /// Returns true if this build reads the manifest's format.
    pub fn is_readable(&self) -> bool {
        (Self::WITHOUT_CHUNKS..=Self::FORMAT).contains(&self.format)
    }

    /// Checks the files of an untrusted manifest.
    ///
    /// # Errors
    /// The file that is invalid, and the reason.
    pub fn check_files(&self) -> Result<(), String> {
        if self.format < self.expected_format() {
            return Err(format!("it has format {}, and a file has chunks", self.format));
        }
        for (name, file) in &self.files {
            file.check().map_err(|why| format!("file `{}`: {why}", printable(name)))?;
        }
        Ok(())
    }

    /// The blobs of all files.
    pub fn blobs(&self) -> impl Iterator<Item = Chunk> + '_ {
        self.files.values().flat_map(FileEntry::blobs)
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

#[cfg(test)]
#[allow(clippy::unwrap_used, reason = "a test may panic")]
mod tests {
    use super::*;

    fn chunk(text: &str) -> Chunk {
        Chunk { digest: Digest::of(text.as_bytes()), bytes: text.len() as u64 }
    }

    /// An older build reads and names a manifest without chunks, and refuses one with chunks.
    #[test]
    fn only_a_manifest_with_chunks_has_the_newer_format() {
        let whole = FileEntry::of_blob(Digest::of(b"ab"), 2);
        let cut = FileEntry { chunks: vec![chunk("a"), chunk("b")], ..whole.clone() };
        let mut manifest = Manifest::new(ArtifactKind::Checkpoint, serde_json::Value::Null);
        manifest.list([("state".to_owned(), whole.clone())]);
        let text = String::from_utf8(manifest.to_bytes()).unwrap();
        let digest = whole.digest;
        assert_eq!(
            text,
            format!(
                r#"{{"files":{{"state":{{"bytes":2,"digest":"{digest}"}}}},"format":1,"kind":"checkpoint","meta":null}}"#
            )
        );
        manifest.list([("state".to_owned(), cut.clone())]);
        assert_eq!(manifest.format, 2);
        let read: Manifest = serde_json::from_slice(&manifest.to_bytes()).unwrap();
        assert_eq!(read, manifest);
        assert!(read.is_readable() && read.check_files().is_ok());
        assert_eq!(read.blobs().collect::<Vec<_>>(), [chunk("a"), chunk("b")]);
        let older = Manifest { format: 1, ..read };
        assert!(older.check_files().is_err());
        manifest.list([("state".to_owned(), whole)]);
        assert_eq!(manifest.format, 1);
        assert!(!Manifest { format: 3, ..manifest }.is_readable());
    }

    #[test]
    fn lengths_that_do_not_fit_are_refused() {
        let file = |bytes: u64, chunks: Vec<Chunk>| FileEntry { digest: Digest::of(b"ab"), bytes, chunks }.check();
        assert_eq!(file(limits::BLOB_BYTES as u64, Vec::new()), Ok(()));
        assert!(file(limits::BLOB_BYTES as u64 + 1, Vec::new()).unwrap_err().contains("its blob"));
        let long = |bytes: u64| Chunk { bytes, ..chunk("a") };
        let most = vec![long(limits::CHUNK_BYTES); limits::FILE_CHUNKS];
        assert_eq!(file(limits::FILE_BYTES, most.clone()), Ok(()));
        assert!(file(limits::FILE_BYTES + 1, most.clone()).unwrap_err().contains("expected at most 549755813888"));
        let more = [most, vec![long(0)]].concat();
        assert!(file(limits::FILE_BYTES, more).unwrap_err().contains("513 chunks"));
        assert!(file(3, vec![chunk("a"), chunk("b")]).unwrap_err().contains("2 bytes together"));
        assert!(file(1, vec![long(u64::MAX), long(2)]).is_err());
    }
}
