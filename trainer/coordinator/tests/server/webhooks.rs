//! Webhooks get each message once and in order, again after a failure, and only at listed addresses.

use std::collections::VecDeque;
use std::os::unix::fs::PermissionsExt as _;
use std::path::Path;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

use axum::extract::State;
use axum::http::{HeaderMap, StatusCode, header};
use axum::response::IntoResponse;
use axum::{Router, routing::post};
use coordinator::{Config, Control, Coordinator, Handle};
use hmac::{Hmac, Mac as _};
use protocol::message::{Assignment, DesiredAssignments, Joined, Poll};
use protocol::proof::SECRET_HEADER;
use registry::{Holder, Store};
use reqwest::Method;
use serde_json::Value;
use sha2::Sha256;
use tokio::net::TcpListener;

use super::shell::{SECRET, TestResult, offer, submission};

const KEY: &str = "the-secret-of-a-hook-of-the-tests";

/// Messages that a receiver has got, and its answers.
#[derive(Default)]
struct Inbox {
    /// Id, status that it was answered with, and text.
    got: Vec<(String, u16, Value)>,
    answers: VecDeque<(StatusCode, Option<String>)>,
}

#[derive(Clone)]
struct Receiver {
    inbox: Arc<Mutex<Inbox>>,
    url: String,
}

impl Receiver {
    async fn start() -> TestResult<Self> {
        let inbox = Arc::<Mutex<Inbox>>::default();
        let listener = TcpListener::bind("127.0.0.1:0").await?;
        let url = format!("http://{}/hook", listener.local_addr()?);
        let router = Router::new().route("/hook", post(receive)).with_state(Arc::clone(&inbox));
        tokio::spawn(async move { axum::serve(listener, router).await });
        Ok(Self { inbox, url })
    }

    fn answer(&self, status: StatusCode, location: Option<&str>) {
        let mut inbox = self.inbox.lock().unwrap_or_else(PoisonError::into_inner);
        inbox.answers.push_back((status, location.map(str::to_owned)));
    }

    fn got(&self) -> Vec<(String, u16, Value)> {
        self.inbox.lock().unwrap_or_else(PoisonError::into_inner).got.clone()
    }

    /// Waits for `count` requests.
    async fn wait_for(&self, count: usize) -> TestResult<Vec<(String, u16, Value)>> {
        for _ in 0..1200 {
            let got = self.got();
            if got.len() >= count {
                return Ok(got);
            }
            tokio::time::sleep(Duration::from_millis(50)).await;
        }
        Err(format!("only {:?}", self.got()).into())
    }
}

async fn receive(State(inbox): State<Arc<Mutex<Inbox>>>, headers: HeaderMap, body: String) -> impl IntoResponse {
    let text = |name: &str| headers[name].to_str().unwrap().to_owned();
    let (id, time) = (text("webhook-id"), text("webhook-timestamp"));
    let mut mac = Hmac::<Sha256>::new_from_slice(KEY.as_bytes()).unwrap();
    mac.update(format!("{id}.{time}.{body}").as_bytes());
    let signed = hex::encode(mac.finalize().into_bytes());
    let said = text("webhook-signature");
    let said = browser::decoded(said.strip_prefix("v1,").unwrap());
    assert_eq!(hex::encode(said), signed);
    let mut inbox = inbox.lock().unwrap();
    let (status, location) = inbox.answers.pop_front().unwrap_or((StatusCode::NO_CONTENT, None));
    inbox.got.push((id, status.as_u16(), serde_json::from_str(&body).unwrap()));
    let mut headers = HeaderMap::new();
    if let Some(location) = location {
        headers.insert(header::LOCATION, location.parse().unwrap());
    }
    (status, headers)
}

fn hooks(dir: &Path, lines: &str) -> TestResult<webhooks::Hooks> {
    let path = dir.join("hooks");
    std::fs::write(&path, lines)?;
    std::fs::set_permissions(&path, std::fs::Permissions::from_mode(0o600))?;
    Ok(webhooks::Hooks::read(&path)?)
}

async fn start(dir: &Path, hooks: webhooks::Hooks) -> TestResult<Handle> {
    let store = Store::open(&dir.join("store"), Holder::this_process("a test")).await?;
    let mut config = Config { alone: false, park: false, hooks, ..Config::embedded() };
    config.hook_retry = Duration::from_millis(1);
    config.allowances.quiet = Duration::from_millis(500);
    config.policy.poll_ms = 100;
    Ok(Coordinator::start(store, config).await?)
}

fn types(got: &[(String, u16, Value)]) -> Vec<(&str, u16)> {
    got.iter().map(|(_, status, body)| (body["type"].as_str().unwrap_or_default(), *status)).collect()
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_hook_gets_each_message_once_in_order_and_again_after_a_failure() -> TestResult {
    let dir = tempfile::tempdir()?;
    let (lab, elsewhere) = (Receiver::start().await?, Receiver::start().await?);
    let listed = hooks(dir.path(), &format!("lab {} {KEY} on=cancelled,failed\n", lab.url))?;
    let handle = start(dir.path(), listed.clone()).await?;
    // A receiver that fails, and one that sends messages elsewhere, get them again.
    lab.answer(StatusCode::INTERNAL_SERVER_ERROR, None);
    lab.answer(StatusCode::TEMPORARY_REDIRECT, Some(&elsewhere.url));
    let first = handle.submit(submission()?).await?;
    handle.control(&first, Control::Cancel).await?;
    let got = lab.wait_for(3).await?;
    assert_eq!(types(&got), [("run.cancelled", 500), ("run.cancelled", 307), ("run.cancelled", 204)]);
    assert!(got.iter().all(|(id, _, body)| *id == got[0].0 && *body == got[0].2), "{got:?}");
    assert_eq!(got[0].2["text"], format!("Run {first} was cancelled"));
    assert_eq!(elsewhere.got().len(), 0, "an address that nobody listed");
    handle.shutdown().await;

    // Another process sends the next message, and none again.
    let handle = start(dir.path(), listed).await?;
    let second = handle.submit(submission()?).await?;
    handle.control(&second, Control::Cancel).await?;
    let got = lab.wait_for(4).await?;
    assert_eq!(got[3].2["data"]["run"], second.as_str());
    // Another list takes effect at once, and its hooks get no earlier message.
    handle.replace_hooks(hooks(dir.path(), &format!("other {} {KEY} on=cancelled\n", elsewhere.url))?).await?;
    let third = handle.submit(submission()?).await?;
    handle.control(&third, Control::Cancel).await?;
    let other = elsewhere.wait_for(1).await?;
    assert_eq!(other[0].2["data"]["run"], third.as_str());
    assert_eq!(lab.got().len(), 4);
    handle.shutdown().await;
    Ok(())
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_stage_that_stands_still_is_reported_once() -> TestResult {
    let dir = tempfile::tempdir()?;
    let lab = Receiver::start().await?;
    let listed = hooks(dir.path(), &format!("lab {} {KEY} on=stalled\n", lab.url))?;
    let handle = start(dir.path(), listed).await?;
    let server = access::Server::new(&handle.url(), Some(handle.token().clone()), None)?;
    let run = handle.submit(submission()?).await?;
    // A run that waits for its first worker does not stand still.
    tokio::time::sleep(Duration::from_secs(1)).await;
    assert_eq!(lab.got().len(), 0);
    let joined = server.request(Method::POST, "/v1/workers").header(SECRET_HEADER, SECRET).json(&offer());
    let joined: Joined = joined.send().await?.error_for_status()?.json().await?;
    let mut held: Option<Assignment> = None;
    for _ in 0..20 {
        let poll = Poll { incarnation: joined.incarnation, doing: vec![], ready: vec![], version: 0, leaving: false };
        let polled = server.request(Method::POST, "/v1/workers/a/poll").header(SECRET_HEADER, SECRET).json(&poll);
        let desired: DesiredAssignments = polled.send().await?.error_for_status()?.json().await?;
        held = held.or(desired.assignments.into_iter().next());
        tokio::time::sleep(Duration::from_millis(100)).await;
    }
    let held = held.ok_or("no task")?;
    let got = lab.wait_for(1).await?;
    assert_eq!(types(&got), [("run.stalled", 204)]);
    assert_eq!(got[0].2["data"]["stage"], held.stage.name.as_str());
    assert_eq!(got[0].2["data"]["run"], run.as_str());
    tokio::time::sleep(Duration::from_secs(2)).await;
    assert_eq!(lab.got().len(), 1, "until it moves again");
    handle.shutdown().await;
    Ok(())
}
