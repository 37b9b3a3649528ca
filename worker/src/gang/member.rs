//! A member of a gang: whom it belongs with, how patient it is, and what it is busy with.

use std::sync::Arc;
use std::sync::atomic::{AtomicU8, Ordering};
use std::thread;
use std::time::Duration;

use protocol::message::Member;
use protocol::{Generation, TaskId};

/// How patient members are with each other.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Timing {
    /// A peer that is waited for and silent for so long is lost.
    pub(crate) patience: Duration,
    /// A sign of life goes out so often.
    pub(crate) keep_alive: Duration,
    /// A peer that shows signs of life but does not take its turn for so long is lost.
    pub(crate) stall: Duration,
    /// The same for a peer that has only begun: so long it may take to read its inputs, which it fetched before it became a member,
    /// to initialise itself, and to take over a state.
    pub(crate) start: Duration,
    /// A gang that is slower than one of its members alone is so for at least so long before a peer is named.
    pub(crate) slow: Duration,
    /// A peer at whose address nothing listens for so long is lost.
    pub(crate) refused: Duration,
}

impl Default for Timing {
    fn default() -> Self {
        Self {
            patience: Duration::from_secs(20),
            keep_alive: Duration::from_secs(3),
            stall: Duration::from_secs(30 * 60),
            start: Duration::from_secs(5 * 60),
            slow: Duration::from_secs(10),
            refused: Duration::from_secs(3),
        }
    }
}

/// What a member is busy with. It says so with its signs of life, for the others to know how long to wait for it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Phase {
    /// Reads its inputs; was at no rendezvous of this attempt yet.
    Starting,
    /// Computes, or waits for others.
    Working,
    /// Saves or reports: as long as the coordinator takes.
    Saving,
}

impl Phase {
    pub(super) fn read(number: u32) -> Self {
        match number {
            0 => Self::Starting,
            2 => Self::Saving,
            _ => Self::Working,
        }
    }
}

/// The phase of a member, which the stage sets and all meshes of the attempt tell.
#[derive(Debug, Clone, Default)]
pub(crate) struct Busy(Arc<AtomicU8>);

impl Busy {
    pub(crate) fn set(&self, phase: Phase) {
        self.0.store(phase as u8, Ordering::SeqCst);
    }

    pub(crate) fn phase(&self) -> Phase {
        Phase::read(self.0.load(Ordering::SeqCst).into())
    }
}

/// All that a mesh needs to know.
#[derive(Debug, Clone)]
pub(crate) struct MeshConfig {
    pub(crate) task: TaskId,
    pub(crate) generation: Generation,
    pub(crate) rank: usize,
    pub(crate) members: Vec<Member>,
    pub(crate) secret: String,
    /// What this member tells the others about itself.
    pub(crate) busy: Busy,
}

/// Starts a thread of the gang's connections.
pub(super) fn spawn(name: &str, serve: impl FnOnce() + Send + 'static) {
    // Without threads there is no worker either.
    thread::Builder::new().name(name.to_owned()).stack_size(512 << 10).spawn(serve).expect("a thread can be started");
}
