//! Tests of files that are stored in several blobs: proof, collection, backup, bundles and damage.
#![allow(clippy::unwrap_used, reason = "a test may panic")]

mod common;

use std::collections::BTreeSet;
use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;

use checkpoint::file;
use common::{fence, grant, metrics, open, run_in};
use protocol::stage::Keep;
use protocol::{ArtifactKind, Digest, FileEntry, Manifest, TaskId, limits};
use registry::backup::restore;
use registry::bundle::{self, BundleError};
use registry::testing::{Whole, archive, compressed, regular};
use registry::{BlobStore, Store, Write};
use serde_json::json;

const CHUNK: u64 = 1000;

/// A sparse file: zeros with some bytes of its own in each chunk.
fn sparse(name: u8, chunks: usize) -> Vec<u8> {
    let mut bytes = vec![0; chunks * CHUNK as usize - 1];
    for at in 0..chunks {
        bytes[at * CHUNK as usize] = name;
        bytes[at * CHUNK as usize + 1] = at as u8;
    }
    bytes
}

/// A checkpoint of three files. The first one changes with each step.
fn put_checkpoint(blobs: &BlobStore, step: u8) -> (Digest, Manifest) {
    let mut manifest = Manifest::new(ArtifactKind::Checkpoint, json!({}));
    for (name, bytes) in [("state", sparse(step, 5)), ("frozen", sparse(255, 3)), ("small", vec![1; 10])] {
        let entry = file::put(blobs, &[&bytes[..7], &bytes[7..]], CHUNK).unwrap();
        manifest.list([(name.to_owned(), entry)]);
    }
    (blobs.put(&manifest.to_bytes()).unwrap(), manifest)
}

async fn save(store: &Store, step: u8) -> (Digest, Manifest) {
    let (digest, manifest) = put_checkpoint(store.blobs(), step);
    let write =
        Write::Checkpoint { grant: grant("r/s", 1), step: step.into(), manifest: digest, metrics: metrics(&[]) };
    store.write(vec![write]).await.unwrap();
    (digest, manifest)
}

fn path(dir: &Path, digest: Digest) -> PathBuf {
    checkpoint::blob_path(dir, digest)
}

/// Changes a byte of a stored blob.
fn damage(dir: &Path, digest: Digest) {
    let path = path(dir, digest);
    let mut bytes = fs::read(&path).unwrap();
    bytes[1] ^= 1;
    fs::remove_file(&path).unwrap();
    fs::write(&path, bytes).unwrap();
}

#[tokio::test]
async fn a_collection_keeps_the_chunks_of_kept_checkpoints_and_frees_the_others() {
    let dir = tempfile::tempdir().unwrap();
    let store = open(dir.path()).await;
    store.write(vec![run_in("running"), fence("r/s", 1)]).await.unwrap();
    let (_, first) = save(&store, 1).await;
    let (_, second) = save(&store, 2).await;
    assert_eq!(first.files["frozen"], second.files["frozen"]);
    // 5 and 3 chunks, a small file and a manifest; the second shares the frozen and the small file.
    assert_eq!(store.blobs().list().unwrap().len(), 10 + 6);
    assert!(store.gc(-1000).await.unwrap().remove.is_empty());
    let task = TaskId::new("r/s");
    store.prune_checkpoints(&task, Keep { latest: 1, ..Keep::default() }, false).await.unwrap();
    let removed: BTreeSet<Digest> = store.gc(-1000).await.unwrap().remove.into_iter().collect();
    let expected = first.files["state"].blobs().map(|blob| blob.digest).chain([first.digest()]);
    assert_eq!(removed, expected.collect());
    assert_eq!(store.fsck().await.unwrap().problems, [""; 0]);
    for (name, bytes) in [("state", sparse(2, 5)), ("frozen", sparse(255, 3)), ("small", vec![1; 10])] {
        assert_eq!(*file::get(store.blobs(), &second.files[name]).unwrap(), *bytes, "{name}");
    }
}

/// A checkpoint whose chunk is missing is not committed, and the message names the chunk and its file.
#[tokio::test]
async fn an_artifact_without_a_chunk_is_not_named() {
    let dir = tempfile::tempdir().unwrap();
    let store = open(dir.path()).await;
    store.write(vec![run_in("running"), fence("r/s", 1)]).await.unwrap();
    let mut manifest = Manifest::new(ArtifactKind::Checkpoint, json!({}));
    let elsewhere = BlobStore::in_memory();
    let entry = file::put(&elsewhere, &[&sparse(1, 3)], CHUNK).unwrap();
    for at in [0, 2] {
        store.blobs().put(&elsewhere.get(entry.chunks[at].digest).unwrap()).unwrap();
    }
    // The whole file as one blob is no substitute.
    store.blobs().put(&sparse(1, 3)).unwrap();
    let missing = entry.chunks[1].digest;
    manifest.list([("state".to_owned(), entry)]);
    let digest = store.blobs().put(&manifest.to_bytes()).unwrap();
    let commit = || Write::Checkpoint { grant: grant("r/s", 1), step: 1, manifest: digest, metrics: metrics(&[]) };
    let refused = store.write(vec![commit()]).await.unwrap_err().to_string();
    assert!(refused.contains(&format!("chunk 2 of 3 of `state` as blob {missing}")), "{refused}");
    store.blobs().put(&elsewhere.get(missing).unwrap()).unwrap();
    store.write(vec![commit()]).await.unwrap();
}

#[tokio::test]
async fn a_backup_has_all_chunks_and_is_restored() {
    let root = tempfile::tempdir().unwrap();
    let (dir, backup, back) = (root.path().join("store"), root.path().join("backup"), root.path().join("back"));
    let store = open(&dir).await;
    store.write(vec![run_in("running"), fence("r/s", 1)]).await.unwrap();
    let (digest, manifest) = save(&store, 1).await;
    store.blobs().put(b"nobody needs this").unwrap();
    assert_eq!(store.backup(&backup).await.unwrap().blobs, 10);
    restore(&backup, &back, None).await.unwrap();
    let copy = open(&back).await;
    assert_eq!(copy.blobs().whole_manifest(digest).unwrap(), manifest);
    assert_eq!(*file::get(copy.blobs(), &manifest.files["state"]).unwrap(), *sparse(1, 5));

    let chunk = manifest.files["state"].chunks[3].digest;
    damage(&backup, chunk);
    let refused = restore(&backup, &root.path().join("other"), None).await.unwrap_err().to_string();
    assert!(refused.contains(&chunk.to_string()), "{refused}");
}

#[tokio::test]
async fn a_damaged_chunk_is_found_and_named() {
    let dir = tempfile::tempdir().unwrap();
    let store = open(dir.path()).await;
    store.write(vec![run_in("running"), fence("r/s", 1)]).await.unwrap();
    let (digest, manifest) = save(&store, 1).await;
    let chunk = manifest.files["state"].chunks[3].digest;
    damage(dir.path(), chunk);
    let problems = store.fsck().await.unwrap().problems;
    assert_eq!(problems.len(), 1, "{problems:?}");
    assert!(problems[0].contains(&format!("blob {chunk} is corrupt")), "{problems:?}");
    let flaw = store.blobs().flaw(digest).unwrap().expect("a flaw").to_string();
    assert!(flaw.contains(&chunk.to_string()), "{flaw}");
    let refused = file::open(store.blobs(), &manifest.files["state"]).unwrap_err().to_string();
    assert!(refused.contains(&chunk.to_string()), "{refused}");
    // The same bytes repair it.
    put_checkpoint(store.blobs(), 1);
    assert_eq!(store.fsck().await.unwrap().problems, [""; 0]);
}

/// A bundle has the file as one entry. The import stores its chunks, and the export joins them again.
#[tokio::test]
async fn a_version_with_chunks_goes_through_a_bundle() {
    let root = tempfile::tempdir().unwrap();
    let weights = sparse(9, 200);
    let whole = Whole::in_chunks(weights.clone(), 70_001);
    assert_eq!(whole.manifest.format, 2);
    let bytes = compressed(&archive(&whole.entries()));
    let file = root.path().join("in.tar.zst");
    fs::write(&file, &bytes).unwrap();
    let dir = root.path().join("store");
    let store = open(&dir).await;
    let imported = store.import_bundle(&file, None).await.unwrap();
    let manifest = store.blobs().whole_manifest(imported.artifact).unwrap();
    let entry = &manifest.files["vae/model.safetensors"];
    assert_eq!((entry.chunks.len(), store.blobs().exists(entry.digest).unwrap()), (3, false));
    assert_eq!(*file::get(store.blobs(), entry).unwrap(), *weights);
    drop(store);

    let registry = |args: &[&str]| {
        let mut command = Command::new(env!("CARGO_BIN_EXE_registry"));
        let out = command.args(args).arg("--store").arg(&dir).env_remove("STRIDE_SERVER").output().unwrap();
        assert!(out.status.success(), "{args:?}: {}", String::from_utf8_lossy(&out.stderr));
    };
    let out = root.path().join("out.tar.zst");
    registry(&["export", "quick:1", "-o", out.to_str().unwrap()]);
    assert_eq!(bundle::read(&fs::read(&out).unwrap()[..], &mut ()).unwrap().manifest, whole.manifest);
    let folder = root.path().join("folder");
    registry(&["export", "quick:1", folder.to_str().unwrap()]);
    assert!(fs::read(folder.join("vae/model.safetensors")).unwrap() == weights);
}

/// Chunks that are each whole but do not form the file, and a chunk with other bytes.
#[test]
fn a_bundle_with_wrong_chunks_is_refused() {
    let weights = sparse(9, 3);
    let right = Whole::in_chunks(weights.clone(), CHUNK as usize);
    assert!(bundle::read(&compressed(&archive(&right.entries()))[..], &mut ()).is_ok());
    let at = right.entries().iter().position(|entry| entry.0 == "vae/model.safetensors").unwrap();
    for (name, expected) in [(0, "its bytes hash to"), (1, "its bytes hash to"), (2, "bytes together")] {
        let mut wrong = Whole::in_chunks(weights.clone(), CHUNK as usize);
        let mut entries = wrong.entries();
        let entry = wrong.manifest.files.get_mut("vae/model.safetensors").unwrap();
        match name {
            0 => entries[at].2[1500] ^= 1,
            1 => {
                entry.chunks.swap(0, 1);
                let (first, second) = entries[at].2[..2000].split_at_mut(1000);
                first.swap_with_slice(second);
            }
            _ => entry.chunks[0].bytes -= 1,
        }
        let head = bundle::Head { artifact: wrong.manifest.digest(), ..wrong.head.clone() };
        entries[0] = regular("bundle.json", serde_json::to_vec(&head).unwrap());
        entries[1].2 = wrong.manifest.to_bytes();
        let refused = bundle::read(&compressed(&archive(&entries))[..], &mut ()).unwrap_err();
        assert!(refused.to_string().contains(expected), "{name}: {refused}");
        assert!(matches!(refused, BundleError::Entry { .. }), "{refused:?}");
    }
}

/// Resident memory of this process in bytes.
fn resident() -> u64 {
    let status = fs::read_to_string("/proc/self/status").unwrap();
    let line = status.lines().find_map(|line| line.strip_prefix("VmRSS:")).unwrap();
    line.trim().trim_end_matches(" kB").trim().parse::<u64>().unwrap() << 10
}

/// A file above the limit of earlier builds, with the real chunks. It writes 12 GiB.
#[test]
#[ignore = "it writes 12 GiB; `.ci/nightly large` runs it"]
fn a_file_of_twelve_gib_is_stored_and_read() {
    const PIECE: usize = 64 << 20;
    let dir = tempfile::tempdir().unwrap();
    let blobs = BlobStore::open_folder(dir.path()).unwrap();
    let zeros = vec![0; PIECE - 8];
    let numbers: Vec<[u8; 8]> = (0..192_u64).map(u64::to_le_bytes).collect();
    let pieces: Vec<&[u8]> = numbers.iter().flat_map(|number| [&number[..], &zeros[..]]).collect();
    let before = resident();
    let entry: FileEntry = file::put(&blobs, &pieces, limits::CHUNK_BYTES).unwrap();
    assert_eq!((entry.bytes, entry.chunks.len()), (12 << 30, 12));
    assert!(entry.bytes > limits::BLOB_BYTES as u64);
    assert_eq!(blobs.list().unwrap().len(), 12, "each chunk has its own numbers");
    let mut manifest = Manifest::new(ArtifactKind::Checkpoint, json!({}));
    manifest.list([("state".to_owned(), entry.clone())]);
    let digest = blobs.put(&manifest.to_bytes()).unwrap();
    assert_eq!(blobs.whole_manifest(digest).unwrap(), manifest);

    let opened = file::open(&blobs, &entry).unwrap();
    let mut number = [0; 8];
    for (at, expected) in numbers.iter().enumerate() {
        opened.read_at((at * PIECE) as u64, &mut number).unwrap();
        assert_eq!(number, *expected, "{at}");
    }
    let grown = resident().saturating_sub(before);
    assert!(grown < 64 << 20, "memory grew by {grown} bytes");

    let reopened = BlobStore::open_folder(dir.path()).unwrap();
    let chunk = entry.chunks[7].digest;
    let file = fs::OpenOptions::new().write(true).open(path(dir.path(), chunk)).unwrap();
    std::os::unix::fs::FileExt::write_all_at(&file, &[1], 1 << 29).unwrap();
    drop(file);
    let refused = reopened.check(chunk).unwrap_err().to_string();
    assert!(refused.contains(&chunk.to_string()), "{refused}");
}
