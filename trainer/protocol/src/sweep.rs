//! `sweep:` on a training stage: the searched settings, the search method, and the evaluation of a trial.
//!
//! A trial is the stage with some of its settings changed, trained in rungs. A rung is an ordinary stage that stops
//! before the end of its learning rate schedule, and the next rung continues from its state. Settings of the evaluating
//! stage can be searched too: trials that differ only in those have one training key, and so share one training. This
//! module is data and arithmetic on it; the coordinator selects the next trial (`coordinator::search`).

use std::collections::BTreeMap;

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use serde_json::Value;

use crate::stage::{Mode, Ref, StageSettings, Target};
use crate::{ArtifactKind, StageName, Steps};

/// Method of searching the space.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "lowercase")]
pub enum SearchKind {
    /// Every point of the grid, each for the whole budget.
    Grid,
    /// Points drawn at random, each for the whole budget.
    Random,
    /// Points drawn at random, each for the first rung. The best continue to the next rung as soon as they are known.
    Asha,
}

impl SearchKind {
    /// Name in YAML.
    pub fn name(self) -> &'static str {
        match self {
            Self::Grid => "grid",
            Self::Random => "random",
            Self::Asha => "asha",
        }
    }
}

/// Budgets at which ASHA compares trials: `first`, `first * factor`, ... below the stage's `steps`, and `steps` itself.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(default)]
pub struct Rungs {
    /// Number of steps of the first rung.
    pub first: Steps,
    /// Factor between rungs: one in this many trials continues, for this many times the steps.
    pub factor: u64,
}

impl Default for Rungs {
    fn default() -> Self {
        Self { first: Steps(0), factor: 3 }
    }
}

/// Values that a setting may have.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Domain {
    /// One of these values.
    Choice(Vec<Value>),
    /// Uniform between two numbers; a whole number if the setting is one.
    Uniform(f64, f64),
    /// Log-uniform between two numbers.
    LogUniform(f64, f64),
}

impl Domain {
    /// Number of listed values.
    pub fn choices(&self) -> usize {
        match self {
            Self::Choice(values) => values.len(),
            Self::Uniform(..) | Self::LogUniform(..) => 0,
        }
    }
}

/// First part of the path of a searched setting of [`Sweep::evaluate`], before a `.`.
pub const EVALUATE: &str = "evaluate";

/// Path within the evaluating stage, if `path` is of that stage.
pub fn in_evaluation(path: &str) -> Option<&str> {
    path.strip_prefix(EVALUATE)?.strip_prefix('.')
}

/// Values of the searched settings by their path, such as `adversarial`, `network.width` or `evaluate.sampler.guidance`.
pub type Values = BTreeMap<String, Value>;

/// A search over the settings of a training stage.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Sweep {
    /// Method of searching the space.
    pub search: SearchKind,
    /// Metric of `evaluate` that ranks the trials.
    pub metric: String,
    /// Direction of the metric.
    pub mode: Mode,
    /// Number of points to try. A grid may leave it out.
    pub trials: usize,
    /// Largest number of concurrent trials. It affects the result: with more, decisions are based on fewer results.
    pub parallel: usize,
    /// Budgets of ASHA.
    pub rungs: Rungs,
    /// Domains of the searched settings, by path.
    pub space: BTreeMap<String, Domain>,
    /// Stage that evaluates a trial, with its reference to the evaluated stage filled in.
    pub evaluate: Box<StageSettings>,
}

/// Largest accepted number of trials.
pub const MAX_TRIALS: usize = crate::limits::TRIALS;

impl Sweep {
    /// Steps at which trials are compared; the last is `budget`, the steps of the stage.
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

    /// Number of points of the grid, if every domain is a choice.
    pub fn points(&self) -> Option<usize> {
        self.space.values().try_fold(1_usize, |product, domain| match domain {
            Domain::Choice(values) => Some(product.saturating_mul(values.len())),
            Domain::Uniform(..) | Domain::LogUniform(..) => None,
        })
    }

    /// Setting at `path` of a stage with settings `base`, or of the evaluating stage.
    pub fn setting(&self, base: &StageSettings, path: &str) -> Option<Value> {
        match in_evaluation(path) {
            Some(path) => setting(&self.evaluate, path),
            None => setting(base, path),
        }
    }

    /// Number of trials before equal ones are left out.
    pub fn trials(&self) -> usize {
        let points = self.points().unwrap_or(usize::MAX);
        match self.search {
            SearchKind::Grid => points,
            SearchKind::Random | SearchKind::Asha => self.trials.min(points),
        }
        .min(MAX_TRIALS)
    }
}

/// Setting at `path`, if it exists.
pub fn setting(settings: &StageSettings, path: &str) -> Option<Value> {
    let json = serde_json::to_value(settings).ok()?;
    path.split('.').try_fold(&json, |value, key| value.get(key)).cloned()
}

/// Field of `evaluate` that names the evaluated stage with output `kind`, whether it is set or still empty.
pub fn evaluated_field(evaluate: &StageSettings, kind: ArtifactKind) -> Option<String> {
    let mut settings = evaluate.clone();
    let refs: Vec<Ref<'_>> = settings.refs().into_iter().filter(|of| of.target == Target::Stage(kind)).collect();
    let found = refs.iter().find(|of| of.read).or_else(|| refs.iter().find(|of| of.name.is_empty()));
    found.map(|of| of.field.clone().into_owned())
}

/// Origin of a stage that a sweep made.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Derived {
    /// The swept stage.
    pub of: StageName,
    /// Number of the trial.
    pub trial: usize,
    /// Number of its rung.
    pub rung: usize,
    /// Name that keys its randomness instead of its own. It is the same for all trials, so that they differ only in
    /// their settings. A trial's result is bit for bit that of the plain stage with the trial's values.
    pub keyed_as: StageName,
}

/// Name of the output that the next rung continues from.
pub const STATE_OUTPUT: &str = "state";

/// Name of the training part of a rung; the evaluation's has the suffix `.eval`. Users' names have no dots.
pub fn rung_name(stage: &StageName, trial: usize, rung: usize) -> StageName {
    StageName::new(format!("{stage}.t{trial:02}.r{rung}"))
}
