//! A member of a gang: its peers, its time limits and its current activity.

use std::sync::Arc;
use std::sync::atomic::{AtomicU8, Ordering};
use std::thread;
use std::time::Duration;

use protocol::message::Member;
use protocol::{Generation, TaskId};

/// Time limits between members.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Timing {
    /// A peer that is waited for and silent for this long is lost.
    pub(crate) patience: Duration,
    /// Interval between keep-alives.
    pub(crate) keep_alive: Duration,
    /// A peer that sends keep-alives but not its part for this long is lost.
    pub(crate) stall: Duration,
    /// Like `stall`, for a peer that has just started. In this time it reads its prefetched inputs, initialises itself
    /// and takes over a state.
    pub(crate) start: Duration,
    /// A gang must be slower than one of its members alone for at least this long before a peer is named.
    pub(crate) slow: Duration,
    /// A peer whose address refuses connections for this long is lost.
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

/// Activity of a member. Its keep-alives carry it, so that the others know how long to wait.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Phase {
    /// Reads its inputs; has not reached a rendezvous of this attempt.
    Starting,
    /// Computes or waits for others.
    Working,
    /// Saves or reports; lasts as long as the coordinator takes.
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

/// The phase of a member. The stage sets it, and all meshes of the attempt report it.
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

/// Settings of a mesh.
#[derive(Debug, Clone)]
pub(crate) struct MeshConfig {
    pub(crate) task: TaskId,
    pub(crate) generation: Generation,
    pub(crate) rank: usize,
    pub(crate) members: Vec<Member>,
    pub(crate) secret: String,
    /// Activity of this member, reported to the others.
    pub(crate) busy: Busy,
}

/// Starts a thread of the gang's connections.
pub(super) fn spawn(name: &str, serve: impl FnOnce() + Send + 'static) {
    // A worker is useless without threads.
    thread::Builder::new().name(name.to_owned()).stack_size(512 << 10).spawn(serve).expect("a thread can be started");
}
