//! Messages of clients: the submission of a run, and its view, with stages and sweeps.

use std::collections::BTreeMap;

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use super::worker::Progress;
use crate::stage::Mode;
use crate::sweep::{SearchKind, Values};
use crate::{Attempt, Digest, Owner, RunId, StageName, WorkerId};

/// `POST /v1/runs`: submits a pipeline.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct Submit {
    /// The validated pipeline as JSON (`pipeline::Pipeline`).
    pub pipeline: serde_json::Value,
    /// YAML as written, kept for display.
    pub source: String,
    /// Submitting twice with one key creates one run.
    pub idempotency_key: Option<String>,
    /// Last stage to run.
    pub until: Option<StageName>,
}

/// A run as clients see it: `GET /v1/runs/{run}`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct RunView {
    pub run: RunId,
    /// The pipeline's name.
    pub pipeline: String,
    /// The token that submitted it.
    #[serde(default)]
    pub owner: Owner,
    pub state: RunState,
    /// It is paused because the process that worked on it ended, not because a user paused it.
    #[serde(default)]
    pub interrupted: bool,
    /// Order among the runs of its group: the highest is served first.
    #[serde(default, skip_serializing_if = "is_usual")]
    pub priority: i32,
    /// It waits until fewer runs of its group are at work.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub queued: bool,
    /// Stages in topological order, then the stages made by sweeps.
    pub stages: Vec<StageView>,
    /// Sweeps that have started.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub sweeps: Vec<SweepView>,
    /// The storage problem that blocks the run.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub storage: Option<StorageProblem>,
    #[serde(default, skip_serializing_if = "Times::are_unknown")]
    pub times: Times,
    /// Its standing in a sentence: the reason of a failure or of waiting, or the result.
    #[serde(default, skip_serializing_if = "String::is_empty")]
    pub note: String,
}

/// A part of a list.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct Listing<T> {
    pub items: Vec<T>,
    /// The `after` that continues the list; missing at its end. A search may return few items and still continue.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub next: Option<String>,
}

/// A run in a list: `GET /v1/runs`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct RunSummary {
    pub run: RunId,
    /// The pipeline's name.
    pub pipeline: String,
    /// Name of the token that submitted it, if it is known.
    #[serde(default, skip_serializing_if = "String::is_empty")]
    pub owner: String,
    /// The token's project.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub project: Option<String>,
    pub state: RunState,
    /// It is paused because the process that worked on it ended, not because a user paused it.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub interrupted: bool,
    /// Order among the runs of its group: the highest is served first.
    #[serde(default, skip_serializing_if = "is_usual")]
    pub priority: i32,
    /// It waits until fewer runs of its group are at work.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub queued: bool,
    /// Time of the submission, in milliseconds since 1970.
    pub created_ms: i64,
    /// Time of the newest change of its state, in milliseconds since 1970.
    pub changed_ms: i64,
    /// Number of finished stages.
    pub done: u32,
    /// Number of stages that were asked for, without those of sweeps.
    pub stages: u32,
    /// Seconds of work on these stages.
    pub wall_s: f64,
    /// Idle workers that it lacks, if that is what it waits for.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub wants_workers: Option<usize>,
    /// The beginning of [`RunView::note`].
    #[serde(default, skip_serializing_if = "String::is_empty")]
    pub note: String,
}

fn is_usual(priority: &i32) -> bool {
    *priority == 0
}

impl RunSummary {
    /// Largest size of a summary as JSON in bytes, unless its names alone are longer.
    pub const BYTES: usize = 300;

    /// Summarises a view. Its times are those of the view, or 0.
    pub fn of(view: &RunView) -> Self {
        let main = || view.stages.iter().filter(|stage| stage.of.is_none() && stage.is_asked_for());
        let count = |stages: usize| u32::try_from(stages).unwrap_or(u32::MAX);
        let created_ms = view.times.created_ms.unwrap_or_default();
        Self {
            run: view.run.clone(),
            pipeline: view.pipeline.clone(),
            owner: view.owner.name.clone(),
            project: view.owner.project.clone(),
            state: view.state,
            interrupted: view.interrupted,
            priority: view.priority,
            queued: view.queued,
            created_ms,
            changed_ms: view.times.ended_ms.unwrap_or(created_ms),
            done: count(main().filter(|stage| stage.state.is_done()).count()),
            stages: count(main().count()),
            wall_s: main().map(|stage| stage.wall_s).sum(),
            wants_workers: main().find_map(|stage| stage.wants_workers),
            note: view.note.clone(),
        }
    }

    /// Shortens the note so that the summary as JSON has at most [`Self::BYTES`] bytes.
    #[must_use]
    pub fn shortened(mut self) -> Self {
        self.wall_s = (self.wall_s * 10.0).round() / 10.0;
        let note = std::mem::take(&mut self.note);
        // Ten bytes: the note's name, quotes and comma.
        let mut left = Self::BYTES.saturating_sub(json_length(&self) + 10);
        if json_length(&note) - 2 <= left {
            self.note = note;
            return self;
        }
        left = left.saturating_sub('…'.len_utf8());
        for letter in note.chars() {
            let bytes = json_length(&letter) - 2;
            if bytes > left {
                break;
            }
            left -= bytes;
            self.note.push(letter);
        }
        if !self.note.is_empty() {
            self.note.push('…');
        }
        self
    }
}

fn json_length(value: &impl Serialize) -> usize {
    serde_json::to_vec(value).map_or(0, |text| text.len())
}

/// Why a store does not take or give what it should.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
pub struct StorageProblem {
    /// Since when, in milliseconds since 1970.
    pub since_ms: i64,
    /// Description of the problem.
    pub what: String,
}

/// State of a run.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "kebab-case")]
pub enum RunState {
    /// Work is in progress or waits for workers.
    Running,
    /// Paused by the user; work yields.
    Paused,
    /// Every requested stage is done.
    Finished,
    /// A stage failed permanently.
    Failed,
    /// Cancelled by the user.
    Cancelled,
}

impl RunState {
    const ALL: [(Self, &str); 5] = [
        (Self::Running, "running"),
        (Self::Paused, "paused"),
        (Self::Finished, "finished"),
        (Self::Failed, "failed"),
        (Self::Cancelled, "cancelled"),
    ];

    /// Its name in JSON and in tables.
    pub fn name(self) -> &'static str {
        Self::ALL.iter().find(|(state, _)| *state == self).map_or("", |(_, name)| name)
    }

    /// The state of a name.
    pub fn named(text: &str) -> Option<Self> {
        Self::ALL.iter().find(|(_, name)| *name == text).map(|(state, _)| *state)
    }

    /// Returns true if the state cannot change any more.
    pub fn is_final(self) -> bool {
        matches!(self, Self::Finished | Self::Failed | Self::Cancelled)
    }
}

/// Times of a run or a stage by the server's clock, in milliseconds since 1970.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
pub struct Times {
    /// Time of the submission; a stage has none.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub created_ms: Option<i64>,
    /// Start of the first work.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub started_ms: Option<i64>,
    /// End of the newest attempt at all of it.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub ended_ms: Option<i64>,
}

impl Times {
    /// Returns true if no time is known.
    pub fn are_unknown(&self) -> bool {
        *self == Self::default()
    }
}

/// A stage as clients see it.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct StageView {
    pub name: StageName,
    /// Stage kind, such as `train.vae`.
    pub kind: String,
    pub state: StageState,
    /// Key of the stage, once its inputs are known.
    pub key: Option<Digest>,
    /// Outputs by name.
    pub outputs: BTreeMap<String, Digest>,
    /// Final values, or the newest ones while it runs.
    #[schemars(with = "BTreeMap<String, Option<f64>>")]
    pub metrics: BTreeMap<String, f64>,
    pub progress: Progress,
    /// Seconds of work so far, over all attempts of this run; not part of any key.
    pub wall_s: f64,
    /// Peak resident memory of one of its workers' processes during its newest attempt, in bytes; not part of any key.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub peak_memory: Option<u64>,
    /// Number of the current attempt.
    pub attempt: Attempt,
    /// Workers with an assignment of it now.
    pub workers: Vec<WorkerId>,
    /// Instruction set of the workers that computed it, or compute it now; not part of any key.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub instruction_set: Option<String>,
    /// Reason of a failure, or of waiting.
    pub message: Option<String>,
    /// Idle workers that it lacks, if that is what it waits for.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub wants_workers: Option<usize>,
    /// Swept stage that it belongs to, if a sweep made it.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub of: Option<StageName>,
    /// The stage of the pipeline's file that it is a copy of, if the file wants several by `seeds` or folds.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub copy_of: Option<StageName>,
    #[serde(default, skip_serializing_if = "Times::are_unknown")]
    pub times: Times,
    /// Stages that it reads.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub needs: Vec<StageName>,
}

impl StageView {
    /// The message of a stage that the submission left out (`until`).
    pub const NOT_ASKED_FOR: &str = "not asked for";

    /// Returns false for a stage that the submission left out (`until`).
    pub fn is_asked_for(&self) -> bool {
        self.state != StageState::Skipped || self.message.as_deref() != Some(Self::NOT_ASKED_FOR)
    }
}

/// A sweep as clients see it.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct SweepView {
    /// The swept stage.
    pub stage: StageName,
    /// Search method of the sweep.
    pub search: SearchKind,
    /// Metric that ranks the trials.
    pub metric: String,
    /// Direction of the metric.
    pub mode: Mode,
    /// Steps at which trials are compared; the last is the whole budget.
    pub rungs: Vec<u64>,
    /// True if no work is in progress or will follow.
    pub over: bool,
    /// Number of steps trained so far, for this sweep or an earlier one.
    pub spent: u64,
    /// Number of steps if no trial fails.
    pub planned: u64,
    /// Number of steps if every trial had the whole budget.
    pub full: u64,
    /// Best trial at the whole budget so far.
    pub best: Option<usize>,
    /// All trials in the order of their numbers.
    pub trials: Vec<TrialView>,
}

/// A trial as clients see it.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct TrialView {
    /// Number of the trial, from 0.
    pub trial: usize,
    /// Values of the searched settings by path.
    pub values: Values,
    pub state: TrialState,
    /// Number of steps trained.
    pub steps: u64,
    /// Metric after each rung with a result; `None` for a failure.
    pub results: Vec<Option<f64>>,
    /// Reason of a failure.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub message: Option<String>,
}

/// State of a trial.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "kebab-case")]
pub enum TrialState {
    /// Not started yet.
    Waiting,
    /// A rung is scheduled: workers compute it or will.
    Running,
    /// A rung is done; the next one is not decided.
    Paused,
    /// Ended after a rung before the whole budget.
    Stopped,
    /// Trained for the whole budget.
    Finished,
    /// Failed and was stopped.
    Failed,
}

/// State of a stage.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "kebab-case")]
pub enum StageState {
    /// Waits for other stages.
    Waiting,
    /// Can start; waits for workers.
    Ready,
    /// Workers compute it.
    Running,
    /// Done in this run, from step 0.
    Ran,
    /// Not run, because a result with its key exists.
    Cached,
    /// Done in this run, continuing a checkpoint of an earlier attempt.
    Resumed,
    /// Failed, without further attempts.
    Failed,
    /// Will not run: an input failed, the run was cancelled, or `--until` ends before it.
    Skipped,
}

impl StageState {
    /// Returns true if the stage has its value.
    pub fn is_done(self) -> bool {
        matches!(self, Self::Ran | Self::Cached | Self::Resumed)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_summary_fits_whatever_its_note_says() {
        let note =
            ["short", &"loss is NaN ".repeat(100), &"\"\\\u{1}".repeat(200), &"ö…😀".repeat(200)].map(str::to_owned);
        for note in note {
            let summary = RunSummary {
                run: "quickstart-0a1b2c3d-100000".into(),
                pipeline: "quickstart".into(),
                owner: "alice".into(),
                project: Some("motion".into()),
                state: RunState::Cancelled,
                interrupted: true,
                priority: -100,
                queued: true,
                created_ms: 1_764_054_273_000,
                changed_ms: 1_764_054_273_000,
                done: 12,
                stages: 12,
                wall_s: 1.0 / 3.0,
                wants_workers: Some(2),
                note: note.clone(),
            };
            let shortened = summary.shortened();
            assert!(json_length(&shortened) <= RunSummary::BYTES, "{shortened:?}");
            assert!(note.starts_with(shortened.note.trim_end_matches('…')) && !shortened.note.is_empty());
        }
    }
}
