//! How callers come in: the options that every command that listens has.

use std::net::SocketAddr;
use std::path::PathBuf;

use access::Tokens;
use clap::Args;
use coordinator::Config;

use crate::problem::Result;

#[derive(Debug, Args)]
pub(super) struct DoorArgs {
    /// Certificate (PEM) for TLS, with those that sign it
    #[arg(long, env = "STRIDE_TLS_CERT", value_name = "FILE", requires = "tls_key")]
    tls_cert: Option<PathBuf>,
    /// Its private key (PEM), closed to other users
    #[arg(long, env = "STRIDE_TLS_KEY", value_name = "FILE", requires = "tls_cert")]
    tls_key: Option<PathBuf>,
    /// A name by which callers know this server, besides the machine's own; may be repeated
    #[arg(long, env = "STRIDE_HOST", value_name = "NAME", value_delimiter = ',')]
    host: Vec<String>,
}

impl DoorArgs {
    /// A server at `listen` for those who show one of `tokens`; beyond this machine without TLS only if `insecure`.
    pub(super) fn config(&self, listen: SocketAddr, tokens: Tokens, insecure: bool) -> Result<Config> {
        let tls = self.tls_cert.as_deref().zip(self.tls_key.as_deref());
        let tls = tls.map(|(certificate, key)| access::tls::server(certificate, key)).transpose()?;
        Ok(Config { hosts: self.host.clone(), tls, insecure, ..Config::server(listen, tokens) })
    }
}
