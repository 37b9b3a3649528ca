//! Errors of a coordinator's start.

use std::net::SocketAddr;

use registry::{QueryError, WriteError};

use crate::batch::Refused;
use crate::journal::RecoverError;
use crate::rejected::Rejected;

/// An error that prevents a coordinator from starting.
#[derive(Debug, thiserror::Error)]
pub enum StartError {
    /// No caller could be authenticated.
    #[error("refusing to listen on {0} without a token: no caller from another machine could be authenticated")]
    NoToken(SocketAddr),
    /// The tokens would be readable on the network.
    #[error("refusing to listen on {0} without TLS: tokens would be readable on the network")]
    NoTls(SocketAddr),
    /// The address is in use, or is not this machine's.
    #[error("cannot listen on {address}: {cause}")]
    Listen { address: SocketAddr, cause: std::io::Error },
    /// The key that authenticates workers cannot be read or created.
    #[error("cannot read the key that authenticates workers: {0}")]
    Key(std::io::Error),
    /// The stored facts cannot be read.
    #[error("cannot read the stored facts: {0}")]
    Read(#[from] QueryError),
    /// The stored facts were written in a format that this build does not support.
    #[error("cannot recover: {0}")]
    Recover(#[from] RecoverError),
    /// The first event cannot be stored.
    #[error("cannot write to the store: {0}")]
    Store(#[from] WriteError),
    /// An internal error.
    #[error("{0}; this is a bug in Stride")]
    Failed(String),
    /// The first event is refused.
    #[error("cannot recover: {0}")]
    Rejected(#[from] Rejected),
}

impl From<Refused> for StartError {
    fn from(refused: Refused) -> Self {
        match refused {
            Refused::Rejected(rejected) => Self::Rejected(rejected),
            Refused::Write(write) => Self::Store(write),
            Refused::Stopped => {
                Self::Rejected(Rejected::Conflict("the server was stopped during its start".to_owned()))
            }
            Refused::Failed(failure) => Self::Failed(failure),
        }
    }
}
