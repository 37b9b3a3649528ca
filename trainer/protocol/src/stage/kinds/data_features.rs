//! `data.features`: a folder of recordings to a dataset. Source: the published HumanML3D and KIT-ML procedures; splits by recording are ours.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use crate::ArtifactKind;
use crate::stage::{DataFormat, Output, Problems, Ref, Shape, StageSpec};

/// `data.features`: recordings (`.bvh`, joints in `.npy` or `.npz`) with captions beside them, to features.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default)]
pub struct DataFeatures {
    /// Which skeleton, rate and features.
    pub format: DataFormat,
    /// The folder, relative to the working directory. Not part of the key: the content's digest is.
    pub path: String,
    /// A table of captions, CSV or JSON; empty: what the folder has (`captions.csv`, `captions.json`, text beside the clips).
    pub captions: String,
    /// Joint map: a shipped one (`cmu`, `lafan1`, `mixamo`, `bandai`, `cmu-daz`, `smpl`) or a file that ends in `.yaml`; empty: found for each file.
    pub map: String,
    /// Length of the files' unit; 0: found for each file.
    pub metres_per_unit: f64,
    /// The files' upward axis.
    pub up: UpAxis,
    /// Frames per second of arrays that do not say it; 0: 20 for 22 joints, 12.5 for 21.
    pub fps: f64,
    /// Bone lengths of the uniform skeleton, a `.npy` of offsets `[J, 3]` or lengths `[J]`; empty: HumanML3D's. KIT-ML's are not public.
    pub target: String,
    /// Adds the left/right mirrored twin of every clip, with captions that say so.
    pub mirror: bool,
    /// Cuts what is too long into equal parts; else it is left out.
    pub cut: bool,
    /// How clips are divided.
    pub splits: Splits,
    /// Share of the clips for validation, by `source`.
    pub val: f64,
    /// Share of the clips for the test split, by `source`.
    pub test: f64,
    /// Leaves out files that are broken, and says so; else they end the stage.
    pub skip_broken: bool,
    /// Shards.
    pub shards: usize,
}

/// An upward axis.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "kebab-case")]
pub enum UpAxis {
    /// Where the figure stands; y for `.npy`.
    Auto,
    /// (x, y, z) becomes (-y, x, z).
    X,
    /// Positions stay as they are.
    Y,
    /// (x, y, z) becomes (x, z, -y).
    Z,
    /// (x, y, z) becomes (y, -x, z).
    #[serde(rename = "-x")]
    NegativeX,
    /// (x, y, z) becomes (x, -y, -z).
    #[serde(rename = "-y")]
    NegativeY,
    /// (x, y, z) becomes (x, -z, y).
    #[serde(rename = "-z")]
    NegativeZ,
}

/// What a split is made of.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "kebab-case")]
pub enum Splits {
    /// Whole recordings, so that none is in two splits.
    Source,
    /// The folder's `train.txt`, `val.txt` and `test.txt`.
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
    /// Whether the joint map is a file.
    pub fn map_is_file(&self) -> bool {
        self.map.ends_with(".yaml") || self.map.ends_with(".yml")
    }
}

impl StageSpec for DataFeatures {
    const KIND: &'static str = "data.features";
    const SHAPE: Shape = Shape::Map;
    const OUTPUT: Output = Output { name: "dataset", kind: ArtifactKind::Dataset };

    fn refs(&mut self) -> Vec<Ref<'_>> {
        let map_is_file = self.map_is_file();
        let mut refs = vec![
            Ref::folder("path", &mut self.path)
                .holding(&[], "recordings of your own, or `trainer data sample --format bvh`"),
            Ref::folder("captions", &mut self.captions),
            Ref::folder("target", &mut self.target),
        ];
        // A shipped map's name is a setting like others.
        if map_is_file {
            refs.push(Ref::folder("map", &mut self.map));
        }
        refs
    }

    fn check(&self, p: &mut Problems) {
        if self.path.trim().is_empty() {
            p.add("path", "`path` is missing: the folder with recordings", "");
        }
        p.fraction("val", self.val, true);
        p.fraction("test", self.test, true);
        if (0.0..1.0).contains(&self.val) && (0.0..1.0).contains(&self.test) && self.val + self.test >= 1.0 {
            p.add("test", "`val` and `test` leave no clips to train on; expected a sum below 1", "");
        }
        if self.format == DataFormat::Kit && self.target.is_empty() && !self.path.is_empty() {
            let help = "name a `.npy` of 21 offsets or lengths";
            p.add("target", "`target` is missing: the uniform skeleton of KIT-ML is not public", help);
        }
        p.shards(self.shards);
    }

    fn format(&self) -> Option<DataFormat> {
        Some(self.format)
    }

    fn shards(&self) -> usize {
        self.shards
    }
}
