//! `trainer sweep`: the trials of a sweep, their results, and the best one.

use std::path::{Path, PathBuf};

use clap::{Args, Subcommand};
use protocol::message::{RunView, SweepView, TrialState, TrialView};
use protocol::stage::Mode;
use protocol::sweep::in_evaluation;
use serde_json::{Value, json};

use crate::client::Target;
use crate::local::pipeline_file;
use crate::reader::Reader;
use crate::report::print::{self, Output};
use crate::report::problem::{Problem, Result, exit};
use crate::report::summary;
use crate::report::sweep_plot::{self, By};

#[derive(Debug, Subcommand)]
pub(crate) enum SweepVerb {
    /// Shows the trials of a sweep, best first
    #[command(after_help = "Example:\n  trainer sweep status @last")]
    Status(StatusArgs),
    /// Shows the best trial, and how to train it alone
    #[command(after_help = "Example:\n  trainer sweep best @last")]
    Best(BestArgs),
}

impl SweepVerb {
    pub(super) fn output(&self) -> Output {
        match self {
            Self::Status(args) => args.which.output,
            Self::Best(args) => args.which.output,
        }
    }
}

/// Selection of a sweep.
#[derive(Debug, Args)]
pub(crate) struct Which {
    /// The run, a unique beginning of its name, `@last`, or a pipeline's file: its newest run
    #[arg(default_value = "@last", value_name = "RUN|PIPELINE")]
    run: String,
    /// Only the sweep of this stage
    #[arg(long)]
    stage: Option<String>,
    #[command(flatten)]
    target: Target,
    /// Format of the answer
    #[arg(short, long, value_enum, default_value_t)]
    output: Output,
}

#[derive(Debug, Args)]
pub(crate) struct StatusArgs {
    #[command(flatten)]
    which: Which,
    /// Draws the trials, an SVG file
    #[arg(long, value_name = "FILE.svg")]
    plot: Option<PathBuf>,
    /// Horizontal axis: a searched setting, `seconds` of their evaluation, or `steps` [default: the only searched
    /// number, or the steps]
    #[arg(long, value_name = "SETTING", requires = "plot")]
    by: Option<String>,
    /// Metrics of the evaluation to draw, one panel each [default: the one that decides]
    #[arg(long, value_name = "NAME", value_delimiter = ',', requires = "plot")]
    metric: Vec<String>,
}

#[derive(Debug, Args)]
pub(crate) struct BestArgs {
    #[command(flatten)]
    which: Which,
}

pub(crate) async fn sweep(verb: SweepVerb) -> Result<u8> {
    match verb {
        SweepVerb::Status(args) => status(args).await,
        SweepVerb::Best(args) => best(args).await,
    }
}

async fn status(args: StatusArgs) -> Result<u8> {
    if let Some(path) = &args.plot {
        if path.extension().is_none_or(|extension| extension != "svg") {
            return Err(Problem::usage(format!(
                "cannot write `{}`; expected a file name that ends in .svg",
                path.display()
            )));
        }
        super::remote::check_parent(path)?;
    }
    let (run, sweeps) = find(&args.which).await?;
    if let Some(path) = &args.plot {
        let [sweep] = sweeps.as_slice() else {
            let names: Vec<&str> = sweeps.iter().map(|sweep| sweep.stage.as_str()).collect();
            let problem = Problem::usage(format!("run `{}` has {} sweeps: {}", run.run, names.len(), names.join(", ")));
            return Err(problem.hint("select one with --stage"));
        };
        let by = match &args.by {
            Some(name) => By::named(name, sweep).map_err(Problem::usage)?,
            None => By::usual(sweep),
        };
        let picture = match (&by, args.metric.is_empty()) {
            (By::Steps, true) => sweep_plot::svg(sweep),
            (_, decides) => {
                let metrics = if decides { vec![sweep.metric.clone()] } else { args.metric.clone() };
                sweep_plot::curves(&run, sweep, &by, &metrics).map_err(Problem::usage)?
            }
        };
        std::fs::write(path, picture)
            .map_err(|error| Problem::usage(format!("cannot write `{}`: {error}", path.display())))?;
    }
    match args.which.output {
        Output::Json => {
            let state = summary::run_state(&run);
            print::json(&json!({"schema_version": 1, "run": run.run, "state": state, "sweeps": sweeps}));
        }
        Output::Table => {
            for sweep in &sweeps {
                print::out(&format!("{}\n", table(sweep)));
                print::out(&summary::sweep_line(sweep));
            }
        }
    }
    Ok(0)
}

async fn best(args: BestArgs) -> Result<u8> {
    let (run, sweeps) = find(&args.which).await?;
    let mut found = Vec::new();
    for sweep in &sweeps {
        let best = sweep.best.and_then(|best| sweep.trials.get(best)).ok_or_else(|| {
            let message = format!("no trial of the sweep of `{}` is fully trained", sweep.stage);
            Problem::new(exit::NOT_FOUND, anyhow::anyhow!("{message}"))
                .hint("`trainer sweep status` shows their progress")
        })?;
        found.push((sweep, best));
    }
    match args.which.output {
        Output::Json => {
            let one = |(sweep, best): &(&SweepView, &TrialView)| {
                let value = best.results.last();
                json!({"stage": sweep.stage, "metric": sweep.metric, "value": value, "trial": best.trial, "values": best.values, "over": sweep.over})
            };
            let best: Vec<Value> = found.iter().map(one).collect();
            print::json(&json!({"schema_version": 1, "run": run.run, "best": best}));
        }
        Output::Table => {
            for (sweep, best) in found {
                print::out(&summary::sweep_line(sweep));
                let own = best.values.iter().filter(|(path, _)| in_evaluation(path).is_none());
                let sets = own.map(|(path, value)| format!(" --set {}.{path}={value}", sweep.stage));
                print::out(&format!("to train only this trial, remove the sweep and use:{}", sets.collect::<String>()));
            }
        }
    }
    Ok(0)
}

/// Finds the selected run and its sweeps.
async fn find(which: &Which) -> Result<(RunView, Vec<SweepView>)> {
    let is_file = which.run.ends_with(".yaml") || which.run.ends_with(".yml");
    let pipeline = is_file.then(|| pipeline_file::read(Path::new(&which.run), &[])).transpose()?;
    let reader = Reader::open(&which.target).await?;
    let run = match &pipeline {
        None => reader.find(&which.run).await,
        Some(file) => {
            let name = &file.pipeline.name;
            let newest = reader.newest(Some(name)).await;
            newest.and_then(|newest| {
                newest.ok_or_else(|| {
                    let problem =
                        Problem::new(exit::NOT_FOUND, anyhow::anyhow!("pipeline `{name}` was never run here"));
                    problem.hint(format!("`trainer run {}` runs it", which.run))
                })
            })
        }
    };
    reader.close().await;
    let run = run?;
    let wanted = |sweep: &&SweepView| which.stage.as_deref().is_none_or(|stage| sweep.stage.as_str() == stage);
    let sweeps: Vec<SweepView> = run.sweeps.iter().filter(wanted).cloned().collect();
    if sweeps.is_empty() {
        let of = which.stage.as_ref().map(|stage| format!(" of stage `{stage}`")).unwrap_or_default();
        let problem = Problem::new(exit::NOT_FOUND, anyhow::anyhow!("no sweep{of} of run `{}` has started", run.run));
        return Err(problem.hint("a stage with `sweep:` starts when its inputs are ready"));
    }
    Ok((run, sweeps))
}

/// The trials, best first. A trial that got further ranks above one that was stopped earlier.
fn table(sweep: &SweepView) -> String {
    let mut trials: Vec<&TrialView> = sweep.trials.iter().collect();
    let rank = |trial: &TrialView| {
        let value = trial.results.last().copied().flatten().filter(|value| value.is_finite());
        let loss = value.map_or(f64::INFINITY, |value| if sweep.mode == Mode::Min { value } else { -value });
        (trial.results.len() - usize::from(trial.state == TrialState::Failed), loss)
    };
    trials.sort_by(|a, b| {
        let (a, b) = (rank(a), rank(b));
        b.0.cmp(&a.0).then(a.1.total_cmp(&b.1))
    });
    let settings: Vec<&String> = sweep.trials.first().map(|trial| trial.values.keys().collect()).unwrap_or_default();
    let head = ["TRIAL".to_owned()]
        .into_iter()
        .chain(settings.iter().map(|path| path.to_uppercase()))
        .chain(["STATE".to_owned(), "STEPS".to_owned()])
        .chain(sweep.rungs.iter().map(|steps| format!("{} @{steps}", sweep.metric)));
    let head: Vec<String> = head.collect();
    let row = |trial: &&TrialView| {
        let best = if sweep.best == Some(trial.trial) { "*" } else { "" };
        let values = settings.iter().map(|path| trial.values.get(*path).map(Value::to_string).unwrap_or_default());
        let results = sweep.rungs.iter().enumerate().map(|(rung, _)| match trial.results.get(rung) {
            Some(Some(value)) => print::number(*value),
            Some(None) => "failed".to_owned(),
            None => String::new(),
        });
        [format!("{}{best}", trial.trial)]
            .into_iter()
            .chain(values)
            .chain([state(trial, sweep), trial.steps.to_string()])
            .chain(results)
            .collect()
    };
    let head: Vec<&str> = head.iter().map(String::as_str).collect();
    print::table(&head, trials.iter().map(row).collect())
}

fn state(trial: &TrialView, sweep: &SweepView) -> String {
    let at = |word: &str| match trial.results.len().checked_sub(1).and_then(|rung| sweep.rungs.get(rung)) {
        Some(steps) => format!("{word} at {steps}"),
        None => word.to_owned(),
    };
    match trial.state {
        TrialState::Waiting => "waiting".into(),
        TrialState::Running => "running".into(),
        TrialState::Paused => at("paused"),
        TrialState::Stopped => at("stopped"),
        TrialState::Finished => "finished".into(),
        TrialState::Failed => at("failed"),
    }
}

#[cfg(test)]
pub(crate) mod tests {
    use protocol::sweep::SearchKind;

    use super::*;

    pub(crate) fn sweep() -> SweepView {
        let trial = |trial: usize, state, results: &[Option<f64>]| TrialView {
            trial,
            values: [("adversarial".to_owned(), json!(0.1)), ("skip".to_owned(), json!(50 + trial))].into(),
            state,
            steps: 100 * results.len() as u64,
            results: results.to_vec(),
            message: None,
        };
        SweepView {
            stage: "pcm".into(),
            search: SearchKind::Asha,
            metric: "latent_fid".into(),
            mode: Mode::Min,
            rungs: vec![100, 300],
            over: true,
            spent: 600,
            planned: 600,
            full: 1200,
            best: Some(2),
            trials: vec![
                trial(0, TrialState::Stopped, &[Some(0.5)]),
                trial(1, TrialState::Failed, &[Some(0.1), None]),
                trial(2, TrialState::Finished, &[Some(0.4), Some(0.2)]),
                trial(3, TrialState::Stopped, &[Some(0.3)]),
            ],
        }
    }

    #[test]
    fn the_table_has_the_best_first_and_says_who_was_stopped_where() {
        let table = table(&sweep());
        let lines: Vec<Vec<&str>> = table.lines().map(|line| line.split_whitespace().collect()).collect();
        assert_eq!(lines[0][..4], ["TRIAL", "ADVERSARIAL", "SKIP", "STATE"], "{table}");
        assert_eq!(lines[1], ["2*", "0.1", "52", "finished", "200", "0.4000", "0.2000"], "{table}");
        let order: Vec<&str> = lines[1..].iter().map(|line| line[0]).collect();
        assert_eq!(order, ["2*", "3", "0", "1"], "{table}");
        assert!(table.contains("stopped at 100") && table.contains("failed at 300"), "{table}");
        let line = summary::sweep_line(&sweep());
        assert_eq!(
            line,
            "pcm: trial 2 is best, latent_fid 0.2000 with adversarial 0.1, skip 52; 4 trials, 600 of 1200 steps (50 %)"
        );
    }
}
