//! Command-line options shared by all commands that connect to a server.

use std::path::{Path, PathBuf};

use crate::connection::{ConnectError, Server};
use crate::local;
use crate::secret::{FileError, Token};

/// Options for the token.
#[derive(Debug, Clone, Default, clap::Args)]
pub struct TokenOptions {
    /// Token; other users of this machine can see command lines, so prefer --token-file
    #[arg(long, env = "STRIDE_TOKEN", hide_env_values = true, global = true, conflicts_with = "token_file")]
    pub token: Option<Token>,
    /// File with the token, closed to other users
    #[arg(long, env = "STRIDE_TOKEN_FILE", value_name = "FILE", global = true)]
    pub token_file: Option<PathBuf>,
}

impl TokenOptions {
    /// Reads the token from the option or the file, if one is given.
    pub fn read(&self) -> Result<Option<Token>, FileError> {
        match (&self.token, &self.token_file) {
            (Some(token), _) => Ok(Some(token.clone())),
            (None, Some(path)) => {
                Token::from_file(path).map(Some).map_err(|error| error.named_by("--token-file or STRIDE_TOKEN_FILE"))
            }
            (None, None) => Ok(None),
        }
    }
}

/// Options for the token and the trust of a connection.
#[derive(Debug, Clone, Default, clap::Args)]
pub struct ConnectionOptions {
    #[command(flatten)]
    pub token: TokenOptions,
    /// Certificate (PEM) that signs the server's; no other is trusted [default: the system's]
    #[arg(long, env = "STRIDE_CA", value_name = "FILE", global = true)]
    pub ca: Option<PathBuf>,
    /// Allow tokens and data to cross a network without TLS, where others can read them
    #[arg(long, global = true)]
    pub insecure: bool,
}

impl ConnectionOptions {
    /// Creates a client of the server at `url`.
    pub fn connect(&self, url: &str) -> Result<Server, ConnectError> {
        let token = self.token.read()?;
        let ca = self.ca.as_deref();
        if self.insecure { Server::insecure(url, token, ca) } else { Server::new(url, token, ca) }
    }
}

/// Options for a server and its connection.
#[derive(Debug, Clone, Default, clap::Args)]
pub struct ServerOptions {
    /// Server to ask instead of the store's folder; addresses of a server and its stand-bys are separated by commas
    #[arg(long, env = "STRIDE_SERVER", value_name = "URL", global = true)]
    pub server: Option<String>,
    #[command(flatten)]
    pub connection: ConnectionOptions,
}

impl ServerOptions {
    /// Creates a client of the server named by `--server`, if any.
    pub fn connect(&self) -> Result<Option<Server>, ConnectError> {
        self.server.as_deref().map(|url| self.connection.connect(url)).transpose()
    }

    /// Creates a client of the process that holds the store in `dir` and listens at `address`. Uses the token in the
    /// store's folder, or else the token given by option.
    pub fn holder(&self, dir: &Path, address: &str) -> Result<Server, ConnectError> {
        let token = match (local::read(dir), self.connection.token.read()?) {
            (Ok(Some(token)), _) | (_, Some(token)) => Some(token),
            (Ok(None), None) => None,
            (Err(error), None) => return Err(ConnectError::Holder { dir: dir.to_owned(), error }),
        };
        Server::new(address, token, None)
    }
}
