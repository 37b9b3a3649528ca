//! Peers that do not belong to the gang, or misbehave.

use std::io::Write as _;
use std::net::SocketAddr;

use super::*;
use crate::gang::handshake::Session;
use crate::gang::seal::Seal;

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

/// Connects as rank 1 with the right secret, then sends the result of `bytes`.
fn misbehave(bytes: impl FnOnce(&mut Seal) -> Vec<u8>) -> Arc<Mesh> {
    let gang = Gang::new(2, QUICK);
    let (mesh, _) = mesh(&gang, &[0, 1], 0, "s");
    let mut stream = TcpStream::connect(gang.seats[0].endpoint.address()).expect("listening");
    let Session { mut sends, .. } = dial(&stream, &task(), 7, 1, 0).expect("welcome");
    stream.write_all(&bytes(&mut sends)).expect("sent");
    wait_until("the peer is given up", || !mesh.lost().is_empty());
    mesh
}

fn frame_under(seal: &mut Seal) -> Vec<u8> {
    let mut bytes = Vec::new();
    frame::write_sealed(&mut bytes, Head::new(Kind::Applied, 3, 1, 0), b"payload", seal).expect("memory");
    bytes
}

#[test]
fn a_changed_frame_ends_the_connection() {
    let mesh = misbehave(|seal| {
        let mut bytes = frame_under(seal);
        *bytes.last_mut().expect("not empty") ^= 1;
        bytes
    });
    assert!(mesh.missing()[0].contains("tag"), "{:?}", mesh.missing());
    mesh.close(None);
}

/// Attacks on the path without the key: a forged frame, and a replayed one.
#[test]
fn a_frame_that_the_peer_did_not_send_there_ends_the_connection() {
    let forged = misbehave(|_| frame_under(&mut Seal::tagged([0; 32])));
    assert!(forged.missing()[0].contains("frame 0"), "{:?}", forged.missing());
    let repeated = misbehave(|seal| frame_under(seal).repeat(2));
    assert!(repeated.missing()[0].contains("frame 1"), "{:?}", repeated.missing());
    for mesh in [forged, repeated] {
        mesh.close(None);
    }
}

#[test]
fn an_oversized_frame_ends_the_connection_without_being_read() {
    misbehave(|seal| {
        let mut bytes = frame::sealed(Head::new(Kind::State, 0, 0, 0), &[], seal).0.to_vec();
        bytes[24..28].copy_from_slice(&(frame::MAX_PAYLOAD as u32 + 1).to_le_bytes());
        bytes
    })
    .close(None);
}

/// Sampled: half as many strangers again as there is room for. They send a byte now and then and reconnect when they
/// are dropped.
#[test]
fn slow_strangers_keep_no_peer_out() {
    let gang = Gang::new(2, QUICK);
    let address = gang.seats[0].endpoint.address();
    let over = AtomicBool::new(false);
    let crowd = std::sync::Barrier::new(Endpoint::STRANGERS * 3 / 2 + 1);
    let stranger = |address: SocketAddr, over: &AtomicBool| {
        let mut stream = TcpStream::connect(address).expect("listening");
        crowd.wait();
        while !over.load(Ordering::SeqCst) {
            if stream.write_all(b"S").is_err() {
                stream = TcpStream::connect(address).expect("listening");
            }
            thread::sleep(Duration::from_millis(100));
        }
    };
    thread::scope(|scope| {
        for _ in 0..Endpoint::STRANGERS * 3 / 2 {
            scope.spawn(|| stranger(address, &over));
        }
        crowd.wait();
        let begun = Instant::now();
        let meshes = [0, 1].map(|own| mesh(&gang, &[0, 1], own, "s").0);
        let [first, second] = &meshes;
        let met: Vec<_> = thread::scope(|scope| {
            let meet = |mesh: &Arc<Mesh>| {
                let mesh = mesh.clone();
                scope.spawn(move || rendezvous::rendezvous(&mesh, None, &[], &|| None).map(drop))
            };
            [meet(first), meet(second)].map(|met| met.join().expect("no panic")).to_vec()
        });
        let took = begun.elapsed();
        over.store(true, Ordering::SeqCst);
        assert_eq!(met, [Ok(()), Ok(())]);
        eprintln!("met among {} strangers after {took:.1?}", Endpoint::STRANGERS * 3 / 2);
        assert!(took < Duration::from_secs(2), "strangers held it up for {took:.1?}");
        for mesh in meshes {
            mesh.close(None);
        }
    });
}

/// Uses the right secret, so that only the tested check can refuse it.
#[test]
fn a_peer_of_another_generation_task_or_rank_never_gets_in() {
    let gang = Gang::new(2, QUICK);
    let (mesh, _) = mesh(&gang, &[0, 1], 0, "s");
    let dial = |of: &TaskId, generation, from, to| {
        let stream = TcpStream::connect(gang.seats[0].endpoint.address()).expect("listening");
        dial(&stream, of, generation, from, to)
    };
    for generation in [6, 8] {
        assert!(dial(&task(), generation, 1, 0).is_err(), "of generation {generation}");
    }
    assert!(dial(&TaskId::from("run/other"), 7, 1, 0).is_err(), "of another task");
    for (from, to) in [(0, 0), (1, 1), (2, 0), (2, 1)] {
        assert!(dial(&task(), 7, from, to).is_err(), "from {from} to {to}");
    }
    assert!(mesh.lost().is_empty(), "strangers end nothing");
    dial(&task(), 7, 1, 0).expect("the right one is welcome");
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
                        let contribution = exchange::Contribution {
                            step,
                            slices,
                            parts,
                            drain: false,
                            saves: false,
                            computed: Duration::ZERO,
                            durable: 0,
                        };
                        exchange::exchange(mesh, &contribution, &|| None)
                    })
                })
                .collect();
            threads.into_iter().map(|thread| thread.join().expect("no panic")).collect()
        });
        // At the first frame, before anything is added. A member whose peer finds out first may lose it before that frame.
        let disagrees = |sum: &_| matches!(sum, Err(Halt::Disagree(why)) if why.contains("is at step"));
        assert!(sums.iter().all(|sum| disagrees(sum) || matches!(sum, Err(Halt::Peer))), "{sums:?}");
        assert!(sums.iter().any(disagrees), "{sums:?}");
        for mesh in meshes {
            mesh.close(None);
        }
    }
}
