//! How training clips are varied where there are few of them. Source: ours.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use super::Problems;

/// Other paths for training clips: the same poses, walked along other curves and at another pace. Nothing by default, as published.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default)]
pub struct Augment {
    /// Deviation of the curvature that is added to a path, 1/m.
    pub bend: f64,
    /// Deviation of the factor that a path's length is multiplied by, about 1.
    pub stretch: f64,
}

impl Augment {
    /// Whether clips stay as they are.
    pub fn is_none(&self) -> bool {
        self.bend == 0.0 && self.stretch == 0.0
    }

    pub(super) fn check(&self, p: &mut Problems) {
        p.not_negative("augment.bend", self.bend);
        p.fraction("augment.stretch", self.stretch, false);
    }
}
