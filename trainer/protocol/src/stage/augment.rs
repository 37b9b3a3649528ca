//! Augmentation of training clips for small data. Source: ours.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// Changed paths for training clips: the same poses along other curves and at another speed. Off by default, as
/// published.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default)]
pub struct Augment {
    /// Standard deviation of the curvature that is added to a path, 1/m.
    #[schemars(range(min = 0.0, max = 1e3))]
    pub bend: f64,
    /// Standard deviation of the factor on a path's length, around 1.
    #[schemars(range(min = 0.0, max = 1.0))]
    pub stretch: f64,
}

impl Augment {
    /// Returns true if clips are not changed.
    pub fn is_none(&self) -> bool {
        self.bend == 0.0 && self.stretch == 0.0
    }
}
