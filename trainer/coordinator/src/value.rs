//! What a stage gives.

use std::collections::BTreeMap;

use checkpoint::model::Parts;
use protocol::stage::Sampler;
use protocol::{Digest, StageName};
use serde::{Deserialize, Serialize};

/// A stage's value as the store knows it.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Known {
    /// Outputs by name.
    pub outputs: BTreeMap<String, Digest>,
    /// Final values.
    pub metrics: BTreeMap<String, f64>,
}

/// A model that a register stage makes a version of.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Candidate {
    /// The stage that made it.
    pub stage: StageName,
    /// The model as that stage gave it.
    pub model: Digest,
    /// How it is drawn from when nobody says otherwise; `None` if nobody measured it.
    pub sampler: Option<Sampler>,
    /// Parts that are added to it.
    pub parts: Parts,
}
