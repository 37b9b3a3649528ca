//! Authentication and authorisation of callers, for clients and servers.
//!
//! Both ends of a connection are here, because they must agree. The server has a table of tokens ([`Tokens`]) and their
//! permissions ([`Scopes`]). All clients share their options ([`ServerOptions`]) and the connection with its TLS
//! ([`Server`]). The process that holds a store admits commands of its own user by a file ([`local`]).
//!
//! The mapping from calls to scopes is not here; it is beside the routes in the coordinator.

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
pub use connection::{ConnectError, Server, UNREACHABLE, describe, explain, retry_after};
pub use expiry::Expiry;
pub use names::Names;
pub use options::{ConnectionOptions, ServerOptions, TokenOptions};
pub use scope::{Scope, Scopes};
pub use secret::{FileError, Token, TokenError, entries, read_secret};
pub use tokens::{Promoter, Tokens, digest_of};

/// Default port of a server.
pub const PORT: u16 = 7700;
