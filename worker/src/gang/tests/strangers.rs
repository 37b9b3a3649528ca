//! Peers that do not belong, or do not behave.

use std::io::Write as _;
use std::net::TcpStream;

use super::*;
use crate::gang::handshake;

#[test]
fn a_peer_with_another_secret_never_gets_in() {
    let gang = Gang::new(2, QUICK);
    let (first, _) = mesh(&gang, &[0, 1], 0, "mine");
    let (second, _) = mesh(&gang, &[0, 1], 1, "yours");
    assert!(first.next(1, "barrier `test`", &|| None).is_err());
    assert!(second.next(0, "barrier `test`", &|| None).is_err());
    assert_eq!(first.lost().len(), 1);
    first.close(None);
    second.close(None);
}

/// Connects as rank 1 with the right secret, then sends `bytes`.
fn misbehave(bytes: &[u8]) -> Arc<Mesh> {
    let gang = Gang::new(2, QUICK);
    let (mesh, _) = mesh(&gang, &[0, 1], 0, "s");
    let mut stream = TcpStream::connect(gang.seats[0].endpoint.address()).expect("listening");
    handshake::dial(&mut stream, &task(), Generation(7), 1, 0, "s").expect("welcome");
    stream.write_all(bytes).expect("sent");
    wait_until("the peer is given up", || !mesh.lost().is_empty());
    mesh
}

#[test]
fn a_corrupt_frame_ends_the_connection() {
    let mut bytes = Vec::new();
    frame::write(&mut bytes, Head::new(Kind::Applied, 3, 1, 0), b"payload").expect("memory");
    *bytes.last_mut().expect("not empty") ^= 1;
    misbehave(&bytes).close(None);
}

#[test]
fn an_oversized_frame_ends_the_connection_without_being_read() {
    let mut bytes = frame::header(Head::new(Kind::State, 0, 0, 0), &[]).to_vec();
    bytes[24..28].copy_from_slice(&(frame::MAX_PAYLOAD as u32 + 1).to_le_bytes());
    misbehave(&bytes).close(None);
}

/// Dials the first of two members of generation 7.
fn dial(gang: &Gang, of: &TaskId, generation: u64, from: usize, to: usize) -> Result<(), handshake::HandshakeError> {
    let mut stream = TcpStream::connect(gang.seats[0].endpoint.address()).expect("listening");
    handshake::dial(&mut stream, of, Generation(generation), from, to, "s")
}

/// With the right secret, so that nothing but the check in question stands between it and the gang.
#[test]
fn a_peer_of_another_generation_task_or_rank_never_gets_in() {
    let gang = Gang::new(2, QUICK);
    let (mesh, _) = mesh(&gang, &[0, 1], 0, "s");
    for generation in [6, 8] {
        assert!(dial(&gang, &task(), generation, 1, 0).is_err(), "of generation {generation}");
    }
    assert!(dial(&gang, &TaskId::from("run/other"), 7, 1, 0).is_err(), "of another task");
    for (from, to) in [(0, 0), (1, 1), (2, 0), (2, 1)] {
        assert!(dial(&gang, &task(), 7, from, to).is_err(), "from {from} to {to}");
    }
    assert!(mesh.lost().is_empty(), "strangers end nothing");
    dial(&gang, &task(), 7, 1, 0).expect("the right one is welcome");
    mesh.close(None);
}

#[test]
fn members_at_different_steps_or_with_other_slices_add_nothing_up() {
    for (step, slices) in [(6, 2), (5, 4)] {
        let gang = Gang::new(2, QUICK);
        let meshes = [0, 1].map(|own| mesh(&gang, &[0, 1], own, "s").0);
        let sums: Vec<_> = thread::scope(|scope| {
            let threads: Vec<_> = [(5, 2), (step, slices)]
                .into_iter()
                .zip(&meshes)
                .map(|((step, slices), mesh)| {
                    scope.spawn(move || {
                        let numbers = [1.0f32; 10];
                        let own = tree::share(slices, mesh.config.rank, 2);
                        let parts = own.map(|slice| (slice..slice + 1, &numbers[..])).collect();
                        let contribution = exchange::Contribution { step, slices, parts, drain: false, durable: 0 };
                        exchange::exchange(mesh, &contribution, &|| None)
                    })
                })
                .collect();
            threads.into_iter().map(|thread| thread.join().expect("no panic")).collect()
        });
        for sum in sums {
            // At the greeting, before anything is added.
            assert!(matches!(&sum, Err(Halt::Disagree(why)) if why.contains("is at step")), "{sum:?}");
        }
        for mesh in meshes {
            mesh.close(None);
        }
    }
}
