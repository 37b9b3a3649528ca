//! How trials stand: what each got at each rung.

use protocol::stage::Mode;
use serde::{Deserialize, Serialize};

/// How a rung of a trial ended.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Score {
    /// The metric, finite.
    Value(f64),
    /// It failed, or the metric is no finite number.
    Failed,
}

impl Score {
    /// The metric, or [`Score::Failed`] if it is not finite.
    pub fn of(value: f64) -> Self {
        if value.is_finite() { Self::Value(value) } else { Self::Failed }
    }

    /// The metric, turned so that less is better; the worst for a failure.
    pub(super) fn loss(self, mode: Mode) -> f64 {
        match (self, mode) {
            (Self::Value(value), Mode::Min) => value,
            (Self::Value(value), Mode::Max) => -value,
            (Self::Failed, _) => f64::INFINITY,
        }
    }
}

/// What counts of all trials so far.
#[derive(Debug, Clone, Copy)]
pub(super) struct Standing<'a> {
    pub(super) mode: Mode,
    /// One of this many goes on.
    pub(super) factor: usize,
    pub(super) rungs: usize,
    /// Results, by trial and rung.
    pub(super) known: &'a [Vec<Score>],
    /// Rungs issued, by trial.
    pub(super) issued: &'a [usize],
}

impl Standing<'_> {
    /// Trials with a result at `rung`, best first; failures at the end.
    pub(super) fn ranking(self, rung: usize) -> Vec<usize> {
        let mut trials: Vec<(f64, usize)> = self
            .known
            .iter()
            .enumerate()
            .filter_map(|(trial, scores)| Some((scores.get(rung)?.loss(self.mode), trial)))
            .collect();
        trials.sort_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
        trials.into_iter().map(|(_, trial)| trial).collect()
    }
}
