//! `sweep:` on a training stage: which settings are searched, how, and what evaluates a trial.
//!
//! A trial is the stage with some of its settings changed, trained in rungs: a rung is an ordinary stage that stops before the end of
//! its learning rate schedule, and the next rung goes on from the state that it left. Settings of the stage that evaluates can be searched
//! too: trials that differ in those alone have one training key, and so share one training. This module is data and the arithmetic on it;
//! who is tried next is decided by the coordinator (`coordinator::search`).

use std::collections::BTreeMap;

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use serde_json::Value;

use crate::stage::{Mode, Placement, Ref, StageSettings, Target, WorkerRange};
use crate::{ArtifactKind, StageName, Steps, pipeline};

/// How the space is searched.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "lowercase")]
pub enum SearchKind {
    /// Every point of the grid, each for the whole budget.
    Grid,
    /// Points drawn at random, each for the whole budget.
    Random,
    /// Points drawn at random, each for the first rung; the best go on to the next rung, as soon as it is clear who they are.
    Asha,
}

impl SearchKind {
    /// The name in YAML.
    pub fn name(self) -> &'static str {
        match self {
            Self::Grid => "grid",
            Self::Random => "random",
            Self::Asha => "asha",
        }
    }
}

/// Budgets at which ASHA compares trials: `first`, `first * factor`, ... below the stage's `steps`, and these.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(default)]
pub struct Rungs {
    /// Steps of the first rung.
    pub first: Steps,
    /// One in so many goes on, for so many times the steps.
    pub factor: u64,
}

impl Default for Rungs {
    fn default() -> Self {
        Self { first: Steps(0), factor: 3 }
    }
}

/// The values that a setting may take.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Domain {
    /// One of these.
    Choice(Vec<Value>),
    /// Between these two; a whole number if the setting is one.
    Uniform(f64, f64),
    /// Between these two, with a logarithm that is uniform.
    LogUniform(f64, f64),
}

impl Domain {
    /// How many values it lists.
    pub fn choices(&self) -> usize {
        match self {
            Self::Choice(values) => values.len(),
            Self::Uniform(..) | Self::LogUniform(..) => 0,
        }
    }
}

/// What the path of a searched setting of [`Sweep::evaluate`] begins with, before a `.`.
pub const EVALUATE: &str = "evaluate";

/// The path within the stage that evaluates, if `path` leads there.
pub fn in_evaluation(path: &str) -> Option<&str> {
    path.strip_prefix(EVALUATE)?.strip_prefix('.')
}

/// Values of the searched settings by their path, such as `adversarial`, `network.width` or `evaluate.sampler.guidance`.
pub type Values = BTreeMap<String, Value>;

/// A search over the settings of a training stage.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Sweep {
    /// How.
    pub search: SearchKind,
    /// The metric of `evaluate` that decides.
    pub metric: String,
    /// Its direction.
    pub mode: Mode,
    /// Points to try. A grid may leave it out.
    pub trials: usize,
    /// How many trials may be under way at a time. Part of what is decided: with more, decisions rest on fewer results.
    pub parallel: usize,
    /// ASHA's budgets.
    pub rungs: Rungs,
    /// What is searched, by path.
    pub space: BTreeMap<String, Domain>,
    /// The stage that evaluates a trial; its reference to the evaluated stage is filled in.
    pub evaluate: Box<StageSettings>,
}

/// More trials than this are a mistake.
pub const MAX_TRIALS: usize = crate::limits::TRIALS;

impl Sweep {
    /// Steps after which trials are compared; the last is `budget`, the steps of the stage.
    pub fn rungs(&self, budget: u64) -> Vec<u64> {
        let mut rungs = Vec::new();
        if self.search == SearchKind::Asha {
            let mut steps = self.rungs.first.0.max(1);
            while steps < budget {
                rungs.push(steps);
                steps = steps.saturating_mul(self.rungs.factor.max(2));
            }
        }
        rungs.push(budget);
        rungs
    }

    /// Points of the grid, if every domain is a choice.
    pub fn points(&self) -> Option<usize> {
        self.space.values().try_fold(1_usize, |product, domain| match domain {
            Domain::Choice(values) => Some(product.saturating_mul(values.len())),
            Domain::Uniform(..) | Domain::LogUniform(..) => None,
        })
    }

    /// The setting at `path` of a stage with settings `base`, or of the stage that evaluates, if there is one.
    pub fn setting(&self, base: &StageSettings, path: &str) -> Option<Value> {
        match in_evaluation(path) {
            Some(path) => setting(&self.evaluate, path),
            None => setting(base, path),
        }
    }

    /// `base` and the stage that evaluates, each with those of `values` in place that are its own.
    ///
    /// # Errors
    /// What does not fit, each with the rule that it breaks.
    pub fn with_values(&self, base: &StageSettings, values: &Values) -> Result<(StageSettings, StageSettings), String> {
        let (mut own, mut of_evaluation) = (Values::new(), Values::new());
        for (path, value) in values {
            match in_evaluation(path) {
                Some(path) => of_evaluation.insert(path.to_owned(), value.clone()),
                None => own.insert(path.clone(), value.clone()),
            };
        }
        let evaluate = match of_evaluation.is_empty() {
            true => (*self.evaluate).clone(),
            false => with_values(&self.evaluate, &of_evaluation)?,
        };
        Ok((with_values(base, &own)?, evaluate))
    }

    /// How many trials there will be, before equal ones are left out.
    pub fn trials(&self) -> usize {
        let points = self.points().unwrap_or(usize::MAX);
        match self.search {
            SearchKind::Grid => points,
            SearchKind::Random | SearchKind::Asha => self.trials.min(points),
        }
        .min(MAX_TRIALS)
    }
}

/// The setting at `path`, if there is one.
pub fn setting(settings: &StageSettings, path: &str) -> Option<Value> {
    let json = serde_json::to_value(settings).ok()?;
    path.split('.').try_fold(&json, |value, key| value.get(key)).cloned()
}

/// `base` with `values` in place.
///
/// # Errors
/// What does not fit, each with the rule that it breaks.
pub fn with_values(base: &StageSettings, values: &Values) -> Result<StageSettings, String> {
    let mut json = serde_json::to_value(base).map_err(|e| e.to_string())?;
    for (path, value) in values {
        let place = path.split('.').try_fold(&mut json, |value, key| value.get_mut(key));
        *place.ok_or_else(|| format!("there is no setting `{path}`"))? = value.clone();
    }
    let settings: StageSettings = serde_json::from_value(json).map_err(|e| e.to_string())?;
    let broken = pipeline::broken_rules(&settings, &Placement::default());
    if broken.is_empty() { Ok(settings) } else { Err(broken.join("; ")) }
}

/// The field through which `evaluate` looks at a stage that gives a `kind`: one that it reads, or one that it would if a stage were named there.
pub fn evaluated_field(evaluate: &StageSettings, kind: ArtifactKind) -> Option<String> {
    let mut settings = evaluate.clone();
    let refs: Vec<Ref<'_>> = settings.refs().into_iter().filter(|of| of.target == Target::Stage(kind)).collect();
    let found = refs.iter().find(|of| of.read).or_else(|| refs.iter().find(|of| of.name.is_empty()));
    found.map(|of| of.field.clone().into_owned())
}

/// What makes a stage one that a sweep derived.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Derived {
    /// The swept stage.
    pub of: StageName,
    /// Which trial.
    pub trial: usize,
    /// Which of its rungs.
    pub rung: usize,
    /// What keys its randomness instead of its own name: the same for all trials, so that they differ in their settings alone, and
    /// so that a trial's result is bit for bit that of the plain stage with the trial's values.
    pub keyed_as: StageName,
}

/// The output of a rung that is gone on from.
pub const STATE_OUTPUT: &str = "state";

/// Name of the training part of a rung; the evaluation's has `.eval` behind it. User's names have no dots.
pub fn rung_name(stage: &StageName, trial: usize, rung: usize) -> StageName {
    StageName::new(format!("{stage}.t{trial:02}.r{rung}"))
}

/// Where the stages of a trial run: one worker each, so that trials run side by side.
pub(crate) fn beside(placement: &Placement) -> Placement {
    Placement { workers: WorkerRange { min: 1, max: 1 }, ..placement.clone() }
}
