//! Tokens that are revoked, changed or expired while their callers are connected.

use std::time::Duration;

use futures::StreamExt as _;
use protocol::message::{Joined, Poll};
use reqwest::{Method, StatusCode};
use serde_json::Value;

use super::lab::{Lab, TestResult, as_they_are, lines, tokens};
use crate::shell::offer;

/// The table without the line of `name`.
fn without(name: &str) -> TestResult<access::Tokens> {
    tokens(&lines(|kind| if kind.name == name { None } else { as_they_are(kind) }))
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_revoked_token_is_not_served_on_connections_that_it_opened() -> TestResult {
    let lab = Lab::new().await?;
    // The client keeps the connection open.
    assert_eq!(lab.call("anna", "GET", "/v1/runs", &Value::Null).await?.0, StatusCode::OK);
    let large = lab.store.blobs().put(&vec![7; 64 << 20])?;
    let begin = lab.client("anna").request(Method::GET, &format!("/v1/blobs/{large}")).send().await?;
    let mut download = begin.bytes_stream();
    assert!(download.next().await.ok_or("a first part")?.is_ok());

    lab.handle.replace_tokens(without("anna")?);
    assert_eq!(lab.call("anna", "GET", "/v1/runs", &Value::Null).await?.0, StatusCode::UNAUTHORIZED);
    let mut came = 0;
    let broken = loop {
        match download.next().await {
            Some(Ok(part)) => came += part.len(),
            Some(Err(_)) => break true,
            None => break false,
        }
    };
    assert!(broken && came < 32 << 20, "{came} bytes came after the token was revoked");
    assert_eq!(lab.call("alice", "GET", "/v1/runs", &Value::Null).await?.0, StatusCode::OK, "another's token stays");
    // Removing scopes from a line takes effect at once, too.
    lab.handle.replace_tokens(tokens(&lines(as_they_are).replace("alice submit,promote", "alice read"))?);
    let path = format!("/v1/runs/{}/pause", lab.runs[&super::lab::Project::Motion]);
    assert_eq!(lab.call("alice", "POST", &path, &Value::Null).await?.0, StatusCode::FORBIDDEN);
    assert_eq!(lab.call("anna", "GET", "/v1/runs", &Value::Null).await?.0, StatusCode::OK, "it is back");
    lab.handle.shutdown().await;
    Ok(())
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_call_that_waits_ends_when_its_token_is_revoked() -> TestResult {
    let lab = Lab::waiting(600_000).await?;
    let mut join = serde_json::to_value(offer())?;
    join["worker"] = "idle".into();
    let joined: Joined = serde_json::from_value(lab.call("node", "POST", "/v1/workers", &join).await?.1)?;
    let mut poll = Poll { incarnation: joined.incarnation, doing: vec![], ready: vec![], version: 0, leaving: false };
    let first = lab.call("node", "POST", "/v1/workers/idle/poll", &serde_json::to_value(&poll)?).await?.1;
    poll.version = first["version"].as_u64().ok_or("a version")?;
    let (poll, begun) = (serde_json::to_value(&poll)?, std::time::Instant::now());
    let (answer, ()) = tokio::join!(lab.call("node", "POST", "/v1/workers/idle/poll", &poll), async {
        tokio::time::sleep(Duration::from_millis(200)).await;
        lab.handle.replace_tokens(without("node").unwrap());
    });
    assert_eq!(answer?.0, StatusCode::UNAUTHORIZED);
    assert!(begun.elapsed() < Duration::from_secs(60), "{:?}", begun.elapsed());
    lab.handle.shutdown().await;
    Ok(())
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_token_ends_at_its_time() -> TestResult {
    let lab = Lab::new().await?;
    let until = |expires: &str| {
        tokens(&lines(|kind| if kind.name == "rita" { Some(expires.into()) } else { as_they_are(kind) }))
    };
    lab.handle.replace_tokens(until("expires=2999-12-31")?);
    assert_eq!(lab.call("rita", "GET", "/v1/runs", &Value::Null).await?.0, StatusCode::OK);
    lab.handle.replace_tokens(until("expires=2020-12-31")?);
    let (status, answer) = lab.call("rita", "GET", "/v1/runs", &Value::Null).await?;
    assert_eq!(status, StatusCode::UNAUTHORIZED);
    assert!(answer["detail"].as_str().is_some_and(|why| why.contains("`rita` has expired")), "{answer}");
    lab.handle.shutdown().await;
    Ok(())
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_range_past_a_blob_is_refused_as_such() -> TestResult {
    let lab = Lab::new().await?;
    let blob = lab.store.blobs().put(b"0123456789")?;
    for (range, status) in
        [("bytes=4-", 206), ("bytes=11-", 416), ("bytes=18446744073709551615-", 416), ("bytes=x-", 400)]
    {
        let request = lab.client("rita").request(Method::GET, &format!("/v1/blobs/{blob}")).header("range", range);
        assert_eq!(request.send().await?.status().as_u16(), status, "{range}");
    }
    lab.handle.shutdown().await;
    Ok(())
}
