//! Settings of `register`.

use serde::{Deserialize, Serialize};

/// Whether a smaller or a larger value is better.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Mode {
    /// Smaller is better.
    Min,
    /// Larger is better.
    Max,
}

/// `register`: model versions, and the best of them promoted.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default)]
pub struct Register {
    /// Model name.
    pub model: String,
    /// Training stages whose denoisers become versions. The metrics of every `evaluate.*` stage of the pipeline that
    /// looks at one of them go with it.
    pub from: Vec<String>,
    /// Metric that decides which is best.
    pub metric: String,
    /// Its direction.
    pub mode: Mode,
    /// What is promoted; without it nothing is.
    pub promote: Promote,
}

impl Default for Register {
    fn default() -> Self {
        Self {
            model: String::new(),
            from: Vec::new(),
            metric: "latent_fid".into(),
            mode: Mode::Min,
            promote: Promote::default(),
        }
    }
}

/// The promotion at the end of a `register` stage.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[serde(default)]
pub struct Promote {
    /// Alias; empty promotes nothing.
    pub to: String,
    /// Gates, such as `latent_fid <= 0.3`.
    pub require: Vec<String>,
}
