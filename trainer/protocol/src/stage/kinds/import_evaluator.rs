//! `import.evaluator`: a published evaluator, read from its files. Source: text-to-motion (Guo et al., CVPR 2022).

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use crate::ArtifactKind;
use crate::stage::{DataFormat, Output, Problems, Ref, Shape, StageSpec};

/// `import.evaluator`: the published files.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default)]
pub struct ImportEvaluator {
    /// Folder in the published layout: `text_mot_match/model/finest.tar` (or `finest.safetensors`) and, where there are several, the one
    /// folder `Comp_*/meta` with `mean.npy` and `std.npy`. Not part of the key: the content's digest is.
    pub path: String,
    /// What it was trained on.
    pub format: DataFormat,
    /// Folder with the word vectors that it was trained with; empty takes the built-in ones, for an evaluator of our own.
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
        vec![Ref::folder("path", &mut self.path), Ref::folder("words", &mut self.words)]
    }

    fn check(&self, p: &mut Problems) {
        if self.path.trim().is_empty() {
            p.add("path", "`path` is missing: the folder with `text_mot_match/model/finest.tar`", "");
        }
    }

    fn format(&self) -> Option<DataFormat> {
        Some(self.format)
    }
}
