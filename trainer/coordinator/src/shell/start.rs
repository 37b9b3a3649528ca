//! Starts a coordinator: recovers its state, listens, and spawns its tasks.

use std::net::{Ipv4Addr, SocketAddr};
use std::sync::Arc;

use access::tls::ServerTls;
use access::{Caller, Scope, Scopes, Token};
use registry::Store;
use registry::audit::AuditLog;
use tokio::sync::watch;

use super::auth::Gate;
use super::config::Config;
use super::handle::{Handle, user};
use super::listener::{self, Listener};
use super::secrets::Secrets;
use super::sessions::Sessions;
use super::start_error::StartError;
use super::token_table::TokenTable;
use super::{actor, api, audit, effects, progress, webhooks};
use crate::batch::Refused;
use crate::event::Event;
use crate::journal;
use crate::policy::Policy;

/// Entry point for starting coordinators.
#[derive(Debug)]
pub struct Coordinator;

impl Coordinator {
    /// Recovers the state from `store` and starts listening.
    pub async fn start(store: Store, config: Config) -> Result<Handle, StartError> {
        config.check()?;
        let limits = Arc::new(config.tokens.limits());
        let policy = Policy { live_runs: config.allowances.runs, limits, ..config.policy.clone() };
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
