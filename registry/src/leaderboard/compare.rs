//! Comparison of two versions, metric by metric.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use super::column::{Better, COLUMNS, better};
use super::measures::measures;
use super::row::Measure;
use crate::versions::Version;

/// Result of comparing two values.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "kebab-case")]
pub enum Verdict {
    /// The left value is better, beyond noise.
    Left,
    /// The right value is better, beyond noise.
    Right,
    /// The values differ beyond noise, but neither is better.
    Differ,
    /// The values do not differ beyond noise.
    Noise,
    /// The values differ, but their noise was not measured.
    Unknown,
}

/// One metric of two models.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct Difference {
    pub metric: String,
    /// Value of the left model.
    pub left: Option<Measure>,
    /// Value of the right model.
    pub right: Option<Measure>,
    /// Right minus left, with the interval of the difference.
    pub difference: Option<Measure>,
    /// Result of the comparison.
    pub verdict: Option<Verdict>,
}

/// A comparison of two models, metric by metric.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct Comparison {
    /// Left version, as `MODEL:VERSION`.
    pub left: String,
    /// Right version, as `MODEL:VERSION`.
    pub right: String,
    /// Every metric of either model.
    pub metrics: Vec<Difference>,
}

/// Compares two versions metric by metric, in the papers' order; other metrics come last.
pub fn compare(left: &Version, right: &Version) -> Comparison {
    let name = |version: &Version| format!("{}:{}", version.model, version.version);
    let a = measures(&left.metrics);
    let b = measures(&right.metrics);
    let base = |key: &str| key.rsplit('.').next().unwrap_or(key).to_owned();
    let place = |key: &str| COLUMNS.iter().position(|c| c.key == base(key)).unwrap_or(COLUMNS.len());
    let mut keys: Vec<&String> = a.keys().chain(b.keys().filter(|key| !a.contains_key(*key))).collect();
    keys.sort_by_key(|key| (place(key), (*key).clone()));
    let metrics = keys.into_iter().map(|key| {
        let left = a.get(key).copied();
        let right = b.get(key).copied();
        let both = left.zip(right).map(|(left, right)| difference(left, right, better(&base(key))));
        Difference { metric: key.clone(), left, right, difference: both.map(|b| b.0), verdict: both.map(|b| b.1) }
    });
    Comparison { left: name(left), right: name(right), metrics: metrics.collect() }
}

fn difference(left: Measure, right: Measure, better: Better) -> (Measure, Verdict) {
    let value = right.value - left.value;
    let half = left.half.zip(right.half).map(|(l, r)| l.hypot(r));
    let verdict = match half {
        _ if value == 0.0 => Verdict::Noise,
        None => Verdict::Unknown,
        Some(half) if value.abs() <= half => Verdict::Noise,
        Some(_) if value.is_nan() => Verdict::Unknown,
        Some(_) => match better {
            Better::Lower if value < 0.0 => Verdict::Right,
            Better::Lower => Verdict::Left,
            Better::Higher if value > 0.0 => Verdict::Right,
            Better::Higher => Verdict::Left,
            Better::NearReal | Better::Neither => Verdict::Differ,
        },
    };
    (Measure { value, half }, verdict)
}
