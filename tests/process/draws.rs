//! Draws through a real server and worker: `POST /v1/draws` of a model that was trained and registered here.

use std::path::Path;

use cluster_tests::cluster::{Cluster, WORKER_TOKEN, stage_of};
use cluster_tests::{Bench, wait_for};
use serde_json::{Value, json};

const TRAINER: &str = env!("CARGO_BIN_EXE_trainer");

/// Draws, and waits for the end of the run.
#[track_caller]
fn draw(cluster: &Cluster, asked: &Value) -> Value {
    let reply = cluster.post("/v1/draws", asked).expect("an answer");
    assert_eq!(reply.status, 200, "{}", reply.body);
    let run = cluster.wait_end(reply.body["run"].as_str().expect("a run"));
    assert_eq!(run["state"], "finished", "{run}\n{}", cluster.everything());
    run
}

fn blob(cluster: &Cluster, digest: &Value) -> Value {
    cluster.get(&format!("/v1/blobs/{}", digest.as_str().expect("a digest"))).expect("a stored blob")
}

#[test]
fn a_worker_draws_with_a_registered_model() {
    let mut cluster = Cluster::start(TRAINER);
    cluster.join("a");
    let kept = ["--set", "stages.mld.checkpoint.keep={latest: 3, ended: 3}"];
    let trained = cluster.submit(Path::new(&Bench::config("smoke.yaml")), &kept);
    let ended = cluster.wait_end(&trained);
    assert_eq!(ended["state"], "finished");

    let asked = json!({
        "models": ["smoke@staging", "smoke:1"], "sentences": ["a person walks", "a person <b>jumps</b>"], "count": 2,
        "seconds": 2.5, "seed": 7,
    });
    let run = draw(&cluster, &asked);
    let mut names = Vec::new();
    for stage in ["m-smoke-staging", "m-smoke-1"] {
        let stage = stage_of(&run, stage);
        assert!(stage["metrics"]["jerk"].as_f64().is_some_and(f64::is_finite), "{stage}");
        let manifest = blob(&cluster, &stage["outputs"]["report"]);
        let motions = blob(&cluster, &manifest["files"]["motions.json"]["digest"]);
        let said = ["a person walks", "a person walks", "a person <b>jumps</b>", "a person <b>jumps</b>"];
        assert_eq!(motions["captions"], json!(said));
        let drawn = motions["motions"].as_array().expect("a list");
        assert!(drawn.len() == 4 && drawn.iter().all(|motion| motion["frames"] == 50), "{drawn:?}");
        for file in ["motion-03.npy", "motion-03.bvh", "motion-03.glb", "motions.gif", "motions.html"] {
            assert!(manifest["files"][file]["bytes"].as_u64() > Some(1_000), "{file}");
        }
        names.push(stage["outputs"]["report"].clone());
    }

    // The same draw is answered from the store, under the same digests.
    let again = draw(&cluster, &asked);
    for (stage, report) in ["m-smoke-staging", "m-smoke-1"].into_iter().zip(&names) {
        let stage = stage_of(&again, stage);
        assert_eq!((&stage["state"], &stage["outputs"]["report"]), (&json!("cached"), report), "{stage}");
    }
    let mut seeded = asked.clone();
    seeded["seed"] = json!(8);
    let seeded = stage_of(&draw(&cluster, &seeded), "m-smoke-1");
    assert!(seeded["state"] == "ran" && seeded["outputs"]["report"] != names[1], "{seeded}");

    // So do checkpoints. That of the last step gives the model of the training.
    let kept = cluster.get(&format!("/v1/runs/{trained}/checkpoints")).expect("a list");
    let kept = kept.as_array().expect("a list").iter().filter(|kept| kept["stage"] == "mld");
    let steps: Vec<u64> = kept.filter_map(|kept| kept["step"].as_u64().filter(|_| kept["draws"] == true)).collect();
    assert_eq!(steps, [10, 15, 16]);
    let named = |step: &u64| json!({"run": trained, "stage": "mld", "step": step});
    let checkpoints: Vec<Value> = steps[1..].iter().map(named).collect();
    let by_step = json!({"checkpoints": checkpoints, "sentences": ["a person walks"], "steps": 2, "seconds": 2.0});
    let run = draw(&cluster, &by_step);
    assert_eq!(stage_of(&run, "c-mld-16")["outputs"]["model"], stage_of(&ended, "mld")["outputs"]["model"], "{run}");
    let report = |step: u64| stage_of(&run, &format!("m-mld-{step}"))["outputs"]["report"].clone();
    assert!(report(15).is_string() && report(15) != report(16), "{run}");
    assert_eq!(stage_of(&draw(&cluster, &by_step), "m-mld-15")["state"], "cached");
    let pruned = json!({"checkpoints": [named(&5)], "sentences": ["a person walks"]});
    let reply = cluster.post("/v1/draws", &pruned).expect("an answer");
    assert_eq!((reply.status, &reply.body["code"]), (404, &json!("not-found")), "{}", reply.body);

    // A refusal of the server, of the scope, and of the worker.
    let unknown = json!({"models": ["none@prod"], "sentences": ["a person walks"]});
    let reply = cluster.post("/v1/draws", &unknown).expect("an answer");
    assert_eq!((reply.status, &reply.body["code"]), (400, &json!("invalid")), "{}", reply.body);
    assert!(reply.body["detail"].as_str().is_some_and(|detail| detail.contains("none")), "{}", reply.body);
    let headers = [("content-type", "application/json")];
    let text = asked.to_string();
    let reply = cluster.call_as(WORKER_TOKEN, "POST", "/v1/draws", &headers, text.as_bytes()).expect("an answer");
    assert_eq!((reply.status, &reply.body["code"]), (403, &json!("forbidden")));
    let long = json!({"models": ["smoke:1"], "sentences": ["a person walks"], "seconds": 59.0});
    let reply = cluster.post("/v1/draws", &long).expect("an answer");
    let run = reply.body["run"].as_str().expect("a run");
    let run = wait_for("the draw to fail", || Some(cluster.view(run)).filter(|run| run["state"] == "failed"));
    let message = stage_of(&run, "m-smoke-1")["message"].to_string();
    assert!(message.contains("`seconds` is 59"), "{run}");
    cluster.fsck();
}
