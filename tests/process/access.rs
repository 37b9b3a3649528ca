//! Access of another user of the machine, and access to the documented server.

use std::fs;
use std::io::{Read, Write};
use std::net::TcpStream;
use std::os::unix::fs::PermissionsExt;
use std::os::unix::process::CommandExt;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::time::Duration;

use cluster_tests::{Bench, Running, wait_for};
use nix::sys::signal::Signal;

const TRAINER: &str = env!("CARGO_BIN_EXE_trainer");
/// The user `nobody`.
const OTHER: u32 = 65534;

fn files(dir: &Path) -> Vec<PathBuf> {
    let entries = fs::read_dir(dir).into_iter().flatten().flatten().map(|entry| entry.path());
    entries.flat_map(|path| if path.is_dir() { [files(&path), vec![path]].concat() } else { vec![path] }).collect()
}

/// Runs a program as another user and returns its output, or `None` if it fails.
fn as_other(program: &str, arguments: &[&str]) -> Option<String> {
    let output = Command::new(program).args(arguments).uid(OTHER).gid(OTHER).output().expect("the program starts");
    output.status.success().then(|| String::from_utf8_lossy(&output.stdout).into_owned())
}

fn ask(address: &str, method: &str, path: &str, more: &str) -> Option<u16> {
    let mut stream = TcpStream::connect(address).ok()?;
    stream.set_read_timeout(Some(Duration::from_secs(20))).ok()?;
    let head =
        format!("{method} {path} HTTP/1.1\r\nhost: {address}\r\nconnection: close\r\n{more}content-length: 0\r\n\r\n");
    stream.write_all(head.as_bytes()).ok()?;
    let mut answer = Vec::new();
    let _reset = stream.read_to_end(&mut answer);
    std::str::from_utf8(answer.get(9..12)?).ok()?.parse().ok()
}

/// Starts `trainer run` with workers, in a folder that every user may read.
fn running() -> (Bench, Running, String) {
    let bench = Bench::new(TRAINER);
    fs::set_permissions(bench.path(), fs::Permissions::from_mode(0o755)).expect("our own folder");
    let config = Bench::config("smoke.yaml");
    let mut command = bench.command(&["run", &config, "--set", "stages.vae.steps=100000", "--workers", "2"]);
    // As on most machines: new files are readable by all users unless the program restricts them.
    command.env_remove("STRIDE_TOKEN");
    let mut run = Running::start(command);
    let address = wait_for("workers that train", || {
        assert!(run.alive(), "the run ended");
        let lock = fs::read_to_string(bench.store().join("lock")).ok()?;
        let holder: serde_json::Value = serde_json::from_str(lock.lines().next()?).ok()?;
        let address = holder["address"].as_str()?.strip_prefix("http://")?.to_owned();
        (run.workers().len() == 2).then_some(address)
    });
    (bench, run, address)
}

#[test]
fn another_user_gets_nothing_from_a_run() {
    let (bench, run, address) = running();
    let secret = fs::read_to_string(bench.store().join("token")).expect("this user's token");

    // Without the token every call is refused, and no answer reveals the token.
    let routes = coordinator::shell::routes();
    for route in &routes {
        let path = route.path.replace("{run}", "r").replace("{worker}", "w1").replace("{action}", "cancel");
        let path = path.replace("{digest}", &format!("sha256:{}", "0".repeat(64)));
        for more in ["", "authorization: Bearer 0123456789abcdef0123456789abcdef\r\n"] {
            assert_eq!(ask(&address, route.method, &path, more), Some(401), "{} {path}", route.method);
        }
    }
    let fine = format!("authorization: Bearer {secret}\r\n");
    assert_eq!(ask(&address, "GET", "/v1/runs", &fine), Some(200));
    for pid in run.workers().into_values().chain([run.pid()]) {
        let line = fs::read(format!("/proc/{pid}/cmdline")).unwrap_or_default();
        assert!(!String::from_utf8_lossy(&line).contains(&secret), "process {pid} shows the token");
    }
    let status = bench.run(&["status", "-o", "json"]).expect_code(0).json();
    assert_eq!(status["state"], "running", "this user's own commands are let in");

    let all = files(&bench.store());
    assert!(all.iter().any(|path| path.ends_with("stride.db")) && all.len() > 5, "{all:?}");
    for path in all.iter().chain([&bench.store()]) {
        // Files come and go during the run.
        let Ok(metadata) = fs::symlink_metadata(path) else { continue };
        let mode = metadata.permissions().mode();
        assert_eq!(mode & 0o077, 0, "{} has mode {mode:o}", path.display());
    }
    if nix::unistd::geteuid().is_root() {
        assert!(as_other("ls", &[&bench.path().display().to_string()]).is_some(), "the folder around it is open");
        for path in &all {
            let path = path.display().to_string();
            assert_eq!(as_other("cat", &[&path]), None, "{path}");
            assert_eq!(as_other("ls", &[&path]), None, "{path}");
        }
        for pid in run.workers().into_values() {
            assert_eq!(as_other("cat", &[&format!("/proc/{pid}/environ")]), None);
        }
    } else {
        fixtures::skip("only root can try the files as another user; their modes were checked");
    }
    println!("{} routes and {} files tried", routes.len(), all.len());

    run.signal(Signal::SIGINT);
    run.wait();
    assert!(!bench.store().join("token").exists(), "the token goes with its run");
}

/// `kill -HUP` makes the server read the token file again; a broken file changes nothing.
#[test]
fn a_token_is_revoked_without_a_restart() {
    let bench = Bench::new(TRAINER);
    let (tokens, log) = (bench.path().join("tokens"), bench.path().join("serve.log"));
    let write = |text: &str| {
        fs::write(&tokens, text).expect("written");
        fs::set_permissions(&tokens, fs::Permissions::from_mode(0o600)).expect("ours");
    };
    let lines = ["alice read 0123456789abcdef-alice", "bob read 0123456789abcdef-bob"];
    write(&lines.join("\n"));
    let serve = ["serve", "--bind", "127.0.0.1:0", "--token-file", "tokens"];
    let mut server = Running::logged(bench.command(&serve).env_remove("STRIDE_TOKEN"), &log);
    let said = || fs::read_to_string(&log).unwrap_or_default();
    let address = wait_for("the server to listen", || {
        assert!(server.alive(), "{}", said());
        Some(said().split_once("listening on http://")?.1.split_once(' ')?.0.to_owned())
    });
    let asked =
        |name: &str| ask(&address, "GET", "/v1/runs", &format!("authorization: Bearer 0123456789abcdef-{name}\r\n"));
    let may = |name: &str| asked(name) == Some(200);
    assert!(may("alice") && may("bob"));
    write(&format!("{}\nbob nonsense 0123456789abcdef-bob\n", lines[0]));
    server.signal(Signal::SIGHUP);
    wait_for("the server to name the mistake", || said().contains("`nonsense` is not a scope").then_some(()));
    assert!(may("alice") && may("bob"), "the table stays as it was");
    write(lines[0]);
    server.signal(Signal::SIGHUP);
    // A call under way ends without an answer.
    wait_for("the line to be gone", || (asked("bob") == Some(401)).then_some(()));
    assert!(may("alice"));
    server.signal(Signal::SIGTERM);
    assert_eq!(server.wait().code, Some(0));
    let audit = bench.run(&["registry", "audit"]).expect_code(0).stdout;
    assert!(audit.contains("alice") && audit.contains("401"), "{audit}");
}
