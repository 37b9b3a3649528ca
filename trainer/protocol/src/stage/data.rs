//! The formats of datasets.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// Skeleton, rate and unit of a data format.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "lowercase")]
pub enum DataFormat {
    /// 263 features, 22 joints, 20 fps, metres.
    Humanml3d,
    /// 251 features, 21 joints, 12.5 fps, millimetres.
    Kit,
}

impl DataFormat {
    /// Name in settings.
    pub fn name(self) -> &'static str {
        match self {
            Self::Humanml3d => "humanml3d",
            Self::Kit => "kit",
        }
    }

    /// Description of its skeleton.
    pub fn skeleton(self) -> &'static str {
        match self {
            Self::Humanml3d => "22 joints (humanml3d)",
            Self::Kit => "21 joints (kit)",
        }
    }
}
