//! `text.embed`: embeds every caption of a dataset as a vector, once. `hashed` is ours; the others are published
//! encoders, read from their folders: CLIP (Radford et al., arXiv:2103.00020), T5 (Raffel et al., arXiv:1910.10683),
//! Sentence-T5 (Ni et al., arXiv:2108.08877).

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use crate::ArtifactKind;
use crate::stage::{Output, Problems, Ref, Shape, StageSpec};

/// Files that an encoder's folder must have; `|` separates alternatives.
const CLIP_FILES: [&str; 3] = [
    "config.json|modules.json",
    "tokenizer.json|vocab.json|modules.json",
    "model.safetensors|model.safetensors.index.json|pytorch_model.bin|modules.json",
];
const T5_FILES: [&str; 3] = [
    "config.json|modules.json",
    "tokenizer.json|modules.json",
    "model.safetensors|model.safetensors.index.json|pytorch_model.bin|modules.json",
];
const SENTENCE_T5_FILES: [&str; 1] = ["modules.json"];

/// `text: {encoder: sentence-t5, path: data/sentence-t5-large}`, or `text: {encoder: hashed}`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default)]
pub struct TextEmbed {
    /// Encoder of the captions.
    pub encoder: TextEncoder,
    /// Folder with the published encoder, in the layout of Hugging Face or of sentence-transformers. If there is no
    /// such folder, its name on huggingface.co, such as `sentence-transformers/sentence-t5-large`. `hashed` has none.
    /// The stage's key has the digest of its content, not its path.
    pub path: String,
    /// Branch, tag or commit of a name on huggingface.co; empty is `main`. Not part of the key either.
    pub revision: String,
    /// Vector of CLIP for a caption; its words are the states of all tokens in either case.
    pub output: ClipOutput,
    /// Conversion of captions to CLIP's token ids.
    pub ids: ClipIds,
    /// Largest number of tokens of a caption, its end included; 0 uses the number in the encoder's folder. MDM reads
    /// 22.
    #[schemars(range(min = 0, max = 4_096), extend("x-unit" = "tokens"))]
    pub max_tokens: usize,
    /// Number of shards.
    #[schemars(range(min = 1, max = crate::limits::SHARDS), extend("x-unit" = "shards"))]
    pub shards: usize,
    /// Stage whose captions are embedded.
    pub dataset: String,
}

impl Default for TextEmbed {
    fn default() -> Self {
        Self {
            encoder: TextEncoder::Hashed,
            path: String::new(),
            revision: String::new(),
            output: ClipOutput::Projected,
            ids: ClipIds::HuggingFace,
            max_tokens: 0,
            shards: 1,
            dataset: "dataset".into(),
        }
    }
}

/// Encoder that embeds a caption as a vector.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "kebab-case")]
pub enum TextEncoder {
    /// Words and word pairs hashed into 768 signed coordinates, L2-normalised; needs no weights.
    Hashed,
    /// CLIP's text tower: MLD, MDM, T2M-GPT, MoMask, MMM, StableMoFusion.
    Clip,
    /// T5's encoder: the states of the tokens, and their mean.
    T5,
    /// Sentence-T5: mean of the tokens, dense layer, L2-normalised. MotionLCM, MotionPCM.
    SentenceT5,
}

/// Vector of CLIP for a caption; never normalised.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "kebab-case")]
pub enum ClipOutput {
    /// The projected state of the end token, which published models read.
    Projected,
    /// The state of the end token before the projection.
    Pooled,
}

/// Conversion of captions to CLIP's token ids.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
pub enum ClipIds {
    /// The folder's tokenizer, padded with the end token: MLD.
    #[serde(rename = "huggingface")]
    HuggingFace,
    /// OpenAI's package: the text is repaired first and padded with zeros, which affect only states of tokens: MDM,
    /// T2M-GPT, MoMask, MMM, StableMoFusion.
    #[serde(rename = "openai")]
    OpenAi,
}

impl TextEncoder {
    /// Name in YAML, and in the encoder's artifacts.
    pub fn name(self) -> &'static str {
        match self {
            Self::Hashed => "hashed",
            Self::Clip => "clip",
            Self::T5 => "t5",
            Self::SentenceT5 => "sentence-t5",
        }
    }

    /// Returns true if a ReLU leaves enough of its vectors. A hashed word is one coordinate, -1 as often as +1. So half
    /// of the words would be lost, and so would the empty caption.
    pub fn survives_relu(self) -> bool {
        self != Self::Hashed
    }

    /// Required files of its folder, and their source.
    fn folder(self) -> (&'static [&'static str], &'static str) {
        match self {
            Self::Hashed => (&[], ""),
            Self::Clip => (
                &CLIP_FILES,
                "CLIP's text tower, such as huggingface.co/openai/clip-vit-base-patch32 (MLD: clip-vit-large-patch14)",
            ),
            Self::T5 => (&T5_FILES, "T5's encoder, such as huggingface.co/google-t5/t5-large"),
            Self::SentenceT5 => {
                (&SENTENCE_T5_FILES, "Sentence-T5, such as huggingface.co/sentence-transformers/sentence-t5-large")
            }
        }
    }
}

impl StageSpec for TextEmbed {
    const KIND: &'static str = "text.embed";
    // Version 2 stores the encoder, version 3 adds published encoders and shards, version 4 rounds GELU differently.
    const VERSION: u32 = 5;
    const SHAPE: Shape = Shape::Map;
    const OUTPUT: Output = Output { name: "embeddings", kind: ArtifactKind::Embeddings };

    fn refs(&mut self) -> Vec<Ref<'_>> {
        let (files, origin) = self.encoder.folder();
        let reads = self.encoder != TextEncoder::Hashed;
        vec![
            Ref::folder("path", &mut self.path).holding(files, origin).only_if(reads),
            Ref::stage("dataset", &mut self.dataset, ArtifactKind::Dataset),
        ]
    }

    fn check(&self, p: &mut Problems) {
        let name = self.encoder.name();
        let (_, origin) = self.encoder.folder();
        // `--set text.encoder=hashed` tries a recipe without its encoder; the other settings then have no effect.
        if self.encoder != TextEncoder::Hashed && self.path.trim().is_empty() {
            let message = format!("`path` is missing; set it to the folder with the encoder `{name}`");
            p.add("path", message, &format!("download {origin}"));
        }
        let unused = |field: &str| format!("`{field}` is set, but the encoder `{name}` does not use it");
        if !matches!(self.encoder, TextEncoder::Clip | TextEncoder::Hashed) {
            if self.output != ClipOutput::Projected {
                p.add("output", unused("output"), "remove it");
            }
            if self.ids != ClipIds::HuggingFace {
                p.add("ids", unused("ids"), "remove it");
            }
        }
        if (1..=2).contains(&self.max_tokens) {
            let message = format!("`max_tokens` is {}; expected 0, or at least 3", self.max_tokens);
            p.add("max_tokens", message, "");
        }
    }

    fn shards(&self) -> usize {
        self.shards
    }
}
