//! Errors as the user sees them: the chain of causes, a blank line, `hint:`, and an exit code.

use std::fmt::Display;

/// Exit codes, one meaning each.
pub(crate) mod exit {
    /// The table of `--help`.
    pub(crate) const HELP: &str = "Exit codes:
    0  done
    1  the requested operation failed, such as a run
    2  wrong usage, a wrong file or a store that cannot be used; nothing was changed
    3  a bug in this program; please report it
    4  a conflict with what is stored
    5  the token is missing or lacks a scope
    6  the server does not answer
    7  there is no such run, stage or model
    8  the run was cancelled
    9  stored data is damaged
   10  a gate does not hold; nothing was changed
  130  interrupted; the same command continues";

    /// The words by which the troubleshooting page explains the codes.
    pub(crate) const WORDS: [(u8, &str); 11] = [
        (FAILED, "failed"),
        (USAGE, "usage"),
        (FAULT, "fault"),
        (CONFLICT, "conflict"),
        (UNAUTHORISED, "unauthorized"),
        (UNREACHABLE, "unreachable"),
        (NOT_FOUND, "not-found"),
        (CANCELLED, "cancelled"),
        (INTEGRITY, "damaged"),
        (GATE, "gate"),
        (INTERRUPTED, "interrupted"),
    ];

    /// The word of a code.
    pub(crate) fn word(code: u8) -> Option<&'static str> {
        WORDS.iter().find(|(known, _)| *known == code).map(|(_, word)| *word)
    }

    pub(crate) const FAILED: u8 = 1;
    pub(crate) const USAGE: u8 = 2;
    pub(crate) const FAULT: u8 = 3;
    pub(crate) const NOT_FOUND: u8 = 7;
    pub(crate) const CONFLICT: u8 = 4;
    pub(crate) const UNAUTHORISED: u8 = 5;
    pub(crate) const UNREACHABLE: u8 = 6;
    pub(crate) const CANCELLED: u8 = 8;
    pub(crate) const INTEGRITY: u8 = 9;
    pub(crate) const GATE: u8 = 10;
    pub(crate) const INTERRUPTED: u8 = 130;
}

/// An error with a hint and an exit code.
#[derive(Debug)]
pub(crate) struct Problem {
    pub(crate) error: anyhow::Error,
    pub(crate) hint: Option<String>,
    pub(crate) exit: u8,
    /// The server's code, if the error is its refusal.
    pub(crate) code: Option<String>,
}

/// Result of most functions of the command.
pub(crate) type Result<T, E = Problem> = std::result::Result<T, E>;

impl Problem {
    pub(crate) fn new(exit: u8, error: impl Into<anyhow::Error>) -> Self {
        Self { error: error.into(), hint: None, exit, code: None }
    }

    /// The code under which the troubleshooting page explains the error.
    pub(crate) fn code(&self) -> Option<&str> {
        self.code.as_deref().or(exit::word(self.exit))
    }

    /// A wrong argument or a wrong file.
    pub(crate) fn usage(message: impl Display) -> Self {
        Self::new(exit::USAGE, anyhow::anyhow!("{message}"))
    }

    pub(crate) fn failed(message: impl Display) -> Self {
        Self::new(exit::FAILED, anyhow::anyhow!("{message}"))
    }

    /// A part of the coordinator in this process has panicked.
    pub(crate) fn coordinator_failed(why: impl Display) -> Self {
        Self::new(exit::FAULT, anyhow::anyhow!("the coordinator has failed: {why}"))
    }

    pub(crate) fn hint(mut self, hint: impl Into<String>) -> Self {
        self.hint = Some(hint.into());
        self
    }
}

impl From<anyhow::Error> for Problem {
    fn from(error: anyhow::Error) -> Self {
        Self::new(exit::FAILED, error)
    }
}

impl From<access::FileError> for Problem {
    fn from(error: access::FileError) -> Self {
        let hint = error.advice().map(str::to_owned);
        Self { hint, ..Self::new(exit::USAGE, error) }
    }
}

impl From<access::ConnectError> for Problem {
    fn from(error: access::ConnectError) -> Self {
        match error {
            access::ConnectError::File(error) => error.into(),
            access::ConnectError::Holder { .. } => Self::new(exit::UNAUTHORISED, error),
            _ => {
                let hint = error.advice().map(str::to_owned);
                Self { hint, ..Self::new(exit::USAGE, error) }
            }
        }
    }
}

impl From<registry::OpenError> for Problem {
    fn from(error: registry::OpenError) -> Self {
        let hint = error.hint();
        // The same code and exit code as `registry`'s.
        Self { code: Some("store".to_owned()), ..Self::new(exit::USAGE, error).hint(hint) }
    }
}

impl From<registry::QueryError> for Problem {
    fn from(error: registry::QueryError) -> Self {
        let exit = match &error {
            registry::QueryError::NotFound(_) => exit::NOT_FOUND,
            registry::QueryError::Invalid(_) => exit::USAGE,
            _ => exit::FAILED,
        };
        Self::new(exit, error)
    }
}

impl From<coordinator::StartError> for Problem {
    fn from(error: coordinator::StartError) -> Self {
        match &error {
            coordinator::StartError::NoToken(_) => {
                Self::new(exit::USAGE, error).hint("set a token file with --token-file, or listen on 127.0.0.1")
            }
            coordinator::StartError::NoTls(_) => Self::new(exit::USAGE, error)
                .hint("set --tls-cert and --tls-key; on a private or encrypted network, use --insecure"),
            coordinator::StartError::Listen { .. } => {
                Self::new(exit::USAGE, error).hint("choose another address with --bind; port 0 selects a free port")
            }
            coordinator::StartError::Recover(_) => Self::new(exit::FAILED, error)
                .hint("use the build that wrote it, or another --store; `registry` can still read this store"),
            _ => Self::new(exit::FAILED, error),
        }
    }
}

impl From<coordinator::RecordsError> for Problem {
    fn from(error: coordinator::RecordsError) -> Self {
        match error {
            coordinator::RecordsError::Open(error) => error.into(),
            coordinator::RecordsError::Recover(error) => error.into(),
        }
    }
}

impl From<coordinator::Refused> for Problem {
    fn from(error: coordinator::Refused) -> Self {
        let exit = match &error {
            coordinator::Refused::Rejected(coordinator::Rejected::Invalid(_)) => exit::USAGE,
            coordinator::Refused::Rejected(coordinator::Rejected::NotFound(_)) => exit::NOT_FOUND,
            coordinator::Refused::Rejected(coordinator::Rejected::Conflict(_)) => exit::CONFLICT,
            coordinator::Refused::Write(registry::WriteError::Storage(_)) => exit::USAGE,
            coordinator::Refused::Failed(_) => exit::FAULT,
            _ => exit::FAILED,
        };
        Self::new(exit, error)
    }
}
