//! Text with numbers of a run. A template's places in double braces are filled from the run's JSON
//! (`trainer run -o json`) and its settings (`trainer config show -o json`). A number is rounded once, here.
//!
//! | place | value |
//! |---|---|
//! | `{{STAGE METRIC}}` | the value, with `±` half of its 95 % interval, or its standard deviation over sampling seeds, if the run has one |
//! | `{{NAME_* METRIC}}` | mean ± standard deviation (n - 1) over the stages `NAME_1`, `NAME_2`, ...: trainings from other random draws |
//! | `{{A METRIC / B METRIC}}` | the ratio; with `*` in both, of those with one number, then mean ± standard deviation |
//! | `{{A METRIC - B METRIC}}` | the difference, as the ratio |
//! | `{{mean ...}}` | any of these with `*`: `±` is half of the 95 % interval of the mean, by Student's distribution |
//! | `{{verdict A METRIC - B METRIC}}` | `lower` or `higher` if that interval of the difference excludes 0, else `no difference shown` |
//! | `{{bare ...}}` | any of these without `±` |
//! | `{{... :N}}` | with N decimals, 3 otherwise |
//! | `{{set STAGE PATH}}` | a setting |
//! | `{{... METRIC}}` | a space in the metric's name is written `_` |

use registry::leaderboard::Measure;
use serde_json::Value;

/// Default number of decimals.
const DECIMALS: usize = 3;

/// Data to fill a template from.
#[derive(Debug)]
pub struct Source {
    /// Output of `trainer run -o json`.
    pub run: Value,
    /// Output of `trainer config show -o json`.
    pub pipeline: Value,
}

/// A value with its uncertainty.
struct Number {
    value: f64,
    spread: Option<f64>,
    /// The mean of several trainings.
    mean: Option<Measure>,
}

impl Number {
    fn once(value: f64, spread: Option<f64>) -> Self {
        Self { value, spread, mean: None }
    }

    /// Half of the 95 % interval of the mean of several trainings.
    fn half(&self) -> Result<f64, String> {
        self.mean
            .and_then(|mean| mean.half)
            .ok_or_else(|| "only several trainings have a mean; name them with `*`".into())
    }

    /// The sign of a difference, if its interval excludes zero.
    fn verdict(&self) -> Result<&'static str, String> {
        let half = self.half()?;
        Ok(match self.value {
            value if value < -half => "lower",
            value if value > half => "higher",
            _ => "no difference shown",
        })
    }
}

/// Fills the places of a template.
///
/// # Errors
/// The first place that cannot be filled, with its line.
pub fn render(template: &str, source: &Source) -> Result<String, String> {
    let mut text = String::with_capacity(template.len());
    for (i, line) in template.lines().enumerate() {
        let mut rest = line;
        while let Some((before, after)) = rest.split_once("{{") {
            let wrong = |why: String| format!("line {}: `{line}`: {why}", i + 1);
            let (place, after) = after.split_once("}}").ok_or_else(|| wrong("a place has no end".into()))?;
            text.push_str(before);
            text.push_str(&fill(place, source).map_err(|why| wrong(format!("`{{{{{place}}}}}`: {why}")))?);
            rest = after;
        }
        text.push_str(rest);
        text.push('\n');
    }
    Ok(text)
}

fn fill(place: &str, source: &Source) -> Result<String, String> {
    let mut words: Vec<&str> = place.split_whitespace().collect();
    let decimals = match words.last().and_then(|word| word.strip_prefix(':')) {
        Some(number) => {
            words.pop();
            number.parse().map_err(|_| format!("`:{number}` is no number of decimals"))?
        }
        None => DECIMALS,
    };
    let form = words.first().copied().filter(|word| ["bare", "mean"].contains(word));
    words.drain(..usize::from(form.is_some()));
    let number = match words[..] {
        ["set", stage, path] => return setting(source, stage, path),
        [stage, metric] => value(source, stage, metric)?,
        [a, of_a, "/", b, of_b] => paired(source, (a, of_a), (b, of_b), |a, b| a / b)?,
        [a, of_a, "-", b, of_b] => paired(source, (a, of_a), (b, of_b), |a, b| a - b)?,
        ["verdict", a, of_a, "-", b, of_b] => {
            return Ok(paired(source, (a, of_a), (b, of_b), |a, b| a - b)?.verdict()?.to_owned());
        }
        _ => return Err("expected such as `STAGE METRIC`".into()),
    };
    let spread = match form {
        None => number.spread,
        Some("mean") => Some(number.half()?),
        Some(_) => None,
    };
    let value = number.value;
    Ok(match spread {
        Some(spread) => format!("{value:.decimals$} ± {spread:.decimals$}"),
        None => format!("{value:.decimals$}"),
    })
}

fn setting(source: &Source, stage: &str, path: &str) -> Result<String, String> {
    let stages = source.pipeline["stages"].as_array().ok_or("the pipeline has no stages")?;
    let found = stages.iter().find(|one| one["name"] == stage).ok_or_else(|| format!("no stage `{stage}`"))?;
    // Settings are beside the name or below it.
    let under = [&found["settings"], found].into_iter();
    let mut values = under.map(|settings| path.split('.').fold(settings, |value, key| &value[key]));
    match values.find(|value| !value.is_null()) {
        Some(Value::String(text)) => Ok(text.clone()),
        Some(value) => Ok(value.to_string()),
        None => Err(format!("`{stage}` has no setting `{path}`")),
    }
}

/// The metrics of the stages that match `name`, each with the part that its `*` matches.
fn stages<'a>(source: &'a Source, name: &str) -> Result<Vec<(String, &'a Value)>, String> {
    let all = source.run["stages"].as_array().ok_or("the run has no stages")?;
    let (before, after) = name.split_once('*').unwrap_or((name, ""));
    let matching = all.iter().filter_map(|stage| {
        let own = stage["name"].as_str()?;
        let number = own.strip_prefix(before)?.strip_suffix(after)?;
        let fits = if name.contains('*') { number.parse::<u32>().is_ok() } else { number.is_empty() };
        fits.then(|| (number.to_owned(), &stage["metrics"]))
    });
    let found: Vec<_> = matching.collect();
    if found.is_empty() { Err(format!("no stage `{name}`")) } else { Ok(found) }
}

fn one(metrics: &Value, name: &str, metric: &str) -> Result<f64, String> {
    let spaced = |metrics: &Value| {
        let all = metrics.as_object()?;
        all.iter().find(|(own, _)| own.contains(' ') && own.replace(' ', "_") == metric)?.1.as_f64()
    };
    metrics[metric].as_f64().or_else(|| spaced(metrics)).ok_or_else(|| {
        let have: Vec<&String> = metrics.as_object().into_iter().flat_map(|map| map.keys()).collect();
        format!("`{name}` has no `{metric}`; it has {have:?}")
    })
}

fn value(source: &Source, name: &str, metric: &str) -> Result<Number, String> {
    let found = stages(source, name)?;
    if name.contains('*') {
        let values = found.iter().map(|(_, metrics)| one(metrics, name, metric)).collect::<Result<Vec<_>, _>>()?;
        return Ok(of_seeds(&values));
    }
    let metrics = found[0].1;
    let value = one(metrics, name, metric)?;
    let interval = metrics[format!("{metric}.upper")].as_f64().map(|upper| upper - value);
    let spread = interval.or_else(|| metrics[format!("{metric}_sd")].as_f64());
    Ok(Number::once(value, spread))
}

/// Combines values of trainings with one number.
fn paired(
    source: &Source,
    (a, of_a): (&str, &str),
    (b, of_b): (&str, &str),
    combine: impl Fn(f64, f64) -> f64,
) -> Result<Number, String> {
    let (over, under) = (stages(source, a)?, stages(source, b)?);
    let pair = |(number, metrics): &(String, &Value)| -> Result<f64, String> {
        let other = under.iter().find(|(of, _)| of == number || under.len() == 1);
        let (_, other) = other.ok_or_else(|| format!("`{b}` has no number {number}"))?;
        Ok(combine(one(metrics, a, of_a)?, one(other, b, of_b)?))
    };
    let values = over.iter().map(pair).collect::<Result<Vec<_>, _>>()?;
    Ok(of_seeds(&values))
}

/// Mean and standard deviation; a single value has no deviation.
fn of_seeds(values: &[f64]) -> Number {
    let n = values.len() as f64;
    let mean = values.iter().sum::<f64>() / n;
    let squares: f64 = values.iter().map(|value| (value - mean).powi(2)).sum();
    let spread = (values.len() > 1).then(|| (squares / (n - 1.0)).sqrt());
    Number { value: mean, spread, mean: Measure::of_trainings(values) }
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;

    fn source() -> Source {
        let run = json!({"stages": [
            {"name": "a_1", "metrics": {"fid": 1.0, "fid.lower": 0.5, "fid.upper": 1.5, "x": 4.3448}},
            {"name": "a_2", "metrics": {"fid": 3.0, "x": 1.0, "x_sd": 0.25}},
            {"name": "b_1", "metrics": {"fid": 2.0}},
            {"name": "b_2", "metrics": {"fid": 3.0}},
            {"name": "other", "metrics": {"fid": 9.0, "share/left hand": 0.75}},
            {"name": "far_1", "metrics": {"fid": 9.0}},
            {"name": "far_2", "metrics": {"fid": 11.25}},
        ]});
        let pipeline = json!({"stages": [{"name": "a_1", "settings": {"steps": 12, "batch": {"global": 8}}}]});
        Source { run, pipeline }
    }

    #[test]
    fn places_are_filled_and_rounded_once() {
        let filled = |place: &str| render(place, &source()).map(|text| text.trim_end().to_owned());
        assert_eq!(filled("{{a_1 fid :1}} and {{bare a_1 fid :1}}").unwrap(), "1.0 ± 0.5 and 1.0");
        assert_eq!(filled("{{a_1 x :2}} {{a_2 x}}").unwrap(), "4.34 1.000 ± 0.250");
        assert_eq!(filled("| {{a_* fid :2}} |").unwrap(), "| 2.00 ± 1.41 |");
        assert_eq!(filled("{{bare a_* fid / b_* fid :2}}").unwrap(), "0.75");
        assert_eq!(filled("{{a_1 fid / other fid}}").unwrap(), "0.111");
        assert_eq!(filled("{{other share/left_hand :2}}").unwrap(), "0.75");
        // Two differences with a standard deviation of .177; 12.706 for one degree of freedom.
        assert_eq!(filled("{{mean far_* fid - a_* fid :2}}").unwrap(), "8.12 ± 1.59");
        assert_eq!(filled("{{verdict far_* fid - a_* fid}}").unwrap(), "higher");
        assert_eq!(filled("{{verdict a_* fid - far_* fid}}").unwrap(), "lower");
        assert_eq!(filled("{{verdict a_* fid - b_* fid}}").unwrap(), "no difference shown");
        assert_eq!(filled("{{set a_1 steps}} of {{set a_1 batch.global}}").unwrap(), "12 of 8");
        for (place, part) in [
            ("one\n{{c fid}}", "line 2: `{{c fid}}`: `{{c fid}}`: no stage `c`"),
            ("{{a_1 fdi}}", "`a_1` has no `fdi`"),
            ("{{a_1}}", "STAGE METRIC"),
            ("{{mean a_1 fid}}", "several trainings"),
            ("{{verdict a_1 fid - b_1 fid}}", "several trainings"),
            ("{{a_1 fid", "no end"),
            ("{{set a_1 stepps}}", "no setting `stepps`"),
            ("{{a_1 fid :x}}", "no number of decimals"),
        ] {
            let refused = filled(place).expect_err(place);
            assert!(refused.contains(part), "{place}: {refused}");
        }
    }
}
