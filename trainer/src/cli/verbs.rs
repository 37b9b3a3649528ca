//! The verbs of the command line, with the examples in their help.

use std::path::PathBuf;

use access::ServerOptions;
use clap::{Args, Parser, Subcommand};

use super::plan::PlanArgs;
use super::resume::ResumeArgs;
use super::run::RunArgs;
use super::{
    config, data, demo, doctor, explain, export, files, gallery, generate, import, metrics, remote, serve, shell,
    sweep, time,
};
use crate::report::print::Output;
use crate::report::problem::exit;

/// Trains text-to-motion models across workers and stores the results
#[derive(Debug, Parser)]
#[command(name = "trainer", version = env!("STRIDE_VERSION"), propagate_version = true, after_help = exit::HELP)]
pub(super) struct Cli {
    #[command(subcommand)]
    pub(super) verb: Verb,
}

#[derive(Debug, Subcommand)]
pub(super) enum Verb {
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
pub(super) enum WorkerVerb {
    /// Offers this machine to a coordinator
    #[command(after_help = "Example:\n  trainer worker join http://127.0.0.1:7700 --token-file .stride/token")]
    Join(worker::JoinArgs),
    /// Lists the workers of a coordinator
    #[command(after_help = "Example:\n  trainer worker list")]
    List(remote::WorkersArgs),
}

#[derive(Debug, Args)]
pub(super) struct RegistryArgs {
    /// The store's folder
    #[arg(long, env = "STRIDE_STORE", default_value = ".stride", value_name = "DIR", global = true)]
    pub(super) store: PathBuf,
    #[command(flatten)]
    pub(super) server: ServerOptions,
    /// Format of the answer; for `export`, the file of a bundle, FILE.tar.zst
    #[arg(short, long, default_value = "table", value_name = "table|json", global = true)]
    pub(super) output: registry::cli::OutputArg,
    #[command(subcommand)]
    pub(super) verb: registry::cli::Verb,
}

impl Verb {
    /// Returns true if the process coordinates runs, whose workers are other processes.
    pub(super) fn coordinates(&self) -> bool {
        match self {
            Self::Run(args) => args.verify.is_none(),
            Self::Serve(_) | Self::Resume(_) | Self::Demo(_) => true,
            _ => false,
        }
    }

    /// Makes files of a store readable for its user only. For other files, the user's umask decides.
    pub(super) fn keep_to_oneself(&self) {
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

    pub(super) fn output(&self) -> Output {
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
