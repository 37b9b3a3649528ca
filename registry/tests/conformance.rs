//! Conformance tests of blob backends, as plain functions, and the backends that must pass them.
#![allow(clippy::unwrap_used, reason = "a test may panic")]

#[path = "conformance/bucket.rs"]
mod bucket;
mod common;

use std::io::Read as _;
use std::os::unix::fs::symlink;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use checkpoint::{BlobError, Blobs};
use common::power::Power;
use futures::stream::BoxStream;
use object_store::memory::InMemory;
use object_store::multipart::{MultipartStore, PartId};
use object_store::{
    CopyOptions, GetOptions, GetResult, ListResult, MultipartId, MultipartUpload, ObjectStore, ObjectStoreExt as _,
    PutMultipartOptions, PutOptions, PutPayload, PutResult,
};
use protocol::{ArtifactKind, Digest, FileEntry, Manifest};
use registry::blob::disk::{Disk as _, DiskFile, Os};
use registry::blob::fs::Folder;
use registry::blob::memory::Memory;
use registry::blob::objects::{Bucket, Objects, Remote};
use registry::blob::{Backend, BlobStore, IDLE, ManifestError, PART_BYTES, ResumeError};
use serde_json::json;

fn what_was_put_is_read(store: &BlobStore) {
    for bytes in [&b""[..], b"a", &vec![7; 3 << 20]] {
        let digest = store.put(bytes).unwrap();
        assert_eq!(digest, Digest::of(bytes));
        assert_eq!(store.get(digest).unwrap(), bytes);
        assert_eq!(store.size(digest).unwrap(), Some(bytes.len() as u64));
    }
}

/// Large enough for several parts in an object store.
fn large_blobs_come_and_go_in_parts(store: &BlobStore) {
    let bytes: Vec<u8> = (0..20 << 20).map(|i: u32| i.to_le_bytes()[(i % 4) as usize]).collect();
    let digest = Blobs::put_pieces(store, &[&bytes[..5], &bytes[5..9 << 20], &bytes[9 << 20..]]).unwrap();
    assert_eq!(digest, Digest::of(&bytes));
    let (mut reader, mut read) = (store.read(digest).unwrap(), Vec::new());
    while let Some(part) = reader.next_part().unwrap() {
        assert!(part.len() <= PART_BYTES);
        read.extend(part);
    }
    assert!(read == bytes);
    let mut rest = store.read_from(digest, (18 << 20) + 3).unwrap();
    let mut read = Vec::new();
    while let Some(part) = rest.next_part().unwrap() {
        read.extend(part);
    }
    assert!(read == bytes[(18 << 20) + 3..]);
    let opened = Blobs::open(store, digest).unwrap();
    let mut middle = [0; 100];
    opened.read_at(10 << 20, &mut middle).unwrap();
    assert_eq!(middle, bytes[10 << 20..][..100]);
    assert!(opened.read_at((20 << 20) - 99, &mut middle).is_err(), "past the end");
}

fn putting_twice_stores_once(store: &BlobStore) {
    let digest = store.put(b"twice").unwrap();
    assert_eq!(store.put(b"twice").unwrap(), digest);
    assert_eq!(store.list().unwrap().len(), 1);
}

fn what_is_put_again_is_young_again(store: &BlobStore) {
    store.put(b"again").unwrap();
    let first = store.list().unwrap()[0].put_ms;
    std::thread::sleep(std::time::Duration::from_millis(20));
    store.put(b"again").unwrap();
    assert!(store.list().unwrap()[0].put_ms > first);
}

fn what_is_not_there_is_not_found(store: &BlobStore) {
    let digest = Digest::of(b"never put");
    assert!(matches!(store.get(digest), Err(BlobError::NotFound(missing)) if missing == digest));
    assert!(matches!(store.verify(digest), Err(BlobError::NotFound(_))));
    assert!(!store.exists(digest).unwrap());
    assert!(!store.reuse(digest).unwrap());
}

fn a_wrong_name_is_refused(store: &BlobStore) {
    let named = Digest::of(b"other");
    let mut upload = store.begin(5).unwrap();
    upload.write(b"bytes").unwrap();
    assert!(matches!(store.commit(upload, named), Err(BlobError::Corrupt { expected, .. }) if expected == named));
    assert!(store.list().unwrap().is_empty());
}

fn many_threads_put_the_same_and_others(store: &BlobStore) {
    std::thread::scope(|scope| {
        for thread in 0..8_u8 {
            scope.spawn(move || {
                for i in 0..20_u8 {
                    store.put(&[i; 1000]).unwrap();
                    store.put(&[thread, i]).unwrap();
                }
            });
        }
    });
    let all = store.list().unwrap();
    assert_eq!(all.len(), 20 + 8 * 20);
    assert!(all.iter().all(|entry| store.get(entry.digest).is_ok()));
    assert!(store.aside().unwrap().is_empty() && store.strays().unwrap().is_empty());
}

fn a_cut_upload_goes_on(store: &BlobStore) {
    let bytes = vec![3; 100_000];
    let (digest, grant) = (Digest::of(&bytes), common::grant("r/s", 1));
    let total = bytes.len() as u64;
    let mut arriving = store.take_up(&grant, digest, 0, total).unwrap();
    arriving.write(&bytes[..60_000]).unwrap();
    assert!(matches!(store.take_up(&grant, digest, 0, total), Err(ResumeError::Busy)), "one request at a time");
    drop(arriving);
    assert!(!store.exists(digest).unwrap(), "nothing is shown before all of it is there");
    assert_eq!(store.staged(&grant, digest).unwrap(), 60_000);

    // A later fence of the same gang, and another worker.
    let next = common::grant("r/s", 2);
    assert_eq!(store.staged(&next, digest).unwrap(), 60_000);
    let other = protocol::message::Grant { worker: "other".into(), ..grant.clone() };
    assert_eq!(store.staged(&other, digest).unwrap(), 0);

    let wrong = store.take_up(&next, digest, 50_000, total);
    assert!(matches!(wrong, Err(ResumeError::Offset { staged: 60_000, offset: 50_000 })));
    let mut arriving = store.take_up(&next, digest, 60_000, total).unwrap();
    arriving.write(&bytes[60_000..]).unwrap();
    assert!(arriving.finish().unwrap());
    assert_eq!(store.get(digest).unwrap(), bytes);
    assert_eq!(store.staged(&next, digest).unwrap(), 0);
    assert!(store.held().contains(&digest), "until its task is let go");
    store.let_go(IDLE, |_| false);
    assert!(store.held().is_empty());

    // Too many bytes and wrong bytes are refused and deleted.
    let mut arriving = store.take_up(&grant, Digest::of(b"abc"), 0, 3).unwrap();
    assert!(matches!(arriving.write(b"abcd"), Err(BlobError::Refused(_))));
    drop(arriving);
    let mut arriving = store.take_up(&grant, Digest::of(b"abc"), 0, 3).unwrap();
    arriving.write(b"abx").unwrap();
    assert!(matches!(arriving.finish(), Err(BlobError::Corrupt { .. })));
    assert_eq!(store.staged(&grant, Digest::of(b"abc")).unwrap(), 0);
    drop(store.take_up(&grant, Digest::of(b"abc"), 0, 3).unwrap());
    store.let_go(IDLE, |_| false);
    assert!(matches!(store.take_up(&grant, Digest::of(b"abc"), 1, 3), Err(ResumeError::Offset { staged: 0, .. })));
}

fn a_backend_moves_the_time_and_removes(backend: &dyn Backend) {
    let digest = Digest::of(b"x");
    let put = |bytes: &[u8]| {
        let mut staged = backend.stage(bytes.len() as u64).unwrap();
        staged.write(bytes).unwrap();
        staged.commit(digest).unwrap()
    };
    assert!(put(b"x"));
    let first = backend.stat(digest).unwrap().unwrap();
    std::thread::sleep(std::time::Duration::from_millis(20));
    let touched = backend.touch(digest).unwrap();
    assert!(touched.put_ms > first.put_ms);
    assert_eq!(backend.stat(digest).unwrap().unwrap(), touched);

    // An existing name is not overwritten.
    assert!(!put(b"something else"));
    let mut read = String::new();
    backend.read(digest, 0).unwrap().read_to_string(&mut read).unwrap();
    assert_eq!(read, "x");

    backend.put_aside(digest).unwrap();
    assert_eq!((backend.stat(digest).unwrap(), backend.aside().unwrap().len()), (None, 1));
    assert!(put(b"x"));
    backend.remove(digest).unwrap();
    backend.remove(digest).unwrap();
    backend.put_aside(digest).unwrap();
    assert_eq!(backend.stat(digest).unwrap(), None);
    assert!(backend.list().unwrap().is_empty());
    assert_eq!(backend.aside().unwrap().len(), 1);
}

fn a_marker_is_compared_and_set(backend: &dyn Backend) {
    assert_eq!(backend.marker().unwrap(), None);
    assert!(!backend.set_marker(Some("old"), "new").unwrap(), "there is none");
    assert!(backend.set_marker(None, "one").unwrap());
    assert!(!backend.set_marker(None, "two").unwrap(), "a marker is not written over unseen");
    assert!(!backend.set_marker(Some("zero"), "two").unwrap());
    assert_eq!(backend.marker().unwrap().as_deref(), Some("one"));
    assert!(backend.set_marker(Some("one"), "two").unwrap());
    assert_eq!(backend.marker().unwrap().as_deref(), Some("two"));
    assert!(backend.is_empty().unwrap(), "a marker is no blob");
    assert!(backend.strays().unwrap().is_empty() && backend.aside().unwrap().is_empty());
}

/// Not run on the test's server, which checks and writes in two steps.
fn a_marker_is_taken_by_one_of_many(backend: &dyn Backend) {
    assert!(backend.set_marker(None, "two").unwrap());
    let set: usize = std::thread::scope(|scope| {
        let set = |i: usize| usize::from(backend.set_marker(Some("two"), &format!("of thread {i}")).unwrap());
        let threads: Vec<_> = (0..8).map(|i| scope.spawn(move || set(i))).collect();
        threads.into_iter().map(|thread| thread.join().unwrap()).sum()
    });
    assert_eq!(set, 1, "one of eight that take it at once");
}

/// Tests detection and repair. `damage` replaces the bytes of a blob without the store's knowledge.
fn damage_is_noticed_and_mended(store: &BlobStore, damage: &dyn Fn(Digest, &[u8])) {
    let good = vec![5; 3 << 20];
    let digest = store.put(&good).unwrap();
    let mut bad = good.clone();
    bad[1 << 20] ^= 1;
    damage(digest, &bad);

    // Read whole, in parts, and through a manifest; the last part is never returned.
    assert!(matches!(store.get(digest), Err(BlobError::Corrupt { expected, .. }) if expected == digest));
    let mut manifest = Manifest::new(ArtifactKind::Vae, json!({}));
    manifest.files.insert("weights".into(), FileEntry::of_blob(digest, good.len() as u64));
    let manifest = store.put(&manifest.to_bytes()).unwrap();
    assert!(store.complete_manifest(manifest).is_ok(), "lengths say nothing");
    assert!(matches!(store.whole_manifest(manifest), Err(ManifestError::Blob(BlobError::Corrupt { .. }))));
    // Other bytes: a bucket's times have whole seconds, and a blob known to be damaged is not read again.
    bad[1 << 20] ^= 3;
    damage(digest, &bad);
    let mut reader = store.read(digest).unwrap();
    let mut handed_out = 0;
    let error = loop {
        match reader.next_part() {
            Ok(part) => handed_out += part.unwrap().len(),
            Err(error) => break error,
        }
    };
    assert!(matches!(error, BlobError::Corrupt { .. }) && handed_out < good.len(), "{handed_out} {error}");
    assert!(matches!(store.read_from(digest, 10), Err(BlobError::Corrupt { .. })));
    assert!(matches!(Blobs::open(store, digest), Err(BlobError::Corrupt { .. })));

    // The good bytes replace the bad ones, which are kept for inspection.
    store.put(&good).unwrap();
    assert!(store.get(digest).unwrap() == good);
    assert!(store.whole_manifest(manifest).is_ok());
    assert_eq!(store.aside().unwrap().len(), 1);

    // The same for a truncated blob, and for an upload.
    damage(digest, &good[..10]);
    let grant = common::grant("r/s", 1);
    let mut arriving = store.take_up(&grant, digest, 0, good.len() as u64).unwrap();
    arriving.write(&good).unwrap();
    assert!(arriving.finish().unwrap());
    assert!(store.get(digest).unwrap() == good);
    assert_eq!(store.aside().unwrap().len(), 2);
}

fn suite(fresh: &dyn Fn() -> Arc<dyn Backend>) {
    for check in [
        what_was_put_is_read,
        large_blobs_come_and_go_in_parts,
        putting_twice_stores_once,
        what_is_put_again_is_young_again,
        what_is_not_there_is_not_found,
        a_wrong_name_is_refused,
        many_threads_put_the_same_and_others,
        a_cut_upload_goes_on,
    ] {
        check(&BlobStore::over(fresh()));
    }
    a_backend_moves_the_time_and_removes(&*fresh());
    a_marker_is_compared_and_set(&*fresh());
}

#[test]
fn memory() {
    suite(&|| Arc::new(Memory::default()));
    a_marker_is_taken_by_one_of_many(&Memory::default());
    let memory = Arc::new(Memory::default());
    damage_is_noticed_and_mended(&BlobStore::over(memory.clone()), &|digest, bytes| memory.damage(digest, bytes));
}

#[test]
fn folder() {
    let dir = tempfile::tempdir().unwrap();
    let next = std::sync::atomic::AtomicU32::new(0);
    let fresh = || {
        let path = dir.path().join(next.fetch_add(1, std::sync::atomic::Ordering::Relaxed).to_string());
        std::fs::create_dir(&path).unwrap();
        path
    };
    suite(&|| Arc::new(Folder::open(&fresh()).unwrap()));
    a_marker_is_taken_by_one_of_many(&Folder::open(&fresh()).unwrap());
    let path = fresh();
    let store = BlobStore::open_folder(&path).unwrap();
    damage_is_noticed_and_mended(&store, &|digest, bytes| change(&blob_path(&path, digest), bytes));
}

/// Runs the suite over prefixes of an object store.
fn objects(store: &Arc<dyn Bucket>) {
    let dir = tempfile::tempdir().unwrap();
    // All stay open: the client's pooled connections end with the runtime of the place that began them.
    let all: std::sync::Mutex<Vec<Arc<Objects>>> = std::sync::Mutex::default();
    let fresh = || {
        let mut all = all.lock().unwrap();
        let name = format!("p/{}", all.len());
        let remote = Remote::over(&format!("s3://bucket/{name}"), Arc::clone(store)).unwrap();
        let objects = Arc::new(Objects::open(Arc::new(remote), &dir.path().join(&name)).unwrap());
        all.push(Arc::clone(&objects));
        (name, objects)
    };
    suite(&|| fresh().1);
    let (name, backend) = fresh();
    let runtime = tokio::runtime::Runtime::new().unwrap();
    damage_is_noticed_and_mended(&BlobStore::over(backend), &|digest, bytes| {
        let hex = digest.hex();
        let path = format!("{name}/sha256/{}/{}", &hex[..2], &hex[2..]);
        runtime.block_on(store.put(&path.into(), bytes.to_vec().into())).unwrap();
    });
}

#[test]
fn objects_in_memory() {
    let store: Arc<dyn Bucket> = Arc::new(InMemory::new());
    objects(&store);
    let dir = tempfile::tempdir().unwrap();
    let remote = Remote::over("s3://bucket/taken", store).unwrap();
    a_marker_is_taken_by_one_of_many(&Objects::open(Arc::new(remote), dir.path()).unwrap());
}

/// A server that ignores conditions, as some did until recently.
#[derive(Debug)]
struct Careless(InMemory);

impl std::fmt::Display for Careless {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "Careless")
    }
}

#[async_trait::async_trait]
impl ObjectStore for Careless {
    async fn put_opts(
        &self,
        path: &object_store::path::Path,
        payload: PutPayload,
        _: PutOptions,
    ) -> object_store::Result<PutResult> {
        self.0.put(path, payload).await
    }
    async fn put_multipart_opts(
        &self,
        path: &object_store::path::Path,
        options: PutMultipartOptions,
    ) -> object_store::Result<Box<dyn MultipartUpload>> {
        self.0.put_multipart_opts(path, options).await
    }
    async fn get_opts(&self, path: &object_store::path::Path, options: GetOptions) -> object_store::Result<GetResult> {
        self.0.get_opts(path, options).await
    }
    fn delete_stream(
        &self,
        paths: BoxStream<'static, object_store::Result<object_store::path::Path>>,
    ) -> BoxStream<'static, object_store::Result<object_store::path::Path>> {
        self.0.delete_stream(paths)
    }
    fn list(
        &self,
        prefix: Option<&object_store::path::Path>,
    ) -> BoxStream<'static, object_store::Result<object_store::ObjectMeta>> {
        self.0.list(prefix)
    }
    async fn list_with_delimiter(&self, prefix: Option<&object_store::path::Path>) -> object_store::Result<ListResult> {
        self.0.list_with_delimiter(prefix).await
    }
    async fn copy_opts(
        &self,
        from: &object_store::path::Path,
        to: &object_store::path::Path,
        options: CopyOptions,
    ) -> object_store::Result<()> {
        self.0.copy_opts(from, to, options).await
    }
}

#[async_trait::async_trait]
impl MultipartStore for Careless {
    async fn create_multipart(&self, path: &object_store::path::Path) -> object_store::Result<MultipartId> {
        self.0.create_multipart(path).await
    }
    async fn put_part(
        &self,
        path: &object_store::path::Path,
        id: &MultipartId,
        number: usize,
        part: PutPayload,
    ) -> object_store::Result<PartId> {
        self.0.put_part(path, id, number, part).await
    }
    async fn complete_multipart(
        &self,
        path: &object_store::path::Path,
        id: &MultipartId,
        parts: Vec<PartId>,
    ) -> object_store::Result<PutResult> {
        self.0.complete_multipart(path, id, parts).await
    }
    async fn abort_multipart(&self, path: &object_store::path::Path, id: &MultipartId) -> object_store::Result<()> {
        self.0.abort_multipart(path, id).await
    }
}

#[test]
fn a_server_without_conditional_writes_is_refused() {
    let dir = tempfile::tempdir().unwrap();
    let careless: Arc<dyn Bucket> = Arc::new(Careless(InMemory::new()));
    let remote = Remote::over("s3://bucket/p", careless).unwrap();
    let objects = Objects::open(Arc::new(remote), dir.path()).unwrap();
    for old in [None, Some("one")] {
        let refused = objects.set_marker(old, "one").unwrap_err().to_string();
        assert!(refused.contains("s3://bucket/p/IDENTITY") && refused.contains("conditional writes"), "{refused}");
    }
}

fn blob_path(dir: &Path, digest: Digest) -> PathBuf {
    dir.join("blobs/sha256").join(&digest.hex()[..2]).join(&digest.hex()[2..])
}

/// Writes a file until its modification time changes, because a file system's clock may tick slowly.
fn change(path: &Path, bytes: &[u8]) {
    let before = std::fs::metadata(path).unwrap().modified().unwrap();
    while {
        std::fs::write(path, bytes).unwrap();
        std::fs::metadata(path).unwrap().modified().unwrap() == before
    } {}
}

/// Another process continues an upload whose owner still has its task.
#[test]
fn a_folder_goes_on_with_uploads_after_a_restart() {
    let dir = tempfile::tempdir().unwrap();
    let open = || BlobStore::open_folder(dir.path()).unwrap();
    let (bytes, grant) = (vec![7; 3 << 20], common::grant("r/s", 1));
    let (digest, total) = (Digest::of(&bytes), bytes.len() as u64);
    let store = open();
    let mut arriving = store.take_up(&grant, digest, 0, total).unwrap();
    arriving.write(&bytes[..2 << 20]).unwrap();
    // As after `kill -9`: nothing is cleaned up.
    std::mem::forget(arriving);
    let store = open();
    let other = protocol::message::Grant { worker: "other".into(), ..grant.clone() };
    assert_eq!((store.staged(&grant, digest).unwrap(), store.staged(&other, digest).unwrap()), (2 << 20, 0));
    let mut arriving = store.take_up(&grant, digest, 2 << 20, total).unwrap();
    arriving.write(&bytes[2 << 20..]).unwrap();
    assert!(arriving.finish().unwrap());
    drop(store);

    let store = open();
    assert!(store.get(digest).unwrap() == bytes);
    assert!(store.strays().unwrap().is_empty());
    // The received bytes were damaged: the end of the upload detects it and the upload starts again.
    let other = Digest::of(b"another upload");
    store.take_up(&grant, other, 0, 14).unwrap().write(b"another").unwrap();
    let part = std::fs::read_dir(dir.path().join("staging")).unwrap().next().unwrap().unwrap().path();
    std::fs::write(part, b"anothEr").unwrap();
    let store = open();
    let mut arriving = store.take_up(&grant, other, 7, 14).unwrap();
    arriving.write(b" upload").unwrap();
    assert!(matches!(arriving.finish(), Err(BlobError::Corrupt { .. })));
    assert_eq!(store.staged(&grant, other).unwrap(), 0);
    assert!(matches!(store.take_up(&grant, other, 7, 14), Err(ResumeError::Offset { staged: 0, .. })));
}

#[test]
fn uploads_that_nobody_asks_for_after_a_restart_go_in_the_end() {
    let dir = tempfile::tempdir().unwrap();
    let parts = || std::fs::read_dir(dir.path().join("staging")).unwrap().count();
    let (digest, task) = (Digest::of(b"three parts"), |task| common::grant(task, 1));
    let store = BlobStore::open_folder(dir.path()).unwrap();
    for name in ["r/a", "r/b", "r/c"] {
        store.take_up(&task(name), digest, 0, 11).unwrap().write(b"three").unwrap();
    }
    drop(store);
    let store = BlobStore::open_folder(dir.path()).unwrap();
    assert_eq!((parts(), store.staged(&task("r/a"), digest).unwrap()), (3, 5));
    let writing = store.take_up(&task("r/b"), digest, 5, 11).unwrap();
    store.let_go(IDLE, |_| true);
    assert_eq!(parts(), 3, "their holders may still come");
    store.let_go(std::time::Duration::ZERO, |_| true);
    assert_eq!(parts(), 1, "but for the one that a request writes to");
    drop(writing);
    store.let_go(IDLE, |task| task.as_str() != "r/b");
    assert_eq!(parts(), 0);
}

/// The kernel refuses to sync a pipe and the folder of processes, so an error proves that the call was made.
#[cfg(target_os = "linux")]
#[test]
fn p7_syncs_reach_the_operating_system() {
    let (_reader, writer) = std::io::pipe().unwrap();
    let mut pipe: Box<dyn DiskFile> = Box::new(std::fs::File::from(std::os::fd::OwnedFd::from(writer)));
    assert!(pipe.sync().is_err());
    assert!(Os.sync_dir(Path::new("/proc")).is_err());
    let dir = tempfile::tempdir().unwrap();
    Os.create(&dir.path().join("file")).unwrap().sync().unwrap();
    Os.sync_dir(dir.path()).unwrap();
}

/// A verified blob is not hashed again by the next process, unless it was written since.
#[test]
fn a_folder_remembers_what_was_verified() {
    let dir = tempfile::tempdir().unwrap();
    let digest = BlobStore::open_folder(dir.path()).unwrap().put(&[1; 100]).unwrap();
    let path = blob_path(dir.path(), digest);
    let store = BlobStore::open_folder(dir.path()).unwrap();
    // The path is renamed twice, which changes the stamp.
    std::fs::rename(&path, dir.path().join("kept")).unwrap();
    std::fs::rename(dir.path().join("kept"), &path).unwrap();
    let renamed = store.verify(digest).unwrap();
    assert_eq!(renamed.bytes, 100);
    let again = BlobStore::open_folder(dir.path()).unwrap();
    let lines = std::fs::read_to_string(dir.path().join("blobs/verified")).unwrap();
    assert!(lines.contains(&format!("{digest} {}", renamed.stamp)), "{lines}");
    change(&path, &[2; 100]);
    assert!(matches!(again.verify(digest), Err(BlobError::Corrupt { .. })));
}

#[test]
fn a_folder_forgets_what_a_dead_process_staged_and_leaves_strangers_alone() {
    let dir = tempfile::tempdir().unwrap();
    let digest = BlobStore::open_folder(dir.path()).unwrap().put(b"a blob").unwrap();
    let (staging, blobs) = (dir.path().join("staging"), dir.path().join("blobs/sha256"));
    std::fs::write(staging.join("0.part"), b"half a bl").unwrap();
    std::fs::create_dir(staging.join("1.part")).unwrap();
    std::fs::write(staging.join("notes.txt"), b"mine").unwrap();
    std::fs::write(blobs.join("notes.txt"), b"mine").unwrap();
    std::fs::write(blobs.join(&digest.hex()[..2]).join("short"), b"mine").unwrap();
    nix::unistd::mkfifo(&staging.join("pipe"), nix::sys::stat::Mode::S_IRWXU).unwrap();
    symlink("/etc", blobs.join("ff")).unwrap();

    let store = BlobStore::open_folder(dir.path()).unwrap();
    assert!(!staging.join("0.part").exists());
    assert_eq!(store.list().unwrap().iter().map(|entry| entry.digest).collect::<Vec<_>>(), [digest]);
    let strays = store.strays().unwrap();
    assert_eq!(strays.len(), 6, "{strays:?}");
    assert_eq!(store.get(digest).unwrap(), b"a blob");

    // Under a blob's name a link is not followed, a pipe does not block, and neither prevents a put.
    let (piped, linked) = (Digest::of(b"piped"), Digest::of(b"linked"));
    for digest in [piped, linked] {
        std::fs::create_dir_all(blob_path(dir.path(), digest).parent().unwrap()).unwrap();
    }
    nix::unistd::mkfifo(&blob_path(dir.path(), piped), nix::sys::stat::Mode::S_IRWXU).unwrap();
    std::fs::write(dir.path().join("elsewhere"), b"linked").unwrap();
    symlink(dir.path().join("elsewhere"), blob_path(dir.path(), linked)).unwrap();
    for digest in [piped, linked] {
        assert!(matches!(store.get(digest), Err(BlobError::NotFound(_))));
        assert!(!store.exists(digest).unwrap());
    }
    store.put(b"piped").unwrap();
    store.put(b"linked").unwrap();
    assert_eq!((store.get(piped).unwrap(), store.get(linked).unwrap()), (b"piped".to_vec(), b"linked".to_vec()));
    assert_eq!(store.aside().unwrap().len(), 2);

    // A link in place of one of the store's blob folders.
    let (other, away) = ((0..).map(|i: u32| i.to_le_bytes()), dir.path().join("away"));
    std::fs::create_dir(&away).unwrap();
    let free =
        other.map(|bytes| (bytes, Digest::of(&bytes))).find(|(_, digest)| !blobs.join(&digest.hex()[..2]).exists());
    let (bytes, digest) = free.unwrap();
    symlink(&away, blobs.join(&digest.hex()[..2])).unwrap();
    store.put(&bytes).unwrap();
    assert_eq!(store.get(digest).unwrap(), bytes);
    assert!(std::fs::read_dir(&away).unwrap().next().is_none());
}

#[test]
fn what_is_stored_outlives_a_loss_of_power() {
    let dir = tempfile::tempdir().unwrap();
    let power = Power::default();
    let open = || BlobStore::new(Folder::open_on(dir.path(), Arc::new(power.clone())).unwrap());
    let store = open();
    let first = store.put(b"stored").unwrap();
    power.lose();
    let store = {
        drop(store);
        open()
    };
    assert_eq!(store.get(first).unwrap(), b"stored");

    // Written by a process that was killed before its last sync, and put again. The folder was synced before.
    let path = blob_path(dir.path(), Digest::of(b"put again"));
    let _ = std::fs::create_dir(path.parent().unwrap());
    power.ignore_syncs(true);
    let second = store.put(b"put again").unwrap();
    power.ignore_syncs(false);
    store.put(b"put again").unwrap();
    power.lose();
    let store = {
        drop(store);
        open()
    };
    assert_eq!(store.get(second).unwrap(), b"put again");

    // A damaged blob that was put aside does not reappear under its name.
    change(&blob_path(dir.path(), first), b"St0red");
    store.put(b"stored").unwrap();
    power.lose();
    let store = {
        drop(store);
        open()
    };
    assert_eq!(store.get(first).unwrap(), b"stored");
    assert_eq!(store.aside().unwrap().len(), 1);
}
