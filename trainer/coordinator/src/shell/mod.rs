//! The thin half: server, clock, runner of effects. The only async code of the crate.
//!
//! One task, the `actor`, owns the state and decides events one by one: copy, decide, store, and only then publish the
//! copy. What a refused transaction would have changed has therefore never been. Everybody else reads published copies.

mod actor;
mod api;
mod auth;
mod effects;
mod polls;
mod queries;
mod uploads;

use std::net::SocketAddr;
use std::sync::Arc;

use protocol::message::{RunView, Submit};
use protocol::{RunId, WorkerId};
use registry::{QueryError, Store, WriteError};
use tokio::net::TcpListener;
use tokio::sync::{oneshot, watch};
use tokio::task::JoinHandle;

use crate::event::{Control, Event, Rejected};
use crate::journal::{self, ReplayError};
use crate::policy::Policy;
use crate::view::WorkerView;

use self::actor::ActorHandle;
pub use self::actor::Refused;
pub use self::queries::{BlobStored, StageMetrics, Submitted};

/// How a coordinator is run.
#[derive(Debug, Clone)]
pub struct Config {
    /// Where to listen; port 0 takes a free one.
    pub listen: SocketAddr,
    /// What callers must bear. Required to listen beyond this machine.
    pub token: Option<String>,
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
        Self {
            listen: SocketAddr::from(([127, 0, 0, 1], 0)),
            token: None,
            policy: Policy::default(),
            alone: true,
            park: true,
        }
    }

    /// For `trainer serve`: workers of before may still be at work and re-attach.
    pub fn server(listen: SocketAddr, token: Option<String>) -> Self {
        Self { listen, token, policy: Policy::default(), alone: false, park: false }
    }
}

/// Why a coordinator did not start.
#[derive(Debug, thiserror::Error)]
pub enum StartError {
    /// It would be open to everybody.
    #[error("refusing to listen on {0} without a token: anybody who reaches it could run execution and move aliases")]
    NoToken(SocketAddr),
    /// The address is taken, or not ours.
    #[error("cannot listen on {address}: {cause}")]
    Listen {
        /// Where.
        address: SocketAddr,
        /// Why not.
        cause: std::io::Error,
    },
    /// The journal cannot be read.
    #[error("cannot read the journal: {0}")]
    Journal(#[from] QueryError),
    /// The journal cannot be replayed.
    #[error("cannot recover: {0}")]
    Replay(#[from] ReplayError),
    /// The first event cannot be stored.
    #[error("cannot write to the store: {0}")]
    Store(#[from] WriteError),
    /// The first event is refused.
    #[error("cannot recover: {0}")]
    Rejected(#[from] Rejected),
}

impl From<Refused> for StartError {
    fn from(refused: Refused) -> Self {
        match refused {
            Refused::Rejected(rejected) => Self::Rejected(rejected),
            Refused::Write(write) => Self::Store(write),
            Refused::Stopped => Self::Rejected(Rejected::Conflict("it was stopped while it started".to_owned())),
        }
    }
}

/// Starts coordinators.
#[derive(Debug)]
pub struct Coordinator;

impl Coordinator {
    /// Recovers from the journal of `store`, then listens.
    pub async fn start(store: Store, config: Config) -> Result<Handle, StartError> {
        if !config.listen.ip().is_loopback() && config.token.as_deref().is_none_or(str::is_empty) {
            return Err(StartError::NoToken(config.listen));
        }
        let state = journal::replay(config.policy.clone(), store.journal_read().await?)?;
        let listen = |cause| StartError::Listen { address: config.listen, cause };
        let listener = TcpListener::bind(config.listen).await.map_err(listen)?;
        let address = listener.local_addr().map_err(listen)?;

        let (actor_handle, actor) = actor::start(store, state);
        actor_handle.decide(Event::Started { alone: config.alone, park: config.park }).await?;
        let (stop, stopped) = watch::channel(false);
        let clock = tokio::spawn(effects::tick(actor_handle.clone(), config.policy.tick_ms, stopped.clone()));
        let router = api::router(actor_handle.clone(), config.token.as_deref());
        let server = tokio::spawn(serve(listener, router, stopped));
        tracing::info!(%address, "coordinator listens");
        Ok(Handle { address, actor_handle, stop, tasks: vec![clock, server, actor] })
    }
}

async fn serve(listener: TcpListener, router: axum::Router, mut stopped: watch::Receiver<bool>) {
    let stop = async move {
        // An error means that the handle is gone, which is a stop too.
        let _ = stopped.wait_for(|stop| *stop).await;
    };
    tokio::select! {
        served = axum::serve(listener, router).into_future() => {
            if let Err(error) = served {
                tracing::error!(%error, "the server ended");
            }
        }
        () = stop => {}
    }
}

/// A running coordinator. Dropping it stops it as `kill -9` would: nothing acknowledged is lost.
#[derive(Debug)]
pub struct Handle {
    address: SocketAddr,
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
        format!("http://{}", self.address)
    }

    /// Submits a pipeline; durable once this returns.
    pub async fn submit(&self, submit: Submit) -> Result<RunId, Refused> {
        self.actor_handle.submit(submit).await
    }

    /// Pauses, resumes or cancels a run.
    pub async fn control(&self, run: &RunId, action: Control) -> Result<(), Refused> {
        self.actor_handle.decide(Event::Control { run: run.clone(), action }).await.map(drop)
    }

    /// A run as clients see it.
    pub fn run_view(&self, run: &RunId) -> Option<RunView> {
        let state = self.actor_handle.state();
        state.run(run).ok().map(|run| state.view(run, self.actor_handle.now()))
    }

    /// All runs, oldest first.
    pub fn runs(&self) -> Vec<RunView> {
        let state = self.actor_handle.state();
        state.runs.iter().map(|run| state.view(run, self.actor_handle.now())).collect()
    }

    /// All workers.
    pub fn workers(&self) -> Vec<WorkerView> {
        self.actor_handle.state().worker_views()
    }

    /// The launcher saw a worker's process exit.
    pub async fn worker_gone(&self, worker: &WorkerId) -> Result<(), Refused> {
        self.actor_handle.decide(Event::WorkerGone { worker: worker.clone() }).await.map(drop)
    }

    /// Asks all workers to save what they have and leave; no work is given any more.
    pub async fn drain(&self) -> Result<(), Refused> {
        self.actor_handle.decide(Event::Drain).await.map(drop)
    }

    /// Whether somebody still holds a task.
    pub fn is_busy(&self) -> bool {
        self.actor_handle.state().executions.values().any(|execution| execution.is_busy())
    }

    /// Waits until something durable changed since the last call on this receiver.
    pub fn changes(&self) -> watch::Receiver<u64> {
        self.actor_handle.changes()
    }

    /// Why the store refused the newest write for want of space or permission; `None` while it takes writes. As long as it
    /// stands, nothing goes on: whoever runs the coordinator should say so and stop.
    pub fn trouble(&self) -> Option<String> {
        self.actor_handle.trouble()
    }

    /// Stops at once. What was acknowledged is in the store; a later start goes on from there.
    pub async fn shutdown(mut self) {
        let _ = self.stop.send(true);
        self.actor_handle.stop();
        for task in std::mem::take(&mut self.tasks) {
            // Ended tasks and cancelled ones alike are what we want here.
            let _ = task.await;
        }
    }
}

impl Drop for Handle {
    fn drop(&mut self) {
        let _ = self.stop.send(true);
        self.actor_handle.stop();
    }
}

/// Waits for an answer that may never come because the actor has ended.
async fn answer<T>(receiver: oneshot::Receiver<Result<T, Refused>>) -> Result<T, Refused> {
    receiver.await.unwrap_or(Err(Refused::Stopped))
}
