//! `trainer run`: runs a coordinator, its workers and a pipeline, to the end or to Ctrl-C.

use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use coordinator::shell::raise_descriptor_limit;
use coordinator::{Config, Control, Coordinator, Handle, Trouble};
use pipeline::Pipeline;
use protocol::message::{FailureClass, RunState, RunView, StageState, Submit};
use protocol::{RunId, StageName};
use registry::{Holder, Place, Store};
use tokio::signal::unix::{Signal, SignalKind, signal};

use crate::client;
use crate::local::advice::advice;
use crate::local::fleet::{self, Crew, Death, Fleet};
use crate::local::missing::check_backend;
use crate::local::pipeline_file::PipelineFile;
use crate::local::{pictures, pipeline_file};
use crate::report::print::{self, Output};
use crate::report::problem::{Problem, Result, exit};
use crate::report::progress::Progress;
use crate::report::summary::{self, Summary, Whys};

/// Interval at which workers and progress are checked.
const BEAT: Duration = Duration::from_millis(200);
/// Longest time for draining before workers are killed.
const PATIENCE: Duration = Duration::from_secs(45);

/// Options of a run.
#[derive(Debug)]
pub(crate) struct Options {
    pub(crate) store: PathBuf,
    /// Location of the blobs, if it is given.
    pub(crate) blobs: Option<Place>,
    pub(crate) workers: Option<usize>,
    pub(crate) output: Output,
    /// Print a link to the page.
    pub(crate) ui: bool,
    /// The command as typed, to show how to continue.
    pub(crate) command: String,
}

/// A new pipeline, or a run of the store to continue.
#[derive(Debug)]
pub(crate) enum Request {
    Submit { file: Box<PipelineFile>, until: Option<StageName> },
    Resume(RunId),
}

/// Ctrl-C and SIGTERM.
struct Stop {
    interrupt: Signal,
    terminate: Signal,
}

impl Stop {
    fn new() -> Result<Self> {
        let listen =
            |kind| signal(kind).map_err(|error| Problem::failed(format!("cannot listen for signals: {error}")));
        Ok(Self { interrupt: listen(SignalKind::interrupt())?, terminate: listen(SignalKind::terminate())? })
    }

    async fn asked(&mut self) {
        tokio::select! {
            _ = self.interrupt.recv() => {}
            _ = self.terminate.recv() => {}
        }
    }
}

/// Reason for the end of watching.
enum End {
    Final,
    Interrupted { killed: bool },
    Trouble(Trouble),
}

/// Runs to the end and returns the exit code.
pub(crate) async fn run(request: Request, options: Options) -> Result<u8> {
    let mut stop = Stop::new()?;
    if options.workers == Some(0) {
        return Err(
            Problem::usage("`--workers` is 0; expected at least 1").hint("leave it out to start one worker per core")
        );
    }
    if let Request::Submit { file, until } = &request {
        pipeline_file::check_stage(&file.pipeline, until.as_ref())?;
        check_backend(file.pipeline.backend)?;
        pipeline_file::check_data(&file.pipeline, &options.store)?;
        advice(&file.pipeline).iter().for_each(|note| print::note(&format!("note: {note}")));
    }
    let holder = Holder::this_process(&*options.command);
    let store = match &request {
        Request::Submit { .. } => Store::open_with(&options.store, options.blobs.as_ref(), holder).await?,
        Request::Resume(_) => Store::open_existing(&options.store, holder).await?,
    };
    let dir = store.dir().to_owned();
    raise_descriptor_limit();
    let handle = Coordinator::start(store.clone(), Config::embedded()).await?;
    let _announced = client::announce(&store, &handle)?;

    let (run, pipeline) = begin(&handle, &store, request).await?;
    pipeline_file::remember_data(&pipeline, &dir);
    let bars = options.output == Output::Table && print::on_terminal();
    let mut progress =
        Progress::new(bars, &pipeline, "all workers of this run are busy or starting; `--workers N` starts N workers");
    progress.note(&format!("run {run} in {}", client::shown(&options.store)));
    if options.ui {
        progress.note(&format!("page {}", handle.page_link()));
    }

    let mut fleet = None;
    let watched = watch(&handle, &run, &pipeline, &options, &mut progress, &mut fleet, &mut stop).await;
    progress.finish();
    let view = handle.run_view(&run).await;
    // A store that fails gives no reasons; the report is printed without them.
    let whys = handle.settings(&run).await.map(summary::whys).unwrap_or_default();
    if let Some(fleet) = &mut fleet {
        fleet.kill(&handle).await;
    }
    handle.shutdown().await;
    let end = watched?;
    let view = view.map_err(|error| Problem::new(exit::FAULT, error))?;
    let exit = report(&view, &whys, &pipeline, &end, &options);
    if view.state == RunState::Finished {
        match pictures::save(&store, &view).await {
            Ok(copies) if options.output == Output::Table => copies.iter().for_each(|(stage, path)| {
                print::out(&format!("{stage} drew {}", client::shown(path)));
            }),
            // Programs find the pictures by their path.
            Ok(_) => {}
            Err(why) => print::note(&format!("cannot copy the pictures of the run: {why}")),
        }
    }
    Ok(exit)
}

async fn begin(handle: &Handle, store: &Store, request: Request) -> Result<(RunId, Pipeline)> {
    match request {
        Request::Submit { file, until } => {
            let PipelineFile { pipeline, source } = *file;
            let json = serde_json::to_value(&pipeline).map_err(|error| Problem::new(exit::FAULT, error))?;
            let run = handle.submit(Submit { pipeline: json, source, idempotency_key: None, until }).await?;
            Ok((run, pipeline))
        }
        Request::Resume(run) => {
            let row = store.run(&run).await?.ok_or_else(|| {
                Problem::new(exit::NOT_FOUND, anyhow::anyhow!("there is no run `{run}` in this store"))
                    .hint("`trainer status --all` lists runs")
            })?;
            let pipeline = serde_json::from_value(row.pipeline.clone())
                .map_err(|error| Problem::failed(format!("cannot parse the pipeline of run `{}`: {error}", row.run)))?;
            handle.control(&row.run, Control::Resume).await?;
            Ok((row.run.clone(), pipeline))
        }
    }
}

async fn watch(
    handle: &Handle,
    run: &RunId,
    pipeline: &Pipeline,
    options: &Options,
    progress: &mut Progress,
    fleet: &mut Option<Fleet>,
    stop: &mut Stop,
) -> Result<End> {
    let mut changes = handle.changes();
    loop {
        let Ok(view) = handle.run_view(run).await else { return Ok(End::Final) };
        progress.update(&view);
        if view.state.is_final() {
            return Ok(End::Final);
        }
        if let Some(trouble) = handle.trouble() {
            return Ok(End::Trouble(trouble));
        }
        if fleet.is_none() && wants_workers(&view) {
            let count = options.workers.unwrap_or_else(|| fleet::default_size(pipeline.backend));
            let crew = Crew { count, backend: pipeline.backend, draws: options.ui };
            *fleet = Some(Fleet::start(&crew, handle, &options.store)?);
        }
        if let Some(fleet) = fleet {
            for death in fleet.reap(true)? {
                let how = death.out_of_memory.as_deref().unwrap_or("has died; starting it again");
                progress.note(&format!("worker {} {how}", death.worker));
                report_death(handle, &death).await;
            }
        }
        tokio::select! {
            _ = changes.changed() => {}
            () = tokio::time::sleep(BEAT) => {}
            () = stop.asked() => return drain(handle, run, progress, fleet, stop).await,
        }
        // A training step may change values ten times a second, faster than anyone can read.
        if fleet.is_some() {
            tokio::time::sleep(BEAT / 4).await;
        }
    }
}

/// Reports the death of a worker and its cause to the coordinator.
async fn report_death(handle: &Handle, death: &Death) {
    if let Some(why) = &death.out_of_memory {
        // Reported as by the worker itself: under a grant that still holds.
        let message = format!("worker `{}` {why}", death.worker);
        if let Err(error) = handle.fail_for(&death.worker, FailureClass::OutOfMemory, message).await {
            tracing::warn!(worker = %death.worker, "cannot report that the worker ran out of memory; its task will be \
                retried: {error}");
        }
    }
    // A worker that never joined is unknown and holds no work.
    let _ = handle.worker_gone(&death.worker).await;
}

/// Returns true if a stage waits for a worker. A run whose stages are all cached needs none.
fn wants_workers(view: &RunView) -> bool {
    view.state == RunState::Running && view.stages.iter().any(|stage| stage.wants_workers.is_some())
}

async fn drain(
    handle: &Handle,
    run: &RunId,
    progress: &mut Progress,
    fleet: &mut Option<Fleet>,
    stop: &mut Stop,
) -> Result<End> {
    progress.note("stopping: workers finish their step and save; press Ctrl-C again to end them at once");
    handle.drain().await?;
    let deadline = Instant::now() + PATIENCE;
    let mut changes = handle.changes();
    loop {
        if let Ok(view) = handle.run_view(run).await {
            progress.update(&view);
        }
        let alive = match fleet {
            Some(fleet) => {
                for death in fleet.reap(false)? {
                    report_death(handle, &death).await;
                }
                fleet.is_alive()
            }
            None => false,
        };
        if !alive || !handle.is_busy() {
            return Ok(End::Interrupted { killed: false });
        }
        if let Some(trouble) = handle.trouble() {
            return Ok(End::Trouble(trouble));
        }
        if Instant::now() > deadline {
            progress.note("the workers did not stop in time; ending them");
            return Ok(End::Interrupted { killed: true });
        }
        tokio::select! {
            _ = changes.changed() => {}
            () = tokio::time::sleep(BEAT) => {}
            () = stop.asked() => return Ok(End::Interrupted { killed: true }),
        }
    }
}

fn next_command(model: &str, store: &Path) -> String {
    let store = match store.to_str() {
        Some(".stride") => String::new(),
        _ => format!(" --store {}", client::shown(store)),
    };
    format!("\n{model} is ready. Try:\n  trainer generate \"a person walks\" --model {model} -o walk.gif{store}")
}

fn report(view: &RunView, whys: &Whys, pipeline: &Pipeline, end: &End, options: &Options) -> u8 {
    let interrupted = matches!(end, End::Interrupted { .. });
    match options.output {
        Output::Json => print::json(&Summary::of(view, whys, interrupted)),
        Output::Table => print::out(&format!("{}{}", summary::table(view, whys), summary::evaluations(view))),
    }
    match end {
        End::Trouble(trouble) => {
            let problem = match trouble {
                Trouble::Store(why) => Problem::usage(format!("cannot write to the store: {why}"))
                    .hint(format!("free some space or make the store writable, then `{}` continues", options.command)),
                Trouble::Failed(why) => Problem::coordinator_failed(why).hint(format!(
                    "saved work is kept, and `{}` continues from it; please report this",
                    options.command
                )),
            };
            print::problem(&problem, options.output);
            return problem.exit;
        }
        End::Interrupted { .. } if !view.state.is_final() => {
            let killed = matches!(end, End::Interrupted { killed: true });
            let saved = if killed { "Ended; the latest checkpoints are kept." } else { "Stopped; saved work is kept." };
            print::note(&format!("\n{saved} To continue:\n  {}", options.command));
            return exit::INTERRUPTED;
        }
        End::Interrupted { .. } | End::Final => {}
    }
    match view.state {
        RunState::Finished => {
            if let (Some(model), Output::Table) = (summary::promoted(pipeline, view), options.output) {
                print::out(&next_command(&model, &options.store));
            }
            0
        }
        RunState::Cancelled => {
            print::problem(
                &Problem::new(exit::CANCELLED, anyhow::anyhow!("run `{}` was cancelled", view.run)),
                options.output,
            );
            exit::CANCELLED
        }
        RunState::Running | RunState::Paused | RunState::Failed => {
            let failed = view.stages.iter().filter(|stage| stage.state == StageState::Failed && stage.of.is_none());
            let reasons: Vec<String> = failed
                .map(|stage| {
                    format!("stage `{}` failed: {}", stage.name, stage.message.as_deref().unwrap_or("no reason given"))
                })
                .collect();
            let message =
                if reasons.is_empty() { format!("run `{}` ended early", view.run) } else { reasons.join("\n") };
            let problem = Problem::failed(message)
                .hint(format!("`trainer logs {}` shows the workers' logs; finished stages are kept", view.run));
            print::problem(&problem, options.output);
            problem.exit
        }
    }
}
