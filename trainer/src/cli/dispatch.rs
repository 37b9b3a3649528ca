//! Runs the command that the process was started with.

use std::process::ExitCode;

use clap::{CommandFactory as _, Parser as _};

use super::args::command_line;
use super::plan::show_plan;
use super::refused::explained;
use super::resume::resume;
use super::run::run_pipeline;
use super::verbs::{Cli, Verb, WorkerVerb};
use super::{
    config, data, demo, doctor, explain, export, files, gallery, generate, import, launch, metrics, remote, serve,
    shell, sweep, time,
};
use crate::report::print::{self, Output};
use crate::report::problem::{Problem, Result, exit};

/// Runs the command that the process was started with.
pub(crate) fn main() -> ExitCode {
    // Messages of servers and workers have many readers; those of other commands only their own user. Messages about
    // arguments quote files too, so this comes before the arguments are read.
    if std::env::args_os().nth(1).is_none_or(|verb| !["serve", "worker", "demo"].iter().any(|other| verb == *other)) {
        protocol::show_excerpts();
    }
    let cli = match Cli::try_parse() {
        Ok(cli) => cli,
        Err(error) => match explained(&error) {
            Some(problem) => {
                print::problem(&problem, Output::Table);
                return ExitCode::from(problem.exit);
            }
            None => error.exit(),
        },
    };
    // The allocator can be tuned only while there is one thread.
    if cli.verb.coordinates() {
        worker::process::tune_allocator_of_a_server();
    } else {
        worker::process::tune_allocator();
    }
    if let Verb::Worker(WorkerVerb::Join(args)) = cli.verb {
        // A worker is synchronous, with its own threads and its own logging.
        let _traces = telemetry::init("stride-worker", worker::LOGGED, false);
        return match worker::Options::try_from(args).and_then(worker::join) {
            Ok(()) => ExitCode::SUCCESS,
            Err(error) => {
                tracing::error!("{error}");
                ExitCode::from(error.exit_code())
            }
        };
    }
    let _traces = match cli.verb {
        // It reports each job that it starts.
        Verb::Launch(_) => telemetry::init("stride", worker::LOGGED, false),
        _ => telemetry::init("stride", LOGGED, print::on_terminal()),
    };
    cli.verb.keep_to_oneself();
    let output = cli.verb.output();
    let runtime = match tokio::runtime::Builder::new_multi_thread().worker_threads(2).enable_all().build() {
        Ok(runtime) => runtime,
        Err(error) => {
            print::problem(&Problem::new(exit::FAULT, error), output);
            return ExitCode::from(exit::FAULT);
        }
    };
    let code = match runtime.block_on(perform(cli.verb)) {
        Ok(code) => code,
        Err(problem) => {
            print::problem(&problem, output);
            problem.exit
        }
    };
    // Do not wait for blocking tasks; their results are no longer needed.
    runtime.shutdown_background();
    ExitCode::from(code)
}

/// Lines that are logged without `RUST_LOG`. The database warns of each statement that waits for a slow disk, in lines
/// of SQL.
const LOGGED: &str = "warn,sqlx=error";

async fn perform(verb: Verb) -> Result<u8> {
    match verb {
        Verb::Demo(args) => demo::demo(args, command_line()).await,
        Verb::Run(args) => run_pipeline(args).await,
        Verb::Plan(args) => show_plan(args).await,
        Verb::Submit(args) => remote::submit(args).await,
        Verb::Serve(args) => serve::serve(args).await,
        Verb::Status(args) => remote::status(args).await,
        Verb::Logs(args) => remote::logs(args).await,
        Verb::Metrics(args) => metrics::metrics(args).await,
        Verb::Files(args) => files::files(args).await,
        Verb::Sweep(verb) => sweep::sweep(verb).await,
        Verb::Cancel(args) => remote::control(args, "cancel").await,
        Verb::Pause(args) => remote::control(args, "pause").await,
        Verb::Resume(args) => resume(args).await,
        Verb::Generate(args) => generate::generate(*args).await,
        Verb::Data(verb) => data::data(verb).await,
        Verb::Gallery(args) => gallery::gallery(*args).await,
        Verb::Export(args) => export::export(&args),
        Verb::Import(args) => import::import(*args, command_line()).await,
        Verb::Time(args) => time::time(args).await,
        Verb::Devices(args) => Ok(config::devices(&args)),
        Verb::Doctor(args) => doctor::doctor(args).await,
        Verb::Explain(args) => explain::explain(&args),
        Verb::Completions(args) => Ok(shell::completions(&args, Cli::command())),
        Verb::Man(args) => shell::man(&args, Cli::command()),
        Verb::Names(args) => shell::names(&args).await,
        Verb::Config(verb) => config::config(&verb),
        Verb::Schema(args) => Ok(config::schema(&args)),
        Verb::Launch(verb) => launch::launch(*verb).await,
        Verb::Worker(WorkerVerb::List(args)) => remote::workers(args).await,
        Verb::Worker(WorkerVerb::Join(_)) => Ok(0),
        Verb::Registry(args) => Ok(registry::cli::execute(args.verb, &args.store, &args.server, args.output).await),
    }
}
