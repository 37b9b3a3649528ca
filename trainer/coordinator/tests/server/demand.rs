//! `GET /v1/demand` over HTTP: the wait for a change, and the one launcher that leads.

use std::time::{Duration, Instant};

use access::{Scopes, Server, Tokens};
use coordinator::{Config, Coordinator};
use protocol::demand::Demand;
use registry::{Holder, Store};
use reqwest::Method;

use crate::shell::{SECRET, TestResult, offer, start, submission};

async fn ask(server: &Server, query: &str) -> TestResult<Demand> {
    Ok(server.request(Method::GET, &format!("/v1/demand?{query}")).send().await?.error_for_status()?.json().await?)
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_call_for_demand_waits_for_a_change() -> TestResult {
    let dir = tempfile::tempdir()?;
    let (handle, server) = start(dir.path(), 50).await?;
    let empty = ask(&server, "").await?;
    assert!(empty.groups.is_empty() && empty.workers.is_empty() && empty.lead_ms == 0);
    let begun = Instant::now();
    let query = format!("after={}&wait=1", empty.version);
    assert_eq!(ask(&server, &query).await?.version, empty.version);
    assert!(begun.elapsed() >= Duration::from_secs(1), "nothing has changed");

    let waiting = tokio::spawn({
        let (server, query) = (server.clone(), format!("after={}&wait=30", empty.version));
        async move { ask(&server, &query).await }
    });
    let submitted = server.request(Method::POST, "/v1/runs").json(&submission()?).send().await?;
    assert!(submitted.status().is_success());
    let demand = tokio::time::timeout(Duration::from_secs(20), waiting).await???;
    assert_eq!(demand.groups.len(), 1);
    assert_eq!((demand.groups[0].ready, demand.groups[0].idle), (1, 0), "the dataset");

    let join = server.request(Method::POST, "/v1/workers").header(protocol::proof::SECRET_HEADER, SECRET);
    assert!(join.json(&offer()).send().await?.status().is_success());
    let demand = ask(&server, "").await?;
    assert!(!demand.workers[0].idle && demand.groups.iter().all(|group| group.ready == 0), "{demand:?}");
    handle.shutdown().await;
    Ok(())
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn of_two_launchers_with_the_same_labels_one_leads() -> TestResult {
    let dir = tempfile::tempdir()?;
    let store = Store::open(dir.path(), Holder::this_process("a test")).await?;
    let mut config = Config { alone: false, park: false, ..Config::embedded() };
    config.policy.lease_ms = 1_000;
    let handle = Coordinator::start(store, config).await?;
    let server = Server::new(&handle.url(), Some(handle.token().clone()), None)?;
    let leads = async |launcher: &str, labels: &str| -> TestResult<bool> {
        Ok(ask(&server, &format!("launcher={launcher}&labels={labels}")).await?.lead_ms > 0)
    };
    assert!(leads("one", "gpu=h100").await?);
    assert!(!leads("two", "gpu=h100").await?, "another one leads");
    assert!(leads("two", "gpu=a100").await?, "other labels");
    assert!(leads("one", "gpu=h100").await?);
    // The second takes over once the first has not called for a lease.
    let begun = Instant::now();
    while !leads("two", "gpu=h100").await? {
        assert!(begun.elapsed() < Duration::from_secs(20), "nobody leads");
        tokio::time::sleep(Duration::from_millis(100)).await;
    }
    assert!(begun.elapsed() >= Duration::from_millis(500));
    assert!(!leads("one", "gpu=h100").await?);
    for wrong in ["launcher=a%20b", "labels=gpu", "backend=abacus", "what=1"] {
        let answer = server.request(Method::GET, &format!("/v1/demand?{wrong}")).send().await?;
        assert_eq!(answer.status(), 400, "{wrong}");
    }
    handle.shutdown().await;
    Ok(())
}

/// A launcher's token shows numbers and names of workers, and nothing of runs.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_launch_token_sees_demand_and_no_run() -> TestResult {
    let dir = tempfile::tempdir()?;
    let store = Store::open(dir.path(), Holder::this_process("a test")).await?;
    let mut tokens = Tokens::default();
    let token: access::Token = "token-of-a-launcher-0123456789".parse()?;
    tokens.add("launcher", "launch".parse::<Scopes>()?, &token);
    let config = Config { tokens, alone: false, park: false, ..Config::embedded() };
    let handle = Coordinator::start(store, config).await?;
    let own = Server::new(&handle.url(), Some(handle.token().clone()), None)?;
    assert!(own.request(Method::POST, "/v1/runs").json(&submission()?).send().await?.status().is_success());
    let launcher = Server::new(&handle.url(), Some(token), None)?;
    let mut shown = String::new();
    let begun = Instant::now();
    // The store is asked first whether it has the value.
    while !shown.contains("ready") && begun.elapsed() < Duration::from_secs(20) {
        shown = launcher.request(Method::GET, "/v1/demand").send().await?.text().await?;
    }
    assert!(shown.contains("ready") && !shown.contains("vae") && !shown.contains("p-"), "{shown}");
    for route in coordinator::shell::routes().into_iter().filter(|route| route.path != "/v1/demand") {
        let method = Method::from_bytes(route.method.as_bytes())?;
        let answer = launcher.request(method, route.path).send().await?;
        assert_eq!(answer.status(), 403, "{} {}", route.method, route.path);
    }
    handle.shutdown().await;
    Ok(())
}
