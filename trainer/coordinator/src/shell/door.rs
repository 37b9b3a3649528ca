//! The server's door without a coordinator behind it: for a process that computes and answers one call of its own, such as a stream of motion
//! (decision 0012). Tokens, names, TLS and connections are held as those of the coordinator are.

use std::net::SocketAddr;
use std::sync::Arc;
use std::time::Duration;

use access::Scope;
use axum::Router;
use axum::extract::DefaultBodyLimit;
use axum::http::StatusCode;
use axum::middleware;
use axum::routing::{MethodRouter, get};
use protocol::limits;
use tokio::sync::watch;

use super::Config;
use super::auth::{self, Gate};
use super::failure::Failure;
use super::listener::{self, Connections, Listener};
use super::route::Route;
use super::start_error::StartError;
use super::token_table::TokenTable;

/// How long a call may take until its answer begins.
const TIME: Duration = Duration::from_secs(60);

/// A bound address whose callers show a token.
pub struct Door {
    listener: Listener,
    address: SocketAddr,
    tls: bool,
    connections: Connections,
    gate: Arc<Gate>,
}

impl std::fmt::Debug for Door {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Door").field("address", &self.address).field("tls", &self.tls).finish_non_exhaustive()
    }
}

impl Door {
    /// Binds the address of `config`, of which everything counts but what is about runs and workers.
    ///
    /// # Errors
    /// No token, also on this machine's own address; beyond it no TLS unless that is wanted; an address that is taken.
    pub async fn open(config: &Config) -> Result<Self, StartError> {
        config.check()?;
        if config.tokens.is_empty() {
            return Err(StartError::NoToken(config.listen));
        }
        let failed = |cause| StartError::Listen { address: config.listen, cause };
        let listener = Listener::bind(config.listen, config.tls.clone()).await.map_err(failed)?;
        let address = listener.address().map_err(failed)?;
        let tokens = Arc::new(TokenTable::new(config.tokens.clone(), Vec::new()));
        let gate = Arc::new(Gate::new(tokens, &config.hosts, config.allowances.calls));
        Ok(Self { listener, address, tls: config.tls.is_some(), connections: config.connections.clone(), gate })
    }

    /// Where it listens.
    pub fn address(&self) -> SocketAddr {
        self.address
    }

    /// Whether what passes is encrypted.
    pub fn is_encrypted(&self) -> bool {
        self.tls
    }

    /// Answers calls of `path` with `handler` if their token has one of `scopes`, until `stopped`.
    pub async fn serve(
        self,
        path: &'static str,
        scopes: &'static [Scope],
        handler: MethodRouter,
        stopped: watch::Receiver<bool>,
    ) {
        let route = Route { method: "GET", path, scopes, body: limits::CALL_BYTES, time: TIME };
        let admit = middleware::from_fn_with_state((Arc::clone(&self.gate), route), auth::admit);
        let absent =
            || async { Failure::new(StatusCode::NOT_FOUND, "not-found", "there is no such address".to_owned()) };
        let router = Router::new()
            .route(path, handler.route_layer(DefaultBodyLimit::max(route.body)).route_layer(admit))
            // Says nothing but that somebody listens.
            .route("/v1/health", get(|| async { "ok" }))
            .fallback(absent)
            .layer(middleware::from_fn_with_state(self.gate, auth::check_host));
        listener::serve(vec![self.listener], router, self.connections, stopped).await;
    }
}
