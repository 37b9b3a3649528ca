//! The rules of `sweep:`. Every value of a choice and both ends of a range are checked as values of the stage.

use protocol::limits;
use protocol::spelling::nearest;
use protocol::stage::{Placement, StageSettings};
use protocol::sweep::{self, Domain, MAX_TRIALS, Rungs, SearchKind, Sweep, Values, evaluated_field};
use protocol::{ArtifactKind, StageName, Steps};
use serde_json::Value;

use crate::definition::PipelineStage;
use crate::graph::{self, ByStage};
use crate::rules::{self, Problem, Problems};
use crate::schema::list_keys;
use crate::trial_values::trial_settings;

/// Checks a stage's sweep without other stages.
pub(crate) fn rules(stage: &PipelineStage) -> Vec<Problem> {
    let mut problems = Problems::default();
    let (p, Some(sweep)) = (&mut problems, &stage.sweep) else { return problems.0 };
    let Some(training) = stage.settings.training() else {
        p.add(
            "sweep",
            format!("`{}` does not train; only a training stage can have a sweep", stage.settings.kind()),
            "",
        );
        return problems.0;
    };
    space_rules(p, stage, sweep);
    if evaluated_field(&sweep.evaluate, stage.settings.output().kind).is_none()
        || sweep.evaluate.output().kind != ArtifactKind::Report
    {
        let evaluation = sweep.evaluate.kind();
        let gives = stage.settings.output().kind.noun();
        p.add("sweep.evaluate", format!("`{evaluation}` does not measure {gives}"), "");
    }
    if !p.0.is_empty() {
        return problems.0;
    }
    metric_rules(p, sweep);
    search_rules(p, sweep);
    rung_rules(p, sweep, training.steps);
    value_rules(p, stage, sweep);
    // Problems of the stage's placement are reported there.
    p.0.extend(rules::stage(&sweep.evaluate, &Placement::default()).into_iter().map(in_evaluation));
    problems.0
}

/// Checks that the evaluation gives the metric.
fn metric_rules(p: &mut Problems, sweep: &Sweep) {
    if sweep.metric.trim().is_empty() {
        p.add("sweep.metric", "`metric` is missing; set it to the value of `evaluate` that ranks the trials", "");
    }
    if let Some(given) = sweep.evaluate.metrics()
        && !sweep.metric.trim().is_empty()
        && !given.contains(&sweep.metric)
    {
        let message =
            format!("`{}` does not report `{}`, the metric that ranks the trials", sweep.evaluate.kind(), sweep.metric);
        let names = given.iter().filter(|name| !name.ends_with(".lower") && !name.ends_with(".upper"));
        let near = nearest(&sweep.metric, names.clone().map(String::as_str));
        let meant = near.map(|near| format!("did you mean `{near}`? ")).unwrap_or_default();
        let help = format!("{meant}use one of {}", list_keys(names.map(String::as_str)));
        p.add("sweep.metric", message, &help);
    }
}

/// Checks that the search method fits the space and the number of trials.
fn search_rules(p: &mut Problems, sweep: &Sweep) {
    if !(1..=1000).contains(&sweep.parallel) {
        p.add("sweep.parallel", format!("`parallel` is {}; expected 1 to 1000", sweep.parallel), "");
    }
    match (sweep.search, sweep.points()) {
        (SearchKind::Grid, None) => {
            let ranges = sweep.space.iter().filter(|(_, domain)| !matches!(domain, Domain::Choice(_)));
            for (path, _) in ranges {
                let message = format!("`{path}` is a range, but a grid needs a list of values");
                p.add(
                    &format!("sweep.space.{path}"),
                    message,
                    "list values with `choice`, or search with `random` or `asha`",
                );
            }
        }
        (SearchKind::Grid, Some(points)) => {
            if sweep.trials != 0 && sweep.trials != points {
                let message = format!("`trials` is {}, but the grid has {points} points", sweep.trials);
                p.add("sweep.trials", message, "remove `trials`, or search with `random`");
            }
            if points > MAX_TRIALS {
                p.add("sweep.space", format!("the grid has {points} points; expected at most {MAX_TRIALS}"), "");
            }
        }
        (SearchKind::Random | SearchKind::Asha, _) => {
            if !(1..=MAX_TRIALS).contains(&sweep.trials) {
                let message = format!("`trials` is {}; expected 1 to {MAX_TRIALS}", sweep.trials);
                p.add("sweep.trials", message, "set it to the number of points to try");
            }
        }
    }
}

/// Checks the budgets at which trials are compared; `steps` are those of the whole training.
fn rung_rules(p: &mut Problems, sweep: &Sweep, steps: Steps) {
    if sweep.search == SearchKind::Asha {
        let Rungs { first, factor } = sweep.rungs;
        if first.0 == 0 || first >= steps {
            let message =
                format!("`rungs.first` is {first}; expected fewer steps than the stage's {steps}, and at least 1");
            p.add("sweep.rungs.first", message, "trials are first compared after this number of steps");
        }
        if !(2..=1000).contains(&factor) {
            p.add("sweep.rungs.factor", format!("`rungs.factor` is {factor}; expected 2 to 1000"), "");
        }
    } else if sweep.rungs != Rungs::default() {
        let message = format!("only `asha` has `rungs`; with `{}`, every trial trains to the end", sweep.search.name());
        p.add("sweep.rungs", message, "remove `rungs`");
    }
}

/// Checks every value of a choice and both ends of a range as a value of the stage.
fn value_rules(p: &mut Problems, stage: &PipelineStage, sweep: &Sweep) {
    for (path, domain) in &sweep.space {
        let field = format!("sweep.space.{path}");
        let whole = sweep.setting(&stage.settings, path).is_some_and(|value| value.is_number() && !value.is_f64());
        for (at, value) in tried(domain, whole) {
            let at = format!("{field}{at}");
            let problem = match trial_settings(sweep, &stage.settings, &Values::from([(path.clone(), value.clone())])) {
                Ok(_) => None,
                // Problems of the stage itself are reported there, and those of its evaluation below.
                Err(_) if !rules::stage(&stage.settings, &stage.placement).is_empty() => None,
                Err(_) if !rules::stage(&sweep.evaluate, &Placement::default()).is_empty() => None,
                Err(problem) => Some(problem),
            };
            if let Some(problem) = problem {
                p.add(&at, format!("with `{path}` at {value}: {problem}"), "");
            }
        }
    }
}

/// Checks a sweep that arrived as JSON as the reader does: each path is a searchable setting, each domain has values.
fn space_rules(p: &mut Problems, stage: &PipelineStage, sweep: &Sweep) {
    let settings = sweep.space.len();
    if !(1..=limits::SWEPT_SETTINGS).contains(&settings) {
        let message = format!("`space` has {settings} settings; expected 1 to {}", limits::SWEPT_SETTINGS);
        p.add("sweep.space", message, "");
    }
    if sweep.metric.len() > limits::KEY_BYTES || sweep.metric.contains(char::is_control) {
        p.add("sweep.metric", "`metric` is not a valid metric name", "expected a name such as `latent_fid`");
    }
    let references = |settings: &StageSettings| -> Vec<String> {
        settings.clone().refs().into_iter().map(|reference| reference.field.into_owned()).collect()
    };
    let of_stage = references(&stage.settings);
    let of_evaluation = references(&sweep.evaluate);
    for (path, domain) in &sweep.space {
        let field = format!("sweep.space.{path}");
        let found = sweep.setting(&stage.settings, path).filter(|value| !value.is_object());
        let (own, references) = match sweep::in_evaluation(path) {
            Some(path) => (path, &of_evaluation),
            None => (&path[..], &of_stage),
        };
        if found.is_none() || own == "kind" || own == "steps" || references.iter().any(|field| field == own) {
            p.add(&field, format!("`{}` cannot be searched", path.escape_debug()), "");
            continue;
        }
        let sound = match domain {
            Domain::Choice(values) => (1..=limits::SWEPT_VALUES).contains(&values.len()),
            Domain::Uniform(low, high) => low < high && low.is_finite() && high.is_finite(),
            Domain::LogUniform(low, high) => 0.0 < *low && low < high && high.is_finite(),
        };
        if !sound {
            p.add(&field, format!("`{path}` has no values to try, or more than {}", limits::SWEPT_VALUES), "");
        }
    }
}

/// Values of a domain that are checked before anything runs, with their places below it.
fn tried(domain: &Domain, whole: bool) -> Vec<(String, Value)> {
    let end = |value: f64| if whole { Value::from(value as u64) } else { Value::from(value) };
    match domain {
        Domain::Choice(values) => {
            values.iter().enumerate().map(|(i, value)| (format!(".choice[{i}]"), value.clone())).collect()
        }
        Domain::Uniform(low, high) => vec![(".uniform[0]".into(), end(*low)), (".uniform[1]".into(), end(*high))],
        Domain::LogUniform(low, high) => {
            vec![(".log_uniform[0]".into(), end(*low)), (".log_uniform[1]".into(), end(*high))]
        }
    }
}

fn in_evaluation(problem: Problem) -> Problem {
    Problem { field: format!("sweep.evaluate.{}", problem.field), ..problem }
}

/// Checks that trials and their evaluations agree with the other stages, value by value. Called once the stages
/// themselves do.
pub(crate) fn check_agreement(stages: &[PipelineStage], found: &mut ByStage) {
    for (i, stage) in stages.iter().enumerate() {
        let Some(sweep) = &stage.sweep else { continue };
        let evaluation_name = StageName::new(format!("{}.eval", stage.name));
        let evaluation = PipelineStage {
            name: evaluation_name.clone(),
            settings: (*sweep.evaluate).clone(),
            inputs: graph::references(&sweep.evaluate),
            sweep: None,
            ..stage.clone()
        };
        let mut all = stages.to_vec();
        all.push(evaluation);
        let mut problems = ByStage::new();
        graph::check_agreement(&all, &mut problems);
        if let Some(wrong) = problems.remove(&evaluation_name).filter(|wrong| !wrong.0.is_empty()) {
            found.entry(stage.name.clone()).or_default().0.extend(wrong.0.into_iter().map(in_evaluation));
            continue;
        }
        for (path, domain) in &sweep.space {
            let Domain::Choice(values) = domain else { continue };
            for (at, value) in values.iter().enumerate() {
                let values = Values::from([(path.clone(), value.clone())]);
                let Ok((settings, evaluation)) = trial_settings(sweep, &stage.settings, &values) else { continue };
                all[i].settings = settings;
                all[stages.len()].settings = evaluation;
                let mut problems = ByStage::new();
                graph::check_agreement(&all, &mut problems);
                if let Some((other, problem)) =
                    problems.into_iter().find_map(|(name, wrong)| Some((name, wrong.0.into_iter().next()?)))
                {
                    let field = format!("sweep.space.{path}.choice[{at}]");
                    let message =
                        format!("with `{path}` at {value}, stage `{other}` does not fit: {}", problem.message);
                    found.entry(stage.name.clone()).or_default().add(&field, message, "");
                }
            }
        }
    }
}
