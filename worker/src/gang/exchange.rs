//! The sum of all members' gradients.
//!
//! A reduce-scatter and an all-gather. A member's contiguous slices are a few nodes of the summation
//! tree. The buffer is cut into one chunk per member. Member m receives every node's partial sum of chunk m, follows
//! the tree to the root, and sends the result to all. No addition depends on the order of arrival. Partial sums are
//! computed in pieces during sending, so the buffer exists once per slice and once for the sum.
//!
//! Drain requests precede the parts. All members OR them over the same messages, so that all stop after the same step.

use std::ops::Range;
use std::time::Duration;

use bytemuck::cast_slice;
use protocol::message::LossCause;

use super::frame::{Frame, Head, Kind, PIECE, Payload};
use super::mesh::{Halt, Mesh};
use super::tree::{self, Node};

const DRAIN: u32 = 1;
const SAVED: u32 = 2;

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
    let own = mesh.config.rank;
    let size = mesh.size();
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
    let own = mesh.config.rank;
    let size = mesh.size();
    let length = sum.len();
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
