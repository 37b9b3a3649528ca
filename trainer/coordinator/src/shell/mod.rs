//! HTTP server, clock and execution of effects. This is the only async code of the crate.
//!
//! One task, the `actor`, owns the state and decides events one by one: it copies the state, decides, stores, and only
//! then publishes the copy. A refused transaction therefore leaves no trace. All other tasks read published copies.

mod actor;
mod actor_handle;
mod allowances;
mod api;
mod audit;
mod auth;
mod blocking;
mod body;
mod bundles;
mod checkpoints;
mod clock;
mod curves;
mod demand;
mod described;
mod draws;
mod effects;
mod events;
mod extract;
mod failure;
mod launchers;
mod line;
mod lines;
mod listener;
mod meters;
mod openapi;
mod paced;
mod page_files;
mod polls;
mod progress;
mod queries;
mod rate;
mod reasons;
mod records;
mod revocable;
mod route;
mod route_server;
mod run_settings;
mod run_times;
mod scrape;
mod secrets;
mod session_calls;
mod sessions;
mod settings;
mod spans;
mod start_error;
mod storage;
mod streams;
mod tickets;
mod token_table;
mod turn;
mod uploads;
mod versions;
mod vouching;
mod webhooks;

use std::net::{Ipv4Addr, SocketAddr};
use std::sync::Arc;
use std::time::Duration;

use ::webhooks::Hooks;
use access::tls::ServerTls;
use access::{Caller, Scope, Scopes, Token, Tokens};
use protocol::message::{FailureClass, ReportOutcome, RunView, Submit, TaskOutcome};
use protocol::{Owner, RunId, WorkerId};
use registry::Store;
use registry::audit::AuditLog;
use tokio::sync::watch;
use tokio::task::JoinHandle;

use crate::batch::Refused;
use crate::event::Event;
use crate::journal;
use crate::policy::Policy;
use crate::state::run::Control;
use crate::view::WorkerView;

use self::actor_handle::ActorHandle;
pub use self::allowances::Allowances;
pub use self::api::{openapi, routes};
use self::auth::Gate;
pub use self::checkpoints::{CheckpointName, KeptCheckpoint};
pub use self::curves::{CurveSeries, Curves};
pub use self::draws::{Draw, Drawing};
use self::listener::Listener;
pub use self::listener::{Connections, raise_descriptor_limit};
pub use self::queries::Submitted;
pub use self::records::{Records, RecordsError, StageCurves, StageMetrics};
pub use self::route::Route;
pub use self::route_server::RouteServer;
pub use self::run_settings::{ReasonKind, RunSettings, SettingChange, SettingsOfStage, StageReason};
use self::secrets::Secrets;
use self::sessions::Sessions;
pub use self::start_error::StartError;
pub use self::tickets::{STREAM_PROTOCOL, StreamOffer};
pub use self::token_table::Standing;
use self::token_table::TokenTable;
pub use self::versions::resolve_versions;

/// Settings of a coordinator.
#[derive(Debug, Clone)]
pub struct Config {
    /// The listening address; port 0 selects a free port.
    pub listen: SocketAddr,
    /// Tokens of callers. Every start makes another one for commands on this machine: [`Handle::token`].
    pub tokens: Tokens,
    /// Host names of this server, in addition to the machine's own name and its addresses.
    pub hosts: Vec<String>,
    /// TLS for all connections from other machines.
    pub tls: Option<ServerTls>,
    /// Allows tokens to cross a network unencrypted.
    pub insecure: bool,
    /// Limits of connections.
    pub connections: Connections,
    /// Limits of runs and tokens.
    pub allowances: Allowances,
    /// Addresses that get messages about runs and models.
    pub hooks: Hooks,
    /// Time before the first repetition of a message to a hook; each further one takes six times as long.
    pub hook_retry: Duration,
    /// The stream that the page offers.
    pub stream: Option<StreamOffer>,
    pub policy: Policy,
    /// Treats all workers of an earlier coordinator as gone. `trainer run` sets it, because it starts its own workers.
    pub alone: bool,
    /// Pauses runs of an earlier coordinator until a client resumes them.
    pub park: bool,
}

impl Config {
    /// Settings for `trainer run`: this machine only, any port, own workers.
    pub fn embedded() -> Self {
        Self { alone: true, park: true, ..Self::server(SocketAddr::from((Ipv4Addr::LOCALHOST, 0)), Tokens::default()) }
    }

    /// Settings for `trainer serve`: earlier workers may still be running and reconnect.
    pub fn server(listen: SocketAddr, tokens: Tokens) -> Self {
        Self {
            listen,
            tokens,
            hosts: Vec::new(),
            tls: None,
            insecure: false,
            connections: Connections::default(),
            allowances: Allowances::default(),
            hooks: Hooks::default(),
            hook_retry: Duration::from_secs(5),
            stream: None,
            policy: Policy::default(),
            alone: false,
            park: false,
        }
    }

    /// Checks that callers at the listening address are authenticated and encrypted as required.
    pub fn check(&self) -> Result<(), StartError> {
        if self.listen.ip().is_loopback() {
            return Ok(());
        }
        if self.tokens.is_empty() {
            return Err(StartError::NoToken(self.listen));
        }
        if self.tls.is_none() && !self.insecure {
            return Err(StartError::NoTls(self.listen));
        }
        Ok(())
    }
}

/// A reason why a coordinator makes no progress.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Trouble {
    /// The store refused the newest write, for lack of space or permission; it may accept the next one.
    Store(String),
    /// A part of the coordinator panicked, and all further requests are refused. Acknowledged work is stored, and
    /// another process can continue it.
    Failed(String),
}

/// Entry point for starting coordinators.
#[derive(Debug)]
pub struct Coordinator;

impl Coordinator {
    /// Recovers the state from `store` and starts listening.
    pub async fn start(store: Store, config: Config) -> Result<Handle, StartError> {
        config.check()?;
        let policy = Policy { live_runs: config.allowances.runs, ..config.policy.clone() };
        let recovered = journal::recover_both(policy, &store.recovery().await?)?;
        let listen = |address| move |cause| StartError::Listen { address, cause };
        let main = Listener::bind(config.listen, config.tls.as_ref().map(ServerTls::config))
            .await
            .map_err(listen(config.listen))?;
        let address = main.address().map_err(listen(config.listen))?;
        let mut listeners = vec![main];
        let mut local = address;
        if config.tls.is_some() || !config.listen.ip().is_loopback() {
            // For commands on this machine, which do not know the server's names or its certificate.
            let here = SocketAddr::from((Ipv4Addr::LOCALHOST, 0));
            let here = Listener::bind(here, None).await.map_err(listen(here))?;
            local = here.address().map_err(listen(config.listen))?;
            listeners.push(here);
        }
        let token = Token::random();
        let worker_token = Token::random();
        let own = vec![
            (Caller::new(user(), Scopes::all()), token.clone()),
            (Caller::new(OWN_WORKERS, Scopes::of(&[Scope::Worker])), worker_token.clone()),
        ];
        let tokens = Arc::new(TokenTable::new(config.tokens.clone(), own));

        let log = AuditLog::of(store.dir());
        let key = store.server_key().map_err(StartError::Key)?;
        let secrets = Secrets::new(key);
        let sessions = Arc::new(Sessions::new(Secrets::new(key)));
        let (actor_handle, actor) =
            actor::start(store, recovered, secrets, Arc::clone(&tokens), config.allowances.clone());
        actor_handle.decide(Event::Started { alone: config.alone, park: config.park }).await?;
        effects::let_go(&actor_handle).await;
        webhooks::enlist(&actor_handle.store, &config.hooks).await.map_err(Refused::from)?;
        let (stop, stopped) = watch::channel(false);
        let tick = effects::tick(actor_handle.clone(), config.policy.tick_ms, stopped.clone());
        let clock = actor_handle.spawn("the clock", tick);
        let gate = Gate::new(tokens, &config.hosts, config.allowances.calls)
            .with_sessions(Arc::clone(&sessions), config.stream.clone());
        let gate = Arc::new(gate);
        let audit = actor_handle.spawn("the audit log", audit::write(Arc::clone(&gate.audit), log, stopped.clone()));
        let router = api::router(actor_handle.clone(), &gate);
        let serve = listener::serve(listeners, router, config.connections.clone(), stopped);
        let server = actor_handle.spawn("the server", serve);
        tracing::info!(%address, "coordinator listens");
        let quiet = progress::watch(actor_handle.clone(), config.allowances.quiet);
        let quiet = actor_handle.spawn("the watch over progress", quiet);
        let (hooks, listed) = watch::channel(config.hooks);
        let telling = webhooks::serve(actor_handle.clone(), listed, config.hook_retry);
        let telling = actor_handle.spawn("the webhooks", telling);
        let leading = Arc::clone(&actor_handle).end_when_superseded(actor_handle.stopped());
        let leading = actor_handle.spawn("the leadership", leading);
        let tls = config.tls.clone();
        let tasks = vec![clock, server, audit, quiet, telling, leading, actor];
        Ok(Handle { address, local, tls, token, worker_token, sessions, hooks, actor_handle, stop, tasks })
    }
}

/// The token name of workers started by this process. Token files cannot contain it, because names have no spaces.
const OWN_WORKERS: &str = "own workers";

/// The name of the process's user.
fn user() -> String {
    let uid = nix::unistd::geteuid();
    nix::unistd::User::from_uid(uid).ok().flatten().map_or_else(|| format!("uid-{uid}"), |user| user.name)
}

/// A running coordinator. Dropping it stops it like `kill -9`: no acknowledged work is lost.
#[derive(Debug)]
pub struct Handle {
    address: SocketAddr,
    local: SocketAddr,
    tls: Option<ServerTls>,
    token: Token,
    worker_token: Token,
    sessions: Arc<Sessions>,
    hooks: watch::Sender<Hooks>,
    actor_handle: Arc<ActorHandle>,
    stop: watch::Sender<bool>,
    tasks: Vec<JoinHandle<()>>,
}

impl Handle {
    /// The listening address.
    pub fn address(&self) -> SocketAddr {
        self.address
    }

    /// The server's URL.
    pub fn url(&self) -> String {
        format!("{}://{}", if self.tls.is_some() { "https" } else { "http" }, self.address)
    }

    /// The server's URL for processes on this machine, never encrypted.
    pub fn local_url(&self) -> String {
        format!("http://{}", self.local)
    }

    /// The address of its page, with a key in the fragment that signs this process's user in. It is good once, for an hour.
    pub fn page_link(&self) -> String {
        self.page_link_at(&self.url())
    }

    /// The same for a server that its callers reach at `url`.
    pub fn page_link_at(&self, url: &str) -> String {
        format!("{url}/#key={}", self.sessions.key())
    }

    /// A token with all scopes, valid for the life of this coordinator. Its name is the user's.
    pub fn token(&self) -> &Token {
        &self.token
    }

    /// A token with the scope `worker` for workers that this process starts, valid for the life of this coordinator.
    pub fn worker_token(&self) -> &Token {
        &self.worker_token
    }

    /// Submits a pipeline, which is stored when this returns.
    pub async fn submit(&self, submit: Submit) -> Result<RunId, Refused> {
        self.actor_handle.submit(submit, Owner::local(user()), None).await
    }

    /// Replaces the table of tokens. Active calls with a removed token are aborted.
    pub fn replace_tokens(&self, tokens: Tokens) {
        self.actor_handle.tokens.replace(tokens);
    }

    /// Reads the files of the certificate again, for new connections. Without TLS, there is nothing to read.
    ///
    /// # Errors
    /// A file has a mistake; the server keeps its certificate.
    pub fn reload_certificate(&self) -> Result<(), access::FileError> {
        self.tls.as_ref().map_or(Ok(()), ServerTls::reload)
    }

    /// Replaces the list of webhooks. A message that is on its way is sent again.
    pub async fn replace_hooks(&self, hooks: Hooks) -> Result<(), Refused> {
        webhooks::enlist(&self.actor_handle.store, &hooks).await?;
        self.hooks.send_if_modified(|listed| {
            let changed = *listed != hooks;
            *listed = hooks;
            changed
        });
        Ok(())
    }

    /// Pauses, resumes or cancels a run.
    pub async fn control(&self, run: &RunId, action: Control) -> Result<(), Refused> {
        self.actor_handle.control(run, action).await
    }

    /// A run as clients see it, active or ended.
    pub async fn run_view(&self, run: &RunId) -> Result<RunView, Refused> {
        self.actor_handle.run_view(run).await
    }

    /// The settings of a run's stages, and why each was computed.
    pub async fn settings(&self, run: &RunId) -> Result<RunSettings, Refused> {
        self.actor_handle.records_for(None).settings(run).await
    }

    /// Views of all workers.
    pub fn workers(&self) -> Vec<WorkerView> {
        self.actor_handle.state().worker_views()
    }

    /// Reports that the launcher saw a worker's process exit. The name becomes free at once.
    pub async fn worker_gone(&self, worker: &WorkerId) -> Result<(), Refused> {
        self.actor_handle.decide(Event::WorkerGone { worker: worker.clone(), incarnation: None }).await.map(drop)
    }

    /// Reports the end of an assignment for a worker whose process has exited. Does nothing if it held no task.
    pub async fn fail_for(&self, worker: &WorkerId, class: FailureClass, message: String) -> Result<(), Refused> {
        let state = self.actor_handle.state();
        let (Some(known), Some((_, task))) = (state.workers.get(worker), state.held_by(worker)) else { return Ok(()) };
        let grant = task.grant_of(worker, known.incarnation);
        let report = ReportOutcome::new(grant, TaskOutcome::Failed { class, message });
        self.actor_handle.decide(Event::Outcome { report }).await.map(drop)
    }

    /// Asks all workers to save and leave, and grants no more work.
    pub async fn drain(&self) -> Result<(), Refused> {
        self.actor_handle.decide(Event::Drain).await.map(drop)
    }

    /// Returns true if an execution still has a busy worker.
    pub fn is_busy(&self) -> bool {
        self.actor_handle.state().executions.values().any(|execution| execution.is_busy())
    }

    /// The number of facts recorded since this coordinator started.
    pub fn facts(&self) -> u64 {
        self.actor_handle.state().recorded
    }

    /// A receiver that is notified of durable changes.
    pub fn changes(&self) -> watch::Receiver<u64> {
        self.actor_handle.changes()
    }

    /// The current problem, if any. The surrounding process should report it and stop.
    pub fn trouble(&self) -> Option<Trouble> {
        let failure = self.actor_handle.failure().map(|failure| Trouble::Failed(failure.to_owned()));
        failure.or_else(|| self.actor_handle.trouble().map(Trouble::Store))
    }

    /// Waits for a panic in a part of the coordinator and returns its message.
    pub async fn failed(&self) -> String {
        let mut changes = self.changes();
        loop {
            changes.mark_unchanged();
            if let Some(failure) = self.actor_handle.failure() {
                return failure.to_owned();
            }
            if changes.changed().await.is_err() {
                return std::future::pending().await;
            }
        }
    }

    /// Stops at once and stores a snapshot of the final state. Acknowledged work is in the store, and a later start
    /// continues it.
    pub async fn shutdown(mut self) {
        let _ = self.stop.send(true);
        self.actor_handle.stop();
        for task in std::mem::take(&mut self.tasks) {
            // It does not matter how the task ended.
            let _ = task.await;
        }
        effects::let_go(&self.actor_handle).await;
        actor::snapshot(&self.actor_handle, &self.actor_handle.state()).await;
    }
}

impl Drop for Handle {
    fn drop(&mut self) {
        let _ = self.stop.send(true);
        self.actor_handle.stop();
    }
}
