//! Limits of a project in the token file, which hold soon after the file changes.

use std::time::{Duration, Instant};

use protocol::RunId;
use reqwest::StatusCode;
use serde_json::Value;

use super::lab::{Kind, Lab, Project, TestResult, lines, pipeline, submission, tokens};

/// The table with `limits` on one line of the project `speech`.
fn limited(limits: &str) -> TestResult<access::Tokens> {
    let change = |kind: &Kind| {
        let is_limited = kind.name == "bob";
        Some(if is_limited { format!("{} {limits}", kind.more()) } else { kind.more().to_owned() })
    };
    tokens(&lines(change))
}

/// A pipeline that no other run has.
fn another(seed: u32) -> String {
    pipeline(Project::Speech).replace("seed: 2", &format!("seed: {seed}"))
}

/// Submits until the answer is as expected, while the table is being applied.
async fn submitted(
    lab: &Lab,
    name: &str,
    is_accepted: bool,
    seed: &mut u32,
) -> TestResult<Result<RunId, (StatusCode, String)>> {
    let begun = Instant::now();
    loop {
        *seed += 1;
        let answer = lab.submit(name, &submission(&another(*seed))?).await?;
        if answer.is_ok() == is_accepted {
            return Ok(answer);
        }
        assert!(begun.elapsed() < Duration::from_secs(30), "still {answer:?}");
        tokio::time::sleep(Duration::from_millis(100)).await;
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_project_is_limited_in_bytes_and_in_runs_at_work() -> TestResult {
    let lab = Lab::new().await?;
    let mut seed = 100;
    lab.handle.replace_tokens(limited("max_gib=0 max_runs=1")?);
    // Another token of the same project.
    let (status, refused) = submitted(&lab, "ben", false, &mut seed).await?.unwrap_err();
    assert_eq!(status, StatusCode::PAYLOAD_TOO_LARGE);
    assert!(
        refused.contains("\"used-up\"") && refused.contains("@speech has stored 0 B; the limit is 0 B"),
        "{refused}"
    );
    assert!(refused.contains("registry forget --ended-before"), "{refused}");
    let free = submitted(&lab, "alice", true, &mut seed).await?.map_err(|(_, error)| error)?;
    let view = lab.call("alice", "GET", &format!("/v1/runs/{free}"), &Value::Null).await?.1;
    assert_eq!(view["queued"], Value::Null, "another project has no limit: {view}");

    lab.handle.replace_tokens(limited("max_runs=1")?);
    let queued = submitted(&lab, "bob", true, &mut seed).await?.map_err(|(_, error)| error)?;
    let path = format!("/v1/runs/{queued}");
    let view = lab.call("bob", "GET", &path, &Value::Null).await?.1;
    assert_eq!(view["queued"], true, "{view}");
    let note = view["note"].as_str().unwrap_or_default();
    assert!(note.starts_with("queued: ") && note.ends_with("of @speech at work, at most 1 allowed"), "{note}");
    let listed = lab.call("bob", "GET", "/v1/runs", &Value::Null).await?.1;
    let of_list =
        listed["items"].as_array().and_then(|items| items.iter().find(|item| item["run"] == *queued.as_str()));
    assert_eq!(of_list.map(|item| &item["queued"]), Some(&Value::Bool(true)), "{listed}");

    let others = listed["items"].as_array().cloned().unwrap_or_default();
    for other in others.iter().filter(|item| item["run"] != *queued.as_str() && item["state"] == "running") {
        let path = format!("/v1/runs/{}/cancel", other["run"].as_str().unwrap_or_default());
        assert!(lab.call("bob", "POST", &path, &Value::Null).await?.0.is_success());
    }
    let view = lab.call("bob", "GET", &path, &Value::Null).await?.1;
    assert_eq!((&view["queued"], &view["state"]), (&Value::Null, &"running".into()), "{view}");
    lab.handle.shutdown().await;
    Ok(())
}
