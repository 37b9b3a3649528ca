//! HTTP/2 where TLS is on: the same answers, and limits for each call where HTTP/1.1 has them for each connection.

use std::time::{Duration, Instant};

use access::{Scope, Scopes, Token};
use axum::body::Body;
use axum::http::{Request, StatusCode, Version, header};
use coordinator::Handle;
use hyper::body::Incoming;
use tempfile::TempDir;

use super::front::{Connection, connect};
use super::tls::{Files, authority, start_with};

struct Site {
    dir: TempDir,
    files: Files,
    token: Token,
    handle: Handle,
}

impl Site {
    async fn start(of_token: usize, idle: Duration) -> Self {
        let dir = tempfile::tempdir().unwrap();
        let (files, token) = (authority(dir.path(), "ours"), Token::random());
        let store = dir.path().join("store");
        let handle = start_with(&store, &files, &Token::random(), |config| {
            // Workers have no such limit, so this token is not theirs.
            config.tokens.add("reader", Scopes::of(&[Scope::Read]), &token);
            config.connections.of_token = of_token;
            config.connections.idle = idle;
            config.allowances.calls = 100_000;
        })
        .await;
        Self { dir, files, token, handle }
    }

    async fn connect(&self) -> Connection {
        connect(self.handle.address(), &self.files.ca).await
    }

    fn request(&self, host: &str, path: &str) -> Request<Body> {
        let request = Request::get(format!("https://{host}:{}{path}", self.handle.address().port()));
        request.header(header::AUTHORIZATION, format!("Bearer {}", self.token.secret())).body(Body::empty()).unwrap()
    }
}

impl Connection {
    async fn ask(&mut self, request: Request<Body>) -> Result<axum::http::Response<Incoming>, hyper::Error> {
        self.send.ready().await?;
        self.send.send_request(request).await
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn calls_of_one_connection_are_answered_and_an_idle_one_is_closed() {
    let site = Site::start(64, Duration::from_millis(300)).await;
    let mut connection = site.connect().await;
    let answer = connection.ask(site.request("localhost", "/v1/runs?limit=3")).await.unwrap();
    assert_eq!((answer.status(), answer.version()), (StatusCode::OK, Version::HTTP_2));
    // The host is checked where HTTP/1.1 has a header for it.
    let answer = connection.ask(site.request("evil.example", "/v1/runs")).await.unwrap();
    assert_eq!(answer.status(), StatusCode::MISDIRECTED_REQUEST);
    // A call that waits keeps its connection, however long it takes.
    let waited = Instant::now();
    let answer = connection.ask(site.request("localhost", "/v1/history?wait=2")).await.unwrap();
    assert!(answer.status() == StatusCode::OK && waited.elapsed() > Duration::from_secs(1), "{answer:?}");
    drop(answer);
    tokio::time::timeout(Duration::from_secs(20), connection.alive).await.expect("closed").unwrap();
    site.handle.shutdown().await;
    drop(site.dir);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn each_call_counts_against_its_token() {
    let site = Site::start(8, Duration::from_secs(20)).await;
    let connection = site.connect().await;
    let calls: Vec<_> = (0..40)
        .map(|_| {
            let mut send = connection.send.clone();
            let request = site.request("localhost", "/v1/history?wait=2");
            tokio::spawn(async move { send.send_request(request).await.unwrap().status() })
        })
        .collect();
    let mut statuses = Vec::new();
    for call in calls {
        statuses.push(call.await.unwrap());
    }
    let count = |status| statuses.iter().filter(|other| **other == status).count();
    // The connection itself counts, too.
    assert_eq!((count(StatusCode::OK), count(StatusCode::TOO_MANY_REQUESTS)), (7, 33), "{statuses:?}");
    let mut connection = connection;
    let again = connection.ask(site.request("localhost", "/v1/runs")).await.unwrap();
    assert_eq!(again.status(), StatusCode::OK, "places are free again");
    site.handle.shutdown().await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn floods_of_cancelled_calls_and_large_heads_end_their_connection_alone() {
    let site = Site::start(64, Duration::from_secs(20)).await;
    let mut flood = site.connect().await;
    for _ in 0..5_000 {
        if flood.send.ready().await.is_err() {
            break;
        }
        let call = flood.send.send_request(site.request("localhost", "/v1/history?wait=5"));
        // Dropping a call cancels it.
        drop(tokio::time::timeout(Duration::from_micros(10), call).await);
    }
    let mut large = site.connect().await;
    let mut request = site.request("localhost", "/v1/runs");
    request.headers_mut().insert("x-large", "x".repeat(200 << 10).parse().unwrap());
    let answer = large.ask(request).await;
    assert!(answer.as_ref().map_or(true, |answer| answer.status().is_client_error()), "{answer:?}");
    let (mut good, asked) = (site.connect().await, Instant::now());
    let answer = good.ask(site.request("localhost", "/v1/runs")).await.unwrap();
    assert_eq!(answer.status(), StatusCode::OK);
    assert!(asked.elapsed() < Duration::from_secs(5), "{:?}", asked.elapsed());
    site.handle.shutdown().await;
}
