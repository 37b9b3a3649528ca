//! Connections that continue in the next generation.

use std::net::SocketAddr;

use super::*;

/// Lets the stages of these seats meet in their newest generation.
fn meet(contexts: &mut [HttpContext], seats: &[usize]) {
    thread::scope(|scope| {
        let chosen = contexts.iter_mut().enumerate().filter(|(i, _)| seats.contains(i));
        for (_, context) in chosen {
            scope.spawn(|| assert!(matches!(context.rendezvous(Some(3), &[]), Ok(Rendezvous::Keep))));
        }
    });
}

/// Both ends of a seat's connection to a rank.
fn ends(gang: &Gang, seat: usize, rank: usize) -> [SocketAddr; 2] {
    let mesh = gang.held(seat).expect("a member").newest_mesh().expect("a mesh");
    let link = lock(&mesh.peers)[rank].link.clone().expect("a connection");
    [link.socket.local_addr().expect("open"), link.socket.peer_addr().expect("open")]
}

fn no_losses(gang: &Gang, seats: &[usize]) {
    for seat in seats {
        assert_eq!(gang.held(*seat).expect("a member").doing().lost, [], "of w{seat}");
    }
}

#[test]
fn members_of_two_generations_keep_their_connection_and_others_do_not() {
    let gang = Gang::new(3, QUICK);
    gang.regroup(&[0, 1, 2], false);
    let mut contexts: Vec<HttpContext> = (0..3).map(|i| gang.context(i)).collect();
    meet(&mut contexts, &[0, 1, 2]);
    let before = ends(&gang, 2, 1);
    // Ranks change too: the former rank 2 is rank 1, then rank 0.
    for seats in [[1, 2], [2, 1]] {
        gang.regroup(&seats, false);
        meet(&mut contexts, &seats);
        let other = usize::from(seats[0] == 2);
        assert_eq!(ends(&gang, 2, other), before, "{seats:?}");
        no_losses(&gang, &seats);
    }
    // The removed member has to connect anew.
    gang.regroup(&[2, 1, 0], false);
    contexts[0] = gang.context(0);
    meet(&mut contexts, &[0, 1, 2]);
    assert_eq!(ends(&gang, 2, 1), before);
    thread::scope(|scope| {
        let sums: Vec<_> = contexts
            .iter_mut()
            .map(|context| {
                scope.spawn(|| {
                    let mut parts: Vec<_> = context.share(3).map(|slice| (slice..slice + 1, vec![1.0; 10])).collect();
                    context.exchange(3..4, 3, &mut parts).expect("summed")
                })
            })
            .collect();
        for sum in sums {
            assert!(matches!(sum.join().expect("no panic"), Exchange::Sum { sum, .. } if sum == [3.0; 10]));
        }
    });
    no_losses(&gang, &[0, 1, 2]);
}

/// A member that polls late may never learn of a generation in which the other one waits for it. The other one learns of
/// the next generation after it, or before it and so continues a connection that the late one does not.
#[test]
fn a_member_whose_orders_skip_a_generation_meets_by_a_new_connection() {
    for (late, is_first) in [(0, true), (1, true), (0, false), (1, false)] {
        let gang = Gang::new(2, QUICK);
        gang.regroup(&[0, 1], false);
        let mut contexts: Vec<HttpContext> = (0..2).map(|i| gang.context(i)).collect();
        meet(&mut contexts, &[0, 1]);
        let before = ends(&gang, 0, 1);
        let early = 1 - late;
        let waits = || gang.held(early).expect("a member").doing().waits_for.is_some();
        let begun = Instant::now();
        gang.order(early, 2, &[0, 1], false);
        thread::scope(|scope| {
            let (first, second) = contexts.split_at_mut(1);
            let (early_stage, late_stage) =
                if early == 0 { (&mut first[0], &mut second[0]) } else { (&mut second[0], &mut first[0]) };
            let meets = |context: &mut HttpContext| {
                assert!(matches!(context.rendezvous(Some(3), &[]), Ok(Rendezvous::Keep)));
            };
            scope.spawn(move || meets(early_stage));
            wait_until("it waits in the generation that the other skips", waits);
            for seat in if is_first { [late, early] } else { [early, late] } {
                gang.order(seat, 3, &[0, 1], false);
                thread::sleep(Duration::from_millis(100));
            }
            scope.spawn(move || meets(late_stage));
        });
        assert!(begun.elapsed() < QUICK.patience, "met after {:.1?}", begun.elapsed());
        assert_ne!(ends(&gang, 0, 1), before);
        no_losses(&gang, &[0, 1]);
    }
}
