//! Comparison of models by the field's metrics: intervals, differences beyond noise, and tables in the papers' column
//! order.
//!
//! A metric `fid` may come with `fid.lower` and `fid.upper`, the 95 % interval of its mean over repeats. Or it comes
//! with `fid_sd`, the standard deviation over repeats; the interval is then 1.96 sd (wider than the mean's). A stage's
//! name in front (`eval_4.fid`) separates metrics of several evaluations of one model; each such stage has its own row.
//!
//! Published rows are the papers' numbers, on the full test splits with the published evaluators. They show the target
//! of a result and are only comparable with numbers of that evaluator on that split.

mod print;
mod published;
mod row;

pub(crate) use print::in_words;

use std::collections::BTreeMap;

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use crate::versions::Version;

pub use print::Style;
pub use row::{Measure, Row};

/// Direction in which a metric is better.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "kebab-case")]
pub enum Better {
    /// A smaller value is better, such as a distance.
    Lower,
    /// A larger value is better, such as a hit rate.
    Higher,
    /// A value closer to that of real motion is better.
    NearReal,
    /// The metric is a property without a better direction.
    Neither,
}

/// A metric with a column in tables.
#[derive(Debug)]
struct Column {
    key: &'static str,
    /// Heading of the column.
    head: &'static str,
    better: Better,
}

const fn column(key: &'static str, head: &'static str, better: Better) -> Column {
    Column { key, head, better }
}

/// Columns in the order of text-to-motion papers, then reconstruction and control, then metrics without an evaluator.
const COLUMNS: [Column; 28] = [
    column("aits", "AITS (s)", Better::Lower),
    column("r_precision_top1", "R@1", Better::Higher),
    column("r_precision_top2", "R@2", Better::Higher),
    column("r_precision_top3", "R@3", Better::Higher),
    column("fid", "FID", Better::Lower),
    column("mm_dist", "MM-Dist", Better::Lower),
    column("diversity", "Diversity", Better::NearReal),
    column("multimodality", "MModality", Better::Neither),
    column("mpjpe_mm", "MPJPE mm", Better::Lower),
    column("pa_mpjpe_mm", "PA-MPJPE mm", Better::Lower),
    column("acceleration_mm", "ACCEL mm", Better::Lower),
    column("feature_error", "Feat. err.", Better::Lower),
    column("sjpe", "sJPE", Better::Lower),
    column("sjpe_noise", "sJPE noise", Better::Lower),
    column("sjpe_static", "sJPE static", Better::Lower),
    column("skating_ratio", "Skating", Better::Lower),
    column("trajectory_error", "Traj. err.", Better::Lower),
    column("location_error", "Loc. err.", Better::Lower),
    column("average_error_m", "Avg. err. (m)", Better::Lower),
    column("latent_fid", "Latent FID", Better::Lower),
    column("latent_fid_floor", "of real", Better::Neither),
    column("latent_fid_test", "Latent FID, test", Better::Lower),
    column("latent_fid_test_floor", "of real, test", Better::Neither),
    column("latent_r_precision_top1", "Latent R@1", Better::Higher),
    column("latent_r_precision_top3", "Latent R@3", Better::Higher),
    column("match", "Match", Better::Lower),
    column("latent_std", "Latent std", Better::Neither),
    column("latent_r_precision_top3_test", "Latent R@3, test", Better::Higher),
];

/// Data formats; the papers' datasets have the same names.
pub const FORMATS: [&str; 2] = ["humanml3d", "kit"];

/// Number of columns of the papers' text-to-motion table, which come first.
const PAPER_COLUMNS: usize = 8;

fn better(key: &str) -> Better {
    COLUMNS.iter().find(|column| column.key == key).map_or(Better::Neither, |column| column.better)
}

/// A table of rows.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct Leaderboard {
    /// Title of the table.
    pub title: String,
    /// Rows of models: ours by the deciding metric, best first, then published ones in their papers' order.
    pub rows: Vec<Row>,
}

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

/// Combines `fid`, `fid.lower`, `fid.upper` and `fid_sd` into one measure.
fn measures(metrics: &BTreeMap<String, f64>) -> BTreeMap<String, Measure> {
    let is_part = |key: &str| {
        let of = |end: &str| key.strip_suffix(end).is_some_and(|base| metrics.contains_key(base));
        of(".lower") || of(".upper") || of("_sd")
    };
    let half = |key: &str| {
        let part = |end: &str| metrics.get(&format!("{key}{end}")).copied();
        match (part(".lower"), part(".upper"), part("_sd")) {
            (Some(lower), Some(upper), _) => Some((upper - lower) / 2.0),
            (_, _, Some(sd)) => Some(1.96 * sd),
            _ => None,
        }
    };
    let whole = metrics.iter().filter(|(key, _)| !is_part(key));
    whole.map(|(key, &value)| (key.clone(), Measure { value, half: half(key) })).collect()
}

/// Groups a version's metrics by evaluation. Metrics with a stage's name belong to that stage; those without one belong
/// to every stage, or to the only evaluation if no metric has a name.
pub(crate) fn measured(version: &Version) -> Vec<(Option<String>, BTreeMap<String, Measure>)> {
    let mut by_stage: BTreeMap<String, BTreeMap<String, Measure>> = BTreeMap::new();
    let mut shared = BTreeMap::new();
    for (key, measure) in measures(&version.metrics) {
        match key.rsplit_once('.') {
            Some((stage, metric)) => drop(by_stage.entry(stage.into()).or_default().insert(metric.into(), measure)),
            None => drop(shared.insert(key, measure)),
        }
    }
    if by_stage.is_empty() {
        return vec![(None, shared)];
    }
    // The value without a stage's name repeats one with a name and is dropped.
    shared.retain(|key, _| !by_stage.values().any(|measures| measures.contains_key(key)));
    by_stage.values_mut().for_each(|measures| measures.extend(shared.clone()));
    by_stage.into_iter().map(|(stage, measures)| (Some(stage), measures)).collect()
}

fn rows(version: &Version) -> Vec<Row> {
    let source = format!("{}:{}", version.model, version.version);
    let row = |(stage, measures): (Option<String>, _)| {
        let label = stage.map_or_else(|| source.clone(), |stage| format!("{source} ({stage})"));
        Row { label, source: source.clone(), published: false, measures }
    };
    measured(version).into_iter().map(row).collect()
}

/// Returns metrics in the order of the tables; other metrics come last, by name.
pub(crate) fn in_order(metrics: &BTreeMap<String, Measure>) -> Vec<(&String, Measure)> {
    let place = |key: &str| COLUMNS.iter().position(|column| column.key == key).unwrap_or(COLUMNS.len());
    let mut all: Vec<_> = metrics.iter().map(|(key, measure)| (key, *measure)).collect();
    all.sort_by_key(|(key, _)| place(key));
    all
}

/// Returns the value of `deciding` and of the first few other metrics with a column.
pub(crate) fn in_brief(version: &Version, deciding: Option<&str>) -> Vec<(String, Measure)> {
    const FEW: usize = 4;
    let plain = version.metrics.iter().filter(|(key, _)| !measures_of_a_stage(&version.metrics, key));
    let all = measures(&plain.map(|(key, value)| (key.clone(), *value)).collect());
    let first = deciding.and_then(|key| Some((key.to_owned(), *all.get(key)?)));
    let known = |key: &str| COLUMNS.iter().any(|column| column.key == key);
    let others = in_order(&all).into_iter().filter(|(key, _)| known(key) && Some(key.as_str()) != deciding);
    let others = others.map(|(key, measure)| (key.clone(), measure));
    first.into_iter().chain(others).take(FEW).collect()
}

/// Returns true if `key` is `STAGE.METRIC` and not the end of an interval.
fn measures_of_a_stage(metrics: &BTreeMap<String, f64>, key: &str) -> bool {
    let base = key.strip_suffix(".lower").or_else(|| key.strip_suffix(".upper")).filter(|b| metrics.contains_key(*b));
    base.unwrap_or(key).contains('.')
}

/// Builds the rows of `versions`, the best by `metric` first, and adds published rows of the data format `published`,
/// if given.
pub fn leaderboard(title: String, versions: &[Version], metric: Option<&str>, published: Option<&str>) -> Leaderboard {
    let mut ours: Vec<Row> = versions.iter().flat_map(rows).collect();
    let deciding = metric.or_else(|| {
        COLUMNS
            .iter()
            .find(|c| c.better != Better::Neither && ours.iter().any(|row| row.measures.contains_key(c.key)))
            .map(|c| c.key)
    });
    if let Some(metric) = deciding {
        let sign = if better(metric) == Better::Higher { -1.0 } else { 1.0 };
        let rank = |row: &Row| {
            row.measures
                .get(metric)
                .map_or(f64::INFINITY, |m| if m.value.is_nan() { f64::INFINITY } else { sign * m.value })
        };
        ours.sort_by(|a, b| rank(a).total_cmp(&rank(b)));
    }
    ours.extend(published.into_iter().flat_map(published::rows));
    Leaderboard { title, rows: ours }
}

/// Builds a table of named evaluations in the given order; `None` if no metric has a column.
pub fn evaluations(title: &str, all: impl IntoIterator<Item = (String, BTreeMap<String, f64>)>) -> Option<Leaderboard> {
    let row = |(label, metrics): (String, BTreeMap<String, f64>)| Row {
        source: label.clone(),
        label,
        published: false,
        measures: measures(&metrics),
    };
    let mut rows: Vec<Row> = all.into_iter().map(row).collect();
    rows.retain(|row| COLUMNS.iter().any(|column| row.measures.contains_key(column.key)));
    (!rows.is_empty()).then(|| Leaderboard { title: title.to_owned(), rows })
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

#[cfg(test)]
#[allow(clippy::unwrap_used, reason = "a test may panic")]
mod tests {
    use super::*;
    use serde_json::json;

    fn version(number: u64, metrics: &[(&str, f64)]) -> Version {
        Version {
            model: "m".into(),
            version: number,
            artifact: protocol::Digest::of(b"x"),
            metrics: metrics.iter().map(|(k, v)| ((*k).to_owned(), *v)).collect(),
            source: json!({}),
            created_ms: 0,
            aliases: Vec::new(),
        }
    }

    #[test]
    fn intervals_are_read_and_differences_beyond_noise_are_told() {
        let a = version(
            1,
            &[
                ("fid", 0.5),
                ("fid.lower", 0.45),
                ("fid.upper", 0.55),
                ("latent_fid", 0.1),
                ("latent_fid_sd", 0.01),
                ("x", 1.0),
            ],
        );
        let b = version(
            2,
            &[("fid", 0.3), ("fid.lower", 0.28), ("fid.upper", 0.32), ("latent_fid", 0.11), ("latent_fid_sd", 0.01)],
        );
        let found = compare(&a, &b);
        let of = |name: &str| found.metrics.iter().find(|d| d.metric == name).unwrap();
        assert_eq!(of("fid").verdict, Some(Verdict::Right));
        assert!((of("fid").difference.unwrap().half.unwrap() - 0.05_f64.hypot(0.02)).abs() < 1e-12);
        assert_eq!(of("latent_fid").verdict, Some(Verdict::Noise));
        assert_eq!(of("x").verdict, None);
        assert_eq!(found.metrics.len(), 3, "bounds are no metrics of their own");
        assert_eq!(compare(&b, &a).metrics[0].verdict, Some(Verdict::Left));
    }

    #[test]
    fn an_evaluation_is_a_row_and_the_best_comes_first() {
        let two = version(
            2,
            &[
                ("one.fid", 0.3),
                ("four.fid", 0.2),
                ("four.fid.lower", 0.1),
                ("four.fid.upper", 0.3),
                ("fid", 0.2),
                ("aits", 0.03),
            ],
        );
        let leaderboard = leaderboard("m".into(), &[version(1, &[("fid", 0.25)]), two], Some("fid"), Some("kit"));
        let labels: Vec<_> = leaderboard.rows.iter().filter(|r| !r.published).map(|r| r.label.as_str()).collect();
        assert_eq!(labels, ["m:2 (four)", "m:1", "m:2 (one)"]);
        assert!((leaderboard.rows[0].measures["fid"].half.unwrap() - 0.1).abs() < 1e-12);
        assert_eq!(leaderboard.rows[0].measures["aits"].value, 0.03);
        assert!(
            leaderboard.rows.iter().any(|row| row.label == "MotionPCM, 1 step" && row.measures["fid"].value == 0.355)
        );
    }
}
