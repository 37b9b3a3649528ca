//! Agreement of all members on the newest state.
//!
//! Every member sends all others the number of updates of its state. A member that is behind the
//! largest number takes the state of the lowest rank that has it. Members differ by at most one step. A sum is complete
//! for no member before every member has sent its part. So a member with the whole sum is at most one step ahead of one
//! that lost a peer before that. If all states are freshly initialised, none is taken: they are equal.

use std::time::Instant;

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
            let begun = Instant::now();
            let mut sent = 0;
            for piece in state.iter().flat_map(|piece| piece.chunks(MAX_PAYLOAD)) {
                // All other members wait for this one.
                let elapsed = begun.elapsed();
                let limit = mesh.timing.start;
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
    let mut pieces = Vec::new();
    let mut there = 0;
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
