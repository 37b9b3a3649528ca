//! Links that are slow, late or cut in one direction, by a relay between the members.

use std::io::{Read, Write};
use std::net::{Shutdown, SocketAddr, TcpListener, TcpStream};
use std::sync::mpsc;

use super::*;
use crate::gang::exchange::{Contribution, Interrupt};
use crate::gang::frame::MAX_PAYLOAD;
use crate::gang::rendezvous::{Line, Met};

const BARRIER: &str = "barrier `test`";

/// Effect of a relay on the bytes of one direction.
#[derive(Debug, Default)]
struct Direction {
    bytes_per_second: AtomicU64,
    late_ms: AtomicU64,
    /// Accepts bytes but never delivers them.
    swallows: AtomicBool,
}

#[derive(Debug, Clone)]
struct Relay {
    address: SocketAddr,
    /// From the dialer to the dialled member.
    there: Arc<Direction>,
    back: Arc<Direction>,
    connections: Arc<AtomicU64>,
}

impl Relay {
    fn to(server: SocketAddr) -> Self {
        let listener = TcpListener::bind("127.0.0.1:0").expect("a free port");
        let address = listener.local_addr().expect("bound");
        let relay = Self { address, there: Arc::default(), back: Arc::default(), connections: Arc::default() };
        let Self { there, back, connections, .. } = relay.clone();
        thread::spawn(move || {
            for client in listener.incoming().flatten() {
                connections.fetch_add(1, Ordering::SeqCst);
                let Ok(server) = TcpStream::connect(server) else { continue };
                let twice = |stream: &TcpStream| stream.try_clone().expect("a socket twice");
                pass(twice(&client), twice(&server), there.clone());
                pass(server, client, back.clone());
            }
        });
        relay
    }

    fn slow_down(&self, bytes_per_second: u64, late_ms: u64) {
        for direction in [&self.there, &self.back] {
            direction.bytes_per_second.store(bytes_per_second, Ordering::SeqCst);
            direction.late_ms.store(late_ms, Ordering::SeqCst);
        }
    }
}

fn pass(mut from: TcpStream, mut to: TcpStream, direction: Arc<Direction>) {
    // Bounded, so that the sender is slowed down too.
    let (sender, receiver) = mpsc::sync_channel::<(Instant, Vec<u8>)>(64);
    let reading = direction.clone();
    thread::spawn(move || {
        let mut buffer = vec![0; 4096];
        while let Ok(n @ 1..) = from.read(&mut buffer) {
            if reading.swallows.load(Ordering::SeqCst) {
                continue;
            }
            let due = Instant::now() + Duration::from_millis(reading.late_ms.load(Ordering::SeqCst));
            if sender.send((due, buffer[..n].to_vec())).is_err() {
                return;
            }
        }
    });
    thread::spawn(move || {
        for (due, bytes) in receiver {
            thread::sleep(due.saturating_duration_since(Instant::now()));
            if to.write_all(&bytes).is_err() {
                return;
            }
            let rate = direction.bytes_per_second.load(Ordering::SeqCst);
            if rate > 0 {
                thread::sleep(Duration::from_secs_f64(bytes.len() as f64 / rate as f64));
            }
        }
        let _ = to.shutdown(Shutdown::Write);
    });
}

/// Two seats; the second reaches the first through a relay.
fn apart(timing: Timing) -> (Relay, Arc<Gang>) {
    let mut gang = Gang::new(2, timing);
    let relay = Relay::to(gang.seats[0].endpoint.address());
    Arc::get_mut(&mut gang).expect("not shared yet").seats[0].member.peer_address = relay.address.to_string();
    (relay, gang)
}

/// Two members that have met through a relay.
fn pair(timing: Timing) -> (Relay, [Arc<Mesh>; 2]) {
    let (relay, gang) = apart(timing);
    let meshes = met(&gang);
    (relay, meshes)
}

fn met(gang: &Gang) -> [Arc<Mesh>; 2] {
    let meshes = [0, 1].map(|own| mesh(gang, &[0, 1], own, "s").0);
    meshes.iter().for_each(|mesh| mesh.use_no_memory());
    thread::scope(|scope| {
        for mesh in &meshes {
            scope.spawn(|| assert_eq!(rendezvous::rendezvous(mesh, Some(5), &[], &|| None), Ok(Met::Keep)));
        }
    });
    // As a stage does once its members have met; no peer is named while one of them starts or saves.
    meshes.iter().for_each(|mesh| mesh.config.busy.set(Phase::Working));
    meshes
}

/// A joiner has asked its peer before. The second time, strangers have taken the place of that connection.
#[test]
fn a_handshake_follows_over_the_connection_of_the_probe() {
    for has_ended in [false, true] {
        let (relay, gang) = apart(QUICK);
        let [peer, joiner] = [0, 1].map(|seat| gang.seats[seat].endpoint.clone());
        joiner.probe(&relay.address.to_string()).expect("an answer");
        let strangers = if has_ended { Endpoint::STRANGERS } else { 0 };
        let _strangers: Vec<_> =
            (0..strangers).map(|_| TcpStream::connect(peer.address()).expect("listening")).collect();
        // Connections are accepted in their order.
        joiner.probe(&peer.address().to_string()).expect("an answer");
        let meshes = met(&gang);
        assert_eq!(relay.connections.load(Ordering::SeqCst), 1 + u64::from(has_ended));
        meshes.into_iter().for_each(|mesh| mesh.close(None));
    }
}

fn slow(worker: &str) -> LostPeer {
    LostPeer { worker: worker.into(), cause: LossCause::Slow }
}

/// Each frame takes longer than the time limit of a silent peer.
#[test]
fn p20_bytes_that_move_keep_a_link_of_30_kb_a_second_and_300_ms() {
    let (relay, [ahead, behind]) = pair(QUICK);
    relay.slow_down(30_000, 300);
    let begun = Instant::now();
    let state = vec![7u8; 3 * MAX_PAYLOAD];
    thread::scope(|scope| {
        scope.spawn(|| assert_eq!(rendezvous::rendezvous(&ahead, Some(6), &[&state], &|| None), Ok(Met::Keep)));
        let line = Line { source: 0, next: None, step: 6 };
        assert_eq!(rendezvous::rendezvous(&behind, Some(5), &[], &|| None), Ok(Met::Behind(line)));
        let mut room = vec![0; state.len()];
        assert_eq!(rendezvous::adopt(&behind, line, &mut [&mut room], true, &|| None), Ok(Vec::new()));
        assert!(room == state);
    });
    assert!(begun.elapsed() > QUICK.patience * 2, "it took {:.1?}", begun.elapsed());
    assert_eq!((ahead.lost(), behind.lost()), (vec![], vec![]));
    [ahead, behind].into_iter().for_each(|mesh| mesh.close(None));
}

#[test]
fn p20_a_cut_in_one_direction_is_noticed_by_both() {
    for is_there in [true, false] {
        let (relay, meshes) = pair(QUICK);
        let direction = if is_there { &relay.there } else { &relay.back };
        direction.swallows.store(true, Ordering::SeqCst);
        let begun = Instant::now();
        thread::scope(|scope| {
            for (mesh, peer) in meshes.iter().zip([1, 0]) {
                scope.spawn(move || assert_eq!(mesh.next(peer, BARRIER, &|| None), Err(Halt::Peer)));
            }
        });
        assert!(begun.elapsed() < QUICK.patience * 4, "after {:.1?}", begun.elapsed());
        assert_eq!([meshes[0].lost(), meshes[1].lost()], [[unreachable("w1")], [unreachable("w0")]]);
        meshes.into_iter().for_each(|mesh| mesh.close(None));
    }
}

/// A member reports its activity during a long send without pauses too.
#[test]
fn signs_of_life_go_out_between_the_frames_of_a_long_payload() {
    let gang = Gang::new(2, QUICK);
    let (mesh, _) = mesh(&gang, &[0, 1], 0, "s");
    let stream = TcpStream::connect(gang.seats[0].endpoint.address()).expect("listening");
    let handshake::Session { mut receives, .. } = dial(&stream, &task(), 7, 1, 0).expect("welcome");
    let over = AtomicBool::new(false);
    let mut large = 0;
    let mut signs = 0;
    let begun = Instant::now();
    thread::scope(|scope| {
        scope.spawn(|| {
            let payload = vec![0; MAX_PAYLOAD];
            while !over.load(Ordering::SeqCst) {
                let head = Head::new(Kind::State, 1, 0, 0);
                mesh.send(1, BARRIER, head, &payload, &|| over.load(Ordering::SeqCst).then_some(Halt::Regroup)).ok();
            }
        });
        let mut reader = &stream;
        while signs < 3 && large < 200_000 && begun.elapsed() < Duration::from_secs(20) {
            // A panic here would wait for the sending thread.
            let Ok(frame) = frame::read_sealed(&mut reader, MAX_PAYLOAD, &mut receives) else { break };
            match frame.kind {
                Kind::KeepAlive => signs += 1,
                _ => large += 1,
            }
        }
        over.store(true, Ordering::SeqCst);
        let _ = stream.shutdown(Shutdown::Both);
    });
    mesh.close(None);
    assert!(signs == 3, "{signs} signs of life among {large} frames");
}

fn step(mesh: &Mesh, step: u64, numbers: &[f32], interrupt: Interrupt<'_>) -> Result<Vec<f32>, Halt> {
    let own = mesh.config.rank;
    let parts = vec![(own..own + 1, numbers)];
    let computed = Duration::from_millis(20);
    let contribution = Contribution { step, slices: 2, parts, drain: false, saves: false, computed, durable: 0 };
    exchange::exchange(mesh, &contribution, interrupt).map(|total| total.sum)
}

/// Two reachable links on which a member alone would be faster: one has too little bandwidth, the other too much
/// latency.
#[test]
fn p20_a_link_that_costs_more_than_the_peer_brings_is_named_slow() {
    let timing = Timing { slow: Duration::from_secs(2), ..QUICK };
    for (rate, late_ms, length) in [(30_000, 0, 200_000), (0, 300, 1_000)] {
        let (relay, meshes) = pair(timing);
        relay.slow_down(rate, late_ms);
        let over = AtomicBool::new(false);
        let begun = Instant::now();
        thread::scope(|scope| {
            for mesh in &meshes {
                let over = &over;
                scope.spawn(move || {
                    let numbers = vec![1.0; length];
                    let interrupt = || over.load(Ordering::SeqCst).then_some(Halt::Regroup);
                    for at in 5.. {
                        if step(mesh, at, &numbers, &interrupt).is_err() {
                            return;
                        }
                    }
                });
            }
            let until = Instant::now() + Duration::from_secs(20);
            let lost = loop {
                let lost = [meshes[0].lost(), meshes[1].lost()];
                if lost == [[slow("w1")], [slow("w0")]] || Instant::now() > until {
                    break lost;
                }
                thread::sleep(Duration::from_millis(5));
            };
            // Before the assertion: the threads of the scope would never end after a panic.
            over.store(true, Ordering::SeqCst);
            assert_eq!(lost, [[slow("w1")], [slow("w0")]], "{rate} B/s and {late_ms} ms");
        });
        eprintln!("{rate} B/s and {late_ms} ms are named after {:.1?}", begun.elapsed());
        meshes.into_iter().for_each(|mesh| mesh.close(None));
    }
}

/// A line that is cut for a while, or a peer that is stopped: once it is back, its gang continues with it.
#[test]
fn a_link_that_is_silent_for_a_while_is_not_named_slow() {
    let timing = Timing { slow: Duration::from_secs(1), patience: Duration::from_secs(20), ..QUICK };
    let (relay, meshes) = pair(timing);
    let over = AtomicBool::new(false);
    let steps = [AtomicU64::new(0), AtomicU64::new(0)];
    thread::scope(|scope| {
        for (mesh, steps) in meshes.iter().zip(&steps) {
            let over = &over;
            scope.spawn(move || {
                let interrupt = || over.load(Ordering::SeqCst).then_some(Halt::Regroup);
                for at in 5.. {
                    if step(mesh, at, &[1.0; 1000], &interrupt).is_err() {
                        return;
                    }
                    steps.store(at, Ordering::SeqCst);
                }
            });
        }
        let moment = || thread::sleep(timing.keep_alive);
        moment();
        // Bytes of this moment arrive late, and all others after them.
        relay.slow_down(0, 3_000);
        moment();
        relay.slow_down(0, 0);
        let before = steps[0].load(Ordering::SeqCst);
        let begun = Instant::now();
        while steps[0].load(Ordering::SeqCst) < before + 100 && begun.elapsed() < timing.patience {
            thread::sleep(Duration::from_millis(5));
        }
        let silent = begun.elapsed();
        let lost = [meshes[0].lost(), meshes[1].lost()];
        over.store(true, Ordering::SeqCst);
        assert!(silent > timing.slow * 2, "silent for {silent:.1?}");
        assert_eq!(lost, [[], []]);
    });
    meshes.into_iter().for_each(|mesh| mesh.close(None));
}

/// Without a relay no peer is named, although the steps are short.
#[test]
fn a_good_link_is_not_named_slow() {
    let timing = Timing { slow: Duration::from_millis(500), ..QUICK };
    let (_relay, meshes) = pair(timing);
    thread::scope(|scope| {
        for mesh in &meshes {
            scope.spawn(move || {
                let begun = Instant::now();
                for at in 5.. {
                    step(mesh, at, &[1.0; 1000], &|| None).expect("summed");
                    // Both stop after the same step.
                    if at == 400 || begun.elapsed() > Duration::from_secs(60) {
                        return;
                    }
                }
            });
        }
    });
    assert_eq!([meshes[0].lost(), meshes[1].lost()], [[], []]);
    meshes.into_iter().for_each(|mesh| mesh.close(None));
}

/// A stage may train networks of different sizes in one generation, as an evaluator does.
#[test]
fn buffers_that_grow_and_shrink_pass_by_memory_too() {
    let gang = Gang::new(2, QUICK);
    let meshes = [0, 1].map(|own| mesh(&gang, &[0, 1], own, "s").0);
    let lengths = [10, 10, 10, 5, 5, 70_000, 70_000, 70_000, 10, 200, 100_001, 100_001, 100_001];
    thread::scope(|scope| {
        for mesh in &meshes {
            scope.spawn(move || {
                let mut shared = Vec::new();
                for (at, length) in (5..).zip(lengths) {
                    let own = mesh.config.rank as f32;
                    let numbers: Vec<f32> = (0..length).map(|i| i as f32 + own).collect();
                    let sum = step(mesh, at, &numbers, &|| None).expect("a sum");
                    assert!(sum.iter().enumerate().all(|(i, sum)| *sum == 2.0 * i as f32 + 1.0), "step {at}");
                    shared.push(mesh.memory(1 - mesh.config.rank).outgoing().is_some());
                }
                // The step that announces memory uses the connection.
                let expected = [5, 10, 15].map(|step| shared[step - 5]);
                assert_eq!(expected, [false; 3], "{shared:?}");
                assert_eq!(shared.iter().filter(|is_shared| **is_shared).count(), lengths.len() - 3, "{shared:?}");
            });
        }
    });
    meshes.into_iter().for_each(|mesh| mesh.close(None));
}
