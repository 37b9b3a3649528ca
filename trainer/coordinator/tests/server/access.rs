//! Access control, and the cost of unauthorised callers: tokens, scopes, host names, TLS, and anonymous connections.

use std::io::{Read, Write};
use std::net::{SocketAddr, TcpStream};
use std::time::Duration;

use access::{Scope, Scopes, Tokens};
use coordinator::shell::routes;
use coordinator::{Config, Coordinator, Handle, StartError};
use protocol::message::ApiError;
use registry::cli::{Answer, Command};
use registry::{Holder, Store};

const JSON: &str = "content-type: application/json\r\n";

async fn start(dir: &std::path::Path, config: Config) -> Handle {
    let store = Store::open(dir, Holder::this_process("a test")).await.unwrap();
    Coordinator::start(store, config).await.unwrap()
}

/// A token for each scope, named after it.
fn tokens() -> Tokens {
    let mut tokens = Tokens::default();
    for scope in Scope::ALL {
        assert!(tokens.add(format!("the-{scope}"), Scopes::of(&[scope]), &token(scope).parse().unwrap()));
    }
    tokens
}

fn token(scope: Scope) -> String {
    format!("token-of-one-who-may-{scope}")
}

/// Sends a raw request; returns the status and body of its answer.
fn exchange(address: SocketAddr, request: &str) -> (u16, Vec<u8>) {
    let mut stream = TcpStream::connect(address).unwrap();
    stream.set_read_timeout(Some(Duration::from_secs(20))).unwrap();
    stream.write_all(request.as_bytes()).unwrap();
    let mut answer = Vec::new();
    // A refused request ends with a reset if the server left its body unread.
    let _ = stream.read_to_end(&mut answer);
    let text = String::from_utf8_lossy(&answer);
    let status = text.get(9..12).unwrap_or_else(|| panic!("no answer to {request}")).parse().unwrap();
    let end = text.find("\r\n\r\n").unwrap() + 4;
    (status, answer[end..].to_vec())
}

fn call(address: SocketAddr, method: &str, path: &str, headers: &str, body: &str) -> (u16, Vec<u8>) {
    let length = body.len();
    let head = format!("{method} {path} HTTP/1.1\r\nhost: localhost\r\nconnection: close\r\n{headers}");
    exchange(address, &format!("{head}content-length: {length}\r\n\r\n{body}"))
}

fn bearer(token: &str) -> String {
    format!("authorization: Bearer {token}\r\n{JSON}")
}

/// The expected scopes of all routes. A change of a route's scopes must be repeated here, so that it cannot be
/// accidental.
fn expected(method: &str, path: &str) -> &'static [Scope] {
    use Scope::{Admin, Launch, Promote, Read, Submit, Worker};
    match (method, path) {
        ("GET", "/v1/runs" | "/v1/runs/{run}" | "/v1/runs/{run}/logs" | "/v1/runs/{run}/metrics") => &[Read],
        ("GET", "/v1/runs/{run}/settings" | "/v1/runs/{run}/checkpoints") => &[Read],
        ("GET", "/metrics" | "/v1/metrics" | "/v1/history" | "/v1/events" | "/v1/workers") => &[Read],
        ("GET" | "POST" | "DELETE", "/v1/session") => &[Read],
        ("GET", "/v1/storage") => &[Admin],
        ("POST", "/v1/runs" | "/v1/draws" | "/v1/tickets" | "/v1/runs/{run}/{action}" | "/v1/bundles") => &[Submit],
        ("POST", "/v1/workers" | "/v1/workers/{worker}/poll" | "/v1/workers/{worker}/gone") => &[Worker],
        ("POST", "/v1/metrics" | "/v1/logs" | "/v1/checkpoints" | "/v1/outcomes") => &[Worker],
        ("GET", "/v1/blobs/{digest}") => &[Read, Worker],
        ("PUT", "/v1/blobs/{digest}") | ("GET", "/v1/blobs/{digest}/staged") => &[Worker],
        ("POST", "/v1/blobs/{digest}/sent") => &[Worker],
        ("GET", "/v1/demand") => &[Launch],
        ("POST", "/v1/registry") => &[Read, Promote, Admin],
        other => panic!("{other:?} is not in this table: say who may call it"),
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn every_route_is_open_to_its_scopes_and_to_nobody_else() {
    let dir = tempfile::tempdir().unwrap();
    let handle = start(dir.path(), Config { tokens: tokens(), ..Config::embedded() }).await;
    let address = handle.address();
    let (mut allowed, mut refused) = (0, 0);
    for route in routes() {
        let needed = expected(route.method, route.path);
        assert_eq!(route.scopes, needed, "{} {}", route.method, route.path);
        let path = route.path.replace("{run}", "r").replace("{worker}", "w").replace("{action}", "pause");
        let path = path.replace("{digest}", "sha256:0");
        // A stream without an end would be waited for.
        let path = if path == "/v1/events" { "/v1/events?lasts=0".to_owned() } else { path };
        for headers in ["", "authorization: Basic dG9rZW4=\r\n", &bearer("a-token-that-nobody-was-given"), &bearer("")]
        {
            assert_eq!(call(address, route.method, &path, headers, "").0, 401, "{} {path} {headers}", route.method);
        }
        for scope in Scope::ALL {
            // The body does not parse, so that an admitted caller gets an error about it.
            let (status, body) = call(address, route.method, &path, &bearer(&token(scope)), "?");
            let may = needed.iter().any(|needed| Scopes::of(&[scope]).allow(*needed));
            let shown = format!("{} {path} as {scope}: {status} {}", route.method, String::from_utf8_lossy(&body));
            assert_eq!(status == 403, !may, "{shown}");
            assert_ne!(status, 401, "{shown}");
            if may { allowed += 1 } else { refused += 1 }
        }
        assert_ne!(call(address, route.method, &path, &bearer(handle.token().secret()), "?").0, 403, "this user's own");
    }
    println!("{} routes: {allowed} calls let in, {refused} refused by scope", routes().len());
    assert_eq!(call(address, "GET", "/v1/health", "", "").0, 200, "asked without a token");
    assert_eq!(call(address, "GET", "/v1/none", "", "").0, 404);
    handle.shutdown().await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn each_command_of_the_registry_asks_for_its_scope_and_moves_bear_the_tokens_name() {
    let dir = tempfile::tempdir().unwrap();
    let handle = start(dir.path(), Config { tokens: tokens(), ..Config::embedded() }).await;
    let promote = Command::Promote {
        reference: "m:1".into(),
        to: "prod".into(),
        expect: None,
        require: vec![],
        reason: "r".into(),
    };
    let rollback =
        Command::Rollback { model: "m".into(), alias: "prod".into(), to: None, expect: None, reason: "r".into() };
    let commands = [
        (Command::List, Scope::Read),
        (Command::Show { reference: "m".into() }, Scope::Read),
        (Command::Lineage { reference: "m:1".into() }, Scope::Read),
        (promote, Scope::Promote),
        (rollback, Scope::Promote),
        (Command::Fsck, Scope::Admin),
        (Command::Gc { dry_run: true, grace_minutes: None }, Scope::Admin),
    ];
    for (command, needed) in commands {
        for scope in Scope::ALL {
            let body = serde_json::to_string(&command).unwrap();
            let (status, answer) = call(handle.address(), "POST", "/v1/registry", &bearer(&token(scope)), &body);
            let may = Scopes::of(&[scope]).allow(needed);
            assert_eq!(status, if may { 200 } else { 403 }, "{command:?} as {scope}");
            if may {
                serde_json::from_slice::<Answer>(&answer).unwrap();
            } else {
                let error: ApiError = serde_json::from_slice(&answer).unwrap();
                assert!(error.message.contains(&format!("the-{scope}")), "{}", error.message);
            }
        }
    }
    // Fields of another build, such as a name that the client would like to use, have no effect.
    let body = r#"{"command": "list", "actor": "root"}"#;
    assert_eq!(call(handle.address(), "POST", "/v1/registry", &bearer(&token(Scope::Read)), body).0, 200);
    handle.shutdown().await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn what_a_browser_was_made_to_send_is_refused() {
    let dir = tempfile::tempdir().unwrap();
    let config = Config { tokens: tokens(), hosts: vec!["stride.lab".into()], ..Config::embedded() };
    let handle = start(dir.path(), config).await;
    let address = handle.address();
    let token = token(Scope::Admin);
    let ask = |head: &str| {
        exchange(
            address,
            &format!("GET /v1/runs HTTP/1.1\r\n{head}authorization: Bearer {token}\r\nconnection: close\r\n\r\n"),
        )
        .0
    };
    for fine in ["localhost", "127.0.0.1:1", "[::1]:7700", "stride.lab:80", &address.to_string()] {
        assert_eq!(ask(&format!("host: {fine}\r\n")), 200, "{fine}");
        assert_eq!(ask(&format!("host: {fine}\r\norigin: http://{fine}\r\n")), 200, "{fine}");
    }
    // A name rebound to our address, and no name at all.
    for other in ["evil.example", "evil.example:7700", "localhost.evil.example", ""] {
        assert_eq!(ask(&format!("host: {other}\r\n")), 421, "{other}");
    }
    for origin in ["http://evil.example", "null", "file://", "http://localhost.evil.example", "http://127.0.0.1:2"] {
        assert_eq!(ask(&format!("host: 127.0.0.1:1\r\norigin: {origin}\r\n")), 403, "{origin}");
    }
    handle.shutdown().await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn beyond_this_machine_a_token_and_tls_are_wanted() {
    let dir = tempfile::tempdir().unwrap();
    let store = Store::open(dir.path(), Holder::this_process("a test")).await.unwrap();
    let anywhere = SocketAddr::from(([0, 0, 0, 0], 0));
    let nobody = Config { insecure: true, ..Config::server(anywhere, Tokens::default()) };
    assert!(matches!(Coordinator::start(store.clone(), nobody).await, Err(StartError::NoToken(_))));
    let clear = Config::server(anywhere, tokens());
    assert!(matches!(Coordinator::start(store.clone(), clear.clone()).await, Err(StartError::NoTls(_))));
    let handle = Coordinator::start(store, Config { insecure: true, ..clear }).await.unwrap();
    assert_ne!(handle.url(), handle.local_url(), "this machine's commands have a door of their own");
    for url in [handle.url().replace("0.0.0.0", "127.0.0.1"), handle.local_url()] {
        let address = url.strip_prefix("http://").unwrap().parse().unwrap();
        assert_eq!(call(address, "GET", "/v1/runs", "", "").0, 401);
        assert_eq!(call(address, "GET", "/v1/runs", &bearer(&token(Scope::Read)), "").0, 200);
    }
    handle.shutdown().await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn bodies_beyond_their_limit_are_refused_before_they_are_read() {
    let dir = tempfile::tempdir().unwrap();
    let handle = start(dir.path(), Config { tokens: tokens(), ..Config::embedded() }).await;
    let headers = bearer(&token(Scope::Admin));
    for (path, bytes) in [("/v1/workers", 1 << 20), ("/v1/metrics", 16 << 20), ("/v1/runs", 8 << 20)] {
        let head = format!("POST {path} HTTP/1.1\r\nhost: localhost\r\nconnection: close\r\n{headers}");
        let answer = exchange(handle.address(), &format!("{head}content-length: {}\r\n\r\n", bytes + 1));
        assert_eq!(answer.0, 413, "{path}");
    }
    // A body of unknown length.
    let part = "8000\r\n".to_owned() + &" ".repeat(0x8000) + "\r\n";
    let head = format!("POST /v1/workers HTTP/1.1\r\nhost: localhost\r\nconnection: close\r\n{headers}");
    let answer = exchange(handle.address(), &format!("{head}transfer-encoding: chunked\r\n\r\n{}", part.repeat(34)));
    assert_eq!(answer.0, 413);
    let plain = format!("authorization: Bearer {}\r\n", token(Scope::Admin));
    assert_eq!(call(handle.address(), "POST", "/v1/runs", &plain, "{}").0, 415, "a form of a page");
    handle.shutdown().await;
}
