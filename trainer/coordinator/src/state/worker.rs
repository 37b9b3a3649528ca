//! A worker name and the presence of its newest process.
//!
//! | presence \ event | Join | WorkerBack | LeaseExpired | PeersLost | WorkerGone |
//! |---|---|---|---|---|---|
//! | Here | Here | Here | Silent | Suspect | Gone |
//! | Suspect | Here | Here | Silent | Suspect | Gone |
//! | Silent | Here | Here | Silent | Silent | Gone |
//! | Gone | Here | Gone | Gone | Gone | Gone |
//!
//! Unknown is not dead: a silent worker may still be computing, and its next poll brings it back. Only the launcher of
//! the process can report it gone. Only a new process returns from that, by a join with the next incarnation. A worker
//! that leaves `Here` loses its tasks, which `decide` handles.
//!
//! A name belongs to the token that joined with it until the name is forgotten. While its process may be working
//! (`Here`, `Suspect`), only the same process can join again: it presents the same secret.

use std::collections::BTreeSet;

use protocol::message::{Join, Member};
use protocol::stage::Backend;
use protocol::{Digest, Incarnation, Labels, TaskId, WorkerId};

use serde::{Deserialize, Serialize};

use crate::rejected::Rejected;
use crate::time::Millis;

/// Availability of a worker for work.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Presence {
    /// The worker polls.
    Here,
    /// Peers could not reach it; it must poll again after a penalty.
    Suspect { since: Millis },
    /// Its lease expired.
    Silent,
    /// Its process is known to have ended.
    Gone,
}

/// An event that may change a worker's presence.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Sign {
    /// A new process joined with the name.
    Join,
    /// The worker polled again.
    Back,
    /// The worker did not poll for the length of its lease.
    LeaseExpired,
    /// Peers could not reach it.
    PeersLost,
    /// Its process ended.
    Gone,
}

impl Presence {
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

    /// The name in the table above.
    pub fn name(self) -> &'static str {
        match self {
            Self::Here => "Here",
            Self::Suspect { .. } => "Suspect",
            Self::Silent => "Silent",
            Self::Gone => "Gone",
        }
    }
}

/// The authenticated identity of a joining process.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Identity {
    /// The name in the token's line.
    pub caller: String,
    /// The digest of the secret that the process presents; the secret itself is not stored.
    pub secret: Digest,
}

/// A worker, as its newest process described it.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Worker {
    /// The number of this process.
    pub incarnation: Incarnation,
    /// The owner of the name. `None`: the worker joined before names belonged to tokens, and any process may replace
    /// it.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub identity: Option<Identity>,
    /// The operating system's process id, for display.
    pub pid: u32,
    /// The backend that it computes on.
    pub backend: Backend,
    /// The instruction set that its kernels use.
    #[serde(default)]
    pub instruction_set: String,
    /// Digest of the code versions of its stage kinds. `None`: the worker joined before they were compared.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub code: Option<Digest>,
    /// The address at which peers reach it.
    pub peer_address: String,
    /// Labels that stages may require.
    #[serde(default, skip_serializing_if = "Labels::is_empty")]
    pub labels: Labels,
    pub presence: Presence,
    /// True once the process was asked to end.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub leaving: bool,
    /// Number of times that this process was removed from a gang, or was the only one to complain of a removed member.
    /// Each time it is shunned for longer. The number decreases with time.
    pub suspicions: u32,
    /// The time of the last suspicion.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub suspected: Option<Millis>,
    /// The end of the period in which it joins no other members of a gang. It may work alone meanwhile.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub shunned: Option<Millis>,
    /// Gang tasks whose inputs it has reported to have. Some may be over.
    #[serde(default, skip_serializing_if = "BTreeSet::is_empty")]
    pub ready: BTreeSet<TaskId>,
    /// The held task: its execution's key and its index there. Derived from the tasks.
    #[serde(skip)]
    pub holds: Option<(Digest, usize)>,
}

/// What decides the bits that a worker computes.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Arithmetic<'a> {
    instruction_set: &'a str,
    code: Option<Digest>,
}

impl Worker {
    /// Creates the process that `join` announces.
    pub fn joined(join: &Join, by: Identity, incarnation: Incarnation) -> Self {
        Self {
            incarnation,
            identity: Some(by),
            pid: join.pid,
            backend: join.backend,
            instruction_set: join.instruction_set.clone(),
            code: Some(protocol::canonical::digest(&join.code_versions)),
            peer_address: join.peer_address.clone(),
            labels: join.labels.clone(),
            presence: Presence::Here,
            leaving: false,
            suspicions: 0,
            suspected: None,
            shunned: None,
            ready: BTreeSet::new(),
            holds: None,
        }
    }

    /// What all members of a gang have in common.
    pub fn arithmetic(&self) -> Arithmetic<'_> {
        Arithmetic { instruction_set: &self.instruction_set, code: self.code }
    }

    /// Returns true if the worker may be given work.
    pub fn is_available(&self) -> bool {
        self.presence == Presence::Here && !self.leaving
    }

    /// Returns true if the worker is not known to be alive.
    pub fn is_away(&self) -> bool {
        match self.presence {
            Presence::Silent | Presence::Gone => true,
            Presence::Here | Presence::Suspect { .. } => false,
        }
    }

    /// Checks that a process of identity `by` may take over the name.
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
                "another process has joined as worker `{name}`; the name is free once that process leaves or its lease ends"
            ))),
        }
    }

    /// The worker as a member that holds a task.
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
