//! The sum of all members' gradients.
//!
//! A reduce-scatter and an all-gather. A member's contiguous slices are a few nodes of the summation
//! tree. The buffer is cut into one chunk per member. Member m receives every node's partial sum of chunk m, follows
//! the tree to the root, and sends the result to all. No addition depends on the order of arrival. Partial sums are
//! computed in pieces during sending, so the buffer exists once per slice and once for the sum. Members of one machine
//! pass numbers by [`memory`](super::memory): for a peer the parts of all nodes, then the sum of the own chunk.
//!
//! Drain requests precede the parts. All members OR them over the same messages, so that all stop after the same step.

use std::ops::Range;
use std::time::{Duration, Instant};

use bytemuck::cast_slice;
use models::flat;
use protocol::message::LossCause;

use super::frame::{Frame, Head, Kind, PIECE, Payload};
use super::memory::Announcement;
use super::mesh::{Halt, Mesh};
use super::tree::{self, Node};

const DRAIN: u32 = 1;
const SAVES: u32 = 2;
/// The sender has mapped the receiver's memory.
const MAPPED: u32 = 4;

/// Returns a reason to give up, if there is one; called often.
pub(crate) type Interrupt<'a> = &'a (dyn Fn() -> Option<Halt> + Sync);

/// Input of a member to an exchange.
#[derive(Debug)]
pub(crate) struct Contribution<'a> {
    pub(crate) step: u64,
    pub(crate) slices: usize,
    /// The gradients of this member's share, slice by slice; all of one length.
    pub(crate) parts: Vec<(Node, &'a [f32])>,
    pub(crate) drain: bool,
    /// True if the member saves, or has saved since the last step.
    pub(crate) saves: bool,
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
    let own = mesh.config.rank;
    let size = mesh.size();
    let root = 0..contribution.slices;
    let barrier = format!("barrier `exchange` of step {} in generation {}", contribution.step, mesh.config.generation);
    let halt = interrupt;
    let interrupt: Interrupt<'_> = &|| {
        mesh.watch_pace();
        halt()
    };
    let own_slices = tree::share(contribution.slices, own, size);
    mesh.pace.begin(contribution.computed, own_slices.len(), contribution.slices);
    if contribution.saves {
        mesh.pace.excuse();
    }

    // Reduce-scatter, sending: each peer's chunk of our nodes. All sends run at once, so that a slow peer does not
    // delay the others.
    let nodes = tree::cover(contribution.slices, &own_slices);
    at_once(mesh.others(), &|peer| send_parts(mesh, &barrier, contribution, peer, &nodes, interrupt))?;

    let received = receive_parts(mesh, &barrier, contribution, interrupt)?;
    let length = received.length.ok_or_else(|| Halt::Fault(format!("{barrier}: no member has a slice")))?;

    // Sum our chunk up to the root of the tree.
    let chunk = tree::chunk(length, own, size);
    let mut known: Vec<(Node, &[f32])> =
        contribution.parts.iter().map(|(slice, part)| (slice.clone(), &part[chunk.clone()])).collect();
    known.extend(received.sums.iter().map(|(node, sum)| (node.clone(), sum.as_slice())));
    known.sort_by_key(|(node, _)| node.start);
    let mut sum = flat::buffer(length);
    tree::sum(&root, &known, &mut sum[chunk.clone()]);
    received.sums.into_iter().for_each(|(_, part)| flat::recycle(part));
    gather(mesh, &barrier, contribution, &mut sum, interrupt)?;
    if let Some(slow) = mesh.pace.end(mesh.others()) {
        mesh.complain(slow);
    }
    Ok(Total { sum, drain: received.drain, durable: received.durable })
}

/// Sends to all peers at once.
fn at_once(peers: impl Iterator<Item = usize>, send: &(dyn Fn(usize) -> Result<(), Halt> + Sync)) -> Result<(), Halt> {
    let peers: Vec<usize> = peers.collect();
    if let [peer] = peers[..] {
        return send(peer);
    }
    std::thread::scope(|scope| {
        let sends: Vec<_> = peers.into_iter().map(|peer| scope.spawn(move || send(peer))).collect();
        let sent = sends.into_iter().map(|thread| thread.join().expect("sending does not panic"));
        sent.collect::<Vec<_>>().into_iter().collect()
    })
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
    let own = mesh.config.rank;
    let size = mesh.size();
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
        let greeting = Greeting::read(begin.bytes());
        let greeting = greeting.ok_or_else(|| disagree(peer, "sends a malformed greeting".to_owned()))?;
        let at = greeting.length;
        let stored = greeting.durable;
        let announced = greeting.announced.filter(|_| mesh.may_share_memory(peer, barrier, interrupt) == Ok(true));
        mesh.memory(peer).greeted(begin.step, announced.as_ref(), begin.b & MAPPED != 0);
        received.drain |= begin.b & DRAIN != 0;
        if begin.b & SAVES != 0 {
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
        let chunk = tree::chunk(length, own, size);
        for (n, node) in nodes.into_iter().enumerate() {
            let (at, numbers) = receive_part(mesh, barrier, peer, n, &chunk, interrupt)?;
            came = at.unwrap_or(came);
            received.sums.push((node, numbers));
        }
        mesh.pace.received(peer, came);
    }
    Ok(received)
}

/// Receives this member's chunk of node `n` of a peer, with the time of the last frame.
fn receive_part(
    mesh: &Mesh,
    barrier: &str,
    peer: usize,
    n: usize,
    chunk: &Range<usize>,
    interrupt: Interrupt<'_>,
) -> Result<(Option<Instant>, Vec<f32>), Halt> {
    let mut came = None;
    let mut numbers = Vec::new();
    for (p, range) in pieces(chunk).enumerate() {
        let (at, frame) = mesh.next_timed(peer, barrier, interrupt)?;
        came = Some(at);
        let unexpected = || disagree(mesh, barrier, peer, &format!("sends an unexpected part at node {n}, piece {p}"));
        let place = (frame.a, frame.b) == (number(n), number(p));
        if place && p == 0 && frame.kind == Kind::SharedPart {
            numbers = flat::buffer(chunk.len());
            if !mesh.memory(peer).read_parts(n * chunk.len(), &mut numbers) {
                return Err(unexpected());
            }
            break;
        }
        let frame = expect(frame, Kind::Part, mesh, peer)?;
        let part = floats(frame).filter(|part| place && part.len() == range.len()).ok_or_else(unexpected)?;
        if range.len() == chunk.len() {
            numbers = part;
        } else {
            numbers.reserve_exact(chunk.len() - numbers.len());
            numbers.extend(part);
        }
    }
    Ok((came, numbers))
}

/// Sends this member's chunk of the sum and receives the others': the all-gather.
fn gather(
    mesh: &Mesh,
    barrier: &str,
    contribution: &Contribution<'_>,
    sum: &mut [f32],
    interrupt: Interrupt<'_>,
) -> Result<(), Halt> {
    let step = contribution.step;
    let own = mesh.config.rank;
    let size = mesh.size();
    let length = sum.len();
    let chunk = tree::chunk(length, own, size);
    let own_sum = &sum[chunk.clone()];
    at_once(mesh.others(), &|peer| {
        if let Some(memory) = mesh.memory(peer).outgoing().filter(|_| !chunk.is_empty()) {
            memory.sum(chunk.len()).copy_from_slice(own_sum);
            return mesh.send(peer, barrier, Head::new(Kind::SharedSum, step, 0, 0), &[], interrupt);
        }
        own_sum.chunks(PIECE).enumerate().try_for_each(|(p, piece)| {
            let head = Head::new(Kind::Sum, step, 0, number(p));
            mesh.send(peer, barrier, head, cast_slice(piece), interrupt)
        })
    })?;
    for peer in mesh.others() {
        let chunk = tree::chunk(length, peer, size);
        for (p, range) in pieces(&chunk).enumerate() {
            let frame = mesh.next(peer, barrier, interrupt)?;
            let unexpected = || disagree(mesh, barrier, peer, &format!("sends an unexpected sum at piece {p}"));
            let place = frame.b == number(p) && frame.step == step;
            if place && p == 0 && frame.kind == Kind::SharedSum {
                if !mesh.memory(peer).read_sum(&mut sum[chunk.clone()]) {
                    return Err(unexpected());
                }
                break;
            }
            let frame = expect(frame, Kind::Sum, mesh, peer)?;
            let part = floats(frame).filter(|part| place && part.len() == range.len()).ok_or_else(unexpected)?;
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
    let step = contribution.step;
    let length = contribution.parts.first().map_or(0, |(_, part)| part.len());
    let chunk = tree::chunk(length, peer, mesh.size());
    let own = tree::chunk(length, mesh.config.rank, mesh.size());
    let local = mesh.may_share_memory(peer, barrier, interrupt)?;
    let mut memory = mesh.memory(peer);
    let (parts, sums) = (nodes.len() * chunk.len(), own.len());
    let announced = if local && parts + sums > 0 { memory.announce(step, parts, sums) } else { None };
    let greeting = Greeting { length: length as u64, durable: contribution.durable, announced };
    let flags = [(contribution.drain, DRAIN), (contribution.saves, SAVES), (memory.has_incoming(), MAPPED)];
    let flags = flags.iter().filter(|(is_set, _)| *is_set).fold(0, |all, (_, flag)| all | flag);
    let sum = |node: &Node, range: Range<usize>, out: &mut [f32]| {
        let parts = &contribution.parts[within(&contribution.parts, node)];
        let leaves: Vec<(Node, &[f32])> =
            parts.iter().map(|(slice, part)| (slice.clone(), &part[range.clone()])).collect();
        tree::sum(node, &leaves, out);
    };
    // Shared parts are written before the peer hears of them, so that it never waits for one after the greeting.
    let shared = memory.outgoing().filter(|_| !chunk.is_empty()).map(|memory| {
        for (n, node) in nodes.iter().enumerate() {
            sum(node, chunk.clone(), memory.parts(n * chunk.len()..(n + 1) * chunk.len()));
        }
    });
    let is_shared = shared.is_some();
    let head = Head::new(Kind::Begin, step, number(contribution.slices), flags);
    mesh.send(peer, barrier, head, &greeting.to_bytes(), interrupt)?;
    let mut piece = vec![0.0f32; PIECE.min(chunk.len())];
    for (n, node) in nodes.iter().enumerate() {
        if is_shared {
            let head = Head::new(Kind::SharedPart, step, number(n), 0);
            mesh.send(peer, barrier, head, &[], interrupt)?;
            continue;
        }
        for (p, range) in pieces(&chunk).enumerate() {
            let out = &mut piece[..range.len()];
            sum(node, range, out);
            let head = Head::new(Kind::Part, step, number(n), number(p));
            mesh.send(peer, barrier, head, cast_slice(out), interrupt)?;
        }
    }
    mesh.pace.sent(peer);
    Ok(())
}

/// Payload of a `Begin` frame.
struct Greeting {
    /// Floats in the buffer; 0 if the sender has no slice.
    length: u64,
    /// [`Contribution::durable`].
    durable: u64,
    announced: Option<Announcement>,
}

impl Greeting {
    fn to_bytes(&self) -> Vec<u8> {
        let mut bytes = [self.length.to_le_bytes(), self.durable.to_le_bytes()].concat();
        bytes.extend(self.announced.iter().flat_map(|announced| announced.to_bytes()));
        bytes
    }

    fn read(bytes: &[u8]) -> Option<Self> {
        let (length, rest) = bytes.split_first_chunk()?;
        let (durable, rest) = rest.split_first_chunk()?;
        let announced = if rest.is_empty() { None } else { Some(Announcement::read(rest)?) };
        Some(Self { length: u64::from_le_bytes(*length), durable: u64::from_le_bytes(*durable), announced })
    }
}

fn number(n: usize) -> u32 {
    u32::try_from(n).expect("slices and pieces are counted in thousands")
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

/// The range in `parts` (in order) that belongs to `node`.
fn within(parts: &[(Node, &[f32])], node: &Node) -> Range<usize> {
    let first = parts.partition_point(|(part, _)| part.start < node.start);
    first..parts.partition_point(|(part, _)| part.end <= node.end)
}

pub(super) fn expect(frame: Frame, kind: Kind, mesh: &Mesh, peer: usize) -> Result<Frame, Halt> {
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
