//! Settings of a run, by stage, and the runs that they can be compared with.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;

use access::Caller;
use axum::extract::State;
use axum::{Extension, Json};
use pipeline::Pipeline;
use protocol::{Digest, RunId, Seed, StageName};
use registry::{RunListQuery, RunOrder, WriteError};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use serde_json::Value;

use super::actor_handle::ActorHandle;
use super::extract::Path;
use super::failure::Failure;
use super::records::{Records, read};
use super::turn::turn;
use crate::batch::Refused;
use crate::rejected::Rejected;

/// Runs of one page of the search for the previous run of a pipeline, and the pages searched. Behind 400 newer runs of the
/// pipeline no previous run is found.
const SEARCHED: (u32, usize) = (100, 4);

/// The answer to `GET /v1/runs/{run}/settings`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct RunSettings {
    pub run: RunId,
    /// The newest earlier run of a pipeline with the same name.
    pub previous: Option<RunId>,
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
}

pub(crate) async fn settings(
    State(actor_handle): State<Arc<ActorHandle>>,
    Extension(caller): Extension<Arc<Caller>>,
    Path(run): Path<RunId>,
) -> Result<Json<RunSettings>, Failure> {
    let _turn = turn(&actor_handle).await?;
    Ok(Json(of_run(&actor_handle.records_for(caller.sees()), &run).await?))
}

async fn of_run(records: &Records, run: &RunId) -> Result<RunSettings, Refused> {
    let view = records.run_view(run).await?;
    let row = records.store().run(run).await.map_err(WriteError::from)?.ok_or_else(|| Rejected::unknown_run(run))?;
    let pipeline: Pipeline = read(run, &row.pipeline.to_string())?;
    let keys: BTreeMap<&StageName, Digest> =
        view.stages.iter().filter_map(|stage| Some((&stage.name, stage.key?))).collect();
    let mut from: BTreeMap<_, _> = records.sources(run, None).await?.into_iter().collect();
    from.retain(|_, (source, _)| source != run);
    let mut hidden = BTreeSet::new();
    for (source, _) in from.values() {
        if !hidden.contains(source) && records.run_view(source).await.is_err() {
            hidden.insert(source.clone());
        }
    }
    let stages = pipeline.stages.iter().map(|stage| SettingsOfStage {
        stage: stage.name.clone(),
        settings: serde_json::to_value(&stage.settings).unwrap_or_default(),
        code: pipeline.code_versions.get(stage.settings.kind()).copied().unwrap_or(1),
        key: keys.get(&stage.name).copied(),
        from: from.get(&stage.name).map(|(source, _)| source.clone()).filter(|source| !hidden.contains(source)),
    });
    let stages = stages.collect();
    let previous = previous(records, run, &view.pipeline).await?;
    Ok(RunSettings { run: run.clone(), previous, seed: pipeline.seed, source: row.source, stages })
}

/// The newest run of the pipeline before `run`.
async fn previous(records: &Records, run: &RunId, pipeline: &str) -> Result<Option<RunId>, Refused> {
    let (limit, pages) = SEARCHED;
    let mut asked = RunListQuery {
        states: Vec::new(),
        pipeline: Some(pipeline.to_owned()),
        owner: None,
        words: String::new(),
        order: RunOrder::Newest,
        after: None,
        limit,
    };
    let mut passed = false;
    for _ in 0..pages {
        let page = records.run_list(&asked).await?;
        for row in page.items {
            if passed {
                return Ok(Some(row.run));
            }
            passed = row.run == *run;
        }
        let Some(next) = page.next else { return Ok(None) };
        asked.after = Some(next);
    }
    Ok(None)
}
