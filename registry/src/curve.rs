//! Values by step, read back: one value for each step, and few enough points to draw.
//!
//! Every attempt's values are kept. The current view of a key takes the newest attempt, and before the first step of that
//! one the attempt before it, and so on: a resumed attempt supersedes what its predecessor did after the resume point.
//! Sampling down keeps the smallest and the largest value of each bucket, so that no spike is lost.

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};

/// A value after a step. What was no number is NaN, and `null` in JSON.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Point {
    /// After which step.
    pub step: u64,
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

/// Makes curves of stored values.
#[derive(Debug, Default)]
pub(crate) struct Curves {
    all: BTreeMap<String, Values>,
    /// The series being read: key, task, attempt.
    reading: Option<(String, String, i64)>,
    /// The first step of the newer attempts, and of the one being read.
    superseded_from: u64,
    first: u64,
}

#[derive(Debug, Default)]
struct Values {
    points: Vec<Point>,
    /// Values that count and are not among the points.
    left_out: u64,
}

impl Curves {
    /// Begins a series; they come by key, by task, by attempt with the newest first. Returns the step before which its values count.
    pub(crate) fn begin(&mut self, key: &str, task: &str, attempt: i64) -> u64 {
        let goes_on = self.reading.as_ref().is_some_and(|(k, t, _)| (k.as_str(), t.as_str()) == (key, task));
        self.superseded_from = if goes_on { self.superseded_from.min(self.first) } else { u64::MAX };
        self.first = u64::MAX;
        self.reading = Some((key.to_owned(), task.to_owned(), attempt));
        self.superseded_from
    }

    /// Says which step is the first of the series, whether its value counts or not.
    pub(crate) fn begins_at(&mut self, step: u64) {
        self.first = step;
    }

    /// Adds a value of the series that counts.
    pub(crate) fn push(&mut self, step: u64, value: Option<f64>) {
        let point = Point { step, value: value.unwrap_or(f64::NAN) };
        if let Some(values) = self.values() {
            values.points.push(point);
        }
    }

    /// Adds so many values of the series that lie between those that were pushed, and no further out.
    pub(crate) fn left_out(&mut self, count: u64) {
        if let Some(values) = self.values() {
            values.left_out += count;
        }
    }

    fn values(&mut self) -> Option<&mut Values> {
        let (key, ..) = self.reading.as_ref()?;
        if !self.all.contains_key(key) {
            self.all.insert(key.clone(), Values::default());
        }
        self.all.get_mut(key)
    }

    /// The curves by key, of at most about `points` each; 0 for all.
    pub(crate) fn finish(self, points: usize) -> BTreeMap<String, Curve> {
        let curve = |mut values: Values| {
            values.points.sort_by_key(|point| point.step);
            let total = values.points.len() as u64 + values.left_out;
            Curve { total, points: downsample(values.points, points) }
        };
        self.all.into_iter().map(|(key, values)| (key, curve(values))).collect()
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
