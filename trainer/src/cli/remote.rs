//! Commands about runs: submit, status, logs, pause, cancel.

use std::path::{Path, PathBuf};
use std::time::Duration;

use clap::Args;
use protocol::message::{RunState, RunSummary, RunView, Submit};
use protocol::{Owner, StageName};

use super::args::{self, PipelineArgs};
use super::spectrum;
use crate::client::{Client, Target};
use crate::local::advice::advice;
use crate::local::pipeline_file;
use crate::reader::Reader;
use crate::report::print::{self, Output};
use crate::report::problem::{Problem, Result, exit};
use crate::report::progress::Progress;
use crate::report::summary::{self, Summary, Whys};

#[derive(Debug, Args)]
pub(crate) struct SubmitArgs {
    #[command(flatten)]
    pipeline: PipelineArgs,
    #[command(flatten)]
    target: Target,
    /// Stop after this stage
    #[arg(long, value_name = "STAGE")]
    until: Option<String>,
    /// Priority among the runs of your project or token, -100 to 100; a higher one takes workers from a lower one
    /// [default: the pipeline's, or 0]
    #[arg(long, value_name = "N", value_parser = args::priority, allow_negative_numbers = true)]
    priority: Option<i32>,
    /// Submitting twice with the same key starts one run
    #[arg(long, value_name = "KEY")]
    idempotency_key: Option<String>,
    /// Watch the run to its end
    #[arg(short, long)]
    follow: bool,
    /// Format of the answer
    #[arg(short, long, value_enum, default_value_t)]
    pub(super) output: Output,
}

#[derive(Debug, Args)]
pub(crate) struct StatusArgs {
    /// The run, a unique beginning of its name, or `@last`
    #[arg(default_value = "@last")]
    run: String,
    /// All runs, one per line
    #[arg(long)]
    all: bool,
    /// Draws the results of the stage `evaluate.spectrum`, energy by frequency band over the denoising steps, to an SVG
    /// file
    #[arg(long, value_name = "FILE.svg", conflicts_with = "all")]
    spectrum: Option<PathBuf>,
    /// The stage of --spectrum, if there are several
    #[arg(long, value_name = "STAGE", requires = "spectrum")]
    stage: Option<String>,
    #[command(flatten)]
    target: Target,
    /// Format of the answer
    #[arg(short, long, value_enum, default_value_t)]
    pub(super) output: Output,
}

#[derive(Debug, Args)]
pub(crate) struct LogsArgs {
    /// The run, a unique beginning of its name, or `@last`
    #[arg(default_value = "@last")]
    run: String,
    /// Only this stage
    #[arg(long)]
    stage: Option<String>,
    /// Continue until the run ends
    #[arg(short, long)]
    follow: bool,
    #[command(flatten)]
    target: Target,
    /// Lines, or one JSON object per line
    #[arg(short, long, value_enum, default_value_t)]
    pub(super) output: Output,
}

#[derive(Debug, Args)]
pub(crate) struct ControlArgs {
    /// The run, a unique beginning of its name, or `@last`
    #[arg(default_value = "@last")]
    run: String,
    #[command(flatten)]
    target: Target,
    /// Format of the answer
    #[arg(short, long, value_enum, default_value_t)]
    pub(super) output: Output,
}

#[derive(Debug, Args)]
pub(crate) struct WorkersArgs {
    #[command(flatten)]
    target: Target,
    /// Format of the answer
    #[arg(short, long, value_enum, default_value_t)]
    pub(super) output: Output,
}

/// Prints a run as a table or an object.
pub(crate) fn show(view: &RunView, whys: &Whys, output: Output) {
    match output {
        Output::Json => print::json(&Summary::of(view, whys, false)),
        Output::Table => {
            let priority = summary::with_priority(view.priority);
            print::out(&format!("run {}: {}{priority}\n", view.run, summary::run_state(view)));
            if view.queued {
                print::out(&format!("{}\n", view.note));
            }
            print::out(&format!("{}{}", summary::table(view, whys), summary::evaluations(view)));
        }
    }
}

pub(crate) async fn submit(args: SubmitArgs) -> Result<u8> {
    let mut file = pipeline_file::read_with_data(&args.pipeline.pipeline, &args.pipeline.set)?;
    if let Some(priority) = args.priority {
        file.pipeline.priority = priority;
    }
    let until = args.until.map(StageName::new);
    pipeline_file::check_stage(&file.pipeline, until.as_ref())?;
    let Some(client) = Client::running(&args.target).await? else {
        let problem = Problem::usage("no server is running on this store, so the run would have no workers");
        return Err(
            problem.hint("`trainer serve` starts a server; `trainer run` needs none; --server selects another server")
        );
    };
    advice(&file.pipeline).iter().for_each(|note| print::note(&format!("note: {note}")));
    let pipeline = serde_json::to_value(&file.pipeline).map_err(|error| Problem::new(exit::FAULT, error))?;
    let submit = Submit { pipeline, source: file.source, idempotency_key: args.idempotency_key, until };
    let run = client.submit(&submit).await?;
    if !args.follow {
        match args.output {
            Output::Json => print::json(&serde_json::json!({"schema_version": 1, "run": run})),
            Output::Table => print::out(run.as_str()),
        }
        return Ok(0);
    }
    let bars = args.output == Output::Table && print::on_terminal();
    let for_workers = "`trainer worker join` adds a worker to the server; `trainer worker list` shows the workers";
    let mut progress = Progress::new(bars, &file.pipeline, for_workers);
    let view = loop {
        let view = client.run(&run).await?;
        progress.update(&view);
        if view.state.is_final() {
            break view;
        }
        tokio::time::sleep(Duration::from_millis(500)).await;
    };
    progress.finish();
    show(&view, &summary::whys(client.settings(&run).await?), args.output);
    Ok(exit_code(view.state))
}

/// Exit code of a command that waited for a run.
pub(super) fn exit_code(state: RunState) -> u8 {
    match state {
        RunState::Finished | RunState::Running | RunState::Paused => 0,
        RunState::Failed => exit::FAILED,
        RunState::Cancelled => exit::CANCELLED,
    }
}

pub(crate) async fn status(args: StatusArgs) -> Result<u8> {
    let reader = Reader::open(&args.target).await?;
    if args.all {
        let runs = reader.runs().await?;
        match args.output {
            Output::Json => print::json(&serde_json::json!({"schema_version": 2, "runs": runs})),
            Output::Table => {
                let row = |run: &RunSummary| {
                    let owner = Owner { name: run.owner.clone(), project: run.project.clone(), ..Owner::default() };
                    let state = match run {
                        RunSummary { interrupted: true, .. } => "interrupted",
                        RunSummary { queued: true, .. } => "queued",
                        _ => run.state.name(),
                    };
                    let state = format!("{state}{}", summary::with_priority(run.priority));
                    let stages = format!("{}/{}", run.done, run.stages);
                    vec![run.run.to_string(), run.pipeline.clone(), owner.to_string(), state, stages]
                };
                print::out(&print::table(
                    &["RUN", "PIPELINE", "OWNER", "STATE", "STAGES"],
                    runs.iter().map(row).collect(),
                ));
            }
        }
    } else {
        // Read by itself, because a list omits the obstacles of a run.
        let view = reader.run(&reader.find(&args.run).await?.run).await?;
        if let Some(path) = &args.spectrum {
            check_parent(path)?;
            spectrum::draw(&reader, &view, args.stage.as_deref(), path).await?;
        }
        show(&view, &summary::whys(reader.settings(&view.run).await?), args.output);
    }
    reader.close().await;
    Ok(0)
}

pub(crate) async fn logs(args: LogsArgs) -> Result<u8> {
    let reader = Reader::open(&args.target).await?;
    let run = reader.find(&args.run).await?.run;
    let mut after = 0;
    loop {
        // Read the state first, so that lines logged before the end are read after it.
        let state = reader.run(&run).await?.state;
        loop {
            let rows = reader.logs(&run, args.stage.as_deref(), after).await?;
            let Some(last) = rows.last() else { break };
            after = last.id;
            for row in &rows {
                match args.output {
                    Output::Json => print::line(&serde_json::to_string(row).unwrap_or_default()),
                    Output::Table => {
                        let task = row.task.as_str();
                        let stage = task.strip_prefix(&format!("{run}/")).unwrap_or(task);
                        print::line(&format!("{stage} {} {}", row.worker, row.text));
                    }
                }
            }
        }
        if !args.follow || state.is_final() || !reader.is_live() {
            reader.close().await;
            return Ok(0);
        }
        tokio::time::sleep(Duration::from_millis(500)).await;
    }
}

pub(crate) async fn control(args: ControlArgs, action: &str) -> Result<u8> {
    // Find the run first: nothing is started for a run that does not exist.
    let reader = Reader::open(&args.target).await?;
    let run = reader.find(&args.run).await?.run;
    reader.close().await;
    let client = Client::connect(&args.target).await?;
    let view = client.control(&run, action).await?;
    show(&view, &summary::whys(client.settings(&run).await?), args.output);
    client.close().await;
    Ok(0)
}

pub(crate) async fn workers(args: WorkersArgs) -> Result<u8> {
    let reader = Reader::open(&args.target).await?;
    let workers = reader.workers().await?;
    match args.output {
        Output::Json => print::json(&workers),
        Output::Table if workers.is_empty() => print::out("no workers; `trainer worker join` adds one to a server"),
        Output::Table => {
            let row = |worker: &coordinator::WorkerView| {
                let task = worker.task.as_ref().map(ToString::to_string).unwrap_or_default();
                let backend = worker.backend.name().to_owned();
                vec![worker.worker.to_string(), worker.pid.to_string(), backend, worker.state.clone(), task]
            };
            print::out(&print::table(
                &["WORKER", "PID", "BACKEND", "STATE", "TASK"],
                workers.iter().map(row).collect(),
            ));
        }
    }
    reader.close().await;
    Ok(0)
}

/// Refuses a file whose folder does not exist, before anything is computed.
pub(crate) fn check_parent(path: &Path) -> Result<()> {
    let parent = path.parent().filter(|parent| !parent.as_os_str().is_empty());
    match parent {
        Some(parent) if !parent.is_dir() => {
            Err(Problem::usage(format!("cannot write `{}`: there is no folder `{}`", path.display(), parent.display())))
        }
        _ => Ok(()),
    }
}
