//! Access to blobs: manifests may name only uploads of their worker and its inputs, which are also all that the worker
//! may read.

use std::collections::BTreeMap;

use protocol::artifact::Chunk;
use protocol::message::CommitCheckpoint;
use protocol::proof::{BlobStored, GRANT_HEADER, PROCESS_HEADER, Process, RECEIPT_HEADER, SECRET_HEADER, Vouched};
use protocol::{ArtifactKind, Digest, FileEntry, Incarnation, Manifest};
use reqwest::Method;

use super::bystanders::{Site, Worker, answer, code, post, token};

const CLIPS: &[u8] = b"clips of another run: a canary";

/// A manifest of one file that mentions these digests.
fn manifest(file: &[u8], mentions: &[Digest]) -> Manifest {
    let mut manifest = Manifest::new(ArtifactKind::Dataset, serde_json::json!({ "parts": mentions }));
    manifest.files.insert("file".into(), FileEntry::of_blob(Digest::of(file), file.len() as u64));
    manifest
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_manifest_names_no_blob_of_another_run() {
    let site = Site::start(60_000).await;
    site.submit(1).await;
    let victim = Worker::join(&site, "nodes", "nodes-1").await;
    let held = victim.given("dataset").await;
    let (foreign, stolen) = victim.artifact(&held, ArtifactKind::Dataset, CLIPS).await;
    site.submit(2).await;
    let thief = Worker::join(&site, "nodes", "nodes-2").await;
    let own = thief.given("dataset").await;

    // The thief knows the names of the victim's blobs and their receipts, but does not have the bytes.
    for receipts in [BTreeMap::new(), stolen.clone()] {
        let refused = thief.finish(&own, foreign, receipts).await;
        assert_eq!(code(&refused), (409, "unvouched"), "{refused:?}");
    }
    let mine = b"clips of mine".as_slice();
    let file = thief.put(&own, mine).await;
    let hidden = manifest(CLIPS, &[]);
    let listed_as_part = {
        let mut manifest = manifest(mine, &[]);
        let (digest, bytes) = (hidden.digest(), hidden.to_bytes().len() as u64);
        manifest.files.insert("vae/manifest.json".into(), FileEntry::of_blob(digest, bytes));
        manifest
    };
    for (what, tried) in [
        ("listed", hidden.clone()),
        ("mentioned", manifest(mine, &[foreign])),
        ("a file mentioned", manifest(mine, &[Digest::of(CLIPS)])),
        ("listed by a manifest that is mentioned", manifest(mine, &[hidden.digest()])),
        ("listed by the manifest of a part", listed_as_part),
    ] {
        let mut receipts = stolen.clone();
        for stored in
            [file.clone(), thief.put(&own, &hidden.to_bytes()).await, thief.put(&own, &tried.to_bytes()).await]
        {
            receipts.insert(stored.digest, stored.receipt.unwrap());
        }
        let refused = thief.finish(&own, tried.digest(), receipts.clone()).await;
        assert_eq!(code(&refused), (409, "unvouched"), "{what}: {refused:?}");
        let (grant, metrics) = (own.grant.clone(), BTreeMap::new());
        let commit = CommitCheckpoint { grant, step: 1, manifest: tried.digest(), metrics };
        let refused = post(&thief.server, &own.secret, "/v1/checkpoints", &Vouched { what: commit, receipts }).await;
        assert_eq!(code(&refused), (409, "unvouched"), "{what}: {refused:?}");
    }
    assert_eq!(thief.holds().await, std::slice::from_ref(&own), "the task is still its own");

    // The victim's blobs seem absent to the thief, although the store has them.
    let staged = thief.server.request(Method::GET, &format!("/v1/blobs/{}/staged", Digest::of(CLIPS)));
    let staged = staged.header(GRANT_HEADER, serde_json::to_string(&own.grant).unwrap());
    let staged = staged.header(SECRET_HEADER, &own.secret).header(RECEIPT_HEADER, &stolen[&Digest::of(CLIPS)]);
    let there: BlobStored = serde_json::from_value(answer(staged).await.1).unwrap();
    assert_eq!((there.stored, there.staged, there.receipt), (false, 0, None));
    // A report that it was sent gives no receipt.
    let sent = thief.server.request(Method::POST, &format!("/v1/blobs/{}/sent", Digest::of(CLIPS)));
    let sent = sent.header(GRANT_HEADER, serde_json::to_string(&own.grant).unwrap()).header(SECRET_HEADER, &own.secret);
    let there: BlobStored = serde_json::from_value(answer(sent).await.1).unwrap();
    assert_eq!((there.stored, there.receipt), (false, None));

    // A worker that has the bytes may upload them as its own.
    let (same, receipts) = thief.artifact(&own, ArtifactKind::Dataset, CLIPS).await;
    assert_eq!(same, foreign);
    assert_eq!(thief.finish(&own, same, receipts).await.0, 200);
    site.handle.shutdown().await;
}

/// A manifest may mention digests that are not blobs, such as that of a dataset's source folder.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_manifest_may_name_blobs_of_inputs_and_digests_of_other_things() {
    let dir = tempfile::tempdir().unwrap();
    let site = Site::of(dir.path(), 60_000).await;
    site.submit(1).await;
    let worker = Worker::join(&site, "nodes", "nodes-1").await;
    let data = worker.given("dataset").await;
    let file = worker.put(&data, CLIPS).await;
    let dataset = manifest(CLIPS, &[Digest::of(b"a folder of this machine")]);
    let stored = worker.put(&data, &dataset.to_bytes()).await;
    let receipts = [file, stored].map(|stored| (stored.digest, stored.receipt.unwrap()));
    let finished = worker.finish(&data, dataset.digest(), receipts.into()).await;
    assert_eq!(finished.0, 200, "{finished:?}");

    let vae = worker.given("vae").await;
    let weights = b"weights".as_slice();
    let file = worker.put(&vae, weights).await;
    let mut saved = manifest(weights, &[dataset.digest()]);
    saved.kind = ArtifactKind::Checkpoint;
    saved.files.insert("clips".into(), FileEntry::of_blob(Digest::of(CLIPS), CLIPS.len() as u64));
    let stored = worker.put(&vae, &saved.to_bytes()).await;
    let receipts: BTreeMap<Digest, String> =
        [file, stored].map(|stored| (stored.digest, stored.receipt.unwrap())).into();
    let (grant, metrics) = (vae.grant.clone(), BTreeMap::new());
    let commit = CommitCheckpoint { grant, step: 5, manifest: saved.digest(), metrics };

    // Receipts stay valid after a restart of the server.
    site.handle.shutdown().await;
    let site = Site::of(dir.path(), 60_000).await;
    let worker = Worker { server: site.server("nodes"), ..worker };
    let vouched = Vouched { what: commit, receipts };
    let committed = post(&worker.server, &vae.secret, "/v1/checkpoints", &vouched).await;
    assert_eq!(committed.0, 200, "{committed:?}");
    assert_eq!(worker.holds().await[0].resume, Some(saved.digest()));
    site.handle.shutdown().await;
}

/// Every chunk of a file needs a receipt like any other blob, and a reader of the artifact may read each.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn chunks_of_a_file_are_blobs_of_its_artifact() {
    let site = Site::start(60_000).await;
    site.submit(1).await;
    let worker = Worker::join(&site, "nodes", "nodes-1").await;
    let data = worker.given("dataset").await;
    let chunks: Vec<Chunk> =
        CLIPS.chunks(10).map(|part| Chunk { digest: Digest::of(part), bytes: part.len() as u64 }).collect();
    let mut dataset = Manifest::new(ArtifactKind::Dataset, serde_json::json!({}));
    let file = FileEntry { digest: Digest::of(CLIPS), bytes: CLIPS.len() as u64, chunks: chunks.clone() };
    dataset.list([("clips".to_owned(), file)]);
    let mut receipts = BTreeMap::new();
    for part in CLIPS.chunks(10).chain([&dataset.to_bytes()[..]]) {
        let stored = worker.put(&data, part).await;
        receipts.insert(stored.digest, stored.receipt.unwrap());
    }
    let mut fewer = receipts.clone();
    fewer.remove(&chunks[1].digest);
    let refused = worker.finish(&data, dataset.digest(), fewer).await;
    assert_eq!(code(&refused), (409, "unvouched"), "{refused:?}");
    assert!(refused.1.to_string().contains(&chunks[1].digest.to_string()), "{refused:?}");
    let finished = worker.finish(&data, dataset.digest(), receipts).await;
    assert_eq!(finished.0, 200, "{finished:?}");

    worker.given("vae").await;
    for chunk in chunks {
        assert_eq!(worker.read(chunk.digest).await, 200, "a chunk of an input");
    }
    assert_eq!(worker.read(Digest::of(CLIPS)).await, 403, "the file is no blob");
    site.handle.shutdown().await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_worker_reads_what_its_task_reads_and_nothing_else() {
    let site = Site::start(60_000).await;
    site.submit(1).await;
    let worker = Worker::join(&site, "nodes", "nodes-1").await;
    let data = worker.given("dataset").await;
    let (dataset, receipts) = worker.artifact(&data, ArtifactKind::Dataset, CLIPS).await;
    assert_eq!(worker.read(dataset).await, 200, "its own upload for a task that it holds");
    assert_eq!(worker.finish(&data, dataset, receipts).await.0, 200);
    let vae = worker.given("vae").await;
    assert_eq!(vae.stage.inputs["dataset"], dataset);
    for digest in [dataset, Digest::of(CLIPS)] {
        assert_eq!(worker.read(digest).await, 200, "an input, and what it lists");
    }

    site.submit(2).await;
    let thief = Worker::join(&site, "nodes", "nodes-2").await;
    thief.given("dataset").await;
    for digest in [dataset, Digest::of(CLIPS)] {
        assert_eq!(thief.read(digest).await, 403);
        let as_the_other = answer(worker.read_request(digest, &thief.secret)).await;
        assert_eq!(code(&as_the_other), (403, "unproven"));
        let with_its_token = Worker { server: site.server("lab"), ..worker.clone() };
        assert_eq!(code(&answer(with_its_token.read_request(digest, &worker.secret)).await), (403, "unproven"));
        let unknown = Process { worker: "nodes-9".into(), incarnation: Incarnation(1) };
        let request = thief.server.request(Method::GET, &format!("/v1/blobs/{digest}"));
        let request = request.header(PROCESS_HEADER, serde_json::to_string(&unknown).unwrap());
        // Not 404, which the sender would take for an answer about the blob.
        assert_eq!(answer(request).await.0, 403);
        let nameless = thief.server.request(Method::GET, &format!("/v1/blobs/{digest}"));
        assert_eq!(answer(nameless).await.0, 400);
    }
    assert_eq!(thief.read(Digest::of(b"nothing")).await, 403, "it is not told what there is");
    let reader = site.server("reader").request(Method::GET, &format!("/v1/blobs/{dataset}"));
    assert_eq!(answer(reader).await.0, 200, "`{}` reads", token("reader"));
    site.handle.shutdown().await;
}
