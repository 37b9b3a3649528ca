//! The suite on a real S3 server, with messages and data after refusals and lost connections.

use std::sync::Arc;
use std::time::Duration;

use checkpoint::{BlobError, Blobs};
use cluster_tests::bucket::{Bucket, KEY, NAME, SECRET};
use object_store::aws::{AmazonS3, AmazonS3Builder, S3ConditionalPut};
use object_store::{BackoffConfig, RetryConfig};
use protocol::Digest;
use registry::blob::objects::{Bucket as AnyBucket, Objects, Remote};
use registry::blob::{Backend, BlobStore};

use super::{common, objects};

#[path = "signed.rs"]
mod signed;

/// A client like that of `Remote::connect`, except for its credentials and a retry time of one second.
fn client(bucket: &Bucket, name: &str, secret: &str) -> Arc<dyn AnyBucket> {
    Arc::new(s3(bucket, name, secret))
}

fn s3(bucket: &Bucket, name: &str, secret: &str) -> AmazonS3 {
    let _ = rustls::crypto::ring::default_provider().install_default();
    let backoff = BackoffConfig { max_backoff: Duration::from_millis(200), ..BackoffConfig::default() };
    let retry = RetryConfig { backoff, max_retries: 4, retry_timeout: Duration::from_secs(1) };
    let builder = AmazonS3Builder::new().with_endpoint(bucket.endpoint()).with_allow_http(true);
    let builder = builder.with_region("us-east-1").with_bucket_name(name);
    let builder = builder.with_access_key_id(KEY).with_secret_access_key(secret);
    builder.with_conditional_put(S3ConditionalPut::ETagMatch).with_retry(retry).build().unwrap()
}

/// Opens the blobs at a prefix through a client, with a separate store folder.
fn open(store: Arc<dyn AnyBucket>) -> (tempfile::TempDir, Objects) {
    let dir = tempfile::tempdir().unwrap();
    let remote = Remote::over(&Bucket::url("p"), store).unwrap();
    let objects = Objects::open(Arc::new(remote), dir.path()).unwrap();
    (dir, objects)
}

/// Lists all files of the bucket, except the server's own metadata.
fn files(dir: &std::path::Path) -> Vec<std::path::PathBuf> {
    let Ok(entries) = std::fs::read_dir(dir) else { return Vec::new() };
    let paths = entries.map(|entry| entry.unwrap().path());
    paths.flat_map(|path| if path.is_dir() { files(&path) } else { vec![path] }).collect()
}

fn bytes(length: u32) -> Vec<u8> {
    (0..length).map(|i| (i.wrapping_mul(2_654_435_761) >> 24) as u8).collect()
}

#[test]
fn objects_on_an_s3_server() {
    let bucket = Bucket::start();
    // Without `a_marker_is_taken_by_one_of_many`: this server checks a condition and then writes, which is not atomic.
    objects(&client(&bucket, NAME, SECRET));
}

#[test]
fn a_wrong_key_and_a_missing_bucket_are_said() {
    let bucket = Bucket::start();
    let (_dir, place) = open(client(&bucket, NAME, "another word"));
    for refused in [place.set_marker(None, "one").unwrap_err(), place.is_empty().unwrap_err()] {
        let BlobError::Storage(said) = &refused else { panic!("{refused}") };
        let parts = ["access was refused", "SignatureDoesNotMatch", "AWS_SECRET_ACCESS_KEY", "s3://stride-tests/p"];
        assert!(parts.iter().all(|part| said.contains(part)), "{said}");
    }
    // The answer to a request for a single object's metadata has no body with details.
    let refused = place.stat(Digest::of(b"x")).unwrap_err();
    assert!(matches!(&refused, BlobError::Storage(said) if said.contains("access was refused")), "{refused}");

    let (_dir, place) = open(client(&bucket, "nowhere", SECRET));
    // Opening a store sends this request first. A put would not fail, because this server creates a missing bucket.
    let refused = place.is_empty().unwrap_err();
    let BlobError::Storage(said) = &refused else { panic!("{refused}") };
    assert!(said.contains("there is no bucket") && said.contains("`--blobs`"), "{said}");
    assert!(files(&bucket.objects()).is_empty(), "nobody has written anything");
}

/// The client does not resend a put that must not overwrite, because it may have succeeded. The store's next try finds
/// out.
#[test]
fn a_cut_put_is_done_once_or_not_at_all() {
    let bucket = Bucket::start();
    let (_dir, place) = open(client(&bucket, NAME, SECRET));
    let store = BlobStore::new(place);
    for (i, after) in [0, 100, 1_000, 30_000].into_iter().enumerate() {
        let bytes = bytes(60_000 + u32::try_from(i).unwrap());
        bucket.cut_after(after);
        if let Err(error) = store.put(&bytes) {
            assert!(matches!(error, BlobError::Unreachable(_)), "{error}");
            store.put(&bytes).unwrap();
        }
        assert_eq!(bucket.cuts(), i as u64 + 1, "cut after {after} bytes");
        assert!(store.get(Digest::of(&bytes)).unwrap() == bytes);
    }
    // A read is resent unnoticed.
    let digest = Digest::of(&bytes(60_000));
    bucket.cut_after(0);
    assert_eq!(store.size(digest).unwrap(), Some(60_000));
    bucket.cut_after(0);
    assert_eq!(store.get(digest).unwrap().len(), 60_000);
    assert!(store.strays().unwrap().is_empty() && store.aside().unwrap().is_empty());
}

#[test]
fn a_part_whose_connection_is_cut_is_sent_again_by_itself() {
    let bucket = Bucket::start();
    let (_dir, place) = open(client(&bucket, NAME, SECRET));
    let (store, bytes) = (BlobStore::new(place), bytes(20 << 20));
    bucket.cut_after(10 << 20);
    let digest = store.put(&bytes).unwrap();
    assert_eq!(bucket.cuts(), 1);
    let opened = Blobs::open(&store, digest).unwrap();
    let mut read = vec![0; 9 << 20];
    bucket.cut_after(0);
    opened.read_at(5 << 20, &mut read).unwrap();
    assert!(read == bytes[5 << 20..14 << 20]);
    assert_eq!(bucket.cuts(), 2);
}

/// The server disappears during an upload in parts. The blob's name shows nothing, the worker's bytes are kept here,
/// and after the server's return they are sent from here alone.
#[test]
fn an_upload_in_parts_that_is_given_up_leaves_nothing_and_goes_on_from_here() {
    let bucket = Bucket::start();
    let (dir, place) = open(client(&bucket, NAME, SECRET));
    let (store, bytes, grant) = (BlobStore::new(place), bytes(20 << 20), common::grant("r/s", 1));
    let (digest, total) = (Digest::of(&bytes), bytes.len() as u64);
    let mut arriving = store.take_up(&grant, digest, 0, total).unwrap();
    arriving.write(&bytes).unwrap();
    bucket.cut_after(9 << 20);
    std::thread::scope(|scope| {
        let sending = scope.spawn(|| arriving.finish());
        while bucket.cuts() == 0 && !sending.is_finished() {
            std::thread::yield_now();
        }
        bucket.close();
        let error = sending.join().unwrap().unwrap_err();
        let BlobError::Unreachable(said) = &error else { panic!("{error}") };
        assert!(said.contains("AWS_ENDPOINT_URL") && said.contains("s3://stride-tests/p/sha256"), "{said}");
    });
    bucket.open();
    assert_eq!(store.size(digest).unwrap(), None, "no part of it has its name");
    assert!(store.list().unwrap().is_empty());

    // The bytes are complete; only the name is missing.
    assert_eq!(store.staged(&grant, digest).unwrap(), total);
    assert!(store.take_up(&grant, digest, total, total).unwrap().finish().unwrap());
    assert!(store.get(digest).unwrap() == bytes);
    assert_eq!(std::fs::read_dir(dir.path().join("staging")).unwrap().count(), 0, "it is not kept twice");
}

/// A process that is gone leaves the parts of its upload, as the server's absence here does. A process with another
/// folder lists and ends the upload, and leaves its own alone.
#[test]
fn parts_that_a_killed_process_left_are_listed_and_removed() {
    let bucket = Bucket::start();
    let (_dir, place) = open(client(&bucket, NAME, SECRET));
    let (store, bytes) = (BlobStore::new(place), bytes(96 << 20));
    std::thread::scope(|scope| {
        let sending = scope.spawn(|| store.put(&bytes));
        while bucket.parts() == 0 && !sending.is_finished() {
            std::thread::yield_now();
        }
        bucket.close();
        sending.join().unwrap().unwrap_err();
    });
    bucket.open();
    assert!(bucket.parts() > 0, "the server kept a part");

    let (_other, place) = open(client(&bucket, NAME, SECRET));
    let left = place.unfinished().unwrap();
    let name = format!("s3://{NAME}/p/sha256/{}", &Digest::of(&bytes).hex()[..2]);
    assert!(left.len() == 1 && left[0].contains(&name), "{left:?}");
    assert_eq!((place.give_up_unfinished().unwrap(), bucket.parts()), (1, 0));
    assert!(place.unfinished().unwrap().is_empty() && place.list().unwrap().is_empty());

    // An upload that succeeds leaves neither parts nor a record.
    let digest = store.put(&bytes).unwrap();
    assert_eq!((place.give_up_unfinished().unwrap(), bucket.parts()), (0, 0));
    assert!(store.get(digest).unwrap() == bytes);
}
