//! Operations of all members together: agreeing on the newest state, and summing gradients.
//!
//! **Rendezvous.** Every member sends all others the number of updates of its state. A member that is behind the
//! largest number takes the state of the lowest rank that has it. Members differ by at most one step. A sum is complete
//! for no member before every member has sent its part. So a member with the whole sum is at most one step ahead of one
//! that lost a peer before that. If all states are freshly initialised, none is taken: they are equal.
//!
//! **Exchange.** A reduce-scatter and an all-gather. A member's contiguous slices are a few nodes of the summation
//! tree. The buffer is cut into one chunk per member. Member m receives every node's partial sum of chunk m, follows
//! the tree to the root, and sends the result to all. No addition depends on the order of arrival. Partial sums are
//! computed in pieces during sending, so the buffer exists once per slice and once for the sum.
//!
//! Drain requests precede the parts. All members OR them over the same messages, so that all stop after the same step.

use std::ops::Range;
use std::time::{Duration, Instant};

use bytemuck::cast_slice;
use protocol::message::LossCause;

use super::frame::{Frame, Head, Kind, MAX_PAYLOAD, PIECE, Payload};
use super::mesh::{Halt, Mesh};
use super::tree::{self, Node};

const DRAIN: u32 = 1;
const SAVED: u32 = 2;

/// Limit of the data that follows a state, namely recorded values that may not be stored yet; larger data is refused.
const MAX_BEHIND_STATE: u64 = 256 << 20;

/// Returns a reason to give up, if there is one; called often.
pub(crate) type Interrupt<'a> = &'a (dyn Fn() -> Option<Halt> + Sync);

/// Result of a rendezvous for this member.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Met {
    Keep,
    /// This rank now sends its state of this many steps.
    Behind(usize, u64),
}

/// Finds the newest state among the members. Sends it to those behind, or names the rank that sends it to this one.
pub(crate) fn rendezvous(
    mesh: &Mesh,
    applied: Option<u64>,
    state: &[&[u8]],
    interrupt: Interrupt<'_>,
) -> Result<Met, Halt> {
    let barrier = rendezvous_barrier(mesh);
    let own = mesh.config.rank;
    let head = Head::new(Kind::Applied, applied.unwrap_or(0), u32::from(applied.is_some()), 0);
    for peer in mesh.others() {
        mesh.send(peer, &barrier, head, &[], interrupt)?;
    }
    let mut at = vec![None; mesh.size()];
    at[own] = applied;
    for peer in mesh.others() {
        let frame = expect(mesh.next(peer, &barrier, interrupt)?, Kind::Applied, mesh, peer)?;
        at[peer] = (frame.a == 1).then_some(frame.step);
    }
    let Some(newest) = at.iter().flatten().max().copied() else { return Ok(Met::Keep) };
    let source = at.iter().position(|&a| a == Some(newest)).expect("the maximum is one of them");
    let behind: Vec<usize> = mesh.others().filter(|&peer| at[peer] != Some(newest)).collect();

    if own == source && !behind.is_empty() {
        let bytes: usize = state.iter().map(|piece| piece.len()).sum();
        tracing::info!(step = newest, bytes, receivers = behind.len(), "sending the state to members behind");
        for peer in behind {
            mesh.send(peer, &barrier, Head::new(Kind::StateLength, bytes as u64, 0, 0), &[], interrupt)?;
            let (begun, mut sent) = (Instant::now(), 0);
            for piece in state.iter().flat_map(|piece| piece.chunks(MAX_PAYLOAD)) {
                // All other members wait for this one.
                let (elapsed, limit) = (begun.elapsed(), mesh.timing.start);
                let is_slow =
                    elapsed > mesh.timing.slow && elapsed.mul_f64(bytes as f64 / sent.max(1) as f64) > limit / 5;
                if elapsed > limit || is_slow {
                    let elapsed = elapsed.as_secs_f32();
                    let reason =
                        format!("{barrier}: it received {sent} of {bytes} bytes of the state in {elapsed:.0} s");
                    mesh.lose(peer, LossCause::Slow, reason);
                    return Err(Halt::Peer);
                }
                mesh.send(peer, &barrier, Head::new(Kind::State, newest, 0, 0), piece, interrupt)?;
                sent += piece.len();
            }
        }
        return Ok(Met::Keep);
    }
    if applied == Some(newest) {
        return Ok(Met::Keep);
    }
    Ok(Met::Behind(source, newest))
}

/// Receives into `room` the state that `source` sends after a rendezvous. Returns the data that follows the state.
///
/// With `directly`, the bytes arrive in `room` itself, which is left unusable by an interrupted transfer. Otherwise all
/// bytes are received first.
pub(crate) fn adopt(
    mesh: &Mesh,
    source: usize,
    room: &mut [&mut [u8]],
    directly: bool,
    interrupt: Interrupt<'_>,
) -> Result<Vec<u8>, Halt> {
    let barrier = rendezvous_barrier(mesh);
    let length = expect(mesh.next(source, &barrier, interrupt)?, Kind::StateLength, mesh, source)?.step;
    let wanted: u64 = room.iter().map(|piece| piece.len() as u64).sum();
    if length < wanted || length - wanted > MAX_BEHIND_STATE {
        let what = format!("offers a state of {length} bytes; expected {wanted} and at most {MAX_BEHIND_STATE} more");
        return Err(disagree(mesh, &barrier, source, &what));
    }
    let mut room = Room::new(room);
    let (mut pieces, mut there) = (Vec::new(), 0);
    while there < length {
        let frame = expect(mesh.next(source, &barrier, interrupt)?, Kind::State, mesh, source)?;
        there += frame.bytes().len() as u64;
        let Payload::Bytes(piece) = frame.payload else { unreachable!("a state's frames carry bytes") };
        if piece.is_empty() || there > length {
            let what = format!("sends pieces that do not add up to its state of {length} bytes");
            return Err(disagree(mesh, &barrier, source, &what));
        }
        if directly {
            room.fill(&piece);
        } else {
            // Assembling a large state would need its memory a second time.
            pieces.push(piece);
        }
    }
    pieces.iter().for_each(|piece| room.fill(piece));
    Ok(room.behind)
}

/// Pieces of memory that are filled in order.
struct Room<'a, 'b> {
    rest: std::slice::IterMut<'a, &'b mut [u8]>,
    now: &'a mut [u8],
    /// Bytes that arrived after all pieces were full.
    behind: Vec<u8>,
}

impl<'a, 'b> Room<'a, 'b> {
    fn new(pieces: &'a mut [&'b mut [u8]]) -> Self {
        Self { rest: pieces.iter_mut(), now: &mut [], behind: Vec::new() }
    }

    fn fill(&mut self, mut bytes: &[u8]) {
        while !bytes.is_empty() {
            if self.now.is_empty() {
                let Some(next) = self.rest.next() else {
                    self.behind.extend_from_slice(bytes);
                    return;
                };
                self.now = next;
                continue;
            }
            let fits = bytes.len().min(self.now.len());
            let (into, later) = std::mem::take(&mut self.now).split_at_mut(fits);
            into.copy_from_slice(&bytes[..fits]);
            (self.now, bytes) = (later, &bytes[fits..]);
        }
    }
}

fn rendezvous_barrier(mesh: &Mesh) -> String {
    format!("barrier `rendezvous` of generation {}", mesh.config.generation)
}

/// Input of a member to an exchange.
#[derive(Debug)]
pub(crate) struct Contribution<'a> {
    pub(crate) step: u64,
    pub(crate) slices: usize,
    /// The gradients of this member's share, slice by slice; all of one length.
    pub(crate) parts: Vec<(Node, &'a [f32])>,
    pub(crate) drain: bool,
    /// True if the member has saved since the last step.
    pub(crate) saved: bool,
    /// Time that its share took to compute.
    pub(crate) computed: Duration,
    /// The last step up to which rank 0 knows that all rows are stored.
    pub(crate) durable: u64,
}

/// Result of an exchange.
#[derive(Debug)]
pub(crate) struct Total {
    pub(crate) sum: Vec<f32>,
    pub(crate) drain: bool,
    /// [`Contribution::durable`] of rank 0.
    pub(crate) durable: u64,
}

/// Sums the gradients of all slices of a step.
pub(crate) fn exchange(mesh: &Mesh, contribution: &Contribution<'_>, interrupt: Interrupt<'_>) -> Result<Total, Halt> {
    let (own, size) = (mesh.config.rank, mesh.size());
    let root = 0..contribution.slices;
    if size == 1 {
        let length = contribution.parts.first().map_or(0, |(_, part)| part.len());
        let mut sum = vec![0.0; length];
        tree::sum(&root, &contribution.parts, &mut sum);
        return Ok(Total { sum, drain: contribution.drain, durable: contribution.durable });
    }
    let barrier = format!("barrier `exchange` of step {} in generation {}", contribution.step, mesh.config.generation);
    let halt = interrupt;
    let interrupt: Interrupt<'_> = &|| {
        mesh.watch_pace();
        halt()
    };
    let own_slices = tree::share(contribution.slices, own, size);
    mesh.pace.begin(contribution.computed, own_slices.len(), contribution.slices);
    if contribution.saved {
        mesh.pace.excuse();
    }

    // Reduce-scatter, sending: each peer's chunk of our nodes. All sends run at once, so that a slow peer does not
    // delay the others.
    let nodes = tree::cover(contribution.slices, &own_slices);
    let peers: Vec<usize> = mesh.others().collect();
    let send = |peer: usize| send_parts(mesh, &barrier, contribution, peer, &nodes, interrupt);
    if let [peer] = peers[..] {
        send(peer)?;
    } else {
        std::thread::scope(|scope| {
            let sends: Vec<_> = peers.iter().map(|peer| scope.spawn(|| send(*peer))).collect();
            let sent = sends.into_iter().map(|thread| thread.join().expect("sending does not panic"));
            sent.collect::<Vec<_>>().into_iter().collect::<Result<(), Halt>>()
        })?;
    }

    let received = receive_parts(mesh, &barrier, contribution, interrupt)?;
    let length = received.length.ok_or_else(|| Halt::Fault(format!("{barrier}: no member has a slice")))?;

    // Sum our chunk up to the root of the tree.
    let chunk = tree::share(length, own, size);
    let mut known: Vec<(Node, &[f32])> =
        contribution.parts.iter().map(|(slice, part)| (slice.clone(), &part[chunk.clone()])).collect();
    known.extend(received.sums.iter().map(|(node, sum)| (node.clone(), sum.as_slice())));
    known.sort_by_key(|(node, _)| node.start);
    let mut sum = vec![0.0; length];
    tree::sum(&root, &known, &mut sum[chunk.clone()]);
    gather(mesh, &barrier, contribution.step, &mut sum, interrupt)?;
    if let Some(slow) = mesh.pace.end(mesh.others()) {
        mesh.complain(slow);
    }
    Ok(Total { sum, drain: received.drain, durable: received.durable })
}

/// Parts and flags of a step from all peers.
struct Received {
    /// This member's chunk of the peers' nodes.
    sums: Vec<(Node, Vec<f32>)>,
    /// Length of the whole buffer, unless no member has a slice.
    length: Option<usize>,
    drain: bool,
    durable: u64,
}

/// Receives this member's chunk of each peer's nodes: the second half of the reduce-scatter.
fn receive_parts(
    mesh: &Mesh,
    barrier: &str,
    contribution: &Contribution<'_>,
    interrupt: Interrupt<'_>,
) -> Result<Received, Halt> {
    let disagree = |peer: usize, what: String| disagree(mesh, barrier, peer, &what);
    let (own, size) = (mesh.config.rank, mesh.size());
    let mut received = Received {
        sums: Vec::new(),
        length: contribution.parts.first().map(|(_, part)| part.len()),
        drain: contribution.drain,
        durable: if own == 0 { contribution.durable } else { 0 },
    };
    for peer in mesh.others() {
        let (mut came, begin) = mesh.next_timed(peer, barrier, interrupt)?;
        let begin = expect(begin, Kind::Begin, mesh, peer)?;
        if begin.step != contribution.step || begin.a != number(contribution.slices) {
            return Err(disagree(
                peer,
                format!("is at step {} with {} slices; expected {} slices", begin.step, begin.a, contribution.slices),
            ));
        }
        let (at, stored) = numbers(&begin).ok_or_else(|| disagree(peer, "sends a malformed greeting".to_owned()))?;
        received.drain |= begin.b & DRAIN != 0;
        if begin.b & SAVED != 0 {
            mesh.pace.excuse();
        }
        if peer == 0 {
            received.durable = stored;
        }
        let nodes = tree::cover(contribution.slices, &tree::share(contribution.slices, peer, size));
        if nodes.is_empty() {
            mesh.pace.received(peer, came);
            continue;
        }
        let at = usize::try_from(at).map_err(|_| disagree(peer, format!("has a buffer of {at} numbers")))?;
        let length = *received.length.get_or_insert(at);
        if at != length {
            return Err(disagree(peer, format!("has a buffer of {at} numbers; expected {length}")));
        }
        let chunk = tree::share(length, own, size);
        for (n, node) in nodes.into_iter().enumerate() {
            let mut numbers = Vec::with_capacity(chunk.len());
            for (p, range) in pieces(&chunk).enumerate() {
                let (at, frame) = mesh.next_timed(peer, barrier, interrupt)?;
                let frame = expect(frame, Kind::Part, mesh, peer)?;
                came = at;
                let place = (frame.a, frame.b) == (number(n), number(p));
                let Some(part) = floats(frame).filter(|part| place && part.len() == range.len()) else {
                    return Err(disagree(peer, format!("sends an unexpected part at node {n}, piece {p}")));
                };
                if numbers.is_empty() && range.len() == chunk.len() { numbers = part } else { numbers.extend(part) }
            }
            received.sums.push((node, numbers));
        }
        mesh.pace.received(peer, came);
    }
    Ok(received)
}

/// Sends this member's chunk of the sum and receives the others': the all-gather.
fn gather(mesh: &Mesh, barrier: &str, step: u64, sum: &mut [f32], interrupt: Interrupt<'_>) -> Result<(), Halt> {
    let (own, size, length) = (mesh.config.rank, mesh.size(), sum.len());
    for peer in mesh.others() {
        for (p, range) in pieces(&tree::share(length, own, size)).enumerate() {
            let head = Head::new(Kind::Sum, step, 0, number(p));
            mesh.send(peer, barrier, head, cast_slice(&sum[range]), interrupt)?;
        }
    }
    for peer in mesh.others() {
        for (p, range) in pieces(&tree::share(length, peer, size)).enumerate() {
            let frame = expect(mesh.next(peer, barrier, interrupt)?, Kind::Sum, mesh, peer)?;
            let place = frame.b == number(p) && frame.step == step;
            let Some(part) = floats(frame).filter(|part| place && part.len() == range.len()) else {
                return Err(disagree(mesh, barrier, peer, &format!("sends an unexpected sum at piece {p}")));
            };
            sum[range].copy_from_slice(&part);
        }
    }
    Ok(())
}

/// Sends a peer its chunk of this member's nodes.
fn send_parts(
    mesh: &Mesh,
    barrier: &str,
    contribution: &Contribution<'_>,
    peer: usize,
    nodes: &[Node],
    interrupt: Interrupt<'_>,
) -> Result<(), Halt> {
    let flags = (if contribution.drain { DRAIN } else { 0 }) | (if contribution.saved { SAVED } else { 0 });
    let length = contribution.parts.first().map(|(_, part)| part.len());
    let mut greeting = [0u8; 16];
    greeting[..8].copy_from_slice(&(length.unwrap_or(0) as u64).to_le_bytes());
    greeting[8..].copy_from_slice(&contribution.durable.to_le_bytes());
    let head = Head::new(Kind::Begin, contribution.step, number(contribution.slices), flags);
    mesh.send(peer, barrier, head, &greeting, interrupt)?;
    let chunk = length.map_or(0..0, |length| tree::share(length, peer, mesh.size()));
    let mut piece = vec![0.0f32; PIECE.min(chunk.len())];
    for (n, node) in nodes.iter().enumerate() {
        for (p, range) in pieces(&chunk).enumerate() {
            let parts = &contribution.parts[within(&contribution.parts, node)];
            let leaves: Vec<(Node, &[f32])> =
                parts.iter().map(|(slice, part)| (slice.clone(), &part[range.clone()])).collect();
            let out = &mut piece[..range.len()];
            tree::sum(node, &leaves, out);
            let head = Head::new(Kind::Part, contribution.step, number(n), number(p));
            mesh.send(peer, barrier, head, cast_slice(out), interrupt)?;
        }
    }
    mesh.pace.sent(peer);
    Ok(())
}

fn number(n: usize) -> u32 {
    u32::try_from(n).expect("slices and pieces are counted in thousands")
}

fn numbers(begin: &Frame) -> Option<(u64, u64)> {
    let (a, b) = begin.bytes().split_at_checked(8)?;
    Some((u64::from_le_bytes(a.try_into().ok()?), u64::from_le_bytes(b.try_into().ok()?)))
}

fn floats(frame: Frame) -> Option<Vec<f32>> {
    match frame.payload {
        Payload::Floats(floats) => Some(floats),
        Payload::Bytes(_) => None,
    }
}

/// Splits a chunk into the pieces that are sent.
fn pieces(chunk: &Range<usize>) -> impl Iterator<Item = Range<usize>> + use<> {
    let chunk = chunk.clone();
    chunk.clone().step_by(PIECE).map(move |start| start..(start + PIECE).min(chunk.end))
}

/// The range in `parts` (slices in order) that belongs to `node`.
fn within(parts: &[(Node, &[f32])], node: &Node) -> Range<usize> {
    let first = parts.partition_point(|(slice, _)| slice.start < node.start);
    first..first + node.len()
}

fn expect(frame: Frame, kind: Kind, mesh: &Mesh, peer: usize) -> Result<Frame, Halt> {
    if frame.kind == kind {
        return Ok(frame);
    }
    let what = format!("sent a frame of kind {:?}; expected {kind:?}", frame.kind);
    Err(disagree(mesh, &format!("generation {}", mesh.config.generation), peer, &what))
}

/// Gives up a peer whose messages do not match ours.
pub(crate) fn disagree(mesh: &Mesh, barrier: &str, peer: usize, what: &str) -> Halt {
    let reason =
        format!("{barrier}: `{}` {what}; use the same build for all workers", mesh.config.members[peer].worker);
    mesh.lose(peer, LossCause::Disagrees, reason.clone());
    Halt::Disagree(reason)
}
