//! The members of one generation of a gang as one of them sees them: sending, receiving, waiting.
//!
//! A mesh opens as soon as a generation is known, on threads of its own. So a member whose stage is in the middle of a
//! slice still answers its peers. Each link has a reader thread that queues frames. One thread sends keep-alives over
//! all idle links, so that a peer that computes for minutes differs from one that is gone. A peer is lost if its
//! connection ends without a goodbye, or if a member waits for it and receives no byte for too long (`peer`).
//!
//! Not its job: making connections (`connect`), the meaning of the frames (`exchange`), and the consequences of a loss
//! (the coordinator's decision).

use std::net::Shutdown;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, Weak};
use std::time::{Duration, Instant};

use protocol::message::{LossCause, LostPeer};
use protocol::{Generation, WorkerId};
use tokio::sync::Notify;

use super::endpoint::Endpoint;
use super::frame::{Frame, Head, Kind, MAX_PAYLOAD};
use super::link::{BLINK, Link, Sign};
use super::member::{MeshConfig, Phase, Timing};
use super::memory::Between;
use super::pace::Pace;
use super::peer::{Patience, Peer, Standing, Verdict};
use super::successor::Successor;
use crate::event_count::{EventCount, lock};

/// Limit of queued frames of a state, for a member that reads slower than they arrive: 16 MiB.
pub(super) const STATE_FRAMES: usize = (16 << 20) / MAX_PAYLOAD;

/// Reason for the early end of a wait.
#[derive(Debug, Clone, PartialEq)]
pub(crate) enum Halt {
    /// There is a newer generation.
    Regroup,
    /// The grant has ended.
    Ended(String),
    /// A peer is gone or has moved on; a newer generation will follow.
    Peer,
    /// A peer's messages do not match; it is given up.
    Disagree(String),
    /// A fault of this member.
    Fault(String),
}

/// The connections of one generation.
#[derive(Debug)]
pub(crate) struct Mesh {
    pub(crate) config: MeshConfig,
    pub(super) endpoint: Arc<Endpoint>,
    pub(super) timing: Timing,
    pub(super) peers: Mutex<Vec<Peer>>,
    pub(super) event_count: Arc<EventCount>,
    /// Wakes the poll, which reports lost peers.
    pub(super) wake: Arc<Notify>,
    /// The rank that the stage waits for, plus one; 0 if it waits for none.
    pub(super) waits_for: AtomicUsize,
    pub(super) pace: Pace,
    /// Memory between this member and each peer. Only the stage's threads use it.
    pub(super) memory: Vec<Mutex<Between>>,
    /// True if gradients pass over connections alone, also on one machine.
    pub(super) uses_no_memory: AtomicBool,
    pub(super) closed: AtomicBool,
    /// The generation after this one, for the threads that read its connections.
    pub(super) successor: Arc<Successor<Self>>,
}

impl Mesh {
    /// Number of members.
    pub(crate) fn size(&self) -> usize {
        self.config.members.len()
    }

    /// Ranks of the others, starting after this one, so that not all members send to the same one first.
    pub(crate) fn others(&self) -> impl Iterator<Item = usize> + use<> {
        let rank = self.config.rank;
        let size = self.size();
        (1..size).map(move |i| (rank + i) % size)
    }

    /// The same ranks, connected ones first, so that they do not wait for the connection of another one.
    pub(super) fn others_connected_first(&self) -> Vec<usize> {
        let peers = lock(&self.peers);
        let (mut connected, unmet): (Vec<_>, Vec<_>) = self.others().partition(|rank| peers[*rank].link.is_some());
        connected.extend(unmet);
        connected
    }

    /// The members with which this one cannot continue in this generation.
    pub(crate) fn lost(&self) -> Vec<LostPeer> {
        let peers = lock(&self.peers);
        let lost = peers.iter().zip(&self.config.members).filter_map(|(peer, member)| match &peer.standing {
            Standing::Lost(cause, _) => Some(LostPeer { worker: member.worker.clone(), cause: *cause }),
            Standing::Unmet(_) | Standing::Up | Standing::Left | Standing::Moved => None,
        });
        let slow = self.pace.slow().into_iter().filter(|rank| !matches!(peers[*rank].standing, Standing::Lost(..)));
        let slow = slow.map(|rank| LostPeer { worker: self.name(rank).clone(), cause: LossCause::Slow });
        lost.chain(slow).collect()
    }

    pub(super) fn sign(&self) -> Sign {
        let head = Head::new(Kind::KeepAlive, 0, self.config.busy.phase() as u32, 0);
        // A thread that wakes just before a keep-alive is due would delay it by a whole interval.
        Sign { head, every: self.timing.keep_alive * 3 / 4 }
    }

    /// Names the peers that delay the current exchange for too long. None is named while a member saves. A peer that is
    /// silent for once is not slow; it is given up after [`Timing::patience`].
    pub(super) fn watch_pace(&self) {
        let now = Instant::now();
        let is_silent = |peer: &Peer| {
            peer.standing == Standing::Up && now.duration_since(peer.pulse.last()) > self.timing.keep_alive * 2
        };
        let (saves, silent) = {
            let peers = lock(&self.peers);
            (peers.iter().any(|peer| peer.phase != Phase::Working), peers.iter().any(is_silent))
        };
        if saves {
            self.pace.excuse();
        } else if silent {
            self.pace.excuse_silence();
        }
        let waits_for = self.waits_for.load(Ordering::SeqCst).checked_sub(1);
        self.pace.overdue(self.others(), waits_for).into_iter().for_each(|peer| self.complain(peer));
    }

    /// Makes the next poll report that this gang is slower than its member alone, because of `rank`. The connection
    /// stays.
    pub(super) fn complain(&self, rank: usize) {
        let task = &self.config.task;
        let generation = self.config.generation;
        tracing::warn!(%task, %generation, peer = %self.name(rank), "the gang is slower than this member alone; it waits for this peer");
        self.wake.notify_one();
    }

    /// The member that the stage is waiting for.
    pub(crate) fn waits_for(&self) -> Option<WorkerId> {
        let rank = self.waits_for.load(Ordering::SeqCst).checked_sub(1)?;
        Some(self.name(rank).clone())
    }

    /// The lost members, each with the barrier and the reason.
    pub(crate) fn missing(&self) -> Vec<String> {
        let peers = lock(&self.peers);
        let missing = peers.iter().enumerate().filter_map(|(rank, peer)| match &peer.standing {
            Standing::Lost(_, reason) => Some(format!("{} (rank {rank}): {reason}", self.name(rank))),
            Standing::Unmet(_) | Standing::Up | Standing::Left | Standing::Moved => None,
        });
        missing.collect()
    }

    /// Gives up all other peers that are as silent as the one just given up, so that all missing members are named at
    /// once.
    fn lose_the_silent(&self, barrier: &str, awake: Instant) {
        let now = Instant::now();
        let silent: Vec<usize> = {
            let peers = lock(&self.peers);
            let silent = |(rank, peer): (usize, &Peer)| {
                let waits = matches!(peer.standing, Standing::Unmet(_) | Standing::Up) && rank != self.config.rank;
                (waits && now.duration_since(peer.pulse.last().max(awake)) > self.timing.patience).then_some(rank)
            };
            peers.iter().enumerate().filter_map(silent).collect()
        };
        for rank in silent {
            let reason = format!("{barrier}: no heartbeat for {} s", self.timing.patience.as_secs_f32());
            self.lose(rank, LossCause::Unreachable, reason);
        }
    }

    /// Says goodbye and closes. Frames already sent still arrive: only our direction of each connection is closed, and
    /// the readers drain the other until the peer closes it.
    pub(crate) fn close(&self, next: Option<Generation>) {
        if self.closed.swap(true, Ordering::SeqCst) {
            return;
        }
        let links: Vec<_> = lock(&self.peers).iter_mut().filter_map(|peer| peer.link.take()).collect();
        links.iter().for_each(|link| link.part(next));
    }

    pub(super) fn is_closed(&self) -> bool {
        self.closed.load(Ordering::SeqCst)
    }

    /// Makes gradients pass over connections alone, which a test may slow down.
    #[cfg(test)]
    pub(crate) fn use_no_memory(&self) {
        self.uses_no_memory.store(true, Ordering::SeqCst);
    }

    /// Number of unread frames from `rank`.
    #[cfg(test)]
    pub(crate) fn queued(&self, rank: usize) -> usize {
        lock(&self.peers)[rank].inbox.len()
    }

    /// Ends every connection without a goodbye, as the death of the process would.
    #[cfg(test)]
    pub(crate) fn sever(&self) {
        self.closed.store(true, Ordering::SeqCst);
        for peer in lock(&self.peers).iter_mut() {
            if let Some(link) = peer.link.take() {
                // A blocked thread may hold the writer; shutting down a clone of the socket ends that write too.
                let _ = link.socket.shutdown(Shutdown::Both);
            }
        }
        self.event_count.notify();
    }

    fn name(&self, rank: usize) -> &WorkerId {
        &self.config.members[rank].worker
    }

    /// Gives a peer up and makes the next poll report it.
    pub(super) fn lose(&self, rank: usize, cause: LossCause, reason: String) {
        if self.is_closed() {
            return;
        }
        {
            let peer = &mut lock(&self.peers)[rank];
            if matches!(peer.standing, Standing::Lost(..) | Standing::Moved) {
                return;
            }
            peer.standing = Standing::Lost(cause, reason.clone());
            if let Some(link) = peer.link.take() {
                let _ = link.socket.shutdown(Shutdown::Write);
            }
        }
        let task = &self.config.task;
        let generation = self.config.generation;
        tracing::warn!(%task, %generation, peer = %self.name(rank), "lost a gang member: {reason}");
        self.wake.notify_one();
        self.event_count.notify();
        self.miss_in_successor(rank);
    }

    /// Waits while the queue holds its limit of a state's frames. The rest stays with its sender, who sends nothing
    /// else meanwhile. Parts of a sum are queued without a limit, because all members send theirs before they read the
    /// others'.
    fn await_room(&self, rank: usize) {
        loop {
            let ticket = self.event_count.ticket();
            {
                let peer = &mut lock(&self.peers)[rank];
                peer.pulse.beat();
                if self.is_closed() || peer.standing != Standing::Up || peer.inbox.len() < STATE_FRAMES {
                    return;
                }
            }
            self.event_count.wait(ticket, BLINK);
        }
    }

    /// Notes a peer's activity of a keep-alive.
    pub(super) fn set_phase(&self, rank: usize, keep_alive: &Frame) {
        lock(&self.peers)[rank].phase = Phase::read(keep_alive.a);
    }

    /// Handles a received frame; frames of the exchange are queued.
    pub(super) fn receive(&self, rank: usize, frame: Frame, link: &Weak<Link>) {
        if frame.kind == Kind::State {
            self.await_room(rank);
        }
        if self.is_closed() {
            return;
        }
        {
            let peer = &mut lock(&self.peers)[rank];
            if peer.link.as_ref().is_some_and(|own| !std::ptr::eq(Arc::as_ptr(own), link.as_ptr())) {
                // Of a connection that another one has replaced.
                return;
            }
            peer.is_unproven = false;
            match frame.kind {
                Kind::KeepAlive => {
                    peer.phase = Phase::read(frame.a);
                    return;
                }
                Kind::Bye => peer.standing = if frame.step == 0 { Standing::Left } else { Standing::Moved },
                _ => peer.inbox.push_back((Instant::now(), frame)),
            }
        }
        self.event_count.notify();
    }

    /// The memory between this member and `rank`.
    pub(super) fn memory(&self, rank: usize) -> MutexGuard<'_, Between> {
        lock(&self.memory[rank])
    }

    /// Waits for a link to `rank`. Returns true if both ends are on this machine and may share memory.
    pub(super) fn may_share_memory(
        &self,
        rank: usize,
        barrier: &str,
        interrupt: &dyn Fn() -> Option<Halt>,
    ) -> Result<bool, Halt> {
        let link = self.wait(rank, barrier, interrupt, |peer| peer.link.clone())?;
        Ok(link.is_local && !self.uses_no_memory.load(Ordering::SeqCst))
    }

    /// Waits for a link to `rank` and sends over it. `interrupt` returns a reason to give up, and is asked before each
    /// frame: what is sent after an order to regroup only delays the next generation.
    pub(crate) fn send(
        &self,
        rank: usize,
        barrier: &str,
        head: Head,
        payload: &[u8],
        interrupt: &dyn Fn() -> Option<Halt>,
    ) -> Result<(), Halt> {
        if let Some(halt) = interrupt() {
            return Err(halt);
        }
        let link = self.wait(rank, barrier, interrupt, |peer| {
            let link = peer.link.clone()?;
            // Nothing else is sent before the peer has come to this generation.
            peer.first = peer.first.or((head.kind == Kind::Applied).then_some(head));
            Some(link)
        })?;
        let sent = link.send(head, payload, &self.sign(), self.timing.patience, &|| interrupt().is_some());
        let Err(error) = sent else { return Ok(()) };
        if let Some(halt) = interrupt() {
            return Err(halt);
        }
        if head.kind == Kind::Applied && self.sends_again(rank, &link) {
            return Ok(());
        }
        self.lose(rank, LossCause::Unreachable, format!("{barrier}: sending failed: {error}"));
        Err(Halt::Peer)
    }

    /// Returns the next frame from `rank`. Frames that arrived before a connection ended are still returned.
    pub(crate) fn next(&self, rank: usize, barrier: &str, interrupt: &dyn Fn() -> Option<Halt>) -> Result<Frame, Halt> {
        self.next_timed(rank, barrier, interrupt).map(|(_, frame)| frame)
    }

    /// Like [`Self::next`], with the time of arrival.
    pub(super) fn next_timed(
        &self,
        rank: usize,
        barrier: &str,
        interrupt: &dyn Fn() -> Option<Halt>,
    ) -> Result<(Instant, Frame), Halt> {
        let (at, frame) = self.wait(rank, barrier, interrupt, |peer| peer.inbox.pop_front())?;
        if frame.kind == Kind::State {
            self.event_count.notify();
        }
        Ok((at, frame))
    }

    /// Waits as long as `rank` lives. If it leaves in good order, waits for the coordinator's response to that.
    pub(crate) fn watch(&self, rank: usize, barrier: &str, interrupt: &dyn Fn() -> Option<Halt>) -> Halt {
        let Err(halt) = self.look_at(rank, barrier, interrupt, Patience::WhileItLives, |_| None::<Frame>) else {
            unreachable!("nothing is taken")
        };
        halt
    }

    fn wait<T>(
        &self,
        rank: usize,
        barrier: &str,
        interrupt: &dyn Fn() -> Option<Halt>,
        take: impl FnMut(&mut Peer) -> Option<T>,
    ) -> Result<T, Halt> {
        self.look_at(rank, barrier, interrupt, Patience::ForItsTurn, take)
    }

    fn look_at<T>(
        &self,
        rank: usize,
        barrier: &str,
        interrupt: &dyn Fn() -> Option<Halt>,
        patience: Patience,
        mut take: impl FnMut(&mut Peer) -> Option<T>,
    ) -> Result<T, Halt> {
        const CHECK_INTERVAL: Duration = Duration::from_millis(250);
        if let Some(taken) = take(&mut lock(&self.peers)[rank]) {
            return Ok(taken);
        }
        let _waiting = Waiting::on(self, rank);
        let mut begun = Instant::now();
        // If this process was stopped itself, the silence was its own and not the peers'.
        let mut awake = begun;
        let mut looked = begun;
        loop {
            let ticket = self.event_count.ticket();
            let now = Instant::now();
            if now.duration_since(looked) > CHECK_INTERVAL * 8 {
                awake = now;
            }
            looked = now;
            let verdict = {
                let peer = &mut lock(&self.peers)[rank];
                if let Some(taken) = take(peer) {
                    return Ok(taken);
                }
                if patience == Patience::WhileItLives || peer.phase == Phase::Saving {
                    begun = now;
                }
                let silent = now.duration_since(peer.pulse.last().max(awake));
                peer.verdict(&self.timing, patience, silent, now.duration_since(begun))
            };
            // Never under the lock: an interrupt looks at the peers too.
            if let Some(halt) = interrupt() {
                return Err(halt);
            }
            match verdict {
                Verdict::Waits => {}
                Verdict::Lost => return Err(Halt::Peer),
                Verdict::GiveUp(reason) => {
                    self.lose(rank, LossCause::Unreachable, format!("{barrier}: {reason}"));
                    self.lose_the_silent(barrier, awake);
                    return Err(Halt::Peer);
                }
            }
            self.event_count.wait(ticket, CHECK_INTERVAL);
        }
    }
}

/// While it lives, the mesh reports the peer that the stage waits for.
struct Waiting<'a>(&'a Mesh);

impl<'a> Waiting<'a> {
    fn on(mesh: &'a Mesh, rank: usize) -> Self {
        mesh.waits_for.store(rank + 1, Ordering::SeqCst);
        Self(mesh)
    }
}

impl Drop for Waiting<'_> {
    fn drop(&mut self) {
        self.0.waits_for.store(0, Ordering::SeqCst);
    }
}

impl Drop for Mesh {
    fn drop(&mut self) {
        self.close(None);
    }
}
