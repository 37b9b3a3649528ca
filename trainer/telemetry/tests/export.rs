//! A collector on this machine receives the spans of a process.

use std::io::{BufRead as _, BufReader, Read as _, Write as _};
use std::net::{TcpListener, TcpStream};
use std::process::Command;
use std::sync::mpsc;
use std::time::Duration;

use coordinator::{Config, Coordinator};

/// Answers every request, and passes on its first line and body.
fn collector() -> (String, mpsc::Receiver<(String, Vec<u8>)>) {
    let listener = TcpListener::bind("127.0.0.1:0").expect("a port");
    let url = format!("http://{}", listener.local_addr().expect("an address"));
    let (send, receive) = mpsc::channel();
    std::thread::spawn(move || {
        for stream in listener.incoming() {
            let mut reader = BufReader::new(stream.expect("a connection"));
            let mut lines = Vec::new();
            loop {
                let mut line = String::new();
                reader.read_line(&mut line).expect("a line");
                if line.trim().is_empty() {
                    break;
                }
                lines.push(line.trim().to_lowercase());
            }
            let length = lines.iter().find_map(|line| line.strip_prefix("content-length: ")).expect("a length");
            let mut body = vec![0; length.parse().expect("a number")];
            reader.read_exact(&mut body).expect("a body");
            reader
                .get_mut()
                .write_all(b"HTTP/1.1 200 OK\r\nconnection: close\r\ncontent-length: 0\r\n\r\n")
                .expect("sent");
            send.send((lines.first().cloned().unwrap_or_default(), body)).expect("somebody listens");
        }
    });
    (url, receive)
}

fn has(body: &[u8], text: &str) -> bool {
    body.windows(text.len()).any(|part| part == text.as_bytes())
}

/// The test sets variables of its process, so it runs itself once more.
#[test]
fn spans_reach_a_collector_with_their_names() {
    const CHILD: &str = "TELEMETRY_TEST_CHILD";
    if std::env::var_os(CHILD).is_some() {
        return record();
    }
    let (url, received) = collector();
    let this = std::env::current_exe().expect("this test");
    let mut child = Command::new(this);
    child.args(["--exact", "spans_reach_a_collector_with_their_names", "--nocapture"]).env(CHILD, "1");
    let output = child.env("OTEL_EXPORTER_OTLP_ENDPOINT", &url).env_remove("RUST_LOG").output().expect("it runs");
    let lines = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success(), "{lines}");
    // Lines look as they do without traces.
    assert!(lines.contains("INFO export: within") && !lines.contains("stride.run"), "{lines}");
    let mut sent = Vec::new();
    while let Ok((call, body)) = received.recv_timeout(Duration::from_millis(500)) {
        assert_eq!(call, "post /v1/traces http/1.1");
        sent.extend(body);
    }
    let words =
        ["the-service", "task", "stage train.vae", "stride.run", "run-1", "within", "http.response.status_code"];
    // A path is named as the table of calls has it, not as a client wrote it.
    for text in words.into_iter().chain(["GET /v1/runs/{run}", "GET /v1/health"]) {
        assert!(has(&sent, text), "`{text}` is not in {}", String::from_utf8_lossy(&sent));
    }
    assert!(!has(&sent, "no-such-run"), "{}", String::from_utf8_lossy(&sent));
    // All tasks of a run are in one trace, whose number follows from the run: the beginning of its SHA-256.
    let trace = [0x4e, 0x65, 0xd3, 0xfb];
    assert_eq!(sent.windows(4).filter(|part| *part == trace).count(), 2);
}

/// Makes spans of tasks as workers do, and those of requests by a server.
fn record() {
    let traces = telemetry::init("the-service", "info", false).expect("the only subscriber");
    for _ in 0..2 {
        let task = tracing::trace_span!(target: telemetry::SPANS, "task", stride.run = "run-1");
        telemetry::join_run(&task, "run-1");
        let _entered = task.entered();
        tracing::info!("within");
    }
    let name = format_args!("stage {}", "train.vae");
    drop(tracing::trace_span!(target: telemetry::SPANS, "stage", otel.name = %name).entered());
    let runtime = tokio::runtime::Runtime::new().expect("a runtime");
    let dir = tempfile::tempdir().expect("a folder");
    runtime.block_on(async {
        let holder = registry::Holder::this_process("a test");
        let store = registry::Store::open(dir.path(), holder).await.expect("a store");
        let handle = Coordinator::start(store, Config::embedded()).await.expect("a server");
        for path in ["/v1/health", "/v1/runs/no-such-run"] {
            let (address, token) = (handle.address(), handle.token().secret().to_owned());
            let head = format!(
                "GET {path} HTTP/1.1\r\nhost: localhost\r\nauthorization: Bearer {token}\r\nconnection: close\r\n\r\n"
            );
            let ask = move || {
                let mut stream = TcpStream::connect(address).expect("a connection");
                stream.write_all(head.as_bytes()).expect("sent");
                let mut answer = String::new();
                stream.read_to_string(&mut answer).expect("an answer");
                answer
            };
            let answer = tokio::task::spawn_blocking(ask).await.expect("an answer");
            assert!(answer.starts_with("HTTP/1.1 "), "{answer}");
        }
        handle.shutdown().await;
    });
    drop(traces);
}
