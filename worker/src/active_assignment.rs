//! One assignment as this worker holds it: shared by the poll, which changes it, the stage, which lives under it, and the
//! uploads, which act in its name.
//!
//! A grant ends when the coordinator no longer lists it, and for no other reason: not because a call failed, and not
//! because a lease would have run out by our clock. A worker that is cut off goes on, since what it does may still be
//! wanted; should somebody else hold the task by then, the store refuses our writes by their fence. Correctness rests on
//! that alone.

use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use protocol::message::{Assignment, Doing, Grant, Progress, Role};
use protocol::{Digest, Generation};
use tokio::sync::Notify;

use crate::client::Credential;
use crate::event_count::{EventCount, lock};
use crate::gang::endpoint::Endpoint;
use crate::gang::member::{Busy, MeshConfig};
use crate::gang::mesh::{Halt, Mesh};

/// After a refused write, how long to wait for orders that explain it.
const STALE_PATIENCE: Duration = Duration::from_secs(30);
/// After a checkpoint that could not be stored, how long to train before the next try.
const SAVE_PAUSE: Duration = Duration::from_secs(5);

#[derive(Debug)]
struct State {
    assignment: Assignment,
    ended: Option<String>,
    /// The stage has returned; nothing runs under this grant any more.
    done: bool,
    progress: Progress,
    /// Steps of the training state in memory.
    holds: Option<u64>,
    committed: Option<Digest>,
    /// The newest generation's connections, until the stage takes them.
    offered: Option<Arc<Mesh>>,
    newest: Option<Arc<Mesh>>,
}

/// One assignment.
#[derive(Debug)]
pub(crate) struct ActiveAssignment {
    state: Mutex<State>,
    event_count: Arc<EventCount>,
    wake: Arc<Notify>,
    endpoint: Arc<Endpoint>,
    flags: Arc<Flags>,
    busy: Busy,
    /// What is stored now is a checkpoint that may be made later.
    postponable: AtomicBool,
    put_off: Mutex<PutOff>,
}

/// Checkpoints that could not be stored: how many in a row, and when the next one is tried.
#[derive(Debug, Default)]
struct PutOff {
    times: u32,
    until: Option<Instant>,
}

/// What holds for all that a worker holds.
#[derive(Debug, Default)]
pub(crate) struct Flags {
    /// It is to go.
    pub(crate) leaving: AtomicBool,
    /// The last poll was not answered.
    pub(crate) away: AtomicBool,
}

/// What a worker does when orders speak of a task that it holds.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Reading {
    /// The same right, perhaps with news.
    Same,
    /// The gang goes on with other members.
    Regrouped,
    /// A right to begin anew.
    Anew,
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
            offered: None,
            newest: None,
        };
        let (state, busy) = (Mutex::new(state), Busy::default());
        let (postponable, put_off) = (AtomicBool::new(false), Mutex::default());
        let held = Self { state, event_count: Arc::default(), wake, endpoint, flags, busy, postponable, put_off };
        held.connect(&mut lock(&held.state));
        Arc::new(held)
    }

    /// The right to write, as of the newest orders.
    pub(crate) fn grant(&self) -> Grant {
        lock(&self.state).assignment.grant.clone()
    }

    /// The same, with its secret.
    pub(crate) fn credential(&self) -> Credential {
        let state = lock(&self.state);
        Credential { grant: state.assignment.grant.clone(), secret: state.assignment.secret.clone() }
    }

    pub(crate) fn assignment(&self) -> Assignment {
        lock(&self.state).assignment.clone()
    }

    /// What the peers are told that this member is busy with.
    pub(crate) fn busy(&self) -> &Busy {
        &self.busy
    }

    pub(crate) fn event_count(&self) -> &Arc<EventCount> {
        &self.event_count
    }

    /// What `newer` orders mean for this assignment.
    pub(crate) fn read(&self, newer: &Assignment) -> Reading {
        let state = lock(&self.state);
        let (old, new) = (&state.assignment.grant, &newer.grant);
        let gang = matches!((&state.assignment.role, &newer.role), (Role::Member { .. }, Role::Member { .. }));
        if old == new {
            Reading::Same
        } else if gang && old.attempt == new.attempt && new.fence > old.fence && !state.done {
            Reading::Regrouped
        } else {
            Reading::Anew
        }
    }

    /// Takes newer orders for the same attempt.
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
        let (task, members, secret) = (grant.task.clone(), members.clone(), secret.clone());
        let busy = self.busy.clone();
        let config = MeshConfig { task, generation: *generation, rank, members, secret, busy };
        if let Some(unused) = state.offered.take() {
            unused.close(Some(*generation));
        }
        let mesh = Mesh::open(config, &self.endpoint, self.event_count.clone(), self.wake.clone());
        state.offered = Some(mesh.clone());
        state.newest = Some(mesh);
    }

    /// The connections of the newest generation, if the stage does not have them yet.
    pub(crate) fn take_mesh(&self) -> Option<Arc<Mesh>> {
        lock(&self.state).offered.take()
    }

    /// Ends all connections as the death of the process would.
    #[cfg(test)]
    pub(crate) fn sever(&self) {
        if let Some(mesh) = &lock(&self.state).newest {
            mesh.sever();
        }
    }

    /// Ends the grant: whatever is asked in its name from now on is refused.
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

    /// Why the grant has ended, if it has.
    pub(crate) fn ended(&self) -> Option<String> {
        lock(&self.state).ended.clone()
    }

    /// Nothing runs under this grant any more.
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

    /// Whether to stop between two steps: asked for by the coordinator, or because this process is to go.
    pub(crate) fn drain(&self) -> bool {
        self.flags.leaving.load(Ordering::SeqCst) || lock(&self.state).assignment.drain
    }

    /// Whether the coordinator did not answer the last poll.
    pub(crate) fn is_away(&self) -> bool {
        self.flags.away.load(Ordering::SeqCst)
    }

    /// Says whether what is stored from here on may be stored later.
    pub(crate) fn set_postponable(&self, may: bool) {
        self.postponable.store(may, Ordering::SeqCst);
    }

    pub(crate) fn may_put_off(&self) -> bool {
        self.postponable.load(Ordering::SeqCst)
    }

    /// Takes note of whether a part of a checkpoint could not be stored: the next one is tried after a pause that doubles.
    pub(crate) fn was_put_off(&self, was: bool) {
        let mut put_off = lock(&self.put_off);
        if was {
            let pause = SAVE_PAUSE.saturating_mul(1 << put_off.times.min(4));
            *put_off = PutOff { times: put_off.times + 1, until: Some(Instant::now() + pause) };
        } else {
            *put_off = PutOff::default();
        }
    }

    /// Whether a checkpoint could not be stored a moment ago.
    pub(crate) fn is_put_off(&self) -> bool {
        lock(&self.put_off).until.is_some_and(|until| Instant::now() < until)
    }

    /// Why to give up waiting for peers of `generation`, if there is a reason.
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

    /// Whether this worker is the one that records and reports: alone, or rank 0 of its gang.
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

    /// The newest checkpoint: ours, or the one the orders name.
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

    /// For the poll.
    pub(crate) fn doing(&self) -> Doing {
        let state = lock(&self.state);
        let (lost, waits_for) = state.newest.as_ref().map(|mesh| (mesh.lost(), mesh.waits_for())).unwrap_or_default();
        let holds = state.holds;
        Doing { holds, waits_for, lost, ..Doing::new(state.assignment.grant.clone(), state.progress.clone()) }
    }

    /// Notes how many steps the state in memory has seen; `None` if it is worth nothing to others.
    pub(crate) fn set_holds(&self, steps: Option<u64>) {
        lock(&self.state).holds = steps;
    }

    /// Sleeps until something changes, at most so long; returns why the grant has ended, if it has.
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

    /// A call under `refused` met a newer fence, or was not recognised. Waits for the orders that say what became of us: a newer grant to write
    /// under, or the end.
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
