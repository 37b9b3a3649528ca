//! A killed worker is seen as soon as its connection breaks.

use std::time::{Duration, Instant};

use access::Server;
use protocol::message::{DesiredAssignments, Joined, Poll};
use protocol::proof::SECRET_HEADER;
use reqwest::Method;
use serde_json::{Value, json};
use tokio::time::{sleep, timeout};

use super::http::with_tokens;
use super::in_browser::call;
use crate::shell::{SECRET, TestResult, offer};

async fn state(server: &Server) -> TestResult<String> {
    let workers = call(server, SECRET, Method::GET, "/v1/workers", &Value::Null).await?;
    Ok(workers[0]["state"].as_str().unwrap_or_default().to_owned())
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_worker_whose_poll_breaks_is_shown_as_unreachable_before_its_lease_ends() -> TestResult {
    let dir = tempfile::tempdir()?;
    let handle = with_tokens(dir.path()).await;
    let server = Server::new(&handle.url(), Some(handle.token().clone()), None)?;
    let joined: Joined = serde_json::from_value(call(&server, SECRET, Method::POST, "/v1/workers", &offer()).await?)?;
    let mut poll = Poll { incarnation: joined.incarnation, doing: vec![], ready: vec![], version: 0, leaving: false };
    let answer = call(&server, SECRET, Method::POST, "/v1/workers/a/poll", &poll).await?;
    poll.version = serde_json::from_value::<DesiredAssignments>(answer)?.version;
    assert_eq!(state(&server).await?, "idle");

    let waits = server.request(Method::POST, "/v1/workers/a/poll").header(SECRET_HEADER, SECRET).json(&poll).send();
    assert!(timeout(Duration::from_millis(300), waits).await.is_err(), "nothing changes, so it waits");
    let begun = Instant::now();
    while state(&server).await? != "unreachable" {
        assert!(begun.elapsed() < Duration::from_secs(10), "the lease lasts {} ms", joined.lease_ms);
        sleep(Duration::from_millis(20)).await;
    }
    println!("unreachable after {:?}", begun.elapsed());

    // Another poll of the process shows that it lives.
    call(&server, SECRET, Method::POST, "/v1/workers/a/poll", &json!(poll)).await?;
    assert_eq!(state(&server).await?, "idle");
    handle.shutdown().await;
    Ok(())
}
