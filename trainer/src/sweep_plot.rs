//! A sweep as a picture: the metric of every trial against its steps, as SVG. Grey lines were stopped, the coloured one is the best.

use std::fmt::Write;

use protocol::message::{SweepView, TrialState};

use crate::print;

const WIDTH: f64 = 720.0;
const HEIGHT: f64 = 420.0;
const LEFT: f64 = 80.0;
const RIGHT: f64 = 24.0;
const TOP: f64 = 44.0;
const BOTTOM: f64 = 56.0;

/// A linear axis; logarithmic where all values are positive and spread over more than a factor of 20.
struct Axis {
    low: f64,
    high: f64,
    logarithmic: bool,
    from: f64,
    to: f64,
}

impl Axis {
    fn new(values: impl Iterator<Item = f64> + Clone, from: f64, to: f64) -> Self {
        let low = values.clone().fold(f64::INFINITY, f64::min);
        let high = values.fold(f64::NEG_INFINITY, f64::max);
        let (low, high) = if low < high {
            (low, high)
        } else if low.is_finite() {
            (low - 0.5, low + 0.5)
        } else {
            (0.0, 1.0)
        };
        Self { low, high, logarithmic: low > 0.0 && high / low > 20.0, from, to }
    }

    fn scale(&self, value: f64) -> f64 {
        if self.logarithmic { value.ln() } else { value }
    }

    fn at(&self, value: f64) -> f64 {
        let share = (self.scale(value) - self.scale(self.low)) / (self.scale(self.high) - self.scale(self.low));
        self.from + share * (self.to - self.from)
    }

    fn marks(&self) -> Vec<f64> {
        let mark = |i: i32| {
            let scaled = self.scale(self.low) + f64::from(i) / 4.0 * (self.scale(self.high) - self.scale(self.low));
            if self.logarithmic { scaled.exp() } else { scaled }
        };
        (0..=4).map(mark).collect()
    }
}

/// The picture.
pub(crate) fn svg(sweep: &SweepView) -> String {
    let values = sweep.trials.iter().flat_map(|trial| trial.results.iter().flatten().copied());
    let x = Axis::new(sweep.rungs.iter().map(|steps| *steps as f64).chain([0.0]), LEFT, WIDTH - RIGHT);
    let y = Axis::new(values, HEIGHT - BOTTOM, TOP);
    let mut out = String::new();
    let mut line = |text: std::fmt::Arguments<'_>| {
        // Writing to a text cannot fail.
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
        let points: Vec<(f64, f64)> = sweep
            .rungs
            .iter()
            .zip(&trial.results)
            .filter_map(|(steps, value)| Some((x.at(*steps as f64), y.at((*value)?))))
            .collect();
        let (colour, width) = match trial.state {
            _ if sweep.best == Some(trial.trial) => ("#d65430", 2.5),
            TrialState::Finished | TrialState::Running => ("#246ec8", 1.5),
            TrialState::Failed => ("#b08bb0", 1.0),
            TrialState::Waiting | TrialState::Paused | TrialState::Stopped => ("#9aa0a6", 1.0),
        };
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

fn escape(text: &str) -> String {
    text.replace('&', "&amp;").replace('<', "&lt;").replace('"', "&quot;")
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
        let mut empty = sweep();
        for trial in &mut empty.trials {
            trial.results.clear();
        }
        assert!(svg(&empty).ends_with("</svg>\n") && !svg(&empty).contains("NaN"));
    }
}
