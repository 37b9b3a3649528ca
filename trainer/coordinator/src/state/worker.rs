//! A worker by name, and whether its newest process can be given work.
//!
//! | presence \ event | Join | WorkerBack | LeaseExpired | PeersLost | WorkerGone |
//! |---|---|---|---|---|---|
//! | Here | Here | Here | Silent | Suspect | Gone |
//! | Suspect | Here | Here | Silent | Suspect | Gone |
//! | Silent | Here | Here | Silent | Silent | Gone |
//! | Gone | Here | Gone | Gone | Gone | Gone |
//!
//! Unknown is not dead: a silent worker may well be computing, and its next poll brings it back. Only the launcher of
//! the process can say that it is gone, and only a new process (a join, with the next incarnation) returns from that.
//! Whatever a worker held it loses on leaving `Here`; that is the business of `decide`.
//!
//! A name belongs to the token that joined under it, for as long as it is remembered. While its process may be at work (`Here`,
//! `Suspect`), only that process joins under it again: it shows the same secret.

use std::collections::BTreeSet;

use protocol::message::{Join, Member};
use protocol::stage::Backend;
use protocol::{Digest, Incarnation, TaskId, WorkerId};

use serde::{Deserialize, Serialize};

use crate::rejected::Rejected;
use crate::time::Millis;

/// Whether a worker can be given work.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Presence {
    /// Polls.
    Here,
    /// Peers could not reach it; it must poll again after a penalty.
    Suspect {
        /// Since when.
        since: Millis,
    },
    /// Its lease ran out.
    Silent,
    /// Its process is known to have ended.
    Gone,
}

/// What may change a worker's presence.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Sign {
    /// A new process took the name.
    Join,
    /// It polled again.
    Back,
    /// It did not.
    LeaseExpired,
    /// Peers could not reach it.
    PeersLost,
    /// Its process ended.
    Gone,
}

impl Presence {
    /// The presence after `sign`.
    #[must_use]
    pub fn after(self, sign: Sign, now: Millis) -> Self {
        match (self, sign) {
            (Self::Here | Self::Suspect { .. } | Self::Silent | Self::Gone, Sign::Join) => Self::Here,
            (Self::Here | Self::Suspect { .. } | Self::Silent, Sign::Back) => Self::Here,
            (Self::Here | Self::Suspect { .. } | Self::Silent, Sign::LeaseExpired) => Self::Silent,
            (Self::Here | Self::Suspect { .. }, Sign::PeersLost) => Self::Suspect { since: now },
            (Self::Silent, Sign::PeersLost) => Self::Silent,
            (Self::Here | Self::Suspect { .. } | Self::Silent, Sign::Gone) => Self::Gone,
            (Self::Gone, Sign::Back | Sign::LeaseExpired | Sign::PeersLost | Sign::Gone) => Self::Gone,
        }
    }

    /// Its name in the table above.
    pub fn name(self) -> &'static str {
        match self {
            Self::Here => "Here",
            Self::Suspect { .. } => "Suspect",
            Self::Silent => "Silent",
            Self::Gone => "Gone",
        }
    }
}

/// Whose word a join is.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Identity {
    /// The name of the token's line.
    pub caller: String,
    /// The digest of the secret that the process shows; the secret itself is stored nowhere.
    pub secret: Digest,
}

/// A worker's newest process.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Worker {
    /// Which process of that name.
    pub incarnation: Incarnation,
    /// Whose it is. `None`: it joined before names belonged to tokens, and gives way to everyone.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub identity: Option<Identity>,
    /// Its process id, for people.
    pub pid: u32,
    /// Where it computes.
    pub backend: Backend,
    /// What its kernels dispatch to.
    #[serde(default)]
    pub instruction_set: String,
    /// Where peers reach it.
    pub peer_address: String,
    /// Whether it can be given work.
    pub presence: Presence,
    /// How often this process was taken out of a gang, or complained alone of a member that left; each time it is shunned for longer.
    /// Fades with time.
    pub suspicions: u32,
    /// When it was last suspected.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub suspected: Option<Millis>,
    /// Until when it does not join other members of a gang. It may do what it does alone.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub shunned: Option<Millis>,
    /// Gang tasks whose inputs it has said that it has. Some may be over.
    #[serde(default, skip_serializing_if = "BTreeSet::is_empty")]
    pub ready: BTreeSet<TaskId>,
    /// What it holds: the key of an execution, and a task's place there. Follows from the tasks.
    #[serde(skip)]
    pub holds: Option<(Digest, usize)>,
}

impl Worker {
    /// The process that `join` announces.
    pub fn joined(join: &Join, by: Identity, incarnation: Incarnation) -> Self {
        Self {
            incarnation,
            identity: Some(by),
            pid: join.pid,
            backend: join.backend,
            instruction_set: join.instruction_set.clone(),
            peer_address: join.peer_address.clone(),
            presence: Presence::Here,
            suspicions: 0,
            suspected: None,
            shunned: None,
            ready: BTreeSet::new(),
            holds: None,
        }
    }

    /// Whether it is not there, as far as anybody knows.
    pub fn is_away(&self) -> bool {
        match self.presence {
            Presence::Silent | Presence::Gone => true,
            Presence::Here | Presence::Suspect { .. } => false,
        }
    }

    /// Checks that a process of identity `by` may take its name.
    pub fn gives_way_to(&self, name: &WorkerId, by: &Identity) -> Result<(), Rejected> {
        let Some(own) = &self.identity else { return Ok(()) };
        if own.caller != by.caller {
            return Err(Rejected::Forbidden(format!(
                "worker name `{name}` belongs to another token; choose another name with `--name`"
            )));
        }
        match self.presence {
            Presence::Silent | Presence::Gone => Ok(()),
            Presence::Here | Presence::Suspect { .. } if own.secret == by.secret => Ok(()),
            Presence::Here | Presence::Suspect { .. } => Err(Rejected::NameHeld(format!(
                "a process has joined as worker `{name}` and has not left; the name is free once it leaves or its lease ends"
            ))),
        }
    }

    /// The worker as a holder of a task.
    pub fn member(&self, name: &WorkerId) -> Member {
        Member { worker: name.clone(), incarnation: self.incarnation, peer_address: self.peer_address.clone() }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_table_in_the_header_is_what_the_code_does() {
        let presences = [Presence::Here, Presence::Suspect { since: Millis(0) }, Presence::Silent, Presence::Gone];
        let signs = [Sign::Join, Sign::Back, Sign::LeaseExpired, Sign::PeersLost, Sign::Gone];
        for presence in presences {
            let cells: Vec<_> = signs.iter().map(|sign| presence.after(*sign, Millis(1)).name()).collect();
            let row = format!("//! | {} | {} |", presence.name(), cells.join(" | "));
            assert!(include_str!("worker.rs").lines().any(|line| line == row), "{row}");
        }
    }
}
