//! The answer about the settings of a run's stages: settings, keys and the reasons why they were computed.

use protocol::{Digest, RunId, Seed, StageName};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use serde_json::Value;

/// The answer to `GET /v1/runs/{run}/settings`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct RunSettings {
    pub run: RunId,
    /// The newest earlier run of a pipeline with the same name.
    pub previous: Option<RunId>,
    /// Stages of the previous run that this one does not have.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub missing: Vec<StageName>,
    pub seed: Seed,
    /// The pipeline's file as the user wrote it.
    pub source: String,
    /// Stages of the pipeline in topological order, without a sweep's trials.
    pub stages: Vec<SettingsOfStage>,
}

/// Settings of one stage.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct SettingsOfStage {
    pub stage: StageName,
    /// Kind and settings, with all defaults.
    pub settings: Value,
    /// Code version of the kind.
    pub code: u32,
    /// Key of the stage, once its inputs are known.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub key: Option<Digest>,
    /// Earlier run that computed the result, unless the caller may not see it.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub from: Option<RunId>,
    /// Why it was computed, beside the previous run.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub why: Option<StageReason>,
}

/// The reason why a stage was computed.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct StageReason {
    pub kind: ReasonKind,
    /// Settings that differ from those of the previous run.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub changes: Vec<SettingChange>,
    /// Stages that it reads and that differ from those of the previous run.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub inputs: Vec<StageName>,
    /// The reason in a few words, such as `lr 2e-4 -> 1e-4`; empty if there is none yet.
    pub text: String,
}

/// Kind of the difference between a stage and that of the previous run.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "kebab-case")]
pub enum ReasonKind {
    /// The previous run has no such stage.
    New,
    /// Some settings differ.
    Changed,
    /// The code version of its kind differs.
    Code,
    /// The pipeline's seed differs.
    Seed,
    /// A stage or a file that it reads differs.
    Input,
    /// Everything is the same.
    Same,
    /// It cannot be said before the stage has a key.
    Unknown,
}

/// A setting that differs.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct SettingChange {
    /// Path in the stage's settings, such as `network.width`.
    pub path: String,
    /// The value in the previous run; `null` if it has none.
    pub from: Value,
    /// The value now; `null` if there is none.
    pub to: Value,
}
