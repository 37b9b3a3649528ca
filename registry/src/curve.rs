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
    all: BTreeMap<String, Vec<Point>>,
    /// The series being read: key, task, attempt.
    reading: Option<(String, String, i64)>,
    /// The first step of the newer attempts, and of the one being read.
    superseded_from: u64,
    first: u64,
}

impl Curves {
    /// Adds a value. They come by key, by task, by attempt with the newest first, and by step.
    pub(crate) fn push(&mut self, key: &str, task: &str, attempt: i64, step: u64, value: Option<f64>) {
        match &self.reading {
            Some((k, t, a)) if (k.as_str(), t.as_str(), *a) == (key, task, attempt) => {}
            Some((k, t, _)) if (k.as_str(), t.as_str()) == (key, task) => {
                self.superseded_from = self.superseded_from.min(self.first);
                self.first = step;
                self.reading = Some((key.to_owned(), task.to_owned(), attempt));
            }
            _ => {
                (self.superseded_from, self.first) = (u64::MAX, step);
                self.reading = Some((key.to_owned(), task.to_owned(), attempt));
            }
        }
        if step < self.superseded_from {
            let point = Point { step, value: value.unwrap_or(f64::NAN) };
            match self.all.get_mut(key) {
                Some(points) => points.push(point),
                None => drop(self.all.insert(key.to_owned(), vec![point])),
            }
        }
    }

    /// The curves by key, of at most about `points` each; 0 for all.
    pub(crate) fn finish(self, points: usize) -> BTreeMap<String, Curve> {
        let curve = |mut all: Vec<Point>| {
            all.sort_by_key(|point| point.step);
            Curve { total: all.len() as u64, points: downsample(all, points) }
        };
        self.all.into_iter().map(|(key, all)| (key, curve(all))).collect()
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
