//! Peers that are silent, late or busy.

use super::*;

#[test]
fn a_slow_peer_is_waited_for_and_a_silent_one_is_named() {
    // The second member's threads answer for it while it is late; the third never sends a keep-alive.
    let quiet = Timing { keep_alive: Duration::from_secs(3600), ..QUICK };
    let mut gang = Gang::new(3, QUICK);
    let silent = Gang::new(1, quiet);
    {
        let gang = Arc::get_mut(&mut gang).expect("not shared yet");
        gang.seats[2].member = silent.seats[0].member.clone();
        gang.seats[2].member.worker = WorkerId::from("w2");
        gang.seats[2].endpoint = silent.seats[0].endpoint.clone();
    }
    let (first, _) = mesh(&gang, &[0, 1, 2], 0, "s");
    let (second, _) = mesh(&gang, &[0, 1, 2], 1, "s");
    let (third, _) = mesh(&gang, &[0, 1, 2], 2, "s");
    let late = thread::spawn(move || {
        thread::sleep(QUICK.patience * 2);
        second.send(0, "late", Head::new(Kind::Applied, 5, 1, 0), &[], &|| None).expect("sent");
        second
    });
    let frame = first.next(1, "barrier `test`", &|| None).expect("late, but alive");
    assert_eq!(frame.step, 5);
    assert!(first.next(2, "barrier `test`", &|| None).is_err());
    assert_eq!(first.lost(), [unreachable("w2")]);
    let second = late.join().expect("no panic");
    for mesh in [first, second, third] {
        mesh.close(None);
    }
}

/// Sampled: one or two of four members are stopped before each barrier. A stopped process keeps its connections and
/// sends nothing, like a member without keep-alives here.
#[test]
fn p18_each_barrier_has_a_name_and_a_time_and_lists_who_is_missing() {
    let quiet = Timing { keep_alive: Duration::from_secs(3600), ..QUICK };
    for (stopped, name) in
        [(vec![3], "rendezvous"), (vec![1, 3], "rendezvous"), (vec![2], "exchange"), (vec![1, 3], "exchange")]
    {
        let mut gang = Gang::new(4, QUICK);
        let silent = Gang::new(4, quiet);
        {
            let gang = Arc::get_mut(&mut gang).expect("not shared yet");
            for &i in &stopped {
                gang.seats[i].member = silent.seats[i].member.clone();
                gang.seats[i].endpoint = silent.seats[i].endpoint.clone();
            }
        }
        let meshes: Vec<_> = (0..4).map(|own| mesh(&gang, &[0, 1, 2, 3], own, "s").0).collect();
        let over = AtomicBool::new(false);
        let begun = Instant::now();
        thread::scope(|scope| {
            let members: Vec<_> = (0..4)
                .map(|own| {
                    let mesh = meshes[own].clone();
                    let stopped = &stopped;
                    let over = &over;
                    scope.spawn(move || {
                        let is_stopped = stopped.contains(&own);
                        let stop = || {
                            while !over.load(Ordering::SeqCst) {
                                thread::sleep(Duration::from_millis(5))
                            }
                        };
                        if is_stopped && name == "rendezvous" {
                            return stop();
                        }
                        let met = rendezvous::rendezvous(&mesh, Some(5), &[], &|| None);
                        if name == "exchange" {
                            met.expect("all are there");
                            if is_stopped {
                                return stop();
                            }
                            let numbers = [1.0f32; 10];
                            let parts = vec![(own..own + 1, &numbers[..])];
                            let contribution = exchange::Contribution {
                                step: 5,
                                slices: 4,
                                parts,
                                drain: false,
                                saves: false,
                                computed: Duration::ZERO,
                                durable: 0,
                            };
                            assert!(matches!(exchange::exchange(&mesh, &contribution, &|| None), Err(Halt::Peer)));
                        } else {
                            assert!(matches!(met, Err(Halt::Peer)));
                        }
                    })
                })
                .collect();
            // The first of the others waits the whole time, so it must know all missing members.
            for (own, member) in members.into_iter().enumerate().filter(|(own, _)| !stopped.contains(own)) {
                member.join().expect("no panic");
                let missing = meshes[own].missing();
                if own == 0 {
                    let names: Vec<String> = stopped.iter().map(|i| format!("w{i} (rank {i})")).collect();
                    let named: Vec<&str> = missing.iter().filter_map(|m| m.split(": ").next()).collect();
                    assert_eq!(named, names, "{missing:?}");
                    assert!(missing.iter().all(|m| m.contains(&format!("barrier `{name}`"))), "{missing:?}");
                    let step = if name == "exchange" { "of step 5" } else { "of generation 7" };
                    assert!(missing.iter().all(|m| m.contains(step) && m.contains("2 s")), "{missing:?}");
                    eprintln!("after {:.1?}: {}", begun.elapsed(), missing.join("; "));
                    assert!(begun.elapsed() < QUICK.patience * 4, "in bounded time");
                    over.store(true, Ordering::SeqCst);
                }
            }
        });
        for mesh in meshes {
            mesh.close(None);
        }
    }
}

/// A member that does not start is lost after the limit for that. One that saves is waited for without a limit.
#[test]
fn a_member_that_does_not_start_is_lost_and_one_that_saves_is_not() {
    let gang = Gang::new(3, Timing { start: Duration::from_millis(1500), ..QUICK });
    let meshes = [0, 1, 2].map(|own| mesh(&gang, &[0, 1, 2], own, "s").0);
    meshes[1].config.busy.set(Phase::Saving);
    meshes[2].config.busy.set(Phase::Starting);
    let begun = Instant::now();
    // Both send keep-alives all the time.
    let late = meshes[0].next(2, "barrier `rendezvous` of generation 7", &|| None);
    assert!(matches!(late, Err(Halt::Peer)), "{late:?}");
    assert!(begun.elapsed() < QUICK.patience * 2, "found after {:.1?}", begun.elapsed());
    let missing = meshes[0].missing();
    assert_eq!(missing.len(), 1, "{missing:?}");
    assert!(
        missing[0].starts_with("w2 (rank 2): barrier `rendezvous`") && missing[0].contains("has not started"),
        "{missing:?}"
    );
    let saver = thread::spawn({
        let saver = meshes[1].clone();
        move || {
            thread::sleep(Duration::from_secs(3));
            saver.send(0, "saved", Head::new(Kind::Applied, 5, 1, 0), &[], &|| None)
        }
    });
    assert_eq!(meshes[0].next(1, "barrier `rendezvous` of generation 7", &|| None).expect("waited for").step, 5);
    assert_eq!(saver.join().expect("no panic"), Ok(()));
    for mesh in meshes {
        mesh.close(None);
    }
}
