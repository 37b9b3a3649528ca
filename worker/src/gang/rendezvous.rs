//! Agreement of all members on the newest state.
//!
//! Every member sends all others the number of updates of its state. Members behind the largest number take the state
//! of one that has it. Members differ by at most one exchange. A sum is complete for no member before every member has
//! sent its part. So a member with the whole sum is at most one exchange ahead of one that lost a peer before that. If all
//! states are freshly initialised, none is taken: they are equal.
//!
//! A state goes along lines of members: each that receives it forwards what has arrived to the next one. So every member
//! sends it once at most, and many joiners need little more time than one. A slow member delays those after it, and not
//! those before it.

use std::borrow::Cow;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc;
use std::time::{Duration, Instant};

use protocol::message::LossCause;

use super::exchange::{Interrupt, disagree, expect};
use super::frame::{Head, Kind, MAX_PAYLOAD, Payload};
use super::mesh::{Halt, Mesh};

/// Limit of the data that follows a state, namely recorded values that may not be stored yet; larger data is refused.
const MAX_BEHIND_STATE: u64 = 256 << 20;

/// Result of a rendezvous for this member.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Met {
    Keep,
    Behind(Line),
}

/// Place of a member behind in the line along which it gets the newest state.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Line {
    /// The rank that sends the state to this member.
    pub(crate) source: usize,
    /// The rank to which this member forwards it.
    pub(crate) next: Option<usize>,
    /// Steps of the state.
    pub(crate) step: u64,
}

/// The newest of the states `at` of all ranks, the rank that sends it to `own`, and the rank that `own` sends it to. `None`
/// if no member has a state. Lines are of equal length, each behind another of the members that are ahead.
fn line(at: &[Option<u64>], own: usize) -> Option<(u64, Option<usize>, Option<usize>)> {
    let newest = at.iter().flatten().max().copied()?;
    let (mut order, behind): (Vec<usize>, Vec<usize>) = (0..at.len()).partition(|&rank| at[rank] == Some(newest));
    let lines = order.len();
    order.extend(behind);
    let place = order.iter().position(|&rank| rank == own).expect("every rank is in the order");
    let source = place.checked_sub(lines).map(|before| order[before]);
    Some((newest, source, order.get(place + lines).copied()))
}

/// Finds the newest state among the members. A member that is ahead sends its own to the next of its line; others learn
/// their place in a line.
pub(crate) fn rendezvous(
    mesh: &Mesh,
    applied: Option<u64>,
    state: &[&[u8]],
    interrupt: Interrupt<'_>,
) -> Result<Met, Halt> {
    let barrier = rendezvous_barrier(mesh);
    let own = mesh.config.rank;
    let head = Head::new(Kind::Applied, applied.unwrap_or(0), u32::from(applied.is_some()), 0);
    for peer in mesh.others_connected_first() {
        mesh.send(peer, &barrier, head, &[], interrupt)?;
    }
    let mut at = vec![None; mesh.size()];
    at[own] = applied;
    for peer in mesh.others() {
        let frame = expect(mesh.next(peer, &barrier, interrupt)?, Kind::Applied, mesh, peer)?;
        at[peer] = (frame.a == 1).then_some(frame.step);
    }
    let Some((step, source, next)) = line(&at, own) else { return Ok(Met::Keep) };
    if let Some(source) = source {
        return Ok(Met::Behind(Line { source, next, step }));
    }
    if let Some(next) = next {
        let bytes: usize = state.iter().map(|piece| piece.len()).sum();
        tracing::info!(step, bytes, to = next, "sending the state to a member behind");
        send_state(mesh, next, step, bytes as u64, state.iter(), interrupt)?;
    }
    Ok(Met::Keep)
}

/// Sends the `bytes` of a state to `peer` as they come.
fn send_state(
    mesh: &Mesh,
    peer: usize,
    step: u64,
    bytes: u64,
    pieces: impl Iterator<Item: AsRef<[u8]>>,
    interrupt: Interrupt<'_>,
) -> Result<(), Halt> {
    let barrier = rendezvous_barrier(mesh);
    mesh.send(peer, &barrier, Head::new(Kind::StateLength, bytes, 0, 0), &[], interrupt)?;
    // The time that this peer takes, without waiting for pieces.
    let mut taken = Duration::ZERO;
    let mut sent = 0;
    for pieces in pieces {
        for piece in pieces.as_ref().chunks(MAX_PAYLOAD) {
            // All other members wait for it.
            let limit = mesh.timing.start;
            let is_slow = taken > mesh.timing.slow && taken.mul_f64(bytes as f64 / sent.max(1) as f64) > limit / 5;
            if taken > limit || is_slow {
                let taken = taken.as_secs_f32();
                let reason = format!("{barrier}: it received {sent} of {bytes} bytes of the state in {taken:.0} s");
                mesh.lose(peer, LossCause::Slow, reason);
                return Err(Halt::Peer);
            }
            let begun = Instant::now();
            mesh.send(peer, &barrier, Head::new(Kind::State, step, 0, 0), piece, interrupt)?;
            taken += begun.elapsed();
            sent += piece.len();
        }
    }
    Ok(())
}

/// Receives the newest state into `room`, and forwards it along the line. Returns the data that follows the state.
///
/// With `directly`, the bytes arrive in `room` itself, which is left unusable by an interrupted transfer. Otherwise all
/// bytes are received first.
pub(crate) fn adopt(
    mesh: &Mesh,
    line: Line,
    room: &mut [&mut [u8]],
    directly: bool,
    interrupt: Interrupt<'_>,
) -> Result<Vec<u8>, Halt> {
    let Line { source, next, step } = line;
    let barrier = rendezvous_barrier(mesh);
    let length = expect(mesh.next(source, &barrier, interrupt)?, Kind::StateLength, mesh, source)?.step;
    let wanted: u64 = room.iter().map(|piece| piece.len() as u64).sum();
    if length < wanted || length - wanted > MAX_BEHIND_STATE {
        let what = format!("offers a state of {length} bytes; expected {wanted} and at most {MAX_BEHIND_STATE} more");
        return Err(disagree(mesh, &barrier, source, &what));
    }
    let receive = |take: &mut dyn FnMut(Vec<u8>)| {
        let mut there = 0;
        while there < length {
            let frame = expect(mesh.next(source, &barrier, interrupt)?, Kind::State, mesh, source)?;
            there += frame.bytes().len() as u64;
            let Payload::Bytes(piece) = frame.payload else { unreachable!("a state's frames carry bytes") };
            if piece.is_empty() || there > length {
                let what = format!("sends pieces that do not add up to its state of {length} bytes");
                return Err(disagree(mesh, &barrier, source, &what));
            }
            take(piece);
        }
        Ok(())
    };
    let mut room = Room::new(room);
    if !directly {
        // Assembling a large state would need its memory a second time.
        let mut pieces = Vec::new();
        receive(&mut |piece| pieces.push(piece))?;
        pieces.iter().for_each(|piece| room.fill(piece, &mut |_| {}));
        if let Some(next) = next {
            // As below.
            let _ = send_state(mesh, next, step, length, pieces.iter(), interrupt);
        }
        return Ok(room.behind);
    }
    let (arrived, arrivals) = mpsc::channel::<Cow<'_, [u8]>>();
    let is_broken = AtomicBool::new(false);
    std::thread::scope(|scope| {
        let mut arrived = next.map(|next| {
            let is_broken = &is_broken;
            scope.spawn(move || {
                // Ends between two frames: a part of one would spoil the connection to a member that stays.
                let pieces = arrivals.into_iter().take_while(|_| !is_broken.load(Ordering::SeqCst));
                // The mesh knows the loss of the next member, and this one's state is whole without it.
                let _ = send_state(mesh, next, step, length, pieces, interrupt);
            });
            arrived
        });
        let received = receive(&mut |piece| {
            room.fill(&piece, &mut |filled| {
                // It fails once the next member is lost.
                let _ = arrived.as_ref().map(|arrived| arrived.send(Cow::Borrowed(filled)));
            });
        });
        is_broken.store(received.is_err(), Ordering::SeqCst);
        // The data behind the state is whole only now.
        if let Some(arrived) = arrived.take().filter(|_| received.is_ok()) {
            let _ = arrived.send(Cow::Owned(room.behind.clone()));
        }
        received.map(|()| room.behind)
    })
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

    /// Fills the next bytes, and passes on what is filled.
    fn fill(&mut self, mut bytes: &[u8], filled: &mut dyn FnMut(&'a [u8])) {
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
            filled(into);
            (self.now, bytes) = (later, &bytes[fits..]);
        }
    }
}

fn rendezvous_barrier(mesh: &Mesh) -> String {
    format!("barrier `rendezvous` of generation {}", mesh.config.generation)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// For each rank the one that sends it the state, and the one it sends it to.
    fn lines(at: &[Option<u64>]) -> Vec<(Option<usize>, Option<usize>)> {
        (0..at.len())
            .map(|own| line(at, own).map(|(_, source, next)| (source, next)).expect("there is a state"))
            .collect()
    }

    #[test]
    fn every_member_sends_the_state_once_at_most() {
        assert_eq!(line(&[None, None], 1), None);
        assert_eq!(lines(&[Some(5), Some(5)]), [(None, None), (None, None)]);
        // One member has the state, three form a line behind it.
        let one = [None, Some(5), Some(4), None];
        assert_eq!(line(&one, 0), Some((5, Some(1), Some(2))));
        assert_eq!(lines(&one), [(Some(1), Some(2)), (None, Some(0)), (Some(0), Some(3)), (Some(2), None)]);
        // Two members have it: two lines.
        let two = [None, Some(5), None, Some(5), None];
        let expected = [(Some(1), Some(4)), (None, Some(0)), (Some(3), None), (None, Some(2)), (Some(0), None)];
        assert_eq!(lines(&two), expected);
    }
}
