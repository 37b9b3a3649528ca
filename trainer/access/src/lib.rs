//! Who may ask what, and how a client says who it is.
//!
//! Both ends of a connection are here, because they must agree: the server's table of tokens ([`Tokens`]) and what a token
//! may do ([`Scopes`]); the options that every client takes ([`ServerOptions`]), declared once for all binaries; the
//! connection itself ([`Server`]) with its TLS; and the file by which the process that holds a store lets the commands of
//! its own user in ([`local`]).
//!
//! Not its job: which call needs which scope. That stands beside the routes, in the coordinator.

mod caller;
mod connection;
mod expiry;
pub mod file;
pub mod local;
mod names;
mod options;
mod scope;
mod secret;
pub mod tls;
mod tokens;

pub use caller::Caller;
pub use connection::{ConnectError, Server, explain, retry_after};
pub use expiry::Expiry;
pub use names::Names;
pub use options::{ConnectionOptions, ServerOptions, TokenOptions};
pub use scope::{Scope, Scopes};
pub use secret::{FileError, Token, TokenError};
pub use tokens::{Promoter, Tokens};

/// Where a server listens unless it is told otherwise.
pub const PORT: u16 = 7700;
