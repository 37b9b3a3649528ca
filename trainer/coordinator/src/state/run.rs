//! One run of a pipeline.
//!
//! | state \ event | pause | resume | cancel | a stage failed | all wanted stages done |
//! |---|---|---|---|---|---|
//! | Running | Paused | Running | Cancelled | Failed | Finished |
//! | Paused | Paused | Running | Cancelled | Failed | Finished |
//! | Finished | - | - | - | - | - |
//! | Failed | - | Running | - | - | - |
//! | Cancelled | - | Running | Cancelled | - | - |
//!
//! `-` refuses a client's request. A run can be ended from every state and resumed from every state except `Finished`.
//! Finished stages are found again by their keys, unfinished ones by their checkpoints.

use std::collections::{BTreeMap, BTreeSet, HashMap};
use std::sync::Arc;

use pipeline::{Pipeline, PipelineStage};
use protocol::message::{RunState, StageState, StageView};
use protocol::sweep::STATE_OUTPUT;
use protocol::{ArtifactKind, Attempt, Digest, Owner, RunId, StageName};
use serde::{Deserialize, Serialize};

use crate::search::Search;
use crate::value::Known;

/// A client's request to a run.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Control {
    /// Pause the run; its workers save and yield.
    Pause,
    /// Continue after a pause, a failure or a cancellation.
    Resume,
    /// End the run.
    Cancel,
}

/// The status of a stage in a run.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Status {
    /// Some inputs are not available yet.
    Waiting,
    /// Its trials are in progress; the searcher is in [`Run::sweeps`].
    Sweeping,
    /// Its execution, which has the stage's key, is in progress.
    Active { key: Digest },
    /// Its value is known.
    Done {
        key: Digest,
        /// `Ran`, `Cached` or `Resumed`.
        how: StageState,
        #[serde(with = "super::shared")]
        known: Arc<Known>,
        /// Seconds of work.
        wall_s: f64,
        /// The number of the attempt that computed it.
        attempt: Attempt,
        /// Peak memory of a worker's process, in bytes.
        #[serde(default, skip_serializing_if = "Option::is_none")]
        peak_memory: Option<u64>,
    },
    /// It failed for good.
    Failed {
        key: Digest,
        /// The reason, as text for the user.
        message: String,
    },
    /// It will not be computed.
    Skipped {
        /// The stage's key, if it had started.
        key: Option<Digest>,
        reason: String,
    },
}

impl Status {
    /// The stage's key, once known.
    pub fn key(&self) -> Option<Digest> {
        match self {
            Self::Waiting | Self::Sweeping => None,
            Self::Active { key } | Self::Done { key, .. } | Self::Failed { key, .. } => Some(*key),
            Self::Skipped { key, .. } => *key,
        }
    }

    /// The stage's value, once done.
    pub fn known(&self) -> Option<&Known> {
        match self {
            Self::Done { known, .. } => Some(known),
            Self::Waiting | Self::Sweeping | Self::Active { .. } | Self::Failed { .. } | Self::Skipped { .. } => None,
        }
    }
}

/// A sweep in progress or complete.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Sweeping {
    /// The index of the swept stage.
    pub stage: usize,
    /// The searcher that chooses the next trials.
    pub search: Search,
    /// For each ticket, the index of its training stage, which its evaluation stage follows. `None` for a ticket
    /// without work or with impossible settings.
    pub places: Vec<Option<usize>>,
    /// Reasons of failed trials, by trial.
    pub failures: BTreeMap<usize, String>,
}

/// A run that has not ended. Ended runs are in the tables and not in memory.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(from = "Stored", into = "Stored")]
pub struct Run {
    pub id: RunId,
    /// Its number in the order of submission.
    pub number: u64,
    /// The submitting token's owner, with its permissions at that time.
    pub owner: Owner,
    /// The pipeline as submitted.
    pub submitted: Arc<Pipeline>,
    /// The pipeline that is executed: the submitted one, followed by the stages that sweeps made.
    pub pipeline: Arc<Pipeline>,
    pub idempotency_key: Option<String>,
    /// The last stage to run.
    pub until: Option<StageName>,
    pub state: RunState,
    /// Set if a restart of the coordinator paused it, not a user.
    pub parked: bool,
    /// Set if it waits until fewer runs of its group are at work.
    pub queued: bool,
    /// The status of each stage of the pipeline.
    pub stages: Vec<Status>,
    /// Sweeps that have started.
    pub sweeps: Vec<Arc<Sweeping>>,
    /// Digests of files outside the store, by stage index and field. A worker computed them for stages submitted
    /// without digests.
    pub resolved: BTreeMap<usize, BTreeMap<String, Digest>>,
    /// Stage indexes by name. Derived from the pipeline.
    places: Arc<HashMap<StageName, usize>>,
    /// Indexes of active stages. Derived from the stages.
    active: BTreeSet<usize>,
}

/// A run as it is stored.
#[derive(Serialize, Deserialize)]
struct Stored {
    id: RunId,
    number: u64,
    #[serde(default)]
    owner: Owner,
    submitted: Pipeline,
    /// Stages that sweeps made.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    made: Vec<PipelineStage>,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    idempotency_key: Option<String>,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    until: Option<StageName>,
    state: RunState,
    #[serde(default)]
    parked: bool,
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    queued: bool,
    stages: Vec<Status>,
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    sweeps: Vec<Sweeping>,
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    resolved: BTreeMap<usize, BTreeMap<String, Digest>>,
}

impl From<Run> for Stored {
    fn from(run: Run) -> Self {
        let made = run.pipeline.stages[run.submitted.stages.len()..].to_vec();
        Self {
            id: run.id,
            number: run.number,
            owner: run.owner,
            submitted: Arc::unwrap_or_clone(run.submitted),
            made,
            idempotency_key: run.idempotency_key,
            until: run.until,
            state: run.state,
            parked: run.parked,
            queued: run.queued,
            stages: run.stages,
            sweeps: run.sweeps.into_iter().map(Arc::unwrap_or_clone).collect(),
            resolved: run.resolved,
        }
    }
}

impl From<Stored> for Run {
    fn from(stored: Stored) -> Self {
        let submitted = Arc::new(stored.submitted);
        let mut run = Self {
            id: stored.id,
            number: stored.number,
            owner: stored.owner,
            pipeline: Arc::clone(&submitted),
            submitted,
            idempotency_key: stored.idempotency_key,
            until: stored.until,
            state: stored.state,
            parked: stored.parked,
            queued: stored.queued,
            stages: Vec::new(),
            sweeps: stored.sweeps.into_iter().map(Arc::new).collect(),
            resolved: stored.resolved,
            places: Arc::default(),
            active: BTreeSet::new(),
        };
        run.places = Arc::new(places(&run.submitted.stages, 0).collect());
        if !stored.made.is_empty() {
            run.add_stages(stored.made);
        }
        run.stages = stored.stages;
        run.active = run.active_places();
        run
    }
}

/// The number at the end of a run's id.
pub fn number_of(run: &RunId) -> Option<u64> {
    run.as_str().rsplit('-').next()?.parse().ok()
}

fn places(stages: &[PipelineStage], first: usize) -> impl Iterator<Item = (StageName, usize)> + '_ {
    stages.iter().enumerate().map(move |(i, stage)| (stage.name.clone(), first + i))
}

impl Run {
    /// Creates a submitted run.
    pub fn new(
        number: u64,
        owner: Owner,
        pipeline: Arc<Pipeline>,
        key: Option<String>,
        until: Option<StageName>,
    ) -> Self {
        let digest = pipeline.digest();
        let id = RunId::new(format!("{}-{}-{number}", pipeline.name, &digest.hex()[..8]));
        let wanted = wanted(&pipeline, until.as_ref());
        let stages = (0..pipeline.stages.len())
            .map(|i| if wanted.contains(&i) { Status::Waiting } else { not_asked_for() })
            .collect();
        Self {
            id,
            number,
            owner,
            submitted: Arc::clone(&pipeline),
            places: Arc::new(places(&pipeline.stages, 0).collect()),
            pipeline,
            idempotency_key: key,
            until,
            state: RunState::Running,
            parked: false,
            queued: false,
            stages,
            sweeps: Vec::new(),
            resolved: BTreeMap::new(),
            active: BTreeSet::new(),
        }
    }

    /// Appends stages that a sweep made, with the status `Waiting`.
    pub(crate) fn add_stages(&mut self, made: Vec<PipelineStage>) {
        Arc::make_mut(&mut self.places).extend(places(&made, self.pipeline.stages.len()));
        self.stages.resize(self.stages.len() + made.len(), Status::Waiting);
        Arc::make_mut(&mut self.pipeline).stages.extend(made);
    }

    /// Sets the status of a stage. This is the only way to change it.
    pub(crate) fn set(&mut self, stage: usize, status: Status) {
        match status {
            Status::Active { .. } => self.active.insert(stage),
            _ => self.active.remove(&stage),
        };
        self.stages[stage] = status;
    }

    fn active_places(&self) -> BTreeSet<usize> {
        let is_active = |(i, status): (usize, &Status)| matches!(status, Status::Active { .. }).then_some(i);
        self.stages.iter().enumerate().filter_map(is_active).collect()
    }

    /// Returns true if the derived fields agree with the others; invariant C14.
    pub fn is_indexed(&self) -> bool {
        let placed = |(i, stage): (usize, &PipelineStage)| self.places.get(&stage.name) == Some(&i);
        self.active == self.active_places() && self.pipeline.stages.iter().enumerate().all(placed)
    }

    /// The index of a stage in the pipeline.
    pub fn position(&self, stage: &StageName) -> Option<usize> {
        self.places.get(stage).copied()
    }

    /// The status of a stage by name.
    pub fn status(&self, stage: &StageName) -> Option<&Status> {
        self.stages.get(self.position(stage)?)
    }

    /// Returns true if its stages are computed now: it is neither paused, queued nor over.
    pub fn is_at_work(&self) -> bool {
        self.state == RunState::Running && !self.queued
    }

    /// The active stages with their keys. Paused, queued and ended runs have none.
    pub fn active(&self) -> impl Iterator<Item = (usize, Digest)> + '_ {
        let places = self.is_at_work().then_some(&self.active);
        places.into_iter().flatten().filter_map(|i| Some((*i, self.stages[*i].key()?)))
    }

    /// Like [`active`](Self::active), in every state of the run.
    pub fn all_active(&self) -> impl Iterator<Item = (usize, Digest)> + '_ {
        self.active.iter().filter_map(|i| Some((*i, self.stages[*i].key()?)))
    }

    /// The values of a stage's inputs by field, or `None` while one is missing.
    pub fn inputs(&self, stage: usize) -> Option<BTreeMap<String, Digest>> {
        let resolved = self.resolved.get(&stage);
        let stage = &self.pipeline.stages[stage];
        let mut inputs = resolved.cloned().unwrap_or_default();
        // Digests from the submission override digests found by a worker.
        inputs.extend(stage.external.iter().map(|(field, digest)| (field.clone(), *digest)));
        for input in &stage.inputs {
            let known = self.status(&input.stage)?.known()?;
            let output = match input.kind {
                ArtifactKind::Checkpoint => known.outputs.get(STATE_OUTPUT),
                _ => value(known),
            };
            inputs.insert(input.field.clone(), *output?);
        }
        Some(inputs)
    }

    /// Returns true if `inputs` has a digest for each file that the stage reads outside the store.
    pub fn is_resolved(&self, stage: usize, inputs: &BTreeMap<String, Digest>) -> bool {
        let folders = self.pipeline.stages[stage].settings.folders();
        folders.iter().all(|folder| inputs.contains_key(&folder.field))
    }

    /// The run's state after `action`; `None` if it is refused.
    pub fn after(&self, action: Control) -> Option<RunState> {
        match (self.state, action) {
            (RunState::Running | RunState::Paused, Control::Pause) => Some(RunState::Paused),
            (RunState::Running | RunState::Paused, Control::Resume) => Some(RunState::Running),
            (RunState::Running | RunState::Paused, Control::Cancel) => Some(RunState::Cancelled),
            (RunState::Failed | RunState::Cancelled, Control::Resume) => Some(RunState::Running),
            (RunState::Cancelled, Control::Cancel) => Some(RunState::Cancelled),
            (RunState::Failed | RunState::Cancelled, Control::Pause) => None,
            (RunState::Failed, Control::Cancel) => None,
            (RunState::Finished, Control::Pause | Control::Resume | Control::Cancel) => None,
        }
    }

    /// The run's state as implied by its stages.
    pub fn state_by_stages(&self) -> RunState {
        match self.state {
            RunState::Running | RunState::Paused => {
                let not_asked_for = not_asked_for();
                if self.failed().is_some() {
                    RunState::Failed
                } else if self.asked().iter().all(|s| matches!(s, Status::Done { .. }) || *s == not_asked_for) {
                    RunState::Finished
                } else {
                    self.state
                }
            }
            RunState::Finished | RunState::Failed | RunState::Cancelled => self.state,
        }
    }

    /// Returns true if a restart of the coordinator paused it, not a user.
    pub fn is_interrupted(&self) -> bool {
        self.parked && self.state == RunState::Paused
    }

    /// The stages of the submitted pipeline. Only these determine the run's state; a failed trial is just a result of
    /// its sweep.
    pub fn asked(&self) -> &[Status] {
        &self.stages[..self.submitted.stages.len()]
    }

    /// The first stage that failed for good.
    pub fn failed(&self) -> Option<usize> {
        self.asked().iter().position(|status| matches!(status, Status::Failed { .. }))
    }

    /// The sweep of a stage, if it has started.
    pub fn sweep(&self, stage: usize) -> Option<&Arc<Sweeping>> {
        self.sweeps.iter().find(|sweep| sweep.stage == stage)
    }

    /// Skips all stages that are not over.
    pub fn skip_rest(&mut self, reason: &str) {
        for i in 0..self.stages.len() {
            match self.stages[i] {
                Status::Waiting | Status::Sweeping | Status::Active { .. } => {
                    self.set(i, Status::Skipped { key: self.stages[i].key(), reason: reason.to_owned() });
                }
                Status::Done { .. } | Status::Failed { .. } | Status::Skipped { .. } => {}
            }
        }
    }

    /// Resets all wanted stages that are not done.
    pub fn reopen(&mut self) {
        let mut wanted = wanted(&self.submitted, self.until.as_ref());
        // A trial that already has a result is not repeated.
        for sweep in self.sweeps.iter().filter(|sweep| wanted.contains(&sweep.stage)).collect::<Vec<_>>() {
            for (ticket, place) in sweep.places.iter().enumerate() {
                if let (Some(place), None) = (place, sweep.search.score(ticket)) {
                    wanted.extend([*place, place + 1]);
                }
            }
        }
        for i in 0..self.stages.len() {
            match self.stages[i] {
                Status::Failed { .. } | Status::Skipped { .. } if wanted.contains(&i) => {
                    // The files that it reads may have been repaired since.
                    self.resolved.remove(&i);
                    self.set(i, Status::Waiting);
                }
                Status::Failed { .. }
                | Status::Skipped { .. }
                | Status::Waiting
                | Status::Sweeping
                | Status::Active { .. }
                | Status::Done { .. } => {}
            }
        }
    }
}

/// The value of a stage, selected from its outputs.
pub(crate) fn value(known: &Known) -> Option<&Digest> {
    known.outputs.iter().find(|(name, _)| *name != STATE_OUTPUT).map(|(_, output)| output)
}

fn not_asked_for() -> Status {
    Status::Skipped { key: None, reason: StageView::NOT_ASKED_FOR.to_owned() }
}

/// Indexes of the stages that `until` names and all of their dependencies; all stages if it is `None`.
fn wanted(pipeline: &Pipeline, until: Option<&StageName>) -> BTreeSet<usize> {
    let Some(until) = until else { return (0..pipeline.stages.len()).collect() };
    let mut names: BTreeSet<&StageName> = pipeline.named(until).map(|stage| &stage.name).collect();
    let mut wanted = BTreeSet::new();
    for (i, stage) in pipeline.stages.iter().enumerate().rev() {
        if names.contains(&stage.name) {
            wanted.insert(i);
            names.extend(stage.inputs.iter().map(|input| &input.stage));
        }
    }
    wanted
}

#[cfg(test)]
mod tests {
    use pipeline::PipelineStage;
    use protocol::Seed;
    use protocol::stage::{Backend, StageSettings};

    use super::*;

    fn run() -> Run {
        let settings = StageSettings::all().remove(0);
        let stage = PipelineStage {
            name: "only".into(),
            settings,
            placement: Default::default(),
            inputs: Vec::new(),
            external: BTreeMap::new(),
            sweep: None,
            derived: None,
            copy_of: None,
        };
        let pipeline = Pipeline {
            name: "p".into(),
            seed: Seed(1),
            backend: Backend::Flex,
            priority: 0,
            stages: vec![stage],
            code_versions: BTreeMap::new(),
        };
        Run::new(1, Owner::local("me"), Arc::new(pipeline), None, None)
    }

    #[test]
    fn the_table_in_the_header_is_what_the_code_does() {
        let key = Digest::of(b"");
        let failed = Status::Failed { key, message: String::new() };
        let known = Arc::new(Known { outputs: BTreeMap::new(), metrics: BTreeMap::new() });
        let attempt = Attempt(1);
        let done = Status::Done { key, how: StageState::Ran, known, wall_s: 0.0, attempt, peak_memory: None };
        for state in [RunState::Running, RunState::Paused, RunState::Finished, RunState::Failed, RunState::Cancelled] {
            let asked = |action| Run { state, ..run() }.after(action).map_or("-".to_owned(), |s| format!("{s:?}"));
            let becomes = |status: &Status| {
                let after = Run { state, stages: vec![status.clone()], ..run() }.state_by_stages();
                if after == state { "-".to_owned() } else { format!("{after:?}") }
            };
            let row = format!(
                "//! | {state:?} | {} | {} | {} | {} | {} |",
                asked(Control::Pause),
                asked(Control::Resume),
                asked(Control::Cancel),
                becomes(&failed),
                becomes(&done)
            );
            assert!(include_str!("run.rs").lines().any(|line| line == row), "{row}");
        }
    }
}
