//! Blobs that are read and written at their place by signed requests, and the way through the coordinator if that fails.

use protocol::Digest;

use super::*;

const BYTES: usize = 20 << 20;

fn blob(seed: usize) -> Vec<u8> {
    (0..BYTES).map(|i| ((i + seed) % 251) as u8).collect()
}

/// A stage that writes one blob and reads another one.
fn worker() -> (Worker, Digest) {
    let (written, read) = (blob(0), blob(7));
    let wanted = Digest::of(&read);
    let expected = read.clone();
    let worker = Worker::start(Box::new(move |context| {
        let blobs = context.blobs();
        assert_eq!(blobs.put_pieces(&[&written[..1000], &written[1000..]]).expect("stored"), Digest::of(&written));
        assert!(*blobs.get(wanted).expect("fetched") == *expected);
        finished(context)
    }));
    lock(&worker.fake.coordinator).blobs.insert(wanted, read);
    worker.fake.offers_place.store(true, Ordering::SeqCst);
    (worker, Digest::of(&blob(0)))
}

/// Ends the stage and returns the bytes of large blobs that passed through the coordinator, and the answers of the place.
fn end(worker: Worker, written: Digest) -> (u64, u64) {
    worker.grant(1);
    worker.wait("an outcome", |coordinator| !coordinator.outcomes.is_empty());
    let carried = worker.fake.received.load(Ordering::SeqCst);
    let placed = worker.fake.placed.load(Ordering::SeqCst);
    let coordinator = worker.leave();
    assert!(matches!(coordinator.outcomes[0].outcome, TaskOutcome::Finished { .. }), "{:?}", coordinator.outcomes);
    assert!(coordinator.blobs[&written] == blob(0));
    (carried, placed)
}

#[test]
fn blobs_pass_the_coordinator_by() {
    let (worker, written) = worker();
    let (carried, placed) = end(worker, written);
    // The manifest of the outcome is small.
    assert!(carried < 4096, "{carried} bytes passed through the coordinator");
    assert_eq!(placed, 2);
}

#[test]
fn a_place_that_refuses_costs_one_try() {
    let (worker, written) = worker();
    worker.fake.place_refuses.store(true, Ordering::SeqCst);
    let (carried, placed) = end(worker, written);
    assert!((2 * BYTES as u64..2 * BYTES as u64 + 4096).contains(&carried), "{carried} bytes");
    assert_eq!(placed, 0);
}

/// The coordinator takes over no damaged blob, and a damaged download is repeated through the coordinator, which verifies.
#[test]
fn a_place_that_damages_blobs_is_passed_by() {
    let (worker, written) = worker();
    worker.fake.place_damages.store(true, Ordering::SeqCst);
    let (carried, placed) = end(worker, written);
    assert!((2 * BYTES as u64..2 * BYTES as u64 + 4096).contains(&carried), "{carried} bytes");
    assert_eq!(placed, 2);
}
