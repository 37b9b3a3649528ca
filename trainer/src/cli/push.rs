//! `trainer data push`: computes the stages of a pipeline that read files, on this machine, for a server.
//!
//! The server's workers need neither the files nor a data root: later stages read only the results. A worker process of
//! this machine, which may read nothing else, takes these stages alone; a label keeps it for them.

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};
use std::process::Stdio;
use std::time::Duration;

use clap::Args;
use nix::sys::signal::{Signal, kill};
use nix::unistd::Pid;
use pipeline::{Pipeline, PipelineStage};
use protocol::message::{RunState, RunView, Submit};
use protocol::{Labels, RunId, canonical};
use serde_json::json;
use tokio::process::{Child, Command};

use super::args::PipelineArgs;
use super::remote;
use crate::client::{Client, Target};
use crate::local::fleet::{last_lines, last_words};
use crate::local::pipeline_file;
use crate::report::print::{self, Output};
use crate::report::problem::{Problem, Result, exit};
use crate::report::progress::Progress;

/// Pause between two looks at the run.
const PAUSE: Duration = Duration::from_millis(300);
/// Time for the worker to leave.
const FAREWELL: Duration = Duration::from_secs(5);
/// Lines of the worker's log that are shown if it ends early.
const LAST_LINES: usize = 5;

#[derive(Debug, Args)]
pub(crate) struct PushArgs {
    #[command(flatten)]
    pipeline: PipelineArgs,
    #[command(flatten)]
    target: Target,
    /// Format of the answer
    #[arg(short, long, value_enum, default_value_t)]
    pub(super) output: Output,
}

/// The part of a pipeline that reads files of this machine.
struct Part {
    pipeline: Pipeline,
    /// The files and folders that its stages name.
    paths: BTreeSet<PathBuf>,
    /// Keeps the worker of this machine for the part.
    label: String,
}

impl Part {
    /// Takes the stages that read files, and no results of stages that it does not take.
    fn of(mut pipeline: Pipeline) -> Result<Self> {
        let mut taken = BTreeSet::new();
        let mut left = Vec::new();
        pipeline.stages.retain(|stage| {
            let reads_files = !stage.settings.folders().is_empty();
            let takes = reads_files && stage.inputs.iter().all(|input| taken.contains(&input.stage));
            if takes {
                taken.insert(stage.name.clone());
            } else if reads_files {
                left.push(stage.name.to_string());
            }
            takes
        });
        if pipeline.stages.is_empty() {
            let problem = Problem::usage("no stage of the pipeline reads files first, so there is nothing to push");
            return Err(problem.hint("`trainer submit` starts the pipeline"));
        }
        if !left.is_empty() {
            print::note(&format!(
                "note: `{}` reads files and results of other stages, so its worker needs a data root with the files",
                left.join("`, `")
            ));
        }
        // The same for the same content, so that the worker of a second push also serves the run of a first.
        let content: Vec<_> = pipeline.stages.iter().map(|stage| (&stage.name, &stage.external)).collect();
        let label = format!("only=push-{}", canonical::digest(&content).short());
        let mut paths = BTreeSet::new();
        for stage in &mut pipeline.stages {
            stage.placement.requires = Labels::from_iter([label.clone()]);
            paths.extend(make_absolute(stage)?);
        }
        Ok(Self { pipeline, paths, label })
    }
}

/// Makes the paths of a stage's settings absolute, so that each is a data root by itself. Returns them. A stage's key
/// has the content's digest and not the path.
fn make_absolute(stage: &mut PipelineStage) -> Result<Vec<PathBuf>> {
    let failed = |error: &dyn std::fmt::Display| Problem::failed(format!("stage `{}`: {error}", stage.name));
    let mut settings = serde_json::to_value(&stage.settings).map_err(|e| failed(&e))?;
    let mut paths = Vec::new();
    for folder in stage.settings.folders() {
        let path = std::path::absolute(&folder.path).map_err(|e| failed(&e))?;
        let pointer = format!("/{}", folder.field.replace('.', "/"));
        let Some(field) = settings.pointer_mut(&pointer) else {
            return Err(failed(&format!("`{}` is no setting", folder.field)));
        };
        *field = json!(path);
        paths.push(path);
    }
    let absolute = serde_json::from_value(settings).map_err(|e| failed(&e))?;
    stage.settings = absolute;
    Ok(paths)
}

/// The worker of this machine. Dropping it ends it.
struct Worker {
    child: Child,
    log: tempfile::NamedTempFile,
}

impl Worker {
    fn start(url: &str, args: &PushArgs, part: &Part) -> Result<Self> {
        let failed = |error: std::io::Error| Problem::failed(format!("cannot start a worker on this machine: {error}"));
        let log = tempfile::NamedTempFile::new().map_err(failed)?;
        let connection = &args.target.server.connection;
        let mut command = Command::new(std::env::current_exe().map_err(failed)?);
        command.args(["worker", "join", url, "--die-with-parent", "--label", &part.label]);
        for path in &part.paths {
            command.arg("--data-root").arg(beneath(path));
        }
        command.args(connection.insecure.then_some("--insecure"));
        if let Some(ca) = &connection.ca {
            command.arg("--ca").arg(ca);
        }
        if let Some(token) = connection.token.read().map_err(Problem::usage)? {
            // Not an argument, because every user of the machine can read arguments.
            command.env("STRIDE_TOKEN", token.secret()).env_remove("STRIDE_TOKEN_FILE");
        }
        command.env_remove("STRIDE_DATA_ROOT").env_remove("STRIDE_LABELS");
        let written = log.reopen().map_err(failed)?;
        command.stdin(Stdio::null()).stdout(Stdio::null()).stderr(written).kill_on_drop(true);
        Ok(Self { child: command.spawn().map_err(failed)?, log })
    }

    /// Reports a worker that ended before its work.
    fn check(&mut self) -> Result<()> {
        let Ok(Some(status)) = self.child.try_wait() else { return Ok(()) };
        let said = last_lines(&last_words(self.log.path(), 0), LAST_LINES);
        let code = status.code().and_then(|code| u8::try_from(code).ok()).unwrap_or(exit::FAILED);
        let problem = Problem::new(code, anyhow::anyhow!("the worker of this machine ended ({status})\n{said}"));
        Err(match code {
            exit::UNAUTHORISED => problem.hint("the token needs the scopes `submit` and `worker`"),
            _ => problem.hint("push again; the stages continue where they were"),
        })
    }

    /// Asks the worker to leave, so that the server does not wait for it.
    async fn leave(mut self) {
        if let Some(id) = self.child.id().and_then(|id| i32::try_from(id).ok()) {
            // It may have ended already.
            let _ = kill(Pid::from_raw(id), Signal::SIGTERM);
            let _ = tokio::time::timeout(FAREWELL, self.child.wait()).await;
        }
    }
}

/// The folder that must be open to read `path`: a file's own folder, because a data root is a folder.
fn beneath(path: &Path) -> &Path {
    if path.is_file() { path.parent().unwrap_or(path) } else { path }
}

pub(crate) async fn push(args: PushArgs) -> Result<u8> {
    let file = pipeline_file::read_with_data(&args.pipeline.pipeline, &args.pipeline.set)?;
    let part = Part::of(file.pipeline)?;
    let Some(client) = Client::running(&args.target).await? else {
        let problem = Problem::usage("no server is named, and none is running on this store");
        return Err(problem.hint("name the server with `--server URL`; `trainer run` needs no push"));
    };
    let pipeline = serde_json::to_value(&part.pipeline).map_err(|error| Problem::new(exit::FAULT, error))?;
    let submit = Submit { pipeline, source: file.source, idempotency_key: None, until: None };
    let run = client.submit(&submit).await?;
    let mut worker = Worker::start(&client.urls(), &args, &part)?;
    let watched = tokio::select! {
        watched = watch(&client, &run, &mut worker, &part, args.output) => watched,
        _ = tokio::signal::ctrl_c() => Err(Problem::new(exit::CANCELLED, anyhow::anyhow!("run `{run}` was cancelled"))),
    };
    if watched.is_err() {
        // Otherwise it waits for a worker of this machine. It may have ended meanwhile.
        let _ = client.control(&run, "cancel").await;
    }
    worker.leave().await;
    let view = watched?;
    report(&view, &args);
    Ok(remote::exit_code(view.state))
}

/// Shows the run until its end.
async fn watch(client: &Client, run: &RunId, worker: &mut Worker, part: &Part, output: Output) -> Result<RunView> {
    let bars = output == Output::Table && print::on_terminal();
    let mut progress = Progress::new(bars, &part.pipeline, "the worker of this machine has not joined yet");
    let view = loop {
        let view = client.run(run).await?;
        progress.update(&view);
        if view.state.is_final() {
            break view;
        }
        worker.check()?;
        tokio::time::sleep(PAUSE).await;
    };
    progress.finish();
    Ok(view)
}

fn report(view: &RunView, args: &PushArgs) {
    let stages = view.stages.iter().map(|stage| (stage.name.to_string(), json!(stage.outputs)));
    match args.output {
        Output::Json => {
            let stages: serde_json::Map<String, serde_json::Value> = stages.collect();
            print::json(&json!({"schema_version": 1, "run": view.run, "state": view.state, "stages": stages}));
        }
        Output::Table if view.state == RunState::Finished => print::out(&format!(
            "the server has the results of {}; submit the pipeline on this machine, and its workers need no files:\n  \
             trainer submit {}",
            stages.map(|(name, _)| format!("`{name}`")).collect::<Vec<_>>().join(", "),
            args.pipeline.pipeline.display()
        )),
        Output::Table => {
            for stage in &view.stages {
                if let Some(reason) = &stage.message {
                    print::note(&format!("stage `{}`: {reason}", stage.name));
                }
            }
        }
    }
}
