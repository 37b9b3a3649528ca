//! Batches without a disk: common decisions, refusals of the store, and the order of answers.

use coordinator::batch::{Ask, Batches, Done, Turn};
use coordinator::state::worker::{Identity, Presence};
use coordinator::{Effect, Event, Millis, Moment, Observation, Policy, Refused, State};
use protocol::message::{Join, PROTOCOL_VERSION, Poll};
use protocol::stage::Backend;
use protocol::{Digest, Incarnation, WorkerId};
use registry::{Write, WriteError};

const TEXT: &str = "name: p\nseed: 1\ndataset: {format: synthetic}\nstages: {vae: {kind: train.vae}}\n";

fn at(now: u64) -> impl FnMut() -> Moment {
    move || Moment { now: Millis(now), entropy: Digest::of(b"entropy") }
}

fn submit() -> Ask {
    let pipeline = pipeline::read("p.yaml", TEXT, &[]).expect("a pipeline");
    let (pipeline, source) = (Box::new(pipeline), TEXT.to_owned());
    Ask::Event(Box::new(Event::Submit {
        submission: None,
        pipeline,
        source,
        idempotency_key: None,
        until: None,
        owner: protocol::Owner::local("me"),
    }))
}

fn join(name: &str) -> Ask {
    let join = Join {
        protocol: PROTOCOL_VERSION,
        worker: name.into(),
        pid: 1,
        backend: Backend::Flex,
        instruction_set: "avx2".into(),
        code_versions: protocol::stage::StageSettings::code_versions(),
        peer_address: format!("{name}:1"),
        labels: Default::default(),
    };
    let by = Identity { caller: "t".into(), secret: Digest::of(name.as_bytes()) };
    Ask::Event(Box::new(Event::Join { join, by }))
}

fn poll(incarnation: Incarnation) -> Poll {
    Poll { incarnation, doing: Vec::new(), ready: Vec::new(), version: 0, leaving: false }
}

fn full() -> Result<(), WriteError> {
    Err(WriteError::Storage("full".into()))
}

fn to_store(turn: Turn<&'static str>) -> Vec<Write> {
    match turn {
        Turn::Store(writes) => writes,
        other => panic!("nothing to store: {other:?}"),
    }
}

fn over(turn: Turn<&'static str>) -> Done<&'static str> {
    match turn {
        Turn::Done(done) => done,
        other => panic!("not over: {other:?}"),
    }
}

/// Decides and stores a single request.
fn taken(batches: &mut Batches<&'static str>, now: u64, ask: Ask) -> Vec<Effect> {
    batches.ask(ask, "alone");
    to_store(batches.decide(at(now)));
    over(batches.stored(Ok(()), at(now))).answers.remove(0).1.expect("taken")
}

/// A worker that joined at time 0.
fn with_a_worker() -> (Batches<&'static str>, Incarnation) {
    let mut batches = Batches::new(State::new(Policy::default()));
    let joined = taken(&mut batches, 0, join("a")).into_iter().find_map(|effect| match effect {
        Effect::Joined(incarnation) => Some(incarnation),
        _ => None,
    });
    (batches, joined.expect("joined"))
}

#[test]
fn what_is_refused_together_is_tried_alone_and_only_one_is_at_fault() {
    let (mut batches, _) = with_a_worker();
    batches.ask(submit(), "first");
    batches.ask(submit(), "second");
    let together = to_store(batches.decide(at(1))).len();
    let refused = over(batches.stored(full(), at(1)));
    assert!(refused.answers.is_empty() && refused.effects.is_empty() && !refused.durable, "{refused:?}");
    assert!(batches.front().state().runs.is_empty(), "none of it has happened");
    assert!(to_store(batches.decide(at(1))).len() < together);
    let first = over(batches.stored(full(), at(1)));
    assert!(matches!(&first.answers[..], [("first", Err(Refused::Write(WriteError::Storage(_))))]), "{first:?}");
    to_store(batches.decide(at(1)));
    let second = over(batches.stored(Ok(()), at(1)));
    assert!(matches!(&second.answers[..], [("second", Ok(_))]) && second.durable, "{second:?}");
    assert_eq!(batches.front().state().runs.size(), 1);
    assert!(matches!(batches.decide(at(1)), Turn::Idle));
}

#[test]
fn nobody_sees_what_is_not_stored_and_quiet_polls_do_not_wait_for_it() {
    let (mut batches, incarnation) = with_a_worker();
    let worker = WorkerId::from("a");
    batches.ask(submit(), "submission");
    to_store(batches.decide(at(1)));
    assert!(batches.front().state().runs.is_empty());
    let asked = batches.front().poll(Millis(9_000), worker.clone(), poll(incarnation)).expect("known");
    assert!(asked.is_none(), "answered beside the queue");
    assert_eq!(over(batches.stored(Ok(()), at(9_500))).answers.len(), 1);
    assert_eq!(batches.front().state().runs.size(), 1);
    // Noted polls are applied before the tick. 15 s have passed since the join, but only 7 s since the poll, so the
    // lease is valid.
    batches.ask(Ask::Observation(Observation::Tick { overslept: 0 }, Millis(16_000)), "tick");
    over(batches.decide(at(16_000)));
    assert_eq!(batches.state().workers[&worker].presence, Presence::Here);
}

#[test]
fn what_was_heard_stays_heard_when_what_follows_cannot_be_stored() {
    let (mut batches, incarnation) = with_a_worker();
    let worker = WorkerId::from("a");
    let expired = Event::LeaseExpired { worker: worker.clone(), incarnation };
    taken(&mut batches, 1_000, Ask::Event(Box::new(expired)));
    let asked = batches.front().poll(Millis(50_000), worker.clone(), poll(incarnation)).expect("known");
    batches.ask(asked.expect("it is back, which is to be stored"), "poll");
    to_store(batches.decide(at(50_000)));
    assert_eq!(over(batches.stored(full(), at(50_000))).answers.len(), 1);
    assert_eq!(batches.state().heard.workers[&worker], Millis(50_000));
    assert_eq!(batches.state().workers[&worker].presence, Presence::Silent);
}
