//! Why a coordinator did not start.

use std::net::SocketAddr;

use registry::{QueryError, WriteError};

use crate::batch::Refused;
use crate::journal::RecoverError;
use crate::rejected::Rejected;

/// Why a coordinator did not start.
#[derive(Debug, thiserror::Error)]
pub enum StartError {
    /// Nobody could call it.
    #[error("refusing to listen on {0} without a token: nobody beyond this machine could be let in")]
    NoToken(SocketAddr),
    /// Anybody who listens on the network would have the tokens.
    #[error("refusing to listen on {0} without TLS: anybody who sees the traffic has the tokens")]
    NoTls(SocketAddr),
    /// The address is taken, or not ours.
    #[error("cannot listen on {address}: {cause}")]
    Listen {
        /// Where.
        address: SocketAddr,
        /// Why not.
        cause: std::io::Error,
    },
    /// The key of the store's server cannot be read or made.
    #[error("cannot read the key by which workers are recognised: {0}")]
    Key(std::io::Error),
    /// What was decided before cannot be read.
    #[error("cannot read what was decided before: {0}")]
    Read(#[from] QueryError),
    /// What was decided before is not what this build understands.
    #[error("cannot recover: {0}")]
    Recover(#[from] RecoverError),
    /// The first event cannot be stored.
    #[error("cannot write to the store: {0}")]
    Store(#[from] WriteError),
    /// A fault of ours.
    #[error("{0}; this is a bug of Stride's")]
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
            Refused::Stopped => Self::Rejected(Rejected::Conflict("it was stopped while it started".to_owned())),
            Refused::Failed(failure) => Self::Failed(failure),
        }
    }
}
