//! `trainer metrics`: the values that stages recorded, as a table, a picture, or all of them.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

use clap::{Args, ValueEnum};
use coordinator::shell::CurveSeries;
use protocol::RunId;
use protocol::units::counted;
use registry::{Axis, Page, Window};

use crate::client::Target;
use crate::reader::Reader;
use crate::report::figure::{self, Panel};
use crate::report::print::{self, Output};
use crate::report::problem::{Problem, Result, exit};
use crate::report::tensorboard::EventFile;

/// Buckets of a drawn curve: about one a pixel.
const DRAWN: usize = 400;

#[derive(Debug, Args)]
pub(crate) struct MetricsArgs {
    /// The run, a unique beginning of its name, or `@last`
    #[arg(default_value = "@last")]
    run: String,
    /// Only this stage
    #[arg(long)]
    stage: Option<String>,
    /// Only these values
    #[arg(long, value_name = "NAME", value_delimiter = ',')]
    key: Vec<String>,
    /// Draws the curves, a panel for each value: the mean, and around it the smallest and the largest, an SVG file
    #[arg(long, value_name = "FILE.svg")]
    plot: Option<PathBuf>,
    /// Horizontal axis of the curves
    #[arg(long, value_enum, default_value_t, requires = "plot")]
    x: Over,
    /// Prints every value as CSV
    #[arg(long, conflicts_with_all = ["plot", "output"])]
    csv: bool,
    /// Writes every value to event files that TensorBoard shows, in a folder for each stage
    #[arg(long, value_name = "DIR", conflicts_with_all = ["plot", "csv", "output"])]
    tensorboard: Option<PathBuf>,
    #[command(flatten)]
    target: Target,
    /// Format of the result
    #[arg(short, long, value_enum, default_value_t)]
    pub(super) output: Output,
}

#[derive(Debug, Clone, Copy, Default, ValueEnum)]
enum Over {
    #[default]
    Step,
    Hours,
}

pub(crate) async fn metrics(args: MetricsArgs) -> Result<u8> {
    if let Some(path) = &args.plot {
        if path.extension().is_none_or(|extension| extension != "svg") {
            return Err(Problem::usage(format!(
                "cannot write `{}`; expected a file name that ends in .svg",
                path.display()
            )));
        }
        super::remote::check_parent(path)?;
    }
    let reader = Reader::open(&args.target).await?;
    let run = reader.find(&args.run).await?.run;
    let axis = match args.x {
        Over::Step => Axis::Step,
        Over::Hours => Axis::Hours,
    };
    let window = Window { axis, from: None, to: None, buckets: if args.plot.is_some() { DRAWN } else { 1 } };
    let mut curves = reader.curves(&run, args.stage.as_deref(), &args.key, &window).await?;
    curves.retain(|curve| curve.total > 0);
    if curves.is_empty() {
        return Err(nothing(&run, &args));
    }
    if let Some(dir) = &args.tensorboard {
        write_events(&reader, &run, &curves, dir).await?;
    } else if args.csv {
        write_csv(&reader, &run, &curves).await?;
    } else if let Some(path) = &args.plot {
        draw(path, &run, axis, &curves)?;
        print::out(&format!("{}: {} of {run}", path.display(), counted(curves.len(), "curve")));
    } else {
        match args.output {
            Output::Json => print::json(&serde_json::json!({"schema_version": 1, "run": run, "series": curves})),
            Output::Table => print::out(&table(&curves)),
        }
    }
    reader.close().await;
    Ok(0)
}

fn nothing(run: &RunId, args: &MetricsArgs) -> Problem {
    let of = args.stage.as_ref().map(|stage| format!(" in stage `{stage}`")).unwrap_or_default();
    let named = if args.key.is_empty() { String::new() } else { format!(" named {}", args.key.join(", ")) };
    let problem = Problem::new(exit::NOT_FOUND, anyhow::anyhow!("run `{run}` has no recorded values{named}{of}"));
    problem.hint("`trainer metrics` without --stage and --key lists all values")
}

fn table(curves: &[CurveSeries]) -> String {
    let row = |curve: &CurveSeries| {
        let columns = &curve.columns;
        let number = |column: &[f64]| match column.last().filter(|value| !value.is_nan()) {
            Some(value) => print::number(*value),
            None => "-".to_owned(),
        };
        let step = columns.x.last().map(|step| format!("{step:.0}")).unwrap_or_default();
        let odd: u64 = columns.nan.iter().sum();
        let odd = if odd > 0 { odd.to_string() } else { String::new() };
        let (stage, key, count) = (curve.stage.to_string(), curve.key.clone(), curve.total.to_string());
        vec![stage, key, step, number(&columns.last), number(&columns.min), number(&columns.max), count, odd]
    };
    print::table(&["STAGE", "NAME", "STEP", "LAST", "MIN", "MAX", "VALUES", "NAN"], curves.iter().map(row).collect())
}

/// Prints every value, page by page.
async fn write_csv(reader: &Reader, run: &RunId, curves: &[CurveSeries]) -> Result<()> {
    print::line("stage,name,step,value");
    for curve in curves {
        let (stage, key) = (curve.stage.as_str(), curve.key.as_str());
        let head = format!("{},{}", field(stage), field(key));
        let mut page = Page { after: None, limit: protocol::limits::CURVE_POINTS };
        loop {
            let points = reader.points(run, stage, key, page).await?;
            let Some(last) = points.last() else { break };
            page.after = Some(last.step);
            let lines: Vec<String> = points.iter().map(|p| format!("{head},{},{}", p.step, p.value)).collect();
            print::out(&lines.join("\n"));
        }
    }
    Ok(())
}

/// Writes every value to an event file of its stage.
async fn write_events(reader: &Reader, run: &RunId, curves: &[CurveSeries], dir: &Path) -> Result<()> {
    let stages: BTreeSet<&str> = curves.iter().map(|curve| curve.stage.as_str()).collect();
    for stage in stages {
        let folder = dir.join(run.as_str()).join(stage);
        let path = folder.join("events.out.tfevents.0.stride");
        let failed = |error: std::io::Error| Problem::usage(format!("cannot write `{}`: {error}", path.display()));
        std::fs::create_dir_all(&folder).map_err(failed)?;
        let out = std::io::BufWriter::new(std::fs::File::create(&path).map_err(failed)?);
        let mut file = None;
        let mut out = Some(out);
        for curve in curves.iter().filter(|curve| curve.stage.as_str() == stage) {
            let times = times(reader, run, curve).await?;
            let mut page = Page { after: None, limit: protocol::limits::CURVE_POINTS };
            loop {
                let points = reader.points(run, stage, &curve.key, page).await?;
                let Some(last) = points.last() else { break };
                page.after = Some(last.step);
                for point in &points {
                    let wall_s = time_of(&times, point.step as f64) / 1000.0;
                    if let Some(out) = out.take() {
                        file = Some(EventFile::new(out, wall_s).map_err(failed)?);
                    }
                    if let Some(file) = &mut file {
                        file.scalar(&curve.key, point.step, wall_s, point.value).map_err(failed)?;
                    }
                }
            }
        }
        if let Some(file) = file {
            file.finish().map_err(failed)?;
        }
        print::note(&format!("wrote {}", path.display()));
    }
    Ok(())
}

/// Steps of a curve with their times in milliseconds since 1970, in order.
async fn times(reader: &Reader, run: &RunId, curve: &CurveSeries) -> Result<Vec<(f64, f64)>> {
    let keys = [curve.key.clone()];
    let mut columns = Vec::new();
    for axis in [Axis::Step, Axis::Time] {
        let window = Window { axis, from: None, to: None, buckets: protocol::limits::CURVE_BUCKETS };
        let drawn = reader.curves(run, Some(curve.stage.as_str()), &keys, &window).await?;
        columns.push(drawn.into_iter().next().map(|curve| curve.columns.x).unwrap_or_default());
    }
    let [steps, times]: [Vec<f64>; 2] = columns.try_into().unwrap_or_default();
    Ok(if steps.len() == times.len() { steps.into_iter().zip(times).collect() } else { Vec::new() })
}

/// The time of a step, on the line between its neighbours.
fn time_of(times: &[(f64, f64)], step: f64) -> f64 {
    let after = times.partition_point(|(known, _)| *known < step);
    match (after.checked_sub(1).and_then(|before| times.get(before)), times.get(after)) {
        (Some((x0, y0)), Some((x1, y1))) if x1 > x0 => y0 + (y1 - y0) * (step - x0) / (x1 - x0),
        (_, Some((_, time))) | (Some((_, time)), None) => *time,
        (None, None) => 0.0,
    }
}

/// Escapes a text for CSV.
fn field(text: &str) -> String {
    if text.contains([',', '"', '\n', '\r']) { format!("\"{}\"", text.replace('"', "\"\"")) } else { text.to_owned() }
}

fn draw(path: &Path, run: &RunId, axis: Axis, curves: &[CurveSeries]) -> Result<()> {
    let picture = figure::svg(&format!("run {run}"), &panels(axis, curves));
    std::fs::write(path, picture).map_err(|error| Problem::usage(format!("cannot write `{}`: {error}", path.display())))
}

/// A panel for each key, with a line for each stage.
fn panels(axis: Axis, curves: &[CurveSeries]) -> Vec<Panel> {
    let x = if axis == Axis::Hours { "hours" } else { "step" };
    let stages: BTreeSet<&str> = curves.iter().map(|curve| curve.stage.as_str()).collect();
    let mut panels: BTreeMap<&str, Panel> = BTreeMap::new();
    for curve in curves {
        let panel = panels.entry(&curve.key).or_insert_with(|| Panel {
            x: x.to_owned(),
            y: curve.key.clone(),
            // The same lines in the same colours in all panels.
            lines: stages.iter().map(|stage| ((*stage).to_owned(), Vec::new())).collect(),
            ..Panel::default()
        });
        let columns = &curve.columns;
        let stage = curve.stage.to_string();
        let ends = columns.min.iter().zip(&columns.max);
        let band = columns.x.iter().zip(ends).map(|(x, (low, high))| (*x, *low, *high)).collect();
        panel.lines.insert(stage.clone(), columns.x.iter().copied().zip(columns.mean.iter().copied()).collect());
        panel.bands.insert(stage, band);
        panel.odd.extend(columns.x.iter().zip(&columns.nan).filter(|(_, nan)| **nan > 0).map(|(x, _)| *x));
    }
    panels.into_values().collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use registry::Buckets;

    fn curve(stage: &str, key: &str) -> CurveSeries {
        let columns = Buckets {
            x: vec![1.0, 2.0],
            min: vec![0.5, f64::NAN],
            max: vec![1.5, f64::NAN],
            mean: vec![1.0, f64::NAN],
            last: vec![0.75, f64::NAN],
            count: vec![2, 3],
            nan: vec![0, 3],
        };
        CurveSeries { run: "r".into(), stage: stage.into(), key: key.into(), total: 5, columns }
    }

    #[test]
    fn a_panel_is_a_value_and_a_line_a_stage() {
        let panels = panels(Axis::Step, &[curve("vae", "loss"), curve("mld", "loss"), curve("vae", "kl")]);
        assert_eq!(panels.iter().map(|panel| panel.y.as_str()).collect::<Vec<_>>(), ["kl", "loss"]);
        assert!(panels.iter().all(|panel| panel.lines.len() == 2), "colours are the stages' in all panels");
        assert_eq!(panels[1].odd, [2.0, 2.0]);
        let picture = figure::svg("r", &panels);
        assert_eq!((picture.matches("<polygon").count(), picture.contains("NaN")), (3, false));
    }

    #[test]
    fn a_step_has_the_time_between_its_neighbours() {
        let times = [(10.0, 1000.0), (20.0, 3000.0)];
        let of = |step| time_of(&times, step);
        assert_eq!([of(0.0), of(10.0), of(15.0), of(20.0), of(99.0)], [1000.0, 1000.0, 2000.0, 3000.0, 3000.0]);
        assert_eq!(time_of(&[], 1.0), 0.0);
    }

    #[test]
    fn a_table_marks_what_is_no_number_and_csv_quotes_what_must_be() {
        let table = table(&[curve("vae", "loss")]);
        let row: Vec<&str> = table.lines().last().into_iter().flat_map(str::split_whitespace).collect();
        assert_eq!(row, ["vae", "loss", "2", "-", "-", "-", "5", "3"]);
        assert_eq!(field("a,\"b\""), "\"a,\"\"b\"\"\"");
        assert_eq!(field("loss"), "loss");
    }
}
