//! A running coordinator, as the process around it sees it.

use std::net::SocketAddr;
use std::sync::Arc;

use ::webhooks::Hooks;
use access::tls::ServerTls;
use access::{Token, Tokens};
use protocol::message::{FailureClass, ReportOutcome, RunView, Submit, TaskOutcome};
use protocol::{Owner, RunId, WorkerId};
use tokio::sync::watch;
use tokio::task::JoinHandle;

use super::actor_handle::ActorHandle;
use super::run_settings::RunSettings;
use super::sessions::Sessions;
use super::{actor, effects, webhooks};
use crate::batch::Refused;
use crate::event::Event;
use crate::state::run::Control;
use crate::view::WorkerView;

/// A reason why a coordinator makes no progress.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Trouble {
    /// The store refused the newest write, for lack of space or permission; it may accept the next one.
    Store(String),
    /// A part of the coordinator panicked, and all further requests are refused. Acknowledged work is stored, and
    /// another process can continue it.
    Failed(String),
}

/// The name of the process's user.
pub(super) fn user() -> String {
    let uid = nix::unistd::geteuid();
    nix::unistd::User::from_uid(uid).ok().flatten().map_or_else(|| format!("uid-{uid}"), |user| user.name)
}

/// A running coordinator. Dropping it stops it like `kill -9`: no acknowledged work is lost.
#[derive(Debug)]
pub struct Handle {
    pub(super) address: SocketAddr,
    pub(super) local: SocketAddr,
    pub(super) tls: Option<ServerTls>,
    pub(super) token: Token,
    pub(super) worker_token: Token,
    pub(super) sessions: Arc<Sessions>,
    pub(super) hooks: watch::Sender<Hooks>,
    pub(super) actor_handle: Arc<ActorHandle>,
    pub(super) stop: watch::Sender<bool>,
    pub(super) tasks: Vec<JoinHandle<()>>,
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
