//! `data.open`: a folder in the published layout. Source: HumanML3D, KIT-ML.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use crate::ArtifactKind;
use crate::stage::{DataFormat, Output, Problems, Ref, Shape, StageSpec};

/// `dataset: {format: humanml3d, path: ...}`: a folder in the published layout.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default)]
pub struct DataOpen {
    /// Format of the dataset: skeleton, rate and features.
    pub format: DataFormat,
    /// Folder, relative to the working directory. The stage's key has the digest of its content, not its path.
    pub path: String,
}

impl Default for DataOpen {
    fn default() -> Self {
        Self { format: DataFormat::Humanml3d, path: String::new() }
    }
}

impl StageSpec for DataOpen {
    const KIND: &'static str = "data.open";
    const SHAPE: Shape = Shape::Plain;
    const OUTPUT: Output = Output { name: "dataset", kind: ArtifactKind::Dataset };

    fn refs(&mut self) -> Vec<Ref<'_>> {
        vec![Ref::dataset("path", &mut self.path, self.format)]
    }

    fn check(&self, p: &mut Problems) {
        if self.path.trim().is_empty() {
            p.add("path", "`path` is missing; set it to the folder with `new_joint_vecs`, `texts` and `train.txt`", "");
        }
    }

    fn format(&self) -> Option<DataFormat> {
        Some(self.format)
    }
}
