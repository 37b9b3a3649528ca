//! An eavesdropper between two members, who records the traffic.

use std::io::{Read as _, Write as _};
use std::net::{Shutdown, SocketAddr, TcpListener, TcpStream};

use super::*;

/// Forwards everything to `server` and records it. It has its own address, so that dialers see their connection leave
/// the machine.
fn recorder(server: SocketAddr, seen: &Arc<Mutex<Vec<u8>>>) -> SocketAddr {
    let listener = TcpListener::bind("127.0.0.2:0").expect("loopback");
    let address = listener.local_addr().expect("bound");
    let seen = seen.clone();
    thread::spawn(move || {
        for client in listener.incoming().flatten() {
            let Ok(server) = TcpStream::connect(server) else { continue };
            for (from, to) in [(&client, &server), (&server, &client)] {
                let from = from.try_clone();
                let to = to.try_clone();
                let seen = seen.clone();
                let mut from = from.expect("a socket twice");
                let mut to = to.expect("a socket twice");
                thread::spawn(move || {
                    let mut buffer = vec![0; 64 << 10];
                    while let Ok(n @ 1..) = from.read(&mut buffer) {
                        lock(&seen).extend_from_slice(&buffer[..n]);
                        if to.write_all(&buffer[..n]).is_err() {
                            break;
                        }
                    }
                    let _ = to.shutdown(Shutdown::Write);
                });
            }
        }
    });
    address
}

#[test]
fn what_leaves_the_machine_is_encrypted_and_changes_no_bits() {
    let plan = Plan { steps: 3, slices: 4, length: 20_000 };
    let seen = Arc::new(Mutex::new(Vec::new()));
    let mut gang = Arc::into_inner(Gang::new(2, Timing::default())).expect("not shared yet");
    gang.seats[0].member.peer_address = recorder(gang.seats[0].endpoint.address(), &seen).to_string();
    let gang = Arc::new(gang);
    gang.regroup(&[0, 1], false);
    let states: Vec<Vec<f32>> = thread::scope(|scope| {
        let start = |i: usize| {
            let gang = gang.clone();
            scope.spawn(move || train(&mut gang.context(i), plan, |_| {}).expect("trained"))
        };
        let threads: Vec<_> = (0..2).map(start).collect();
        threads.into_iter().map(|thread| thread.join().expect("no panic")).collect()
    });
    let expected = reference(plan.steps, plan.slices, plan.length);
    for state in &states {
        assert!(bits(state) == bits(&expected), "encryption changes no bits");
    }
    let seen = lock(&seen);
    assert!(seen.len() > plan.length * 4, "the exchange passed by: {} bytes", seen.len());
    // Sums of the first step in memory layout. A match of 16 bytes anywhere means that the traffic is readable.
    let sum = reference(1, plan.slices, plan.length);
    let bytes: &[u8] = bytemuck::cast_slice(&sum);
    for at in (0..bytes.len() - 16).step_by(bytes.len() / 50) {
        let sample = &bytes[at..at + 16];
        assert!(!seen.windows(16).any(|window| window == sample), "values at {at} are readable");
    }
}
