//! Panels of curves side by side, as SVG: one quantity as a function of another.

use std::collections::BTreeMap;
use std::fmt::Write;

use crate::report::print;

const WIDTH: f64 = 460.0;
const HEIGHT: f64 = 340.0;
const LEFT: f64 = 80.0;
const RIGHT: f64 = 20.0;
const TOP: f64 = 64.0;
const BOTTOM: f64 = 56.0;
/// Panels per row.
const COLUMNS: usize = 2;
/// Least distance between the centres of two numbers below an axis.
const APART: f64 = 44.0;
/// Colours of lines; a ninth line repeats the first one.
const COLOURS: [&str; 8] = ["#246ec8", "#d65430", "#2f8f5b", "#8a5bb5", "#c79a1b", "#4aa3b8", "#b0477a", "#6b6f76"];

/// A linear axis. It is logarithmic if all values are positive and span more than a factor of 20.
pub(crate) struct Axis {
    low: f64,
    high: f64,
    logarithmic: bool,
    from: f64,
    to: f64,
}

impl Axis {
    pub(crate) fn new(values: impl Iterator<Item = f64> + Clone, from: f64, to: f64) -> Self {
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

    pub(crate) fn at(&self, value: f64) -> f64 {
        let share = (self.scale(value) - self.scale(self.low)) / (self.scale(self.high) - self.scale(self.low));
        self.from + share * (self.to - self.from)
    }

    pub(crate) fn marks(&self) -> Vec<f64> {
        let mark = |i: i32| {
            let scaled = self.scale(self.low) + f64::from(i) / 4.0 * (self.scale(self.high) - self.scale(self.low));
            if self.logarithmic { scaled.exp() } else { scaled }
        };
        (0..=4).map(mark).collect()
    }
}

/// Points of a line that are more than these are drawn without marks of their own.
const MARKED: usize = 60;

/// One of the pictures: lines by name, each of points (x, y), and what the axes are.
#[derive(Debug, Clone, Default)]
pub(crate) struct Panel {
    pub(crate) x: String,
    pub(crate) y: String,
    pub(crate) lines: BTreeMap<String, Vec<(f64, f64)>>,
    /// Bands around lines of the same name, each point (x, low, high).
    pub(crate) bands: BTreeMap<String, Vec<(f64, f64, f64)>>,
    /// Places of values that are not finite, drawn as red ticks.
    pub(crate) odd: Vec<f64>,
}

/// Draws the panels. All show the same lines, and their names appear above if there are several. Points that are not
/// finite are left out.
pub(crate) fn svg(title: &str, panels: &[Panel]) -> String {
    let names: Vec<&String> = panels.first().map(|panel| panel.lines.keys().collect()).unwrap_or_default();
    let columns = panels.len().clamp(1, COLUMNS);
    let (width, height) = (WIDTH * columns as f64, 28.0 + HEIGHT * panels.len().div_ceil(COLUMNS) as f64);
    let mut out = String::new();
    // Writing to a string never fails.
    let _ = writeln!(
        out,
        r##"<svg xmlns="http://www.w3.org/2000/svg" width="{width}" height="{height}" viewBox="0 0 {width} {height}" font-family="sans-serif" font-size="12" fill="#282a30">
<rect width="{width}" height="{height}" fill="#fafaf8"/>
<text x="{LEFT}" y="24" font-size="15">{}</text>"##,
        escape(title)
    );
    for (i, panel) in panels.iter().enumerate() {
        let (x, y) = (WIDTH * (i % COLUMNS) as f64, 28.0 + HEIGHT * (i / COLUMNS) as f64);
        let _ = writeln!(out, r#"<g transform="translate({x},{y})">"#);
        let plotted = Plotted::new(panel);
        plotted.draw_axes(&mut out);
        plotted.draw_lines(&mut out, &names);
        let _ = writeln!(out, "</g>");
    }
    out + "</svg>\n"
}

/// The finite values of a panel's lines and bands, and its axes.
struct Plotted<'a> {
    panel: &'a Panel,
    lines: Vec<(&'a String, Vec<(f64, f64)>)>,
    bands: BTreeMap<&'a String, Vec<(f64, f64, f64)>>,
    x: Axis,
    y: Axis,
    /// The values on the x axis, in order.
    values: Vec<f64>,
}

impl<'a> Plotted<'a> {
    fn new(panel: &'a Panel) -> Self {
        let finite = |points: &Vec<(f64, f64)>| -> Vec<(f64, f64)> {
            points.iter().copied().filter(|(x, y)| x.is_finite() && y.is_finite()).collect()
        };
        let lines: Vec<_> = panel.lines.iter().map(|(name, points)| (name, finite(points))).collect();
        let is_finite = |(x, low, high): &&(f64, f64, f64)| x.is_finite() && low.is_finite() && high.is_finite();
        let finite = |band: &Vec<(f64, f64, f64)>| band.iter().filter(is_finite).copied().collect();
        let bands: BTreeMap<_, Vec<_>> = panel.bands.iter().map(|(name, band)| (name, finite(band))).collect();
        let mut all: Vec<(f64, f64)> = lines.iter().flat_map(|(_, points)| points.iter().copied()).collect();
        all.extend(bands.values().flatten().flat_map(|(x, low, high)| [(*x, *low), (*x, *high)]));
        let x = Axis::new(all.iter().map(|point| point.0), LEFT, WIDTH - RIGHT);
        let y = Axis::new(all.iter().map(|point| point.1), HEIGHT - BOTTOM, TOP);
        let mut values: Vec<f64> = all.iter().map(|point| point.0).collect();
        values.sort_by(f64::total_cmp);
        values.dedup();
        Self { panel, lines, bands, x, y, values }
    }

    /// Marks the values themselves if they are few and their labels do not touch.
    fn x_marks(&self) -> Vec<f64> {
        let apart = self.values.windows(2).all(|pair| self.x.at(pair[1]) - self.x.at(pair[0]) >= APART);
        if (1..=8).contains(&self.values.len()) && apart { self.values.clone() } else { self.x.marks() }
    }

    fn point(&self, a: f64, b: f64) -> String {
        format!("{:.1},{:.1}", self.x.at(a), self.y.at(b))
    }

    fn draw_axes(&self, out: &mut String) {
        let mut line = |text: std::fmt::Arguments<'_>| {
            let _ = writeln!(out, "{text}");
        };
        for mark in self.y.marks() {
            let (at, end, label) = (self.y.at(mark), WIDTH - RIGHT, print::number(mark));
            line(format_args!(r##"<line x1="{LEFT}" x2="{end}" y1="{at:.1}" y2="{at:.1}" stroke="#dedfe0"/>"##));
            line(format_args!(r#"<text x="{:.1}" y="{:.1}" text-anchor="end">{label}</text>"#, LEFT - 8.0, at + 4.0));
        }
        for mark in self.x_marks() {
            let whole = mark.fract() == 0.0 && mark.abs() < 1e6;
            let label = if whole { format!("{mark:.0}") } else { print::number(mark) };
            let (at, bottom) = (self.x.at(mark), HEIGHT - BOTTOM);
            line(format_args!(r##"<line x1="{at:.1}" x2="{at:.1}" y1="{TOP}" y2="{bottom}" stroke="#dedfe0"/>"##));
            line(format_args!(r#"<text x="{at:.1}" y="{}" text-anchor="middle">{label}</text>"#, bottom + 18.0));
        }
        let middle = (LEFT + WIDTH - RIGHT) / 2.0;
        let (below, label) = (HEIGHT - 14.0, escape(&self.panel.x));
        line(format_args!(r#"<text x="{middle}" y="{below}" text-anchor="middle">{label}</text>"#));
        let title = escape(&self.panel.y);
        line(format_args!(r#"<text x="{LEFT}" y="{}" font-weight="bold">{title}</text>"#, TOP - 34.0));
    }

    fn draw_lines(&self, out: &mut String, names: &[&String]) {
        let mut line = |text: std::fmt::Arguments<'_>| {
            let _ = writeln!(out, "{text}");
        };
        for (i, (name, points)) in self.lines.iter().enumerate() {
            let colour = COLOURS[i % COLOURS.len()];
            let title = escape(name);
            let path: Vec<String> = points.iter().map(|(a, b)| self.point(*a, *b)).collect();
            line(format_args!(r#"<g stroke="{colour}" fill="{colour}"><title>{title}</title>"#));
            if let Some(band) = self.bands.get(name).filter(|band| !band.is_empty()) {
                let low = band.iter().map(|(a, low, _)| (a, low));
                let high = band.iter().rev().map(|(a, _, high)| (a, high));
                let edge: Vec<String> = low.chain(high).map(|(a, b)| self.point(*a, *b)).collect();
                line(format_args!(r#"<polygon points="{}" stroke="none" fill-opacity=".2"/>"#, edge.join(" ")));
            }
            line(format_args!(r#"<polyline points="{}" fill="none" stroke-width="1.8"/>"#, path.join(" ")));
            for (a, b) in points.iter().filter(|_| points.len() <= MARKED) {
                line(format_args!(r#"<circle cx="{:.1}" cy="{:.1}" r="2.5"/>"#, self.x.at(*a), self.y.at(*b)));
            }
            line(format_args!("</g>"));
            if names.len() > 1 {
                let at = LEFT + (WIDTH - LEFT - RIGHT) / names.len() as f64 * i as f64;
                line(format_args!(r#"<text x="{at:.1}" y="{}" fill="{colour}">{title}</text>"#, TOP - 14.0));
            }
        }
        for at in self.panel.odd.iter().filter(|at| at.is_finite()).map(|at| self.x.at(*at)) {
            let (from, to) = (HEIGHT - BOTTOM, HEIGHT - BOTTOM - 8.0);
            line(format_args!(r##"<line x1="{at:.1}" x2="{at:.1}" y1="{from}" y2="{to}" stroke="#c0142c"/>"##));
        }
    }
}

/// Escapes text for SVG.
pub(crate) fn escape(text: &str) -> String {
    text.replace('&', "&amp;").replace('<', "&lt;").replace('"', "&quot;")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn curves_lie_inside_their_panels_and_have_their_names() {
        let lines = BTreeMap::from([
            ("ddim".to_owned(), vec![(1.0, 0.5), (2.0, 0.4), (50.0, f64::NAN)]),
            ("dpm & <co>".to_owned(), vec![(1.0, 0.6), (50.0, 0.01)]),
        ]);
        let panel = Panel { x: "steps".into(), y: "fid".into(), lines, ..Panel::default() };
        let picture = svg("a title", &[panel.clone(), panel.clone(), panel]);
        assert_eq!((picture.matches("<polyline").count(), picture.matches("<circle").count()), (6, 12));
        assert!(picture.contains("dpm &amp; &lt;co>") && !picture.contains("NaN"), "{picture}");
        for circle in picture.split("<circle cx=\"").skip(1) {
            let x: f64 = circle.split('"').next().unwrap().parse().unwrap();
            let y: f64 = circle.split("cy=\"").nth(1).unwrap().split('"').next().unwrap().parse().unwrap();
            assert!((LEFT..=WIDTH - RIGHT).contains(&x) && (TOP..=HEIGHT - BOTTOM).contains(&y), "{x} {y}");
        }
        assert!(svg("nothing", &[]).ends_with("</svg>\n"));
    }

    #[test]
    fn bands_lie_behind_their_lines_and_what_is_no_number_is_a_tick() {
        let many: Vec<(f64, f64)> = (0..100).map(|i| (f64::from(i), 1.0)).collect();
        let band = many.iter().map(|(x, y)| (*x, y - 5.0, y + 5.0)).chain([(100.0, f64::NAN, f64::NAN)]).collect();
        let name = "loss".to_owned();
        let (lines, bands) = (BTreeMap::from([(name.clone(), many)]), BTreeMap::from([(name, band)]));
        let panel = Panel { x: "step".into(), y: "loss".into(), lines, bands, odd: vec![50.0, f64::NAN] };
        let picture = svg("a title", &[panel]);
        assert_eq!((picture.matches("<polygon").count(), picture.matches("<circle").count()), (1, 0));
        assert_eq!(picture.matches("#c0142c").count(), 1);
        assert!(!picture.contains("NaN") && picture.find("<polygon") < picture.find("<polyline"));
    }

    #[test]
    fn numbers_below_an_axis_do_not_touch() {
        for values in [vec![0.89, 0.9, 1.7, 5.6], vec![1.0, 2.0, 4.0, 8.0, 15.0, 30.0], vec![3.0]] {
            let lines = BTreeMap::from([(String::new(), values.iter().map(|x| (*x, 1.0)).collect())]);
            let picture = svg("a title", &[Panel { x: "seconds".into(), y: "fid".into(), lines, ..Panel::default() }]);
            let below = format!("y=\"{}\" text-anchor=\"middle\"", HEIGHT - BOTTOM + 18.0);
            let places: Vec<f64> = picture
                .lines()
                .filter(|line| line.contains(&below))
                .map(|line| line.split('"').nth(1).unwrap().parse().unwrap())
                .collect();
            assert!(!places.is_empty() && places.windows(2).all(|pair| pair[1] - pair[0] >= APART - 0.2), "{places:?}");
        }
    }
}
