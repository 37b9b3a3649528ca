//! Results of trials by rung, and their ranking.

use protocol::stage::Mode;
use serde::{Deserialize, Serialize};

/// The result of a trial at a rung.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Score {
    /// A finite metric.
    Value(f64),
    /// The trial failed, or its metric is not finite.
    Failed,
}

impl Score {
    /// The metric, or [`Score::Failed`] if it is not finite.
    pub fn of(value: f64) -> Self {
        if value.is_finite() { Self::Value(value) } else { Self::Failed }
    }

    /// The metric with the sign for minimisation; infinity for a failure.
    pub(super) fn loss(self, mode: Mode) -> f64 {
        match (self, mode) {
            (Self::Value(value), Mode::Min) => value,
            (Self::Value(value), Mode::Max) => -value,
            (Self::Failed, _) => f64::INFINITY,
        }
    }
}

/// All folded results.
#[derive(Debug, Clone, Copy)]
pub(super) struct Standing<'a> {
    pub(super) mode: Mode,
    /// One in this many trials advances.
    pub(super) factor: usize,
    pub(super) rungs: usize,
    /// Results by trial and rung.
    pub(super) known: &'a [Vec<Score>],
    /// Number of issued rungs, by trial.
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
