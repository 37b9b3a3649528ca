//! Settings of a coordinator.

use std::net::{Ipv4Addr, SocketAddr};
use std::time::Duration;

use ::webhooks::Hooks;
use access::Tokens;
use access::tls::ServerTls;

use super::allowances::Allowances;
use super::listener::Connections;
use super::start_error::StartError;
use super::tickets::StreamOffer;
use crate::policy::Policy;

/// Settings of a coordinator.
#[derive(Debug, Clone)]
pub struct Config {
    /// The listening address; port 0 selects a free port.
    pub listen: SocketAddr,
    /// Tokens of callers. Every start makes another one for commands on this machine:
    /// [`Handle::token`](super::Handle::token).
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
