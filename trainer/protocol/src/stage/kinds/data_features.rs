//! `data.features`: converts a folder of recordings to a dataset. Source: the published HumanML3D and KIT-ML
//! procedures; splits by recording are ours.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use crate::ArtifactKind;
use crate::stage::{DataFormat, Output, Problems, Ref, Shape, StageSpec};

/// `data.features`: converts recordings (`.bvh`, joints in `.npy` or `.npz`) with captions beside them to features.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default)]
pub struct DataFeatures {
    /// Format of the dataset: skeleton, rate and features.
    pub format: DataFormat,
    /// Folder, relative to the working directory. The stage's key has the digest of its content, not its path.
    pub path: String,
    /// Table of captions, CSV or JSON; empty uses the folder's own (`captions.csv`, `captions.json`, text beside the
    /// clips).
    pub captions: String,
    /// Joint map: a shipped one (`cmu`, `lafan1`, `mixamo`, `bandai`, `cmu-daz`, `smpl`) or a file that ends in
    /// `.yaml`; empty detects it for each file.
    pub map: String,
    /// Length of the files' unit; 0 detects it for each file.
    #[schemars(range(min = 0.0, max = 1000.0), extend("x-unit" = "metres"))]
    pub metres_per_unit: f64,
    /// Upward axis of the files.
    pub up: UpAxis,
    /// Frame rate of arrays without one; 0 means 20 for 22 joints, 12.5 for 21.
    #[schemars(range(min = 0.0, max = 10_000.0), extend("x-unit" = "frames a second"))]
    pub fps: f64,
    /// Bone lengths of the uniform skeleton, a `.npy` of offsets `[J, 3]` or lengths `[J]`; empty means HumanML3D's.
    /// KIT-ML's are not public.
    pub target: String,
    /// Adds a mirrored twin of every clip, with mirrored captions.
    pub mirror: bool,
    /// Cuts clips that are too long into equal parts; otherwise they are left out.
    pub cut: bool,
    /// Division of clips into splits.
    pub splits: Splits,
    /// Share of the validation clips, for `source`.
    #[schemars(range(min = 0.0), extend("exclusiveMaximum" = 1.0, "x-unit" = "of the clips"))]
    pub val: f64,
    /// Share of the test clips, for `source`.
    #[schemars(range(min = 0.0), extend("exclusiveMaximum" = 1.0, "x-unit" = "of the clips"))]
    pub test: f64,
    /// Leaves out broken files and reports them; otherwise they fail the stage.
    pub skip_broken: bool,
    /// Number of shards.
    #[schemars(range(min = 1, max = crate::limits::SHARDS), extend("x-unit" = "shards"))]
    pub shards: usize,
}

/// Upward axis of recordings.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "kebab-case")]
pub enum UpAxis {
    /// Detected from the figure; y for `.npy`.
    Auto,
    /// Upward x: (x, y, z) becomes (-y, x, z).
    X,
    /// Upward y: positions are unchanged.
    Y,
    /// Upward z: (x, y, z) becomes (x, z, -y).
    Z,
    /// Upward -x: (x, y, z) becomes (y, -x, z).
    #[serde(rename = "-x")]
    NegativeX,
    /// Upward -y: (x, y, z) becomes (x, -y, -z).
    #[serde(rename = "-y")]
    NegativeY,
    /// Upward -z: (x, y, z) becomes (x, -z, y).
    #[serde(rename = "-z")]
    NegativeZ,
}

/// Division of clips into splits.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "kebab-case")]
pub enum Splits {
    /// By whole recordings, so that none is in two splits.
    Source,
    /// By the folder's `train.txt`, `val.txt` and `test.txt`.
    Lists,
}

impl Default for DataFeatures {
    fn default() -> Self {
        Self {
            format: DataFormat::Humanml3d,
            path: String::new(),
            captions: String::new(),
            map: String::new(),
            metres_per_unit: 0.0,
            up: UpAxis::Auto,
            fps: 0.0,
            target: String::new(),
            mirror: false,
            cut: true,
            splits: Splits::Source,
            val: 0.05,
            test: 0.15,
            skip_broken: false,
            shards: 8,
        }
    }
}

impl DataFeatures {
    /// Returns true if the joint map is a file.
    pub fn map_is_file(&self) -> bool {
        self.map.ends_with(".yaml") || self.map.ends_with(".yml")
    }
}

impl StageSpec for DataFeatures {
    const KIND: &'static str = "data.features";
    // Version 3 lists the recording of each clip.
    const VERSION: u32 = 3;
    const SHAPE: Shape = Shape::Map;
    const OUTPUT: Output = Output { name: "dataset", kind: ArtifactKind::Dataset };

    fn refs(&mut self) -> Vec<Ref<'_>> {
        let map_is_file = self.map_is_file();
        let mut refs = vec![
            Ref::folder("path", &mut self.path)
                .holding(&[], "use your own recordings, public ones (`trainer data fetch bandai`), or synthetic ones (`trainer data sample --format bvh`)"),
            Ref::folder("captions", &mut self.captions),
            Ref::folder("target", &mut self.target),
        ];
        // The name of a shipped map is an ordinary setting.
        if map_is_file {
            refs.push(Ref::folder("map", &mut self.map));
        }
        refs
    }

    fn check(&self, p: &mut Problems) {
        if self.path.trim().is_empty() {
            p.add("path", "`path` is missing; set it to the folder with the recordings", "");
        }
        if (0.0..1.0).contains(&self.val) && (0.0..1.0).contains(&self.test) && self.val + self.test >= 1.0 {
            p.add("test", "`val` and `test` leave no training clips; expected a sum below 1", "");
        }
        if self.format == DataFormat::Kit && self.target.is_empty() && !self.path.is_empty() {
            let help = "set it to a `.npy` file with 21 offsets or lengths";
            p.add("target", "`target` is missing; the uniform skeleton of KIT-ML is not public", help);
        }
    }

    fn format(&self) -> Option<DataFormat> {
        Some(self.format)
    }

    fn shards(&self) -> usize {
        self.shards
    }
}
