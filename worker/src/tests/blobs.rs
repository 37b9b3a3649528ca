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
    // The fake counts bytes of both directions.
    let uploaded = Arc::new(Barrier::new(2));
    let counted = Arc::clone(&uploaded);
    let worker = Worker::start(Box::new(move |context| {
        let blobs = context.blobs();
        let digest = blobs.put_pieces(&[&sent[..1000], &sent[1000..]]).expect("stored");
        uploaded.wait();
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
    let bytes = worker.fake.received.load(Ordering::SeqCst);
    counted.wait();
    // Half of two parts of 8 MiB arrived; sending all again would be twice as much.
    assert!(bytes < (BYTES + (10 << 20)) as u64, "{bytes} bytes were sent");
    worker.wait("an outcome", |coordinator| !coordinator.outcomes.is_empty());
    let outcomes = worker.leave().outcomes.clone();
    assert!(matches!(outcomes[0].outcome, TaskOutcome::Finished { .. }), "{outcomes:?}");
}

/// Bytes of a chunk in these tests: two parts of an upload.
const CHUNK: usize = 9 << 20;

/// A sparse file: zeros, except at the beginning of each chunk.
fn sparse(name: u8, chunks: usize) -> Vec<u8> {
    let mut bytes = vec![0; chunks * CHUNK];
    for at in 0..chunks {
        bytes[at * CHUNK..][..2].copy_from_slice(&[name, at as u8]);
    }
    bytes
}

/// The files of a checkpoint after `step`; only the first one depends on it.
fn state(step: u8) -> [(&'static str, Vec<u8>); 3] {
    [("state", sparse(step, 3)), ("average", sparse(254, 3)), ("frozen", sparse(255, 2))]
}

fn save(context: &mut dyn GangContext, step: u8) -> Result<(), StageError> {
    let files = state(step);
    let pieces: Vec<[&[u8]; 2]> = files.iter().map(|(_, bytes)| [&bytes[..1000], &bytes[1000..]]).collect();
    let files: Vec<(&str, &[&[u8]])> =
        files.iter().zip(&pieces).map(|((name, _), pieces)| (*name, &pieces[..])).collect();
    context.record(1, &[("loss", 0.5)]);
    let checkpoint = Checkpoint { chunk_bytes: CHUNK as u64, ..checkpoint(1, serde_json::json!({ "step": step })) };
    context.save(checkpoint, &files)?;
    context.saved(true).expect("a save was begun")?;
    Ok(())
}

/// The coordinator loses the chunk that is on its way in the middle of a checkpoint of three files. The next attempt
/// reads the checkpoint and saves another one.
#[test]
fn a_cut_upload_sends_only_the_chunk_under_way_again() {
    let worker = Worker::start(Box::new(|context| {
        context.rendezvous(None, &[])?;
        let Some(manifest) = context.latest_checkpoint()? else {
            save(context, 1)?;
            return Ok(Outcome::Yielded { at: 1 });
        };
        let blobs = context.blobs();
        for (name, bytes) in state(1) {
            let file = checkpoint::file::open(&*blobs, &manifest.files[name]).expect("fetched");
            let mut read = vec![0; bytes.len()];
            file.read_at(0, &mut read).expect("read");
            assert!(read == bytes, "{name}");
        }
        let mapped = checkpoint::file::map(&*blobs, &manifest.files["average"]).expect("joined");
        assert!(mapped == state(1)[1].1);
        save(context, 2)?;
        finished(context)
    }));
    let total = 8 * CHUNK as u64;
    let received = || worker.fake.received.load(Ordering::SeqCst);
    worker.fake.lose_at.store(total / 2 + 1, Ordering::SeqCst);
    worker.grant(1);
    worker.wait("a checkpoint", |coordinator| coordinator.checkpoints.len() == 1);
    let sent = received();
    // The manifest has some hundred bytes.
    assert!((total + (8 << 20)..=total + CHUNK as u64 + 4096).contains(&sent), "{sent} bytes were sent for {total}");
    worker.wait("an outcome", |coordinator| !coordinator.outcomes.is_empty());
    lock(&worker.fake.coordinator).fetched.clear();
    worker.fake.received.store(0, Ordering::SeqCst);

    let resume = lock(&worker.fake.coordinator).checkpoints[0].manifest;
    worker.grant_from(2, Some(resume));
    worker.wait("another checkpoint", |coordinator| coordinator.checkpoints.len() == 2);
    worker.wait("another outcome", |coordinator| coordinator.outcomes.len() == 2);
    let transferred = received();
    // Each chunk was read once. Only those of the first file were sent; manifests have some thousand bytes.
    let expected = total + 3 * CHUNK as u64;
    assert!((expected..expected + 16_384).contains(&transferred), "{transferred} bytes were transferred");
    let coordinator = worker.leave();
    assert!(matches!(coordinator.outcomes[1].outcome, TaskOutcome::Finished { .. }), "{:?}", coordinator.outcomes);
    let of = |at: usize| -> Manifest {
        serde_json::from_slice(&coordinator.blobs[&coordinator.checkpoints[at].manifest]).expect("a manifest")
    };
    let (first, second) = (of(0), of(1));
    let chunks = |manifest: &Manifest, name: &str| manifest.files[name].chunks.len();
    assert_eq!(["state", "average", "frozen"].map(|name| chunks(&first, name)), [3, 3, 2]);
    assert_eq!(first.files["average"], second.files["average"]);
    for blob in first.blobs() {
        assert!(coordinator.fetched.contains(&blob.digest), "chunks are read, and not the whole");
    }
    assert!(!coordinator.fetched.contains(&first.files["state"].digest));
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
