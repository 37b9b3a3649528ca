//! Blobs that are damaged, missing or interrupted in transfer.

use checkpoint::BlobError;
use protocol::Digest;
use stages::context::ContextError;

use super::*;

#[test]
fn blobs_are_verified() {
    let good = Digest::of(b"good");
    let absent = Digest::of(b"absent");
    let worker = Worker::start(Box::new(move |context| {
        let blobs = context.blobs();
        assert_eq!(&*blobs.get(good).expect("a damaged download is repeated"), b"good");
        assert!(matches!(blobs.get(absent), Err(BlobError::NotFound(d)) if d == absent));
        assert!(matches!(context.manifest(good), Err(ContextError::Corrupt(_))), "not a manifest");
        finished(context)
    }));
    lock(&worker.fake.coordinator).blobs.insert(good, b"good".to_vec());
    worker.fake.damage.store(2, Ordering::SeqCst);
    worker.grant(1);
    worker.wait("an outcome", |coordinator| !coordinator.outcomes.is_empty());
    let coordinator = worker.leave();
    assert!(matches!(coordinator.outcomes[0].outcome, TaskOutcome::Finished { .. }), "{:?}", coordinator.outcomes);
}

#[test]
fn a_blob_that_stays_damaged_is_an_error() {
    let good = Digest::of(b"good");
    let worker = Worker::start(Box::new(move |context| {
        assert!(matches!(context.blobs().get(good), Err(BlobError::Corrupt { expected, .. }) if expected == good));
        finished(context)
    }));
    lock(&worker.fake.coordinator).blobs.insert(good, b"good".to_vec());
    worker.fake.damage.store(100, Ordering::SeqCst);
    worker.grant(1);
    worker.wait("an outcome", |coordinator| !coordinator.outcomes.is_empty());
    assert!(matches!(worker.leave().outcomes[0].outcome, TaskOutcome::Finished { .. }));
}

#[test]
fn cut_transfers_go_on_where_they_were_cut() {
    const BYTES: usize = 30 << 20;
    let whole: Vec<u8> = (0..BYTES).map(|i| (i % 251) as u8).collect();
    let sent = whole.clone();
    let worker = Worker::start(Box::new(move |context| {
        let blobs = context.blobs();
        let digest = blobs.put_pieces(&[&sent[..1000], &sent[1000..]]).expect("stored");
        let read = blobs.open(digest).expect("fetched");
        assert_eq!(read.bytes(), BYTES as u64);
        let mut end = vec![0; 1000];
        read.read_at((BYTES - 1000) as u64, &mut end).expect("read");
        assert_eq!(end, sent[BYTES - 1000..]);
        finished(context)
    }));
    worker.fake.cut.store(2, Ordering::SeqCst);
    worker.grant(1);
    worker.wait("an upload", |coordinator| coordinator.blobs.contains_key(&Digest::of(&whole)));
    let uploaded = worker.fake.received.load(Ordering::SeqCst);
    // Half of two parts of 8 MiB arrived; sending all again would be twice as much.
    assert!(uploaded < (BYTES + (10 << 20)) as u64, "{uploaded} bytes were sent");
    worker.wait("an outcome", |coordinator| !coordinator.outcomes.is_empty());
    let outcomes = worker.leave().outcomes.clone();
    assert!(matches!(outcomes[0].outcome, TaskOutcome::Finished { .. }), "{outcomes:?}");
}

#[test]
fn a_cut_download_goes_on() {
    const BYTES: usize = 20 << 20;
    let whole: Vec<u8> = (0..BYTES).map(|i| (i % 241) as u8).collect();
    let digest = Digest::of(&whole);
    let sent = whole.clone();
    let worker = Worker::start(Box::new(move |context| {
        assert_eq!(*context.blobs().get(digest).expect("fetched"), *sent);
        finished(context)
    }));
    lock(&worker.fake.coordinator).blobs.insert(digest, whole);
    worker.fake.cut.store(1, Ordering::SeqCst);
    worker.grant(1);
    worker.wait("an outcome", |coordinator| !coordinator.outcomes.is_empty());
    let received = worker.fake.received.load(Ordering::SeqCst);
    // Bytes in flight at the interruption may be lost, but not all bytes before them.
    assert!(received < (2 * BYTES) as u64, "{received} bytes were sent");
    assert!(matches!(worker.leave().outcomes[0].outcome, TaskOutcome::Finished { .. }));
}

/// A blob that is damaged in the store is no network error. It is reported once with its name and not fetched again.
#[test]
fn a_blob_that_is_damaged_in_the_store_fails_the_attempt_at_once() {
    let digest = Digest::of(b"rotten");
    let worker = Worker::start(Box::new(move |context| {
        context.manifest(digest)?;
        finished(context)
    }));
    worker.fake.rotten.store(true, Ordering::SeqCst);
    worker.grant(1);
    worker.wait("an outcome", |coordinator| !coordinator.outcomes.is_empty());
    assert_eq!(worker.fake.received.load(Ordering::SeqCst), 1, "asked once");
    let outcomes = worker.leave().outcomes.clone();
    let TaskOutcome::Failed { class: FailureClass::Damaged, .. } = &outcomes[0].outcome else { panic!("{outcomes:?}") };
}
