//! The life of a worker process.

use std::net::{IpAddr, SocketAddr, ToSocketAddrs, UdpSocket};
use std::path::PathBuf;
use std::sync::Arc;
use std::thread;
use std::time::Duration;

use access::Server;
use burn::tensor::Device;
use protocol::WorkerId;
use protocol::message::{Join, PROTOCOL_VERSION};
use protocol::stage::Backend;
use stages::external::{DataAccess, open_roots};
use tokio::runtime;
use tokio::signal::unix::{SignalKind, signal};

use crate::assignments::{self, End, Shared};
use crate::cache::{Bounds, Cache};
use crate::client::Client;
use crate::gang::endpoint::Endpoint;
use crate::gang::member::Timing;
use crate::stage_limits::StageLimits;
use crate::stage_thread::{self, Bench, Kinds};
use crate::{failpoints, kinds, process};

/// How long the coordinator may take to hear that we leave.
const FAREWELL: Duration = Duration::from_secs(2);

/// Which files outside the store pipelines may name.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Files {
    /// All that the process may read.
    Anywhere,
    /// Those below these folders.
    Beneath(Vec<PathBuf>),
}

impl Files {
    fn open(&self) -> Result<DataAccess, JoinError> {
        match self {
            Self::Anywhere => Ok(DataAccess::anywhere(process::host_name())),
            Self::Beneath(folders) => {
                let roots = open_roots(folders).map_err(JoinError::Usage)?;
                Ok(DataAccess::beneath(roots, process::host_name()))
            }
        }
    }
}

/// How a worker takes part.
#[derive(Debug, Clone)]
pub struct Options {
    /// The coordinator.
    pub server: Server,
    /// The worker's name, unique among live workers; host and process id if there is none.
    pub name: Option<WorkerId>,
    /// Where to compute.
    pub backend: Backend,
    /// Which device of that backend.
    pub device: usize,
    /// Keep downloaded blobs in this folder.
    pub cache: Option<PathBuf>,
    /// The folder of the coordinator's store, if it is on this machine.
    pub store: Option<PathBuf>,
    /// Which files outside the store its stages may read.
    pub files: Files,
    /// Where peers reach this worker, `host:port`; the address from which the coordinator is reached if `None`.
    pub peer_address: Option<String>,
    /// Be killed when the parent dies, and leave Ctrl-C to it.
    pub die_with_parent: bool,
    /// Limits of a stage.
    pub limits: StageLimits,
    /// How long saving and saying goodbye may take once the process was asked to end; then it ends at once.
    pub leave_within: Duration,
}

/// Why a worker ended other than in good order.
#[derive(Debug, thiserror::Error)]
pub enum JoinError {
    /// The options cannot be followed.
    #[error("{0}")]
    Usage(String),
    /// The coordinator does not want this worker.
    #[error("{0}")]
    Refused(String),
    /// The machine does not give what a worker needs.
    #[error("{what}: {source}")]
    System {
        /// What was asked for.
        what: &'static str,
        /// Why it failed.
        source: std::io::Error,
    },
    /// A thread of ours panicked.
    #[error("a thread of the worker has panicked")]
    Fault,
}

impl JoinError {
    /// What the process exits with: 2 for wrong usage, 3 for our fault, 1 otherwise.
    pub fn exit_code(&self) -> u8 {
        match self {
            Self::Usage(_) => 2,
            Self::Refused(_) | Self::System { .. } => 1,
            Self::Fault => 3,
        }
    }
}

/// Plain lines on standard error, chosen by `RUST_LOG`; standard output stays free. Does nothing if there is a log already.
pub fn init_logging() {
    let filter = tracing_subscriber::EnvFilter::try_from_default_env()
        .unwrap_or_else(|_| tracing_subscriber::EnvFilter::new("info"));
    let log = tracing_subscriber::fmt().with_env_filter(filter).with_writer(std::io::stderr).with_ansi(false);
    // A second subscriber is refused; the first one's lines are as good. A line that nobody reads any more is dropped, without a panic.
    let _ = log.log_internal_errors(false).try_init();
}

/// Works for a coordinator until that says to leave or the process is asked to end.
///
/// To be called from `main` before other threads are started, after [`tune_allocator`](process::tune_allocator).
/// SIGTERM, and SIGINT unless a parent takes care of it, drains it: what runs saves a checkpoint and is released. If that is not over
/// after [`Options::leave_within`], be it that no coordinator is there to take the checkpoint, the process ends as it is with exit code 1:
/// what was acknowledged is stored, and the task goes on from there.
pub fn join(options: Options) -> Result<(), JoinError> {
    if options.die_with_parent {
        process::belong_to_parent();
    }
    failpoints::arm_from_env();
    stage_thread::log_panics();
    // The one place that counts devices: number 3 here is number 3 of `trainer devices`.
    let device = models::device::open(options.backend, options.device);
    let device = device.map_err(|error| JoinError::Usage(error.to_string()))?;
    work(options, device, Arc::new(kinds::Stages), Timing::default())
}

fn work(options: Options, device: Device, kinds: Arc<dyn Kinds>, timing: Timing) -> Result<(), JoinError> {
    let system = |what| move |source| JoinError::System { what, source };
    let name = options.name.clone().unwrap_or_else(|| WorkerId::new(process::default_name()));
    if !protocol::id::is_name(name.as_str()) {
        return Err(JoinError::Usage(format!(
            "`{name}` is not a worker name: expected a letter or digit, then letters, digits, `.`, `_` or `-`, at most 64"
        )));
    }
    if !options.server.is_encrypted() && !options.server.is_local() {
        tracing::warn!(
            "`{}` has no TLS: its token, the gangs' secrets and all data cross the network readable; so does what peers exchange, to anybody who saw a secret",
            options.server.url()
        );
    }
    let data = Arc::new(options.files.open()?);
    let runtime = runtime::Builder::new_multi_thread().worker_threads(1).thread_name("http").enable_all().build();
    let runtime = runtime.map_err(system("the HTTP thread"))?;
    let client = Client::new(options.server.clone(), runtime.handle().clone());
    let (bind, advertised) = peer_address(&options)?;
    let endpoint = Endpoint::open(bind, timing).map_err(system("the listener for peers"))?;
    let cache = Cache::new(options.cache.clone(), options.store.clone(), Bounds::default())
        .map_err(system("the blob cache"))?;
    let shared = Shared::new(endpoint.clone());
    let watch = async { watch_signals(shared.clone(), options.die_with_parent, options.leave_within) };
    runtime.block_on(watch).map_err(system("signals"))?;

    let cache = Arc::new(cache);
    let preparer = {
        let (shared, client, cache) = (shared.clone(), client.clone(), cache.clone());
        let run = move || shared.preparation.run(&client, &cache);
        thread::Builder::new().name("prepare".to_owned()).spawn(run).map_err(system("the thread that fetches ahead"))?
    };
    let bench = Bench { kinds, client: client.clone(), cache, data, device, limits: options.limits.clone() };
    let stage = {
        let shared = shared.clone();
        let run = move || {
            process::compute_here();
            stage_thread::run(&shared, &bench);
        };
        // Graphs of some thousand nodes are dropped recursively.
        thread::Builder::new()
            .name("stage".to_owned())
            .stack_size(64 << 20)
            .spawn(run)
            .map_err(system("the stage thread"))?
    };
    let offer = Join {
        protocol: PROTOCOL_VERSION,
        worker: name,
        pid: std::process::id(),
        backend: options.backend,
        instruction_set: models::instruction_set().to_owned(),
        peer_address: advertised.unwrap_or_else(|| endpoint.address().to_string()),
    };
    let end = runtime.block_on(assignments::follow(&client, &offer, &shared));
    shared.end("this worker leaves");
    stage.join().map_err(|_| JoinError::Fault)?;
    preparer.join().map_err(|_| JoinError::Fault)?;
    match end {
        End::Left => {
            // Spares the coordinator the wait for our lease to run out; if it does not hear it, that is what happens.
            let told = runtime.block_on(async { tokio::time::timeout(FAREWELL, client.leave(&offer.worker)).await });
            if !matches!(told, Ok(Ok(()))) {
                tracing::debug!("the coordinator did not hear that this worker leaves");
            }
            Ok(())
        }
        End::Refused(reason) => Err(JoinError::Refused(reason)),
    }
}

/// Where to listen for peers, and what to tell them if it is not that.
fn peer_address(options: &Options) -> Result<(SocketAddr, Option<String>), JoinError> {
    if let Some(address) = &options.peer_address {
        let port = address.rsplit_once(':').and_then(|(_, port)| port.parse::<u16>().ok());
        let port = port
            .ok_or_else(|| JoinError::Usage(format!("`{address}` is not an address for peers: expected HOST:PORT")))?;
        return Ok((SocketAddr::from(([0, 0, 0, 0], port)), Some(address.clone())));
    }
    let url = options.server.url();
    let url = reqwest::Url::parse(url).map_err(|e| JoinError::Usage(format!("`{url}`: {e}")))?;
    let host = url.host_str().unwrap_or_default().trim_matches(['[', ']']).to_owned();
    let port = url.port_or_known_default().unwrap_or(80);
    let local = (host.as_str(), port).to_socket_addrs().ok().into_iter().flatten().find_map(|coordinator| {
        let any = if coordinator.is_ipv4() { IpAddr::from([0; 4]) } else { IpAddr::from([0u16; 8]) };
        // Sends nothing: the kernel picks the route, and with it our address.
        let socket = UdpSocket::bind((any, 0)).ok()?;
        socket.connect(coordinator).ok()?;
        Some(socket.local_addr().ok()?.ip())
    });
    match local {
        Some(ip) => Ok((SocketAddr::new(ip, 0), None)),
        None => Err(JoinError::Usage(format!(
            "no route to `{host}`, so no address to give to other workers; check the URL or pass --peer-address HOST:PORT"
        ))),
    }
}

fn watch_signals(shared: Arc<Shared>, owned: bool, leave_within: Duration) -> std::io::Result<()> {
    let mut terminate = signal(SignalKind::terminate())?;
    let mut interrupt = signal(SignalKind::interrupt())?;
    tokio::spawn(async move {
        let mut interrupts = 0;
        loop {
            tokio::select! {
                _ = terminate.recv() => {}
                _ = interrupt.recv() => {
                    if owned {
                        continue;
                    }
                    interrupts += 1;
                    if interrupts > 1 {
                        std::process::exit(130);
                    }
                }
            }
            if !shared.is_leaving() {
                tracing::info!("draining: what runs is saved and released");
                shared.leave();
                // A thread, so that nothing that waits on the runtime or for the coordinator puts it off.
                thread::spawn(move || {
                    thread::sleep(leave_within);
                    tracing::error!(
                        "not done {} s after it was asked to leave; ending now: what was acknowledged is stored",
                        leave_within.as_secs_f64()
                    );
                    std::process::exit(1);
                });
            }
        }
    });
    Ok(())
}
