//! Settings that cannot change a stage's value: number and labels of workers, cadence of checkpoints.

use std::collections::BTreeMap;

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use super::{Mode, Problems};
use crate::{Labels, Steps};

/// Settings that cannot change a stage's value: number and labels of workers, cadence of checkpoints.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema, Default)]
#[serde(default)]
pub struct Placement {
    /// Number of workers of a gang.
    pub workers: WorkerRange,
    /// Labels that each of its workers must have, such as `gpu=h100`.
    #[serde(skip_serializing_if = "Labels::is_empty")]
    pub requires: Labels,
    /// Checkpoint cadence and retention.
    pub checkpoint: CheckpointPolicy,
}

impl Placement {
    /// The default as JSON with every key, which a pipeline's reader and reference go by. As stored, a placement has no
    /// empty `requires`, so that digests of pipelines stay.
    pub fn example() -> serde_json::Value {
        let mut example = serde_json::to_value(Self::default()).unwrap_or_default();
        example["requires"] = serde_json::json!([]);
        example
    }

    pub fn check(&self, p: &mut Problems) {
        let w = self.workers;
        if w.max != 0 && w.max < w.min {
            let message = format!("`workers.max` is {}, which is less than `workers.min` ({})", w.max, w.min);
            p.add("workers.max", message, "0 sets no upper bound");
        }
        if let Err(error) = self.requires.check() {
            p.add("requires", format!("`requires`: {error}"), "");
        }
        let keep = &self.checkpoint.keep;
        if keep.metric.trim().is_empty() {
            p.add(
                "checkpoint.keep.metric",
                "`checkpoint.keep.metric` is empty; expected a value that the stage records",
                "",
            );
        } else if keep.best == 0 && keep.metric != Keep::default().metric {
            let message = format!("`checkpoint.keep.metric` is `{}`, but `checkpoint.keep.best` is 0", keep.metric);
            p.add("checkpoint.keep.metric", message, "set `checkpoint.keep.best` to the number of checkpoints to keep");
        }
    }
}

/// Number of workers of a gang.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(default)]
pub struct WorkerRange {
    /// Smallest number; with fewer the stage yields and waits.
    #[schemars(range(min = 1, max = 10_000), extend("x-unit" = "workers"))]
    pub min: usize,
    /// Largest number; 0 means no limit.
    #[schemars(range(min = 0, max = 10_000), extend("x-unit" = "workers"))]
    pub max: usize,
}

impl Default for WorkerRange {
    fn default() -> Self {
        Self { min: 1, max: 0 }
    }
}

/// Cadence and retention of checkpoints.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(default)]
pub struct CheckpointPolicy {
    /// Number of steps between checkpoints; 0 saves only when the stage yields.
    #[schemars(range(min = 0, max = 1_000_000_000))]
    pub every: Steps,
    /// Checkpoints to keep.
    pub keep: Keep,
}

impl Default for CheckpointPolicy {
    fn default() -> Self {
        Self { every: Steps(2000), keep: Keep::default() }
    }
}

/// Checkpoints of a task to keep: the union of the newest and the best.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(default)]
pub struct Keep {
    /// Number of newest checkpoints to keep.
    #[schemars(range(min = 1, max = 10_000), extend("x-unit" = "checkpoints"))]
    pub latest: usize,
    /// Number of newest checkpoints to keep once the stage has ended and its value is stored. `trainer run --verify`
    /// begins at them; 2 lets it check the last interval.
    #[schemars(range(min = 0, max = 10_000), extend("x-unit" = "checkpoints"))]
    pub ended: usize,
    /// Number of best checkpoints by `metric` to keep.
    #[schemars(range(min = 0, max = 10_000), extend("x-unit" = "checkpoints"))]
    pub best: usize,
    /// A value that the stage saves with its checkpoints; each is a mean of recorded values over the last hundred
    /// steps.
    pub metric: String,
    /// Direction of the metric.
    pub mode: Mode,
}

impl Default for Keep {
    fn default() -> Self {
        Self { latest: 2, ended: 0, best: 0, metric: "loss".into(), mode: Mode::Min }
    }
}

impl Keep {
    /// Checkpoints of a task to keep, given their metrics, oldest first. The newest is always kept, and of equal ones
    /// the newer. A value that is not finite is never best. All are kept if none has the metric, because the best is
    /// unknown.
    pub fn kept(&self, oldest_first: &[&BTreeMap<String, f64>]) -> Vec<bool> {
        self.newest_and_best(oldest_first, self.latest.max(1))
    }

    /// Checkpoints to keep once the stage's value is stored: as [`Self::kept`], with `ended` newest ones, which may be none.
    pub fn kept_at_end(&self, oldest_first: &[&BTreeMap<String, f64>]) -> Vec<bool> {
        self.newest_and_best(oldest_first, self.ended)
    }

    fn newest_and_best(&self, oldest_first: &[&BTreeMap<String, f64>], newest: usize) -> Vec<bool> {
        let count = oldest_first.len();
        if self.best > 0 && count > 0 && oldest_first.iter().all(|metrics| !metrics.contains_key(&self.metric)) {
            return vec![true; count];
        }
        let sign = if self.mode == Mode::Max { -1.0 } else { 1.0 };
        let value =
            |metrics: &BTreeMap<String, f64>| metrics.get(&self.metric).filter(|v| v.is_finite()).map(|v| sign * v);
        let mut ranked: Vec<(f64, usize)> =
            oldest_first.iter().enumerate().filter_map(|(i, metrics)| Some((value(metrics)?, i))).collect();
        ranked.sort_by(|a, b| a.0.total_cmp(&b.0).then(b.1.cmp(&a.1)));
        let mut kept: Vec<bool> = (0..count).map(|i| i + newest >= count).collect();
        ranked.iter().take(self.best).for_each(|(_, i)| kept[*i] = true);
        kept
    }

    /// Refuses a metric that is not among `saved`, if the best are to be kept.
    ///
    /// # Errors
    /// An unknown metric; the message lists the saved ones.
    pub fn check<'a>(&self, saved: impl IntoIterator<Item = &'a str>) -> Result<(), String> {
        let saved: Vec<&str> = saved.into_iter().collect();
        if self.best == 0 || saved.contains(&self.metric.as_str()) {
            return Ok(());
        }
        Err(format!(
            "`checkpoint.keep.metric` is `{}`, which checkpoints do not record; they record {}",
            self.metric,
            if saved.is_empty() { "nothing".to_owned() } else { saved.join(", ") }
        ))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A small generator, so that the cases are the same everywhere.
    fn dice(state: &mut u64) -> u64 {
        *state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        *state >> 33
    }

    #[test]
    fn the_newest_and_the_best_by_any_metric_stay() {
        let mut state = 7;
        for _ in 0..4000 {
            let count = dice(&mut state) as usize % 9;
            let rows: Vec<BTreeMap<String, f64>> = (0..count)
                .map(|_| {
                    // Few values, so that some are equal; some are not finite, some are missing.
                    let value = match dice(&mut state) % 8 {
                        0 => f64::NAN,
                        1 => f64::INFINITY,
                        2 => f64::NEG_INFINITY,
                        n => n as f64,
                    };
                    let mut row = BTreeMap::from([("loss".to_owned(), dice(&mut state) as f64)]);
                    if !dice(&mut state).is_multiple_of(5) {
                        row.insert("joint".to_owned(), value);
                    }
                    row
                })
                .collect();
            let mode = if dice(&mut state).is_multiple_of(2) { Mode::Min } else { Mode::Max };
            let latest = dice(&mut state) as usize % 4;
            let best = dice(&mut state) as usize % 4;
            let ended = dice(&mut state) as usize % 3;
            let keep = Keep { latest, ended, best, metric: "joint".into(), mode };
            let is_over = dice(&mut state).is_multiple_of(2);
            let rows_in_order = rows.iter().collect::<Vec<_>>();
            let kept = if is_over { keep.kept_at_end(&rows_in_order) } else { keep.kept(&rows_in_order) };
            assert_eq!(kept.len(), count);
            if best > 0 && rows.iter().all(|row| !row.contains_key("joint")) {
                assert!(kept.iter().all(|kept| *kept), "nothing is lost by a metric that is not there");
                continue;
            }
            let newest = count.saturating_sub(if is_over { ended } else { latest.max(1) });
            assert!(kept[newest..].iter().all(|kept| *kept), "{keep:?} {rows:?} {kept:?}");
            // A slow reference: a checkpoint is among the best if fewer than `best` are better, or equal and newer.
            let finite = |i: usize| rows[i].get("joint").copied().filter(|v| v.is_finite());
            let beats = |i: usize, j: usize| match (finite(i), finite(j)) {
                (Some(a), Some(b)) if a == b => i > j,
                (Some(a), Some(b)) => (a < b) == (mode == Mode::Min),
                (a, _) => a.is_some(),
            };
            for i in 0..count {
                let among = finite(i).is_some() && (0..count).filter(|j| beats(*j, i)).count() < best;
                assert_eq!(kept[i], i >= newest || among, "{i} of {keep:?} {rows:?} {kept:?}");
            }
        }
    }

    #[test]
    fn a_policy_that_was_written_before_it_had_a_metric_reads() {
        let old: Keep = serde_json::from_str(r#"{"latest": 3, "best": 1}"#).expect("reads");
        assert_eq!(old, Keep { latest: 3, best: 1, ..Keep::default() });
    }

    #[test]
    fn a_metric_that_is_not_saved_is_refused_with_those_that_are() {
        let keep = Keep { best: 1, metric: "fid".into(), ..Keep::default() };
        let refused = keep.check(["loss", "joint"]).expect_err("no `fid`");
        assert!(refused.contains("`fid`") && refused.contains("loss, joint"), "{refused}");
        assert_eq!(keep.check(["fid"]), Ok(()));
        assert_eq!(Keep { best: 0, ..keep }.check(["loss"]), Ok(()), "nothing is ranked");
    }
}
