//! The arguments of `trainer launch`.

use std::path::PathBuf;
use std::time::Duration;

use access::{ConnectError, Server, ServerOptions, Token};
use clap::{Args, Subcommand, ValueEnum};
use protocol::Labels;
use protocol::id::is_name;
use protocol::stage::Backend;

use crate::command::LIMIT;
use crate::engine::Launcher;
use crate::fleet::Plan;
use crate::hosts::Hosts;
use crate::kubernetes::Kubernetes;
use crate::slurm::Slurm;
use crate::worker_command::WorkerCommand;

/// Longest name of a launcher, so that names of its workers have at most 63 characters.
const NAME: usize = 40;

/// The engine that runs the workers.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum Engine {
    Slurm,
    Kubernetes,
    Ssh,
    Local,
}

/// Verbs of `trainer launch`.
#[derive(Debug, Clone, Subcommand)]
pub enum LaunchVerb {
    /// Starts workers as jobs of Slurm; options after `--` are of `sbatch`
    #[command(
        after_help = "Example:\n  trainer launch slurm --workers 0..8 --label gpu=h100 --backend cuda --worker-token-file nodes.token -- --gres=gpu:1"
    )]
    Slurm(FollowArgs),
    /// Starts workers as Jobs of Kubernetes, made from a CronJob; options after `--` are of `kubectl`
    #[command(after_help = "Example:\n  trainer launch kubernetes --workers 0..8 -- --namespace=stride stride-worker")]
    Kubernetes(FollowArgs),
    /// Starts workers on other machines; after `--` stand the machines, HOST:WORKERS, and options of `ssh`
    #[command(
        after_help = "Example:\n  trainer launch ssh --workers 0..3 --worker-token-file nodes.token -- gpu1:2 gpu2:1"
    )]
    Ssh(FollowArgs),
    /// Starts workers on this machine
    #[command(after_help = "Example:\n  trainer launch local --workers 0..2 --idle 1m --worker-token-file nodes.token")]
    Local(FollowArgs),
    /// Shows the demand, and the jobs of a launcher
    #[command(after_help = "Example:\n  trainer launch status slurm --label gpu=h100")]
    Status(JobsArgs),
    /// Asks the workers of a launcher to save and leave; end the launcher itself first
    #[command(after_help = "Example:\n  trainer launch stop slurm --label gpu=h100")]
    Stop(JobsArgs),
}

/// The kind of workers of a launcher.
#[derive(Debug, Clone, Args)]
pub struct KindArgs {
    #[command(flatten)]
    pub server: ServerOptions,
    /// Label of the workers, such as `gpu=h100`; may be given several times
    #[arg(long = "label", value_name = "KEY=VALUE", value_parser = label)]
    pub labels: Vec<String>,
    /// Computing backend of the workers: flex, ndarray, wgpu or cuda
    #[arg(long, default_value = "flex", value_parser = backend)]
    pub backend: Backend,
    /// Name of the launcher; its workers and jobs are called NAME-... [default: from the backend and the labels]
    #[arg(long, value_parser = name)]
    pub name: Option<String>,
    /// Options for the engine
    #[arg(last = true, value_name = "ENGINE-OPTIONS")]
    pub options: Vec<String>,
}

/// Arguments of a launcher that follows the demand.
#[derive(Debug, Clone, Args)]
pub struct FollowArgs {
    /// Numbers of workers: with no demand, and at most
    #[arg(long, value_name = "MIN..MAX", value_parser = range)]
    pub workers: (usize, usize),
    /// Time without work after which a worker is asked to leave, such as `30s`, `10m` or `1h`
    #[arg(long, value_name = "TIME", default_value = "10m", value_parser = time)]
    pub idle: Duration,
    /// The launcher ends after this many jobs in a row that cannot be submitted or end before any work
    #[arg(long, value_name = "N", default_value_t = 5, value_parser = clap::value_parser!(u32).range(1..))]
    pub crashes: u32,
    /// URL of the server as workers reach it [default: that of --server]
    #[arg(long, value_name = "URL")]
    pub worker_url: Option<String>,
    /// File with the token of the workers, on their machines; its scope is `worker`
    #[arg(long, value_name = "FILE")]
    pub worker_token_file: Option<PathBuf>,
    /// Further argument of `worker join`, such as `--worker-arg=--data-root=/data`; may be given several times
    #[arg(long = "worker-arg", value_name = "ARGUMENT", allow_hyphen_values = true)]
    pub worker_arguments: Vec<String>,
    /// The program on the machines of the workers [default: `trainer`; for `local`, this program]
    #[arg(long, value_name = "FILE")]
    pub program: Option<String>,
    #[command(flatten)]
    pub kind: KindArgs,
}

/// Arguments of a command about the jobs of a launcher.
#[derive(Debug, Clone, Args)]
pub struct JobsArgs {
    /// The engine of the launcher
    pub engine: Engine,
    #[command(flatten)]
    pub kind: KindArgs,
}

/// An argument that cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum ArgumentError {
    #[error("no server is named")]
    NoServer,
    #[error("the workers need a token")]
    NoWorkerToken,
    #[error(transparent)]
    Connect(#[from] ConnectError),
    #[error("{0}")]
    Wrong(String),
}

impl KindArgs {
    /// The server that reports the demand for workers.
    ///
    /// # Errors
    /// None is named, or it cannot be used.
    pub fn connect(&self) -> Result<Server, ArgumentError> {
        self.server.connect()?.ok_or(ArgumentError::NoServer)
    }

    fn labels(&self) -> Labels {
        self.labels.iter().cloned().collect()
    }

    /// The plan of a launcher without workers.
    pub fn plan(&self) -> Plan {
        let labels = self.labels();
        Plan {
            prefix: self.name.clone().unwrap_or_else(|| derived_name(self.backend, &labels)),
            backend: self.backend,
            labels,
            min: 0,
            max: 0,
            idle: Duration::ZERO,
            crashes: 1,
        }
    }

    fn engine(&self, engine: Engine, worker: WorkerCommand) -> Result<Box<dyn Launcher>, ArgumentError> {
        let prefix = self.plan().prefix;
        let options = self.options.clone();
        Ok(match engine {
            Engine::Slurm => Box::new(Slurm { worker, options, limit: LIMIT }),
            Engine::Kubernetes => Box::new(Kubernetes::new(worker, prefix, options, LIMIT)),
            Engine::Ssh => Box::new(Hosts::ssh(worker, prefix, options, LIMIT).map_err(ArgumentError::Wrong)?),
            Engine::Local if options.is_empty() => Box::new(Hosts::local(worker, prefix, LIMIT)),
            Engine::Local => return Err(ArgumentError::Wrong("`local` has no options after `--`".to_owned())),
        })
    }
}

impl JobsArgs {
    /// The engine, which is not asked to submit.
    ///
    /// # Errors
    /// The engine's options are wrong.
    pub fn engine(&self) -> Result<Box<dyn Launcher>, ArgumentError> {
        let program = String::new();
        let url = String::new();
        let worker =
            WorkerCommand { program, url, backend: self.kind.backend, labels: self.kind.labels(), more: Vec::new() };
        self.kind.engine(self.engine, worker)
    }
}

impl FollowArgs {
    /// The server, the plan and the engine of a launcher.
    ///
    /// # Errors
    /// An argument is missing or wrong.
    pub fn prepare(&self, engine: Engine) -> Result<(Server, Plan, Box<dyn Launcher>), ArgumentError> {
        let server = self.kind.connect()?;
        let mut more = Vec::new();
        match (&self.worker_token_file, engine) {
            (Some(file), _) => more.extend(["--token-file".to_owned(), file.display().to_string()]),
            // The token is in the template.
            (None, Engine::Kubernetes) => {}
            (None, Engine::Slurm | Engine::Ssh | Engine::Local) => return Err(ArgumentError::NoWorkerToken),
        }
        let connection = &self.kind.server.connection;
        // Its own certificate and its choice of no encryption are also right for its workers.
        if engine != Engine::Kubernetes {
            more.extend(connection.ca.iter().flat_map(|ca| ["--ca".to_owned(), ca.display().to_string()]));
            more.extend(connection.insecure.then(|| "--insecure".to_owned()));
        }
        more.extend(self.worker_arguments.iter().cloned());
        let this_program = || std::env::current_exe().ok().map(|path| path.display().to_string());
        if let (Some(file), Engine::Local) = (&self.worker_token_file, engine) {
            // Workers of this machine read this very file, so a mistake is shown at once.
            Token::from_file(file).map_err(|error| ConnectError::File(error.named_by("--worker-token-file")))?;
        }
        let program = match (&self.program, engine) {
            (Some(program), _) => program.clone(),
            (None, Engine::Local) => this_program().unwrap_or_else(|| "trainer".to_owned()),
            (None, Engine::Slurm | Engine::Ssh | Engine::Kubernetes) => "trainer".to_owned(),
        };
        let url = self.worker_url.clone().unwrap_or_else(|| server.urls());
        let worker = WorkerCommand { program, url, backend: self.kind.backend, labels: self.kind.labels(), more };
        let engine = self.kind.engine(engine, worker)?;
        let (min, max) = self.workers;
        let max = engine.capacity().map_or(max, |capacity| capacity.min(max));
        let plan = Plan { min: min.min(max), max, idle: self.idle, crashes: self.crashes, ..self.kind.plan() };
        Ok((server, plan, engine))
    }
}

/// A name that another start with the same arguments derives too.
fn derived_name(backend: Backend, labels: &Labels) -> String {
    let whole = std::iter::once(backend.name()).chain(labels.iter()).collect::<Vec<_>>().join("-");
    let safe: String =
        whole.chars().map(|c| if c.is_ascii_alphanumeric() { c.to_ascii_lowercase() } else { '-' }).collect();
    let name = format!("stride-{safe}");
    if name.len() <= NAME {
        return name;
    }
    let digest = protocol::Digest::of(whole.as_bytes());
    format!("{}-{}", &name[..NAME - 9], &digest.hex()[..8])
}

fn label(text: &str) -> Result<String, String> {
    text.parse::<Labels>().map(|label| label.to_string()).map_err(|error| error.to_string())
}

fn backend(text: &str) -> Result<Backend, String> {
    let all = [Backend::Flex, Backend::Ndarray, Backend::Wgpu, Backend::Cuda];
    all.into_iter().find(|b| b.name() == text).ok_or_else(|| "expected flex, ndarray, wgpu or cuda".to_owned())
}

fn name(text: &str) -> Result<String, String> {
    // Kubernetes allows no other letters.
    let is_fine =
        is_name(text) && text.len() <= NAME && !text.contains(|c: char| c.is_ascii_uppercase() || "._".contains(c));
    let wrong =
        || format!("expected a letter or digit, then lowercase letters, digits or `-`, at most {NAME} characters");
    is_fine.then(|| text.to_owned()).ok_or_else(wrong)
}

fn range(text: &str) -> Result<(usize, usize), String> {
    let wrong = || "expected MIN..MAX, such as `0..8`, or one number".to_owned();
    let number = |text: &str| text.parse::<usize>().map_err(|_| wrong());
    let (min, max) = match text.split_once("..") {
        Some((min, max)) => (number(min)?, number(max)?),
        None => (number(text)?, number(text)?),
    };
    if min > max || max == 0 { Err(wrong()) } else { Ok((min, max)) }
}

fn time(text: &str) -> Result<Duration, String> {
    let wrong = || "expected a time such as `30s`, `10m` or `1h`".to_owned();
    let unit = text.chars().last().ok_or_else(wrong)?;
    let seconds = match unit {
        's' => 1,
        'm' => 60,
        'h' => 3600,
        _ => return Err(wrong()),
    };
    let number: u32 = text[..text.len() - 1].parse().map_err(|_| wrong())?;
    Ok(Duration::from_secs(seconds * u64::from(number)))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_and_times_of_the_command_line_are_read() {
        assert_eq!((range("0..8"), range("3")), (Ok((0, 8)), Ok((3, 3))));
        for wrong in ["", "..", "8..0", "0", "0..0", "-1..2", "a..b"] {
            assert!(range(wrong).is_err(), "{wrong}");
        }
        assert_eq!((time("30s"), time("10m")), (Ok(Duration::from_secs(30)), Ok(Duration::from_secs(600))));
        for wrong in ["", "10", "m", "1d", "-1s"] {
            assert!(time(wrong).is_err(), "{wrong}");
        }
    }

    #[test]
    fn the_same_arguments_give_the_same_name() {
        let labels = |text: &str| text.parse::<Labels>().expect("labels");
        assert_eq!(derived_name(Backend::Cuda, &labels("zone=a,gpu=H100")), "stride-cuda-gpu-h100-zone-a");
        let long = derived_name(Backend::Flex, &labels("a=0123456789012345678901234567890123456789"));
        assert!(long.len() == NAME && name(&long).is_ok(), "{long}");
        assert!(name("Big").is_err() && name("a.b").is_err() && name("gpus-2").is_ok());
    }
}
