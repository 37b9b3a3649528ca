//! A server without a coordinator, for a process that answers a single call of its own, such as a stream of motion
//! (decision 0012). Tokens, host names, TLS and connections follow the coordinator's rules.

use std::net::SocketAddr;
use std::sync::Arc;
use std::time::Duration;

use access::Scope;
use access::tls::ServerTls;
use axum::Router;
use axum::extract::DefaultBodyLimit;
use axum::middleware;
use axum::routing::{MethodRouter, get};
use protocol::limits;
use tokio::sync::watch;

use super::Config;
use super::api;
use super::auth::{self, Gate};
use super::listener::{self, Connections, Listener};
use super::route::Route;
use super::start_error::StartError;
use super::token_table::TokenTable;

/// Time limit until the answer begins.
const TIME: Duration = Duration::from_secs(60);

/// A bound address with token authentication.
pub struct RouteServer {
    listener: Listener,
    address: SocketAddr,
    tls: bool,
    connections: Connections,
    gate: Arc<Gate>,
}

impl std::fmt::Debug for RouteServer {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("RouteServer").field("address", &self.address).field("tls", &self.tls).finish_non_exhaustive()
    }
}

impl RouteServer {
    /// Binds the address of `config`. Settings about runs and workers are ignored.
    ///
    /// # Errors
    /// No token, even on a loopback address; no TLS on other addresses unless `insecure` is set; an address that cannot
    /// be bound.
    pub async fn bind(config: &Config) -> Result<Self, StartError> {
        config.check()?;
        if config.tokens.is_empty() {
            return Err(StartError::NoToken(config.listen));
        }
        let failed = |cause| StartError::Listen { address: config.listen, cause };
        let listener =
            Listener::bind(config.listen, config.tls.as_ref().map(ServerTls::config)).await.map_err(failed)?;
        let address = listener.address().map_err(failed)?;
        let tokens = Arc::new(TokenTable::new(config.tokens.clone(), Vec::new()));
        let gate = Arc::new(Gate::new(tokens, &config.hosts, config.allowances.calls).with_tickets());
        Ok(Self { listener, address, tls: config.tls.is_some(), connections: config.connections.clone(), gate })
    }

    /// The listening address.
    pub fn address(&self) -> SocketAddr {
        self.address
    }

    /// Returns true if the server uses TLS.
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
        let router = Router::new()
            .route(path, handler.route_layer(DefaultBodyLimit::max(route.body)).route_layer(admit))
            // Reveals only that a server is running.
            .route("/v1/health", get(|| async { "ok" }))
            .fallback(api::absent)
            .method_not_allowed_fallback(api::no_such_method)
            .layer(middleware::from_fn_with_state(self.gate, auth::check_host));
        listener::serve(vec![self.listener], router, self.connections, stopped).await;
    }
}
