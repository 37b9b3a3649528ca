//! The audit log of a server: its records, access to it, and the grouping of refusals.

use std::time::Duration;

use registry::audit::AuditEntry;
use reqwest::StatusCode;
use serde_json::{Value, json};

use super::lab::{Lab, Project, TestResult, promote};

async fn entries(lab: &Lab) -> TestResult<Vec<AuditEntry>> {
    let (status, answer) = lab.registry("root", &json!({"command": "audit", "limit": 10_000})).await?;
    assert_eq!(status, StatusCode::OK, "{answer}");
    Ok(serde_json::from_value(answer["data"]["entries"].clone())?)
}

/// Waits for a matching record.
async fn until(lab: &Lab, what: &str, is_it: impl Fn(&AuditEntry) -> bool) -> TestResult<AuditEntry> {
    for _ in 0..600 {
        if let Some(entry) = entries(lab).await?.into_iter().find(&is_it) {
            return Ok(entry);
        }
        tokio::time::sleep(Duration::from_millis(50)).await;
    }
    panic!("no line of {what}: {:#?}", entries(lab).await?)
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn changes_and_refusals_are_logged_and_a_crowd_of_them_is_counted() -> TestResult {
    let lab = Lab::new().await?;
    let run = &lab.runs[&Project::Motion];
    let submitted = until(&lab, "the submission", |it| it.call == "POST /v1/runs" && it.object == run.as_str()).await?;
    assert_eq!(
        (submitted.who.as_str(), submitted.from.as_str(), submitted.status),
        ("alice (motion)", "127.0.0.1", 200)
    );
    lab.registry("bob", &promote("talks", 2, "staging")).await?;
    lab.call("bob", "POST", &format!("/v1/runs/{run}/cancel"), &Value::Null).await?;
    until(&lab, "the promotion", |it| it.who == "bob (speech)" && it.object == "promote talks:2 to staging").await?;
    let refused =
        |it: &AuditEntry| it.who == "bob (speech)" && it.call == "POST /v1/runs/{run}/{action}" && it.status == 404;
    until(&lab, "the refusal", refused).await?;
    until(&lab, "the worker", |it| it.who == "node" && it.call == "POST /v1/workers").await?;

    let before = entries(&lab).await?.len();
    for _ in 0..500 {
        assert_eq!(
            lab.call("rita", "POST", &format!("/v1/runs/{run}/cancel"), &Value::Null).await?.0,
            StatusCode::FORBIDDEN
        );
    }
    until(&lab, "the first of many", |it| it.who == "rita (speech)" && it.status == 403).await?;
    let after = entries(&lab).await?.len();
    assert!(after - before < 10, "{} lines", after - before);
    for name in ["alice", "carol", "paul", "node"] {
        assert_eq!(
            lab.registry(name, &json!({"command": "audit", "limit": 1})).await?.0,
            StatusCode::FORBIDDEN,
            "{name}"
        );
    }
    // Counted calls are recorded at shutdown.
    let dir = lab.store.dir().to_owned();
    lab.handle.shutdown().await;
    let all = registry::audit::read(&dir, 10_000)?;
    let counted = all.iter().filter(|it| it.who == "rita (speech)" && it.status == 403).map(|it| it.count).sum::<u64>();
    assert_eq!(counted, 500);
    assert!(!all.iter().any(|it| it.call.contains("/poll")), "polls are not logged");
    Ok(())
}
