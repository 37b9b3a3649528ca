//! Pipelines that register and promote: refused on submission, and again at the time of registration.

use std::collections::BTreeMap;

use pipeline::Pipeline;
use protocol::message::{RunState, RunView, StageState, Submit};
use protocol::stage::{Register, WorkerRange};
use protocol::{Digest, Manifest, RunId};
use registry::Write;
use reqwest::StatusCode;
use serde_json::{Value, json};

use super::lab::{CANARY, Lab, TestResult, as_they_are, lines, tokens};
use crate::pipelines;

/// The quickstart, registering `model` and moving `alias`.
fn quickstart(model: &str, alias: &str) -> TestResult<Pipeline> {
    let mut pipeline = pipelines::quickstart(7, WorkerRange::default(), &[]);
    let release = pipeline.stages.last_mut().ok_or("a stage")?;
    let mut register = release.settings.get::<Register>().ok_or("`register`")?.clone();
    register.model = model.to_owned();
    register.promote.to = alias.to_owned();
    release.settings = protocol::stage::StageSettings::Register(register);
    Ok(pipeline)
}

fn submit(pipeline: &Pipeline) -> TestResult<Submit> {
    let pipeline = serde_json::to_value(pipeline)?;
    Ok(Submit { pipeline, source: String::new(), idempotency_key: None, until: None })
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_submission_that_would_move_what_is_not_its_owners_to_move_is_refused() -> TestResult {
    let lab = Lab::new().await?;
    let walks = format!("{CANARY}-walks");
    for (name, model, alias, refused) in [
        ("alice", "new", "staging", None),
        ("alice", &walks, "staging", None),
        ("anna", "new", "", None),
        ("anna", &walks, "", None),
        ("anna", "new", "staging", Some("the token of `anna` does not have the scope `promote`")),
        ("anna", "new", "prod", Some("scope `promote`")),
        ("alice", "new", "prod", Some("alias `prod` is protected")),
        ("bob", "talks", "prod", Some("alias `prod` is protected")),
        ("ben", "talks", "prod", None),
        ("root", &walks, "prod", None),
        ("bob", &walks, "", Some("belongs to another owner")),
        ("ben", &walks, "prod", Some("belongs to another owner")),
        ("mona", "talks", "staging", Some("belongs to another owner")),
        ("carol", &walks, "", Some("belongs to another owner")),
    ] {
        let runs = |list: &Value| list["items"].as_array().map(Vec::len);
        let before = runs(&lab.call("root", "GET", "/v1/runs", &Value::Null).await?.1);
        let answer = lab.submit(name, &submit(&quickstart(model, alias)?)?).await?;
        match (refused, answer) {
            (None, Ok(_)) => {}
            (Some(words), Err((StatusCode::FORBIDDEN, why))) => {
                assert!(why.contains(words) && why.contains("stage `release`"), "{name} {model}@{alias}: {why}");
                assert_eq!(runs(&lab.call("root", "GET", "/v1/runs", &Value::Null).await?.1), before, "nothing began");
            }
            (_, answer) => panic!("{name} {model}@{alias}: {answer:?}"),
        }
    }
    lab.handle.shutdown().await;
    Ok(())
}

/// Stores a value for each stage except the last, so that a run reaches its registration at once.
async fn all_but_the_last(lab: &Lab, pipeline: &Pipeline) -> TestResult {
    let mut values: BTreeMap<String, Digest> = BTreeMap::new();
    let last = pipeline.stages.len() - 1;
    for stage in &pipeline.stages[..last] {
        let inputs = stage.inputs.iter().map(|input| (input.field.clone(), values[input.stage.as_str()])).collect();
        let output = stage.settings.output();
        let manifest = Manifest::new(output.kind, json!({"name": stage.name}));
        let digest = lab.store.blobs().put(&manifest.to_bytes())?;
        values.insert(stage.name.to_string(), digest);
        lab.store
            .write(vec![Write::StageResult {
                grant: None,
                key: pipeline.identity(stage, &inputs).key(),
                run: "made-1".into(),
                stage: stage.name.clone(),
                kind: stage.settings.kind().to_owned(),
                outputs: BTreeMap::from([(output.name.to_owned(), digest)]),
                metrics: BTreeMap::from([("latent_fid".to_owned(), 0.5)]),
                inputs,
                wall_s: 1.0,
            }])
            .await?;
    }
    Ok(())
}

async fn ended(lab: &Lab, run: &RunId) -> TestResult<RunView> {
    loop {
        let (_, view) = lab.call("root", "GET", &format!("/v1/runs/{run}"), &Value::Null).await?;
        let view: RunView = serde_json::from_value(view)?;
        if view.state != RunState::Running {
            return Ok(view);
        }
        tokio::time::sleep(std::time::Duration::from_millis(20)).await;
    }
}

fn why(view: &RunView) -> &str {
    let release = view.stages.last().map(|stage| (stage.state, stage.message.as_deref()));
    match release {
        Some((StageState::Failed, Some(message))) => message,
        other => panic!("{other:?}"),
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_token_that_was_revoked_meanwhile_promotes_nothing() -> TestResult {
    let lab = Lab::new().await?;
    let pipeline = quickstart("new", "staging")?;
    all_but_the_last(&lab, &pipeline).await?;
    let run = lab.submit("alice", &submit(&pipeline)?).await?.map_err(|(_, why)| why)?;
    let view = ended(&lab, &run).await?;
    assert!(view.owner.promotes && view.owner.to_string() == "alice (motion)", "{:?}", view.owner);
    // The artifacts are not models, so this error shows that the token was accepted.
    assert!(why(&view).contains("cannot assemble"), "{}", why(&view));
    for (change, words) in [("", "no token of `alice` is still valid"), ("expires=2020-01-01", "no token of `alice`")] {
        let without = lines(|kind| match kind.name {
            "alice" if change.is_empty() => None,
            "alice" => Some(format!("project=motion {change}")),
            _ => as_they_are(kind),
        });
        lab.handle.replace_tokens(tokens(&without)?);
        let resumed = lab.call("anna", "POST", &format!("/v1/runs/{run}/resume"), &Value::Null).await?;
        assert_eq!(resumed.0, StatusCode::OK, "{}", resumed.1);
        let view = ended(&lab, &run).await?;
        assert!(why(&view).contains(words), "{}", why(&view));
    }
    let history = lab.registry("root", &json!({"command": "list"})).await?.1;
    assert!(!history.to_string().contains("\"new\""), "{history}");
    lab.handle.shutdown().await;
    Ok(())
}
