//! Gangs of threads over loopback, with a minimal coordinator that handles losses as the real one does.

mod eavesdropper;
mod handover;
mod relay;
mod silence;
mod states;
mod strangers;
mod welcome;

use std::collections::BTreeMap;
use std::net::TcpStream;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::{Arc, Mutex};
use std::thread;
use std::time::{Duration, Instant};

use proptest::prelude::*;
use protocol::message::{LossCause, LostPeer, Member};
use protocol::{Generation, Incarnation, TaskId, WorkerId};
use stages::context::{Adopted, AttemptContext as _, ContextError, Exchange, GangContext, Rendezvous};
use tokio::runtime::Runtime;

use super::endpoint::Endpoint;
use super::frame::{self, Head, Kind};
use super::member::{Busy, MeshConfig, Phase, Timing};
use super::mesh::{Halt, Mesh};
use super::tree;
use super::{exchange, handshake, rendezvous};
use crate::active_assignment::ActiveAssignment;
use crate::context::HttpContext;
use crate::event_count::{EventCount, lock};
use crate::testing::{self, assignment, task};

/// Short limits, so that silent peers are found within a test.
const QUICK: Timing = Timing {
    patience: Duration::from_secs(2),
    keep_alive: Duration::from_millis(200),
    stall: Duration::from_secs(60),
    start: Duration::from_secs(60),
    slow: Duration::from_secs(60),
    refused: Duration::from_millis(500),
};

/// One worker with its address, and its assignment once it is a member.
#[derive(Debug)]
struct Seat {
    member: Member,
    endpoint: Arc<Endpoint>,
    held: Mutex<Option<Arc<ActiveAssignment>>>,
    dead: AtomicBool,
}

#[derive(Debug)]
struct Gang {
    seats: Vec<Seat>,
    generation: AtomicU64,
    runtime: Runtime,
}

impl Gang {
    fn new(seats: usize, timing: Timing) -> Arc<Self> {
        let seat = |i: usize| {
            let endpoint = Endpoint::open(([127, 0, 0, 1], 0).into(), timing).expect("loopback");
            let member = Member {
                worker: WorkerId::new(format!("w{i}")),
                incarnation: Incarnation(1),
                peer_address: endpoint.address().to_string(),
            };
            Seat { member, endpoint, held: Mutex::default(), dead: AtomicBool::new(false) }
        };
        let runtime = tokio::runtime::Builder::new_multi_thread().worker_threads(1).enable_all().build();
        let runtime = runtime.expect("a runtime");
        Arc::new(Self { seats: (0..seats).map(seat).collect(), generation: AtomicU64::new(0), runtime })
    }

    /// Starts a generation with these seats and ends the assignments of other members.
    fn regroup(&self, seats: &[usize], drain: bool) {
        let generation = self.generation.fetch_add(1, Ordering::SeqCst) + 1;
        for i in 0..self.seats.len() {
            if seats.contains(&i) {
                self.order(i, generation, seats, drain);
            } else if let Some(held) = lock(&self.seats[i].held).take() {
                held.end("dropped from the gang");
            }
        }
    }

    /// Tells one seat of a generation.
    fn order(&self, i: usize, generation: u64, seats: &[usize], drain: bool) {
        let members: Vec<Member> = seats.iter().map(|&i| self.seats[i].member.clone()).collect();
        let seat = &self.seats[i];
        let mut desired = assignment(&seat.member.worker, generation, &members, &format!("secret {generation}"));
        desired.drain = drain;
        let mut held = lock(&seat.held);
        match &*held {
            Some(held) => held.update(desired),
            None => *held = Some(ActiveAssignment::new(desired, seat.endpoint.clone(), Arc::default(), Arc::default())),
        }
    }

    fn held(&self, seat: usize) -> Option<Arc<ActiveAssignment>> {
        lock(&self.seats[seat].held).clone()
    }

    fn context(&self, seat: usize) -> HttpContext {
        testing::context(self.held(seat).expect("a member"), self.runtime.handle().clone())
    }

    /// Acts as the coordinator: drops members that another one cannot reach, and takes back suspects that are alive.
    fn supervise(self: Arc<Self>, mut members: Vec<usize>, over: &AtomicBool) {
        while !over.load(Ordering::SeqCst) {
            let mut lost: Vec<WorkerId> = Vec::new();
            for &i in &members {
                if let (false, Some(held)) = (self.seats[i].dead.load(Ordering::SeqCst), self.held(i)) {
                    lost.extend(held.doing().lost.into_iter().map(|peer| peer.worker));
                }
            }
            let before = members.clone();
            members.retain(|&i| !lost.contains(&self.seats[i].member.worker));
            if members != before {
                if members.is_empty() {
                    return;
                }
                self.regroup(&members, false);
            }
            thread::sleep(Duration::from_millis(2));
        }
    }
}

/// A pseudorandom gradient of a step and a slice.
fn gradient(step: u64, slice: usize, length: usize) -> Vec<f32> {
    let mut x = step.wrapping_mul(0x9E37_79B9_7F4A_7C15) ^ (slice as u64 + 1).wrapping_mul(0xD1B5_4A32_D192_ED03);
    (0..length)
        .map(|_| {
            x ^= x << 13;
            x ^= x >> 7;
            x ^= x << 17;
            (x >> 40) as f32 / 1e4 - 800.0
        })
        .collect()
}

/// The result of a single member.
fn reference(steps: u64, slices: usize, length: usize) -> Vec<f32> {
    let mut state = vec![0.0f32; length];
    for step in 0..steps {
        let parts: Vec<Vec<f32>> = (0..slices).map(|s| gradient(step, s, length)).collect();
        let known: Vec<_> = parts.iter().enumerate().map(|(s, p)| (s..s + 1, p.as_slice())).collect();
        let mut sum = vec![0.0; length];
        tree::sum(&(0..slices), &known, &mut sum);
        apply(&mut state, &sum);
    }
    state
}

fn apply(state: &mut [f32], sum: &[f32]) {
    for (s, g) in state.iter_mut().zip(sum) {
        *s = *s * 0.99 + *g;
    }
}

#[derive(Debug, Clone, Copy)]
struct Plan {
    steps: u64,
    slices: usize,
    length: usize,
}

/// The training loop, as `stages` has it.
fn train(context: &mut HttpContext, plan: Plan, mut before: impl FnMut(u64)) -> Result<Vec<f32>, ContextError> {
    let mut state = vec![0.0f32; plan.length];
    let mut applied = None;
    let mut parts: BTreeMap<usize, Vec<f32>> = BTreeMap::new();
    let mut met = false;
    while applied.unwrap_or(0) < plan.steps {
        if !met {
            let mut at = applied.unwrap_or(0).to_le_bytes();
            met = context.rendezvous(applied, &[&at, bytemuck::cast_slice(&state)])? == Rendezvous::Keep;
            if !met && context.adopt(&mut [&mut at, bytemuck::cast_slice_mut(&mut state)])? == Adopted::Whole {
                applied = Some(u64::from_le_bytes(at));
                parts.clear();
                met = true;
            } else if applied.is_none() {
                // Discard the state of an interrupted transfer.
                state.fill(0.0);
            }
            continue;
        }
        let step = applied.unwrap_or(0);
        before(step);
        let share = context.share(plan.slices);
        parts.retain(|slice, _| share.contains(slice));
        for slice in share {
            parts.entry(slice).or_insert_with(|| gradient(step, slice, plan.length));
        }
        let mut brought: Vec<_> = parts.iter().map(|(s, p)| (*s..*s + 1, p.clone())).collect();
        match context.exchange(step..step + 1, plan.slices, &mut brought)? {
            Exchange::Regroup => met = false,
            Exchange::Sum { sum, .. } => {
                apply(&mut state, &sum);
                applied = Some(step + 1);
                parts.clear();
            }
        }
    }
    Ok(state)
}

fn bits(state: &[f32]) -> Vec<u32> {
    state.iter().map(|x| x.to_bits()).collect()
}

/// Runs `plan` with `members` seats and without faults.
fn run_whole(members: usize, plan: Plan) -> Vec<Vec<f32>> {
    let gang = Gang::new(members, Timing::default());
    gang.regroup(&(0..members).collect::<Vec<_>>(), false);
    thread::scope(|scope| {
        let threads: Vec<_> = (0..members)
            .map(|i| {
                let gang = gang.clone();
                scope.spawn(move || train(&mut gang.context(i), plan, |_| {}).expect("trained"))
            })
            .collect();
        threads.into_iter().map(|t| t.join().expect("no panic")).collect()
    })
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(16))]
    #[test]
    fn any_membership_gives_the_same_bits(members in 1usize..=4, slices in 1usize..=9, length in 1usize..5000) {
        let plan = Plan { steps: 3, slices, length };
        let expected = bits(&reference(plan.steps, slices, length));
        for state in run_whole(members, plan) {
            prop_assert!(bits(&state) == expected, "{members} members differ from one");
        }
    }
}

#[test]
fn buffers_of_many_pieces_are_summed_too() {
    let plan = Plan { steps: 2, slices: 5, length: 3 * frame::PIECE + 17 };
    let expected = bits(&reference(plan.steps, plan.slices, plan.length));
    for members in [2, 3] {
        for state in run_whole(members, plan) {
            assert!(bits(&state) == expected, "{members} members differ from one");
        }
    }
}

/// Kills one of `members` after `delay`. The others must end with the bits of an undisturbed run.
fn lose_one(members: usize, victim: usize, plan: Plan, at: u64, delay: Duration) {
    let gang = Gang::new(members, QUICK);
    let all: Vec<usize> = (0..members).collect();
    gang.regroup(&all, false);
    let over = AtomicBool::new(false);
    let expected = bits(&reference(plan.steps, plan.slices, plan.length));
    thread::scope(|scope| {
        let supervisor = {
            let gang = gang.clone();
            let all = all.clone();
            let over = &over;
            scope.spawn(move || gang.supervise(all, over))
        };
        let threads: Vec<_> = all
            .iter()
            .map(|&i| {
                let gang = gang.clone();
                scope.spawn(move || {
                    let mut context = gang.context(i);
                    train(&mut context, plan, |step| {
                        if i == victim && step == at && !gang.seats[i].dead.load(Ordering::SeqCst) {
                            let gang = gang.clone();
                            // From another thread, so that it strikes at any point of the exchange.
                            thread::spawn(move || {
                                thread::sleep(delay);
                                gang.seats[i].dead.store(true, Ordering::SeqCst);
                                let held = gang.held(i);
                                if let Some(held) = held {
                                    held.sever();
                                    held.end("killed");
                                }
                            });
                        }
                    })
                })
            })
            .collect();
        for (i, thread) in threads.into_iter().enumerate() {
            let result = thread.join().expect("no panic");
            if i == victim {
                // It may have finished before the kill.
                assert!(matches!(result, Err(ContextError::GrantEnded(_)) | Ok(_)), "{result:?}");
            } else {
                let state = result.unwrap_or_else(|e| panic!("member {i}: {e}"));
                assert!(bits(&state) == expected, "member {i} differs after a loss");
            }
        }
        over.store(true, Ordering::SeqCst);
        supervisor.join().expect("no panic");
    });
}

#[test]
fn a_loss_at_any_moment_changes_no_bits() {
    let plan = Plan { steps: 12, slices: 6, length: 40_000 };
    for (round, micros) in [0u64, 50, 150, 300, 500, 800, 1200, 2000, 3000, 5000].into_iter().enumerate() {
        let members = 2 + round % 3;
        lose_one(members, round % members, plan, 4, Duration::from_micros(micros));
    }
}

#[test]
fn joiners_take_the_state_of_a_peer() {
    let plan = Plan { steps: 40, slices: 4, length: 40_000 };
    let gang = Gang::new(4, QUICK);
    gang.regroup(&[0], false);
    let expected = bits(&reference(plan.steps, plan.slices, plan.length));
    let adopted = AtomicU64::new(0);
    thread::scope(|scope| {
        let mut threads = Vec::new();
        let first = gang.clone();
        let (reached, reached_by_first) = std::sync::mpsc::channel();
        threads.push(scope.spawn(move || {
            train(&mut first.context(0), plan, |step| {
                if step == 10 {
                    let _ = reached.send(());
                }
                thread::sleep(Duration::from_millis(2));
            })
        }));
        reached_by_first.recv().expect("the first member trains");
        gang.regroup(&[0, 1, 2, 3], false);
        for i in [1, 2, 3] {
            let gang = gang.clone();
            let adopted = &adopted;
            threads.push(scope.spawn(move || {
                let mut first = true;
                train(&mut gang.context(i), plan, |step| {
                    if std::mem::take(&mut first) {
                        adopted.fetch_max(step, Ordering::SeqCst);
                    }
                })
            }));
        }
        for thread in threads {
            let state = thread.join().expect("no panic").expect("trained");
            assert!(bits(&state) == expected);
        }
    });
    assert!(adopted.load(Ordering::SeqCst) >= 10, "joiners began where the first member was");
}

/// No coordinator answers here, so a line is never stored.
#[test]
fn a_context_ends_though_its_lines_cannot_be_stored() {
    let gang = Gang::new(1, QUICK);
    gang.regroup(&[0], false);
    let mut context = gang.context(0);
    context.log("a line");
    // Longer than the sender waits before its first try.
    thread::sleep(Duration::from_secs(1));
    let (ended, ends) = std::sync::mpsc::channel();
    thread::spawn(move || {
        drop(context);
        let _ = ended.send(());
    });
    ends.recv_timeout(Duration::from_secs(10)).expect("the context ends");
}

#[test]
fn one_wish_to_drain_is_heard_by_all_after_the_same_step() {
    let gang = Gang::new(3, QUICK);
    gang.regroup(&[0, 1, 2], false);
    let contexts: Vec<HttpContext> = (0..3).map(|i| gang.context(i)).collect();
    // Only the second member gets the drain request.
    let held = gang.held(1).expect("a member");
    let stops: Vec<Vec<bool>> = thread::scope(|scope| {
        let threads: Vec<_> = contexts
            .into_iter()
            .map(|mut context| {
                let held = held.clone();
                scope.spawn(move || {
                    context.rendezvous(None, &[]).expect("met");
                    let mut stops = Vec::new();
                    for step in 0..4 {
                        let mut parts: Vec<_> = context.share(3).map(|s| (s..s + 1, vec![1.0])).collect();
                        if step == 2 {
                            let mut desired = held.assignment();
                            desired.drain = true;
                            held.update(desired);
                        }
                        match context.exchange(step..step + 1, 3, &mut parts).expect("summed") {
                            Exchange::Sum { drain, sum } => {
                                assert_eq!(sum, [3.0]);
                                stops.push(drain);
                            }
                            Exchange::Regroup => panic!("nothing happened"),
                        }
                    }
                    stops
                })
            })
            .collect();
        threads.into_iter().map(|t| t.join().expect("no panic")).collect()
    });
    assert!(stops.iter().all(|s| *s == stops[0]), "{stops:?}");
    assert!(stops[0][3]);
}

fn mesh(gang: &Gang, seats: &[usize], own: usize, secret: &str) -> (Arc<Mesh>, Arc<EventCount>) {
    let members = seats.iter().map(|&i| gang.seats[i].member.clone()).collect();
    let config = MeshConfig {
        task: task(),
        generation: Generation(7),
        rank: own,
        members,
        secret: secret.to_owned(),
        busy: Busy::default(),
    };
    let event_count: Arc<EventCount> = Arc::default();
    (Mesh::open(config, &gang.seats[seats[own]].endpoint, event_count.clone(), Arc::default(), None), event_count)
}

/// Dials as a peer that knows the secret, and waits for the welcome.
fn dial(
    stream: &TcpStream,
    of: &TaskId,
    generation: u64,
    from: usize,
    to: usize,
) -> Result<handshake::Session, handshake::HandshakeError> {
    let hurried = &mut handshake::Hurried::new(stream, Instant::now())?;
    let session = handshake::dial(hurried, of, Generation(generation), from, to, "s")?;
    handshake::welcomed(hurried).map(|()| session)
}

fn unreachable(worker: &str) -> LostPeer {
    LostPeer { worker: worker.into(), cause: LossCause::Unreachable }
}

fn wait_until(what: &str, mut holds: impl FnMut() -> bool) {
    let begun = Instant::now();
    while !holds() {
        assert!(begun.elapsed() < Duration::from_secs(20), "{what}");
        thread::sleep(Duration::from_millis(5));
    }
}

/// Rank 0 has the last step to save. The others hold their state as long as it lives and learn of its death at once.
#[test]
fn members_hold_their_state_until_rank_0_has_saved() {
    let gang = Gang::new(3, QUICK);
    gang.regroup(&[0, 1, 2], false);
    let mut contexts: Vec<HttpContext> = (0..3).map(|i| gang.context(i)).collect();
    thread::scope(|scope| {
        for context in &mut contexts {
            scope.spawn(|| context.rendezvous(Some(8), &[]).map(drop).expect("met"));
        }
    });
    let [_lead, second, third] = &mut contexts[..] else { unreachable!("there are three") };
    thread::scope(|scope| {
        let holds = [scope.spawn(|| second.hold()), scope.spawn(|| third.hold())];
        thread::sleep(Duration::from_millis(300));
        assert!(holds.iter().all(|hold| !hold.is_finished()), "rank 0 has not reported");
        gang.held(0).expect("a member").sever();
        wait_until("both miss rank 0", || {
            let misses = |i| gang.held(i).expect("a member").doing().lost == [unreachable("w0")];
            [1, 2].into_iter().all(misses)
        });
        gang.regroup(&[1, 2], false);
        for hold in holds {
            assert!(matches!(hold.join().expect("no panic"), Ok(())));
        }
    });
    thread::scope(|scope| {
        for context in [&mut *second, &mut *third] {
            scope.spawn(|| assert!(matches!(context.rendezvous(Some(8), &[]), Ok(Rendezvous::Keep))));
        }
    });
    assert!(second.leads() && !third.leads(), "the next rank saves");
    thread::scope(|scope| {
        let hold = scope.spawn(|| third.hold());
        gang.held(2).expect("a member").end("the coordinator revoked the grant");
        assert!(matches!(hold.join().expect("no panic"), Err(ContextError::GrantEnded(_))), "once it is reported");
    });
}

#[test]
#[ignore = "a measurement: cargo test --release -p worker throughput -- --ignored --nocapture"]
fn throughput() {
    for (members, length) in [(1, 20_000_000), (2, 2_000_000), (2, 20_000_000), (3, 20_000_000)] {
        let gang = Gang::new(members, Timing::default());
        gang.regroup(&(0..members).collect::<Vec<_>>(), false);
        let begun = Mutex::new(None::<Instant>);
        let barrier = std::sync::Barrier::new(members);
        thread::scope(|scope| {
            for i in 0..members {
                let gang = gang.clone();
                let begun = &begun;
                let barrier = &barrier;
                scope.spawn(move || {
                    let mut context = gang.context(i);
                    context.rendezvous(None, &[]).expect("met");
                    let mut parts: Vec<_> = context.share(8).map(|s| (s..s + 1, vec![0.5f32; length])).collect();
                    barrier.wait();
                    lock(begun).get_or_insert_with(Instant::now);
                    for step in 0..4 {
                        context.exchange(step..step + 1, 8, &mut parts).expect("summed");
                    }
                    barrier.wait();
                    if i == 0 {
                        let each = lock(begun).expect("set").elapsed() / 4;
                        eprintln!("{members} members, {length} floats, 8 slices: {each:?} an exchange");
                    }
                });
            }
        });
    }
}
