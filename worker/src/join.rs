//! The life cycle of a worker process.

use std::io;
use std::net::{IpAddr, SocketAddr, ToSocketAddrs, UdpSocket};
use std::path::PathBuf;
use std::sync::Arc;
use std::thread::{self, JoinHandle};
use std::time::Duration;

use access::Server;
use burn::tensor::Device;
use protocol::message::{Join, PROTOCOL_VERSION};
use protocol::stage::{Backend, StageSettings};
use protocol::{Labels, WorkerId};
use stages::external::{DataAccess, open_roots};
use tokio::runtime;
use tokio::signal::unix::{SignalKind, signal};

use crate::assignments::{self, End, Shared};
use crate::cache::{Bounds, Cache};
use crate::client::Client;
use crate::gang::endpoint::Endpoint;
use crate::gang::member::Timing;
use crate::sandbox::Sandbox;
use crate::stage_limits::StageLimits;
use crate::stage_thread::{self, Bench, Kinds};
use crate::{failpoints, kinds, process};

/// Timeout of the call that reports the end of the worker.
const FAREWELL: Duration = Duration::from_secs(2);

/// Files outside the store that pipelines may name.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Files {
    /// All files that the process may read.
    Anywhere,
    /// Files below these folders.
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

/// Settings of a worker.
#[derive(Debug, Clone)]
pub struct Options {
    pub server: Server,
    /// The worker's name, unique among live workers. `None`: host and process id.
    pub name: Option<WorkerId>,
    /// Labels that stages may require.
    pub labels: Labels,
    pub backend: Backend,
    /// Number of the device of that backend.
    pub device: usize,
    /// Folder that keeps downloaded blobs.
    pub cache: Option<PathBuf>,
    /// Folder of the coordinator's store, if it is on this machine.
    pub store: Option<PathBuf>,
    /// Files outside the store that its stages may read.
    pub files: Files,
    /// Close all other files to the process.
    pub sandbox: bool,
    /// Address at which peers reach this worker, `host:port`. `None`: the address from which the coordinator is
    /// reached.
    pub peer_address: Option<String>,
    /// Die with the parent process, and leave Ctrl-C to it.
    pub die_with_parent: bool,
    pub limits: StageLimits,
    /// Time for saving and for the goodbye after a request to end. The process then exits at once.
    pub leave_within: Duration,
}

/// Failure of a worker.
#[derive(Debug, thiserror::Error)]
pub enum JoinError {
    /// The options are invalid.
    #[error("{0}")]
    Usage(String),
    /// The coordinator refuses this worker.
    #[error("{0}")]
    Refused(String),
    /// The token is missing, unknown or lacks the scope.
    #[error("{0}")]
    Unauthorized(String),
    /// The system lacks something that a worker needs.
    #[error("cannot start {what}: {source}")]
    System {
        /// The part of the worker that failed to start.
        what: &'static str,
        /// The system's error.
        source: std::io::Error,
    },
    /// A thread of the worker panicked.
    #[error("a thread of the worker has panicked")]
    Fault,
}

impl JoinError {
    /// Exit code of the process: 2 for wrong usage, 3 for our fault, 5 for a token without the right, 1 otherwise.
    pub fn exit_code(&self) -> u8 {
        match self {
            Self::Usage(_) => 2,
            Self::Refused(_) | Self::System { .. } => 1,
            Self::Fault => 3,
            Self::Unauthorized(_) => 5,
        }
    }
}

/// Lines that are logged without `RUST_LOG`.
pub const LOGGED: &str = "info";

/// Works for a coordinator until it asks the worker to leave or the process is asked to end.
///
/// Call this from `main` before other threads start, after [`tune_allocator`](process::tune_allocator).
/// SIGTERM drains the worker: the running stage saves a checkpoint and is released. SIGINT does the same unless a
/// parent handles it. If draining takes longer than [`Options::leave_within`], for example because the coordinator is
/// unreachable, the process exits with code 1. Acknowledged work is stored, and the task continues from there.
pub fn join(options: Options) -> Result<(), JoinError> {
    if options.die_with_parent {
        process::belong_to_parent();
    }
    if options.sandbox {
        let read = match &options.files {
            Files::Anywhere => vec![PathBuf::from("/")],
            Files::Beneath(folders) => folders.clone(),
        };
        let read = read.into_iter().chain(options.store.clone()).collect();
        if let Some(cache) = &options.cache {
            std::fs::create_dir_all(cache).map_err(|source| JoinError::System { what: "the blob cache", source })?;
        }
        let sandbox = Sandbox { read, write: options.cache.iter().cloned().collect() };
        sandbox.enter().map_err(|error| JoinError::Usage(error.to_string()))?;
    }
    failpoints::arm_from_env();
    stage_thread::log_panics();
    // The one place that counts devices: number 3 here is number 3 of `trainer devices`.
    let device = models::device::open(options.backend, options.device);
    let device = device.map_err(|error| JoinError::Usage(error.to_string()))?;
    work(options, device, Arc::new(kinds::Stages), Timing::default())
}

fn work(options: Options, device: Device, kinds: Arc<dyn Kinds>, timing: Timing) -> Result<(), JoinError> {
    let name = name(&options)?;
    if !options.server.is_encrypted() && !options.server.is_local() {
        tracing::warn!(
            "`{}` has no TLS: others on the network can read the token, the gangs' secrets and all data, and with a \
             secret also the exchange between peers",
            options.server.url()
        );
    }
    let data = Arc::new(options.files.open()?);
    let runtime = runtime::Builder::new_multi_thread().worker_threads(1).thread_name("http").enable_all().build();
    let runtime = runtime.map_err(system("the HTTP thread"))?;
    let client = Client::new(options.server.clone(), runtime.handle().clone());
    let (bind, advertised) = peer_address(&options)?;
    let endpoint = Endpoint::open(bind, timing).map_err(system("the peer listener"))?;
    let cache = Cache::new(options.cache.clone(), options.store.clone(), Bounds::default())
        .map_err(system("the blob cache"))?;
    let shared = Shared::new(endpoint.clone());
    let watch = async { watch_signals(shared.clone(), options.die_with_parent, options.leave_within) };
    runtime.block_on(watch).map_err(system("signal handling"))?;

    let cache = Arc::new(cache);
    let preparer = start_preparing(&shared, &client, &cache)?;
    let bench = Bench { kinds, client: client.clone(), cache, data, device, limits: options.limits.clone() };
    let stage = start_stages(&shared, bench)?;
    let offer = Join {
        protocol: PROTOCOL_VERSION,
        worker: name,
        pid: std::process::id(),
        backend: options.backend,
        instruction_set: models::instruction_set().to_owned(),
        code_versions: StageSettings::code_versions(),
        peer_address: advertised.unwrap_or_else(|| endpoint.address().to_string()),
        labels: options.labels.clone(),
    };
    let end = runtime.block_on(assignments::follow(&client, &offer, &shared));
    shared.end("this worker leaves");
    stage.join().map_err(|_| JoinError::Fault)?;
    preparer.join().map_err(|_| JoinError::Fault)?;
    match end {
        End::Left => {}
        End::Refused(reason) => return Err(JoinError::Refused(reason)),
        End::Unauthorized(reason) => return Err(JoinError::Unauthorized(reason)),
    }
    // Spares the coordinator the wait for the end of our lease. If this call is lost, the lease simply expires.
    let left = runtime.block_on(async { tokio::time::timeout(FAREWELL, client.leave(&offer.worker)).await });
    if !matches!(left, Ok(Ok(()))) {
        tracing::debug!("cannot tell the coordinator that this worker leaves; its lease will expire");
    }
    Ok(())
}

fn system(what: &'static str) -> impl Fn(io::Error) -> JoinError {
    move |source| JoinError::System { what, source }
}

/// Starts the thread that fetches inputs ahead.
fn start_preparing(shared: &Arc<Shared>, client: &Client, cache: &Arc<Cache>) -> Result<JoinHandle<()>, JoinError> {
    let shared = shared.clone();
    let client = client.clone();
    let cache = Arc::clone(cache);
    let run = move || shared.preparation.run(&client, &cache);
    thread::Builder::new().name("prepare".to_owned()).spawn(run).map_err(system("the prefetch thread"))
}

/// Starts the thread on which stages compute.
fn start_stages(shared: &Arc<Shared>, bench: Bench) -> Result<JoinHandle<()>, JoinError> {
    let shared = shared.clone();
    let run = move || {
        process::compute_here();
        stage_thread::run(&shared, &bench);
    };
    // Graphs of several thousand nodes are dropped recursively.
    let builder = thread::Builder::new().name("stage".to_owned()).stack_size(64 << 20);
    builder.spawn(run).map_err(system("the stage thread"))
}

/// The worker's name, which defaults to one made of host and process.
fn name(options: &Options) -> Result<WorkerId, JoinError> {
    let name = options.name.clone().unwrap_or_else(|| WorkerId::new(process::default_name()));
    if protocol::id::is_name(name.as_str()) {
        return Ok(name);
    }
    Err(JoinError::Usage(format!(
        "`{name}` is not a valid worker name; expected a letter or digit, then letters, digits, `.`, `_` or `-`, at \
         most 64 characters"
    )))
}

/// The address to listen on for peers, and the address to announce if it is another one.
fn peer_address(options: &Options) -> Result<(SocketAddr, Option<String>), JoinError> {
    if let Some(address) = &options.peer_address {
        let port = address.rsplit_once(':').and_then(|(_, port)| port.parse::<u16>().ok());
        let port = port
            .ok_or_else(|| JoinError::Usage(format!("`{address}` is not an address for peers; expected HOST:PORT")))?;
        return Ok((SocketAddr::from(([0, 0, 0, 0], port)), Some(address.clone())));
    }
    let urls = options.server.urls();
    match urls.split(',').find_map(own_address) {
        Some(ip) => Ok((SocketAddr::new(ip, 0), None)),
        None => Err(JoinError::Usage(format!(
            "there is no route to `{urls}`, so the address for other workers is unknown; check the URL, or pass \
             --peer-address HOST:PORT"
        ))),
    }
}

/// This machine's address from which the host of `url` is reached; `None` if there is no route to it.
fn own_address(url: &str) -> Option<IpAddr> {
    let url = reqwest::Url::parse(url).ok()?;
    let host = url.host_str()?.trim_matches(['[', ']']);
    let port = url.port_or_known_default().unwrap_or(80);
    (host, port).to_socket_addrs().ok()?.find_map(|coordinator| {
        let any = if coordinator.is_ipv4() { IpAddr::from([0; 4]) } else { IpAddr::from([0u16; 8]) };
        // Sends nothing: the kernel picks the route, and with it our address.
        let socket = UdpSocket::bind((any, 0)).ok()?;
        socket.connect(coordinator).ok()?;
        Some(socket.local_addr().ok()?.ip())
    })
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
                tracing::info!("draining: saving and releasing the running task");
                shared.leave();
                // A separate thread, so that nothing that waits on the runtime or for the coordinator delays the exit.
                thread::spawn(move || {
                    thread::sleep(leave_within);
                    tracing::error!(
                        "the worker did not finish within {} s after it was asked to leave; ending now; acknowledged \
                         work is stored",
                        leave_within.as_secs_f64()
                    );
                    std::process::exit(1);
                });
            }
        }
    });
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_address_without_a_route_leaves_the_next_one() {
        let loopback = Some(IpAddr::from([127, 0, 0, 1]));
        assert_eq!(own_address("https://no-such-host.invalid:7700"), None);
        assert_eq!(own_address("http://127.0.0.1:7700"), loopback);
        let urls = "https://no-such-host.invalid:7700,http://127.0.0.1:7700";
        assert_eq!(urls.split(',').find_map(own_address), loopback);
    }
}
