//! `trainer launch`: workers by demand.

use launcher::cli::{ArgumentError, Engine, FollowArgs, JobsArgs, LaunchVerb};
use launcher::follow::{self, FollowError};
use launcher::{EngineError, Job};

use crate::report::print;
use crate::report::problem::{Problem, Result, exit};

/// Advice if the program of an engine cannot be started.
const MISSING: &str = "run the launcher on a machine that has this program, such as a login node";

impl From<ArgumentError> for Problem {
    fn from(error: ArgumentError) -> Self {
        match error {
            ArgumentError::Connect(error) => error.into(),
            ArgumentError::NoServer => Self::usage(error).hint("give its address with --server or STRIDE_SERVER"),
            ArgumentError::NoWorkerToken => {
                Self::usage(error).hint("name a token file of scope `worker` with --worker-token-file")
            }
            ArgumentError::Wrong(_) => Self::usage(error),
        }
    }
}

impl From<FollowError> for Problem {
    fn from(error: FollowError) -> Self {
        match &error {
            FollowError::Crashes { .. } => {
                Self::failed(error).hint("correct the cause, then start the launcher again with the same options")
            }
            FollowError::Refused { status, .. } if matches!(status.as_u16(), 401 | 403) => {
                Self::new(exit::UNAUTHORISED, error).hint("a launcher's token needs the scope `launch`")
            }
            FollowError::Unreachable { .. } => Self::new(exit::UNREACHABLE, error).hint(access::UNREACHABLE),
            FollowError::Engine(EngineError::Missing { .. }) => Self::failed(error).hint(MISSING),
            FollowError::Refused { .. } | FollowError::Engine(_) => Self::failed(error),
        }
    }
}

impl From<EngineError> for Problem {
    fn from(error: EngineError) -> Self {
        FollowError::Engine(error).into()
    }
}

pub(crate) async fn launch(verb: LaunchVerb) -> Result<u8> {
    match verb {
        LaunchVerb::Slurm(args) => follow(&args, Engine::Slurm).await,
        LaunchVerb::Kubernetes(args) => follow(&args, Engine::Kubernetes).await,
        LaunchVerb::Ssh(args) => follow(&args, Engine::Ssh).await,
        LaunchVerb::Local(args) => follow(&args, Engine::Local).await,
        LaunchVerb::Status(args) => status(&args).await,
        LaunchVerb::Stop(args) => stop(&args).await,
    }
}

async fn follow(args: &FollowArgs, engine: Engine) -> Result<u8> {
    let (server, plan, engine) = args.prepare(engine)?;
    follow::follow(&server, plan, &*engine).await?;
    Ok(0)
}

async fn status(args: &JobsArgs) -> Result<u8> {
    let (engine, plan) = (args.engine()?, args.kind.plan());
    let server = args.kind.connect()?;
    let demand = follow::demand(&server, &plan, None, None, std::time::Duration::ZERO).await?;
    let groups = demand.groups.iter().map(|group| {
        let labels = if group.requires.is_empty() { "-".to_owned() } else { group.requires.to_string() };
        let counts = [group.ready, group.wanted, group.idle].map(|count| count.to_string());
        let wait = print::duration(group.oldest_wait_ms as f64 / 1000.0);
        [group.backend.name().to_owned(), labels].into_iter().chain(counts).chain([wait]).collect()
    });
    let head = ["BACKEND", "REQUIRES", "READY", "WANTED", "IDLE", "OLDEST WAIT"];
    print::out(&print::table(&head, groups.collect()));
    show(&follow::jobs(&plan, &*engine).await?);
    Ok(0)
}

async fn stop(args: &JobsArgs) -> Result<u8> {
    let (engine, plan) = (args.engine()?, args.kind.plan());
    let jobs = follow::stop(&plan, &*engine).await?;
    show(&jobs);
    if !jobs.is_empty() {
        print::note("asked these jobs to save and leave; a launcher that still runs starts new ones while work waits");
    }
    Ok(0)
}

fn show(jobs: &[Job]) {
    if jobs.is_empty() {
        print::out("no jobs of this launcher");
        return;
    }
    let row = |job: &Job| vec![job.worker.clone(), job.id.clone(), job.state.name().to_owned()];
    print::out(&print::table(&["WORKER", "JOB", "STATE"], jobs.iter().map(row).collect()));
}
