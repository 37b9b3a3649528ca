//! `trainer serve --webhooks`: a file with a mistake is refused with its line, and the end of a run is sent.

use std::fs;
use std::io::{BufRead as _, BufReader, Read as _, Write as _};
use std::net::TcpListener;
use std::os::unix::fs::PermissionsExt as _;
use std::sync::mpsc;
use std::time::Duration;

use cluster_tests::{Bench, Running, wait_for};
use nix::sys::signal::Signal;

const TRAINER: &str = env!("CARGO_BIN_EXE_trainer");

const SECRET: &str = "whsec_MDEyMzQ1Njc4OWFiY2RlZg==";

/// Answers one request and returns its body.
fn receive(listener: &TcpListener) -> String {
    let mut reader = BufReader::new(listener.accept().expect("a connection").0);
    let (mut line, mut length) = (String::new(), 0);
    while reader.read_line(&mut line).expect("a line") > 2 {
        if let Some(value) = line.to_lowercase().strip_prefix("content-length:") {
            length = value.trim().parse().expect("a number");
        }
        line.clear();
    }
    let mut body = vec![0; length];
    reader.read_exact(&mut body).expect("a body");
    let answer = b"HTTP/1.1 204 No Content\r\nconnection: close\r\n\r\n";
    reader.get_mut().write_all(answer).expect("answered");
    String::from_utf8(body).expect("text")
}

#[test]
fn a_listed_address_gets_a_message_about_a_cancelled_run() {
    let bench = Bench::new(TRAINER);
    let (hooks, log) = (bench.path().join("hooks"), bench.path().join("serve.log"));
    let write = |text: &str| {
        fs::write(&hooks, text).expect("written");
        fs::set_permissions(&hooks, fs::Permissions::from_mode(0o600)).expect("ours");
    };
    let serve = ["serve", "--bind", "127.0.0.1:0", "--webhooks", "hooks"];
    write(&format!("# hooks\nlab http://chat.example.org/ {SECRET}\n"));
    let refused = bench.run(&serve).expect_code(2).stderr;
    assert!(refused.contains("line 2: the address is not encrypted") && !refused.contains(SECRET), "{refused}");

    let listener = TcpListener::bind("127.0.0.1:0").expect("a port");
    let address = listener.local_addr().expect("an address");
    let (send, got) = mpsc::channel();
    std::thread::spawn(move || send.send(receive(&listener)));
    write(&format!("lab http://{address}/in {SECRET} on=cancelled\n"));
    let mut server = Running::logged(&mut bench.command(&serve), &log);
    let said = || fs::read_to_string(&log).unwrap_or_default();
    wait_for("the server to listen", || {
        assert!(server.alive(), "{}", said());
        said().contains("listening on http://").then_some(())
    });
    bench.run(&["submit", &Bench::config("smoke.yaml")]).expect_code(0);
    bench.run(&["cancel"]).expect_code(0);
    let body = got.recv_timeout(Duration::from_secs(30)).expect("a message");
    assert!(body.contains(r#""type":"run.cancelled""#) && body.contains("was cancelled"), "{body}");
    server.signal(Signal::SIGTERM);
    assert_eq!(server.wait().code, Some(0));
}
