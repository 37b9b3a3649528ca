//! Values by step, read back: each of them, or few enough buckets of them to draw.
//!
//! Every attempt's values are kept. A resumed attempt supersedes what its predecessors recorded after the step that it resumed from. If that
//! step is not known, the first step of the newer attempt takes its place.
//!
//! Every value counts in its bucket; none is left out by chance. A value that is not finite is counted and hides no other.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// A value after a step. A missing number is NaN, and `null` in JSON.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct Point {
    pub step: u64,
    #[serde(deserialize_with = "null_is_nan")]
    #[schemars(with = "Option<f64>")]
    pub value: f64,
}

fn null_is_nan<'de, D: serde::Deserializer<'de>>(deserializer: D) -> Result<f64, D::Error> {
    Option::<f64>::deserialize(deserializer).map(|value| value.unwrap_or(f64::NAN))
}

/// The values of one key of one stage.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct Curve {
    /// Ordered by step.
    pub points: Vec<Point>,
}

/// A part of a curve's points.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Page {
    /// The step after which they begin.
    pub after: Option<u64>,
    pub limit: usize,
}

impl Page {
    /// Every point of a curve.
    pub const ALL: Self = Self { after: None, limit: usize::MAX };
}

/// Axis that a curve is drawn over.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "lowercase")]
pub enum Axis {
    #[default]
    Step,
    /// Milliseconds since 1970, by the server's clock.
    Time,
    /// Hours since the stage's first values came.
    Hours,
}

/// Part of a curve to draw, and its resolution.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Window {
    pub axis: Axis,
    /// The first and the last place on the axis; `None` is the curve's own.
    pub from: Option<f64>,
    pub to: Option<f64>,
    /// The largest number of buckets of one curve.
    pub buckets: usize,
}

/// A curve in buckets of neighbouring values, column by column. A bucket holds all values after the bucket before, up to its place. A number
/// that there is not is NaN, and `null` in JSON.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct Buckets {
    /// The place of each bucket's last value on the axis.
    #[serde(deserialize_with = "nulls_are_nan")]
    #[schemars(with = "Vec<Option<f64>>")]
    pub x: Vec<f64>,
    /// The smallest, the largest and the mean of the finite values.
    #[serde(deserialize_with = "nulls_are_nan")]
    #[schemars(with = "Vec<Option<f64>>")]
    pub min: Vec<f64>,
    #[serde(deserialize_with = "nulls_are_nan")]
    #[schemars(with = "Vec<Option<f64>>")]
    pub max: Vec<f64>,
    #[serde(deserialize_with = "nulls_are_nan")]
    #[schemars(with = "Vec<Option<f64>>")]
    pub mean: Vec<f64>,
    /// The last value, if it is finite.
    #[serde(deserialize_with = "nulls_are_nan")]
    #[schemars(with = "Vec<Option<f64>>")]
    pub last: Vec<f64>,
    /// Number of values, and number of values that are not finite.
    pub count: Vec<u64>,
    pub nan: Vec<u64>,
}

fn nulls_are_nan<'de, D: serde::Deserializer<'de>>(deserializer: D) -> Result<Vec<f64>, D::Error> {
    let all = Vec::<Option<f64>>::deserialize(deserializer)?;
    Ok(all.into_iter().map(|value| value.unwrap_or(f64::NAN)).collect())
}
