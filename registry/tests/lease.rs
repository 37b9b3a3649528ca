//! Two copies of a store's folder on one bucket: one process at a time holds the blobs, and notices when it loses them.
#![allow(clippy::unwrap_used, reason = "a test may panic")]

mod common;

use std::path::Path;
use std::sync::Arc;
use std::time::{Duration, Instant};

use common::{artifact, note, result};
use protocol::ArtifactKind;
use registry::blob::Backend;
use registry::testing::slow::SlowBucket;
use registry::{Holder, LeaseTerms, OpenError, Store, WriteError};

/// Short terms, so that the tests wait only briefly.
fn terms() -> LeaseTerms {
    let [renewed, relied_on, waited_for] = [50, 1_500, 4_000].map(Duration::from_millis);
    LeaseTerms { renewed, relied_on, waited_for }
}

async fn open(dir: &Path, blobs: Arc<dyn Backend>, who: &str) -> Result<Store, OpenError> {
    Store::open_over(dir, blobs, Holder::this_process(who), terms()).await
}

/// Copies a folder in use, like `cp -a`.
fn copy(from: &Path, to: &Path) {
    for entry in std::fs::read_dir(from).unwrap() {
        let entry = entry.unwrap();
        let target = to.join(entry.file_name());
        if entry.file_type().unwrap().is_dir() {
            std::fs::create_dir_all(&target).unwrap();
            copy(&entry.path(), &target);
        } else {
            std::fs::copy(entry.path(), target).unwrap();
        }
    }
}

/// Two folders, the second copied from the first while that was open. Each has its own connection to the bucket.
struct Two {
    first: tempfile::TempDir,
    second: tempfile::TempDir,
    line: SlowBucket,
    other_line: SlowBucket,
}

impl Two {
    async fn new() -> (Self, Store) {
        let (first, second) = (tempfile::tempdir().unwrap(), tempfile::tempdir().unwrap());
        let line = SlowBucket::default();
        let store = open(first.path(), line.place("p", first.path()), "the first").await.unwrap();
        store.write(vec![note("made by the first")]).await.unwrap();
        let other_line = line.of_another();
        let two = Self { first, second, line, other_line };
        copy(two.first.path(), two.second.path());
        (two, store)
    }

    async fn open_second(&self) -> Result<Store, OpenError> {
        let dir = self.second.path();
        open(dir, self.other_line.place("p", dir), "the second").await
    }
}

async fn until(what: &str, mut is_so: impl AsyncFnMut() -> bool) {
    let begun = Instant::now();
    while !is_so().await {
        assert!(begun.elapsed() < Duration::from_secs(30), "{what}");
        tokio::time::sleep(Duration::from_millis(20)).await;
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_second_process_is_refused_while_the_first_one_holds_the_blobs() {
    let (two, store) = Two::new().await;
    let made = artifact(store.blobs(), ArtifactKind::Vae, "after the copy was made");
    store.write(vec![result("key", made)]).await.unwrap();

    let refused = two.open_second().await.unwrap_err();
    let OpenError::Held { by, .. } = &refused else { panic!("{refused}") };
    assert!(by.contains("the first") && by.contains(&*two.first.path().to_string_lossy()), "{by}");
    assert!(refused.to_string().contains("in use by"), "{refused}");

    // Blobs that the copy does not know are still present.
    assert!(store.fsck().await.unwrap().problems.is_empty());
    assert!(store.blobs().complete_manifest(made).is_ok());
    drop(store);
    // The blobs are free, and the copy has the same epoch, so it may take them.
    let store = two.open_second().await.unwrap();
    assert!(matches!(
        open(two.first.path(), two.line.place("p", two.first.path()), "late").await,
        Err(OpenError::Held { .. })
    ));
    drop(store);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_process_that_cannot_renew_its_lease_names_and_removes_nothing() {
    let (two, store) = Two::new().await;
    let made = artifact(store.blobs(), ArtifactKind::Vae, "made");
    let garbage = store.blobs().put(b"garbage").unwrap();
    let proof = store.prove(made).await.unwrap();
    two.line.silence(true);
    // A new key each time, because a value that is already stored names nothing.
    let mut keys = 0;
    let mut name = async || {
        keys += 1;
        store.write_proven(vec![result(&format!("key {keys}"), made)]).await
    };
    until("a lease that runs out", async || name().await.is_err()).await;
    let refused = name().await.unwrap_err();
    assert!(matches!(&refused, WriteError::Unreachable(why) if why.contains("lease")), "{refused}");
    store.write(vec![note("what names no blob is stored")]).await.unwrap();

    // The other process waits for the length of the lease and takes the blobs.
    let begun = Instant::now();
    let second = two.open_second().await.unwrap();
    assert!(begun.elapsed() >= terms().waited_for, "{:?}", begun.elapsed());
    let kept = artifact(second.blobs(), ArtifactKind::Vae, "made by the second");
    second.write(vec![result("second", kept)]).await.unwrap();

    two.line.silence(false);
    until("the first one to know", async || matches!(name().await, Err(WriteError::Storage(_)))).await;
    let refused = name().await.unwrap_err().to_string();
    assert!(refused.contains("the second") && refused.contains("stop one of the two"), "{refused}");
    let refused = store.gc(-1000).await.unwrap_err().to_string();
    assert!(refused.contains("nothing was collected"), "{refused}");
    drop(proof);
    drop(store);
    assert!(second.blobs().complete_manifest(kept).is_ok() && second.blobs().exists(garbage).unwrap());
    assert!(second.fsck().await.unwrap().problems.is_empty());
    second.write(vec![result("again", kept)]).await.unwrap();
}

/// Each removal checks the lease: if it expires during a collection, the collection ends.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_collection_ends_with_the_lease() {
    let (two, store) = Two::new().await;
    for i in 0..20 {
        store.blobs().put(format!("garbage {i}").as_bytes()).unwrap();
    }
    // Each request takes longer than a renewal may.
    two.line.delay(terms().relied_on * 2);
    let refused = store.gc(-1000).await.unwrap_err().to_string();
    assert!(refused.contains("lease"), "{refused}");
    two.line.delay(Duration::ZERO);
    assert_eq!(store.blobs().list().unwrap().len(), 20);
    until("a lease that is renewed", async || store.gc(-1000).await.is_ok()).await;
    assert!(store.blobs().list().unwrap().is_empty());
}

/// A killed process leaves its name in the marker. The lock in the folder shows that it has ended.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn the_same_folder_is_opened_at_once_after_a_kill() {
    let (two, store) = Two::new().await;
    // It ends while it cannot release the lease.
    two.line.silence(true);
    drop(store);
    let begun = Instant::now();
    let dir = two.first.path();
    let store = open(dir, two.other_line.place("p", dir), "the next").await.unwrap();
    assert!(begun.elapsed() < terms().waited_for, "{:?}", begun.elapsed());
    two.line.silence(false);
    let made = artifact(store.blobs(), ArtifactKind::Vae, "made");
    store.write(vec![result("key", made)]).await.unwrap();
}
