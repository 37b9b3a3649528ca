//! Ownership of worker names by tokens and processes.

use std::time::{Duration, Instant};

use protocol::message::Gone;

use super::bystanders::{LEASE_MS, Site, Worker, code, join_of, post};

const OTHER: &str = "the-secret-of-another-process-of-the-same-token";

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_live_workers_name_is_taken_by_no_other_token_and_by_no_other_process() {
    let site = Site::start(60_000).await;
    site.submit(1).await;
    let worker = Worker::join(&site, "nodes", "nodes-1").await;
    let held = worker.given("dataset").await;
    for (token, secret, expected) in [
        ("lab", OTHER, (403, "forbidden")),
        // A stolen secret is useless with another token.
        ("lab", &worker.secret, (403, "forbidden")),
        ("admin", &worker.secret, (403, "forbidden")),
        ("nodes", OTHER, (409, "name-held")),
        ("nodes", "", (400, "invalid")),
    ] {
        let refused = post(&site.server(token), secret, "/v1/workers", &join_of("nodes-1")).await;
        assert_eq!(code(&refused), expected, "{token}: {refused:?}");
    }
    assert_eq!(worker.holds().await, [held], "it holds what it held");
    // A repeated join of the same process, after a lost answer, is accepted: it shows the same secret.
    let again = post(&worker.server, &worker.secret, "/v1/workers", &join_of("nodes-1")).await;
    assert_eq!(again.0, 200, "{again:?}");
    assert_eq!(worker.try_poll().await.0, 409, "by its old incarnation it is another process");
    site.handle.shutdown().await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_token_names_its_workers_by_its_pattern() {
    let site = Site::start(60_000).await;
    let refused = post(&site.server("nodes"), OTHER, "/v1/workers", &join_of("lab-1")).await;
    assert_eq!(code(&refused), (403, "forbidden"));
    assert!(refused.1["detail"].as_str().unwrap().contains("`nodes-*`, not `lab-1`"), "{refused:?}");
    assert!(site.handle.workers().is_empty());
    Worker::join(&site, "lab", "lab-1").await;
    site.handle.shutdown().await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_name_passes_on_once_its_process_has_left_and_only_within_its_token() {
    let site = Site::start(60_000).await;
    let worker = Worker::join(&site, "nodes", "nodes-1").await;
    let bystander = Worker::join(&site, "nodes", "nodes-2").await;
    let gone = Gone { incarnation: worker.process.incarnation };
    for (server, secret) in [
        (&bystander.server, &bystander.secret),
        (&site.server("lab"), &worker.secret),
        (&site.server("admin"), &worker.secret),
    ] {
        let refused = post(server, secret, "/v1/workers/nodes-1/gone", &gone).await;
        assert_eq!(code(&refused), (403, "unproven"), "{refused:?}");
    }
    assert_eq!(worker.try_poll().await.0, 200, "it has not left");
    assert_eq!(post(&worker.server, &worker.secret, "/v1/workers/nodes-1/gone", &gone).await.0, 200);
    let refused = post(&site.server("lab"), OTHER, "/v1/workers", &join_of("nodes-1")).await;
    assert_eq!(code(&refused), (403, "forbidden"), "the name stays with its token");
    assert_eq!(post(&worker.server, OTHER, "/v1/workers", &join_of("nodes-1")).await.0, 200);
    site.handle.shutdown().await;
}

/// A killed worker that returns under its name waits for its old lease to expire, and no longer.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_name_passes_on_when_the_lease_of_its_process_ends() {
    let site = Site::start(LEASE_MS).await;
    let worker = Worker::join(&site, "nodes", "nodes-1").await;
    let begun = Instant::now();
    loop {
        let answer = post(&worker.server, OTHER, "/v1/workers", &join_of("nodes-1")).await;
        if answer.0 == 200 {
            break;
        }
        assert_eq!(code(&answer), (409, "name-held"), "{answer:?}");
        tokio::time::sleep(Duration::from_millis(20)).await;
    }
    let waited = begun.elapsed();
    println!("a name was free {waited:.1?} after its process was last heard of; its lease is {LEASE_MS} ms");
    assert!(waited > Duration::from_millis(LEASE_MS / 2), "not before: {waited:?}");
    assert_eq!(worker.try_poll().await.0, 409, "the old process is told so");
    site.handle.shutdown().await;
}

/// `trainer run` observes the exit of its workers' processes.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_name_is_free_at_once_when_the_launcher_saw_its_process_end() {
    let site = Site::start(60_000).await;
    let worker = Worker::join(&site, "nodes", "nodes-1").await;
    site.handle.worker_gone(&"nodes-1".into()).await.unwrap();
    assert_eq!(post(&worker.server, OTHER, "/v1/workers", &join_of("nodes-1")).await.0, 200);
    site.handle.shutdown().await;
}
