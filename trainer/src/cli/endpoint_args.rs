//! Options of every command that listens for callers.

use std::net::SocketAddr;
use std::path::PathBuf;

use access::Tokens;
use clap::Args;
use coordinator::{Config, Handle};

use crate::report::problem::Result;

#[derive(Debug, Args)]
pub(super) struct EndpointArgs {
    /// Certificate (PEM) for TLS, followed by its chain
    #[arg(long, env = "STRIDE_TLS_CERT", value_name = "FILE", requires = "tls_key")]
    tls_cert: Option<PathBuf>,
    /// Private key (PEM) of the certificate, unreadable for other users
    #[arg(long, env = "STRIDE_TLS_KEY", value_name = "FILE", requires = "tls_cert")]
    tls_key: Option<PathBuf>,
    /// Another name of this server for its callers, besides the machine's own; may be repeated
    #[arg(long, env = "STRIDE_HOST", value_name = "NAME", value_delimiter = ',')]
    host: Vec<String>,
}

impl EndpointArgs {
    /// The URL by which callers reach the server: with the name of `--host`; with the machine's name if it listens on all
    /// networks.
    pub(super) fn url(&self, handle: &Handle) -> String {
        let address = handle.address();
        let own = || nix::unistd::gethostname().ok()?.into_string().ok();
        let name = self.host.first().cloned().or_else(|| address.ip().is_unspecified().then(own).flatten());
        let scheme = if self.tls_cert.is_some() { "https" } else { "http" };
        name.map_or_else(|| handle.url(), |name| format!("{scheme}://{name}:{}", address.port()))
    }

    /// Configures a server at `listen` for callers with one of `tokens`. Without TLS, it accepts callers from other
    /// machines only if `insecure`.
    pub(super) fn config(&self, listen: SocketAddr, tokens: Tokens, insecure: bool) -> Result<Config> {
        let tls = self.tls_cert.as_deref().zip(self.tls_key.as_deref());
        let tls = tls.map(|(certificate, key)| access::tls::ServerTls::read(certificate, key)).transpose()?;
        Ok(Config { hosts: self.host.clone(), tls, insecure, ..Config::server(listen, tokens) })
    }
}
