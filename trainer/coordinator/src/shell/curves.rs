//! Curves to draw: which are asked for, and how they look on the wire.
//!
//! `GET /v1/metrics?run=A&run=B&key=loss&stage=S&x=step|time|hours&from=&to=&buckets=800`, as JSON or, by
//! `Accept: application/octet-stream`, packed: the length of a head as `u32`, the head as JSON padded with blanks to a multiple of four
//! bytes, then for each series of the head its columns one after the other as `f32`. All numbers are little-endian; `x` counts from the
//! series' `x0`. The column `nan` is missing where all of it is zero. A finite value that `f32` cannot hold is its largest number.

use std::pin::pin;
use std::sync::Arc;

use access::Caller;
use axum::extract::State;
use axum::http::{HeaderMap, header};
use axum::response::{IntoResponse, Response};
use axum::{Extension, Json};
use futures::{StreamExt as _, TryStreamExt as _, stream};
use protocol::{RunId, StageName, limits};
use registry::{Axis, Buckets, Window};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use super::actor_handle::ActorHandle;
use super::blocking::blocking;
use super::extract::Query;
use super::failure::Failure;
use super::queries::{PACKED, accepts_packed};
use super::records::StageCurves;
use super::turn::turn;

/// Runs of one call whose curves are read at the same time.
const AT_ONCE: usize = 2;

/// The answer to `GET /v1/metrics`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct Curves {
    pub x: Axis,
    /// By run as asked for, by stage, by key.
    pub series: Vec<CurveSeries>,
}

/// One curve in buckets.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct CurveSeries {
    pub run: RunId,
    pub stage: StageName,
    pub key: String,
    /// Number of values in all buckets.
    pub total: u64,
    #[serde(flatten)]
    pub columns: Buckets,
}

impl CurveSeries {
    /// The curves of a run, by stage, by key.
    pub fn of(run: &RunId, stages: StageCurves) -> Vec<Self> {
        let mut series = Vec::new();
        for (stage, keys) in stages {
            for (key, columns) in keys {
                let total = columns.count.iter().sum();
                series.push(Self { run: run.clone(), stage: stage.clone(), key, total, columns });
            }
        }
        series
    }
}

/// The call's query as it is documented; `run` and `key` may be given several times.
#[derive(Debug, JsonSchema)]
#[expect(dead_code, reason = "only its schema is used")]
pub(crate) struct CurvesAsked {
    run: Vec<RunId>,
    /// All stages, if it is missing.
    stage: Option<StageName>,
    /// All names, if it is missing.
    #[schemars(default)]
    key: Vec<String>,
    /// `step`, `time` in milliseconds since 1970, or `hours` since the stage's first value.
    x: Option<Axis>,
    from: Option<f64>,
    to: Option<f64>,
    #[schemars(range(min = 1, max = 4000))]
    buckets: Option<usize>,
}

/// The call's query.
#[derive(Debug, PartialEq)]
struct CurveQuery {
    runs: Vec<RunId>,
    stage: Option<StageName>,
    /// All, if there are none.
    keys: Vec<String>,
    window: Window,
}

impl CurveQuery {
    fn read(pairs: Vec<(String, String)>) -> Result<Self, Failure> {
        let window = Window { axis: Axis::Step, from: None, to: None, buckets: 800 };
        let mut query = Self { runs: Vec::new(), stage: None, keys: Vec::new(), window };
        for (name, value) in pairs {
            match name.as_str() {
                "run" if query.runs.iter().any(|run| run.as_str() == value) => {}
                "run" => query.runs.push(RunId::new(value)),
                "stage" => query.stage = Some(StageName::new(value)),
                "key" => query.keys.push(value),
                "x" => {
                    query.window.axis = match value.as_str() {
                        "step" => Axis::Step,
                        "time" => Axis::Time,
                        "hours" => Axis::Hours,
                        _ => return Err(expected("x", &value, "`step`, `time` or `hours`")),
                    }
                }
                "from" => query.window.from = Some(number(&name, &value)?),
                "to" => query.window.to = Some(number(&name, &value)?),
                "buckets" => {
                    let buckets = value.parse().ok().filter(|buckets| (1..=limits::CURVE_BUCKETS).contains(buckets));
                    let most = limits::CURVE_BUCKETS;
                    query.window.buckets =
                        buckets.ok_or_else(|| expected("buckets", &value, &format!("a number from 1 to {most}")))?;
                }
                other => {
                    let known = "`run`, `stage`, `key`, `x`, `from`, `to` and `buckets`";
                    return Err(Failure::invalid(format!(
                        "unknown parameter `{other}` of curves; known parameters: {known}"
                    )));
                }
            }
        }
        match query.runs.len() {
            0 => Err(Failure::invalid("the query names no run".into()).hint("name a run: `?run=RUN&key=loss`")),
            more if more > limits::CURVE_RUNS => {
                Err(Failure::invalid(format!("the query has {more} runs; expected at most {}", limits::CURVE_RUNS)))
            }
            _ => Ok(query),
        }
    }
}

fn expected(name: &str, value: &str, expected: &str) -> Failure {
    Failure::invalid(format!("`{name}` is `{value}`; expected {expected}"))
}

fn number(name: &str, value: &str) -> Result<f64, Failure> {
    let number = value.parse().ok().filter(|number: &f64| number.is_finite());
    number.ok_or_else(|| expected(name, value, "a number"))
}

pub(crate) async fn curves(
    State(actor_handle): State<Arc<ActorHandle>>,
    Extension(caller): Extension<Arc<Caller>>,
    headers: HeaderMap,
    Query(pairs): Query<Vec<(String, String)>>,
) -> Result<Response, Failure> {
    let CurveQuery { runs, stage, keys, window } = CurveQuery::read(pairs)?;
    let _turn = turn(&actor_handle).await?;
    let records = actor_handle.records_for(caller.sees());
    let keys = (!keys.is_empty()).then_some(keys.as_slice());
    let mut curves = Curves { x: window.axis, series: Vec::new() };
    let records = &records;
    let stage = stage.as_ref();
    let window = &window;
    let read = |run| async move {
        let stages = records.buckets(&run, stage, keys, window).await?;
        Result::<_, Failure>::Ok(CurveSeries::of(&run, stages))
    };
    let mut found = pin!(stream::iter(runs).map(read).buffered(AT_ONCE));
    while let Some(series) = found.try_next().await? {
        curves.series.extend(series);
        let most = limits::CURVE_CELLS / window.buckets;
        if curves.series.len() > most {
            let message =
                format!("there are more than {most} curves, the largest number with {} buckets", window.buckets);
            return Err(Failure::invalid(message).hint("set `stage` or `key`, or use fewer `buckets`"));
        }
    }
    let vary = (header::VARY, "accept");
    // Beside the threads that answer heartbeats: there may be many numbers.
    if accepts_packed(&headers) {
        let packed = blocking(move || pack(&curves)).await;
        return Ok(([(header::CONTENT_TYPE, PACKED), vary], packed).into_response());
    }
    let text = blocking(move || Json(curves).into_response()).await;
    Ok(([vary], text).into_response())
}

/// A series in the head of a packed answer.
#[derive(Debug, Serialize)]
struct Head<'a> {
    run: &'a RunId,
    stage: &'a StageName,
    key: &'a str,
    total: u64,
    /// Number of buckets.
    rows: usize,
    x0: f64,
    columns: Vec<&'static str>,
}

/// The nearest finite number; NaN stays NaN.
fn single(value: f64) -> f32 {
    (value as f32).clamp(f32::MIN, f32::MAX)
}

fn pack(curves: &Curves) -> Vec<u8> {
    let mut heads = Vec::new();
    let mut numbers: Vec<u8> = Vec::new();
    for CurveSeries { run, stage, key, total, columns } in &curves.series {
        let x0 = columns.x.first().copied().unwrap_or_default();
        let mut names = Vec::new();
        let mut column = |name, values: &mut dyn Iterator<Item = f64>| {
            names.push(name);
            numbers.extend(values.flat_map(|value| single(value).to_le_bytes()));
        };
        column("x", &mut columns.x.iter().map(|x| x - x0));
        column("min", &mut columns.min.iter().copied());
        column("max", &mut columns.max.iter().copied());
        column("mean", &mut columns.mean.iter().copied());
        column("last", &mut columns.last.iter().copied());
        column("count", &mut columns.count.iter().map(|count| *count as f64));
        if columns.nan.iter().any(|nan| *nan > 0) {
            column("nan", &mut columns.nan.iter().map(|nan| *nan as f64));
        }
        heads.push(Head { run, stage, key, total: *total, rows: columns.x.len(), x0, columns: names });
    }
    let mut head = serde_json::json!({"x": curves.x, "series": heads}).to_string();
    head.extend(std::iter::repeat_n(' ', head.len().next_multiple_of(4) - head.len()));
    let length = u32::try_from(head.len()).unwrap_or(u32::MAX);
    [&length.to_le_bytes(), head.as_bytes(), &numbers].concat()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn read(query: &[(&str, &str)]) -> Result<CurveQuery, Failure> {
        CurveQuery::read(query.iter().map(|(name, value)| ((*name).to_owned(), (*value).to_owned())).collect())
    }

    #[test]
    fn a_query_says_what_is_wrong_with_it() {
        let query =
            read(&[("run", "a"), ("run", "b"), ("run", "a"), ("key", "loss"), ("x", "hours"), ("from", "-1.5")]);
        let query = query.ok().map(|query| (query.runs, query.keys, query.window));
        let window = Window { axis: Axis::Hours, from: Some(-1.5), to: None, buckets: 800 };
        assert_eq!(query, Some((vec!["a".into(), "b".into()], vec!["loss".into()], window)));
        for (name, value, says) in [
            ("x", "epoch", "`x` is `epoch`; expected `step`, `time` or `hours`"),
            ("to", "inf", "`to` is `inf`; expected a number"),
            ("buckets", "0", "`buckets` is `0`; expected a number from 1 to 4000"),
            ("points", "5", "unknown parameter `points`"),
        ] {
            let refused = read(&[("run", "a"), (name, value)]).err().map(|failure| format!("{failure:?}"));
            assert!(refused.as_ref().is_some_and(|refused| refused.contains(says)), "{refused:?}");
        }
        assert!(read(&[("key", "loss")]).is_err());
    }

    #[test]
    fn a_packed_answer_reads_as_its_head_says() {
        let columns = Buckets {
            x: vec![1e12, 1e12 + 5.0],
            min: vec![1.0, f64::NAN],
            max: vec![2.0, f64::NAN],
            mean: vec![1e300, f64::NAN],
            last: vec![2.0, f64::NAN],
            count: vec![2, 1],
            nan: vec![0, 1],
        };
        let series = |columns| CurveSeries { run: "r".into(), stage: "s".into(), key: "é".into(), total: 3, columns };
        let whole = Buckets { nan: vec![0, 0], ..columns.clone() };
        let packed = pack(&Curves { x: Axis::Time, series: vec![series(columns), series(whole)] });
        let (length, rest) = packed.split_at(4);
        let length = u32::from_le_bytes(length.try_into().unwrap_or_default()) as usize;
        assert_eq!(length % 4, 0);
        let head: serde_json::Value = serde_json::from_slice(&rest[..length]).unwrap_or_default();
        assert_eq!(
            (&head["x"], &head["series"][0]["key"], &head["series"][0]["x0"]),
            (&"time".into(), &"é".into(), &1e12.into())
        );
        let counts: Vec<usize> = head["series"]
            .as_array()
            .into_iter()
            .flatten()
            .map(|s| s["columns"].as_array().map_or(0, Vec::len))
            .collect();
        assert_eq!(counts, [7, 6]);
        let number = |bytes: &[u8]| f32::from_le_bytes(bytes.try_into().unwrap_or_default());
        let numbers: Vec<f32> = rest[length..].chunks(4).map(number).collect();
        assert_eq!(numbers.len(), 2 * 13);
        assert_eq!((numbers[1], numbers[2], numbers[13]), (5.0, 1.0, 1.0));
        assert!(numbers[3].is_nan());
        assert_eq!((numbers[6], single(-1e300)), (f32::MAX, f32::MIN), "finite, as in JSON");
    }
}
