//! Connections that outlive a generation.
//!
//! Two members of a generation that are both members of the next one keep their connection. So a regroup costs no
//! handshake, and TCP keeps the rate that it has learned. Each direction changes by itself. The goodbye of a generation is
//! the last frame under its key. The next frame is under the key of the generation that the goodbye names. That key
//! comes from the new generation's secret ([`Opening::renewed`](super::handshake::Opening::renewed)). A member that was
//! removed does not have it.
//!
//! The stage hands a connection over when it leaves the old generation. Until then the old one sends keep-alives. A reader
//! whose peer is ahead waits for its own orders. If the orders of one member skip a generation of the other, or if a
//! connection ends in between, the higher rank dials anew. Over a connection on which the peer has not yet sent anything,
//! a member has sent its first frame at most, because it waits for that of the peer. The new connection starts with this frame.

use std::cmp::Ordering;
use std::net::Shutdown;
use std::sync::atomic::Ordering::SeqCst;
use std::sync::{Arc, Weak};
use std::time::Duration;

use protocol::Generation;
use protocol::message::{LossCause, Member};

use super::frame::{Frame, Kind};
use super::link::Link;
use super::member::MeshConfig;
use super::mesh::Mesh;
use super::peer::Standing;
use super::seal::Seal;
use super::successor::{Next, Successor};
use crate::event_count::{EventCount, lock};

/// Longest time between two looks at the orders.
const LOOK: Duration = Duration::from_millis(250);

impl Mesh {
    /// Makes this the generation after `before`, whose connections to members of both are expected to continue here.
    pub(super) fn follow(self: &Arc<Self>, before: &Arc<Self>) {
        {
            let theirs = lock(&before.peers);
            if before.is_closed() {
                return;
            }
            let mut ours = lock(&self.peers);
            for (peer, member) in ours.iter_mut().zip(&self.config.members) {
                let old = before.rank_of(member).map(|rank| &theirs[rank]);
                if let Some(old) = old.filter(|old| old.link.is_some()) {
                    peer.inherits = true;
                    // The old generation's keep-alives are signs of life until the change.
                    peer.pulse = old.pulse.clone();
                }
            }
        }
        let generation = self.config.generation;
        before.successor.set(Next { generation, mesh: Arc::downgrade(self), successor: self.successor.clone() });
    }

    fn rank_of(&self, member: &Member) -> Option<usize> {
        let is_same = |one: &Member| (&one.worker, one.incarnation) == (&member.worker, member.incarnation);
        self.config.members.iter().position(is_same)
    }

    /// Leaves this generation for `next`. Connections to members of both continue there; the others are closed.
    pub(crate) fn hand_over(&self, next: &Arc<Self>) {
        if self.closed.swap(true, SeqCst) {
            return;
        }
        let links: Vec<_> = lock(&self.peers).iter_mut().map(|peer| peer.link.take()).collect();
        for (link, member) in links.into_iter().zip(&self.config.members) {
            let to = next.rank_of(member).filter(|rank| lock(&next.peers)[*rank].inherits);
            match (link, to) {
                (Some(link), Some(to)) => {
                    if !next.inherit(to, &link) {
                        let _ = link.socket.shutdown(Shutdown::Both);
                        next.miss(to);
                    }
                }
                (Some(link), None) => link.part(Some(next.config.generation)),
                (None, Some(to)) => next.miss(to),
                (None, None) => {}
            }
        }
        self.event_count.notify();
    }

    /// Continues a connection of the generation before. Returns false if that fails.
    fn inherit(&self, rank: usize, link: &Arc<Link>) -> bool {
        let Ok(mut writer) = link.writer.try_lock() else { return false };
        let is_said = writer.say_goodbye(Some(self.config.generation)).is_ok();
        if !is_said || Link::limit_unsent(&link.socket, self.size() - 1).is_err() {
            return false;
        }
        let MeshConfig { secret, generation, rank: own, .. } = &self.config;
        writer.seal = link.opening.renewed(secret, *generation, *own, rank).sends;
        let peer = &mut lock(&self.peers)[rank];
        if self.is_closed() || !matches!(peer.standing, Standing::Unmet(_)) {
            return false;
        }
        peer.link = Some(link.clone());
        peer.pulse.beat();
        peer.standing = Standing::Up;
        peer.inherits = false;
        peer.is_unproven = peer.inbox.is_empty();
        true
    }

    /// No connection of the generation before continues to `rank`: the higher rank dials.
    fn miss(self: &Arc<Self>, rank: usize) {
        {
            let peer = &mut lock(&self.peers)[rank];
            if !std::mem::take(&mut peer.inherits) {
                return;
            }
            peer.pulse.beat();
        }
        if rank < self.config.rank {
            self.start_dial(rank);
        }
    }

    /// Returns true if a frame that `link` did not take is sent again over another connection. That is so if the link was
    /// replaced, or if its peer has not come to this generation yet.
    pub(super) fn sends_again(&self, rank: usize, link: &Arc<Link>) -> bool {
        let peer = &mut lock(&self.peers)[rank];
        match &peer.link {
            Some(own) if !Arc::ptr_eq(own, link) => true,
            Some(_) if peer.is_unproven && peer.standing == Standing::Up => {
                // Its reader notices the end, and then the higher rank dials.
                let _ = link.socket.shutdown(Shutdown::Both);
                peer.link = None;
                peer.standing = Standing::Unmet(None);
                peer.is_unproven = false;
                peer.inherits = true;
                true
            }
            Some(_) => false,
            None => matches!(peer.standing, Standing::Unmet(_)),
        }
    }

    /// Tells the next generation that the connection to `rank` does not continue.
    pub(super) fn miss_in_successor(&self, rank: usize) {
        for next in self.successor.all() {
            if let Some(to) = next.rank_of(&self.config.members[rank]) {
                next.miss(to);
            }
        }
    }

    /// True if this is the connection to `rank`.
    fn has(&self, rank: usize, link: &Weak<Link>) -> bool {
        lock(&self.peers)[rank].link.as_ref().is_some_and(|own| std::ptr::eq(Arc::as_ptr(own), link.as_ptr()))
    }

    /// A connection that later generations may have taken over was never welcomed.
    pub(super) fn disinherit_successors(&self, rank: usize, link: &Arc<Link>, reason: &str) {
        disinherit(&self.successor, &self.config.members[rank], &Arc::downgrade(link), reason);
    }

    /// A connection of the generation before has ended before its peer came to this one.
    fn disinherit(self: &Arc<Self>, rank: usize, link: &Weak<Link>, reason: &str) {
        if self.has(rank, link) {
            let peer = &mut lock(&self.peers)[rank];
            if peer.standing == Standing::Up {
                peer.link = None;
                peer.standing = Standing::Unmet(Some(reason.to_owned()));
                peer.is_unproven = false;
                peer.inherits = true;
            }
        }
        self.miss(rank);
    }
}

/// Reports the end of the connection to `member` to all later generations.
fn disinherit(successor: &Successor<Mesh>, member: &Member, link: &Weak<Link>, reason: &str) {
    for next in successor.all() {
        if let Some(rank) = next.rank_of(member) {
            next.disinherit(rank, link, reason);
        }
    }
}

/// The generation of the frames that a reader gets.
#[derive(Debug)]
pub(super) struct Reading {
    /// Threads that outlive their mesh's owner hold it weakly.
    mesh: Weak<Mesh>,
    successor: Arc<Successor<Mesh>>,
    event_count: Arc<EventCount>,
    rank: usize,
    member: Member,
    link: Weak<Link>,
    opening: super::handshake::Opening,
    /// True before the first frame of a generation that the connection was handed over to.
    is_new: bool,
}

/// Where a reader continues after a goodbye.
pub(super) enum Follow {
    /// In the named generation, under this seal.
    Here(Seal),
    /// This member has no newer generation, or the peer is not in it.
    Nowhere,
    /// This member's newer generation is another one.
    Skipped,
}

impl Reading {
    pub(super) fn new(mesh: &Arc<Mesh>, rank: usize, link: &Arc<Link>) -> Self {
        Self {
            mesh: Arc::downgrade(mesh),
            successor: mesh.successor.clone(),
            event_count: mesh.event_count.clone(),
            rank,
            member: mesh.config.members[rank].clone(),
            link: Arc::downgrade(link),
            opening: link.opening.clone(),
            is_new: false,
        }
    }

    /// Passes a frame to its generation. Its activity is news for the next one too.
    pub(super) fn receive(&mut self, frame: Frame) {
        self.is_new = false;
        for next in self.successor.all().iter().filter(|_| frame.kind == Kind::KeepAlive) {
            if let Some(rank) = next.rank_of(&self.member) {
                next.set_phase(rank, &frame);
            }
        }
        if let Some(mesh) = self.mesh.upgrade() {
            mesh.receive(self.rank, frame, &self.link);
        }
    }

    /// Waits for this member's orders after the peer's goodbye.
    pub(super) fn follow(&mut self, wanted: Generation) -> Follow {
        let (mut mesh, mut successor) = (self.mesh.clone(), self.successor.clone());
        let next = loop {
            let ticket = self.event_count.ticket();
            let is_over = mesh.upgrade().is_none_or(|mesh| mesh.is_closed());
            match successor.get().map(|next| (next.generation.cmp(&wanted), next)) {
                Some((Ordering::Less, next)) => (mesh, successor) = (next.mesh.clone(), next.successor.clone()),
                Some((Ordering::Equal, next)) => match next.mesh.upgrade() {
                    Some(next) => break next,
                    None => return Follow::Skipped,
                },
                Some((Ordering::Greater, _)) => return Follow::Skipped,
                None if is_over => return Follow::Nowhere,
                None => self.event_count.wait(ticket, LOOK),
            }
        };
        let Some(rank) = next.rank_of(&self.member) else { return Follow::Nowhere };
        let renewed = self.opening.renewed(&next.config.secret, wanted, next.config.rank, rank);
        (self.mesh, self.successor, self.rank) = (Arc::downgrade(&next), next.successor.clone(), rank);
        self.is_new = true;
        Follow::Here(renewed.receives)
    }

    /// Reports the end of the connection to each generation that uses it.
    pub(super) fn end(&self, reason: &str) {
        disinherit(&self.successor, &self.member, &self.link, reason);
        let Some(mesh) = self.mesh.upgrade() else { return };
        let has_it = mesh.has(self.rank, &self.link);
        if self.is_new || !has_it {
            return mesh.disinherit(self.rank, &self.link, reason);
        }
        let parted = matches!(lock(&mesh.peers)[self.rank].standing, Standing::Left | Standing::Moved);
        if !parted {
            mesh.lose(self.rank, LossCause::Unreachable, reason.to_owned());
        }
    }
}
