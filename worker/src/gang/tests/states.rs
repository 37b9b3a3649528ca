//! Transfers of states between members.

use std::thread;

use super::{Gang, Halt, Head, Kind, QUICK, mesh, rendezvous, wait_until};
use crate::gang::frame::MAX_PAYLOAD;
use crate::gang::mesh::STATE_FRAMES;
use crate::gang::rendezvous::{Line, Met};

const BARRIER: &str = "barrier `rendezvous` of generation 7";

/// The place of the only member behind.
const ONLY: Line = Line { source: 0, next: None, step: 5 };

fn bytes(length: usize) -> Vec<u8> {
    (0..length).map(|i| (i % 251) as u8).collect()
}

#[test]
fn a_state_arrives_where_it_belongs_however_it_is_cut() {
    let gang = Gang::new(2, QUICK);
    let [ahead, behind] = [0, 1].map(|own| mesh(&gang, &[0, 1], own, "s").0);
    let state = bytes(3 * MAX_PAYLOAD + 70);
    for (applied, cuts) in [(None, [8, MAX_PAYLOAD, 0]), (Some(4), [2 * MAX_PAYLOAD + 1, 3, 7])] {
        thread::scope(|scope| {
            scope.spawn(|| {
                let pieces = [&state[..8], &state[8..], b"rows behind it"];
                assert_eq!(rendezvous::rendezvous(&ahead, Some(5), &pieces, &|| None), Ok(Met::Keep));
            });
            assert_eq!(rendezvous::rendezvous(&behind, applied, &[], &|| None), Ok(Met::Behind(ONLY)));
            let mut room = vec![0; state.len()];
            let mut rest = room.as_mut_slice();
            let mut pieces = Vec::new();
            for cut in cuts {
                let (piece, later) = rest.split_at_mut(cut);
                pieces.push(piece);
                rest = later;
            }
            pieces.push(rest);
            let more = rendezvous::adopt(&behind, ONLY, &mut pieces, applied.is_none(), &|| None);
            assert_eq!(more, Ok(b"rows behind it".to_vec()));
            assert!(room == state);
        });
    }
    // A state of another length, as another build may send.
    thread::scope(|scope| {
        // The refusal may end the connection before the sender is done.
        scope.spawn(|| rendezvous::rendezvous(&ahead, Some(5), &[&state[..100]], &|| None).map(drop));
        assert_eq!(rendezvous::rendezvous(&behind, None, &[], &|| None), Ok(Met::Behind(ONLY)));
        let refused = rendezvous::adopt(&behind, ONLY, &mut [&mut [0; 101]], true, &|| None);
        assert!(matches!(&refused, Err(Halt::Disagree(why)) if why.contains("100 bytes; expected 101")), "{refused:?}");
    });
    [ahead, behind].into_iter().for_each(|mesh| mesh.close(None));
}

/// A member that came with a state of its own still has it after the sender is lost.
#[test]
fn a_state_that_is_cut_short_takes_the_place_of_none() {
    let gang = Gang::new(2, QUICK);
    let [ahead, behind] = [0, 1].map(|own| mesh(&gang, &[0, 1], own, "s").0);
    let length = Head::new(Kind::StateLength, 2 * MAX_PAYLOAD as u64, 0, 0);
    ahead.send(1, BARRIER, length, &[], &|| None).expect("sent");
    ahead.send(1, BARRIER, Head::new(Kind::State, 5, 0, 0), &bytes(MAX_PAYLOAD), &|| None).expect("sent");
    wait_until("the first half is there", || behind.queued(0) == 2);
    ahead.sever();
    let mut room = vec![9; 2 * MAX_PAYLOAD];
    assert_eq!(rendezvous::adopt(&behind, ONLY, &mut [&mut room], false, &|| None), Err(Halt::Peer));
    assert!(room.iter().all(|byte| *byte == 9));
    behind.close(None);
}

/// Unread frames of a state wait with their sender and not in memory here.
#[test]
fn a_state_is_queued_within_bounds() {
    let gang = Gang::new(2, QUICK);
    let [ahead, behind] = [0, 1].map(|own| mesh(&gang, &[0, 1], own, "s").0);
    let state = bytes(96 << 20);
    thread::scope(|scope| {
        let sending = scope.spawn(|| rendezvous::rendezvous(&ahead, Some(5), &[&state], &|| None));
        assert_eq!(rendezvous::rendezvous(&behind, None, &[], &|| None), Ok(Met::Behind(ONLY)));
        wait_until("as much as may be is queued", || behind.queued(0) == STATE_FRAMES);
        thread::sleep(QUICK.patience / 4);
        assert!(behind.queued(0) <= STATE_FRAMES + 1 && !sending.is_finished(), "{} frames are here", behind.queued(0));
        let mut room = vec![0; state.len()];
        assert_eq!(rendezvous::adopt(&behind, ONLY, &mut [&mut room], true, &|| None), Ok(Vec::new()));
        assert!(room == state);
        assert_eq!(sending.join().expect("no panic"), Ok(Met::Keep));
    });
    [ahead, behind].into_iter().for_each(|mesh| mesh.close(None));
}

/// A member forwards what has arrived before it has everything, and does not wait for a slow next one.
#[test]
fn a_state_passes_through_a_member_while_it_arrives() {
    let gang = Gang::new(3, QUICK);
    let [ahead, first, second] = [0, 1, 2].map(|own| mesh(&gang, &[0, 1, 2], own, "s").0);
    let state = bytes(96 << 20);
    let (half, rest) = state.split_at(48 << 20);
    let send = |part: &[u8]| {
        for piece in part.chunks(MAX_PAYLOAD) {
            ahead.send(1, BARRIER, Head::new(Kind::State, 5, 0, 0), piece, &|| None).expect("sent");
        }
    };
    thread::scope(|scope| {
        let adopting = scope.spawn(|| {
            let mut room = vec![0; state.len() - 4];
            let (head, tail) = room.split_at_mut(5);
            let line = Line { source: 0, next: Some(2), step: 5 };
            let more = rendezvous::adopt(&first, line, &mut [head, tail], true, &|| None);
            (more, room)
        });
        ahead.send(1, BARRIER, Head::new(Kind::StateLength, state.len() as u64, 0, 0), &[], &|| None).expect("sent");
        send(half);
        wait_until("the first half fills the queue of the last member", || second.queued(1) >= STATE_FRAMES);
        // The first has room for all of it, although the second reads nothing.
        send(rest);
        wait_until("the first has read all", || first.queued(0) == 0);
        let mut room = vec![0; state.len() - 4];
        let line = Line { source: 1, next: None, step: 5 };
        let more = rendezvous::adopt(&second, line, &mut [&mut room], true, &|| None);
        for (more, room) in [(more, room), adopting.join().expect("no panic")] {
            assert_eq!(more, Ok(state[state.len() - 4..].to_vec()));
            assert!(room == state[..state.len() - 4]);
        }
    });
    [ahead, first, second].into_iter().for_each(|mesh| mesh.close(None));
}

/// After the loss of the source or of the next member, no member waits.
#[test]
fn a_state_that_is_cut_short_in_a_line_ends_for_all() {
    for loses_the_source in [true, false] {
        let gang = Gang::new(3, QUICK);
        let [ahead, first, second] = [0, 1, 2].map(|own| mesh(&gang, &[0, 1, 2], own, "s").0);
        let state = bytes(8 * MAX_PAYLOAD);
        thread::scope(|scope| {
            let adopting = scope.spawn(|| {
                let mut room = vec![0; state.len()];
                let line = Line { source: 0, next: Some(2), step: 5 };
                let more = rendezvous::adopt(&first, line, &mut [&mut room], true, &|| None);
                (more, room)
            });
            ahead
                .send(1, BARRIER, Head::new(Kind::StateLength, state.len() as u64, 0, 0), &[], &|| None)
                .expect("sent");
            let mut pieces = state.chunks(MAX_PAYLOAD);
            let send = |piece| ahead.send(1, BARRIER, Head::new(Kind::State, 5, 0, 0), piece, &|| None).expect("sent");
            send(pieces.next().expect("eight"));
            wait_until("the last member has the first piece", || second.queued(1) == 2);
            if loses_the_source {
                ahead.sever();
                assert_eq!(adopting.join().expect("no panic").0, Err(Halt::Peer));
            } else {
                second.sever();
                pieces.for_each(send);
                assert_eq!(adopting.join().expect("no panic"), (Ok(Vec::new()), state.clone()));
            }
        });
        [ahead, first, second].into_iter().for_each(|mesh| mesh.close(None));
    }
}
