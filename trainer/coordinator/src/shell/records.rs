//! What there is to tell of runs: those that go on are in the coordinator's state, those that ended in the tables alone.

use std::collections::BTreeMap;
use std::path::Path;
use std::sync::Arc;

use protocol::message::RunView;
use protocol::{Digest, Group, RunId, StageName, limits};
use registry::{Curve, LogRow, OpenError, ReadStore, Write, WriteError};

use super::clock::wall_clock;
use super::start_error::StartError;
use crate::batch::Refused;
use crate::decide::decide;
use crate::event::{Effect, Event};
use crate::policy::Policy;
use crate::rejected::Rejected;
use crate::state::State;
use crate::state::run::Run;
use crate::time::{Millis, Moment};
use crate::view::WorkerView;
use crate::{journal, state};

/// The answer to `GET /v1/runs/{run}/metrics`: values by step, by key, by stage.
pub type StageMetrics = BTreeMap<StageName, BTreeMap<String, Curve>>;

/// A state and the tables beside it, for questions that change nothing.
#[derive(Debug, Clone)]
pub struct Records {
    store: ReadStore,
    state: Arc<State>,
    now: Millis,
    /// Runs that would end if a coordinator started here, as clients would see them. They are in no table yet.
    ending: BTreeMap<RunId, String>,
    /// The group whose runs are shown; `None` shows all.
    sees: Option<Group>,
}

/// Why there is nothing to read.
#[derive(Debug, thiserror::Error)]
pub enum RecordsError {
    /// The store.
    #[error(transparent)]
    Open(#[from] OpenError),
    /// What was decided before.
    #[error(transparent)]
    Recover(#[from] StartError),
}

impl Records {
    pub(super) fn new(store: ReadStore, state: Arc<State>, now: Millis, sees: Option<Group>) -> Self {
        Self { store, state, now, ending: BTreeMap::new(), sees }
    }

    fn shows(&self, run: &Run) -> bool {
        self.sees.as_ref().is_none_or(|group| run.owner.group() == *group)
    }

    /// Opens the store in `dir`, which no coordinator holds. It is read as a coordinator would find it that started now: nobody is at
    /// work, and what was interrupted waits to be resumed. Nothing is started and nothing is written.
    ///
    /// # Errors
    /// If there is no store to read, or what was decided before is not what this build understands.
    pub async fn open(dir: &Path) -> Result<Self, RecordsError> {
        let store = ReadStore::open(dir).await?;
        let stored = store.recovery().await.map_err(StartError::from)?;
        let mut state = journal::recover(Policy::default(), &stored).map_err(StartError::from)?;
        let now = wall_clock().max(state.now);
        // No secret comes of it: nobody is granted anything.
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

    /// Lets go of the store.
    pub async fn close(self) {
        self.store.close().await;
    }

    /// The store that is read.
    pub fn store(&self) -> &ReadStore {
        &self.store
    }

    /// Runs by submission, each as JSON: the newest `limit`, or those before a run, if one is given.
    ///
    /// # Errors
    /// If the tables do not read.
    pub async fn run_views(&self, before: Option<&RunId>, limit: u32) -> Result<Vec<String>, Refused> {
        let limit = limit.min(limits::RUNS_LISTED);
        let ended = self.store.ended_views(before, limit).await.map_err(WriteError::from)?;
        let place = |run: RunId| (state::run::number_of(&run), run);
        let mut views: BTreeMap<_, String> = ended.into_iter().map(|(run, view)| (place(run), view)).collect();
        let first_after = before.map_or(u64::MAX, |run| state::run::number_of(run).unwrap_or_default());
        // A run that ended since the state was read, or goes on after an end, is in both.
        let ending = self.ending.iter().map(|(run, view)| (place(run.clone()), view.clone()));
        views.extend(ending.filter(|((number, _), _)| number.is_some_and(|number| number < first_after)));
        let live = self.state.runs.range(..first_after).rev().filter(|(_, run)| self.shows(run));
        for (_, run) in live.take(limit as usize) {
            let view = serde_json::to_string(&self.state.view(run, self.now));
            let view = view.map_err(|e| Rejected::Invalid(format!("run `{}`: {e}", run.id)))?;
            views.insert(place(run.id.clone()), view);
        }
        while views.len() > limit as usize {
            views.pop_first();
        }
        Ok(views.into_values().collect())
    }

    /// A run as clients see it, whether it goes on or has ended.
    ///
    /// # Errors
    /// If there is no such run, or what is kept of it does not read.
    pub async fn run_view(&self, run: &RunId) -> Result<RunView, Refused> {
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

    /// All workers. What one works on is shown to those who see its run.
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

    /// Log lines of a run, or of one stage of it, that were stored after line `after`; at most `limit`.
    ///
    /// # Errors
    /// If there is no such run or stage, or the tables do not read.
    pub async fn logs(
        &self,
        run: &RunId,
        stage: Option<&StageName>,
        after: i64,
        limit: u32,
    ) -> Result<Vec<LogRow>, Refused> {
        let (mut rows, limit) = (Vec::new(), limit.min(limits::LINES_READ));
        for (_, (run, stage)) in self.sources(run, stage).await? {
            rows.extend(self.store.logs(&run, Some(&stage), after, limit).await.map_err(WriteError::from)?);
        }
        rows.sort_by_key(|row| row.id);
        rows.truncate(limit as usize);
        Ok(rows)
    }

    /// Values by step of a run, or of one stage of it; at most about `points` of each key.
    ///
    /// # Errors
    /// If there is no such run or stage, or the tables do not read.
    pub async fn metrics(
        &self,
        run: &RunId,
        stage: Option<&StageName>,
        points: usize,
    ) -> Result<StageMetrics, Refused> {
        let points = if points == 0 { limits::CURVE_POINTS } else { points.min(limits::CURVE_POINTS) };
        let mut stages = StageMetrics::new();
        for (name, (run, stage)) in self.sources(run, stage).await? {
            stages.insert(name, self.store.metrics(&run, &stage, None, points).await.map_err(WriteError::from)?);
        }
        Ok(stages)
    }

    /// By the name of a stage in this run: the run and the stage under whose names its logs and values are stored. A stage that another
    /// run computes has them under that run's name.
    async fn sources(
        &self,
        run: &RunId,
        stage: Option<&StageName>,
    ) -> Result<Vec<(StageName, (RunId, StageName))>, Refused> {
        let view = self.run_view(run).await?;
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
        let source = |(name, key): (StageName, Digest)| {
            let known = executions.get(&key).map(|execution| (execution.run.clone(), execution.stage.clone()));
            let source = known.or_else(|| stored.get(&key).cloned()).unwrap_or_else(|| (run.clone(), name.clone()));
            (name, source)
        };
        Ok(begun.into_iter().map(source).collect())
    }
}

/// What the tables keep of a run that ended.
pub(super) fn read<T: serde::de::DeserializeOwned>(run: &RunId, text: &str) -> Result<T, Refused> {
    serde_json::from_str(text).map_err(|error| {
        Rejected::Conflict(format!("what is kept of run `{run}` does not read: {error}; use the build that wrote it"))
            .into()
    })
}
