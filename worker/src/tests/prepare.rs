//! Prefetching of inputs before a task is assigned.

use std::sync::Mutex;

use protocol::Digest;
use protocol::message::{Member, Prepare};

use super::*;

/// Stores an artifact of one file in the fake's store. Returns the digests of its manifest and of the file.
fn artifact(fake: &Fake, bytes: &[u8]) -> (Digest, Digest) {
    let file = Digest::of(bytes);
    let mut manifest = Manifest::new(ArtifactKind::Dataset, serde_json::json!({}));
    let entry = protocol::artifact::FileEntry::of_blob(file, bytes.len() as u64);
    manifest.files.insert("file".to_owned(), entry);
    let blobs = &mut lock(&fake.coordinator).blobs;
    blobs.insert(file, bytes.to_vec());
    blobs.insert(manifest.digest(), manifest.to_bytes());
    (manifest.digest(), file)
}

fn prepare(task: &str, input: Digest, resume: Option<Digest>) -> Prepare {
    Prepare { task: task.into(), inputs: BTreeMap::from([("dataset".to_owned(), input)]), resume, peers: Vec::new() }
}

fn says_ready(coordinator: &FakeState, tasks: &[&str]) -> bool {
    coordinator.last_poll.as_ref().is_some_and(|poll| poll.ready.iter().map(TaskId::as_str).eq(tasks.iter().copied()))
}

#[test]
fn what_a_task_needs_is_fetched_before_it_is_given() {
    let input = Arc::new(Mutex::new(None));
    let read = input.clone();
    let worker = Worker::start(Box::new(move |context| {
        let digest = lock(&read).expect("set before the grant");
        let manifest = context.manifest(digest)?;
        context.blobs().get(manifest.files["file"].digest).expect("there");
        finished(context)
    }));
    let (data, file) = artifact(&worker.fake, b"data");
    let (saved, state) = artifact(&worker.fake, b"state");
    *lock(&input) = Some(data);
    // One part is still missing, and one arrives damaged.
    let held_back = lock(&worker.fake.coordinator).blobs.remove(&state).expect("stored");
    worker.fake.damage.store(1, Ordering::SeqCst);
    worker.fake.desired(|coordinator| coordinator.prepare = vec![prepare("run/stage", data, Some(saved))]);
    worker.wait("the file that is missing", |coordinator| coordinator.fetched.contains(&state));
    assert!(says_ready(&lock(&worker.fake.coordinator), &[]), "not before all is there");
    lock(&worker.fake.coordinator).blobs.insert(state, held_back);
    worker.wait("it to be ready", |coordinator| says_ready(coordinator, &["run/stage"]));
    let fetched = lock(&worker.fake.coordinator).fetched.len();
    assert!(lock(&worker.fake.coordinator).fetched.contains(&file));
    worker.grant(1);
    worker.wait("an outcome", |coordinator| !coordinator.outcomes.is_empty());
    worker.fake.desired(|coordinator| coordinator.prepare.clear());
    worker.wait("it to be forgotten", |coordinator| says_ready(coordinator, &[]));
    let coordinator = worker.leave();
    assert_eq!(coordinator.fetched.len(), fetched, "the stage fetches nothing");
    assert!(matches!(coordinator.outcomes[0].outcome, TaskOutcome::Finished { .. }), "{:?}", coordinator.outcomes);
}

/// A damaged input does not delay a task for ever: the task counts as ready, and its attempt reports the damage.
#[test]
fn a_damaged_input_does_not_keep_a_task_from_being_given() {
    let worker = Worker::start(Box::new(finished));
    worker.fake.rotten.store(true, Ordering::SeqCst);
    let (data, _) = artifact(&worker.fake, b"data");
    worker.fake.desired(|coordinator| coordinator.prepare = vec![prepare("run/stage", data, None)]);
    worker.wait("it to be taken as it is", |coordinator| says_ready(coordinator, &["run/stage"]));
    worker.leave();
}

#[test]
fn fetching_ahead_stops_when_the_task_is_another_s_and_when_the_worker_leaves() {
    let worker = Worker::start(Box::new(finished));
    let (first, _) = artifact(&worker.fake, b"first");
    let (second, _) = artifact(&worker.fake, b"second");
    worker.fake.stuck.store(true, Ordering::SeqCst);
    worker.fake.desired(|coordinator| coordinator.prepare = vec![prepare("run/a", first, None)]);
    worker.wait("a download that hangs", |coordinator| coordinator.fetched == [first]);
    worker.fake.stuck.store(false, Ordering::SeqCst);
    worker.fake.desired(|coordinator| coordinator.prepare = vec![prepare("run/b", second, None)]);
    worker.wait("the other one", |coordinator| says_ready(coordinator, &["run/b"]));
    worker.fake.stuck.store(true, Ordering::SeqCst);
    worker.fake.desired(|coordinator| coordinator.prepare = vec![prepare("run/a", first, None)]);
    worker.wait("the first one again", |coordinator| coordinator.fetched.iter().filter(|d| **d == first).count() == 2);
    let begun = Instant::now();
    worker.leave();
    assert!(begun.elapsed() < Duration::from_secs(5), "it waited for the download");
}

/// A member that refuses connections. The gang does not see a joiner that could not take part, and other tasks are
/// prepared meanwhile.
#[test]
fn a_task_is_ready_only_once_its_members_answer() {
    let worker = Worker::start(Box::new(finished));
    let (data, _) = artifact(&worker.fake, b"data");
    let closed = std::net::TcpListener::bind("127.0.0.1:0").expect("a free port").local_addr().expect("bound");
    let member = |address: std::net::SocketAddr| Member {
        worker: "holder".into(),
        incarnation: protocol::Incarnation(1),
        peer_address: address.to_string(),
    };
    let joined = |address| Prepare { peers: vec![member(address)], ..prepare("run/gang", data, None) };
    worker.fake.desired(|coordinator| coordinator.prepare = vec![joined(closed), prepare("run/other", data, None)]);
    worker.wait("the other one", |coordinator| says_ready(coordinator, &["run/other"]));
    // The member comes back at the same address.
    let timing = crate::gang::member::Timing::default();
    let _endpoint = crate::gang::endpoint::Endpoint::open(closed, timing).expect("free again");
    worker.wait("both", |coordinator| says_ready(coordinator, &["run/other", "run/gang"]));
    worker.leave();
}
