//! The worker's state of one assignment. The poll changes it, the stage runs under it, and uploads use its grant.
//!
//! A grant ends when the coordinator no longer lists it, and for no other reason. A failed call does not end it, and
//! neither does a lease that has expired by the local clock. A worker that is cut off keeps working, because its
//! results may still be wanted. If another worker holds the task by then, the store refuses our writes by their fence.
//! Correctness depends on that fence alone.

use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, OnceLock};
use std::time::{Duration, Instant};

use protocol::message::{Assignment, Doing, Grant, Progress, Role};
use protocol::{Digest, Generation};
use tokio::sync::Notify;

use crate::client::Credential;
use crate::event_count::{EventCount, lock};
use crate::gang::endpoint::Endpoint;
use crate::gang::member::{Busy, MeshConfig};
use crate::gang::mesh::{Halt, Mesh};

/// Time to wait after a refused write for the orders that explain it.
const STALE_PATIENCE: Duration = Duration::from_secs(30);
/// Time for the coordinator to let a gang continue without this worker. Then the whole gang saves and stops.
const POLITE: Duration = Duration::from_secs(3);
/// Time to train after a failed checkpoint before the next try.
const SAVE_PAUSE: Duration = Duration::from_secs(5);

#[derive(Debug)]
struct State {
    assignment: Assignment,
    ended: Option<String>,
    /// Set once the stage has returned; nothing runs under this grant any more.
    done: bool,
    progress: Progress,
    /// Steps applied to the training state in memory.
    holds: Option<u64>,
    committed: Option<Digest>,
    /// Highest memory of the process during this assignment, in bytes.
    peak_memory: Option<u64>,
    /// Connections of the newest generation, until the stage takes them.
    offered: Option<Arc<Mesh>>,
    newest: Option<Arc<Mesh>>,
}

/// The state of one assignment; see the module.
#[derive(Debug)]
pub(crate) struct ActiveAssignment {
    state: Mutex<State>,
    event_count: Arc<EventCount>,
    wake: Arc<Notify>,
    endpoint: Arc<Endpoint>,
    flags: Arc<Flags>,
    busy: Busy,
    /// True while the blobs being stored belong to a checkpoint that can be saved later.
    postponable: AtomicBool,
    put_off: Mutex<PutOff>,
}

/// Consecutive checkpoints that could not be stored, and the earliest time of the next try.
#[derive(Debug, Default)]
struct PutOff {
    times: u32,
    until: Option<Instant>,
}

/// Flags of the process, shared by all assignments.
#[derive(Debug, Default)]
pub(crate) struct Flags {
    /// Time of the request to leave.
    leaving: OnceLock<Instant>,
    /// True if the last poll was not answered.
    pub(crate) away: AtomicBool,
}

impl Flags {
    pub(crate) fn leave(&self) {
        self.leaving.get_or_init(Instant::now);
    }

    /// Time since the request to leave; `None` without one.
    pub(crate) fn leaving_for(&self) -> Option<Duration> {
        self.leaving.get().map(Instant::elapsed)
    }
}

/// Effect of new orders on a held task.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Reading {
    /// The same grant, possibly with other fields changed.
    Same,
    /// The same attempt in a gang with other members.
    Regrouped,
    /// A grant under which the stage starts from the beginning.
    Restart,
}

impl ActiveAssignment {
    pub(crate) fn new(
        assignment: Assignment,
        endpoint: Arc<Endpoint>,
        wake: Arc<Notify>,
        flags: Arc<Flags>,
    ) -> Arc<Self> {
        let state = State {
            assignment,
            ended: None,
            done: false,
            progress: Progress::default(),
            holds: None,
            committed: None,
            peak_memory: None,
            offered: None,
            newest: None,
        };
        let state = Mutex::new(state);
        let busy = Busy::default();
        let postponable = AtomicBool::new(false);
        let put_off = Mutex::default();
        let held = Self { state, event_count: Arc::default(), wake, endpoint, flags, busy, postponable, put_off };
        held.connect(&mut lock(&held.state));
        Arc::new(held)
    }

    /// The current grant, from the newest orders.
    pub(crate) fn grant(&self) -> Grant {
        lock(&self.state).assignment.grant.clone()
    }

    /// The current grant with its secret.
    pub(crate) fn credential(&self) -> Credential {
        let state = lock(&self.state);
        Credential { grant: state.assignment.grant.clone(), secret: state.assignment.secret.clone() }
    }

    pub(crate) fn assignment(&self) -> Assignment {
        lock(&self.state).assignment.clone()
    }

    /// Activity of this member, as reported to its peers.
    pub(crate) fn busy(&self) -> &Busy {
        &self.busy
    }

    pub(crate) fn event_count(&self) -> &Arc<EventCount> {
        &self.event_count
    }

    /// Compares `newer` orders with this assignment.
    pub(crate) fn read(&self, newer: &Assignment) -> Reading {
        let state = lock(&self.state);
        let old = &state.assignment.grant;
        let new = &newer.grant;
        let gang = matches!((&state.assignment.role, &newer.role), (Role::Member { .. }, Role::Member { .. }));
        if old == new {
            Reading::Same
        } else if gang && old.attempt == new.attempt && new.fence > old.fence && !state.done {
            Reading::Regrouped
        } else {
            Reading::Restart
        }
    }

    /// Replaces the orders with newer ones for the same attempt.
    pub(crate) fn update(&self, assignment: Assignment) {
        {
            let mut state = lock(&self.state);
            let regrouped = state.assignment.grant != assignment.grant;
            state.assignment = assignment;
            if regrouped {
                self.connect(&mut state);
            }
        }
        self.event_count.notify();
    }

    fn connect(&self, state: &mut State) {
        let Role::Member { generation, members, secret } = &state.assignment.role else { return };
        let grant = &state.assignment.grant;
        let own = members.iter().position(|m| m.worker == grant.worker && m.incarnation == grant.incarnation);
        let Some(rank) = own else {
            let reason =
                format!("generation {generation} of `{}` does not list this worker among its members", grant.task);
            tracing::error!("{reason}");
            state.ended = Some(reason);
            return;
        };
        let task = grant.task.clone();
        let members = members.clone();
        let secret = secret.clone();
        let busy = self.busy.clone();
        let config = MeshConfig { task, generation: *generation, rank, members, secret, busy };
        if let Some(unused) = state.offered.take() {
            unused.close(Some(*generation));
        }
        let before = state.newest.as_ref();
        let mesh = Mesh::open(config, &self.endpoint, self.event_count.clone(), self.wake.clone(), before);
        state.offered = Some(mesh.clone());
        state.newest = Some(mesh);
    }

    /// Takes the connections of the newest generation, unless the stage already has them.
    pub(crate) fn take_mesh(&self) -> Option<Arc<Mesh>> {
        lock(&self.state).offered.take()
    }

    /// The connections of the newest generation.
    pub(crate) fn newest_mesh(&self) -> Option<Arc<Mesh>> {
        lock(&self.state).newest.clone()
    }

    /// Ends all connections as the death of the process would.
    #[cfg(test)]
    pub(crate) fn sever(&self) {
        if let Some(mesh) = &lock(&self.state).newest {
            mesh.sever();
        }
    }

    /// Ends the grant: later calls under it are refused.
    pub(crate) fn end(&self, reason: &str) {
        {
            let mut state = lock(&self.state);
            state.ended.get_or_insert_with(|| reason.to_owned());
            if let Some(mesh) = state.offered.take() {
                mesh.close(None);
            }
        }
        self.event_count.notify();
    }

    /// The reason for the end of the grant, or `None` while it holds.
    pub(crate) fn ended(&self) -> Option<String> {
        lock(&self.state).ended.clone()
    }

    /// Marks the stage as returned and closes its connections.
    pub(crate) fn finish(&self) {
        let mut state = lock(&self.state);
        state.done = true;
        for mesh in [state.offered.take(), state.newest.take()].into_iter().flatten() {
            mesh.close(None);
        }
        drop(state);
        self.event_count.notify();
        self.wake.notify_one();
    }

    pub(crate) fn is_done(&self) -> bool {
        lock(&self.state).done
    }

    /// Returns true if a stage of `members` members should stop between two steps, because the coordinator drains it or
    /// the worker is leaving. Within [`POLITE`], the gang usually continues without it.
    pub(crate) fn drain(&self, members: usize) -> bool {
        let leaves = |waited: Duration| members <= 1 || waited >= POLITE;
        self.flags.leaving_for().is_some_and(leaves) || lock(&self.state).assignment.drain
    }

    /// Returns true if the last poll was not answered.
    pub(crate) fn is_away(&self) -> bool {
        self.flags.away.load(Ordering::SeqCst)
    }

    /// Sets whether the blobs stored from now on may be stored later instead.
    pub(crate) fn set_postponable(&self, may: bool) {
        self.postponable.store(may, Ordering::SeqCst);
    }

    pub(crate) fn may_put_off(&self) -> bool {
        self.postponable.load(Ordering::SeqCst)
    }

    /// Records whether part of a checkpoint could not be stored. If so, the next try follows after a pause that
    /// doubles.
    pub(crate) fn was_put_off(&self, was: bool) {
        let mut put_off = lock(&self.put_off);
        if was {
            let pause = SAVE_PAUSE.saturating_mul(1 << put_off.times.min(4));
            *put_off = PutOff { times: put_off.times + 1, until: Some(Instant::now() + pause) };
        } else {
            *put_off = PutOff::default();
        }
    }

    /// Returns true during the pause after a failed checkpoint.
    pub(crate) fn is_put_off(&self) -> bool {
        lock(&self.put_off).until.is_some_and(|until| Instant::now() < until)
    }

    /// The reason to stop waiting for peers of `generation`, if there is one.
    pub(crate) fn halt(&self, generation: Generation) -> Option<Halt> {
        let state = lock(&self.state);
        if let Some(reason) = &state.ended {
            return Some(Halt::Ended(reason.clone()));
        }
        match &state.assignment.role {
            Role::Member { generation: newest, .. } if *newest > generation => Some(Halt::Regroup),
            _ => None,
        }
    }

    /// Returns true if this worker records and reports: a single worker, or rank 0 of a gang.
    pub(crate) fn leads(&self) -> bool {
        let state = lock(&self.state);
        let grant = &state.assignment.grant;
        match &state.assignment.role {
            Role::Member { members, .. } => members
                .first()
                .is_some_and(|first| (&first.worker, first.incarnation) == (&grant.worker, grant.incarnation)),
            Role::Alone | Role::Resolve | Role::Shard { .. } | Role::Merge { .. } => true,
        }
    }

    /// The newest checkpoint: the one committed here, else the one in the orders.
    pub(crate) fn checkpoint(&self) -> Option<Digest> {
        let state = lock(&self.state);
        state.committed.or(state.assignment.resume)
    }

    pub(crate) fn committed(&self, manifest: Digest) {
        lock(&self.state).committed = Some(manifest);
    }

    pub(crate) fn set_progress(&self, progress: Progress) {
        lock(&self.state).progress = progress;
    }

    /// Notes that the process uses `bytes` of memory.
    pub(crate) fn saw_memory(&self, bytes: u64) {
        let mut state = lock(&self.state);
        state.peak_memory = state.peak_memory.max(Some(bytes));
    }

    /// The highest memory of the process during this assignment, in bytes.
    pub(crate) fn peak_memory(&self) -> Option<u64> {
        lock(&self.state).peak_memory
    }

    /// The report of this assignment for the poll.
    pub(crate) fn doing(&self) -> Doing {
        let state = lock(&self.state);
        let (lost, waits_for) = state.newest.as_ref().map(|mesh| (mesh.lost(), mesh.waits_for())).unwrap_or_default();
        let holds = state.holds;
        let peak_memory = state.peak_memory;
        let doing = Doing::new(state.assignment.grant.clone(), state.progress.clone());
        Doing { holds, waits_for, lost, peak_memory, ..doing }
    }

    /// Records the number of steps applied to the state in memory; `None` if the state is of no use to peers.
    pub(crate) fn set_holds(&self, steps: Option<u64>) {
        lock(&self.state).holds = steps;
    }

    /// Sleeps until something changes, for at most `at_most`. Returns the reason if the grant has ended.
    pub(crate) fn pause(&self, at_most: Duration) -> Result<(), String> {
        let until = Instant::now() + at_most;
        loop {
            let ticket = self.event_count.ticket();
            if let Some(reason) = self.ended() {
                return Err(reason);
            }
            let left = until.saturating_duration_since(Instant::now());
            if left.is_zero() {
                return Ok(());
            }
            self.event_count.wait(ticket, left);
        }
    }

    /// Waits for new orders after a call under `refused` met a newer fence or an unknown secret. Returns once there is
    /// a newer grant, or with the reason for the end.
    pub(crate) fn after_stale(&self, refused: &Credential) -> Result<(), String> {
        let until = Instant::now() + STALE_PATIENCE;
        loop {
            let ticket = self.event_count.ticket();
            if let Some(reason) = self.ended() {
                return Err(reason);
            }
            if self.credential() != *refused {
                return Ok(());
            }
            let left = until.saturating_duration_since(Instant::now());
            if left.is_zero() {
                let reason = "the store has a newer fence for the task";
                self.end(reason);
                return Err(reason.to_owned());
            }
            self.wake.notify_one();
            self.event_count.wait(ticket, left.min(Duration::from_millis(500)));
        }
    }
}
