//! Settings of a run, by stage, and the previous run that they are compared with.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;

use access::Caller;
use axum::extract::State;
use axum::{Extension, Json};
use pipeline::Pipeline;
use protocol::message::RunView;
use protocol::{Digest, RunId, StageName};
use registry::{RunListQuery, RunOrder, WriteError};

use super::actor_handle::ActorHandle;
use super::extract::Path;
use super::failure::Failure;
use super::reasons::explain;
use super::records::{Records, read};
use super::run_settings::{RunSettings, SettingsOfStage};
use super::turn::turn;
use crate::batch::Refused;
use crate::rejected::Rejected;

/// Runs of one page of the search for the previous run of a pipeline, and the pages searched. Behind 400 newer runs of the
/// pipeline no previous run is found.
const SEARCHED: (u32, usize) = (100, 4);

pub(crate) async fn settings(
    State(actor_handle): State<Arc<ActorHandle>>,
    Extension(caller): Extension<Arc<Caller>>,
    Path(run): Path<RunId>,
) -> Result<Json<RunSettings>, Failure> {
    let _turn = turn(&actor_handle).await?;
    Ok(Json(actor_handle.records_for(caller.sees()).settings(&run).await?))
}

impl Records {
    /// The settings of a run's stages, and why each was computed.
    ///
    /// # Errors
    /// If there is no such run, or its row cannot be read.
    pub async fn settings(&self, run: &RunId) -> Result<RunSettings, Refused> {
        let view = self.run_view(run).await?;
        let mut now = as_submitted(self, run, &view).await?;
        let mut from: BTreeMap<_, _> = self.sources(run, None).await?.into_iter().collect();
        from.retain(|_, (source, _)| source != run);
        let mut hidden = BTreeSet::new();
        for (source, _) in from.values() {
            if !hidden.contains(source) && self.run_view(source).await.is_err() {
                hidden.insert(source.clone());
            }
        }
        for stage in &mut now.stages {
            let source = from.get(&stage.stage).map(|(source, _)| source.clone());
            stage.from = source.filter(|source| !hidden.contains(source));
        }
        now.previous = previous(self, run, &view.pipeline).await?;
        let before = match &now.previous {
            // A run that was forgotten meanwhile, or that only another build can read, is not compared with.
            Some(previous) => earlier(self, previous).await.ok(),
            None => None,
        };
        if let Some(before) = &before {
            let is_here = |name: &StageName| now.stages.iter().any(|stage| stage.stage == *name);
            now.missing = before.stages.iter().map(|stage| stage.stage.clone()).filter(|name| !is_here(name)).collect();
        }
        explain(&mut now, &view, before.as_ref());
        Ok(now)
    }
}

async fn earlier(records: &Records, run: &RunId) -> Result<RunSettings, Refused> {
    as_submitted(records, run, &records.run_view(run).await?).await
}

/// The settings of a run's stages by themselves.
async fn as_submitted(records: &Records, run: &RunId, view: &RunView) -> Result<RunSettings, Refused> {
    let row = records.store().run(run).await.map_err(WriteError::from)?.ok_or_else(|| Rejected::unknown_run(run))?;
    let pipeline: Pipeline = read(run, &row.pipeline.to_string())?;
    let keys: BTreeMap<&StageName, Digest> =
        view.stages.iter().filter_map(|stage| Some((&stage.name, stage.key?))).collect();
    let stages = pipeline.stages.iter().map(|stage| SettingsOfStage {
        stage: stage.name.clone(),
        settings: serde_json::to_value(&stage.settings).unwrap_or_default(),
        code: pipeline.code_versions.get(stage.settings.kind()).copied().unwrap_or(1),
        key: keys.get(&stage.name).copied(),
        from: None,
        why: None,
    });
    let stages = stages.collect();
    let previous = None;
    let missing = Vec::new();
    Ok(RunSettings { run: run.clone(), previous, missing, seed: pipeline.seed, source: row.source, stages })
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
