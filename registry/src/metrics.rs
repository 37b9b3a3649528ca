//! Values by step, read back: one value for each step, and few enough points to draw.
//!
//! Every attempt's values are kept. The current view of a key takes the newest attempt, and before the first step of that
//! one the attempt before it, and so on: a resumed attempt supersedes what its predecessor did after the resume point.
//! Sampling down keeps the smallest and the largest value of each bucket, so that no spike is lost.

use std::collections::BTreeMap;

use protocol::{RunId, StageName};
use serde::{Deserialize, Serialize};
use sqlx::Row;

use crate::{QueryError, ReadStore};

/// A value after a step. What was no number is NaN, and `null` in JSON.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Point {
    /// After which step.
    pub step: u64,
    /// The value.
    #[serde(deserialize_with = "null_is_nan")]
    pub value: f64,
}

fn null_is_nan<'de, D: serde::Deserializer<'de>>(deserializer: D) -> Result<f64, D::Error> {
    Option::<f64>::deserialize(deserializer).map(|value| value.unwrap_or(f64::NAN))
}

/// The values of one key of one stage.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct Curve {
    /// How many values there are before sampling down.
    pub total: u64,
    /// By step.
    pub points: Vec<Point>,
}

impl ReadStore {
    /// The current values of a stage by key; of all keys, or of `keys`; at most about `points` of each, 0 for all.
    pub async fn metrics(
        &self,
        run: &RunId,
        stage: &StageName,
        keys: Option<&[String]>,
        points: usize,
    ) -> Result<BTreeMap<String, Curve>, QueryError> {
        let mut conn = self.readers().acquire().await?;
        let find = sqlx::query(
            "SELECT s.key, s.task, s.attempt, m.step, m.value FROM series s JOIN metrics m ON m.series = s.id \
             WHERE s.run = ?1 AND s.stage = ?2 AND (?3 IS NULL OR s.key IN (SELECT value FROM json_each(?3))) \
             ORDER BY s.key, s.task, s.attempt DESC, m.step",
        );
        let keys = keys.map(|keys| crate::db::apply::json(&keys));
        let rows = find.bind(run.as_str()).bind(stage.as_str()).bind(keys).fetch_all(&mut *conn).await?;

        let mut curves: BTreeMap<String, Vec<Point>> = BTreeMap::new();
        // Of the series being read: its task and attempt, the first step of the newer attempts, and its own first step.
        let mut reading: Option<(&str, &str, i64)> = None;
        let (mut superseded_from, mut first) = (u64::MAX, u64::MAX);
        for row in &rows {
            let (key, task, attempt): (&str, &str, i64) = (row.try_get(0)?, row.try_get(1)?, row.try_get(2)?);
            let step = row.try_get::<i64, _>(3)?.unsigned_abs();
            match reading {
                Some(series) if series == (key, task, attempt) => {}
                Some((k, t, _)) if (k, t) == (key, task) => {
                    superseded_from = superseded_from.min(first);
                    first = step;
                }
                _ => {
                    superseded_from = u64::MAX;
                    first = step;
                }
            }
            reading = Some((key, task, attempt));
            if step < superseded_from {
                let value = row.try_get::<Option<f64>, _>(4)?.unwrap_or(f64::NAN);
                curves.entry(key.to_owned()).or_default().push(Point { step, value });
            }
        }
        let curve = |mut all: Vec<Point>| {
            all.sort_by_key(|point| point.step);
            Curve { total: all.len() as u64, points: downsample(all, points) }
        };
        Ok(curves.into_iter().map(|(key, all)| (key, curve(all))).collect())
    }
}

/// At most about `limit` points: the first, the last, and of each bucket in between the smallest and the largest value.
/// A value that is no number counts as larger than all others.
fn downsample(all: Vec<Point>, limit: usize) -> Vec<Point> {
    if limit == 0 || all.len() <= limit.max(4) {
        return all;
    }
    let buckets = (limit.max(4) - 2) / 2;
    let inner = &all[1..all.len() - 1];
    let mut kept = vec![all[0]];
    for bucket in 0..buckets {
        let part = &inner[bucket * inner.len() / buckets..(bucket + 1) * inner.len() / buckets];
        let by_value = |a: &&Point, b: &&Point| a.value.abs_nan().total_cmp(&b.value.abs_nan());
        let (Some(low), Some(high)) = (part.iter().min_by(by_value), part.iter().max_by(by_value)) else { continue };
        let (a, b) = if low.step <= high.step { (low, high) } else { (high, low) };
        kept.push(*a);
        if a.step != b.step {
            kept.push(*b);
        }
    }
    kept.push(all[all.len() - 1]);
    kept
}

trait AbsNan {
    /// The same number; a NaN without its sign, so that `total_cmp` puts every NaN last.
    fn abs_nan(self) -> Self;
}

impl AbsNan for f64 {
    fn abs_nan(self) -> Self {
        if self.is_nan() { self.abs() } else { self }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sampling_down_keeps_ends_and_spikes() {
        let mut all: Vec<_> = (0..10_000).map(|step| Point { step, value: 1.0 }).collect();
        all[4_321].value = 100.0;
        all[7_777].value = -100.0;
        let few = downsample(all.clone(), 100);
        assert!(few.len() <= 100, "{}", few.len());
        assert_eq!((few[0].step, few[few.len() - 1].step), (0, 9_999));
        assert!(few.contains(&all[4_321]) && few.contains(&all[7_777]));
        assert!(few.is_sorted_by_key(|p| p.step));
        assert_eq!(downsample(all.clone(), 0), all);
    }
}
