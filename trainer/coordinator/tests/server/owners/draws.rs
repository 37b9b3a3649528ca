//! Draws: short runs of one stage for each model, of models that the caller sees, and few at a time.

use std::collections::BTreeMap;

use coordinator::shell::Drawing;
use protocol::message::{DesiredAssignments, Join, Joined, Poll};
use protocol::{ArtifactKind, Manifest, Owner, labels, limits};
use registry::Write;
use reqwest::StatusCode;
use serde_json::{Value, json};

use super::lab::{Lab, TestResult};
use crate::shell::offer;

async fn draw(lab: &Lab, name: &str, body: &Value) -> TestResult<(StatusCode, Value)> {
    lab.call(name, "POST", "/v1/draws", body).await
}

/// A lab with the version `drawn:1` of the project `motion`.
async fn lab_with_a_model() -> TestResult<Lab> {
    let lab = Lab::new().await?;
    let owner = Owner { name: "alice".into(), project: Some("motion".into()), ..Owner::default() };
    let meta = json!({"generator": "latent-diffusion", "format": "humanml3d", "parts": {}});
    let artifact = lab.store.blobs().put(&Manifest::new(ArtifactKind::Model, meta).to_bytes())?;
    let (metrics, source) = (BTreeMap::new(), json!({"metric": "fid", "mode": "min"}));
    let own = Write::ModelOwner { model: "drawn".into(), owner };
    lab.store.write(vec![own, Write::Version { model: "drawn".into(), artifact, metrics, source }]).await?;
    Ok(lab)
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_worker_that_is_kept_for_draws_takes_nothing_else() -> TestResult {
    let lab = lab_with_a_model().await?;
    let kept = Join { labels: labels::ONLY_DRAWS.parse()?, ..offer() };
    let (_, joined) = lab.call("node", "POST", "/v1/workers", &serde_json::to_value(kept)?).await?;
    let Joined { incarnation, .. } = serde_json::from_value(joined)?;
    let asked = json!({"models": ["drawn:1"], "sentences": ["a person walks"]});
    let (status, answer) = draw(&lab, "anna", &asked).await?;
    assert_eq!(status, StatusCode::OK, "{answer}");
    let drawing: Drawing = serde_json::from_value(answer)?;
    let poll = serde_json::to_value(Poll { incarnation, doing: vec![], ready: vec![], version: 0, leaving: false })?;
    let task = loop {
        let (_, answer) = lab.call("node", "POST", "/v1/workers/a/poll", &poll).await?;
        let desired: DesiredAssignments = serde_json::from_value(answer)?;
        if let Some(assignment) = desired.assignments.first() {
            break assignment.grant.task.to_string();
        }
    };
    assert!(task.starts_with(drawing.run.as_str()), "older runs wait, and it got {task} instead of {}", drawing.run);
    lab.handle.shutdown().await;
    Ok(())
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_draw_is_a_run_of_its_caller_and_few_wait_at_a_time() -> TestResult {
    let lab = lab_with_a_model().await?;
    let asked = json!({"models": ["drawn:1"], "sentences": ["a person walks", "a person \"jumps\""], "seed": 5, "seconds": 2.0});
    let (status, answer) = draw(&lab, "anna", &asked).await?;
    assert_eq!(status, StatusCode::OK, "{answer}");
    let drawing: Drawing = serde_json::from_value(answer)?;
    assert_eq!(drawing.stages, ["m-drawn-1".into()]);
    let (_, run) = lab.call("anna", "GET", &format!("/v1/runs/{}", drawing.run), &Value::Null).await?;
    assert_eq!((&run["pipeline"], &run["owner"]["name"]), (&json!("draw"), &json!("anna")), "{run}");
    assert_eq!((&run["stages"][0]["kind"], run["stages"].as_array().map(Vec::len)), (&json!("draw.motions"), Some(1)));
    assert!(run["stages"][0]["key"].is_string(), "the version is resolved: {run}");

    // Others do not learn whether the model exists, and readers draw nothing.
    let (status, hidden) = draw(&lab, "bob", &asked).await?;
    assert_eq!(status, StatusCode::BAD_REQUEST);
    let mut none = asked.clone();
    none["models"] = json!(["never:1"]);
    let (_, unknown) = draw(&lab, "bob", &none).await?;
    let without = |answer: &Value, name: &str| answer["detail"].as_str().map(|text| text.replace(name, "MODEL"));
    assert_eq!(without(&hidden, "drawn"), without(&unknown, "never"), "{hidden}");
    assert_eq!(draw(&lab, "rita", &asked).await?.0, StatusCode::FORBIDDEN);

    for wrong in [
        json!({"models": ["drawn:1"]}),
        json!({"models": ["drawn:1"], "sentences": ["x"], "path": "/etc/passwd"}),
        json!({"models": ["drawn:1"], "sentences": ["x"], "seconds": 1e9}),
        json!({"models": ["drawn:1"], "sentences": ["x".repeat(2000)]}),
        json!({"models": ["../x"], "sentences": ["x"]}),
        json!({"models": ["drawn:1", "drawn:1", "drawn:1", "drawn:1", "drawn:1"], "sentences": ["x"]}),
    ] {
        let (status, answer) = draw(&lab, "alice", &wrong).await?;
        assert!(status.is_client_error() && answer["code"] == "invalid", "{wrong}: {status} {answer}");
    }

    // Those of a project wait together.
    for _ in 1..limits::DRAWS_WAITING_EACH {
        let (status, answer) = draw(&lab, "alice", &asked).await?;
        assert_eq!(status, StatusCode::OK, "{answer}");
    }
    let (status, answer) = draw(&lab, "alice", &asked).await?;
    assert_eq!((status, answer["code"].as_str()), (StatusCode::TOO_MANY_REQUESTS, Some("busy")), "{answer}");
    assert_eq!(draw(&lab, "root", &asked).await?.0, StatusCode::OK, "others draw");
    let (status, _) = lab.call("anna", "POST", &format!("/v1/runs/{}/cancel", drawing.run), &Value::Null).await?;
    assert_eq!(status, StatusCode::OK);
    assert_eq!(draw(&lab, "alice", &asked).await?.0, StatusCode::OK, "one has ended");
    lab.handle.shutdown().await;
    Ok(())
}
