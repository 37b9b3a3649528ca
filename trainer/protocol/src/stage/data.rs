//! Settings of the stages that give clips and captions.

use serde::{Deserialize, Serialize};

/// Length-dependent rules of the two data formats.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum DataFormat {
    /// 263 features, 22 joints, 20 fps, metres.
    Humanml3d,
    /// 251 features, 21 joints, 12.5 fps, millimetres.
    Kit,
}

/// `dataset: {format: humanml3d, path: ...}`: a folder in the published layout.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default)]
pub struct DataOpen {
    /// Which of the two formats.
    pub format: DataFormat,
    /// The folder, relative to the working directory. Not part of the key: the content's digest is.
    pub path: String,
}

impl Default for DataOpen {
    fn default() -> Self {
        Self { format: DataFormat::Humanml3d, path: String::new() }
    }
}

/// `dataset: {format: synthetic, clips: 400}`: procedural motion with captions, in the HumanML3D layout.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default)]
pub struct DataSynthetic {
    /// Clips to make, before mirroring.
    pub clips: usize,
    /// Shares of the clips for validation and test.
    pub val: f64,
    /// See `val`.
    pub test: f64,
    /// Adds the left/right mirrored twin of every clip.
    pub mirror: bool,
}

impl Default for DataSynthetic {
    fn default() -> Self {
        Self { clips: 400, val: 0.05, test: 0.15, mirror: false }
    }
}

/// `text: {encoder: hashed}`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
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
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum TextEncoder {
    /// Words and word pairs hashed into 768 signed coordinates, L2-normalised.
    Hashed,
}
