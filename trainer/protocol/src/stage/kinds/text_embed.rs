//! `text.embed`: every caption of a dataset as a vector, computed once. `hashed` is ours.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use crate::ArtifactKind;
use crate::stage::{Output, Ref, Shape, StageSpec};

/// `text: {encoder: hashed}`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default)]
pub struct TextEmbed {
    /// `hashed`: n-grams hashed to signed coordinates, unit norm; needs no weights.
    pub encoder: TextEncoder,
    /// Stage whose captions are embedded.
    pub dataset: String,
}

impl Default for TextEmbed {
    fn default() -> Self {
        Self { encoder: TextEncoder::Hashed, dataset: "dataset".into() }
    }
}

/// How a caption becomes a vector.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "kebab-case")]
pub enum TextEncoder {
    /// Words and word pairs hashed into 768 signed coordinates, L2-normalised.
    Hashed,
}

impl TextEncoder {
    /// The word in YAML, and in what the encoder made.
    pub fn name(self) -> &'static str {
        match self {
            Self::Hashed => "hashed",
        }
    }

    /// Whether enough of its vectors is left by a ReLU. A hashed word is one coordinate, as often -1 as +1, so that half of the words
    /// would mean nothing, and so would the empty caption.
    pub fn survives_relu(self) -> bool {
        match self {
            Self::Hashed => false,
        }
    }
}

impl StageSpec for TextEmbed {
    const KIND: &'static str = "text.embed";
    // 2: with the encoder.
    const VERSION: u32 = 2;
    const SHAPE: Shape = Shape::Plain;
    const OUTPUT: Output = Output { name: "embeddings", kind: ArtifactKind::Embeddings };

    fn refs(&mut self) -> Vec<Ref<'_>> {
        vec![Ref::stage("dataset", &mut self.dataset, ArtifactKind::Dataset)]
    }
}
