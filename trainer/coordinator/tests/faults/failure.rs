//! A panic in the actor: waiting and new callers get an error at once, and the next coordinator continues acknowledged
//! work.

use std::time::Duration;

use coordinator::{Refused, Trouble};
use fail::FailScenario;
use protocol::message::{Joined, Poll};
use protocol::proof::SECRET_HEADER;
use reqwest::{Method, RequestBuilder, Response};

use crate::shell::{SECRET, TestResult, offer, start, submission};

/// Much shorter than any wait of the coordinator: a poll waits 2 s by default, and a minute here.
const AT_ONCE: Duration = Duration::from_secs(10);
/// Longest wait of a poll in milliseconds.
const POLL_MS: u64 = 60_000;

async fn is_refused(answer: Result<Response, reqwest::Error>, what: &str) -> TestResult {
    let answer = answer?;
    let status = answer.status();
    let text = answer.text().await?;
    assert_eq!(status, 503, "{what}: {text}");
    assert!(text.contains("\"failed\"") && text.contains("start it again"), "{what}: {text}");
    Ok(())
}

fn as_worker(request: RequestBuilder) -> RequestBuilder {
    request.header(SECRET_HEADER, SECRET)
}

#[tokio::test(flavor = "multi_thread")]
async fn a_panic_of_the_actor_is_told_to_everybody_at_once() -> TestResult {
    let scenario = FailScenario::setup();
    let dir = tempfile::tempdir()?;
    let (handle, server) = start(dir.path(), POLL_MS).await?;
    let run = handle.submit(submission()?).await?;
    let joined: Joined =
        as_worker(server.request(Method::POST, "/v1/workers")).json(&offer()).send().await?.json().await?;
    // The first poll has no version and is answered at once; the next one has the current version and waits.
    let poll = |version| Poll {
        incarnation: joined.incarnation,
        doing: Vec::new(),
        ready: Vec::new(),
        version,
        leaving: false,
    };
    let path = "/v1/workers/a/poll";
    let mut version = 0;
    let waiting = loop {
        let answer = as_worker(server.request(Method::POST, path)).json(&poll(version)).send();
        let mut answer = tokio::spawn(answer);
        match tokio::time::timeout(Duration::from_millis(500), &mut answer).await {
            Ok(answer) => {
                let desired: protocol::message::DesiredAssignments = answer??.json().await?;
                version = desired.version;
            }
            Err(_) => break answer,
        }
    };
    assert_eq!(handle.trouble(), None);

    fail::cfg("actor::decide", "panic(made up)")?;
    let told = tokio::time::timeout(AT_ONCE, async {
        let refused = handle.submit(submission()?).await;
        assert!(matches!(&refused, Err(Refused::Failed(why)) if why.contains("made up")), "{refused:?}");
        is_refused(waiting.await?, "the poll that waited").await?;
        is_refused(as_worker(server.request(Method::POST, path)).json(&poll(version)).send().await, "the next poll")
            .await?;
        is_refused(server.request(Method::POST, "/v1/runs").json(&submission()?).send().await, "a submission").await?;
        is_refused(server.request(Method::GET, "/v1/runs").send().await, "a look").await?;
        is_refused(server.request(Method::GET, "/v1/health").send().await, "a question how it is").await?;
        TestResult::Ok(handle.failed().await)
    });
    let why = told.await.map_err(|_| "somebody was left waiting")??;
    assert!(why.contains("the actor") && why.contains("made up"), "{why}");
    assert_eq!(handle.trouble(), Some(Trouble::Failed(why)));
    fail::remove("actor::decide");
    handle.shutdown().await;

    let (handle, _) = start(dir.path(), POLL_MS).await?;
    assert_eq!(handle.run_view(&run).await?.run, run, "what was acknowledged is there");
    handle.submit(submission()?).await?;
    handle.shutdown().await;
    scenario.teardown();
    Ok(())
}
