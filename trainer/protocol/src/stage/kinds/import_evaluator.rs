//! `import.evaluator`: imports a published evaluator from its files. Source: text-to-motion (Guo et al., CVPR 2022).

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use crate::ArtifactKind;
use crate::stage::{DataFormat, Output, Problems, Ref, Shape, StageSpec};

/// Files of a folder with the published word vectors.
pub(super) const VOCABULARY: [&str; 3] = ["our_vab_data.npy", "our_vab_words.pkl", "our_vab_idx.pkl"];
/// Source of the word vectors.
pub(super) const WORDS_ORIGIN: &str = "its word vectors (GloVe), linked in github.com/EricGuo5513/HumanML3D";

/// `import.evaluator`: imports the published files of an evaluator.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default)]
pub struct ImportEvaluator {
    /// Folder in the published layout: `text_mot_match/model/finest.tar` (or `finest.safetensors`) and `mean.npy` and
    /// `std.npy` in `meta` or in the only folder `Comp_*/meta`. The stage's key has the digest of its content, not its path.
    pub path: String,
    /// Format of its training data.
    pub format: DataFormat,
    /// Folder with the word vectors of its training; empty uses the built-in ones, for an evaluator of our own.
    pub words: String,
}

impl Default for ImportEvaluator {
    fn default() -> Self {
        Self { path: String::new(), format: DataFormat::Humanml3d, words: String::new() }
    }
}

impl StageSpec for ImportEvaluator {
    const KIND: &'static str = "import.evaluator";
    const SHAPE: Shape = Shape::Plain;
    const OUTPUT: Output = Output { name: "evaluator", kind: ArtifactKind::Evaluator };

    fn refs(&mut self) -> Vec<Ref<'_>> {
        let files = &["text_mot_match/model/finest.tar|text_mot_match/model/finest.safetensors"];
        let origin = "the papers' evaluator, linked in github.com/EricGuo5513/text-to-motion";
        vec![
            Ref::folder("path", &mut self.path).holding(files, origin),
            Ref::folder("words", &mut self.words).holding(&VOCABULARY, WORDS_ORIGIN),
        ]
    }

    fn check(&self, p: &mut Problems) {
        if self.path.trim().is_empty() {
            p.add("path", "`path` is missing; set it to the folder with `text_mot_match/model/finest.tar`", "");
        }
    }

    fn format(&self) -> Option<DataFormat> {
        Some(self.format)
    }
}
