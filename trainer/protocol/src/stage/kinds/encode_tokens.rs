//! `encode.tokens`: token ids of every clip, computed once for all stages that train on them. Source: T2M-GPT, MoMask,
//! MMM.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use crate::ArtifactKind;
use crate::stage::{Neighbours, Output, Problems, Ref, Shape, StageSpec};

/// `encode.tokens`: token ids of all clips.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default)]
pub struct EncodeTokens {
    /// Stage that gives the clips.
    pub dataset: String,
    /// Stage that gives the tokenizer.
    pub tokenizer: String,
    /// Pads clips with zeros to this many frames before encoding, as MoMask does (196); 0 adds none. A token depends on
    /// some 90 frames on either side, so ids differ.
    #[schemars(range(min = 0, max = 10_000), extend("x-unit" = "frames"))]
    pub padded: usize,
    /// Number of shards.
    #[schemars(range(min = 1, max = crate::limits::SHARDS), extend("x-unit" = "shards"))]
    pub shards: usize,
}

impl Default for EncodeTokens {
    fn default() -> Self {
        Self { dataset: "dataset".into(), tokenizer: "tokenizer".into(), padded: 0, shards: 8 }
    }
}

impl StageSpec for EncodeTokens {
    const KIND: &'static str = "encode.tokens";
    const VERSION: u32 = 2;
    const SHAPE: Shape = Shape::Map;
    const OUTPUT: Output = Output { name: "tokens", kind: ArtifactKind::Tokens };

    fn refs(&mut self) -> Vec<Ref<'_>> {
        vec![
            Ref::stage("dataset", &mut self.dataset, ArtifactKind::Dataset),
            Ref::stage("tokenizer", &mut self.tokenizer, ArtifactKind::Tokenizer),
        ]
    }

    fn check(&self, p: &mut Problems) {
        p.whole_tokens("padded", self.padded);
    }

    fn check_neighbours(&self, stages: &Neighbours<'_>, p: &mut Problems) {
        stages.same_skeleton(p, ("tokenizer", &self.tokenizer), &self.dataset);
    }

    fn shards(&self) -> usize {
        self.shards
    }
}
