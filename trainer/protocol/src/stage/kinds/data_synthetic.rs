//! `data.synthetic`: procedural clips, a dataset without a download. Source: ours.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use crate::ArtifactKind;
use crate::stage::{DataFormat, Output, Problems, Ref, Shape, StageSpec};

/// `dataset: {format: synthetic, clips: 400}`: procedural motion with captions, in the HumanML3D layout.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default)]
pub struct DataSynthetic {
    /// Number of clips before mirroring.
    #[schemars(range(min = 1, max = 100_000), extend("x-unit" = "clips"))]
    pub clips: usize,
    /// Share of the validation clips.
    #[schemars(range(min = 0.0), extend("exclusiveMaximum" = 1.0, "x-unit" = "of the clips"))]
    pub val: f64,
    /// Share of the test clips.
    #[schemars(range(min = 0.0), extend("exclusiveMaximum" = 1.0, "x-unit" = "of the clips"))]
    pub test: f64,
    /// Adds a mirrored twin of every clip.
    pub mirror: bool,
}

impl Default for DataSynthetic {
    fn default() -> Self {
        Self { clips: 400, val: 0.05, test: 0.15, mirror: false }
    }
}

impl StageSpec for DataSynthetic {
    const KIND: &'static str = "data.synthetic";
    const SHAPE: Shape = Shape::Plain;
    const OUTPUT: Output = Output { name: "dataset", kind: ArtifactKind::Dataset };

    fn refs(&mut self) -> Vec<Ref<'_>> {
        vec![]
    }

    fn check(&self, p: &mut Problems) {
        if (0.0..1.0).contains(&self.val) && (0.0..1.0).contains(&self.test) && self.val + self.test >= 1.0 {
            p.add("test", "`val` and `test` leave no training clips; expected a sum below 1", "");
        }
    }

    fn format(&self) -> Option<DataFormat> {
        Some(DataFormat::Humanml3d)
    }
}
