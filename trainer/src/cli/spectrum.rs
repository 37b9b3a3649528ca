//! A picture of the results of `evaluate.spectrum`: Free-T2M's figure 4, as a mean over motions.

use std::collections::BTreeMap;
use std::path::Path;

use protocol::message::{RunView, StageView};
use serde_json::Value;

use super::model;
use crate::reader::Reader;
use crate::report::figure::{self, Panel};
use crate::report::problem::{Problem, Result, exit};

/// Kind of the stages that are drawn.
const KIND: &str = "evaluate.spectrum";

/// Draws the stage `name` of a run, or its only stage of this kind.
pub(super) async fn draw(reader: &Reader, run: &RunView, name: Option<&str>, path: &Path) -> Result<()> {
    if path.extension().is_none_or(|extension| extension != "svg") {
        return Err(Problem::usage(format!(
            "cannot write `{}`; expected a file name that ends in .svg",
            path.display()
        )));
    }
    let ready = run.stages.iter().filter(|stage| stage.kind == KIND && stage.outputs.contains_key("report"));
    let found: Vec<&StageView> = ready.filter(|stage| name.is_none_or(|name| stage.name.as_str() == name)).collect();
    let [stage] = found[..] else {
        let names: Vec<&str> = found.iter().map(|stage| stage.name.as_str()).collect();
        let message = match names.is_empty() {
            true => format!("run `{}` has no finished stage of kind `{KIND}`", run.run),
            false => format!("run `{}` has several stages of kind `{KIND}`: {}", run.run, names.join(", ")),
        };
        let problem = Problem::new(exit::NOT_FOUND, anyhow::anyhow!("{message}"));
        return Err(problem.hint("select one with --stage"));
    };
    let report = model::report(reader, stage.outputs["report"]).await?;
    let title = format!("{} of {}", stage.name, run.run);
    std::fs::write(path, figure::svg(&title, &panels(&stage.metrics, &report["details"])))
        .map_err(|error| Problem::usage(format!("cannot write `{}`: {error}", path.display())))
}

/// Panels of energies and of settled shares, by band, over the steps.
fn panels(metrics: &BTreeMap<String, f64>, details: &Value) -> Vec<Panel> {
    let panel = |metric: &str, y: &str| {
        let mut lines: BTreeMap<String, Vec<(f64, f64)>> = BTreeMap::new();
        for (name, value) in metrics {
            let mut parts = name.split('/');
            let (found, band, step) = (parts.next(), number(parts.next()), number(parts.next()));
            if let (true, Some(band), Some(step)) = (found == Some(metric), band, step) {
                lines.entry(band_name(band, &details["bands_hz"])).or_default().push((step as f64, *value));
            }
        }
        lines.values_mut().for_each(|points| points.sort_by(|a, b| a.0.total_cmp(&b.0)));
        Panel { x: "denoising step".into(), y: y.into(), lines, ..Panel::default() }
    };
    vec![
        panel("energy", "energy, as a share of real motion's"),
        panel("settled", "settled, of the final motion's energy"),
    ]
}

fn number(text: Option<&str>) -> Option<usize> {
    text?.parse().ok()
}

/// `1: 0-0.5 Hz`; the band's number comes first, so that lines stay in order.
fn band_name(band: usize, ends: &Value) -> String {
    let end = |i: usize| ends.get(i).and_then(Value::as_f64);
    match (band.checked_sub(2).map_or(Some(0.0), end), band.checked_sub(1).and_then(end)) {
        (Some(from), Some(to)) => format!("{band}: {from}-{to} Hz"),
        (Some(from), None) => format!("{band}: over {from} Hz"),
        (None, _) => band.to_string(),
    }
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;

    #[test]
    fn bands_are_lines_and_steps_their_points() {
        let metrics = [
            ("energy/1/1", 0.5),
            ("energy/1/2", 1.0),
            ("energy/3/1", 0.1),
            ("settled/1/10", 1.0),
            ("settled/1/2", 0.2),
            ("fid", 1.0),
        ];
        let metrics = metrics.map(|(name, value)| (name.to_owned(), value)).into();
        let panels = panels(&metrics, &json!({"bands_hz": [0.5, 1.0]}));
        let names: Vec<&str> = panels[0].lines.keys().map(String::as_str).collect();
        assert_eq!(names, ["1: 0-0.5 Hz", "3: over 1 Hz"]);
        assert_eq!(panels[0].lines["1: 0-0.5 Hz"], [(1.0, 0.5), (2.0, 1.0)]);
        assert_eq!(panels[1].lines["1: 0-0.5 Hz"], [(2.0, 0.2), (10.0, 1.0)]);
    }
}
