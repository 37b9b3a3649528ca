//! The options of every command that asks a server, declared once.

use std::path::{Path, PathBuf};

use crate::connection::{ConnectError, Server};
use crate::local;
use crate::secret::{FileError, Token};

/// What shows who is asking.
#[derive(Debug, Clone, Default, clap::Args)]
pub struct TokenOptions {
    /// Token; other users of this machine see command lines, so rather use --token-file
    #[arg(long, env = "STRIDE_TOKEN", hide_env_values = true, global = true, conflicts_with = "token_file")]
    pub token: Option<Token>,
    /// File with the token, closed to other users
    #[arg(long, env = "STRIDE_TOKEN_FILE", value_name = "FILE", global = true)]
    pub token_file: Option<PathBuf>,
}

impl TokenOptions {
    /// The token, if there is one.
    pub fn read(&self) -> Result<Option<Token>, FileError> {
        match (&self.token, &self.token_file) {
            (Some(token), _) => Ok(Some(token.clone())),
            (None, Some(path)) => Token::from_file(path).map(Some),
            (None, None) => Ok(None),
        }
    }
}

/// How a server is asked.
#[derive(Debug, Clone, Default, clap::Args)]
pub struct ConnectionOptions {
    /// Who is asking.
    #[command(flatten)]
    pub token: TokenOptions,
    /// Certificate (PEM) that signs the server's; no other is trusted [default: the system's]
    #[arg(long, env = "STRIDE_CA", value_name = "FILE", global = true)]
    pub ca: Option<PathBuf>,
    /// Let tokens and data cross a network without TLS: everybody who sees the traffic has them
    #[arg(long, global = true)]
    pub insecure: bool,
}

impl ConnectionOptions {
    /// The server at `url`.
    pub fn connect(&self, url: &str) -> Result<Server, ConnectError> {
        let (token, ca) = (self.token.read()?, self.ca.as_deref());
        if self.insecure { Server::insecure(url, token, ca) } else { Server::new(url, token, ca) }
    }
}

/// Which server to ask, and how.
#[derive(Debug, Clone, Default, clap::Args)]
pub struct ServerOptions {
    /// Server to ask instead of the store's folder
    #[arg(long, env = "STRIDE_SERVER", value_name = "URL", global = true)]
    pub server: Option<String>,
    /// How it is asked.
    #[command(flatten)]
    pub connection: ConnectionOptions,
}

impl ServerOptions {
    /// The server of `--server`, if one is named.
    pub fn connect(&self) -> Result<Option<Server>, ConnectError> {
        self.server.as_deref().map(|url| self.connection.connect(url)).transpose()
    }

    /// The process that holds the store in `dir` and answers at `address`: by the token that it left for its user, or by
    /// one that was given.
    pub fn holder(&self, dir: &Path, address: &str) -> Result<Server, ConnectError> {
        let token = match (local::read(dir), self.connection.token.read()?) {
            (Ok(Some(token)), _) | (_, Some(token)) => Some(token),
            (Ok(None), None) => None,
            (Err(error), None) => return Err(ConnectError::Holder { dir: dir.to_owned(), error }),
        };
        Server::new(address, token, None)
    }
}
