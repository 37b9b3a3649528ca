//! Records of runs: active runs are in the coordinator's state, ended ones only in the tables.

use std::collections::BTreeMap;
use std::path::Path;
use std::sync::Arc;

use protocol::message::{Listing, RunSummary, RunView, StageState};
use protocol::{Digest, Group, RunId, StageName, limits};
use registry::{
    Buckets, Curve, HistoryQuery, HistoryRow, LogRow, OpenError, Page, QueryError, ReadStore, RunListQuery, Window,
    Write, WriteError,
};

use super::clock::wall_clock;
use super::run_times::{RunTimes, TimesCache};
use super::start_error::StartError;
use crate::batch::Refused;
use crate::decide::decide;
use crate::event::{Effect, Event};
use crate::journal;
use crate::policy::Policy;
use crate::rejected::Rejected;
use crate::state::State;
use crate::state::run::Run;
use crate::time::{Millis, Moment};
use crate::view::WorkerView;

/// The answer to `GET /v1/runs/{run}/metrics`: values by stage, key and step.
pub type StageMetrics = BTreeMap<StageName, BTreeMap<String, Curve>>;

/// Curves to draw, by key, by stage.
pub type StageCurves = BTreeMap<StageName, BTreeMap<String, Buckets>>;

/// A state and the tables beside it, for questions that change nothing.
#[derive(Debug, Clone)]
pub struct Records {
    store: ReadStore,
    state: Arc<State>,
    now: Millis,
    /// Views of runs that the start of a coordinator would end; they are in no table yet.
    ending: BTreeMap<RunId, String>,
    /// The group whose runs are shown; `None` shows all.
    sees: Option<Group>,
    /// Times that a running coordinator has read.
    times: Arc<TimesCache>,
}

/// An error on opening records.
#[derive(Debug, thiserror::Error)]
pub enum RecordsError {
    /// The store cannot be opened.
    #[error(transparent)]
    Open(#[from] OpenError),
    /// The stored facts cannot be recovered.
    #[error(transparent)]
    Recover(#[from] StartError),
}

impl Records {
    pub(super) fn new(store: ReadStore, state: Arc<State>, now: Millis, sees: Option<Group>) -> Self {
        Self { store, state, now, ending: BTreeMap::new(), sees, times: Arc::default() }
    }

    /// Shares the times in `cache`.
    pub(super) fn with_times(self, times: Arc<TimesCache>) -> Self {
        Self { times, ..self }
    }

    fn shows(&self, run: &Run) -> bool {
        self.sees.as_ref().is_none_or(|group| run.owner.group() == *group)
    }

    /// Opens the store in `dir`, which no coordinator holds. The records show the state after a start: no worker is
    /// busy, and interrupted runs wait to be resumed. Nothing is started or written.
    ///
    /// # Errors
    /// If there is no store, or this build cannot read the stored facts.
    pub async fn open(dir: &Path) -> Result<Self, RecordsError> {
        let store = ReadStore::open(dir).await?;
        let stored = store.recovery().await.map_err(StartError::from)?;
        let mut state = journal::recover(Policy::default(), &stored).map_err(StartError::from)?;
        let now = wall_clock().max(state.now);
        // No secret is derived from it, because nothing is granted.
        let moment = Moment { now, entropy: Digest::of(b"") };
        let effects = decide(&mut state, moment, Event::Started { alone: true, park: true });
        let mut records = Self::new(store, Arc::new(state), now, None);
        for effect in effects.map_err(StartError::from)? {
            let Effect::Store(writes) = effect else { continue };
            records.ending.extend(writes.into_iter().filter_map(|write| match write {
                Write::RunEnded { run, view, .. } => Some((run, view)),
                _ => None,
            }));
        }
        Ok(records)
    }

    /// Closes the store.
    pub async fn close(self) {
        self.store.close().await;
    }

    /// The store behind these records.
    pub fn store(&self) -> &ReadStore {
        &self.store
    }

    /// A part of the list of runs.
    ///
    /// # Errors
    /// If `after` is of no list, or the tables cannot be read.
    pub async fn run_list(&self, asked: &RunListQuery) -> Result<Listing<RunSummary>, Refused> {
        let mut asked = RunListQuery { limit: asked.limit.clamp(1, limits::RUNS_LISTED), ..asked.clone() };
        let wanted = asked.limit;
        let mut items = Vec::new();
        loop {
            let page = self.store.run_list(&asked).await.map_err(|error| match error {
                QueryError::Invalid(why) => Refused::from(Rejected::Invalid(why)),
                error => WriteError::from(error).into(),
            })?;
            for row in page.rows {
                items.extend(self.summary(row)?);
            }
            // The state and the tables are not of one moment.
            items.retain(|row: &RunSummary| asked.states.is_empty() || asked.states.contains(&row.state));
            asked.limit = wanted.saturating_sub(u32::try_from(items.len()).unwrap_or(u32::MAX));
            asked.after = page.next;
            if asked.limit == 0 || asked.after.is_none() {
                return Ok(Listing { items, next: asked.after });
            }
        }
    }

    /// The summary of a run of the tables; `None` if it was submitted after this state.
    fn summary(&self, row: RunSummary) -> Result<Option<RunSummary>, Refused> {
        let summary = match (self.state.run(&row.run), self.ending.get(&row.run)) {
            (Ok(run), _) => self.state.summary(run, self.now),
            (Err(_), Some(view)) => RunSummary::of(&read(&row.run, view)?),
            (Err(_), None) if row.state.is_final() => row.clone(),
            (Err(_), None) => return Ok(None),
        };
        let summary = RunSummary { created_ms: row.created_ms, changed_ms: row.changed_ms, ..summary };
        Ok(Some(summary.shortened()))
    }

    /// A run as clients see it, active or ended.
    ///
    /// # Errors
    /// If the run does not exist, or its row cannot be read.
    pub async fn run_view(&self, run: &RunId) -> Result<RunView, Refused> {
        let mut view = self.bare_view(run).await?;
        let times = self.times(&view).await?;
        view.times = times.run;
        for stage in &mut view.stages {
            if !matches!(stage.state, StageState::Waiting | StageState::Cached) {
                stage.times = times.stages.get(&stage.name).copied().unwrap_or_default();
            }
        }
        Ok(view)
    }

    /// Times of a run and its stages. Those of an active run are read once for each state.
    async fn times(&self, view: &RunView) -> Result<Arc<RunTimes>, Refused> {
        let run = &view.run;
        if let Some(kept) = self.times.get(&self.state, run) {
            return Ok(kept);
        }
        let mut times = self.store.run_times(std::slice::from_ref(run)).await.map_err(WriteError::from)?;
        let began = view.stages.iter().any(|stage| !matches!(stage.state, StageState::Waiting | StageState::Cached));
        let stages = if began { self.store.stage_times(run).await.map_err(WriteError::from)? } else { BTreeMap::new() };
        let times = Arc::new(RunTimes { run: times.remove(run).unwrap_or_default(), stages });
        if self.state.run(run).is_ok() {
            self.times.keep(&self.state, run.clone(), Arc::clone(&times));
        }
        Ok(times)
    }

    /// The view of a run as the coordinator has it, without times.
    async fn bare_view(&self, run: &RunId) -> Result<RunView, Refused> {
        let unknown = match self.state.run(run) {
            Ok(run) if self.shows(run) => return Ok(self.state.view(run, self.now)),
            Ok(_) => return Err(Rejected::unknown_run(run).into()),
            Err(unknown) => unknown,
        };
        if let Some(view) = self.ending.get(run) {
            return read(run, view);
        }
        match self.store.ended(run).await.map_err(WriteError::from)? {
            Some(row) => read(run, &row.view),
            None => Err(unknown.into()),
        }
    }

    /// Views of all workers. The task of a worker is shown only to callers who see its run.
    pub fn workers(&self) -> Vec<WorkerView> {
        let mut workers = self.state.worker_views();
        for worker in &mut workers {
            let task = worker.task.take();
            worker.task = task.filter(|task| {
                let run = self.state.task(task).ok().and_then(|(execution, _)| self.state.run(&execution.run).ok());
                self.sees.is_none() || run.is_some_and(|run| self.shows(run))
            });
        }
        workers
    }

    /// Log lines of a run, or of one of its stages, stored after line `after`; at most `limit`.
    ///
    /// # Errors
    /// If the run or stage does not exist, or the tables cannot be read.
    pub async fn logs(
        &self,
        run: &RunId,
        stage: Option<&StageName>,
        after: i64,
        limit: u32,
    ) -> Result<Vec<LogRow>, Refused> {
        let mut rows = Vec::new();
        let limit = limit.min(limits::LINES_READ);
        for (_, (run, stage)) in self.sources(run, stage).await? {
            rows.extend(self.store.logs(&run, Some(&stage), after, limit).await.map_err(WriteError::from)?);
        }
        rows.sort_by_key(|row| row.id);
        rows.truncate(limit as usize);
        Ok(rows)
    }

    /// The newest `limit` log lines of a run, or of one of its stages, in their order.
    ///
    /// # Errors
    /// If there is no such run or stage, or the tables do not read.
    pub async fn last_logs(&self, run: &RunId, stage: Option<&StageName>, limit: u32) -> Result<Vec<LogRow>, Refused> {
        let mut rows = Vec::new();
        let limit = limit.min(limits::LINES_READ);
        for (_, (run, stage)) in self.sources(run, stage).await? {
            rows.extend(self.store.last_logs(&run, Some(&stage), limit).await.map_err(WriteError::from)?);
        }
        rows.sort_by_key(|row| row.id);
        rows.drain(..rows.len().saturating_sub(limit as usize));
        Ok(rows)
    }

    /// Values by step of a run, or of one stage of it; of all keys, or of those named.
    ///
    /// # Errors
    /// If there is no such run or stage, or the tables do not read.
    pub async fn points(
        &self,
        run: &RunId,
        stage: Option<&StageName>,
        keys: Option<&[String]>,
        page: Page,
    ) -> Result<StageMetrics, Refused> {
        let mut stages = StageMetrics::new();
        for (name, (run, stage)) in self.sources(run, stage).await? {
            stages.insert(name, self.store.points(&run, &stage, keys, page).await.map_err(WriteError::from)?);
        }
        Ok(stages)
    }

    /// The curves of a run, or of one stage of it, in buckets.
    ///
    /// # Errors
    /// If there is no such run or stage, or the tables do not read.
    pub async fn buckets(
        &self,
        run: &RunId,
        stage: Option<&StageName>,
        keys: Option<&[String]>,
        window: &Window,
    ) -> Result<StageCurves, Refused> {
        let mut stages = StageCurves::new();
        for (name, (run, stage)) in self.sources(run, stage).await? {
            stages.insert(name, self.store.buckets(&run, &stage, keys, window).await.map_err(WriteError::from)?);
        }
        Ok(stages)
    }

    /// Returns the ids of the oldest event and of the newest one ever added.
    ///
    /// # Errors
    /// If the tables do not read.
    pub async fn history_span(&self) -> Result<(Option<i64>, i64), Refused> {
        Ok(self.store.history_span().await.map_err(WriteError::from)?)
    }

    /// Returns the events, oldest first.
    ///
    /// # Errors
    /// If there is no run of that name, or the tables do not read.
    pub async fn history(&self, asked: &HistoryQuery) -> Result<Vec<HistoryRow>, Refused> {
        if let Some(run) = &asked.run {
            self.bare_view(run).await?;
        }
        Ok(self.store.timeline(asked).await.map_err(WriteError::from)?)
    }

    /// For each stage of this run, the run and stage under which its logs and metrics are stored. A stage computed for
    /// another run has them under that run.
    pub(super) async fn sources(
        &self,
        run: &RunId,
        stage: Option<&StageName>,
    ) -> Result<Vec<(StageName, (RunId, StageName))>, Refused> {
        let view = self.bare_view(run).await?;
        if let Some(stage) = stage
            && !view.stages.iter().any(|known| known.name == *stage)
        {
            return Err(Rejected::NotFound(format!("run `{run}` has no stage `{stage}`")).into());
        }
        let begun = view.stages.into_iter().filter(|known| stage.is_none_or(|stage| known.name == *stage));
        let begun: Vec<(StageName, Digest)> = begun.filter_map(|known| Some((known.name, known.key?))).collect();
        let executions = &self.state.executions;
        let left: Vec<Digest> = begun.iter().map(|(_, key)| *key).filter(|key| !executions.contains_key(key)).collect();
        let stored = match left.as_slice() {
            [] => BTreeMap::new(),
            left => self.store.sources(left).await.map_err(WriteError::from)?,
        };
        let mut sources = Vec::new();
        for (name, key) in begun {
            let known = executions.get(&key).map(|execution| (execution.run.clone(), execution.stage.clone()));
            let source = known.or_else(|| stored.get(&key).cloned()).unwrap_or_else(|| (run.clone(), name.clone()));
            sources.push((name, source));
        }
        Ok(sources)
    }
}

/// Parses stored data of an ended run.
pub(super) fn read<T: serde::de::DeserializeOwned>(run: &RunId, text: &str) -> Result<T, Refused> {
    serde_json::from_str(text).map_err(|error| {
        Rejected::Conflict(format!("cannot read the stored data of run `{run}`: {error}; use the build that wrote it"))
            .into()
    })
}
