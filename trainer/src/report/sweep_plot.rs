//! Pictures of a sweep, as SVG. One shows the metric of every trial over its steps: stopped trials are grey, and the
//! best one is coloured. A sweep without rungs has a panel for each searched setting instead. The other shows metrics
//! over a searched setting, or over the time of the evaluation.

use std::collections::{BTreeMap, BTreeSet};
use std::fmt::Write;

use protocol::message::{RunView, StageView, SweepView, TrialState, TrialView};
use protocol::sweep::rung_name;
use serde_json::Value;

use crate::report::figure::{self, Axis, Panel, escape};
use crate::report::print;

const WIDTH: f64 = 720.0;
const HEIGHT: f64 = 420.0;
const LEFT: f64 = 80.0;
const RIGHT: f64 = 24.0;
const TOP: f64 = 44.0;
const BOTTOM: f64 = 56.0;

/// Draws the metric of every trial over its steps, or over each searched setting if no trial is stopped early.
pub(crate) fn svg(sweep: &SweepView) -> String {
    if sweep.rungs.len() < 2 {
        return scatter(sweep);
    }
    let values = sweep.trials.iter().flat_map(|trial| trial.results.iter().flatten().copied());
    let x = Axis::new(sweep.rungs.iter().map(|steps| *steps as f64).chain([0.0]), LEFT, WIDTH - RIGHT);
    let y = Axis::new(values, HEIGHT - BOTTOM, TOP);
    let mut out = String::new();
    let mut line = |text: std::fmt::Arguments<'_>| {
        // Writing to a string never fails.
        let _ = writeln!(out, "{text}");
    };
    line(format_args!(
        r##"<svg xmlns="http://www.w3.org/2000/svg" width="{WIDTH}" height="{HEIGHT}" viewBox="0 0 {WIDTH} {HEIGHT}" font-family="sans-serif" font-size="12" fill="#282a30">"##
    ));
    line(format_args!(r##"<rect width="{WIDTH}" height="{HEIGHT}" fill="#fafaf8"/>"##));
    let title =
        escape(&format!("sweep of {}: {} by steps of {} trials", sweep.stage, sweep.metric, sweep.trials.len()));
    line(format_args!(r#"<text x="{LEFT}" y="24" font-size="15">{title}</text>"#));
    for mark in y.marks() {
        let at = y.at(mark);
        let (end, label) = (WIDTH - RIGHT, print::number(mark));
        line(format_args!(r##"<line x1="{LEFT}" x2="{end}" y1="{at:.1}" y2="{at:.1}" stroke="#dedfe0"/>"##));
        line(format_args!(r#"<text x="{:.1}" y="{:.1}" text-anchor="end">{label}</text>"#, LEFT - 8.0, at + 4.0));
    }
    for steps in &sweep.rungs {
        let at = x.at(*steps as f64);
        let (bottom, label) = (HEIGHT - BOTTOM, HEIGHT - BOTTOM + 18.0);
        line(format_args!(r##"<line x1="{at:.1}" x2="{at:.1}" y1="{TOP}" y2="{bottom}" stroke="#dedfe0"/>"##));
        line(format_args!(r#"<text x="{at:.1}" y="{label}" text-anchor="middle">{steps}</text>"#));
    }
    let (middle, bottom) = ((LEFT + WIDTH - RIGHT) / 2.0, HEIGHT - 14.0);
    line(format_args!(r#"<text x="{middle}" y="{bottom}" text-anchor="middle">steps</text>"#));
    // The best is drawn last, over the others.
    let mut order: Vec<usize> = (0..sweep.trials.len()).collect();
    order.sort_by_key(|trial| (sweep.best == Some(*trial), sweep.trials[*trial].results.len()));
    for trial in order.into_iter().map(|trial| &sweep.trials[trial]) {
        let (colour, width) = stroke(sweep, trial);
        let points: Vec<(f64, f64)> = sweep
            .rungs
            .iter()
            .zip(&trial.results)
            .filter_map(|(steps, value)| Some((x.at(*steps as f64), y.at((*value)?))))
            .collect();
        let path: Vec<String> = points.iter().map(|(x, y)| format!("{x:.1},{y:.1}")).collect();
        let name =
            escape(&format!("trial {}: {}", trial.trial, serde_json::to_string(&trial.values).unwrap_or_default()));
        line(format_args!(r#"<g stroke="{colour}" fill="{colour}"><title>{name}</title>"#));
        line(format_args!(r#"<polyline points="{}" fill="none" stroke-width="{width}"/>"#, path.join(" ")));
        for (x, y) in points {
            line(format_args!(r#"<circle cx="{x:.1}" cy="{y:.1}" r="2.5"/>"#));
        }
        line(format_args!("</g>"));
    }
    line(format_args!("</svg>"));
    out
}

/// Colour and width of a trial's line.
fn stroke(sweep: &SweepView, trial: &TrialView) -> (&'static str, f64) {
    match trial.state {
        _ if sweep.best == Some(trial.trial) => ("#d65430", 2.5),
        TrialState::Finished | TrialState::Running => ("#246ec8", 1.5),
        TrialState::Failed => ("#b08bb0", 1.0),
        TrialState::Waiting | TrialState::Paused | TrialState::Stopped => ("#9aa0a6", 1.0),
    }
}

/// Width and height of a panel of [`scatter`].
const PANEL: [f64; 2] = [360.0, 280.0];

/// Draws the last result of each trial over each searched setting, in a panel of its own. Values that are words are at
/// equal distances. The best trial is coloured.
fn scatter(sweep: &SweepView) -> String {
    let settings: Vec<&String> = sweep.trials.first().map(|trial| trial.values.keys().collect()).unwrap_or_default();
    let columns = settings.len().clamp(1, 2);
    let [width, height] = [PANEL[0] * columns as f64, 40.0 + PANEL[1] * settings.len().div_ceil(2).max(1) as f64];
    let mut out = String::new();
    let trials = sweep.trials.len();
    let title = escape(&format!("sweep of {}: {} of {trials} trials", sweep.stage, sweep.metric));
    // Writing to a string never fails.
    let _ = writeln!(
        out,
        r##"<svg xmlns="http://www.w3.org/2000/svg" width="{width}" height="{height}" viewBox="0 0 {width} {height}" font-family="sans-serif" font-size="12" fill="#282a30">
<rect width="{width}" height="{height}" fill="#fafaf8"/>
<text x="16" y="26" font-size="15">{title}</text>"##
    );
    for (i, setting) in settings.iter().enumerate() {
        let (x, y) = (PANEL[0] * (i % 2) as f64, 40.0 + PANEL[1] * (i / 2) as f64);
        let _ = writeln!(out, r#"<g transform="translate({x},{y})">"#);
        scatter_panel(&mut out, sweep, setting);
        let _ = writeln!(out, "</g>");
    }
    out + "</svg>\n"
}

fn scatter_panel(out: &mut String, sweep: &SweepView, setting: &str) {
    let (left, right, top, bottom) = (72.0, PANEL[0] - 20.0, 16.0, PANEL[1] - 52.0);
    let result = |trial: &TrialView| trial.results.last().copied().flatten().filter(|value| value.is_finite());
    let text = |value: &Value| value.as_str().map_or_else(|| value.to_string(), str::to_owned);
    let values = || sweep.trials.iter().filter_map(|trial| trial.values.get(setting));
    let words: BTreeSet<String> =
        if values().all(Value::is_number) { BTreeSet::new() } else { values().map(text).collect() };
    let place = |trial: &TrialView| {
        let value = trial.values.get(setting)?;
        let word = || words.iter().position(|word| *word == text(value)).map(|at| at as f64);
        if words.is_empty() { value.as_f64() } else { word() }
    };
    let places: Vec<f64> = sweep.trials.iter().filter_map(place).collect();
    // Points do not lie on the frame.
    let x = Axis::new(places.iter().copied(), left + 14.0, right - 14.0);
    let y = Axis::new(sweep.trials.iter().filter_map(result), bottom - 8.0, top + 8.0);
    let mut line = |text: std::fmt::Arguments<'_>| {
        let _ = writeln!(out, "{text}");
    };
    for mark in y.marks() {
        let (at, label) = (y.at(mark), print::number(mark));
        line(format_args!(r##"<line x1="{left}" x2="{right}" y1="{at:.1}" y2="{at:.1}" stroke="#dedfe0"/>"##));
        line(format_args!(r#"<text x="{:.1}" y="{:.1}" text-anchor="end">{label}</text>"#, left - 8.0, at + 4.0));
    }
    let marks: Vec<(f64, String)> = if words.is_empty() {
        [0, 2, 4].into_iter().filter_map(|i| x.marks().get(i).map(|mark| (*mark, print::number(*mark)))).collect()
    } else {
        words.iter().enumerate().map(|(at, word)| (at as f64, word.clone())).collect()
    };
    for (mark, label) in marks {
        let (at, below, label) = (x.at(mark), bottom + 18.0, escape(&label));
        line(format_args!(r#"<text x="{at:.1}" y="{below}" text-anchor="middle">{label}</text>"#));
    }
    let (middle, below, name) = ((left + right) / 2.0, bottom + 38.0, escape(setting));
    line(format_args!(r#"<text x="{middle}" y="{below}" text-anchor="middle" font-weight="bold">{name}</text>"#));
    let mut order: Vec<&TrialView> = sweep.trials.iter().collect();
    order.sort_by_key(|trial| sweep.best == Some(trial.trial));
    for trial in order {
        let (Some(at), Some(value)) = (place(trial), result(trial)) else { continue };
        let best = sweep.best == Some(trial.trial);
        let (colour, radius) = if best { ("#d65430", 5.5) } else { ("#246ec8", 4.0) };
        let title = escape(&format!("trial {}: {} {}", trial.trial, sweep.metric, print::number(value)));
        let (cx, cy) = (x.at(at), y.at(value));
        line(format_args!(
            r#"<circle cx="{cx:.1}" cy="{cy:.1}" r="{radius}" fill="{colour}" fill-opacity=".8"><title>{title}</title></circle>"#
        ));
    }
}

/// Horizontal axis of the trials.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) enum By {
    Steps,
    /// A searched setting that is a number.
    Setting(String),
    /// Seconds of the evaluation, including reading and measuring.
    Seconds,
}

impl By {
    /// The default: a searched number if every trial is trained to its end, else the steps.
    pub(crate) fn usual(sweep: &SweepView) -> Self {
        let mut numbers = numbers(sweep).into_iter();
        match (sweep.rungs.len(), numbers.next(), numbers.next()) {
            (1, Some(only), None) => Self::Setting(only),
            _ => Self::Steps,
        }
    }

    /// Finds a searched setting by its path or the end of it, `seconds` or `steps`.
    ///
    /// # Errors
    /// If there is none; the message lists the choices.
    pub(crate) fn named(name: &str, sweep: &SweepView) -> Result<Self, String> {
        let numbers = numbers(sweep);
        let is = |path: &&String| *path == name || path.ends_with(&format!(".{name}"));
        match (name, numbers.iter().find(is)) {
            (_, Some(path)) => Ok(Self::Setting(path.clone())),
            ("seconds", None) => Ok(Self::Seconds),
            ("steps", None) => Ok(Self::Steps),
            _ => {
                let there =
                    numbers.iter().map(String::as_str).chain(["seconds", "steps"]).collect::<Vec<_>>().join(", ");
                Err(format!("`{name}` is not a searched number; available: {there}"))
            }
        }
    }
}

/// Searched settings that are numbers and differ between trials.
fn numbers(sweep: &SweepView) -> Vec<String> {
    let Some(first) = sweep.trials.first() else { return Vec::new() };
    let differs = |path: &&String| {
        let mut values = sweep.trials.iter().map(|trial| trial.values.get(*path).and_then(Value::as_f64));
        let first = values.next().flatten();
        first.is_some() && values.clone().all(|value| value.is_some()) && values.any(|value| value != first)
    };
    first.values.keys().filter(differs).cloned().collect()
}

/// Draws curves of `metrics` over the axis `by`: one panel per metric, and one line per choice of the other searched
/// settings.
///
/// # Errors
/// If no evaluation has a metric; the message lists those that exist.
pub(crate) fn curves(run: &RunView, sweep: &SweepView, by: &By, metrics: &[String]) -> Result<String, String> {
    let last = sweep.rungs.len().saturating_sub(1);
    let evaluations: Vec<(&TrialView, &StageView)> = sweep
        .trials
        .iter()
        .filter_map(|trial| {
            let name = format!("{}.eval", rung_name(&sweep.stage, trial.trial, last));
            Some((trial, run.stages.iter().find(|stage| stage.name.as_str() == name)?))
        })
        .collect();
    let named = |path: &str| path.rsplit('.').next().unwrap_or(path).to_owned();
    let x = |trial: &TrialView, stage: &StageView| match by {
        By::Setting(path) => trial.values.get(path).and_then(Value::as_f64),
        // A cached evaluation took no time in this run.
        By::Seconds => Some(stage.wall_s).filter(|seconds| *seconds > 0.0),
        By::Steps => Some(trial.steps as f64),
    };
    let line = |trial: &TrialView| {
        let others = trial.values.iter().filter(|(path, _)| match by {
            By::Setting(by) => *path != by,
            // Timed trials differ in the numbers that change the time.
            By::Seconds | By::Steps => !trial.values[*path].is_number(),
        });
        let text = |value: &Value| value.as_str().map_or_else(|| value.to_string(), str::to_owned);
        others.map(|(path, value)| format!("{} {}", named(path), text(value))).collect::<Vec<_>>().join(", ")
    };
    let mut panels = Vec::new();
    for metric in metrics {
        let mut lines: BTreeMap<String, Vec<(f64, f64)>> = BTreeMap::new();
        for (trial, stage) in &evaluations {
            if let (Some(x), Some(y)) = (x(trial, stage), stage.metrics.get(metric)) {
                lines.entry(line(trial)).or_default().push((x, *y));
            }
        }
        if lines.is_empty() {
            let given: BTreeSet<&str> =
                evaluations.iter().flat_map(|(_, stage)| stage.metrics.keys().map(String::as_str)).collect();
            let given = given.into_iter().filter(|name| !name.ends_with(".lower") && !name.ends_with(".upper"));
            return Err(format!(
                "no evaluation of `{}` has `{metric}` together with the value of the x axis; metrics: {}",
                sweep.stage,
                given.collect::<Vec<_>>().join(", ")
            ));
        }
        lines.values_mut().for_each(|points| points.sort_by(|a, b| a.0.total_cmp(&b.0)));
        let x = match by {
            By::Setting(path) => named(path),
            By::Seconds => "seconds that the evaluation took".to_owned(),
            By::Steps => "steps".to_owned(),
        };
        panels.push(Panel { x, y: metric.clone(), lines, ..Panel::default() });
    }
    let title = format!("sweep of {}: {} trials", sweep.stage, sweep.trials.len());
    Ok(figure::svg(&title, &panels))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::cli::sweep::tests::sweep;

    #[test]
    fn every_trial_is_drawn_inside_the_frame_and_the_best_last() {
        let picture = svg(&sweep());
        assert_eq!(picture.matches("<polyline").count(), 4);
        assert_eq!(picture.matches("<circle").count(), 5, "one for each result that is a number");
        let last = picture.rsplit("<title>").next().unwrap();
        assert!(last.starts_with("trial 2:") && picture.contains("#d65430"), "{last}");
        for circle in picture.split("<circle cx=\"").skip(1) {
            let x: f64 = circle.split('"').next().unwrap().parse().unwrap();
            let y: f64 = circle.split("cy=\"").nth(1).unwrap().split('"').next().unwrap().parse().unwrap();
            assert!((LEFT..=WIDTH - RIGHT).contains(&x) && (TOP..=HEIGHT - BOTTOM).contains(&y), "{x} {y}");
        }
        let mut flat = sweep();
        flat.rungs.truncate(1);
        flat.trials.iter_mut().for_each(|trial| trial.results.truncate(1));
        let picture = svg(&flat);
        let settings = flat.trials[0].values.len();
        let drawn = flat.trials.iter().filter(|trial| trial.results.first().is_some_and(Option::is_some)).count();
        assert!(settings > 0 && drawn > 1, "{settings} settings of {drawn} trials");
        assert_eq!(picture.matches("<circle").count(), settings * drawn, "a point for each trial in each panel");
        assert_eq!(picture.matches("#d65430").count(), settings, "the best one in each panel");
        assert!(!picture.contains("<polyline") && !picture.contains("NaN"), "{picture}");
        let mut empty = sweep();
        for trial in &mut empty.trials {
            trial.results.clear();
        }
        assert!(svg(&empty).ends_with("</svg>\n") && !svg(&empty).contains("NaN"));
    }
}
