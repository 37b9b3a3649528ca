//! Checkpoints of a run's trainings, and the stages that make models of them.

use std::collections::BTreeMap;
use std::sync::Arc;

use access::Caller;
use axum::extract::State;
use axum::{Extension, Json};
use pipeline::{Pipeline, PipelineStage};
use protocol::message::RunView;
use protocol::sweep::STATE_OUTPUT;
use protocol::{ArtifactKind, Digest, RunId, StageName, Steps, TaskId};
use registry::WriteError;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use super::actor_handle::ActorHandle;
use super::extract::Path;
use super::failure::Failure;
use super::records::{Records, read};
use super::turn::turn;
use crate::batch::Refused;
use crate::rejected::Rejected;

/// A checkpoint that is kept.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct KeptCheckpoint {
    pub stage: StageName,
    /// Number of applied steps.
    pub step: u64,
    /// Time of the commit, in milliseconds since 1970.
    pub at_ms: i64,
    /// Manifest of the training state.
    pub digest: Digest,
    /// True if the training outputs a model, so that `POST /v1/draws` draws with the checkpoint.
    pub draws: bool,
}

/// Name of a checkpoint.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct CheckpointName {
    pub run: RunId,
    /// A training stage of the run that outputs a model.
    pub stage: StageName,
    /// Number of applied steps.
    pub step: u64,
}

/// Lists the checkpoints of a run that are kept, those of each stage by step.
pub(crate) async fn checkpoints(
    State(actor_handle): State<Arc<ActorHandle>>,
    Extension(caller): Extension<Arc<Caller>>,
    Path(run): Path<RunId>,
) -> Result<Json<Vec<KeptCheckpoint>>, Failure> {
    let _turn = turn(&actor_handle).await?;
    Ok(Json(of_run(&actor_handle.records_for(caller.sees()), &run).await?))
}

async fn of_run(records: &Records, run: &RunId) -> Result<Vec<KeptCheckpoint>, Refused> {
    let sources = records.sources(run, None).await?;
    let pipeline = pipeline_of(records, run).await?;
    let mut kept = Vec::new();
    for (stage, (from, name)) in sources {
        let Some(known) = pipeline.stage(&stage).filter(|known| known.settings.training().is_some()) else { continue };
        let draws = known.settings.output().kind == ArtifactKind::Model;
        let task = TaskId::of(&from, &name, None);
        let mut rows = records.store().checkpoints(&task).await.map_err(WriteError::from)?;
        rows.sort_by_key(|row| row.step);
        kept.extend(rows.into_iter().map(|row| KeptCheckpoint {
            stage: stage.clone(),
            step: row.step,
            at_ms: row.at_ms,
            digest: row.manifest,
            draws,
        }));
    }
    Ok(kept)
}

async fn pipeline_of(records: &Records, run: &RunId) -> Result<Pipeline, Refused> {
    let row = records.store().run(run).await.map_err(WriteError::from)?.ok_or_else(|| Rejected::unknown_run(run))?;
    read(run, &row.pipeline.to_string())
}

/// The stage `name`, which outputs the model that a training had at a checkpoint.
pub(super) async fn stage_at(
    records: &Records,
    wanted: &CheckpointName,
    name: StageName,
) -> Result<PipelineStage, Refused> {
    let CheckpointName { run, stage, step } = wanted;
    let view = records.run_view(run).await?;
    let kept = of_run(records, run).await?;
    let kept = kept.into_iter().rfind(|kept| kept.draws && kept.stage == *stage && kept.step == *step);
    let Some(kept) = kept else {
        let message = format!("run `{run}` keeps no checkpoint of a model's training `{stage}` after step {step}");
        return Err(Rejected::NotFound(message).into());
    };
    let pipeline = pipeline_of(records, run).await?;
    let training = pipeline.stage(stage).ok_or_else(|| Rejected::unknown_run(run))?;
    let inputs = inputs(&view, training)?;
    let made = training.at_checkpoint(name, Steps(*step), kept.digest, inputs);
    made.map_err(|why| Rejected::Invalid(format!("stage `{stage}`: {why}")).into())
}

/// Outputs of the run that a stage reads, by field.
fn inputs(view: &RunView, stage: &PipelineStage) -> Result<BTreeMap<String, Digest>, Refused> {
    let mut inputs = BTreeMap::new();
    for input in &stage.inputs {
        let known = view.stages.iter().find(|known| known.name == input.stage);
        let mut outputs = known.into_iter().flat_map(|known| &known.outputs);
        let Some((_, output)) = outputs.find(|(name, _)| *name != STATE_OUTPUT) else {
            let message = format!("`{}`, which `{}` reads, has no output", input.stage, stage.name);
            return Err(Rejected::Conflict(message).into());
        };
        inputs.insert(input.field.clone(), *output);
    }
    Ok(inputs)
}
