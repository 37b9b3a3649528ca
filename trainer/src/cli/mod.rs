//! Command line: one type and one function per verb.

mod allowance_args;
mod args;
mod config;
mod control;
mod data;
mod datasets;
mod demo;
mod doctor;
mod endpoint_args;
mod explain;
mod export;
mod files;
mod gallery;
mod generate;
mod import;
mod keep;
mod launch;
mod metrics;
mod model;
mod out;
mod remote;
mod sampler;
mod sentences;
mod serve;
mod shell;
mod spectrum;
mod stream;
pub(crate) mod sweep;
mod time;
mod unknown_words;

use std::path::PathBuf;
use std::process::ExitCode;

use access::ServerOptions;
use clap::{Args, CommandFactory as _, Parser, Subcommand};
use protocol::StageName;
use registry::{OpenError, ReadStore};

use self::args::{BlobArgs, PipelineArgs};
use crate::client::Target;
use crate::local::advice::advice;
use crate::local::{cost, pipeline_file, plan, run, verify};
use crate::reader::Reader;
use crate::report::print::{self, Output};
use crate::report::problem::{Problem, Result, exit};
use crate::report::summary;

/// Trains text-to-motion models across workers and stores the results
#[derive(Debug, Parser)]
#[command(name = "trainer", version = env!("STRIDE_VERSION"), propagate_version = true, after_help = exit::HELP)]
pub(crate) struct Cli {
    #[command(subcommand)]
    verb: Verb,
}

#[derive(Debug, Subcommand)]
enum Verb {
    /// Draws motions with two small models that come with the program, without data and network
    Demo(demo::DemoArgs),
    /// Runs a pipeline on this machine; run it again to continue where it stopped
    #[command(
        after_help = "Examples:\n  trainer run configs/quickstart.yaml\n  trainer run configs/smoke.yaml --until vae --workers 2 -o json"
    )]
    Run(RunArgs),
    /// Shows what `run` would do, and why
    #[command(
        after_help = "Examples:\n  trainer plan configs/quickstart.yaml\n  trainer plan configs/motionpcm.yaml --no-time"
    )]
    Plan(PlanArgs),
    /// Sends a pipeline to a server
    #[command(after_help = "Example:\n  trainer submit configs/quickstart.yaml --follow")]
    Submit(remote::SubmitArgs),
    /// Coordinates runs for clients and workers elsewhere
    Serve(serve::ServeArgs),
    /// Shows a run, or all runs
    #[command(after_help = "Examples:\n  trainer status\n  trainer status --all")]
    Status(remote::StatusArgs),
    /// Shows the logs of workers
    #[command(after_help = "Example:\n  trainer logs @last --stage vae --follow")]
    Logs(remote::LogsArgs),
    /// Shows the recorded values of a run's stages: the newest, a picture of all, or every one
    #[command(
        after_help = "Examples:\n  trainer metrics @last --stage vae\n  trainer metrics @last --key loss --plot loss.svg\n  trainer metrics @last --key loss --csv"
    )]
    Metrics(metrics::MetricsArgs),
    /// Lists, copies or prints the files that a run's stages made, such as reports and pictures
    #[command(
        after_help = "Examples:\n  trainer files @last\n  trainer files @last --stage fid_pcm --name report.json --print\n  trainer files @last --copy made"
    )]
    Files(files::FilesArgs),
    /// Shows the trials of a run's sweeps and their results
    #[command(subcommand)]
    Sweep(sweep::SweepVerb),
    /// Ends a run
    #[command(after_help = "Example:\n  trainer cancel @last")]
    Cancel(remote::ControlArgs),
    /// Pauses a run: its workers save and stop
    #[command(after_help = "Example:\n  trainer pause @last")]
    Pause(remote::ControlArgs),
    /// Continues a paused, failed or cancelled run
    #[command(after_help = "Example:\n  trainer resume @last")]
    Resume(ResumeArgs),
    /// Generates motions from sentences
    #[command(
        after_help = "Examples:\n  trainer generate \"a person walks in a circle\" --model quickstart@staging -o walk.gif\n  trainer generate \"a person jumps\" -n 4 --seconds 4s --model quickstart@staging -o jump.html -o json"
    )]
    Generate(Box<generate::GenerateArgs>),
    /// Inspects recordings of motion, writes samples and fetches published sets
    #[command(subcommand)]
    Data(data::DataVerb),
    /// Draws the motions of a run's models side by side on one page
    #[command(after_help = "Example:\n  trainer gallery @last -n 2 -o gallery.html")]
    Gallery(Box<gallery::GalleryArgs>),
    /// Converts a motion or a recording to another format: BVH, GLB, a page, a picture, an array
    #[command(after_help = "Example:\n  trainer export walk.npy -o walk.glb -o walk.mp4")]
    Export(export::ExportArgs),
    /// Makes a version of a model from published weights
    #[command(
        after_help = "Example:\n  trainer import motionlcm.ckpt --as motionlcm --part lcm --statistics deps/motionlcm/meta --text sentence-t5=data/sentence-t5-large"
    )]
    Import(Box<import::ImportArgs>),
    /// Measures the time of models per sentence (AITS), side by side
    #[command(after_help = "Example:\n  trainer time quickstart@staging --stage mld --steps 50,4,1")]
    Time(time::TimeArgs),
    /// Lists the computing devices of this build and machine
    #[command(after_help = "Example:\n  trainer devices")]
    Devices(config::DevicesArgs),
    /// Checks store, disk, devices and server, with advice for each problem
    Doctor(doctor::DoctorArgs),
    /// Explains an error by its code: its meaning, and the remedy
    #[command(after_help = "Examples:\n  trainer explain not-found\n  trainer explain 7\n  trainer explain")]
    Explain(explain::ExplainArgs),
    /// Prints a script with which a shell completes commands and options
    Completions(shell::CompletionsArgs),
    /// Prints names that may follow on a command line, for the scripts of `completions`
    #[command(hide = true)]
    Names(shell::NamesArgs),
    /// Writes manual pages, one for each command
    Man(shell::ManArgs),
    /// Checks and shows pipeline files
    #[command(subcommand)]
    Config(config::ConfigVerb),
    /// Prints the JSON Schema of pipelines, for editors
    #[command(after_help = "Example:\n  trainer schema --markdown")]
    Schema(config::SchemaArgs),
    /// Starts and ends workers by demand: on Slurm, Kubernetes, by ssh, or on this machine
    #[command(subcommand)]
    Launch(Box<launcher::cli::LaunchVerb>),
    /// Runs and lists workers
    #[command(subcommand)]
    Worker(WorkerVerb),
    /// Manages models, their versions, and the aliases that point at them
    Registry(RegistryArgs),
}

#[derive(Debug, Subcommand)]
enum WorkerVerb {
    /// Offers this machine to a coordinator
    #[command(after_help = "Example:\n  trainer worker join http://127.0.0.1:7700 --token-file .stride/token")]
    Join(worker::JoinArgs),
    /// Lists the workers of a coordinator
    #[command(after_help = "Example:\n  trainer worker list")]
    List(remote::WorkersArgs),
}

#[derive(Debug, Args)]
struct RunArgs {
    #[command(flatten)]
    pipeline: PipelineArgs,
    /// Number of worker processes [default: one per core on CPU, one on a GPU]
    #[arg(long, value_name = "N", value_parser = args::count, allow_negative_numbers = true)]
    workers: Option<usize>,
    /// The store's folder
    #[arg(long, env = "STRIDE_STORE", default_value = ".stride", value_name = "DIR")]
    store: PathBuf,
    #[command(flatten)]
    blobs: BlobArgs,
    /// Stop after this stage
    #[arg(long, value_name = "STAGE")]
    until: Option<String>,
    /// Trains nothing; runs N steps of each training stage again and compares them with what is stored [default N: 20]
    #[arg(long, value_name = "N", num_args = 0..=1, default_missing_value = "20", value_parser = args::whole::<1>, conflicts_with_all = ["workers", "until"])]
    verify: Option<u64>,
    /// Print a link to a page that shows the run live
    #[arg(long)]
    ui: bool,
    /// Format of the result
    #[arg(short, long, value_enum, default_value_t)]
    output: Output,
}

#[derive(Debug, Args)]
struct PlanArgs {
    #[command(flatten)]
    pipeline: PipelineArgs,
    /// Tries no stage, and so omits parameters and times
    #[arg(long)]
    no_time: bool,
    /// The store's folder
    #[arg(long, env = "STRIDE_STORE", default_value = ".stride", value_name = "DIR")]
    store: PathBuf,
    /// Format of the plan
    #[arg(short, long, value_enum, default_value_t)]
    output: Output,
}

#[derive(Debug, Args)]
struct ResumeArgs {
    /// The run, a unique beginning of its name, or `@last`
    #[arg(default_value = "@last")]
    run: String,
    #[command(flatten)]
    target: Target,
    /// Number of worker processes, when no server is running
    #[arg(long, value_name = "N", value_parser = args::count, allow_negative_numbers = true)]
    workers: Option<usize>,
    /// Format of the result
    #[arg(short, long, value_enum, default_value_t)]
    output: Output,
}

#[derive(Debug, Args)]
struct RegistryArgs {
    /// The store's folder
    #[arg(long, env = "STRIDE_STORE", default_value = ".stride", value_name = "DIR", global = true)]
    store: PathBuf,
    #[command(flatten)]
    server: ServerOptions,
    /// Format of the answer; for `export`, the file of a bundle, FILE.tar.zst
    #[arg(short, long, default_value = "table", value_name = "table|json", global = true)]
    output: registry::cli::OutputArg,
    #[command(subcommand)]
    verb: registry::cli::Verb,
}

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

/// Explains a refused command line that has a more probable reading than that of its grammar.
fn explained(error: &clap::Error) -> Option<Problem> {
    let words = || std::env::args_os().skip(1);
    if error.kind() == clap::error::ErrorKind::MissingRequiredArgument && words().eq(["worker", "join"]) {
        let problem = Problem::usage("`trainer worker join` needs the address of a coordinator");
        return Some(problem.hint(
            "`trainer serve` starts one and prints the command with its address and token; `trainer run` starts its \
             own workers",
        ));
    }
    let text = || words().map(|word| word.to_string_lossy().into_owned());
    unknown_command(error, text()).or_else(|| sentences::without_quotes(error, words()))
}

/// Names the command that an unknown word probably means, where the parser knows none.
fn unknown_command(error: &clap::Error, words: impl Iterator<Item = String>) -> Option<Problem> {
    use clap::error::{ContextKind, ErrorKind};

    if error.kind() != ErrorKind::InvalidSubcommand || error.get(ContextKind::SuggestedSubcommand).is_some() {
        return None;
    }
    let mut command = Cli::command();
    for word in words.filter(|word| !word.starts_with('-')) {
        let Some(known) = command.find_subcommand(&word).cloned() else {
            let near = protocol::spelling::nearest(&word, command.get_subcommands().map(clap::Command::get_name))?;
            let problem = Problem::usage(format!("there is no command `{word}`"));
            return Some(problem.hint(format!("did you mean `{near}`? `trainer --help` lists the commands")));
        };
        command = known;
    }
    None
}

/// Lines that are logged without `RUST_LOG`. The database warns of each statement that waits for a slow disk, in lines of
/// SQL.
const LOGGED: &str = "warn,sqlx=error";

impl Verb {
    /// Returns true if the process coordinates runs, whose workers are other processes.
    fn coordinates(&self) -> bool {
        match self {
            Self::Run(args) => args.verify.is_none(),
            Self::Serve(_) | Self::Resume(_) | Self::Demo(_) => true,
            _ => false,
        }
    }

    /// Makes files of a store readable for its user only. For other files, the user's umask decides.
    fn keep_to_oneself(&self) {
        let store_only = match self {
            Self::Run(_) | Self::Serve(_) | Self::Resume(_) | Self::Cancel(_) | Self::Pause(_) | Self::Import(_) => {
                true
            }
            Self::Registry(args) => !matches!(args.verb, registry::cli::Verb::Export { .. }),
            _ => false,
        };
        if store_only {
            nix::sys::stat::umask(nix::sys::stat::Mode::from_bits_truncate(0o077));
        }
    }

    fn output(&self) -> Output {
        match self {
            Self::Demo(args) => args.output,
            Self::Run(args) => args.output,
            Self::Plan(args) => args.output,
            Self::Submit(args) => args.output,
            Self::Status(args) => args.output,
            Self::Logs(args) => args.output,
            Self::Metrics(args) => args.output,
            Self::Files(args) => args.output,
            Self::Cancel(args) | Self::Pause(args) => args.output,
            Self::Sweep(verb) => verb.output(),
            Self::Data(verb) => verb.output(),
            Self::Resume(args) => args.output,
            Self::Generate(args) => args.report(),
            Self::Gallery(args) => args.report,
            Self::Export(args) => args.report(),
            Self::Import(args) => args.output,
            Self::Time(args) => args.output,
            Self::Devices(args) => args.output,
            Self::Doctor(args) => args.output,
            Self::Worker(WorkerVerb::List(args)) => args.output,
            Self::Serve(_)
            | Self::Explain(_)
            | Self::Completions(_)
            | Self::Man(_)
            | Self::Names(_)
            | Self::Launch(_)
            | Self::Config(_)
            | Self::Schema(_)
            | Self::Worker(WorkerVerb::Join(_))
            | Self::Registry(_) => Output::Table,
        }
    }
}

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
        Verb::Data(verb) => data::data(&verb),
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

/// The command as typed, for messages that suggest how to continue.
fn command_line() -> String {
    let quoted = std::env::args().skip(1).map(|argument| {
        let plain = |c: char| c.is_ascii_alphanumeric() || "-_./=@:,+".contains(c);
        if argument.chars().all(plain) { argument } else { format!("'{}'", argument.replace('\'', "'\\''")) }
    });
    std::iter::once("trainer".to_owned()).chain(quoted).collect::<Vec<_>>().join(" ")
}

async fn run_pipeline(args: RunArgs) -> Result<u8> {
    let file = pipeline_file::read_with_data(&args.pipeline.pipeline, &args.pipeline.set)?;
    if let Some(steps) = args.verify {
        return verify::verify(&file.pipeline, &args.store, steps, args.output).await;
    }
    let until = args.until.map(StageName::new);
    let options = run::Options {
        store: args.store,
        blobs: args.blobs.blobs,
        workers: args.workers,
        output: args.output,
        ui: args.ui,
        command: command_line(),
    };
    run::run(run::Request::Submit { file: Box::new(file), until }, options).await
}

async fn show_plan(args: PlanArgs) -> Result<u8> {
    let (file, missing) = pipeline_file::read_to_plan(&args.pipeline.pipeline, &args.pipeline.set)?;
    let store = match ReadStore::open(&args.store).await {
        Ok(store) => Some(store),
        Err(OpenError::NotAStore(_)) => None,
        Err(error) => return Err(error.into()),
    };
    let mut file = file;
    pipeline_file::resolve_versions(&mut file.pipeline, store.as_ref()).await?;
    let mut plan = plan::plan(&file.pipeline, store.as_ref()).await?;
    plan.missing = missing;
    if !args.no_time && plan.stages.iter().any(|step| step.action != "cached") {
        plan.estimate(&cost::estimates(&file.pipeline));
    }
    advice(&file.pipeline).iter().for_each(|note| print::note(&format!("note: {note}")));
    match args.output {
        Output::Json => print::json(&plan),
        Output::Table => print::out(&plan.screen(&file.pipeline)),
    }
    Ok(0)
}

async fn resume(args: ResumeArgs) -> Result<u8> {
    // Find the run first: nothing is started for a run that does not exist.
    let reader = Reader::open(&args.target).await?;
    let found = reader.find(&args.run).await?;
    let client = match reader {
        Reader::Server(client) => client,
        Reader::Store(records) => {
            // No server holds the store, so this process does the work.
            records.close().await;
            let options = run::Options {
                store: args.target.store,
                blobs: None,
                workers: args.workers,
                output: args.output,
                ui: false,
                command: command_line(),
            };
            return run::run(run::Request::Resume(found.run), options).await;
        }
    };
    let view = client.control(&found.run, "resume").await?;
    let whys = summary::whys(client.settings(&view.run).await?);
    remote::show(&view, &whys, args.output);
    Ok(0)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_commands_of_the_documents_parse() {
        let commands = cluster_tests::documented::commands(&cluster_tests::Bench::repository(), "trainer");
        assert!(commands.len() >= 10, "{commands:#?}");
        for words in commands {
            if let Err(error) = Cli::try_parse_from(&words) {
                panic!("{}: {error}", words.join(" "));
            }
        }
    }

    /// The examples in the `--help` of a command and its subcommands. Each command that runs has one.
    fn examples(command: &clap::Command, path: &str) -> Vec<String> {
        let help = command.get_after_help().map(ToString::to_string).unwrap_or_default();
        let own: Vec<String> = match help.split_once("Example") {
            None => Vec::new(),
            Some((_, listed)) => listed.lines().filter_map(|line| line.strip_prefix("  ").map(str::to_owned)).collect(),
        };
        let below: Vec<&clap::Command> = command.get_subcommands().filter(|command| !command.is_hide_set()).collect();
        assert!(!below.is_empty() || !own.is_empty(), "`{path}` has no example in its help");
        let below = below.into_iter().flat_map(|below| examples(below, &format!("{path} {}", below.get_name())));
        own.into_iter().chain(below).collect()
    }

    #[test]
    fn the_examples_of_every_help_parse() {
        let command = Cli::command();
        let examples = examples(&command, "trainer");
        assert!(examples.len() >= 60, "{examples:#?}");
        for example in examples {
            let mut words = cluster_tests::documented::words(&example);
            if words[0] == "registry" {
                words.insert(0, "trainer".to_owned());
            }
            assert_eq!(words[0], "trainer", "{example}");
            let words: Vec<&String> = words.iter().take_while(|word| *word != ">").collect();
            if let Err(error) = Cli::try_parse_from(words) {
                panic!("{example}: {error}");
            }
        }
    }

    #[test]
    fn options_are_consistent() {
        Cli::command().debug_assert();
    }

    #[test]
    fn a_blank_token_is_refused_by_every_command() {
        for line in ["serve --token", "status --token", "worker join http://h:1 --token", "registry list --token"] {
            for token in ["", " ", "short"] {
                let words = ["trainer"].into_iter().chain(line.split(' ')).chain([token]);
                let error = Cli::try_parse_from(words).expect_err("no token").to_string();
                assert!(error.contains("the token"), "{line} {token:?}: {error}");
            }
        }
    }
}
