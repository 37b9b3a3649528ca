//! Every worker call by every kind of caller, on its own, another worker's and a finished task. The calls come from the
//! server's table, so a new call that is missing here fails the test.

use std::collections::BTreeMap;

use access::{Scope, Server};
use coordinator::shell::routes;
use protocol::ArtifactKind;
use protocol::Digest;
use protocol::message::{
    Assignment, CommitCheckpoint, Gone, LogBatch, MetricBatch, MetricRow, ReportOutcome, TaskOutcome,
};
use protocol::proof::{GRANT_HEADER, PROCESS_HEADER, SECRET_HEADER};
use reqwest::{Method, RequestBuilder};

use crate::front::Protocol;

use super::bystanders::{Site, TOKENS, Worker, answer, join_of};

/// A task with its current or former holder.
struct Object {
    what: &'static str,
    worker: Worker,
    assignment: Assignment,
    blob: Digest,
}

/// A caller: a token, and the secrets that it can show for an object.
struct Actor {
    what: String,
    server: Server,
    /// Secrets of its process and grant. They are the object's own if the caller is its worker or has stolen them.
    process: String,
    grant: String,
}

fn request(server: &Server, method: &str, path: &str, object: &Object, actor: &Actor) -> RequestBuilder {
    let grant = object.assignment.grant.clone();
    let (manifest, metrics) = (object.blob, BTreeMap::new());
    let path = path.replace("{worker}", &object.worker.name).replace("{digest}", &object.blob.to_string());
    let ask = |method| server.request(method, &path);
    let (process, own) = (actor.process.as_str(), actor.grant.as_str());
    match (method, path.as_str()) {
        ("POST", "/v1/workers") => ask(Method::POST).header(SECRET_HEADER, process).json(&join_of(&object.worker.name)),
        ("POST", path) if path.ends_with("/poll") => {
            ask(Method::POST).header(SECRET_HEADER, process).json(&object.worker.poll_of(vec![], 0))
        }
        ("POST", path) if path.ends_with("/gone") => {
            let gone = Gone { incarnation: object.worker.process.incarnation };
            ask(Method::POST).header(SECRET_HEADER, process).json(&gone)
        }
        ("POST", "/v1/metrics") => {
            let rows = vec![MetricRow { step: 1, key: "matrix".into(), value: 1.0 }];
            ask(Method::POST).header(SECRET_HEADER, own).json(&MetricBatch { grant, rows })
        }
        ("POST", "/v1/logs") => {
            let lines = vec!["matrix".into()];
            ask(Method::POST).header(SECRET_HEADER, own).json(&LogBatch { grant, first: 0, lines })
        }
        ("POST", "/v1/checkpoints") => {
            let commit = CommitCheckpoint { grant, step: 1, manifest, metrics };
            ask(Method::POST).header(SECRET_HEADER, own).json(&commit)
        }
        ("POST", "/v1/outcomes") => {
            let report = ReportOutcome::new(grant, TaskOutcome::Finished { output: manifest, metrics });
            ask(Method::POST).header(SECRET_HEADER, own).json(&report)
        }
        ("PUT", _) => {
            let grant = serde_json::to_string(&grant).unwrap();
            ask(Method::PUT).header(GRANT_HEADER, grant).header(SECRET_HEADER, own).body("matrix")
        }
        ("GET" | "POST", path) if path.ends_with("/staged") || path.ends_with("/sent") => {
            let grant = serde_json::to_string(&grant).unwrap();
            let method = if method == "GET" { Method::GET } else { Method::POST };
            ask(method).header(GRANT_HEADER, grant).header(SECRET_HEADER, own)
        }
        ("GET", path) if path.starts_with("/v1/blobs/") => {
            let header = serde_json::to_string(&object.worker.process).unwrap();
            ask(Method::GET).header(PROCESS_HEADER, header).header(SECRET_HEADER, process)
        }
        other => panic!("{other:?} is a call of workers: say here how it is made"),
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn every_call_of_workers_is_open_to_the_tasks_own_process_alone() {
    every_call(Protocol::Http1).await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn every_call_of_workers_over_http2_is_open_to_the_tasks_own_process_alone() {
    every_call(Protocol::Http2).await;
}

async fn every_call(protocol: Protocol) {
    let site = Site::over(protocol, 600_000).await;
    let run = site.submit(1).await;
    let worker = Worker::join(&site, "nodes", "nodes-1").await;
    let data = worker.given("dataset").await;
    let (dataset, receipts) = worker.artifact(&data, ArtifactKind::Dataset, b"clips").await;
    assert_eq!(worker.finish(&data, dataset, receipts).await.0, 200);
    let vae = worker.given("vae").await;
    let held = Object { what: "a held task", worker: worker.clone(), assignment: vae.clone(), blob: dataset };
    let finished = Object { what: "a finished task", worker: worker.clone(), assignment: data, blob: dataset };
    site.submit(2).await;
    let thief = Worker::join(&site, "nodes", "nodes-2").await;
    let of_thief = thief.given("dataset").await;

    let mut actors: Vec<Actor> = TOKENS
        .iter()
        .map(|(name, ..)| Actor {
            what: format!("`{name}` with the worker's own secrets, stolen"),
            server: site.server(name),
            process: worker.secret.clone(),
            grant: vae.secret.clone(),
        })
        .filter(|actor| !actor.what.starts_with("`nodes`"))
        .collect();
    let (server, process) = (thief.server.clone(), thief.secret.clone());
    actors.push(Actor { what: "another process of its token".into(), server, process, grant: of_thief.secret.clone() });

    let before = site.view(&run).await;
    let state = |site: &Site| serde_json::to_value(site.handle.workers()).unwrap();
    let workers = state(&site);
    let mut tried = 0;
    for route in routes().into_iter().filter(|route| route.scopes.contains(&Scope::Worker)) {
        for object in [&held, &finished] {
            for actor in &actors {
                let (status, answer) = answer(request(&actor.server, route.method, route.path, object, actor)).await;
                let shown =
                    format!("{} {} on {} by {}: {status} {answer}", route.method, route.path, object.what, actor.what);
                // A caller with the scope `read` may read everything.
                let reads = route.scopes.contains(&Scope::Read) && !actor.what.starts_with("`lab`");
                let reads = reads && !actor.what.starts_with("another process");
                // Another process may take over its own token's name later; other callers are never admitted.
                let expected: &[u16] = match (route.path, reads) {
                    (_, true) => &[200],
                    ("/v1/workers", _) => &[403, 409],
                    _ => &[403],
                };
                assert!(expected.contains(&status), "{shown}");
                tried += 1;
            }
        }
    }
    println!("{tried} calls by {} callers on two tasks", actors.len());
    assert_eq!(before, site.view(&run).await);
    assert_eq!(workers, state(&site));
    assert_eq!(worker.holds().await, std::slice::from_ref(&vae));

    // The same calls by the task's own process: all pass the check of identity. The last call leaves.
    let own = Actor { what: "itself".into(), server: worker.server.clone(), process: worker.secret, grant: vae.secret };
    let mut calls: Vec<_> = routes().into_iter().filter(|route| route.scopes.contains(&Scope::Worker)).collect();
    calls.sort_by_key(|route| {
        let ends = route.path.ends_with("/gone");
        (ends, route.path == "/v1/workers", route.path == "/v1/outcomes")
    });
    for route in calls {
        let (status, answer) = answer(request(&own.server, route.method, route.path, &held, &own)).await;
        assert!(status != 403 && status != 401, "{} {}: {status} {answer}", route.method, route.path);
    }
    site.handle.shutdown().await;
}
