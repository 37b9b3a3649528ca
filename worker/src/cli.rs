//! The arguments of `worker join`, shared by the two binaries that have it.

use std::path::PathBuf;
use std::time::Duration;

use access::ConnectionOptions;
use clap::builder::{OsStringValueParser, TypedValueParser as _};
use protocol::stage::Backend;
use protocol::{Labels, WorkerId};

use crate::{Files, JoinError, Options, StageLimits};

/// Offer this machine to a coordinator.
#[derive(Debug, Clone, clap::Args)]
pub struct JoinArgs {
    /// URL of the coordinator, such as `http://127.0.0.1:7700`; those of its stand-bys follow after commas
    #[arg(env = "STRIDE_SERVER")]
    pub url: String,
    #[command(flatten)]
    pub connection: ConnectionOptions,
    /// The worker's name, unique among live workers [default: host and process id]
    #[arg(long)]
    pub name: Option<String>,
    /// Label that stages may require, such as `gpu=h100`; may be given several times
    #[arg(long = "label", value_name = "KEY=VALUE", env = "STRIDE_LABELS", value_delimiter = ',', value_parser = label)]
    pub labels: Vec<String>,
    /// Computing backend: flex, ndarray, wgpu or cuda
    #[arg(long, default_value = "flex", value_parser = backend)]
    pub backend: Backend,
    /// Number of the device of that backend
    #[arg(long, default_value_t = 0)]
    pub device: usize,
    /// Keep downloaded blobs in this folder; workers may share it
    #[arg(long, value_name = "DIR")]
    pub cache: Option<PathBuf>,
    /// The folder of the coordinator's store, if it is on this machine: blobs are read there, and shared by all workers
    #[arg(long, value_name = "DIR")]
    pub store: Option<PathBuf>,
    /// Read files that pipelines name only below this folder; may be given several times. If it is not given, no file
    /// is read
    // Empty values pass, so that an empty variable names no folder instead of ending the worker.
    #[arg(
        long = "data-root",
        value_name = "DIR",
        env = "STRIDE_DATA_ROOT",
        value_delimiter = ':',
        value_parser = OsStringValueParser::new().map(PathBuf::from)
    )]
    pub data_roots: Vec<PathBuf>,
    /// Read files at any path that pipelines name. For a worker that only runs its own user's pipelines, such as those
    /// of `trainer run`
    #[arg(long, hide = true)]
    pub any_file: bool,
    /// Close all files to this process except the data roots, the cache, the store and the system's libraries (Landlock)
    #[arg(long, env = "STRIDE_SANDBOX", conflicts_with = "any_file")]
    pub sandbox: bool,
    /// Address at which other workers reach this one [default: the address from which the coordinator is reached, any
    /// port]
    #[arg(long, value_name = "HOST:PORT")]
    pub peer_address: Option<String>,
    /// Be killed when the parent process dies, and leave Ctrl-C to it
    #[arg(long)]
    pub die_with_parent: bool,
    /// Memory limit of a stage in GiB; a stage above it fails [default: nine tenths of the machine's]
    #[arg(long, env = "STRIDE_STAGE_MEMORY", value_name = "GIB")]
    pub stage_memory: Option<f64>,
    /// Time limit in minutes of a stage that does not train; a stage above it fails [default: no limit]
    #[arg(long, env = "STRIDE_STAGE_TIME", value_name = "MINUTES")]
    pub stage_time: Option<u64>,
    /// Exit at the latest this many seconds after SIGTERM, even if the state is not saved
    #[arg(long, value_name = "SECONDS", default_value_t = 30)]
    pub leave_within: u64,
}

impl TryFrom<JoinArgs> for Options {
    type Error = JoinError;

    fn try_from(args: JoinArgs) -> Result<Self, JoinError> {
        let unusable = |error: &dyn std::fmt::Display| JoinError::Usage(error.to_string());
        let server = args.connection.connect(&args.url).map_err(|error| match error.advice() {
            Some(advice) => JoinError::Usage(format!("{error}; {advice}")),
            None => unusable(&error),
        })?;
        let mut limits = StageLimits::default();
        if let Some(gib) = args.stage_memory {
            limits.memory = Some((gib * f64::from(1 << 30)) as u64);
        }
        limits.time = args.stage_time.map(|minutes| Duration::from_secs(60 * minutes));
        Ok(Self {
            server,
            name: args.name.map(WorkerId::new),
            labels: args.labels.into_iter().filter(|label| !label.is_empty()).collect(),
            backend: args.backend,
            device: args.device,
            cache: args.cache,
            store: args.store,
            files: match args.any_file {
                true => Files::Anywhere,
                // An empty variable names no folder.
                false => {
                    Files::Beneath(args.data_roots.into_iter().filter(|root| !root.as_os_str().is_empty()).collect())
                }
            },
            sandbox: args.sandbox,
            peer_address: args.peer_address,
            die_with_parent: args.die_with_parent,
            limits,
            leave_within: Duration::from_secs(args.leave_within),
        })
    }
}

fn label(text: &str) -> Result<String, String> {
    text.parse::<Labels>().map(|label| label.to_string()).map_err(|error| error.to_string())
}

fn backend(text: &str) -> Result<Backend, String> {
    let all = [Backend::Flex, Backend::Ndarray, Backend::Wgpu, Backend::Cuda];
    all.into_iter().find(|b| b.name() == text).ok_or_else(|| "expected flex, ndarray, wgpu or cuda".to_owned())
}
