//! The thin half: server, clock, runner of effects. The only async code of the crate.
//!
//! One task, the `actor`, owns the state and decides events one by one: copy, decide, store, and only then publish the
//! copy. What a refused transaction would have changed has therefore never been. Everybody else reads published copies.

mod actor;
mod actor_handle;
mod allowances;
mod api;
mod audit;
mod auth;
mod blocking;
mod body;
mod bundles;
mod clock;
mod door;
mod effects;
mod failure;
mod listener;
mod paced;
mod polls;
mod queries;
mod rate;
mod records;
mod revocable;
mod route;
mod secrets;
mod start_error;
mod storage;
mod token_table;
mod uploads;
mod versions;
mod vouching;

use std::net::{Ipv4Addr, SocketAddr};
use std::sync::Arc;

use access::{Caller, Scope, Scopes, Token, Tokens};
use protocol::message::{FailureClass, ReportOutcome, RunView, Submit, TaskOutcome};
use protocol::{Owner, RunId, WorkerId};
use registry::Store;
use registry::audit::AuditLog;
use rustls::ServerConfig;
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
pub use self::api::routes;
use self::auth::Gate;
pub use self::door::Door;
use self::listener::Listener;
pub use self::listener::{Connections, raise_descriptor_limit};
pub use self::queries::Submitted;
pub use self::records::{Records, RecordsError, StageMetrics};
pub use self::route::Route;
use self::secrets::Secrets;
pub use self::start_error::StartError;
pub use self::token_table::Standing;
use self::token_table::TokenTable;
pub use self::versions::resolve_versions;

/// How a coordinator is run.
#[derive(Debug, Clone)]
pub struct Config {
    /// Where to listen; port 0 takes a free one.
    pub listen: SocketAddr,
    /// Who may ask. One token more, for this machine's command line, is made at every start: [`Handle::token`].
    pub tokens: Tokens,
    /// Names by which callers know this server, besides the machine's own and its addresses.
    pub hosts: Vec<String>,
    /// Encrypts all but what stays on this machine.
    pub tls: Option<Arc<ServerConfig>>,
    /// Whether tokens may cross a network as they are.
    pub insecure: bool,
    /// How many connections there may be.
    pub connections: Connections,
    /// Limits of runs and tokens.
    pub allowances: Allowances,
    /// Times and budgets.
    pub policy: Policy,
    /// No worker of an earlier coordinator can reach this one (`trainer run` starts its own): theirs are gone for certain.
    pub alone: bool,
    /// Runs of earlier are paused until they are asked for again.
    pub park: bool,
}

impl Config {
    /// For `trainer run`: this machine only, any port, own workers.
    pub fn embedded() -> Self {
        Self { alone: true, park: true, ..Self::server(SocketAddr::from((Ipv4Addr::LOCALHOST, 0)), Tokens::default()) }
    }

    /// For `trainer serve`: workers of before may still be at work and re-attach.
    pub fn server(listen: SocketAddr, tokens: Tokens) -> Self {
        Self {
            listen,
            tokens,
            hosts: Vec::new(),
            tls: None,
            insecure: false,
            connections: Connections::default(),
            allowances: Allowances::default(),
            policy: Policy::default(),
            alone: false,
            park: false,
        }
    }

    /// Whether it may listen where it is to, as far as its callers are concerned.
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

/// Why a coordinator does not go on.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Trouble {
    /// The store refused the newest write, for want of space or permission; it may take the next one.
    Store(String),
    /// A part of the coordinator has panicked: every request is refused from then on. What was acknowledged is stored, and
    /// another process goes on from there.
    Failed(String),
}

/// Starts coordinators.
#[derive(Debug)]
pub struct Coordinator;

impl Coordinator {
    /// Recovers from the snapshot and the facts in `store`, then listens.
    pub async fn start(store: Store, config: Config) -> Result<Handle, StartError> {
        config.check()?;
        let policy = Policy { live_runs: config.allowances.runs, ..config.policy.clone() };
        let recovered = journal::recover_both(policy, &store.recovery().await?)?;
        let listen = |address| move |cause| StartError::Listen { address, cause };
        let main = Listener::bind(config.listen, config.tls.clone()).await.map_err(listen(config.listen))?;
        let address = main.address().map_err(listen(config.listen))?;
        let (mut listeners, mut local) = (vec![main], address);
        if config.tls.is_some() || !config.listen.ip().is_loopback() {
            // For the commands of this machine, which know neither our names nor our certificate.
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
        let secrets = Secrets::new(store.server_key().map_err(StartError::Key)?);
        let (actor_handle, actor) =
            actor::start(store, recovered, secrets, Arc::clone(&tokens), config.allowances.clone());
        actor_handle.decide(Event::Started { alone: config.alone, park: config.park }).await?;
        effects::let_go(&actor_handle);
        let (stop, stopped) = watch::channel(false);
        let tick = effects::tick(actor_handle.clone(), config.policy.tick_ms, stopped.clone());
        let clock = actor_handle.spawn("the clock", tick);
        let gate = Arc::new(Gate::new(tokens, &config.hosts, config.allowances.calls));
        let audit = actor_handle.spawn("the audit log", audit::write(Arc::clone(&gate.audit), log, stopped.clone()));
        let router = api::router(actor_handle.clone(), &gate);
        let serve = listener::serve(listeners, router, config.connections.clone(), stopped);
        let server = actor_handle.spawn("the server", serve);
        tracing::info!(%address, "coordinator listens");
        let tls = config.tls.is_some();
        let tasks = vec![clock, server, audit, actor];
        Ok(Handle { address, local, tls, token, worker_token, actor_handle, stop, tasks })
    }
}

/// The name of the token of workers that this process starts; no line of a token file can bear it.
const OWN_WORKERS: &str = "own workers";

/// The name of the user whom this process belongs to.
fn user() -> String {
    let uid = nix::unistd::geteuid();
    nix::unistd::User::from_uid(uid).ok().flatten().map_or_else(|| format!("uid-{uid}"), |user| user.name)
}

/// A running coordinator. Dropping it stops it as `kill -9` would: nothing acknowledged is lost.
#[derive(Debug)]
pub struct Handle {
    address: SocketAddr,
    local: SocketAddr,
    tls: bool,
    token: Token,
    worker_token: Token,
    actor_handle: Arc<ActorHandle>,
    stop: watch::Sender<bool>,
    tasks: Vec<JoinHandle<()>>,
}

impl Handle {
    /// Where it listens.
    pub fn address(&self) -> SocketAddr {
        self.address
    }

    /// Its URL.
    pub fn url(&self) -> String {
        format!("{}://{}", if self.tls { "https" } else { "http" }, self.address)
    }

    /// Its URL for processes of this machine, never encrypted.
    pub fn local_url(&self) -> String {
        format!("http://{}", self.local)
    }

    /// A token that allows everything and lasts as long as this coordinator. Its name is that of the user.
    pub fn token(&self) -> &Token {
        &self.token
    }

    /// A token for workers that this process starts: it allows what workers do. It lasts as long as this coordinator.
    pub fn worker_token(&self) -> &Token {
        &self.worker_token
    }

    /// Submits a pipeline; durable once this returns.
    pub async fn submit(&self, submit: Submit) -> Result<RunId, Refused> {
        self.actor_handle.submit(submit, Owner::local(user()), None).await
    }

    /// Takes another table of tokens. Calls under way whose token is not in it any more end.
    pub fn replace_tokens(&self, tokens: Tokens) {
        self.actor_handle.tokens.replace(tokens);
    }

    /// Pauses, resumes or cancels a run.
    pub async fn control(&self, run: &RunId, action: Control) -> Result<(), Refused> {
        self.actor_handle.control(run, action).await
    }

    /// A run as clients see it, whether it goes on or has ended.
    pub async fn run_view(&self, run: &RunId) -> Result<RunView, Refused> {
        self.actor_handle.run_view(run).await
    }

    /// All workers.
    pub fn workers(&self) -> Vec<WorkerView> {
        self.actor_handle.state().worker_views()
    }

    /// The launcher saw a worker's process exit. Its name is free at once.
    pub async fn worker_gone(&self, worker: &WorkerId) -> Result<(), Refused> {
        self.actor_handle.decide(Event::WorkerGone { worker: worker.clone(), incarnation: None }).await.map(drop)
    }

    /// Reports for a worker whose process has exited what it can no longer report: how its work ended. Does nothing if it held none.
    pub async fn fail_for(&self, worker: &WorkerId, class: FailureClass, message: String) -> Result<(), Refused> {
        let state = self.actor_handle.state();
        let (Some(known), Some((_, task))) = (state.workers.get(worker), state.held_by(worker)) else { return Ok(()) };
        let grant = task.grant_of(worker, known.incarnation);
        let report = ReportOutcome { grant, outcome: TaskOutcome::Failed { class, message } };
        self.actor_handle.decide(Event::Outcome { report }).await.map(drop)
    }

    /// Asks all workers to save what they have and leave; no work is given any more.
    pub async fn drain(&self) -> Result<(), Refused> {
        self.actor_handle.decide(Event::Drain).await.map(drop)
    }

    /// Whether somebody still holds a task.
    pub fn is_busy(&self) -> bool {
        self.actor_handle.state().executions.values().any(|execution| execution.is_busy())
    }

    /// How many facts this coordinator has recorded since it started.
    pub fn facts(&self) -> u64 {
        self.actor_handle.state().recorded
    }

    /// Waits until something durable changed since the last call on this receiver.
    pub fn changes(&self) -> watch::Receiver<u64> {
        self.actor_handle.changes()
    }

    /// Why nothing goes on, if that is so: the process around the coordinator should say it and stop.
    pub fn trouble(&self) -> Option<Trouble> {
        let failure = self.actor_handle.failure().map(|failure| Trouble::Failed(failure.to_owned()));
        failure.or_else(|| self.actor_handle.trouble().map(Trouble::Store))
    }

    /// Returns once a part of the coordinator has panicked, with what it said.
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

    /// Stops at once. What was acknowledged is in the store; a later start goes on from there, and from a snapshot of the end.
    pub async fn shutdown(mut self) {
        let _ = self.stop.send(true);
        self.actor_handle.stop();
        for task in std::mem::take(&mut self.tasks) {
            // Ended tasks and cancelled ones alike are what we want here.
            let _ = task.await;
        }
        effects::let_go(&self.actor_handle);
        actor::snapshot(&self.actor_handle, &self.actor_handle.state()).await;
    }
}

impl Drop for Handle {
    fn drop(&mut self) {
        let _ = self.stop.send(true);
        self.actor_handle.stop();
    }
}
