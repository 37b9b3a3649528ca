//! Values of stages.

use std::collections::BTreeMap;

use checkpoint::model::Parts;
use protocol::stage::Sampler;
use protocol::{Digest, StageName};
use serde::{Deserialize, Serialize};

/// A stage's value as stored.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Known {
    /// Outputs by name.
    pub outputs: BTreeMap<String, Digest>,
    /// Final values of metrics, by name.
    pub metrics: BTreeMap<String, f64>,
}

/// A model from which a register stage makes a version.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Candidate {
    /// The stage that made it.
    pub stage: StageName,
    /// The model's manifest as that stage returned it.
    pub model: Digest,
    /// Default sampler for generation; `None` if no evaluation measured one.
    pub sampler: Option<Sampler>,
    /// Parts to add to the model.
    pub parts: Parts,
}
